"""Levenberg-Marquardt descent that stops on rows which it does not fit; Gauss-Newton for the first states of runs."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class _Steps:
    """How the damping of a step is chosen."""

    damping: float = 1e-3  # first weight of the diagonal in a Levenberg-Marquardt step
    growth: float = 4.0  # factor on the damping after a step that does not lower the error
    decay: float = 0.2  # factor on the damping after a step that does
    least_damping: float = 1e-14  # damping does not fall below this
    trials: int = 10  # dampings tried for one step


_STEPS = _Steps()
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

    Only the entries at the places `free` change. `patience` counts steps in a row that do not gain on `judged`,
    and `converged` is the share of the error of `fitted` that a step has to gain. Where no step lowers the error,
    `project` returns the Θ to try in its place.
    """
    theta = best = start
    places = np.arange(theta.size) if free is None else free
    value, least = error.evaluate(theta, fitted), error.evaluate(theta, judged)
    damping, at, waited = _STEPS.damping, 0, 0
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
            for _ in range(_STEPS.trials):
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
                    damping = max(_STEPS.decay * damping, _STEPS.least_damping)
                    break
                damping *= _STEPS.growth
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
    step: Callable[[Float[np.ndarray, "m n"]], Float[np.ndarray, "m n"]],
    starts: Float[np.ndarray, "m n"],
    *,
    steps: int = 20,
    shares: Sequence[float] = tuple(0.5**i for i in range(8)),
    converged: float = 1e-12,
) -> Float[np.ndarray, "m n"]:
    """Return the first state of each of m runs that explains its rows best, by Gauss-Newton on all runs at once.

    `evaluate` returns the squared error of each run, inf where it leaves the model, and `step` the Gauss-Newton step.
    `shares` are those of a step that are tried, and `converged` is the share of all errors that a step has to gain.
    """
    errors = evaluate(starts)
    for _ in range(steps):
        move, before = step(starts), errors.sum()
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
