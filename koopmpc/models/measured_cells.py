"""The squared error of a model that runs freely over segments, at the cells that were measured, and its slopes."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar, cast

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc.base.interrupts import raise_swallowed
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.partial import PartialEpisodes
from koopmpc.lifting.base import Lifting
from koopmpc.models.moments.solve import BilinearColumns

_Column = TypeVar("_Column", np.ndarray, ca.SX)


@dataclass(frozen=True)
class ModelColumns:
    """What x⁺ = Θ φ is linear in: φ = [ψ(ζ); w⊗u; u; w; u⊗ψ; w⊗ψ], products where the model is bilinear.

    Attributes
    ----------
    lifting
        ψ, bound to the names of ζ.
    nx, nu, nw
        Entries of x, u and w.
    embedding
        What makes ζ of x and its past; None where ζ is x.
    bilinear, crossed
        Whether u and w multiply ψ, and whether w multiplies u.
    """

    lifting: Lifting
    nx: int
    nu: int
    nw: int
    embedding: Delay | None
    bilinear: bool
    crossed: bool
    past: int = field(init=False)  # rows before x that ζ holds
    of_states: Int[np.ndarray, " ns"] = field(init=False)  # entries of ζ that are x_k, x_{k−1}, …, one after the other

    def __post_init__(self) -> None:
        d = 0 if self.embedding is None else self.embedding.steps
        more = self.nu if self.embedding is not None and self.embedding.inputs else 0
        block = self.nx + more
        first = [0, *(self.nx + block * i + more for i in range(d))]
        object.__setattr__(self, "past", d)
        object.__setattr__(self, "of_states", np.concatenate([k + np.arange(self.nx) for k in first]))

    @property
    def factors(self) -> Int[np.ndarray, " np"]:
        """The observables that u and w multiply: all but the Constant."""
        every = np.arange(self.lifting.nz) if self.bilinear else np.zeros(0, dtype=np.intp)
        return every if self.lifting.constant_index is None else every[every != self.lifting.constant_index]

    @property
    def parts(self) -> BilinearColumns:
        """The order of the columns."""
        return BilinearColumns(self.lifting.nz, self.nu, self.nw, crossed=self.crossed)

    def arrange(self, psi: list[_Column], u: list[_Column], w: list[_Column]) -> list[_Column]:
        """Return the columns of φ."""
        crossed = [wj * ui for wj in w for ui in u] if self.crossed else []
        factors: list[int] = self.factors.tolist()
        products = [each * psi[i] for each in (*u, *w) for i in factors]
        return [*psi, *crossed, *u, *w, *products]

    def evaluate(
        self, points: Float[np.ndarray, "m nzeta"], U: Float[np.ndarray, "m nu"], W: Float[np.ndarray, "m nw"]
    ) -> Float[np.ndarray, "m nphi"]:
        """Return φ of rows."""
        psi = np.asarray(self.lifting(points))
        return np.stack(self.arrange(list(psi.T), list(U.T), list(W.T)), axis=1)

    def points(
        self, states: Float[np.ndarray, "m ns"], U: Float[np.ndarray, "past m nu"]
    ) -> Float[np.ndarray, "m nzeta"]:
        """Return ζ of [x_k, x_{k−1}, …] and of u_{k−d} … u_{k−1}."""
        if not self.past or self.embedding is None or not self.embedding.inputs:
            return states
        first, *before = np.split(states, self.past + 1, axis=1)
        return np.hstack([first, *(part for u, x in zip(U[::-1], before, strict=True) for part in (u, x))])


@dataclass(frozen=True, eq=False)
class Cells:
    """Segments of m runs: states with NaN, (steps + 1, m, nx), which were measured, and what drove, (steps, m, …)."""

    X: Float[np.ndarray, "steps1 m nx"]
    measured: Bool[np.ndarray, "steps1 m nx"]
    U: Float[np.ndarray, "steps m nu"]
    W: Float[np.ndarray, "steps m nw"]


class CellSlopes(NamedTuple):
    """Gauss-Newton of Θ and of the starts of all segments, in spreads; the starts are eliminated segment by segment."""

    gradient: Float[np.ndarray, " p"]
    matrix: Float[np.ndarray, "p p"]
    of_starts: Float[np.ndarray, "m ns"]
    starts: Float[np.ndarray, "m ns ns"]
    cross: Float[np.ndarray, "m ns p"]

    def solve(self, damping: float) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "m ns"]]:
        """Return the steps of Θ and of the starts, in spreads."""
        ns = self.starts.shape[1]
        own = np.diagonal(self.starts, axis1=1, axis2=2)
        inverse: np.ndarray = np.linalg.inv(
            self.starts + damping * (own + 1e-9)[:, :, None] * np.eye(ns) + 1e-12 * np.eye(ns)
        )
        moved: np.ndarray = inverse @ self.cross
        matrix = self.matrix - np.einsum("mip,miq->pq", self.cross, moved)
        gradient = self.gradient - np.einsum("mip,mi->p", moved, self.of_starts)
        scale = np.sqrt(np.where(self.matrix.diagonal() > 0, self.matrix.diagonal(), 1.0))
        scaled = matrix / np.outer(scale, scale) + damping * np.eye(len(scale))
        theta = -np.asarray(np.linalg.lstsq(scaled, gradient / scale, rcond=None)[0], dtype=np.float64) / scale
        return theta, -np.einsum("mij,mj->mi", inverse, self.of_starts + self.cross @ theta)


class MeasuredError:
    """The mean squared error of x̂_{k+1} = Θ φ(ζ̂_k, u_k, w_k) at the measured cells, x̂_0 … x̂_d free in each segment.

    d is the number of past rows in ζ. The free rows of a segment are its start, [x̂_d, …, x̂_0], newest first.
    """

    @raise_swallowed()
    def __init__(self, columns: ModelColumns, size: Float[np.ndarray, " nx"]) -> None:
        x = ca.SX.sym("x", columns.nx if columns.embedding is None else len(columns.embedding.names))
        u, w = ca.SX.sym("u", columns.nu), ca.SX.sym("w", columns.nw)
        signals = (columns.lifting.symbolic(x), u, w)
        phi = ca.densify(ca.vertcat(*columns.arrange(*(ca.vertsplit(each) for each in signals))))
        theta = ca.SX.sym("theta", columns.nx, phi.numel())
        self._slopes = ca.Function(
            "slopes", [x, u, w, theta], [phi, ca.densify(ca.jacobian(theta @ phi, x))], {"cse": True}
        )
        self.columns, self.shape, self.size = columns, (columns.nx, int(phi.numel())), size
        self.start_size: Float[np.ndarray, " ns"] = np.tile(size, columns.past + 1)

    @raise_swallowed()
    def _step(
        self, states: Float[np.ndarray, "m ns"], k: int, cells: Cells, theta: Float[np.ndarray, "nx nphi"]
    ) -> tuple[Float[np.ndarray, "m nphi"], Float[np.ndarray, "m nx ns"]]:
        """Return φ of row k, whose states and past these are, and the slopes of Θ φ along them."""
        columns, m = self.columns, len(states)
        zeta = columns.points(states, cells.U[k - columns.past : k])
        drive = zeta.T, cells.U[k].T, cells.W[k].T, np.tile(theta, (1, m))
        phi, slope = (np.asarray(v) for v in cast("Any", self._slopes.map(m)(*drive)))
        return phi.T, slope.reshape(columns.nx, m, -1).transpose(1, 0, 2)[:, :, columns.of_states]

    def _begin(self, starts: Float[np.ndarray, "m ns"]) -> list[Float[np.ndarray, "m nx"]]:
        """Return the free rows of the segments, oldest first."""
        return np.split(starts, self.columns.past + 1, axis=1)[::-1]

    @np.errstate(over="ignore", invalid="ignore")
    def simulate(
        self, theta: Float[np.ndarray, "nx nphi"], starts: Float[np.ndarray, "m ns"], cells: Cells
    ) -> Float[np.ndarray, "steps1 m nx"]:
        """Return x̂ of all segments."""
        found, states, nx = self._begin(starts), starts, self.columns.nx
        for k in range(self.columns.past, len(cells.U)):
            found.append(self._step(states, k, cells, theta)[0] @ theta.T)
            states = np.hstack([found[-1], states[:, :-nx]])
        return np.stack(found)

    def evaluate(self, theta: Float[np.ndarray, "nx nphi"], starts: Float[np.ndarray, "m ns"], cells: Cells) -> float:
        """Return the mean over all measured cells; inf where a forecast overflows."""
        with np.errstate(over="ignore", invalid="ignore"):
            gap = (self.simulate(theta, starts, cells) - cells.X) / self.size
            total = float(np.mean(gap[cells.measured] ** 2))
        return total if np.isfinite(total) else np.inf

    def derivatives(
        self, theta: Float[np.ndarray, "nx nphi"], starts: Float[np.ndarray, "m ns"], cells: Cells
    ) -> CellSlopes:
        """Return half the gradient of `evaluate`, and the Gauss-Newton matrices."""
        (nx, count), (m, ns), past = self.shape, starts.shape, self.columns.past
        p = nx * count
        gradient, matrix = np.zeros(p), np.zeros((p, p))
        of_starts, own, cross = np.zeros((m, ns)), np.zeros((m, ns, ns)), np.zeros((m, ns, p))
        states, D, S = starts, np.zeros((m, ns, p)), np.tile(np.diag(self.start_size), (m, 1, 1))
        rows = np.arange(nx)
        for k in range(len(cells.X)):
            if k > past:
                phi, slope = self._step(states, k - 1, cells, theta)
                moved, started = slope @ D, slope @ S
                moved.reshape(m, nx, nx, count)[:, rows, rows] += phi[:, None]
                states = np.hstack([phi @ theta.T, states[:, :-nx]])
                D, S = np.hstack([moved, D[:, :-nx]]), np.hstack([started, S[:, :-nx]])
            at = slice(nx * max(past - k, 0), nx * max(past - k, 0) + nx)  # where x̂_k stands in the states
            seen = cells.measured[k][:, :, None] / self.size[:, None]
            gap = np.where(cells.measured[k], (states[:, at] - np.nan_to_num(cells.X[k])) / self.size, 0.0)
            Dw, Sw = D[:, at] * seen, S[:, at] * seen
            gradient += np.einsum("mip,mi->p", Dw, gap)
            matrix += Dw.reshape(m * nx, p).T @ Dw.reshape(m * nx, p)
            of_starts += np.einsum("mij,mi->mj", Sw, gap)
            own += np.einsum("mij,mik->mjk", Sw, Sw)
            cross += np.einsum("mij,mip->mjp", Sw, Dw)
        cut = 1.0 / cells.measured.sum()
        return CellSlopes(cut * gradient, cut * matrix, cut * of_starts, cut * own, cut * cross)


def cut_cells(
    data: PartialEpisodes, bridged: Episodes, horizon: int, past: int
) -> tuple[Cells, Float[np.ndarray, "m ns"]]:
    """Return the segments of all runs, one after the other, and where they start on the bridged rows."""
    X, U, W, starts = list[np.ndarray](), list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    for x, u, w, whole in zip(data.X, data.U, data.W, bridged, strict=True):
        first = np.arange(0, len(u) - horizon + 1, horizon)
        if len(first) and len(u) - horizon > first[-1]:
            first = np.append(first, len(u) - horizon)
        ahead = np.arange(horizon + 1)[:, None] + first
        X.append(x[ahead])
        U.append(u[ahead[:-1]])
        W.append(w[ahead[:-1]])
        starts.append(np.hstack([whole.X[first + past - i] for i in range(past + 1)]))
    cells = np.concatenate(X, axis=1)
    driven = np.concatenate(U, axis=1), np.concatenate(W, axis=1)
    return Cells(cells, np.isfinite(cells), *driven), np.concatenate(starts)
