"""run_fresh_loops: the loops of a chosen controller from fresh starts, and where they are outside the data."""

from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc.base.text import to_percent
from koopmpc.data.angles import find_angles
from koopmpc.data.episodes import Episodes
from koopmpc.lifting.base import strip_unit
from koopmpc.lifting.state import State
from koopmpc.synthesis.loops.neighbours import NeighbourMap, probe_range
from koopmpc.synthesis.loops.pool import DrawnLoop, LoopPool
from koopmpc.synthesis.rates import FreshLoops
from koopmpc.synthesis.task import DesignTask, goal_box

CORNERS = 8  # corners of the goal's range from which loops run, at most
DRAWN = 400  # states outside the data that are kept for a picture, at most
BLIND_RANGE = 0.3  # share of them outside the data above which a design says so
BLIND = 0.05  # share of steps outside the data above which a design says where they are


def run_fresh_loops(pool: LoopPool, controller: Any, loops: int, rng: np.random.Generator) -> FreshLoops:
    """Return fresh loops, and loops from the corners of the goal's range, which are on nearest neighbours."""
    task, near = pool.task, pool.neighbours
    assert near is not None, "a design has nearest rows"
    drawn = pool.draw(loops, rng)
    corners = draw_corners(task, rng)
    results = pool.run(controller, [*drawn, *corners])
    share, away = np.zeros(len(results)), [np.zeros((0, len(task.low)))]
    begun = 0
    for i, (result, loop) in enumerate(zip(results, [*drawn, *corners], strict=True)):
        if result.run is None:
            share[i] = float(near.find_outside(near.start(loop.x0)[None], near.middle[None])[0])
        elif near.embedding is None:
            X, outside = result.run.X[:-1], near.find_outside(result.run.X[:-1], result.run.U)
            share[i], begun = outside.mean(), begun + bool(outside[0] and i < loops)
            away += [X[outside]]
    states = np.concatenate(away)
    cost, violation = (np.array([getattr(result, name) for result in results]) for name in ("cost", "violation"))
    return FreshLoops(
        cost=cost[:loops],
        violation=violation[:loops],
        outside=share[:loops],
        kinds=tuple(["neighbours" if loop.place < 0 else "models" for loop in drawn]),
        corner_cost=cost[loops:],
        corner_violation=violation[loops:],
        corner_outside=share[loops:],
        outside_states=states[:: -(-len(states) // DRAWN) or 1],
        begun_outside=begun,
    )


def find_blind_range(data: Episodes, task: DesignTask, neighbours: NeighbourMap) -> list[str]:
    """Return a sentence if much of the goal's range has no data around it: each signal is inside, but not together."""
    kept = [i for i in range(data.nx) if i not in neighbours.ignored]
    if neighbours.embedding is not None or len(kept) < 2:
        return []
    X, away = probe_range(task, neighbours)
    share = float(away.mean())
    if share <= BLIND_RANGE:
        return []
    low, high = goal_box(task)
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


def draw_corners(task: DesignTask, rng: np.random.Generator) -> list[DrawnLoop]:
    """Return loops from corners of the goal's range, some of them where there are many."""
    low, high = goal_box(task)
    if len(low) <= 3:
        corners = np.array([np.where(way, high, low) for way in product((False, True), repeat=len(low))])
    else:
        corners = np.where(rng.uniform(size=(CORNERS, len(low))) < 0.5, low, high)
    return [DrawnLoop(x0, -1, 1.0, 0, int(rng.integers(2**31))) for x0 in corners]


def describe_outside(data: Episodes, task: DesignTask, fresh: FreshLoops) -> list[str]:
    """Return one sentence that says where many steps of the loops are outside the data, and what to record."""
    share, X = float(fresh.outside.mean()) if len(fresh.outside) else 0.0, fresh.outside_states
    if share <= BLIND or not len(X):
        return []
    size = np.where(task.high > task.low, task.high - task.low, 1.0)
    center, spread = np.median(X, axis=0), np.ptp(X, axis=0) / size
    named = np.argsort(spread, kind="stable")[: min(2, data.nx)]
    places = ", ".join(f"{strip_unit(data.states[i])} near {center[i]:.3g}" for i in sorted(map(int, named)))
    return [
        f"{to_percent(share)} of the steps of fresh loops lie outside the data, most of them with {places}; "
        f"{fresh.begun_outside} of {len(fresh.outside)} loops begin there: record episodes that start and pass there, "
        "with inputs like those of the loop"
    ]


def find_blind_reference(
    data: Episodes, task: DesignTask, neighbours: NeighbourMap, u_held: Float[np.ndarray, "T nu"]
) -> list[str]:
    """Return a sentence if a reference of the whole state lies outside the data though each of its values is inside."""
    of = task.cost.of.bind(data.states)
    whole = isinstance(of, State) and sorted(of.state_indices) == list(range(data.nx))
    Q = np.diag(task.cost.matrices(of.nz, data.nu)[0])
    if task.moves or not whole or not isinstance(of, State) or (Q <= 0).any() or neighbours.embedding is not None:
        return []
    if find_angles(data.states, np.concatenate([e.X for e in data])):
        return []
    row = np.zeros(data.nx)
    row[list(of.state_indices)] = task.reference[0]
    inside = ((row >= task.low) & (row <= task.high)).all()
    if not inside or not neighbours.find_outside(row[None], u_held[:1])[0]:
        return []
    return [
        "the reference lies outside the data, though each of its values is inside their range: no log has these values "
        "at the same time; record episodes that rest near it (km.plot.blindness draws it)"
    ]
