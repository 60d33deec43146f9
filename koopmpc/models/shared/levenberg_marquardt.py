"""Levenberg-Marquardt descent that stops on rows which it does not fit; Gauss-Newton for the first states of runs."""

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

DAMPING = 1e-3  # first weight of the diagonal in a Levenberg-Marquardt step
GROWTH = 4.0  # factor on the damping after a step that does not lower the error
DECAY = 0.2  # factor on the damping after a step that does
LEAST_DAMPING = 1e-14  # damping does not fall below this
TRIALS = 10  # dampings tried for one step
CONVERGED = 1e-12  # stop where a step lowers the squared error by less than this share
_ROUNDING = float(np.finfo(float).eps)  # smaller eigenvalues than this share of the largest are rounding error
PATIENCE = 3  # stop after this many steps in a row that do not lower the error on the held-out rows

D = TypeVar("D", contravariant=True)


@runtime_checkable
class SquaredError(Protocol[D]):
    """A mean squared error with parameters Θ, on some data."""

    def evaluate(self, theta: Float[np.ndarray, "..."], data: D, /) -> float:
        """Return the error; inf where it cannot be computed."""
        ...

    def derivatives(
        self, theta: Float[np.ndarray, "..."], data: D, /
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
        """Return half the gradient, row after row of Θ, and the Gauss-Newton matrix."""
        ...


def minimise(
    error: SquaredError[D],
    start: Float[np.ndarray, "..."],
    fitted: D,
    judged: D,
    iterations: int,
    *,
    free: Int[np.ndarray, " f"] | None = None,
    patience: int = PATIENCE,
    converged: float = CONVERGED,
    project: Callable[[Float[np.ndarray, "..."]], Float[np.ndarray, "..."]] | None = None,
) -> tuple[Float[np.ndarray, "..."], int]:
    """Return the Θ on the way down the error of `fitted` that has the least error on `judged`, and its iteration.

    Parameters
    ----------
    error
        What is minimised.
    start
        Θ to start from.
    fitted, judged
        Data that are fitted, and data that decide when to stop.
    iterations
        Steps, at most.
    free
        Places of the entries of Θ that may change; all by default.
    patience
        Stop after this many steps in a row that do not lower the error of `judged`.
    converged
        Stop where a step lowers the error of `fitted` by less than this share.
    project
        Returns the Θ that may be taken in place of that of a step, tried where no step itself lowers the error.
    """
    theta = best = start
    places = np.arange(theta.size) if free is None else free
    value, least = error.evaluate(theta, fitted), error.evaluate(theta, judged)
    damping, at, waited = DAMPING, 0, 0
    for step in range(1, iterations + 1):
        if not np.isfinite(value):
            break  # the start overflows: there is no derivative to follow
        gradient, matrix = error.derivatives(theta, fitted)
        gradient, matrix = gradient[places], matrix[np.ix_(places, places)]
        scale = np.sqrt(np.where(matrix.diagonal() > 0, matrix.diagonal(), 1.0))
        sizes, directions = np.linalg.eigh(matrix / np.outer(scale, scale))  # once for all dampings
        slope, lower = directions.T @ (gradient / scale), np.inf
        begun = damping
        for turn in (_keep,) if project is None else (_keep, project):
            damping = begun
            for _ in range(TRIALS):
                move = np.zeros(theta.size)
                damped = sizes + damping
                steep = damped > _ROUNDING * len(sizes) * damped[-1]  # directions that are more than rounding error
                along = np.divide(slope, damped, out=np.zeros(len(sizes)), where=steep)
                if along @ (2 * slope - sizes * along) < converged * value:
                    break  # the quadratic model promises too little for another step
                move[places] = -directions @ along / scale
                trial = turn(theta + move.reshape(theta.shape))
                lower = error.evaluate(trial, fitted)
                if lower < value:
                    theta = trial
                    damping = max(DECAY * damping, LEAST_DAMPING)
                    break
                damping *= GROWTH
            if lower < value:
                break
        if not lower < value:
            break
        gained, value = 1 - lower / value, lower
        now = error.evaluate(theta, judged)
        if now < least:
            best, least, at, waited = theta, now, step, 0
        else:
            waited += 1
        if gained < converged or waited == patience:
            break
    return best, at


def _keep(theta: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    return theta


def find_starts(
    evaluate: Callable[[Float[np.ndarray, "m n"]], Float[np.ndarray, " m"]],
    differentiate: Callable[[Float[np.ndarray, "m n"]], tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n n"]]],
    starts: Float[np.ndarray, "m n"],
    *,
    steps: int = 20,
    soft: float = 0.0,
    shares: Sequence[float] = tuple(0.5**i for i in range(8)),
    converged: float = 1e-12,
) -> Float[np.ndarray, "m n"]:
    """Return the first state of each of m runs that explains its rows best, by Gauss-Newton on all runs at once.

    Parameters
    ----------
    evaluate
        Squared error of each run; inf where it leaves the model.
    differentiate
        Half its gradient by the first state, and the Gauss-Newton matrix.
    starts
        Where the search begins.
    steps
        Steps, at most.
    soft
        Weight of a state's own size in a step, as a share of the mean of the matrix's diagonal.
    shares
        Of a step, tried until it lowers the error of a run.
    converged
        Stop where a step lowers the sum of all errors by less than this share.
    """
    errors = evaluate(starts)
    for _ in range(steps):
        (slope, square), before = differentiate(starts), errors.sum()
        move = -np.matmul(invert_softly(square, soft), slope[..., None])[..., 0]
        waits = np.ones(len(starts), dtype=np.bool_)
        for share in shares:
            trial = np.where(waits[:, None], starts + share * move, starts)
            lower = evaluate(trial)
            better = waits & (lower < errors)
            starts, errors = np.where(better[:, None], trial, starts), np.where(better, lower, errors)
            waits &= ~better
            if not waits.any():
                break
        if not before - errors.sum() > converged * before:
            break
    return starts


def invert_softly(square: Float[np.ndarray, "m n n"], soft: float) -> Float[np.ndarray, "m n n"]:
    """Return the inverse of each matrix, with a little weight on its diagonal."""
    n = square.shape[1]
    weighed = square.copy()
    weighed[:, np.arange(n), np.arange(n)] += soft * np.trace(square, axis1=1, axis2=2)[:, None] / n + 1e-300
    return np.linalg.inv(weighed)
