"""Refinement of a fitted model on its simulation error: from one step ahead to many."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float, Int

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.data.episodes import Episode, Episodes, episodes_of
from koopmpc.models.base import FitReport, change_model
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.models.records.conversion import SignalUnits, cut_segments, from_standard, is_hidden, to_standard
from koopmpc.models.records.free_starts import shoot
from koopmpc.models.records.hidden import SimulationError, join_segments
from koopmpc.models.shared.levenberg_marquardt import minimise
from koopmpc.models.spectrum import check_same_names
from koopmpc.plants.routines import bind_interpreter

HELD_OUT = 0.25  # share of each episode, its end, that decides when to stop, where no episodes are given for it
ROWS = 20_000  # steps of all segments together, at most: beyond it segments begin less often


@dataclass(frozen=True, eq=False)
class Segments:
    """RecordSegments of `horizon` steps: the points ζ they start from, [u; w] of each step, and the states after it."""

    points: Float[np.ndarray, "m npoint"]
    inputs: Float[np.ndarray, "horizon m nv"]
    states: Float[np.ndarray, "horizon m nx"]


class MultiStepError:
    """The error of x̂_{k+1} = Θ φ(ζ̂_k, v_k), lifted afresh at each step, over segments, and its derivative by Θ.

    φ = [ψ(ζ); v] with v = [u; w] for a linear model, [ψ(ζ); v; u ⊗ ψ(ζ)] for a bilinear one, and w ⊗ ψ(ζ) and w ⊗ u
    behind it where w multiplies something. Errors are relative to `size`, one number a state; a reading at a rail of
    its sensor counts on one side only. With D_k = ∂x̂_k/∂Θ and J = ∂(Θ φ)/∂ζ the derivative follows
    D_{k+1} = I ⊗ φᵀ + J ∂ζ̂_k/∂Θ.
    """

    @raise_swallowed()
    def __init__(
        self,
        model: LinearPredictor | BilinearPredictor,
        size: Float[np.ndarray, " nx"],
        free: Int[np.ndarray, " f"] | None = None,
    ) -> None:
        self.embedding, self.size, self._free = model.embedding, size, free
        zeta, v = ca.SX.sym("zeta", len(model.point_names)), ca.SX.sym("v", model.nu + model.nw)
        z, u, w = model.lifting.symbolic(zeta), v[: model.nu], v[model.nu :]
        products = [ca.kron(u, z)] if isinstance(model, BilinearPredictor) else []
        if isinstance(model, BilinearPredictor) and model.is_scheduled:
            products += [ca.kron(w, z), ca.kron(w, u)]
        phi = ca.densify(ca.vertcat(z, v, *products))
        self._nu = model.nu
        theta = ca.SX.sym("theta", model.nx, phi.numel())
        slope = ca.densify(ca.jacobian(theta @ phi, zeta))
        self._features = ca.Function("features", [zeta, v], [phi], {"cse": True})
        self._slopes = ca.Function("slopes", [zeta, v, ca.vec(theta.T)], [phi, slope], {"cse": True})
        self.shape = model.nx, phi.numel()
        self._bound: dict[tuple[bool, int], tuple[list[np.ndarray], Callable[[], None], Any]] = {}

    @raise_swallowed()
    def evaluate(self, theta: Float[np.ndarray, "nx nphi"], data: Segments) -> float:
        """Return the mean squared relative error over all segments and steps; inf where a forecast overflows."""
        total, point = 0.0, data.points
        with np.errstate(over="ignore", invalid="ignore"):
            for v, truth in zip(data.inputs, data.states, strict=True):
                x = self.find_features(point, v)[0] @ theta.T
                total += float(np.sum((self._find_gap(x, truth) / self.size) ** 2))
                if not np.isfinite(total):
                    return np.inf
                point = x if self.embedding is None else self.embedding.shift(point, v[:, : self._nu], x)
        return total / data.states.size

    def _find_gap(self, x: Float[np.ndarray, "m nx"], truth: Float[np.ndarray, "m nx"]) -> Float[np.ndarray, "m nx"]:
        """Return x̂ − x; zero where a reading is at a rail and x̂ lies beyond it."""
        gap = x - truth
        return gap if self.embedding is None else np.where(self.embedding.is_beyond(truth, x), 0.0, gap)

    def find_features(self, *values: np.ndarray) -> list[np.ndarray]:
        """Return φ of every segment, (m, nphi), of points and inputs; with Θ also the slopes, (m, npoint, nx)."""
        slopes, (m, npoint), (nx, count) = len(values) > 2, values[0].shape, self.shape
        if (slopes, m) not in self._bound:
            function = self._slopes.map("all", "serial", m, [2], []) if slopes else self._features.map(m)
            given = [np.zeros(value.shape) for value in values]
            out = [np.zeros((m, count)), np.zeros((m, npoint, nx))][: 1 + slopes]
            self._bound[slopes, m] = ([*given, *out], *bind_interpreter(function, given, out))
        arrays, evaluate, _ = self._bound[slopes, m]
        for array, value in zip(arrays, values, strict=False):
            array[...] = value
        evaluate()
        return arrays[len(values) :]

    @raise_swallowed()
    def derivatives(
        self, theta: Float[np.ndarray, "nx nphi"], data: Segments
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
        """Return half the gradient of `evaluate` by Θ, row after row, and the Gauss-Newton matrix.

        Entries of Θ that are not among `free` count as constants.
        """
        (nx, count), (m, n) = self.shape, data.points.shape
        free = np.arange(nx * count) if self._free is None else self._free
        rows, columns, every = free // count, free % count, np.arange(len(free))
        slopes, squares = np.zeros(len(free)), np.zeros((len(free), len(free)))
        point, moved = data.points, np.zeros((m, len(free), n))
        for v, truth in zip(data.inputs, data.states, strict=True):
            phi, slope = self.find_features(point, v, theta)
            D = moved @ slope  # (m, f, nx)
            D[:, every, rows] += phi[:, columns]
            x = phi @ theta.T
            gap, shown = self._find_gap(x, truth) / self.size, D / self.size
            if self.embedding is not None and self.embedding.rails is not None:
                shown = shown * (~self.embedding.is_beyond(truth, x))[:, None]
                D = D * (self.embedding.clip(x) == x)[:, None]
            weighed = shown.transpose(0, 2, 1).reshape(m * nx, -1)
            slopes += weighed.T @ gap.ravel()
            squares += weighed.T @ weighed
            if self.embedding is None:
                point, moved = x, D
            else:
                point = self.embedding.shift(point, v[:, : self._nu], x)
                moved = self.embedding.without_rails().shift(moved, np.zeros((*D.shape[:2], self._nu)), D)
        gradient, matrix = np.zeros(nx * count), np.zeros((nx * count, nx * count))
        gradient[free], matrix[np.ix_(free, free)] = slopes, squares
        return gradient / data.states.size, matrix / data.states.size


def refine(
    model: LinearPredictor | BilinearPredictor,
    episodes: Episodes,
    *,
    horizon: int,
    held_out: Episodes | None = None,
    iterations: int = 30,
    free_starts: bool = False,
) -> LinearPredictor | BilinearPredictor:
    """Refine the rows Θ = C [A B E N] of a model on forecasts: min_Θ Σ_s Σ_h ‖(x̂_{s+h} − x_{s+h}) / σ‖².

    The forecast x̂_{k+1} = C (A ψ(ζ̂_k) + B u_k + E w_k + Σ uᵢ Nᵢ ψ(ζ̂_k)) starts at measured ζ_s and knows the
    measured w; products of w that the model has are refined, too. It is lifted afresh at each step, as `step_map()`
    simulates and BilinearMPC plans; a model that is linear in the state and its past forecasts the same lifted once.
    One-step least squares learns the noise where samples are fast; the error over many steps does not. Coefficients
    that are exactly zero stay zero. Segments of `horizon` steps begin at measured points, as in multiple shooting for
    an unstable plant. The minimisation is Levenberg-Marquardt with exact derivatives, in units of the states' standard
    deviations σ. It stops on held-out rows, and the model returned has the least error there: `model` itself where no
    step lowers that.

    Parameters
    ----------
    model
        Its lifting holds the states (C picks them), as `State() + …` does. Of ψ(ζ⁺) only the rows of the states change.
        Measured disturbances stay those of the episodes.
        Or a model with a hidden state, of `subspace` or `polynomial_state_space`: then the dynamics of z, C and the
        encoder T of z_0 = T ζ change, and a segment runs in z, without lifting afresh.
    episodes
        What it learns from.
    horizon
        Steps of a segment. Longer ones weigh slow modes more, and cost more.
    held_out
        Episodes that decide when to stop; by default the last quarter of each episode, which is then not learned from.
    iterations
        Levenberg-Marquardt steps, at most.
    free_starts
        Of a hidden state: each segment first begins with its own z_0, the one that explains it best (multiple
        shooting), and T is fitted to these; from there all is refined as above. For unstable plants, and where noise
        in few past rows hides the state. The best of both ways on held-out rows is kept.

    Raises
    ------
    DataError
        The episodes are too short for one segment in each part, or have another dt; C does not pick the states from ψ.
    ShapeError
        The episodes have other states, inputs or measured disturbances than the model.

    References
    ----------
    Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", J. SIAM 11, 1963; simulation error
    and multiple shooting: Ribeiro et al., "On the smoothness of nonlinear system identification", Automatica 121,
    2020.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=20, steps=60)
    >>> model = km.edmd(data, km.State() + km.Constant())
    >>> refined = km.identify.refine(model, data, horizon=10)
    >>> bool(km.score(refined, data, 10).rmse[-1, 0] <= km.score(model, data, 10).rmse[-1, 0])
    True
    """
    checks.kind(model, "model", (LinearPredictor, BilinearPredictor), "pass what a fit returns")
    horizon, iterations = checks.count(horizon, "horizon"), checks.count(iterations, "iterations")
    whole = episodes_of(episodes)
    for part in (whole, whole if held_out is None else episodes_of(held_out)):
        check_same_names(model, part)
    if is_hidden(model):
        return _refine_hidden(model, whole, horizon, held_out, iterations, free_starts)
    if free_starts:
        raise DataError(
            "free_starts is for models with a hidden state; this model begins at measured rows: leave it out"
        )
    places = rows_of_states(model)
    learn, unseen = split_ends(whole) if held_out is None else (list(whole), list(episodes_of(held_out)))
    size = np.concatenate([episode.X for episode in learn]).std(axis=0)
    size = np.where(size > 0, size, 1.0)
    fitted = cut_into_segments(model, whole.with_episodes(learn), horizon, "to learn from")
    judged = cut_into_segments(model, whole.with_episodes(unseen), horizon, "held out")
    start = coefficients_of_states(model, places)
    free = np.flatnonzero(start.ravel())
    error = MultiStepError(model, size, free)
    theta, steps = minimise(error, start, fitted, judged, iterations, free=free)
    before, after = error.evaluate(start, judged), error.evaluate(theta, judged)
    if not after < before:
        return model
    return with_coefficients(model, places, theta, _describe(horizon, steps, before, after))


def _describe(horizon: int, steps: int, before: float, after: float) -> str:
    return (
        f"refined on forecasts of {horizon} steps, {steps} iterations: their error on held-out rows is "
        f"{np.sqrt(after):.3g} spreads, {np.sqrt(before):.3g} before"
    )


def _refine_hidden(
    model: LinearPredictor | BilinearPredictor,
    episodes: Episodes,
    horizon: int,
    held_out: Episodes | None,
    iterations: int,
    free_starts: bool,
) -> LinearPredictor | BilinearPredictor:
    """Refine the dynamics, the output and the encoder of a hidden state on forecasts of `horizon` steps."""
    assert model.embedding is not None, "a hidden state begins with past rows"
    parts = split_ends(episodes) if held_out is None else (list(episodes), list(episodes_of(held_out)))
    learn, unseen = (episodes.with_episodes(part) for part in parts)
    delays = model.embedding.steps
    units = SignalUnits.of(learn, model.embedding.rails)
    start = to_standard(model, units)
    fitted, judged = (
        [join_segments(cut_segments(part, units, delays, horizon, _apart(part, horizon)))] for part in (learn, unseen)
    )
    error = SimulationError(start)
    theta, steps = minimise(error, start.parameters, fitted, judged, iterations)
    before, after = error.evaluate(start.parameters, judged), error.evaluate(theta, judged)
    if free_starts:
        shot, first = shoot(start, fitted, judged, iterations)
        other, more = minimise(error, shot.parameters, fitted, judged, iterations)
        if (other_error := error.evaluate(other, judged)) < after:
            theta, steps, after = other, first + more, other_error
    if not after < before:
        return model
    report = model.report
    if report is not None:
        report = replace(report, changes=(*report.changes, _describe(horizon, steps, before, after)))
    return from_standard(start.with_parameters(theta), units, learn, delays, report)


def _apart(episodes: Episodes, horizon: int) -> int:
    """Return the rows between the starts of segments."""
    steps = sum(map(len, episodes))
    return max(-(-horizon // 2), -(-steps * horizon // ROWS))


def rows_of_states(model: LinearPredictor | BilinearPredictor) -> Int[np.ndarray, " nx"]:
    """Return the places of the states among the observables."""
    places = np.argmax(model.C, axis=1)
    if not np.array_equal(model.C, np.eye(model.nz)[places]):
        raise DataError(
            "C does not pick the states from the observables; fit with a lifting that holds them: State() + …"
        )
    return places


def coefficients_of_states(
    model: LinearPredictor | BilinearPredictor, rows: Int[np.ndarray, " nx"]
) -> Float[np.ndarray, "nx nphi"]:
    """Return Θ = C [A B E N₁ N₂ … S₁ S₂ … M₁ M₂ …], without S and M where no w multiplies anything."""
    products = [Ni[rows] for Ni in model.N] if isinstance(model, BilinearPredictor) else []
    if isinstance(model, BilinearPredictor) and model.is_scheduled:
        products += [each[rows] for each in (*model.S, *model.M)]
    return np.hstack([model.A[rows], model.B[rows], model.E[rows], *products])


def with_coefficients(
    model: LinearPredictor | BilinearPredictor,
    rows: Int[np.ndarray, " nx"],
    theta: Float[np.ndarray, "nx nphi"],
    sentence: str,
) -> LinearPredictor | BilinearPredictor:
    """Return the model with Θ as its rows of the states."""
    nz, nu, nw = model.nz, model.nu, model.nw
    A, B, E = model.A.copy(), model.B.copy(), model.E.copy()
    ends = np.cumsum([nz, nu, nw, nu * nz, nw * nz])
    A[rows], B[rows], E[rows], of_N, of_S, of_M = np.split(theta, ends, axis=1)
    report: FitReport | None = model.report
    if report is not None:
        report = replace(report, changes=(*report.changes, sentence))
    if isinstance(model, LinearPredictor):
        return change_model(model, A=A, B=B, E=E, report=report, exact_modes=None)  # they were those of the old A
    N, S, M = model.N.copy(), model.S.copy(), model.M.copy()
    N[:, rows] = of_N.reshape(len(rows), nu, nz).transpose(1, 0, 2)
    if model.is_scheduled:
        S[:, rows] = of_S.reshape(len(rows), nw, nz).transpose(1, 0, 2)
        M[:, rows] = of_M.reshape(len(rows), nw, nu).transpose(1, 0, 2)
    return change_model(model, A=A, B=B, E=E, N=N, S=S, M=M, report=report)


def split_ends(episodes: Episodes) -> tuple[list[Episode], list[Episode]]:
    """Return the beginning of each episode, and its last quarter."""
    at = [round((1 - HELD_OUT) * len(episode)) for episode in episodes]
    learn = [Episode(X=e.X[: k + 1], U=e.U[:k], W=e.W[:k]) for e, k in zip(episodes, at, strict=True)]
    return learn, [Episode(X=e.X[k:], U=e.U[k:], W=e.W[k:]) for e, k in zip(episodes, at, strict=True)]


def cut_into_segments(
    model: LinearPredictor | BilinearPredictor, episodes: Episodes, horizon: int, role: str
) -> Segments:
    """Return segments that begin every half horizon, or less often where they would have more than `ROWS` steps."""
    past = 0 if model.embedding is None else model.embedding.steps
    long = [episode for episode in episodes if len(episode) >= horizon + past]
    if not long:
        raise DataError(
            f"no episode {role} has the {horizon + past} steps of a segment and its past; pass a shorter horizon, or "
            "longer episodes"
        )
    points = model.embed(episodes.with_episodes(long))
    apart = _apart(points, horizon)
    starts: list[Float[np.ndarray, "_ npoint"]] = []
    inputs: list[Float[np.ndarray, "horizon _ nv"]] = []
    states: list[Float[np.ndarray, "horizon _ nx"]] = []
    for episode in points:
        first = np.arange(0, len(episode) - horizon + 1, apart)
        ahead = np.arange(horizon)[:, None] + first
        starts.append(episode.X[first])
        inputs.append(np.concatenate([episode.U, episode.W[:, : model.nw]], axis=1)[ahead])
        states.append(episode.X[ahead + 1, : model.nx])
    return Segments(_join(starts, 0), _join(inputs, 1), _join(states, 1))


def _join(parts: Sequence[np.ndarray], axis: int) -> np.ndarray:
    return np.ascontiguousarray(np.concatenate(parts, axis=axis))
