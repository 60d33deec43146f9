"""unequal_rates: a linear model of runs in which sensors measured at rates of their own, fitted to measured cells."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float

from koopmpc import checks
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.partial import PartialEpisodes
from koopmpc.errors import DataError
from koopmpc.identify.fits.edmd import edmd
from koopmpc.interrupts import raise_swallowed
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.state import State
from koopmpc.predict.predictors import LinearPredictor

_GAPS = 4  # a segment has this many measurements of the slowest sensor
_SHORT = 20  # a segment has at least so many steps
_CONVERGED = 1e-13  # stop where a step lowers the error by less than this share
_EXACT = 1e-16  # at this mean squared error in spreads no other start is tried
_LEAST = 1e-24  # stop at this mean squared error in spreads: rounding
_DAMPING = 1e-3  # damping of the first step, as a share of the diagonal
_TRIALS = 12  # times that the damping grows before the fit ends


@dataclass(frozen=True, eq=False)
class _Cells:
    """Segments of runs: states with NaN, (steps + 1, m, nx), which were measured, and inputs, (steps, m, nu)."""

    X: Float[np.ndarray, "steps1 m nx"]
    measured: Bool[np.ndarray, "steps1 m nx"]
    U: Float[np.ndarray, "steps m nu"]


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Gauss-Newton of Θ and of the starts of all segments; the starts are eliminated segment by segment."""

    gradient: Float[np.ndarray, " p"]
    matrix: Float[np.ndarray, "p p"]
    of_starts: Float[np.ndarray, "m nx"]
    starts: Float[np.ndarray, "m nx nx"]
    cross: Float[np.ndarray, "m nx p"]

    def solve(self, damping: float) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "m nx"]]:
        """Return the steps of Θ and of the starts."""
        nx = self.starts.shape[1]
        own = np.diagonal(self.starts, axis1=1, axis2=2)
        inverse: np.ndarray = np.linalg.inv(
            self.starts + damping * (own + 1e-9)[:, :, None] * np.eye(nx) + 1e-12 * np.eye(nx)
        )
        moved: np.ndarray = inverse @ self.cross
        matrix = self.matrix - np.einsum("mip,miq->pq", self.cross, moved)
        gradient = self.gradient - np.einsum("mip,mi->p", moved, self.of_starts)
        scale = np.sqrt(np.where(self.matrix.diagonal() > 0, self.matrix.diagonal(), 1.0))
        scaled = matrix / np.outer(scale, scale) + damping * np.eye(len(scale))
        theta = -np.asarray(np.linalg.lstsq(scaled, gradient / scale, rcond=None)[0], dtype=np.float64) / scale
        return theta, -np.einsum("mij,mj->mi", inverse, self.of_starts + self.cross @ theta)


class _Found(NamedTuple):
    """The end of one minimisation: its error, iterations and Θ, and the segments as the model simulates them."""

    value: float
    steps: int
    theta: Float[np.ndarray, "nx nphi"]
    simulated: Episodes


class _MeasuredError:
    """The mean squared error of x̂_{k+1} = Θ [ψ(x̂_k); u_k] at the measured cells, x̂_0 free in each segment."""

    @raise_swallowed()
    def __init__(self, lifting: Lifting, nx: int, nu: int, size: Float[np.ndarray, " nx"]) -> None:
        x, u = ca.SX.sym("x", nx), ca.SX.sym("u", nu)
        phi = ca.densify(ca.vertcat(lifting.symbolic(x), u))
        theta = ca.SX.sym("theta", nx, phi.numel())
        self._slopes = ca.Function(
            "slopes", [x, u, theta], [phi, ca.densify(ca.jacobian(theta @ phi, x))], {"cse": True}
        )
        self.shape, self.size = (nx, int(phi.numel())), size

    @raise_swallowed()
    def _step(
        self, x: Float[np.ndarray, "m nx"], u: Float[np.ndarray, "m nu"], theta: Float[np.ndarray, "nx nphi"]
    ) -> tuple[Float[np.ndarray, "m nphi"], Float[np.ndarray, "m nx nx"]]:
        m, nx = x.shape
        phi, slope = (np.asarray(v) for v in cast("Any", self._slopes.map(m)(x.T, u.T, np.tile(theta, (1, m)))))
        return phi.T, slope.reshape(nx, m, nx).transpose(1, 0, 2)

    @np.errstate(over="ignore", invalid="ignore")
    def simulate(
        self, theta: Float[np.ndarray, "nx nphi"], starts: Float[np.ndarray, "m nx"], cells: _Cells
    ) -> Float[np.ndarray, "steps1 m nx"]:
        """Return x̂ of all segments."""
        found = [starts]
        for u in cells.U:
            found.append(self._step(found[-1], u, theta)[0] @ theta.T)
        return np.stack(found)

    def evaluate(self, theta: Float[np.ndarray, "nx nphi"], starts: Float[np.ndarray, "m nx"], cells: _Cells) -> float:
        """Return the mean over all measured cells; inf where a forecast overflows."""
        with np.errstate(over="ignore", invalid="ignore"):
            gap = (self.simulate(theta, starts, cells) - cells.X) / self.size
            total = float(np.mean(gap[cells.measured] ** 2))
        return total if np.isfinite(total) else np.inf

    def derivatives(
        self, theta: Float[np.ndarray, "nx nphi"], starts: Float[np.ndarray, "m nx"], cells: _Cells
    ) -> _Slopes:
        """Return half the gradient of `evaluate`, and the Gauss-Newton matrices."""
        (nx, count), m = self.shape, len(starts)
        p = nx * count
        gradient, matrix = np.zeros(p), np.zeros((p, p))
        of_starts, own, cross = np.zeros((m, nx)), np.zeros((m, nx, nx)), np.zeros((m, nx, p))
        x, D, S = starts, np.zeros((m, nx, p)), np.tile(np.eye(nx), (m, 1, 1))
        rows = np.arange(nx)
        for k in range(len(cells.X)):
            if k:
                phi, slope = self._step(x, cells.U[k - 1], theta)
                D, S = slope @ D, slope @ S
                D.reshape(m, nx, nx, count)[:, rows, rows] += phi[:, None]
                x = phi @ theta.T
            seen = cells.measured[k][:, :, None] / self.size[:, None]
            gap = np.where(cells.measured[k], (x - np.nan_to_num(cells.X[k])) / self.size, 0.0)
            Dw, Sw = D * seen, S * seen
            gradient += np.einsum("mip,mi->p", Dw, gap)
            matrix += Dw.reshape(m * nx, p).T @ Dw.reshape(m * nx, p)
            of_starts += np.einsum("mij,mi->mj", Sw, gap)
            own += np.einsum("mij,mik->mjk", Sw, Sw)
            cross += np.einsum("mij,mip->mjp", Sw, Dw)
        cut = 1.0 / cells.measured.sum()
        return _Slopes(cut * gradient, cut * matrix, cut * of_starts, cut * own, cut * cross)


def unequal_rates(
    data: PartialEpisodes, lifting: Lifting, *, horizon: int | None = None, iterations: int = 60
) -> LinearPredictor:
    """Fit z⁺ = A z + B u to runs whose sensors measured at rates of their own: residuals at measured cells alone.

    min over Θ = C [A B] and the first state of each segment of Σ ((x̂_k − x_k) / σ)² over the cells that were
    measured, x̂_{k+1} = Θ [ψ(x̂_k); u_k] lifted afresh. Levenberg-Marquardt with exact derivatives; first states are
    eliminated segment by segment. It starts at least squares on rows whose gaps are bridged by straight lines, by held
    values, and by the mean, and takes the least error of the three; only the start depends on them. Segments become
    longer in two steps. Rows of observables other than the states come from `edmd` on the states that the model itself
    simulates.

    Parameters
    ----------
    data
        Runs with NaN where a state was not measured.
    lifting
        Observables that hold the states, `State() + …`, without delays.
    horizon
        Steps of a segment; by default four times the longest gap, at least 20.
    iterations
        Levenberg-Marquardt steps, at most.

    Raises
    ------
    DataError
        No run has a segment; fewer cells were measured than there are unknowns; the lifting lacks a state.

    References
    ----------
    Ljung, "System Identification: Theory for the User", 2nd ed., 1999, section 14.2: missing data as parameters of the
    prediction error.

    Examples
    --------
    >>> import koopmpc as km
    >>> import numpy as np
    >>> rng, A, x = np.random.default_rng(0), np.array([[0.9, 0.2], [-0.1, 0.8]]), [np.zeros(2)]
    >>> U = rng.standard_normal((300, 1))
    >>> for u in U:
    ...     x.append(A @ x[-1] + np.array([0.0, 0.5]) * u)
    >>> X = np.array(x)
    >>> X[np.arange(301) % 10 > 0, 1] = np.nan  # the second sensor measures every tenth row
    >>> model = km.identify.unequal_rates(km.data.PartialEpisodes(X=[X], U=[U], dt=0.1), km.State())
    >>> bool(np.abs(model.A - A).max() < 1e-6)
    True
    """
    checks.kind(data, "data", PartialEpisodes, "pass km.data.PartialEpisodes(X=[…], U=[…], dt=…)")
    checks.kind(lifting, "lifting", Lifting, "for example km.State()")
    bound, iterations = lifting.bind(data.states), checks.count(iterations, "iterations")
    if not set(State().bind(data.states).names) <= set(bound.names):
        raise DataError(f"the lifting lacks a state; pass km.State() + … of {', '.join(data.states)}")
    longest = max(map(len, data.U))
    wanted = max(_GAPS * data.find_gap(), _SHORT) if horizon is None else checks.count(horizon, "horizon")
    if horizon is not None and horizon > longest:
        raise DataError(
            f"no run has the {horizon} steps of a segment; the longest has {longest}, pass a shorter horizon"
        )
    wanted = min(wanted, longest)
    nx, nu = len(data.states), len(data.inputs)
    size = np.nanstd(np.concatenate(data.X), axis=0)
    error = _MeasuredError(bound, nx, nu, np.where(size > 0, size, 1.0))
    lengths = sorted({max(wanted // 2, 1), wanted})
    best: _Found | None = None
    for kind in ("line", "held", "mean"):
        found = _fit_from(data, error, bound, _bridge(data, kind), lengths, iterations)
        best = found if best is None or found.value < best.value else best
        if best.value < _EXACT:
            break
    assert best is not None, "there are three starts"
    value, steps, theta, simulated = best
    model = edmd(simulated, lifting)
    places = np.argmax(model.C, axis=1)
    A, B = model.A.copy(), model.B.copy()
    A[places], B[places] = theta[:, : model.nz], theta[:, model.nz :]
    measured = int(data.count_measured().sum())
    report = model.report
    if report is not None:
        sentence = (
            f"fitted to {measured} measured cells of {sum(x.size for x in data.X)} by simulation over {wanted} steps, "
            f"{steps} iterations; their error is {np.sqrt(value):.3g} spreads"
        )
        report = replace(report, method="unequal_rates", samples=measured, changes=(*report.changes, sentence))
    return LinearPredictor(
        A, B, model.C, model.lifting, model.dt, model.states, model.inputs, report, scale=model.scale
    )


def _fit_from(
    data: PartialEpisodes,
    error: _MeasuredError,
    lifting: Lifting,
    bridged: Episodes,
    lengths: list[int],
    iterations: int,
) -> _Found:
    """Return where the minimisation ends that starts at one-step least squares on the bridged rows."""
    before, after = np.concatenate([e.X[:-1] for e in bridged]), np.concatenate([e.X[1:] for e in bridged])
    phi = np.hstack([lifting(before), np.concatenate([e.U for e in bridged])])
    theta, steps = np.asarray(np.linalg.lstsq(phi, after, rcond=None)[0]).T, 0
    cells, starts = _cut(data, bridged, lengths[-1])
    unknowns = theta.size + starts.size
    if cells.measured.sum() < unknowns:
        raise DataError(
            f"{int(cells.measured.sum())} cells were measured, and the fit has {unknowns} unknowns; measure longer,"
            " or pass a longer horizon, which has fewer first states"
        )
    value = np.inf
    for length in lengths:
        cells, starts = _cut(data, bridged, length)
        theta, starts, value, taken = _minimise(error, theta, starts, cells, iterations)
        steps += taken
    return _Found(value, steps, theta, _simulate_all(data, error, theta, starts, cells))


def _minimise(
    error: _MeasuredError,
    theta: Float[np.ndarray, "nx nphi"],
    starts: Float[np.ndarray, "m nx"],
    cells: _Cells,
    iterations: int,
) -> tuple[Float[np.ndarray, "nx nphi"], Float[np.ndarray, "m nx"], float, int]:
    """Return Θ, the first states, the error there, and the iterations."""
    value, damping, steps = error.evaluate(theta, starts, cells), _DAMPING, 0
    for _ in range(iterations):
        if not np.isfinite(value) or value < _LEAST:
            break
        slopes, lower = error.derivatives(theta, starts, cells), np.inf
        for _trial in range(_TRIALS):
            move, moved = slopes.solve(damping)
            trial = theta + move.reshape(theta.shape), starts + moved
            lower = error.evaluate(*trial, cells)
            if lower < value:
                (theta, starts), damping = trial, max(damping / 10, 1e-15)
                break
            damping *= 10
        if not lower < value * (1 - _CONVERGED):
            break
        value, steps = lower, steps + 1
    return theta, starts, value, steps


def _bridge(data: PartialEpisodes, kind: str) -> Episodes:
    """Return the runs with their gaps bridged by lines, held values or the mean: where a fit starts, nothing else."""
    found: list[Episode] = []
    for x, u in zip(data.X, data.U, strict=True):
        whole, rows = x.copy(), np.arange(len(x))
        for i, column in enumerate(x.T):
            known = np.isfinite(column)
            mean = float(np.nanmean(np.concatenate([each[:, i] for each in data.X])))
            if kind == "line" and known.any():
                whole[:, i] = np.interp(rows, rows[known], column[known])
            elif kind == "held" and known.any():
                last = np.maximum.accumulate(np.where(known, rows, rows[known][0]))
                whole[:, i] = column[last]
            else:
                whole[~known, i] = mean
        found.append(Episode(X=whole, U=u))
    return Episodes(found, data.dt, states=data.states, inputs=data.inputs)


def _cut(data: PartialEpisodes, bridged: Episodes, horizon: int) -> tuple[_Cells, Float[np.ndarray, "m nx"]]:
    """Return the segments of all runs, one after the other, and where they start on the bridged rows."""
    X, U, starts = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    for x, u, whole in zip(data.X, data.U, bridged, strict=True):
        first = np.arange(0, len(u) - horizon + 1, horizon)
        if len(first) and len(u) - horizon > first[-1]:
            first = np.append(first, len(u) - horizon)
        ahead = np.arange(horizon + 1)[:, None] + first
        X.append(x[ahead])
        U.append(u[ahead[:-1]])
        starts.append(whole.X[first])
    cells = np.concatenate(X, axis=1)
    return _Cells(cells, np.isfinite(cells), np.concatenate(U, axis=1)), np.concatenate(starts)


def _simulate_all(
    data: PartialEpisodes,
    error: _MeasuredError,
    theta: Float[np.ndarray, "nx nphi"],
    starts: Float[np.ndarray, "m nx"],
    cells: _Cells,
) -> Episodes:
    """Return the segments as the model simulates them."""
    X = error.simulate(theta, starts, cells)
    episodes = [Episode(X=X[:, i], U=cells.U[:, i]) for i in range(X.shape[1])]
    return Episodes(episodes, data.dt, states=data.states, inputs=data.inputs)
