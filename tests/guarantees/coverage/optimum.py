"""The least cost on the true plant from a start, limits hard, by multiple shooting with Ipopt."""

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

QUIET = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-8, "ipopt.max_iter": 300}
TOUCHED = 1e-4  # of ±`size`: a state so near to its limit touches it


class Optimum(NamedTuple):
    """Cost, whether some state limit is active, and x_1 … x_T."""

    cost: float
    touches: bool
    X: np.ndarray


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
    Q, R = np.diag(task.cost.Q), np.diag(task.cost.R)
    size = task.spread / 0.05
    low, high = task.limits.states(len(plant.outputs))
    low, high = (
        np.resize(side, plant.nx) if len(side) == plant.nx else np.full(plant.nx, end)
        for side, end in ((low, -np.inf), (high, np.inf))
    )
    u_low, u_high = task.limits.inputs(plant.nu)
    u_size = np.where(np.isfinite(u_high - u_low), (u_high - u_low) / 2, 1.0)
    X, U = ca.MX.sym("X", plant.nx, T), ca.MX.sym("U", plant.nu, T)
    before = ca.horzcat(ca.DM(x0), X[:, :-1] * size)
    defects = (plant.F.map(T)(before, U * u_size) - X * size) / size
    error, moved = (X * size)[tracked, :] - task.rows[1:].T, U * u_size - task.held.T
    cost = ca.sum1(ca.sum2(error * (Q @ error))) + ca.sum1(ca.sum2(moved * (R @ moved)))
    variables = ca.vertcat(ca.vec(X), ca.vec(U))
    solver = ca.nlpsol("optimum", "ipopt", {"x": variables, "f": cost, "g": ca.vec(defects)}, QUIET)
    bounds = {
        "lbx": np.concatenate([np.tile(low / size, T), np.tile(u_low / u_size, T)]),
        "ubx": np.concatenate([np.tile(high / size, T), np.tile(u_high / u_size, T)]),
    }
    best: tuple[float, np.ndarray] | None = None
    guesses = [(np.tile(x0, (T, 1)), task.held)]
    if X0 is not None and U0 is not None:
        guesses.insert(0, (np.clip(X0, low, high), np.clip(U0, u_low, u_high)))
    for guess, inputs in guesses:
        found = solver(x0=np.concatenate([(guess / size).ravel(), (inputs / u_size).ravel()]), lbg=0, ubg=0, **bounds)
        if solver.stats()["success"] and (best is None or float(found["f"]) < best[0]):
            best = float(found["f"]), found["x"].full().ravel()[: T * plant.nx].reshape(T, -1)
    if best is None:
        return None
    near = np.minimum(best[1] - low / size, high / size - best[1]).min()
    return Optimum(best[0], bool(near < TOUCHED), best[1] * size)
