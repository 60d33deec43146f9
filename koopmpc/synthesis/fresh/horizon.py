"""choose_horizon: the horizon of a design that was given none, from its data."""

import numpy as np
import scipy.linalg
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.control.cost import Cost, check_cost_and_limits
from koopmpc.control.limits import Limits
from koopmpc.data.episodes import Episodes
from koopmpc.lifting.state import State

SHORTEST = 8  # steps
LONGEST = 40  # steps
SETTLED = 0.1  # a loop has settled where its error is below this share of its first error
SHARE = 0.5  # of the settling time; the tail of the cost stands for the rest
TRIED = 400  # steps of the trial loop


def choose_horizon(data: Episodes, cost: Cost, limits: Limits | None, reference: ArrayLike) -> tuple[int, str]:
    """Return the steps, and a sentence that says where they come from.

    Half of the time in which an LQR with limited inputs settles, on the affine model of the data, from the first state
    that takes longest; between 8 and 40 steps, and shorter than half of the episodes. The limits of the inputs bound
    how fast a motion can be stopped, and so the time.
    """
    cost, limits = check_cost_and_limits(cost, limits, data.states, data.inputs)
    X = np.concatenate([e.X[:-1] for e in data])
    U = np.concatenate([e.U for e in data])
    after = np.concatenate([e.X[1:] for e in data])
    size, u_size = np.maximum(X.std(axis=0), 1e-300), np.maximum(U.std(axis=0), 1e-300)
    table = np.hstack([(X - X.mean(axis=0)) / size, (U - U.mean(axis=0)) / u_size])
    moved: Float[np.ndarray, "M nx"] = (after - after.mean(axis=0)) / size
    fitted: Float[np.ndarray, "nx n"] = np.asarray(np.linalg.lstsq(table, moved, rcond=1e-8)[0]).T
    A, B = fitted[:, : data.nx], fitted[:, data.nx :]
    of = cost.of.bind(data.states)
    Q, R = cost.matrices(of.nz, data.nu)
    weight, goal = np.eye(data.nx), X.mean(axis=0)
    if isinstance(of, State):
        places = list(of.state_indices)
        weight = np.zeros((data.nx, data.nx))
        weight[np.ix_(places, places)] = Q * np.outer(size[places], size[places])
        goal[places] = np.atleast_2d(np.asarray(reference, dtype=np.float64))[-1]
    weight += 1e-6 * np.trace(weight) * np.eye(data.nx) / data.nx
    R = R * np.outer(u_size, u_size) + 1e-9 * np.eye(data.nu) * (1 + np.trace(R))
    most = max(min(LONGEST, int(np.median([len(e) for e in data])) // 2), 1)
    settled = _measure_settling(A, B, weight, R, (np.array([e.X[0] for e in data]) - goal) / size, data, limits, u_size)
    N = int(min(max(np.ceil(SHARE * settled), min(SHORTEST, most)), most))
    return N, (
        f"the horizon is {N} steps of {data.dt:g} s: half of the {settled} steps in which a linear loop with limited "
        "inputs settles, within 8 to 40 steps and half of the episodes"
    )


def _measure_settling(
    A: Float[np.ndarray, "nx nx"],
    B: Float[np.ndarray, "nx nu"],
    Q: Float[np.ndarray, "nx nx"],
    R: Float[np.ndarray, "nu nu"],
    starts: Float[np.ndarray, "n nx"],
    data: Episodes,
    limits: Limits,
    u_size: Float[np.ndarray, " nu"],
) -> int:
    """Return the steps until all loops stay below a tenth of their first error, at most 400."""
    try:
        P: Float[np.ndarray, "nx nx"] = np.asarray(scipy.linalg.solve_discrete_are(A, B, Q, R))
    except (np.linalg.LinAlgError, ValueError):
        return TRIED
    K: Float[np.ndarray, "nu nx"] = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    low, high = limits.inputs(data.nu)
    U = np.concatenate([e.U for e in data])
    half = np.where(np.isfinite(high - low), high - low, np.ptp(U, axis=0)) / 2 / u_size
    E, first, last = starts.T, np.sqrt(np.einsum("in,ij,jn->n", starts.T, Q, starts.T)), 1
    with np.errstate(all="ignore"):
        for k in range(1, TRIED + 1):
            E = A @ E + B @ np.clip(-K @ E, -half[:, None], half[:, None])
            if not (np.sqrt(np.einsum("in,ij,jn->n", E, Q, E)) <= SETTLED * first).all():
                last = k + 1
    return min(last, TRIED)
