"""Controllers compared on the same fresh loops: finalists, ends of plans, longer horizons."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.special import bdtr

from koopmpc.base.errors import DataError, KoopmpcError, hide_fit_warnings
from koopmpc.base.text import to_percent
from koopmpc.codegen.compiled import Compiled
from koopmpc.control.ask.limits import Limits
from koopmpc.control.ask.terminal import TerminalSet
from koopmpc.data.episodes import Episodes
from koopmpc.lifting.state import Constant, State
from koopmpc.models.fits.edmd import edmd
from koopmpc.models.predictors import LinearPredictor
from koopmpc.synthesis.choice import CHOICE, DesignRow
from koopmpc.synthesis.loops.abreast import speed_up
from koopmpc.synthesis.loops.fresh import DRAWN, draw_corners
from koopmpc.synthesis.loops.judging import LITTLE
from koopmpc.synthesis.loops.pool import LoopPool, LoopResult
from koopmpc.synthesis.rates import KEPT
from koopmpc.synthesis.search.recipe import Designed, Recipe, get_model
from koopmpc.validate.scoring import AnyPredictor


@dataclass(frozen=True)
class Comparison:
    """How many loops compare controllers, and by what one of them is better."""

    loops: int = 60  # fresh loops in which horizons, or finalists, are compared in machine code
    loops_in_python: int = 12  # and in Python
    finalists: int = 3  # rows beside the chosen one whose controllers run many fresh loops
    further: int = 240  # further loops of the last two finalists
    different: float = 0.05  # share of the loops by which one of two controllers must keep more
    chance: float = 0.05  # and probability that this is chance
    cheaper: float = 0.98  # a finalist that costs this share of the chosen one takes its place
    much: float = 0.9  # a horizon that costs this share of the given one is much better
    ahead: int = 40  # steps after the end of a plan in which limits are to be kept
    acting: float = 0.9  # share of an input's way to its limit that is trusted to stop a motion


COMPARISON = Comparison()


def watch_data(recipe: Recipe, model: AnyPredictor, controller: Designed, data: Episodes) -> Designed:
    """Return a new controller with a monitor of the data; if these have too few rows, the old one after a reset."""
    try:
        return recipe.controller(model, controller.cost, controller.limits, controller.horizon, monitor=data)
    except DataError:
        controller.reset()
        return controller


def find_room_to_stop(
    pool: LoopPool, recipe: Recipe, controller: Designed, data: Episodes, rng: np.random.Generator
) -> tuple[Limits, str]:
    """Return the limits of a controller, with an end of its plans if these are too short to stop, and why; "" if not.

    If a twentieth of the fresh loops break limits, plans have to end where an affine model of the data can
    still keep them, see `find_stopping_set`. That stays if the same loops prefer it, see `is_preferable`.
    """
    limits, near = controller.limits, pool.neighbours
    low, high = limits.states(len(pool.task.low))
    if limits.terminal is not None or near is None or data.nw or not np.isfinite(np.stack([low, high])).any():
        return limits, ""
    fast = speed_up(controller)
    drawn = pool.draw(COMPARISON.loops if isinstance(fast, Compiled) else COMPARISON.loops_in_python, rng)
    given = pool.run(fast, drawn)
    X = near.points[((near.points >= low) & (near.points <= high)).all(axis=1)]
    if _count_broken(given) < COMPARISON.different * len(given) or not len(X):
        return limits, ""
    with hide_fit_warnings():
        model = edmd(data, State() + Constant())
    ends = find_stopping_set(model, pool.task.limits, near.middle, X[:: -(-len(X) // DRAWN)])
    if ends is None:
        return limits, ""
    kept = replace(limits, terminal=ends)
    try:
        other = recipe.controller(get_model(controller), pool.task.cost, kept, controller.horizon)
    except KoopmpcError:  # the model's states are others
        return limits, ""
    stopped = pool.run(speed_up(other), drawn)
    if not is_preferable(stopped, given, COMPARISON.much):
        return limits, ""
    broken = [_count_broken(one) for one in (given, stopped)]
    return kept, (
        f"plans of {controller.horizon} steps are too short to stop before a limit, so they have to end where it can "
        f"be kept: of {len(given)} fresh loops {broken[1]} violate limits by more than {to_percent(KEPT)} of their "
        f"range in place of {broken[0]}, and they cost {_compare_costs(stopped, given)[0]:.3g} times as much"
    )


def find_stopping_set(
    model: LinearPredictor, limits: Limits, middle: Float[np.ndarray, " nu"], points: Float[np.ndarray, "n nx"]
) -> TerminalSet | None:
    """Return where a plan has to end so that limits of states can be kept afterwards; None where it may end anywhere.

    For each limit c x ≤ b of a state and each k ≤ 40 the set has a row c x_k ≤ b under those inputs that make c x_k
    least. So it leaves out only what no input can keep inside, if the plant is the `model`. Inputs are trusted with
    nine tenths of their way from `middle` to their limits.
    """
    nx = model.nx
    bounds = np.stack([-limits.states(nx).low, limits.states(nx).high])
    u_low, u_high = (middle + COMPARISON.acting * (each - middle) for each in limits.inputs(model.nu))
    zero, *ones = model.lifting(np.vstack([np.zeros(nx), np.eye(nx)]))
    S = np.column_stack([one - zero for one in ones])
    H, h = list[Float[np.ndarray, " nx"]](), list[float]()
    for way, i in np.argwhere(np.isfinite(bounds)).tolist():
        row, least = (-1.0, 1.0)[way] * model.C[i], 0.0
        for _ in range(COMPARISON.ahead):
            effect = row @ model.B
            reach = np.where(effect > 0, u_low, u_high)[effect != 0]
            row, least = row @ model.A, least + float(effect[effect != 0] @ reach)
            if not (np.isfinite(least) and np.isfinite(row).all()):
                break
            H.append(row @ S)
            h.append(float(bounds[way, i]) - least - float(row @ zero))
    if not H:
        return None
    rows, ends, low, high = np.array(H), np.array(h), points.min(axis=0), points.max(axis=0)
    room = ((ends - points @ rows.T) / np.maximum(np.abs(rows) @ (high - low), 1e-300)).min(axis=1)
    center = points[int(room.argmax())]
    if room.max() <= 0:
        return None
    rows = rows / (ends - rows @ center)[:, None]
    most: Float[np.ndarray, "p nx"] = np.maximum(rows * (low - center), rows * (high - center))
    rows = rows[most.sum(axis=1) > 1]
    return TerminalSet(center, of=State(), H=rows, h=np.ones(len(rows))) if len(rows) else None


def compare_longer_horizon(
    pool: LoopPool, recipe: Recipe, controller: Designed, fast: Any, rng: np.random.Generator
) -> list[str]:
    """Return a sentence if a horizon twice as long is much better, or keeps limits that the given one breaks.

    All horizons run the same loops, from fresh starts and from the corners of the goal's range; `fast` is the
    controller as `speed_up` returns it. Where twice as long is better, four times is tried, and told if better still.
    """
    N, drawn = (
        controller.horizon,
        pool.draw(COMPARISON.loops if isinstance(fast, Compiled) else COMPARISON.loops_in_python, rng),
    )
    drawn += draw_corners(pool.task, rng)

    def run(horizon: int) -> list[LoopResult]:
        one = recipe.controller(get_model(controller), controller.cost, controller.limits, horizon)
        return pool.run(fast if horizon == N else speed_up(one), drawn)

    given, twice = run(N), run(2 * N)
    if not is_preferable(twice, given, COMPARISON.much):
        return []
    lost, broken = ([count_loops(one) for one in (given, twice)] for count_loops in (_count_lost, _count_broken))
    said = (
        f"a horizon of {2 * N} steps in place of {N} costs {_compare_costs(twice, given)[0]:.3g} times as much; of "
        f"{len(given)} loops {broken[1]} violate limits by more than {to_percent(KEPT)} of their range in place of "
        f"{broken[0]}, and {lost[1]} are lost in place of {lost[0]}: take it if a step has the time"
    )
    if is_preferable(longer := run(4 * N), twice, COMPARISON.much):
        said += (
            f"; {4 * N} steps cost {_compare_costs(longer, given)[0]:.3g} times as much, {_count_broken(longer)} "
            f"violate, and {_count_lost(longer)} are lost"
        )
    return [said]


def list_finalists(rows: Sequence[DesignRow], best: int) -> list[int]:
    """Return up to three rows with other models whose scores are within 3 % of the best and that lose no more runs.

    They have the estimator of the chosen row, for stand-ins underrate what an estimator corrects: see `choose_row`.
    """
    chosen, least, found = rows[best], min(row.score for row in rows if row.off), list[int]()
    known = [chosen.recipe.candidate]
    for i, row in enumerate(rows):
        one = row.recipe
        other = row.off and one.candidate not in known and one.estimator == chosen.recipe.estimator
        if other and row.score <= (1 + CHOICE.unsure) * least and row.lost <= chosen.lost:
            known.append(one.candidate)
            found.append(i)
    return found[: COMPARISON.finalists]


def choose_finalist(pool: LoopPool, finalists: Sequence[Designed], rng: np.random.Generator) -> tuple[int, int, str]:
    """Return the place of the finalist that fresh loops prefer, how many loops ran, and why if it is not the first.

    All run the same 60 loops, and the first and the best of the others 240 more. The first stays unless the other is
    safer, or costs 2 % less and by three standard errors, see `is_preferable`. Those without machine code are left out.
    """
    fast = [speed_up(one) for one in finalists]
    places = [i for i, one in enumerate(fast) if isinstance(one, Compiled)]
    if len(places) < 2 or places[0] != 0:
        return 0, 0, ""
    drawn = pool.draw(COMPARISON.loops, rng)
    results = {i: pool.run(fast[i], drawn) for i in places}

    def rank(i: int) -> tuple[float, ...]:
        return _count_lost(results[i]), _count_broken(results[i]), _compare_costs(results[i], results[0])[0]

    other = min(places[1:], key=rank)
    more, loops = pool.draw(COMPARISON.further, rng), len(places) * COMPARISON.loops + 2 * COMPARISON.further
    first, second = (results[i] + pool.run(fast[i], more) for i in (0, other))
    if not is_preferable(second, first, COMPARISON.cheaper):
        return 0, loops, ""
    lost, broken = ([count_loops(one) for one in (first, second)] for count_loops in (_count_lost, _count_broken))
    return (
        other,
        loops,
        f"of {len(first)} fresh loops {lost[1]} are lost in place of {lost[0]}, {broken[1]} violate limits by more "
        f"than {to_percent(KEPT)} of their range in place of {broken[0]}, and they cost "
        f"{_compare_costs(second, first)[0]:.3g} times as much",
    )


def is_preferable(one: Sequence[LoopResult], other: Sequence[LoopResult], cheaper: float) -> bool:
    """Return whether of the same loops one controller loses fewer or keeps more limits, or else costs less.

    Loops that one of the two alone loses, or keeps, decide: a twentieth of all, and more than the toss of a coin
    explains in one case of twenty. A cost is less by a factor `cheaper` and by three standard errors.
    """
    for fails in (_is_lost, _is_broken):
        mine, others = (np.array([fails(result) for result in each]) for each in (one, other))
        worse, better = int(np.sum(mine & ~others)), int(np.sum(others & ~mine))
        few, many = sorted((worse, better))
        if many - few >= COMPARISON.different * len(mine) and bdtr(few, few + many, 0.5) <= COMPARISON.chance:
            return better > worse
    change, error = _compare_costs(one, other)
    return change < cheaper and bool(np.log(change) < -3 * error)


def _compare_costs(one: Sequence[LoopResult], other: Sequence[LoopResult]) -> tuple[float, float]:
    """Return the geometric mean of cost ratios of loops that neither lost, and the standard error of its logarithm."""
    mine, others = (np.array([result.cost for result in each]) for each in (one, other))
    both = np.isfinite(mine) & np.isfinite(others)
    if not both.any():
        return 1.0, 0.0
    little = LITTLE * float(np.median(others[both]))
    ratio = np.log((mine[both] + little) / (others[both] + little))
    return float(np.exp(ratio.mean())), float(ratio.std() / np.sqrt(len(ratio)))


def _is_lost(result: LoopResult) -> bool:
    return not np.isfinite(result.cost)


def _is_broken(result: LoopResult) -> bool:
    return result.violation > KEPT


def _count_lost(results: Sequence[LoopResult]) -> int:
    return sum(map(_is_lost, results))


def _count_broken(results: Sequence[LoopResult]) -> int:
    return sum(map(_is_broken, results))
