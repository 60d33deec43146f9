"""Doubts about a task, in sentences: episodes that went astray, references and starts where no data are, limits."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from koopmpc.base.text import with_unit
from koopmpc.control.ask.limits import Limits
from koopmpc.control.nonlinear.equilibrium import Equilibrium
from koopmpc.data.episodes import Episodes
from koopmpc.lifting.base import strip_unit
from koopmpc.lifting.state import State
from koopmpc.loop.metrics import stack_limited
from koopmpc.synthesis.loops.surrogates import Surrogate
from koopmpc.synthesis.task import LENGTHS, DesignTask

FAR = 1.0  # an episode is left out if it leaves the box of the others by more than this many widths
MOST = 0.9  # share of the episodes inside this box


def limit_margins(task: DesignTask, data: Episodes) -> Float[np.ndarray, " nx"]:
    """Return the largest margin of each state (nx,): half of the way from the reference to the nearest limit.

    Without this bound, errors of a poor model could lead to margins that exclude the reference itself. A reference on
    or beyond a limit, or without a weight, bounds no margin.
    """
    low, high = task.limits.states(data.nx)
    room = np.full(data.nx, np.inf)
    for i, aims in _weighted_references(task, data).items():
        way = min(aims.min() - low[i], high[i] - aims.max())
        if way > 0:
            room[i] = way / 2
    return room


def find_stray_episodes(data: Episodes, task: DesignTask) -> dict[int, str]:
    """Return the episodes that went far away with ordinary inputs, each with a sentence that says how far.

    A sensor may have jumped, or the plant fallen over; the squares of such an episode outweigh all others in fits and
    in errors. An episode is far away if it leaves, by more than its width, the box of nine tenths of the episodes, the
    starts, the reference and the limits. Its inputs are ordinary if they stay within half a width of those of the
    others. Episodes with stronger inputs are kept, because they are valuable experiments.
    """
    low, high = task.limits.states(data.nx)
    low, high = np.where(np.isfinite(low), low, np.inf), np.where(np.isfinite(high), high, -np.inf)
    low, high = np.minimum(low, task.starts.min(axis=0)), np.maximum(high, task.starts.max(axis=0))
    for i, aims in _weighted_references(task, data).items():
        low[i], high[i] = min(low[i], aims.min()), max(high[i], aims.max())
    X, U = [episode.X for episode in data], [episode.U for episode in data]
    x_far, x_low, x_high = _measure_departures(X, low, high)
    u_far, _, _ = _measure_departures(U, np.full(data.nu, np.inf), np.full(data.nu, -np.inf))
    found: dict[int, str] = {}
    for k in np.flatnonzero((x_far.max(axis=1) > FAR) & (u_far.max(axis=1) <= LENGTHS.room)).tolist():
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


def find_outside_data(task: DesignTask, data: Episodes, tracked: Sequence[int], free: Sequence[int]) -> list[str]:
    """Return a sentence for each state whose start or reference lies outside the data, where no model was fitted."""
    said: list[str] = []
    room = 0.01 * (task.high - task.low)
    targets = {i: task.reference[:, column] for column, i in enumerate(tracked)}
    for i, name in enumerate(data.states):
        low, high = task.low[i], task.high[i]
        for what, values in (("a start", task.starts[:, i]), ("the reference", targets.get(i, np.zeros(0)))):
            far = values[(values < low - room[i]) | (values > high + room[i])]
            if far.size and i not in free:
                said.append(
                    f"{what} has {with_unit(name, f'= {far[np.abs(far - (low + high) / 2).argmax()]:.4g}')}, outside "
                    f"the data, which go from {low:.4g} to {high:.4g}: no model was fitted there; collect data there, "
                    "or ask for less"
                )
    return said


def find_outside_limits(task: DesignTask, data: Episodes) -> list[str]:
    """Return a sentence for each limit that a start or a moving reference lies beyond.

    A constant reference is not checked here; `explain_unreachable` says what can be held instead.
    """
    limits, states = task.limits, data.states
    names = states if limits.of is None else (*states, *limits.of.bind(states).names)
    starts, box = stack_limited(limits, task.starts, states)
    tracked = task.cost.of.bind(states).names
    targets = dict(zip(tracked, task.reference.T, strict=True)) if task.moves else {}
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


def find_poor_logs(task: DesignTask, data: Episodes, tracked: Sequence[int]) -> list[str]:
    """Return sentences where logs cannot serve: outside of all limits, from a single start, slower than the reference.

    A reference is too fast if half of the rows that move it move it by more than the logs move that state in any step.
    """
    X, said = [episode.X for episode in data], list[str]()
    least, most = (np.array([ends(one, axis=0) for one in X]) for ends in (np.min, np.max))
    for name, low, high, under, over in zip(
        data.states, least.min(axis=0), most.max(axis=0), *task.limits.states(data.nx), strict=True
    ):
        if low > over or high < under:
            said.append(
                f"the limits of {strip_unit(name)} allow {under:.4g} to {over:.4g}, and the data go from {low:.4g} to "
                f"{high:.4g}: no log was inside these limits; record some there, or widen the limits"
            )
    first = np.array([one[0] for one in X])
    if len(X) > 1 and (first == first[0]).all() and (task.starts == first[0]).all():
        shown = ", ".join(with_unit(name, f"= {value:.4g}") for name, value in zip(data.states, first[0], strict=True))
        said.append(
            f"all {len(X)} episodes start at {shown}: how the loop goes from elsewhere was tried on no such start; "
            "record episodes from other states, or pass starts="
        )
    steps = np.max([np.abs(np.diff(one, axis=0)).max(axis=0) for one in X], axis=0)
    for column, i in enumerate(tracked):
        moved = np.abs(np.diff(task.reference[:, column]))
        usual = float(np.median(moved[moved > 0])) if (moved > 0).sum() > LENGTHS.few else 0.0
        if usual > steps[i] and i in _weighted_references(task, data):
            said.append(
                f"no input can follow the reference: it moves {strip_unit(data.states[i])} by {usual:.4g} in a step, "
                f"and no log moves it by more than {steps[i]:.4g}; ask for a slower one"
            )
    return said


def find_unweighted_limits(task: DesignTask, data: Episodes) -> list[str]:
    """Return a sentence for each limited state that the cost does not weigh."""
    of = task.cost.of.bind(data.states)
    if not isinstance(of, State):
        return []
    weighed = _weighted_references(task, data)
    box = task.limits.states(data.nx)
    idle = [i for i in range(data.nx) if i not in weighed and (np.isfinite(box.low[i]) or np.isfinite(box.high[i]))]
    if not idle:
        return []
    names = ", ".join(strip_unit(data.states[i]) for i in idle)
    return [
        f"{names} {'has' if len(idle) == 1 else 'have'} limits and no weight in Q: only the limit itself keeps the "
        "loop away from it; a small weight would make it keep a distance"
    ]


def _weighted_references(task: DesignTask, data: Episodes) -> dict[int, Float[np.ndarray, " T1"]]:
    """Return the reference rows of each state that the cost weighs; none for a cost on other observables."""
    of = task.cost.of.bind(data.states)
    if not isinstance(of, State):
        return {}
    Q, _ = task.cost.matrices(of.nz, data.nu)
    return {int(i): task.reference[:, column] for column, i in enumerate(of.state_indices) if Q[column, column] > 0}


UNHELD = 0.02  # an equilibrium may miss the reference by this share of the data's range
HEADROOM = 0.1  # an input rests near a limit if less than this share of its range is left


def explain_unreachable(one: Surrogate, task: DesignTask) -> list[str]:
    """Return a sentence if no input holds a constant reference; it names the limit and the nearest equilibrium.

    Outputs without a weight in the cost are ignored, and so are deviations up to 2 % of the data's range, which may be
    errors of the surrogate.
    """
    if task.moves:
        return []
    model, row, cost = one.model, task.reference[0], task.cost
    of, nx = cost.of.bind(model.states), model.nx
    Q, _ = cost.matrices(of.nz, model.nu)
    ends = of(np.array([task.low, task.high]))
    tolerance = np.where(np.diag(Q) > 0, np.maximum(UNHELD * np.abs(ends[1] - ends[0]), 1e-9), np.inf)

    def is_missed(at: Equilibrium) -> bool:
        return bool((np.abs(of(at.x[:nx]) - row) > tolerance).any())

    def format_outputs(numbers: Float[np.ndarray, " nr"]) -> str:
        shown = np.where(np.abs(numbers) > 1e-3 * tolerance, numbers, 0.0)
        return ", ".join(with_unit(of.names[i], f"= {shown[i]:.4g}") for i in np.flatnonzero(np.isfinite(tolerance)))

    def list_broken(at: Equilibrium) -> list[str]:
        names, values = (*model.inputs, *model.states), np.concatenate([at.u, at.x[:nx]])
        off = np.concatenate([1e-6 * np.abs(at.u), UNHELD * (task.high - task.low)])
        low, high = np.hstack([task.limits.inputs(model.nu), task.limits.states(nx)])
        return [
            f"{with_unit(names[i], f'= {values[i] if abs(values[i]) > 1e-3 * off[i] else 0:.4g}')}, and its limit is "
            f"{low[i] if values[i] < low[i] else high[i]:.4g}"
            for i in np.flatnonzero(~((values >= low - off) & (values <= high + off)))
        ]

    inside = one.holding(cost, task.limits)(row)
    rests = not list_broken(inside)  # where no equilibrium is inside all limits, the search keeps those of inputs alone
    if rests and not is_missed(inside):
        return []
    free = one.holding(cost, Limits())(row)
    nearest = f"the nearest that can be held is {format_outputs(of(inside.x[:nx]))}"
    if not rests:
        nearest = "the plant rests nowhere inside these limits: widen them"
    if is_missed(free):
        return [
            f"no input holds {format_outputs(row)}: this is not an equilibrium of the plant as the data show it; "
            f"{nearest}"
        ]
    ways = list_broken(free) or list_broken(inside)
    if not ways and task.limits.of is None:
        return []
    needs = "; ".join(ways) if ways else "what the limits of its observables forbid"
    return [f"no input inside the limits holds {format_outputs(row)}: it needs {needs}; {nearest}"]


def describe_rest(surrogates: Sequence[Surrogate], task: DesignTask) -> str:
    """Return at which inputs a constant reference rests, in the median of surrogates, and which are near a limit."""
    row, names = task.reference[0], surrogates[0].inputs
    rest = np.median([one.holding(task.cost, task.limits)(row).u for one in surrogates], axis=0)
    values, near = list[str](), list[str]()
    for name, value, low, high in zip(names, rest, *task.limits.inputs(len(names)), strict=True):
        size = high - low
        if not np.isfinite(size):
            values.append(with_unit(name, f"= {value:.3g}"))
            continue
        shown = value if abs(value) > 1e-3 * size else 0.0
        values.append(f"{with_unit(name, f'= {shown:.3g}')} of {low:.4g} … {high:.4g}")
        for side, left in (("above", high - value), ("below", value - low)):
            if left < HEADROOM * size:
                near.append(f"{side} for {name.partition(' [')[0]}")
    room = f"; less than a tenth of the range is left {' and '.join(near)}: no headroom" if near else ""
    return f"the reference rests at {', '.join(values)}{room}"
