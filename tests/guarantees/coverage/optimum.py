"""The least cost of a `CoverageTask` on the true plant from a start, limits hard."""

from typing import Any

import numpy as np

from tests.closed_loop.optimum import QUIET, Optimum, find_best

QUICK = QUIET | {"ipopt.tol": 1e-8, "ipopt.max_iter": 300}
TOUCHED = 1e-4  # of ±`size`: a state so near to its limit touches it


def find_optimum(
    task: Any, x0: np.ndarray, X0: np.ndarray | None = None, U0: np.ndarray | None = None
) -> Optimum | None:
    """Return the optimum of a `CoverageTask` from x0, None where there is no way inside the limits.

    X0 (T, nx) and U0 (T, nu) are a second guess, such as a run.
    """
    plant, T = task.plant, task.steps
    names = list(plant.states)
    of = task.cost.of.bind(plant.states) if task.cost.of is not None else None
    tracked = list(range(plant.nx)) if of is None else [names.index(name) for name in of.names]
    low, high, u_low, u_high = ends = (*_read_box(task), *task.limits.inputs(plant.nu))
    u_size = np.where(np.isfinite(u_high - u_low), (u_high - u_low) / 2, 1.0)
    guesses = [(np.tile(x0, (T, 1)), task.held)]
    if X0 is not None and U0 is not None:
        guesses.insert(0, (np.clip(X0, low, high), np.clip(U0, u_low, u_high)))
    weights = np.diag(task.cost.Q), np.diag(task.cost.R), tracked
    references = task.rows[1:], task.held
    return find_best(plant, x0, weights, references, ends, (_size(task), u_size), guesses, QUICK)


def is_touched(task: Any, best: Optimum) -> bool:
    """Return whether some state limit is active on the way."""
    low, high = _read_box(task)
    way = best.X[1:]
    return bool((np.minimum(way - low, high - way) / _size(task)).min() < TOUCHED)


def _size(task: Any) -> np.ndarray:
    return task.spread / 0.05


def _read_box(task: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return x_min and x_max; a limit of outputs alone is none of states."""
    nx = task.plant.nx
    low, high = task.limits.states(len(task.plant.outputs))
    return (
        np.resize(low, nx) if len(low) == nx else np.full(nx, -np.inf),
        np.resize(high, nx) if len(high) == nx else np.full(nx, np.inf),
    )
