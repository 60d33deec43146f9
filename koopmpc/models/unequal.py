"""unequal_rates: a model of runs in which sensors measured at rates of their own, fitted to measured cells."""

import warnings
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, overload

import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc.base import checks
from koopmpc.base.errors import DataError, FitWarning
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.partial import PartialEpisodes
from koopmpc.lifting.base import Lifting
from koopmpc.models.base import change_model
from koopmpc.models.fits.bilinear import bilinear_edmd
from koopmpc.models.fits.edmd import edmd
from koopmpc.models.fits.refinement import MultiStepError, rows_of_states, with_coefficients
from koopmpc.models.moments.solve import column_norms
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor

_GAPS = 4  # a segment has this many measurements of the slowest sensor for each of its unknown rows
_SHORT = 20  # a segment has at least so many steps
_CONVERGED = 1e-13  # stop where a step lowers the error by less than this share
_EXACT = 1e-16  # at this mean squared error in spreads no other start is tried
_LEAST = 1e-24  # stop at this mean squared error in spreads: rounding
_DAMPING = 1e-3  # damping of the first step, as a share of the diagonal
_RANK = 1e-8  # singular values of the simulated columns below this share of the largest are modes that nothing excites
_TRIALS = 12  # times that the damping grows before the fit ends


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
        self.free: Int[np.ndarray, " p"] = np.flatnonzero(np.tile(self.columns, model.nx))
        super().__init__(model, size, self.free)
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


class _Found(NamedTuple):
    """The end of one minimisation: its error, iterations and Θ, and the segments as the model simulates them."""

    value: float
    steps: int
    theta: Float[np.ndarray, "nx nphi"]
    simulated: Episodes


@overload
def unequal_rates(
    data: PartialEpisodes,
    lifting: Lifting,
    *,
    embedding: Delay | None = None,
    bilinear: Literal[False] = False,
    scheduled_inputs: bool = False,
    horizon: int | None = None,
    iterations: int = 100,
) -> LinearPredictor: ...
@overload
def unequal_rates(
    data: PartialEpisodes,
    lifting: Lifting,
    *,
    embedding: Delay | None = None,
    bilinear: Literal[True],
    scheduled_inputs: bool = False,
    horizon: int | None = None,
    iterations: int = 100,
) -> BilinearPredictor: ...
def unequal_rates(
    data: PartialEpisodes,
    lifting: Lifting,
    *,
    embedding: Delay | None = None,
    bilinear: bool = False,
    scheduled_inputs: bool = False,
    horizon: int | None = None,
    iterations: int = 100,
) -> LinearPredictor | BilinearPredictor:
    """Fit z⁺ = A z + B u + E w to runs whose sensors measured at rates of their own: residuals at measured cells alone.

    min over Θ = C [A B E] and the first state of each segment of Σ ((x̂_k − x_k) / σ)² over the cells that were
    measured, x̂_{k+1} = Θ [ψ(x̂_k); u_k; w_k] lifted afresh. Levenberg-Marquardt with exact derivatives; first states
    are eliminated segment by segment. It starts at least squares on rows whose gaps are bridged by straight lines, by
    held values, and by the mean, and takes the least error of the three; only the start depends on them. Segments
    become longer in two steps. Where several Θ make the same rows, as with delays to spare, the smallest is taken:
    others may hold unstable modes that nothing excited. Rows of observables other than the states come from `edmd`, or
    `bilinear_edmd`, on the states that the model itself simulates.

    Parameters
    ----------
    data
        Runs with NaN where a state was not measured.
    lifting
        Observables that hold the states, `State() + …`.
    embedding
        ψ acts on the state and its past d rows, as in `edmd`; then the first d + 1 states of a segment are unknown.
    bilinear
        Also fit Σ uᵢ Nᵢ z + Σ wⱼ Sⱼ z, as `bilinear_edmd` does.
    scheduled_inputs
        Of a bilinear model also Σ wⱼ Mⱼ u.
    horizon
        Steps of a segment; by default four times the longest gap for each of its d + 1 unknown rows, at least 20.
    iterations
        Levenberg-Marquardt steps, at most.

    Raises
    ------
    DataError
        No run has a segment; fewer cells were measured than there are unknowns; the lifting lacks a state; a bilinear
        model of runs without inputs; scheduled_inputs without W or of a linear model; an embedding with rails.

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
    iterations = checks.count(iterations, "iterations")
    if bilinear and not data.inputs:
        raise DataError("the runs have no inputs, so nothing multiplies the state; leave bilinear out")
    if scheduled_inputs and not (bilinear and data.disturbances):
        raise DataError("scheduled_inputs multiply inputs by measured disturbances; pass W, and bilinear=True")
    if embedding is not None:
        checks.kind(embedding, "embedding", Delay, "pass km.Delay(steps)")
        if embedding.rails is not None:
            raise DataError("the embedding has rails, which this fit does not know; pass km.Delay without them")

    def fit(rows: Episodes) -> LinearPredictor | BilinearPredictor:
        if bilinear:
            return bilinear_edmd(rows, lifting, embedding=embedding, scheduled_inputs=scheduled_inputs)
        return edmd(rows, lifting, embedding=embedding)

    past = 0 if embedding is None else embedding.steps
    wanted = _choose_horizon(data, horizon, past)
    size = np.nanstd(np.concatenate(data.X), axis=0)
    line = _bridge(data, "line")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)  # rows with bridged gaps are a start alone
        model = fit(line)
    if not set(data.states) <= set(model.lifting.names):
        raise DataError(f"the lifting lacks a state; pass km.State() + … of {', '.join(data.states)}")
    places, error = rows_of_states(model), MeasuredError(model, np.where(size > 0, size, 1.0), crossed=scheduled_inputs)
    lengths = sorted({max(wanted // 2, past + 1), wanted})
    best: _Found | None = None
    for kind in ("line", "held", "mean"):
        bridged = line if kind == "line" else _bridge(data, kind)
        found = _fit_from(data, error, model, bridged, lengths, iterations)
        best = found if best is None or found.value < best.value else best
        if best.value < _EXACT:
            break
    assert best is not None, "there are three starts"
    measured = int(data.count_measured().sum())
    sentence = (
        f"fitted to {measured} measured cells of {sum(x.size for x in data.X)} by simulation over {wanted} steps, "
        f"{best.steps} iterations; their error is {np.sqrt(best.value):.3g} spreads"
    )
    refitted = with_coefficients(fit(best.simulated), places, best.theta, sentence)
    assert refitted.report is not None, "it was fitted"
    return change_model(refitted, report=replace(refitted.report, method="unequal_rates", samples=measured))


def _choose_horizon(data: PartialEpisodes, horizon: int | None, past: int) -> int:
    """Return the steps of a segment."""
    longest = max(map(len, data.U))
    if horizon is None:
        wanted = min(max(_GAPS * data.find_gap() * (past + 1), _SHORT) + past, longest)
    else:
        wanted = checks.count(horizon, "horizon")
        if wanted > longest:
            raise DataError(
                f"no run has the {wanted} steps of a segment; the longest has {longest}, pass a shorter horizon"
            )
    if wanted <= past:
        raise DataError(
            f"a segment has {wanted} steps, and the embedding keeps {past}; pass longer runs or a longer horizon"
        )
    return wanted


def _fit_from(
    data: PartialEpisodes,
    error: MeasuredError,
    model: LinearPredictor | BilinearPredictor,
    bridged: Episodes,
    lengths: list[int],
    iterations: int,
) -> _Found:
    """Return where the minimisation ends that starts at one-step least squares on the bridged rows."""
    theta, steps = error.regress(model.embed(bridged), model.nx), 0
    cells, starts = cut_cells(data, bridged, lengths[-1], error.past)
    unknowns = model.nx * int(error.columns.sum()) + starts.size
    if cells.measured.sum() < unknowns:
        raise DataError(
            f"{int(cells.measured.sum())} cells were measured, and the fit has {unknowns} unknowns; measure longer,"
            " or pass a longer horizon, which has fewer first states"
        )
    value = np.inf
    for length in lengths:
        cells, starts = cut_cells(data, bridged, length, error.past)
        theta, starts, value, taken = _minimise(error, theta, starts, cells, iterations)
        steps += taken
    X = error.simulate(theta, starts, cells)
    episodes = [Episode(X=X[:, i], U=cells.V[:, i, : model.nu], W=cells.V[:, i, model.nu :]) for i in range(X.shape[1])]
    simulated = Episodes(episodes, data.dt, data.states, data.inputs, data.disturbances)
    least = error.regress(model.embed(simulated), model.nx, _RANK)  # no unstable modes that nothing excited
    if error.evaluate_from(least, starts, cells) <= max(value, _EXACT):
        theta = least
    return _Found(value, steps, theta, simulated)


def _minimise(
    error: MeasuredError,
    theta: Float[np.ndarray, "nx nphi"],
    starts: Float[np.ndarray, "m ns"],
    cells: Cells,
    iterations: int,
) -> tuple[Float[np.ndarray, "nx nphi"], Float[np.ndarray, "m ns"], float, int]:
    """Return Θ, the first states, the error there, and the iterations."""
    value, damping, steps = error.evaluate_from(theta, starts, cells), _DAMPING, 0
    for _ in range(iterations):
        if not np.isfinite(value) or value < _LEAST:
            break
        slopes, lower = error.slopes_from(theta, starts, cells), np.inf
        for _trial in range(_TRIALS):
            move, moved = slopes.solve(damping)
            step = np.zeros(theta.size)
            step[error.free] = move
            trial = theta + step.reshape(theta.shape), starts + moved * error.start_size
            lower = error.evaluate_from(*trial, cells)
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
    for x, u, w in zip(data.X, data.U, data.W, strict=True):
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
        found.append(Episode(X=whole, U=u, W=w))
    return Episodes(found, data.dt, data.states, data.inputs, data.disturbances)


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
