"""The task of a design: cost, limits, horizon, reference and starts, checked against the data."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost, check_cost_and_limits, refuse_stage
from koopmpc.control.limits import Limits, refuse_levels, refuse_priority
from koopmpc.data.episodes import Episodes
from koopmpc.errors import DataError, ShapeError
from koopmpc.lifting.base import strip_unit
from koopmpc.lifting.composed import evaluate_jacobians
from koopmpc.lifting.state import State
from koopmpc.loop.metrics import stack_limited
from koopmpc.text import with_unit
from koopmpc.values import Value

RUN = 3  # length of a run in horizons
MOVING = 120  # steps of a run with a moving reference, at least: three short horizons show the way there, no tracking
LONGEST = 120  # steps of a run that is as long as a loop takes to settle, at most
STARTS = 12  # default number of starts: one for each condition of a design
_FEW = 4  # if at least this many first states are inside the limits, only those are used
_ROWS = 400  # rows along a few records from which random starts are drawn, at most
ROOM = 0.5  # a run may leave the data by this share of their range
SETTLED = 0.1  # a loop has settled where its error is below this share of its first error
TRIED = 400  # steps of the trial loop
FAR = 1.0  # an episode is left out if it leaves the box of the others by more than this many widths
MOST = 0.9  # share of the episodes inside this box


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
        starts, at most 120; at least 120 where the reference moves; or all its steps.
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
        room = ROOM * (self.high - self.low)
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
    """Return the task, checked.

    Raises
    ------
    DataError, ShapeError
        A size does not fit, NaN, an angle that is no state.
    """
    cost, limits = check_cost_and_limits(cost, limits, data.states, data.inputs)
    if limits.in_time:
        raise DataError(
            "the limits have rows in time, and a design judges by one set; pass limits.base, and the rows to its "
            "controller: controller(y, reference, limits=controller.limits.with_bounds(u_max=rows))"
        )
    refuse_levels(limits, "a design")
    refuse_stage(cost, "a design")
    refuse_priority(limits, "a design")
    nx, states = data.nx, data.states
    of = cost.of.bind(states)
    cost.matrices(of.nz, data.nu)
    ny = 0 if limits.of is None else limits.of.bind(states).nz
    limits.inputs(data.nu)
    limits.find_rows(nx, ny)
    rows = checks.array(reference, "reference")
    given = (rows.shape or (1,))[-1]
    if rows.ndim > 2 or given != of.nz or not rows.size:
        fewer = "; to track fewer pass Cost(of=km.State(…), …)" if 0 < given < of.nz else ""
        raise ShapeError(
            f"reference has shape {rows.shape}, expected ({of.nz},) or rows (T+1, {of.nz}), one column for each "
            f"output that the cost tracks: {', '.join(of.names)}{fewer}"
        )
    rows = rows.reshape(-1, of.nz)
    outside = [i for i in angles if not 0 <= i < nx]
    if outside:
        raise DataError(f"angles holds {outside[0]}; pass indices of states, 0 to {nx - 1}")
    X = np.concatenate([episode.X for episode in data])
    low, high = X.min(axis=0), X.max(axis=0)
    firsts, along = _first_states(data, limits), starts is None and len(data) < _FEW
    if starts is None:
        points = _choose_spread(firsts)
    else:
        points = checks.array(starts, "starts")
        points = checks.array(
            points.reshape(-1, nx) if points.ndim < 2 and points.size == nx else points, "starts", (None, nx)
        )
        if not len(points):
            raise DataError("starts is empty; pass states (n, nx), or None for first states of the data's episodes")
    steps = max(RUN * horizon, min(measure_settling(data, cost, limits, rows, points), LONGEST))
    if len(rows) == 1:
        rows = np.repeat(rows, steps + 1, axis=0)
    if (rows != rows[0]).any():
        steps = max(steps, MOVING)
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
        low=low,
        high=high,
        limit_sizes=sizes,
        along=along,
    )


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


def limit_margins(asked: DesignTask, data: Episodes) -> Float[np.ndarray, " nx"]:
    """Return the largest margin of each state (nx,): half of the way from the reference to the nearest limit.

    Without this bound, errors of a poor model could lead to margins that exclude the reference itself. A reference on
    or beyond a limit, or without a weight, bounds no margin.
    """
    low, high = asked.limits.states(data.nx)
    room = np.full(data.nx, np.inf)
    for i, aims in _weighted_references(asked, data).items():
        way = min(aims.min() - low[i], high[i] - aims.max())
        if way > 0:
            room[i] = way / 2
    return room


def find_stray_episodes(data: Episodes, asked: DesignTask) -> dict[int, str]:
    """Return the episodes that went far away with ordinary inputs, each with a sentence that says how far.

    A sensor may have jumped, or the plant fallen over; the squares of such an episode outweigh all others in fits and
    in errors. An episode is far away if it leaves, by more than its width, the box of nine tenths of the episodes, the
    starts, the reference and the limits. Its inputs are ordinary if they stay within half a width of those of the
    others. Episodes with stronger inputs are kept, because they are valuable experiments.
    """
    low, high = asked.limits.states(data.nx)
    low, high = np.where(np.isfinite(low), low, np.inf), np.where(np.isfinite(high), high, -np.inf)
    low, high = np.minimum(low, asked.starts.min(axis=0)), np.maximum(high, asked.starts.max(axis=0))
    for i, aims in _weighted_references(asked, data).items():
        low[i], high[i] = min(low[i], aims.min()), max(high[i], aims.max())
    X, U = [episode.X for episode in data], [episode.U for episode in data]
    x_far, x_low, x_high = _measure_departures(X, low, high)
    u_far, _, _ = _measure_departures(U, np.full(data.nu, np.inf), np.full(data.nu, -np.inf))
    found: dict[int, str] = {}
    for k in np.flatnonzero((x_far.max(axis=1) > FAR) & (u_far.max(axis=1) <= ROOM)).tolist():
        i = int(x_far[k].argmax())
        furthest = X[k][np.abs(X[k][:, i] - (x_low[i] + x_high[i]) / 2).argmax(), i]
        found[k] = (
            f"episode {k} of 0 … {len(data) - 1} is left out: it goes to "
            f"{with_unit(data.states[i], f'= {furthest:.4g}')}, and nine in ten stay between {x_low[i]:.4g} and "
            f"{x_high[i]:.4g} under such inputs; look at it: a sensor may have jumped, or the plant have fallen over"
        )
    return found


def _measure_departures(
    rows: Sequence[Float[np.ndarray, "_ n"]], low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "e n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return how far each episode leaves the box of nine tenths of them, in widths (episodes, n), and the box.

    The box is widened to hold `low` and `high`.
    """
    least, most = np.array([one.min(axis=0) for one in rows]), np.array([one.max(axis=0) for one in rows])
    low = np.minimum(np.quantile(least, 1 - MOST, axis=0), low)
    high = np.maximum(np.quantile(most, MOST, axis=0), high)
    width = np.maximum(high - low, 1e-300)
    return np.maximum(low - least, most - high) / width, low, high


def find_outside_data(asked: DesignTask, data: Episodes, tracked: Sequence[int], free: Sequence[int]) -> list[str]:
    """Return a sentence for each state whose start or reference lies outside the data, where no model was fitted."""
    said: list[str] = []
    room = 0.01 * (asked.high - asked.low)
    targets = {i: asked.reference[:, column] for column, i in enumerate(tracked)}
    for i, name in enumerate(data.states):
        low, high = asked.low[i], asked.high[i]
        for what, values in (("a start", asked.starts[:, i]), ("the reference", targets.get(i, np.zeros(0)))):
            far = values[(values < low - room[i]) | (values > high + room[i])]
            if far.size and i not in free:
                said.append(
                    f"{what} has {with_unit(name, f'= {far[np.abs(far - (low + high) / 2).argmax()]:.4g}')}, outside "
                    f"the data, which go from {low:.4g} to {high:.4g}: no model was fitted there; collect data there, "
                    "or ask for less"
                )
    return said


def find_outside_limits(asked: DesignTask, data: Episodes) -> list[str]:
    """Return a sentence for each limit that a start or a moving reference lies beyond.

    A constant reference is not checked here; `explain_unreachable` says what can be held instead.
    """
    limits, states = asked.limits, data.states
    names = states if limits.of is None else (*states, *limits.of.bind(states).names)
    starts, box = stack_limited(limits, asked.starts, states)
    tracked = asked.cost.of.bind(states).names
    targets = dict(zip(tracked, asked.reference.T, strict=True)) if asked.moves else {}
    said: list[str] = []
    for name, start, low, high in zip(names, starts.T, *box, strict=True):
        for what, values, meaning in (
            ("a start", start, "no input can keep the limit from there; start inside it, or widen it"),
            ("the reference", targets.get(name), "the loop stays at the limit there; ask for less, or widen it"),
        ):
            over = np.zeros(1) if values is None else np.maximum(low - values, values - high)
            if values is not None and over.max() > 1e-9 * np.abs(values).max():
                value = values[over.argmax()]
                limit = with_unit(name, f"= {low if value < low else high:.4g}")
                said.append(f"{what} has {with_unit(name, f'= {value:.4g}')}, beyond the limit {limit}: {meaning}")
    return said


def find_poor_logs(asked: DesignTask, data: Episodes, tracked: Sequence[int]) -> list[str]:
    """Return sentences where logs cannot serve: outside of all limits, from a single start, slower than the reference.

    A reference is too fast if half of the rows that move it move it by more than the logs move that state in any step.
    """
    X, said = [episode.X for episode in data], list[str]()
    least, most = (np.array([ends(one, axis=0) for one in X]) for ends in (np.min, np.max))
    for name, low, high, under, over in zip(
        data.states, least.min(axis=0), most.max(axis=0), *asked.limits.states(data.nx), strict=True
    ):
        if low > over or high < under:
            said.append(
                f"the limits of {strip_unit(name)} allow {under:.4g} to {over:.4g}, and the data go from {low:.4g} to "
                f"{high:.4g}: no log was inside these limits; record some there, or widen the limits"
            )
    first = np.array([one[0] for one in X])
    if len(X) > 1 and (first == first[0]).all() and (asked.starts == first[0]).all():
        shown = ", ".join(with_unit(name, f"= {value:.4g}") for name, value in zip(data.states, first[0], strict=True))
        said.append(
            f"all {len(X)} episodes start at {shown}: how the loop goes from elsewhere was tried on no such start; "
            "record episodes from other states, or pass starts="
        )
    steps = np.max([np.abs(np.diff(one, axis=0)).max(axis=0) for one in X], axis=0)
    for column, i in enumerate(tracked):
        moved = np.abs(np.diff(asked.reference[:, column]))
        usual = float(np.median(moved[moved > 0])) if (moved > 0).sum() > _FEW else 0.0
        if usual > steps[i] and i in _weighted_references(asked, data):
            said.append(
                f"no input can follow the reference: it moves {strip_unit(data.states[i])} by {usual:.4g} in a step, "
                f"and no log moves it by more than {steps[i]:.4g}; ask for a slower one"
            )
    return said


def find_unweighted_limits(asked: DesignTask, data: Episodes) -> list[str]:
    """Return a sentence for each limited state that the cost does not weigh."""
    of = asked.cost.of.bind(data.states)
    if not isinstance(of, State):
        return []
    weighed = _weighted_references(asked, data)
    box = asked.limits.states(data.nx)
    idle = [i for i in range(data.nx) if i not in weighed and (np.isfinite(box.low[i]) or np.isfinite(box.high[i]))]
    if not idle:
        return []
    names = ", ".join(strip_unit(data.states[i]) for i in idle)
    return [
        f"{names} {'has' if len(idle) == 1 else 'have'} limits and no weight in Q: only the limit itself keeps the "
        "loop away from it; a small weight would make it keep a distance"
    ]


def _weighted_references(asked: DesignTask, data: Episodes) -> dict[int, Float[np.ndarray, " T1"]]:
    """Return the reference rows of each state that the cost weighs; none for a cost on other observables."""
    of = asked.cost.of.bind(data.states)
    if not isinstance(of, State):
        return {}
    Q, _ = asked.cost.matrices(of.nz, data.nu)
    return {int(i): asked.reference[:, column] for column, i in enumerate(of.state_indices) if Q[column, column] > 0}


def _first_states(data: Episodes, limits: Limits) -> Float[np.ndarray, "n nx"]:
    """Return the first states of episodes, those inside the limits alone where there are four or more."""
    points = np.unique(np.array([episode.X[0] for episode in data]), axis=0)
    low, high = limits.states(data.nx)
    inside = points[((points >= low) & (points <= high)).all(axis=1)]
    return inside if len(inside) >= _FEW else points


def _rows_along(data: Episodes, limits: Limits) -> Float[np.ndarray, "n nx"]:
    """Return states spread evenly over all steps of the episodes, those inside the limits."""
    rows = np.concatenate([episode.X for episode in data])
    low, high = limits.states(data.nx)
    inside = rows[((rows >= low) & (rows <= high)).all(axis=1)]
    return inside[:: -(-len(inside) // _ROWS) or 1]


def _choose_spread(points: Float[np.ndarray, "n nx"]) -> Float[np.ndarray, "m nx"]:
    """Return a few of the points: of the half nearest to their median, far from each other."""
    size = np.ptp(points, axis=0)
    Z = (points - np.median(points, axis=0)) / np.where(size > 0, size, 1.0)
    central = np.argsort((Z**2).sum(axis=1), kind="stable")[: max(-(-len(Z) // 2), min(_FEW, len(Z)))]
    picked = [int(central[-1])]
    while len(picked) < min(STARTS, len(central)):
        apart = np.min([((Z[central] - Z[i]) ** 2).sum(axis=1) for i in picked], axis=0)
        picked.append(int(central[apart.argmax()]))
    return points[picked]
