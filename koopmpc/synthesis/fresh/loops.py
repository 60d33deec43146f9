"""run_fresh_loops: the loops of a chosen controller from fresh starts, and where they are outside the data."""

from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from koopmpc.data.angles import find_angles
from koopmpc.data.episodes import Episodes
from koopmpc.errors import DataError
from koopmpc.lifting.base import strip_unit
from koopmpc.lifting.state import State
from koopmpc.loop.metrics import metrics, violation_shares
from koopmpc.plants.plant import Transition
from koopmpc.synthesis.asked import DesignTask
from koopmpc.synthesis.candidates import Designed, Recipe
from koopmpc.synthesis.designed import BREAKS
from koopmpc.synthesis.fresh.neighbours import NeighbourMap, goal_box, probe_range
from koopmpc.synthesis.fresh.verdict import FreshLoops
from koopmpc.synthesis.judging import LITTLE, Condition, LoopTest, run_on_surrogate
from koopmpc.synthesis.surrogates import Surrogate
from koopmpc.text import to_percent
from koopmpc.validate.scoring import AnyPredictor

NEIGHBOURS = 2  # so many loops of OF in a row are on nearest neighbours, the others on learned models
OF = 3  # see NEIGHBOURS
SHIFT = 0.05  # a fresh start is a start of the task moved by up to this share of the data's range
GAIN = 0.1  # in fresh loops inputs act by up to this share more or less
CORNERS = 8  # corners of the goal's range from which loops run, at most
COMPARED = 12  # fresh loops in which two horizons are compared
MUCH = 0.9  # a horizon that costs this share of the given one is much better
DRAWN = 400  # states outside the data that are kept for a picture, at most
BLIND_RANGE = 0.3  # share of them outside the data above which a design says so
BLIND = 0.05  # share of steps outside the data above which a design says where they are

Row = tuple[float, float, float]  # cost, violation, share of the steps outside the data


def draw_starts(asked: DesignTask, count: int, rng: np.random.Generator) -> Float[np.ndarray, "n nx"]:
    """Return starts of the task, drawn at random, each moved a little inside the data's range and the limits."""
    pool = np.unique(np.concatenate([asked.starts, asked.first_states]), axis=0)
    if not any((asked.starts[0] == first).all() for first in asked.first_states):
        pool = asked.starts  # the user has named them
    picked = pool[rng.integers(len(pool), size=count)]
    low, high = goal_box(asked)
    moved = picked + SHIFT * (asked.high - asked.low) * rng.uniform(-1, 1, picked.shape)
    return np.clip(moved, np.minimum(low, picked), np.maximum(high, picked))


def run_fresh_loops(
    test: LoopTest,
    controller: Designed,
    neighbours: NeighbourMap,
    loops: int,
    rng: np.random.Generator,
    *,
    stretch: int = 1,
) -> tuple[FreshLoops, list[str]]:
    """Return the loops, and a sentence if many of their steps are outside the data.

    With a constant reference they take `stretch` times the steps of the task.

    Each loop on nearest neighbours draws one bootstrap sample of the episodes and keeps it. The others are on the
    learned surrogates in turn. Loops from the corners of the goal's range are on nearest neighbours.
    """
    asked, nominal = test.asked, [test.conditions[i] for i in test.nominal]
    still = not asked.moves and stretch > 1
    outside: list[tuple[Float[np.ndarray, "k nx"], Float[np.ndarray, "k nx"]]] = []

    def run(one: Condition, x0: Float[np.ndarray, " nx"], gain: float, on_rows: bool, seed: int) -> Row:
        stand_in: Surrogate | NeighbourMap = neighbours if on_rows else test.surrogates[one.surrogate]
        plant: Transition = neighbours.draw(np.random.default_rng(seed), gain) if on_rows else test.plant(one)
        rows = asked.reference[one.first : one.first + asked.steps + 1]
        done = run_on_surrogate(
            asked,
            stand_in,
            plant,
            controller,
            x0,
            box=(test.low, test.high),
            reference=np.repeat(rows, stretch, axis=0)[: stretch * asked.steps + 1] if still else rows,
            u_reference=np.repeat(one.u_reference, stretch, axis=0) if still else one.u_reference,
            rng=seed,
        )
        if done is None:
            return (
                np.inf,
                np.inf,
                float(neighbours.find_outside(neighbours.start(x0)[None], neighbours.middle[None])[0]),
            )
        share = 0.0
        if neighbours.embedding is None:
            away = neighbours.find_outside(done.X[:-1], done.U)
            share = float(away.mean())
            outside.append((done.X[:-1][away], done.X[:-1][:1]))
        over = violation_shares(done, asked.limit_sizes)[1:]
        return metrics(done).cost, float(over.max(initial=0.0)), share

    starts = draw_starts(asked, loops, rng)
    kinds = ["neighbours" if i % OF < NEIGHBOURS else "models" for i in range(loops)]
    places: Int[np.ndarray, " loops"] = rng.integers(len(nominal), size=loops)
    gains = 1 + GAIN * rng.uniform(-1, 1, loops)
    seeds = rng.integers(2**31, size=loops + CORNERS)
    results = [
        run(nominal[int(places[i])], starts[i], float(gains[i]), kinds[i] == "neighbours", int(seeds[i]))
        for i in range(loops)
    ]
    corners = _list_corners(asked, rng)
    edges = [run(nominal[0], x0, 1.0, True, int(seeds[loops + i])) for i, x0 in enumerate(corners)]
    cost, violation, share = np.array(results).reshape(-1, 3).T
    corner_cost, corner_violation, corner_share = np.array(edges).reshape(-1, 3).T
    away = np.concatenate([np.zeros((0, test.episodes.nx)), *(states for states, _ in outside)])
    away = away[:: -(-len(away) // DRAWN) or 1]
    fresh = FreshLoops(cost, violation, share, tuple(kinds), corner_cost, corner_violation, corner_share, away)
    return fresh, _describe_outside(test.episodes, asked, neighbours, fresh, outside[: len(results)])


def find_blind_range(data: Episodes, asked: DesignTask, neighbours: NeighbourMap) -> list[str]:
    """Return a sentence if much of the goal's range has no data around it: each signal is inside, but not together."""
    kept = [i for i in range(data.nx) if i not in neighbours.ignored]
    if neighbours.embedding is not None or len(kept) < 2:
        return []
    X, away = probe_range(asked, neighbours)
    share = float(away.mean())
    if share <= BLIND_RANGE:
        return []
    low, high = goal_box(asked)
    size = np.where(high > low, high - low, 1.0)
    distance, _ = neighbours.tree.query(neighbours.scale_states(X))
    place = int(np.argmax(np.where(away, distance, 0.0)))
    rows = np.concatenate([episode.X for episode in data])
    apart = np.abs(rows - X[place])[:, kept] / size[kept]
    far = np.argsort(-apart[int(np.argmin((apart**2).sum(axis=1)))], kind="stable")[:2]
    named = sorted(kept[int(i)] for i in far)
    shown = ", ".join(f"{strip_unit(data.states[i])} = {X[place, i]:.3g}" for i in named)
    return [
        f"{to_percent(share)} of the goal's range, which is what limits and ranges of the signals allow, has no data "
        f"around it, such as {shown} at the same time: from there the controller guesses, and its moves say "
        "known = False; record episodes that start there (design.starts_to_record()), or run design.guarded()"
    ]


def _list_corners(asked: DesignTask, rng: np.random.Generator) -> Float[np.ndarray, "corners nx"]:
    """Return corners of the goal's range, some of them where there are many."""
    low, high = goal_box(asked)
    if len(low) <= 3:
        return np.array([np.where(way, high, low) for way in product((False, True), repeat=len(low))])
    return np.where(rng.uniform(size=(CORNERS, len(low))) < 0.5, low, high)


def _describe_outside(
    data: Episodes,
    asked: DesignTask,
    neighbours: NeighbourMap,
    fresh: FreshLoops,
    outside: Sequence[tuple[Float[np.ndarray, "k nx"], Float[np.ndarray, "1 nx"]]],
) -> list[str]:
    """Return one sentence that says where the loops are outside the data, and what to record."""
    share = float(fresh.outside.mean()) if len(fresh.outside) else 0.0
    points = [away for away, _ in outside if len(away)]
    if share <= BLIND or not points:
        return []
    X = np.concatenate(points)
    size = np.where(asked.high > asked.low, asked.high - asked.low, 1.0)
    center = np.median(X, axis=0)
    spread = np.ptp(np.concatenate([X, X[:1]]), axis=0) / size
    named = np.argsort(spread, kind="stable")[: min(2, data.nx)]
    places = ", ".join(f"{strip_unit(data.states[i])} near {center[i]:.3g}" for i in sorted(map(int, named)))
    begun = sum(bool(len(away)) and bool((away[0] == first[0]).all()) for away, first in outside)
    return [
        f"{to_percent(share)} of the steps of fresh loops lie outside the data, most of them with {places}; "
        f"{begun} of {len(outside)} loops begin there: record episodes that start and pass there, with inputs like "
        "those of the loop"
    ]


def find_blind_reference(
    data: Episodes, asked: DesignTask, neighbours: NeighbourMap, u_held: Float[np.ndarray, "T nu"]
) -> list[str]:
    """Return a sentence if a reference of the whole state lies outside the data though each of its values is inside."""
    of = asked.cost.of.bind(data.states)
    whole = isinstance(of, State) and sorted(of.state_indices) == list(range(data.nx))
    Q = np.diag(asked.cost.matrices(of.nz, data.nu)[0])
    if asked.moves or not whole or not isinstance(of, State) or (Q <= 0).any() or neighbours.embedding is not None:
        return []
    if find_angles(data.states, np.concatenate([e.X for e in data])):
        return []
    row = np.zeros(data.nx)
    row[list(of.state_indices)] = asked.reference[0]
    inside = ((row >= asked.low) & (row <= asked.high)).all()
    if not inside or not neighbours.find_outside(row[None], u_held[:1])[0]:
        return []
    return [
        "the reference lies outside the data, though each of its values is inside their range: no log has these values "
        "at the same time; record episodes that rest near it"
    ]


def watch_data(recipe: Recipe, model: AnyPredictor, controller: Designed, data: Episodes) -> Designed:
    """Return a new controller with a monitor of the data; if these have too few rows, the old one after a reset."""
    try:
        return recipe.controller(model, controller.cost, controller.limits, controller.horizon, monitor=data)
    except DataError:
        controller.reset()
        return controller


def compare_longer_horizon(
    test: LoopTest, recipe: Recipe, controller: Designed, neighbours: NeighbourMap, rng: np.random.Generator
) -> list[str]:
    """Return a sentence if a horizon twice as long is much better, or keeps limits that the given one breaks.

    Both controllers run the same loops: from fresh starts, and from the corners of the goal's range.
    """
    N, seed = controller.horizon, int(rng.integers(2**31))
    model: Any = getattr(controller, "predictor", None) or getattr(controller, "model", None)
    longer = recipe.controller(model, controller.cost, controller.limits, 2 * N)
    short, long = (
        run_fresh_loops(test, one, neighbours, COMPARED, np.random.default_rng(seed), stretch=2)[0]
        for one in (controller, longer)
    )
    costs = [np.concatenate([one.cost, one.corner_cost]) for one in (short, long)]
    over = [np.concatenate([one.violation, one.corner_violation]) for one in (short, long)]
    both = np.isfinite(costs[0]) & np.isfinite(costs[1])
    if not both.any():
        return []
    little = LITTLE * float(np.median(costs[0][both]))
    change = float(np.exp(np.mean(np.log((costs[1][both] + little) / (costs[0][both] + little)))))
    before, after = (int(np.sum(one > BREAKS)) for one in over)
    lost = [int(np.sum(~np.isfinite(one))) for one in costs]
    keeps = before > 1 and 2 * after <= before
    if not (keeps or change < MUCH or lost[1] < lost[0]):
        return []
    return [
        f"a horizon of {2 * N} steps in place of {N} costs {change:.3g} times as much; of {len(costs[0])} loops "
        f"{after} violate limits by more than {to_percent(BREAKS)} of their range in place of {before}, and "
        f"{lost[1]} are lost in place of {lost[0]}: take it if a step has the time"
    ]
