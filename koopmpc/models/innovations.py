"""The direct method for logs of a closed loop: a fit of the model together with a model of the noise."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.data.episodes import Episode, Episodes, episodes_of
from koopmpc.models.fits.refinement import (
    MultiStepError,
    Segments,
    coefficients_of_states,
    cut_into_segments,
    rows_of_states,
    split_ends,
    with_coefficients,
)
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.models.shared.levenberg_marquardt import minimise
from koopmpc.models.spectrum import check_same_names

RESTS = "follows from the readings alone, for the set point rests and no test signal is added"
_NOT_IDENTIFIABLE = "not identifiable from these logs"
_SPAN = 200  # steps of a segment, where the episodes have them
_SETTLES = 5  # one step of so many of a segment is not judged: there the first gains still act
_LEAST = 20  # steps of a segment, at least
_EXACT = 1e-12  # share of the largest variance below which a direction's is not trusted
_UNKNOWN = 0.1  # standard error of a coefficient, in spreads of its state for a spread of its regressor
_PAST = 4  # rows from which a controller would find its input
_EACH = 2  # rows for each coefficient of that, at least
_FEEDBACK = 1e-4  # share of an input's spread that is left where the readings say it all
_ROUNDS = 2  # fits, the second with the covariance of the innovations of the first


class InnovationsError(MultiStepError):
    """The error of forecasts one step ahead by a filter with gain L, over segments, and its derivative by [Θ L].

    x̃_k = x̂_k + L_k (y_k − x̂_k), x̂_{k+1} = Θ φ(x̃_k, u_k), L_k = L + (I − L) / (k + 1): the first reading is taken
    whole, later ones in part, as a filter does that knows nothing of x_0. Errors are multiplied by `root`.
    """

    def __init__(self, model: LinearPredictor | BilinearPredictor, root: Float[np.ndarray, "nx nx"]) -> None:
        super().__init__(model, np.ones(model.nx))
        self.root = root

    def evaluate(self, theta: Float[np.ndarray, "nx n"], data: Segments) -> float:
        """Return the mean squared weighted error after the steps in which the filter settles; inf on overflow."""
        with np.errstate(over="ignore", invalid="ignore"):
            value = float(np.mean((self.find_errors(theta, data) @ self.root.T) ** 2))
        return value if np.isfinite(value) else np.inf

    @raise_swallowed()
    def find_errors(self, theta: Float[np.ndarray, "nx n"], data: Segments) -> Float[np.ndarray, "steps m nx"]:
        """Return y_k − x̂_k of each segment after the steps in which the filter settles."""
        coefficients, gain = np.split(theta, [self.shape[1]], axis=1)
        errors, x = np.empty_like(data.states), data.points
        with np.errstate(over="ignore", invalid="ignore"):
            for k, (u, y) in enumerate(zip(data.inputs, data.states, strict=True)):
                ahead = self.find_features(x, u)[0] @ coefficients.T
                errors[k] = y - ahead
                x = ahead + errors[k] @ (gain + (np.eye(len(gain)) - gain) / (k + 2)).T
        return errors[len(errors) // _SETTLES :]

    @raise_swallowed()
    def derivatives(
        self, theta: Float[np.ndarray, "nx n"], data: Segments
    ) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p p"]]:
        """Return half the gradient of `evaluate` by [Θ L], row after row, and the Gauss-Newton matrix."""
        (nx, count), m = self.shape, len(data.points)
        width, first = count + nx, len(data.states) // _SETTLES
        coefficients, gain = np.split(theta, [count], axis=1)
        gradient, matrix = np.zeros(nx * width), np.zeros((nx * width, nx * width))
        rows, unit = np.arange(nx), np.eye(nx)
        x, moved = data.points, np.zeros((m, nx * width, nx))  # of x̃ by θ
        for k, (u, y) in enumerate(zip(data.inputs, data.states, strict=True)):
            phi, slope = self.find_features(x, u, coefficients)
            D = moved @ slope  # of x̂ by θ
            D.reshape(m, nx, width, nx)[:, rows, :count, rows] += phi
            ahead = phi @ coefficients.T
            error = y - ahead
            if k >= first:
                weighed = (D @ self.root.T).transpose(0, 2, 1).reshape(m * nx, -1)
                gradient -= weighed.T @ (error @ self.root.T).ravel()
                matrix += weighed.T @ weighed
            part = 1 / (k + 2)
            step = gain + (unit - gain) * part
            x = ahead + error @ step.T
            moved = D @ (unit - step).T
            moved.reshape(m, nx, width, nx)[:, rows, count:, rows] += (1 - part) * error
        judged = data.states[first:].size
        return gradient / judged, matrix / judged


def prediction_error(
    model: LinearPredictor | BilinearPredictor, episodes: Episodes, *, iterations: int = 30
) -> LinearPredictor | BilinearPredictor:
    """Fit Θ = C [A B N] with the gain L of a filter, min Σ_k ‖y_k − x̂_k‖²: for logs of a loop with noisy sensors.

    x̃_k = x̂_k + L (y_k − x̂_k) and x̂_{k+1} = Θ φ(x̃_k, u_k), with φ = [ψ(x̃); u; u ⊗ ψ(x̃)]. L is the model of the
    noise: at I each reading is the state, which is least squares one step ahead; at 0 the sensors are all noise and
    the forecast is a simulation. If the plant is linear and its noises are white, the fit is consistent under
    feedback, without a set point that moves, as far as the loop excites the plant. Errors are weighed by the inverse
    covariance of the innovations, from a fit before. Levenberg-Marquardt with exact derivatives starts at the given
    model, stops on the last quarter of each episode, and then goes on with all rows for as many steps.

    Parameters
    ----------
    model
        Where the fit starts; its lifting holds the states, and it has no past rows and no measured disturbances.
        Coefficients that are exactly zero stay zero.
    episodes
        Logs of measured states.
    iterations
        Levenberg-Marquardt steps of each fit, at most.

    Returns
    -------
    The model with Θ as fitted, or `model` itself where no gain lowers the error of the last quarters.

    Raises
    ------
    DataError
        The model has past rows or measured disturbances, C does not pick the states, the last quarter of no episode
        has 20 steps; the loop does not excite the plant enough to separate the coefficients.
    ShapeError
        The episodes have other states or inputs.

    References
    ----------
    Ljung, "System Identification: Theory for the User", 2nd edition, 1999, chapters 7 and 13: the direct method.

    Examples
    --------
    >>> import numpy as np
    >>> import koopmpc as km
    >>> rng = np.random.default_rng(0)
    >>> x, X, U = 0.0, [], []
    >>> for k in range(2000):
    ...     X.append([x + 0.2 * rng.standard_normal()])
    ...     U.append([(-1.0) ** (k // 20) - 0.5 * X[-1][0]])  # feedback of the noisy sensor
    ...     x = 0.9 * x + 0.2 * U[-1][0]
    >>> logs = km.Episodes([km.Episode(X=np.array([*X, [x]]), U=np.array(U))], dt=0.1)
    >>> plain = km.edmd(logs, km.State() + km.Constant())
    >>> direct = km.identify.prediction_error(plain, logs)
    >>> [bool(abs(m.A[0, 0] - 0.9) < 0.02) for m in (plain, direct)]
    [False, True]
    """
    return fit_with_gain(model, episodes, iterations)[0]


def fit_with_gain(
    model: LinearPredictor | BilinearPredictor, episodes: Episodes, iterations: int = 30
) -> tuple[LinearPredictor | BilinearPredictor, Float[np.ndarray, "nx nx"]]:
    """Return the fit of `prediction_error` and its gain L; the given model and I where no gain lowers the error."""
    checks.kind(model, "model", (LinearPredictor, BilinearPredictor), "pass what a fit returns")
    iterations, whole = checks.count(iterations, "iterations"), episodes_of(episodes)
    if model.embedding is not None or model.nw:
        raise DataError(
            "the model has past rows or measured disturbances, which prediction_error does not know; pass a model of "
            "measured states alone, or fit km.identify.subspace(logs), which models the noise of outputs"
        )
    check_same_names(model, whole)
    _check_set_point(whole)
    places, nx = rows_of_states(model), model.nx
    learn, unseen = (whole.with_episodes(part) for part in split_ends(whole))
    fitted, judged, every = (_cut(model, part) for part in (learn, unseen, whole))
    size = np.concatenate([e.X for e in learn]).std(axis=0)
    in_spreads = np.diag(1 / np.where(size > 0, size, 1.0))
    theta = np.hstack([coefficients_of_states(model, places), np.eye(nx)])
    free = np.flatnonzero(np.hstack([theta[:, :-nx], np.ones((nx, nx))]).ravel())
    error, steps = InnovationsError(model, in_spreads), 1
    before = error.evaluate(theta, judged)
    if before < _EXACT:
        return model, np.eye(nx)
    for _ in range(_ROUNDS):
        error.root = _whiten(error.find_errors(theta, fitted))
        theta, more = minimise(error, theta, fitted, judged, iterations, free=free)
        steps += more
    error.root = in_spreads
    after = error.evaluate(theta, judged)
    if not after < before:
        return model, np.eye(nx)
    error.root = _whiten(error.find_errors(theta, fitted))
    theta = minimise(error, theta, every, every, steps, free=free)[0]
    _check_excitation(error, theta, every, free, sum(map(len, whole)))
    gain = theta[:, -nx:]
    sentence = (
        f"fitted with a filter of gain {', '.join(f'{value:.3g}' for value in np.diag(gain))} (1: a sensor without "
        f"noise), {steps - 1} iterations: its error one step ahead on held-out rows is {np.sqrt(after):.3g} spreads, "
        f"{np.sqrt(before):.3g} before"
    )
    return with_coefficients(model, places, theta[:, :-nx], sentence), gain


@raise_swallowed()
def filter_states(
    model: LinearPredictor | BilinearPredictor, gain: Float[np.ndarray, "nx nx"], episodes: Episodes
) -> Episodes:
    """Return the episodes with the states x̃ of the filter: x̃_k = x̂_k + L_k (y_k − x̂_k), x̃_0 = y_0.

    x̃_{k+1} = Θ φ(x̃_k, u_k) + L_k e_{k+1}, and the innovation e_{k+1} knows nothing of x̃_k and u_k: least squares on
    these states is consistent under feedback where the filter is right.
    """
    error, rest = InnovationsError(model, np.eye(model.nx)), np.eye(model.nx) - gain
    coefficients = coefficients_of_states(model, rows_of_states(model))
    made: list[Episode] = []
    for e in episodes:
        X = e.X.copy()
        for k, u in enumerate(e.U):
            ahead = coefficients @ error.find_features(X[k : k + 1], u[None])[0][0]
            X[k + 1] = ahead + (gain + rest / (k + 2)) @ (e.X[k + 1] - ahead)
        made.append(replace(e, X=X))
    return episodes.with_episodes(made)


def _cut(model: LinearPredictor | BilinearPredictor, episodes: Episodes) -> Segments:
    lengths = [len(e) for e in episodes]
    return cut_into_segments(model, episodes, max(min(_SPAN, int(np.median(lengths))), _LEAST), "to fit")


def _whiten(errors: Float[np.ndarray, "steps m nx"]) -> Float[np.ndarray, "nx nx"]:
    """Return R with Rᵀ R the inverse covariance of the errors."""
    flat = errors.reshape(-1, errors.shape[-1])
    values, vectors = np.linalg.eigh(flat.T @ flat / len(flat))
    return vectors.T / np.sqrt(np.maximum(values, max(values[-1] * _EXACT, np.finfo(float).tiny)))[:, None]


def _check_set_point(episodes: Episodes) -> None:
    """Raise DataError where an input is a function of past readings and inputs: nothing but noise moves the loop."""
    for name, size, alone, both in zip(episodes.inputs, *explain_by_readings(episodes), strict=True):
        if both < _FEEDBACK * size < alone:
            raise DataError(f"{_NOT_IDENTIFIABLE}: {name} {RESTS}; move the set point, or add a test signal")


def explain_by_readings(episodes: Episodes) -> tuple[Float[np.ndarray, " nu"], ...]:
    """Return the spread of the inputs, what past inputs leave of it, and what these and the readings leave."""
    long = [e for e in episodes if len(e) > 4 * _PAST]
    columns = (_PAST - 1) * episodes.nu + _PAST * episodes.nx
    if sum(len(e) - _PAST for e in long) <= _EACH * columns:  # as many coefficients explain any input
        return (np.zeros(episodes.nu),) * 3
    past = np.concatenate([np.hstack([e.U[_PAST - i : len(e) - i] for i in range(1, _PAST)]) for e in long])
    seen = np.concatenate([np.hstack([e.X[_PAST - i : len(e) - i] for i in range(_PAST)]) for e in long])
    now = np.concatenate([e.U[_PAST:] for e in long])
    return now.std(axis=0), _find_rest(past, now), _find_rest(np.hstack([past, seen]), now)


def _find_rest(regressors: Float[np.ndarray, "M n"], targets: Float[np.ndarray, "M nu"]) -> Float[np.ndarray, " nu"]:
    """Return the standard deviation of the noise beside a linear function of the regressors."""
    P = np.hstack([regressors, np.ones((len(regressors), 1))])
    P = P / np.maximum(np.abs(P).max(axis=0), np.finfo(float).tiny)
    rest = np.asarray(targets - P @ np.linalg.lstsq(P, targets, rcond=1e-12)[0], dtype=np.float64)
    return np.sqrt((rest**2).sum(axis=0) / (len(P) - P.shape[1]))


@raise_swallowed()
def _check_excitation(
    error: InnovationsError, theta: Float[np.ndarray, "nx n"], data: Segments, free: Int[np.ndarray, " f"], rows: int
) -> None:
    """Raise DataError where a coefficient's standard error is large beside the spreads of its regressor and target."""
    nx, count = error.shape
    fisher = error.derivatives(theta, data)[1][np.ix_(free, free)] * rows * nx
    scale = np.sqrt(np.maximum(fisher.diagonal(), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(fisher / np.outer(scale, scale))
    spread = np.zeros(theta.size)
    spread[free] = np.sqrt((vectors**2 / np.maximum(values, _EXACT)).sum(axis=1)) / scale
    spread = spread.reshape(nx, -1)[:, :count]
    points = data.states[:-1].reshape(-1, nx)
    phi = error.find_features(points, data.inputs[1:].reshape(len(points), -1))[0]
    size = np.asarray(points.std(axis=0), dtype=np.float64)
    known = spread * np.asarray(phi.std(axis=0), dtype=np.float64) / np.where(size > 0, size, np.inf)[:, None]
    worst = float(np.max(known))
    if worst > _UNKNOWN:
        raise DataError(
            f"{_NOT_IDENTIFIABLE}: a coefficient is known to {worst:.2g} spreads of its state, at most "
            f"{_UNKNOWN} expected; move the set point, add a test signal to u, or pass fewer observables"
        )
