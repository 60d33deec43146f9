"""The measure: the least cost that any input sequence has on the true plant, over the whole run.

Multiple shooting with Ipopt, written apart from the library's controllers: of koopmpc it uses the plant's step map.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache

import casadi as ca
import numpy as np

import koopmpc as km
from tests.closed_loop.more_tasks import JUDGED
from tests.closed_loop.tasks import Task, UTarget

QUIET = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-9, "ipopt.max_iter": 1500}
RANDOM = 3  # starts with random inputs


@dataclass(frozen=True)
class Optimum:
    """x_0 … x_T and u_0 … u_{T−1} of the least cost; `found` holds the costs from all starts that converged."""

    X: np.ndarray
    U: np.ndarray
    cost: float
    found: tuple[float, ...]


def weights(task: Task) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Return Q, R and the indices of the tracked states."""
    names = task.plant.states
    tracked = list(range(len(names))) if task.tracked is None else [names.index(name) for name in task.tracked]
    return np.diag(task.Q), np.diag(task.R), tracked


def boxes(task: Task) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return x_min, x_max, u_min, u_max."""
    plant, limits = task.plant, task.limits
    ends = ((limits.x_min, -np.inf, plant.nx), (limits.x_max, np.inf, plant.nx))
    ends += ((limits.u_min, -np.inf, plant.nu), (limits.u_max, np.inf, plant.nu))
    low, high, u_low, u_high = (
        np.broadcast_to(free if end is None else end, (n,)).astype(float) for end, free, n in ends
    )
    return low, high, u_low, u_high


@cache
def held(name: str, u_target: UTarget | None = None) -> np.ndarray:
    """Return (steps, nu) the inputs from which a task counts: those that hold its references, or zeros.

    They minimise ‖of(x) − r‖²_Q over the equilibria x = F(x, u) inside the limits.
    """
    task = JUDGED[name].but(u_target)
    plant = task.plant
    if task.u_target == "zero":
        return np.zeros((task.steps, plant.nu))
    Q, _, tracked = weights(task)
    size, u_size = sizes(task)
    low, high, u_low, u_high = boxes(task)
    x, u, r = ca.SX.sym("x", plant.nx), ca.SX.sym("u", plant.nu), ca.SX.sym("r", len(Q))
    error = (x * size)[tracked] - r
    rest = (plant.F(x * size, u * u_size) - x * size) / size
    v = ca.vertcat(x, u)
    problem = {"x": v, "p": r, "f": error.T @ Q @ error, "g": rest}
    solver = ca.nlpsol("held", "ipopt", problem, QUIET)
    distinct, of = np.unique(task.rows[:-1], axis=0, return_inverse=True)
    bounds = {
        "lbx": np.concatenate([low / size, u_low / u_size]),
        "ubx": np.concatenate([high / size, u_high / u_size]),
    }
    guess = np.concatenate([np.array(task.around[0]) / size, np.array(task.around[1]) / u_size])
    found = []
    for row in distinct:
        guess = solver(x0=guess, p=row, lbg=0, ubg=0, **bounds)["x"].full().ravel()
        if not solver.stats()["success"]:
            raise RuntimeError(f"{name}: no equilibrium for {row}: {solver.stats()['return_status']}")
        found.append(guess[plant.nx :] * u_size)
    return np.array(found)[of.ravel()]


def sizes(task: Task) -> tuple[np.ndarray, np.ndarray]:
    """Return the spread of each state in the training data's initial states and the span of each input."""
    x0 = task.training.x0
    _, _, u_low, u_high = boxes(task)
    return (np.asarray(x0.high) - np.asarray(x0.low)) / 2, (u_high - u_low) / 2


@cache
def optimum(name: str, start: int, u_target: UTarget | None = None) -> Optimum:
    """Return the best solution from several starts, state limits hard.

    The sum is the one of `km.metrics`: Σ_{k=1}^{T} ‖of(x_k) − r_k‖²_Q + Σ_{k=0}^{T−1} ‖u_k − u_r‖²_R.
    """
    task = JUDGED[name].but(u_target)
    x0, u_ref = np.array(task.starts[start]), held(name, u_target)
    given = weights(task), (task.rows[1:], u_ref), boxes(task), sizes(task), _starts(task, x0, u_ref)
    best = find_best(task.plant, x0, *given, W=task.weather)
    if best is None:
        raise RuntimeError(f"{name}: no start of the optimal-control problem converged; is the task feasible?")
    return best


def find_best(
    plant: km.StepMap,
    x0: np.ndarray,
    weights: tuple[np.ndarray, np.ndarray, list[int]],
    references: tuple[np.ndarray, np.ndarray],
    boxes: tuple[np.ndarray, ...],
    sizes: tuple[np.ndarray, np.ndarray],
    guesses: Iterable[tuple[np.ndarray, np.ndarray]],
    settings: dict = QUIET,
    W: np.ndarray | None = None,
) -> Optimum | None:
    """Return the best way from x0 that Ipopt finds from the guesses (X, U), None where none converges.

    `references` are (T, nr) rows of the tracked states and (T, nu) inputs from which the cost counts. W are the (T, nw)
    measured disturbances of a plant that has some.
    """
    (Q, R, tracked), (rows, u_ref), (size, u_size), (low, high, u_low, u_high) = weights, references, sizes, boxes
    T = len(u_ref)
    X, U = ca.MX.sym("X", plant.nx, T), ca.MX.sym("U", plant.nu, T)
    before = ca.horzcat(ca.DM(x0), X[:, :-1] * size)  # in the plant's units
    driven = plant.F.map(T)(before, U * u_size, *(() if W is None else (W.T,)))
    defects = (driven - X * size) / size
    error, moved = (X * size)[tracked, :] - rows.T, U * u_size - u_ref.T
    cost = ca.sum1(ca.sum2(error * (Q @ error))) + ca.sum1(ca.sum2(moved * (R @ moved)))
    variables = ca.vertcat(ca.vec(X), ca.vec(U))
    solver = ca.nlpsol("optimum", "ipopt", {"x": variables, "f": cost, "g": ca.vec(defects)}, settings)
    bounds = {
        "lbx": np.concatenate([np.tile(low / size, T), np.tile(u_low / u_size, T)]),
        "ubx": np.concatenate([np.tile(high / size, T), np.tile(u_high / u_size, T)]),
    }
    best, found = None, []
    for X0, U0 in guesses:
        result = solver(x0=np.concatenate([(X0 / size).ravel(), (U0 / u_size).ravel()]), lbg=0, ubg=0, **bounds)
        if not solver.stats()["success"]:
            continue
        found.append(float(result["f"]))
        if best is None or found[-1] < best[0]:
            best = found[-1], result["x"].full().ravel()
    if best is None:
        return None
    states, inputs = np.split(best[1], [T * plant.nx])
    X = np.vstack([x0, states.reshape(T, -1) * size])
    return Optimum(X, inputs.reshape(T, -1) * u_size, best[0], tuple(sorted(found)))


def _starts(task: Task, x0: np.ndarray, u_ref: np.ndarray):
    """Yield guesses (X, U): rest at x0, a straight way to the reference, and what random inputs do."""
    T, plant = task.steps, task.plant
    low, high, u_low, u_high = boxes(task)
    _, _, tracked = weights(task)
    ahead = np.tile(x0, (T, 1))
    yield ahead, u_ref
    share = np.minimum(np.arange(1, T + 1) / (T / 4), 1.0)[:, None]
    straight = ahead.copy()
    straight[:, tracked] += share * (task.rows[1:] - x0[tracked])
    yield np.clip(straight, low, high), u_ref
    rng = np.random.default_rng(0)
    for _ in range(RANDOM):
        U = np.repeat(rng.uniform(u_low, u_high, (T // 5 + 1, plant.nu)), 5, axis=0)[:T]
        yield np.clip(straight + 0.3 * rng.standard_normal(straight.shape) * sizes(task)[0], low, high), U
