"""The squared error of a model that runs freely over segments, at the cells that were measured, and its slopes."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from koopmpc.base.interrupts import raise_swallowed
from koopmpc.data.episodes import Episodes
from koopmpc.data.partial import PartialEpisodes
from koopmpc.models.fits.refinement import MultiStepError
from koopmpc.models.moments.solve import column_norms
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor


@dataclass(frozen=True, eq=False)
class Cells:
    """Segments of m runs: states with NaN, (steps + 1, m, nx), which were measured, and [u; w]."""

    X: Float[np.ndarray, "steps1 m nx"]
    measured: Bool[np.ndarray, "steps1 m nx"]
    V: Float[np.ndarray, "steps m nv"]


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


class MeasuredError(MultiStepError):
    """The mean squared error of x̂_{k+1} = Θ φ(ζ̂_k, v_k) at the measured cells, x̂_0 … x̂_d free in each segment.

    d is the number of past rows in ζ. The free rows of a segment are its start, [x̂_d, …, x̂_0], newest first. Entries
    of Θ that multiply nothing new, as u times the Constant, are not `free`.
    """

    def __init__(
        self, model: LinearPredictor | BilinearPredictor, size: Float[np.ndarray, " nx"], crossed: bool
    ) -> None:
        nz, nu, nw = model.nz, model.nu, model.nw
        moving = np.arange(nz) != (-1 if model.lifting.constant_index is None else model.lifting.constant_index)
        columns = [np.ones(nz + nu + nw, dtype=np.bool_)]
        if isinstance(model, BilinearPredictor):
            columns.append(np.tile(moving, nu))
            if model.is_scheduled:
                columns += [np.tile(moving, nw), np.full(nw * nu, crossed)]
        self.columns = np.concatenate(columns)
        super().__init__(model, size, np.flatnonzero(np.tile(self.columns, model.nx)))
        self.past = 0 if model.embedding is None else model.embedding.steps
        self._npoint = len(model.point_names)
        self.start_size: Float[np.ndarray, " ns"] = np.tile(size, self.past + 1)

    def regress(self, points: Episodes, nx: int, cut: float | None = None) -> Float[np.ndarray, "nx nphi"]:
        """Return the Θ of one-step least squares on these points, the smallest of several."""
        Z, v = np.concatenate([e.X[:-1] for e in points]), np.concatenate([np.hstack([e.U, e.W]) for e in points])
        phi = self.find_features(Z, v)[0][:, self.columns]
        norms = column_norms(phi)
        norms[norms == 0] = 1.0
        after = np.concatenate([e.X[1:, :nx] for e in points])
        theta = np.zeros((nx, len(self.columns)))
        theta[:, self.columns] = (np.asarray(np.linalg.lstsq(phi / norms, after, rcond=cut)[0]) / norms[:, None]).T
        return theta

    def _shift(self, point: np.ndarray, u: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return the point after a step that led to x, of one or of many derivatives."""
        return x if self.embedding is None else self.embedding.shift(point, u, x)

    def simulate(
        self, theta: Float[np.ndarray, "nx nphi"], starts: Float[np.ndarray, "m ns"], cells: Cells
    ) -> Float[np.ndarray, "steps1 m nx"]:
        """Return x̂ of all segments."""
        nx, m, found = len(theta), len(starts), np.empty(cells.X.shape)
        point = np.zeros((m, self._npoint))
        with np.errstate(over="ignore", invalid="ignore"):
            for k in range(len(found)):
                v = cells.V[max(k - 1, 0)]
                if k <= self.past:
                    x = starts[:, nx * (self.past - k) : nx * (self.past - k + 1)]
                else:
                    x = self.find_features(point, v)[0] @ theta.T
                found[k], point = x, self._shift(point, v[:, : self._nu], x)
        return found

    def evaluate_from(
        self, theta: Float[np.ndarray, "nx nphi"], starts: Float[np.ndarray, "m ns"], cells: Cells
    ) -> float:
        """Return the mean over all measured cells; inf where a forecast overflows."""
        with np.errstate(over="ignore", invalid="ignore"):
            gap = (self.simulate(theta, starts, cells) - cells.X) / self.size
            total = float(np.mean(gap[cells.measured] ** 2))
        return total if np.isfinite(total) else np.inf

    @raise_swallowed()
    def slopes_from(
        self, theta: Float[np.ndarray, "nx nphi"], starts: Float[np.ndarray, "m ns"], cells: Cells
    ) -> CellSlopes:
        """Return half the gradient of `evaluate_from` by the free entries of Θ, and the Gauss-Newton matrices."""
        (nx, count), (m, ns), past = self.shape, starts.shape, self.past
        assert self._free is not None, "its columns say so"
        rows, columns, p = self._free // count, self._free % count, len(self._free)
        every, delay = np.arange(p), None if self.embedding is None else self.embedding.without_rails()
        gradient, matrix = np.zeros(p), np.zeros((p, p))
        of_starts, own, cross = np.zeros((m, ns)), np.zeros((m, ns, ns)), np.zeros((m, ns, p))
        point, moved = np.zeros((m, self._npoint)), np.zeros((m, p + ns, self._npoint))
        for k in range(len(cells.X)):
            v = cells.V[max(k - 1, 0)]
            if k <= past:
                block = np.arange(nx * (past - k), nx * (past - k + 1))
                x, D = starts[:, block], np.zeros((m, p + ns, nx))
                D[:, p + block, np.arange(nx)] = self.size
            else:
                phi, slope = self.find_features(point, v, theta)
                x, D = phi @ theta.T, moved @ slope
                D[:, every, rows] += phi[:, columns]
            gap = np.where(cells.measured[k], (x - np.nan_to_num(cells.X[k])) / self.size, 0.0)
            shown = D * (cells.measured[k] / self.size)[:, None]
            by_theta, by_starts = shown[:, :p], shown[:, p:]
            weighed = by_theta.transpose(0, 2, 1).reshape(m * nx, p)
            gradient += weighed.T @ gap.ravel()
            matrix += weighed.T @ weighed
            of_starts += np.matmul(by_starts, gap[..., None])[..., 0]
            own += np.matmul(by_starts, by_starts.swapaxes(1, 2))
            cross += np.matmul(by_starts, by_theta.swapaxes(1, 2))
            point = self._shift(point, v[:, : self._nu], x)
            moved = D if delay is None else delay.shift(moved, np.zeros((m, p + ns, self._nu)), D)
        cut = 1.0 / cells.measured.sum()
        return CellSlopes(cut * gradient, cut * matrix, cut * of_starts, cut * own, cut * cross)


def cut_cells(
    data: PartialEpisodes, bridged: Episodes, horizon: int, past: int
) -> tuple[Cells, Float[np.ndarray, "m ns"]]:
    """Return the segments of all runs, one after the other, and where they start on the bridged rows."""
    X, V, starts = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    for x, u, w, whole in zip(data.X, data.U, data.W, bridged, strict=True):
        first = np.arange(0, len(u) - horizon + 1, horizon)
        if len(first) and len(u) - horizon > first[-1]:
            first = np.append(first, len(u) - horizon)
        ahead = np.arange(horizon + 1)[:, None] + first
        X.append(x[ahead])
        V.append(np.hstack([u, w])[ahead[:-1]])
        starts.append(np.hstack([whole.X[first + past - i] for i in range(past + 1)]))
    cells = np.concatenate(X, axis=1)
    return Cells(cells, np.isfinite(cells), np.concatenate(V, axis=1)), np.concatenate(starts)
