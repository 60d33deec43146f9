"""The task of a design: cost, limits, horizon, reference and starts, checked against the data."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import Value
from koopmpc.control.ask.checks import FEEDBACK_FIELDS
from koopmpc.control.ask.cost import Cost, check_cost_and_limits, refuse_stage
from koopmpc.control.ask.limits import Limits, require_known
from koopmpc.data.episodes import Episodes
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.composed import evaluate_jacobians
from koopmpc.lifting.state import State
from koopmpc.loop.metrics import stack_limited


@dataclass(frozen=True)
class TaskSettings:
    """How long loops and plans are, and from where loops begin."""

    run: int = 3  # length of a run in horizons
    moving: int = 120  # steps of a run with a moving reference, at least: three short horizons show no tracking
    longest: int = 120  # steps of a run that is as long as a loop takes to settle, at most
    starts: int = 12  # default number of starts: one for each condition of a design
    few: int = 4  # if at least this many first states are inside the limits, only those are used
    rows: int = 400  # rows along a few records from which random starts are drawn, at most
    room: float = 0.5  # a run may leave the data by this share of their range
    settled: float = 0.1  # a loop has settled where its error is below this share of its first error
    tried: int = 400  # steps of the trial loop
    least_plan: int = 8  # steps
    most_plan: int = 40  # steps
    plan_share: float = 0.5  # of the settling time; the tail of the cost stands for the rest


LENGTHS = TaskSettings()


@dataclass(frozen=True, eq=False)
class DesignTask(Value):
    """A control task on the plant of some data.

    Attributes
    ----------
    cost, limits, horizon
        Settings of every controller.
    reference
        (T+1, nr) rows, T at least `steps`.
    starts
        (n, nx) states from which runs begin.
    first_states
        (m, nx) first states of all episodes, or only those inside the limits if there are enough; random starts are
        drawn from them. Three records or fewer have too few of them: rows all along the records stand beside them.
    steps
        Length of a run: three horizons, and as many steps as a linear loop on the data takes to settle from the
        starts, at most 120; at least 120 where the reference moves; or all steps of the reference.
    angles
        Indices of states whose errors wrap.
    low, high
        (nx,) range of the data.
    limit_sizes
        (nx + ny,) size of each limited row, in which violations are measured: the distance of its two limits, or the
        range of the data.
    along
        Whether random starts are rows along a few records, with the past that they had there.
    """

    cost: Cost
    limits: Limits
    horizon: int
    reference: Float[np.ndarray, "T1 nr"]
    starts: Float[np.ndarray, "n nx"]
    first_states: Float[np.ndarray, "m nx"]
    steps: int
    angles: tuple[int, ...]
    low: Float[np.ndarray, " nx"]
    high: Float[np.ndarray, " nx"]
    limit_sizes: Float[np.ndarray, " nl"]
    along: bool = False

    @property
    def moves(self) -> bool:
        """Whether the reference changes."""
        return bool((self.reference != self.reference[0]).any())

    @property
    def late(self) -> int:
        """The last reference row at which a run can begin."""
        return len(self.reference) - 1 - self.steps

    def weigh_states(self, x: Float[np.ndarray, " nx"], states: Sequence[str], nu: int) -> Float[np.ndarray, "nx nx"]:
        """Return JᵀQJ, the weights of the tracked outputs as weights of the states around x."""
        J = evaluate_jacobians(self.cost.of.bind(states), x[None])[0]
        return J.T @ self.cost.matrices(len(J), nu)[0] @ J

    def hull(self, free: Sequence[int], tracked: Sequence[int]) -> tuple[Float[np.ndarray, " nx"], ...]:
        """Return the box that a run must not leave: data, starts and reference, widened by half of the data's range.

        The states `free` have no bounds. The columns of the reference belong to the states `tracked`, which may be
        empty.
        """
        low, high = np.minimum(self.low, self.starts.min(axis=0)), np.maximum(self.high, self.starts.max(axis=0))
        for column, i in enumerate(tracked):
            low[i] = min(low[i], self.reference[:, column].min())
            high[i] = max(high[i], self.reference[:, column].max())
        room = LENGTHS.room * (self.high - self.low)
        low, high = low - room, high + room
        low[list(free)], high[list(free)] = -np.inf, np.inf
        return low, high


def check_task(
    data: Episodes,
    cost: Cost,
    limits: Limits | None,
    horizon: int,
    reference: ArrayLike,
    starts: ArrayLike | None,
    angles: Sequence[int],
) -> DesignTask:
    """Return the task, checked."""
    cost, limits = check_cost_and_limits(cost, limits, data.states, data.inputs)
    if limits.in_time:
        raise DataError(
            "the limits have rows in time, and a design judges by one set; pass limits.base, and the rows to its "
            "controller: controller(y, reference, limits=controller.limits.with_bounds(u_max=rows))"
        )
    require_known(limits, "a design", FEEDBACK_FIELDS - {"priority"})
    refuse_stage(cost, "a design")
    nx, states = data.nx, data.states
    of = cost.of.bind(states)
    cost.matrices(of.nz, data.nu)
    ny = 0 if limits.of is None else limits.of.bind(states).nz
    limits.inputs(data.nu)
    limits.find_rows(nx, ny)
    rows = _check_reference(reference, of)
    outside = [i for i in angles if not 0 <= i < nx]
    if outside:
        raise DataError(f"angles holds {outside[0]}; pass indices of states, 0 to {nx - 1}")
    X = np.concatenate([episode.X for episode in data])
    firsts, along = _first_states(data, limits), starts is None and len(data) < LENGTHS.few
    points = _choose_spread(firsts) if starts is None else _check_starts(starts, nx)
    steps = max(LENGTHS.run * horizon, min(measure_settling(data, cost, limits, rows, points), LENGTHS.longest))
    if len(rows) == 1:
        rows = np.repeat(rows, steps + 1, axis=0)
    if (rows != rows[0]).any():
        steps = max(steps, LENGTHS.moving)
    values, box = stack_limited(limits, X, states)
    sizes = box.high - box.low
    sizes = np.where(np.isfinite(sizes) & (sizes > 0), sizes, np.maximum(np.ptp(values, axis=0), 1e-300))
    return DesignTask(
        cost=cost,
        limits=limits,
        horizon=horizon,
        reference=rows,
        starts=points,
        first_states=np.vstack([firsts, _rows_along(data, limits)]) if along else firsts,
        steps=min(steps, max(len(rows) - 1, 1)),
        angles=tuple(angles),
        low=X.min(axis=0),
        high=X.max(axis=0),
        limit_sizes=sizes,
        along=along,
    )


def _check_reference(reference: ArrayLike, of: Lifting) -> Float[np.ndarray, "T1 nr"]:
    rows = checks.array(reference, "reference")
    given = (rows.shape or (1,))[-1]
    if rows.ndim > 2 or given != of.nz or not rows.size:
        fewer = "; to track fewer pass Cost(of=km.State(…), …)" if 0 < given < of.nz else ""
        raise ShapeError(
            f"reference has shape {rows.shape}, expected ({of.nz},) or rows (T+1, {of.nz}), one column for each "
            f"output that the cost tracks: {', '.join(of.names)}{fewer}"
        )
    return rows.reshape(-1, of.nz)


def _check_starts(starts: ArrayLike, nx: int) -> Float[np.ndarray, "n nx"]:
    points = checks.array(starts, "starts")
    single = points.ndim < 2 and points.size == nx
    points = checks.array(points.reshape(-1, nx) if single else points, "starts", (None, nx))
    if not len(points):
        raise DataError("starts is empty; pass states (n, nx), or None for first states of the data's episodes")
    return points


def measure_settling(
    data: Episodes, cost: Cost, limits: Limits, reference: ArrayLike, starts: Float[np.ndarray, "n nx"]
) -> int:
    """Return the steps in which an LQR with limited inputs settles from each of the starts, at most 400.

    The loop is on the affine model of the data. The limits of the inputs bound how fast a motion can be stopped, and so
    the time.
    """
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
    return _count_steps(A, B, weight, R, (starts - goal) / size, data, limits, u_size)


def _count_steps(
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
        return LENGTHS.tried
    K: Float[np.ndarray, "nu nx"] = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    low, high = limits.inputs(data.nu)
    U = np.concatenate([e.U for e in data])
    half = np.where(np.isfinite(high - low), high - low, np.ptp(U, axis=0)) / 2 / u_size
    E, first, last = starts.T, np.sqrt(np.einsum("in,ij,jn->n", starts.T, Q, starts.T)), 1
    with np.errstate(all="ignore"):
        for k in range(1, LENGTHS.tried + 1):
            E = A @ E + B @ np.clip(-K @ E, -half[:, None], half[:, None])
            if not (np.sqrt(np.einsum("in,ij,jn->n", E, Q, E)) <= LENGTHS.settled * first).all():
                last = k + 1
    return min(last, LENGTHS.tried)


def _first_states(data: Episodes, limits: Limits) -> Float[np.ndarray, "n nx"]:
    """Return the first states of episodes, those inside the limits alone where there are four or more."""
    points = np.unique(np.array([episode.X[0] for episode in data]), axis=0)
    low, high = limits.states(data.nx)
    inside = points[((points >= low) & (points <= high)).all(axis=1)]
    return inside if len(inside) >= LENGTHS.few else points


def _rows_along(data: Episodes, limits: Limits) -> Float[np.ndarray, "n nx"]:
    """Return states spread evenly over all steps of the episodes, those inside the limits."""
    rows = np.concatenate([episode.X for episode in data])
    low, high = limits.states(data.nx)
    inside = rows[((rows >= low) & (rows <= high)).all(axis=1)]
    return inside[:: -(-len(inside) // LENGTHS.rows) or 1]


def _choose_spread(points: Float[np.ndarray, "n nx"]) -> Float[np.ndarray, "m nx"]:
    """Return a few of the points: of the half nearest to their median, far from each other."""
    size = np.ptp(points, axis=0)
    Z = (points - np.median(points, axis=0)) / np.where(size > 0, size, 1.0)
    central = np.argsort((Z**2).sum(axis=1), kind="stable")[: max(-(-len(Z) // 2), min(LENGTHS.few, len(Z)))]
    picked = [int(central[-1])]
    while len(picked) < min(LENGTHS.starts, len(central)):
        apart = np.min([((Z[central] - Z[i]) ** 2).sum(axis=1) for i in picked], axis=0)
        picked.append(int(central[apart.argmax()]))
    return points[picked]


def choose_horizon(data: Episodes, cost: Cost, limits: Limits | None, reference: ArrayLike) -> tuple[int, str]:
    """Return the steps, and a sentence that says where they come from.

    Half of the time in which a linear loop on the data settles, see `measure_settling`; between 8 and 40 steps, and
    shorter than half of the episodes.
    """
    cost, limits = check_cost_and_limits(cost, limits, data.states, data.inputs)
    settled = measure_settling(data, cost, limits, reference, np.array([e.X[0] for e in data]))
    most = max(min(LENGTHS.most_plan, int(np.median([len(e) for e in data])) // 2), 1)
    N = int(min(max(np.ceil(LENGTHS.plan_share * settled), min(LENGTHS.least_plan, most)), most))
    return N, (
        f"the horizon is {N} steps of {data.dt:g} s: half of the {settled} steps in which a linear loop with limited "
        "inputs settles, within 8 to 40 steps and half of the episodes"
    )


def goal_box(task: DesignTask) -> tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " nx"]]:
    """Return the range of the goal: what both the limits and the range of the data allow."""
    low, high = task.limits.states(len(task.low))
    low, high = np.maximum(low, task.low), np.minimum(high, task.high)
    empty = low > high
    return np.where(empty, task.low, low), np.where(empty, task.high, high)
