"""LoopPool: independent loops of a controller; each draws its surrogate, start, inputs, delay and noise."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.codegen.compiled import Compiled
from koopmpc.loop.metrics import total_cost, violation_shares
from koopmpc.loop.run import Run
from koopmpc.loop.simulate import LoopOptions
from koopmpc.plants.step_map import StepMap
from koopmpc.synthesis.loops.abreast import Acting, CrowdStep, run_abreast
from koopmpc.synthesis.loops.judging import Fenced, read_reference, run_on_surrogate
from koopmpc.synthesis.loops.neighbours import NeighbourMap
from koopmpc.synthesis.loops.surrogates import Surrogate
from koopmpc.synthesis.rates import KEPT, SHIFT
from koopmpc.synthesis.task import DesignTask, goal_box

NEIGHBOURS = 2 / 3  # share of the loops on nearest neighbours; the others are on learned models
GAIN = 0.1  # in fresh loops inputs act by up to this share more or less
LATE = 0.1  # and up to this share of a step late
ABREAST = 256  # loops that run side by side, at most: their controllers need about 0.1 MB each
NEARBY = 30  # rows of a record of which a start takes the nearest, with its past
_PLACES = 4  # a loop begins at one of so many places of a long reference


class DrawnLoop(NamedTuple):
    """One loop: where it starts, what stands in for the plant (−1 for nearest neighbours), and its other draws.

    `past` is ζ of that start as it was in the data, None where the loop starts after a rest.
    """

    x0: Float[np.ndarray, " nx"]
    place: int
    gain: float
    first: int
    seed: int
    late: float = 0.0
    past: Float[np.ndarray, " nzeta"] | None = None


class LoopResult(NamedTuple):
    """Cost and largest violation of a loop, as a share of the limit's range; both infinite where it was lost."""

    cost: float
    violation: float
    run: Run | None = None

    @property
    def keeps(self) -> bool:
        """Whether the loop was not lost and kept its limits."""
        return self.violation <= KEPT


def draw_starts(task: DesignTask, count: int, rng: np.random.Generator) -> Float[np.ndarray, "n nx"]:
    """Return starts of the task, drawn at random, each moved a little inside the data's range and the limits."""
    pool = np.unique(np.concatenate([task.starts, task.first_states]), axis=0)
    if not any((task.starts[0] == first).all() for first in task.first_states):
        pool = task.starts  # the user has named them
    picked = pool[rng.integers(len(pool), size=count)]
    low, high = goal_box(task)
    moved = picked + SHIFT * (task.high - task.low) * rng.uniform(-1, 1, picked.shape)
    return np.clip(moved, np.minimum(low, picked), np.maximum(high, picked))


@dataclass(frozen=True, eq=False)
class LoopPool:
    """The distribution of loops: two in three on bootstrapped nearest neighbours, the others on a learned model.

    Starts are those of the task, moved by up to 5 % of the data's range. Of a few records with an embedding they are
    rows of the data with their past, of thirty rows the nearest to such a start. Inputs act by up to 10 % more or
    less, and up to a tenth of a step late. A loop is lost if it leaves the box from `low` to `high`.
    """

    task: DesignTask
    surrogates: tuple[Surrogate, ...]
    neighbours: NeighbourMap | None
    low: Float[np.ndarray, " nx"]
    high: Float[np.ndarray, " nx"]
    _plants: dict[tuple[int, bool], StepMap] = field(default_factory=dict[tuple[int, bool], StepMap])
    _inputs: dict[int, Float[np.ndarray, "T nu"]] = field(default_factory=dict[int, Any])

    def draw(self, count: int, rng: np.random.Generator) -> list[DrawnLoop]:
        """Return independent loops."""
        starts, many = draw_starts(self.task, count, rng), len(self.surrogates)
        places = rng.integers(many, size=count)
        if self.neighbours is not None:
            places = np.where(rng.uniform(size=count) < NEIGHBOURS, -1, places)
        gains = 1 + GAIN * rng.uniform(-1, 1, count)
        firsts = self.task.late * rng.integers(_PLACES, size=count) // (_PLACES - 1)
        seeds = rng.integers(2**31, size=count)
        late = LATE * rng.uniform(size=count)
        loops = [
            DrawnLoop(starts[i], int(places[i]), float(gains[i]), int(firsts[i]), int(seeds[i]), float(late[i]))
            for i in range(count)
        ]
        near = self.neighbours
        if near is None or near.embedding is None or not self.task.along:
            return loops
        nx, size = starts.shape[1], np.maximum(self.task.high - self.task.low, 1e-300)
        some = rng.integers(len(near.pasts), size=(count, NEARBY))
        apart = ((near.pasts[some, :nx] - starts[:, None]) / size) ** 2
        pasts = near.pasts[some[np.arange(count), apart.sum(axis=2).argmin(axis=1)]]
        return [loop._replace(x0=past[:nx], past=past) for loop, past in zip(loops, pasts, strict=True)]

    def run(self, controller: Any, loops: Sequence[DrawnLoop]) -> list[LoopResult]:
        """Return what became of these loops, those of a controller in machine code side by side."""
        results: list[LoopResult] = [LoopResult(np.inf, np.inf)] * len(loops)
        for place in sorted({loop.place for loop in loops}):
            own = [i for i, loop in enumerate(loops) if loop.place == place]
            for first in range(0, len(own), ABREAST):
                some = own[first : first + ABREAST]
                for i, run in zip(some, self._run_place(controller, [loops[i] for i in some]), strict=True):
                    results[i] = self._judge(run)
        return results

    def _judge(self, run: Run | None) -> LoopResult:
        if run is None:
            return LoopResult(np.inf, np.inf)
        cost, over = total_cost(run), float(violation_shares(run, self.task.limit_sizes)[1:].max(initial=0.0))
        return LoopResult(cost, over, run) if np.isfinite(cost) else LoopResult(np.inf, np.inf)

    def _run_place(self, controller: Any, loops: Sequence[DrawnLoop]) -> list[Run | None]:
        """Return the runs of loops that have one stand-in in common."""
        task, place, box = self.task, loops[0].place, (self.low, self.high)
        near = self.neighbours if place < 0 else None
        stand_in: Surrogate | NeighbourMap = self.surrogates[max(place, 0)] if near is None else near
        starts = [self._find_start(loop, stand_in) for loop in loops]
        rows, held = zip(*(self._find_rows(loop, controller.horizon) for loop in loops), strict=True)
        acting = Acting(stand_in.middle, np.array([one.gain for one in loops]), np.array([one.late for one in loops]))
        if isinstance(controller, Compiled):
            seeds = [loop.seed for loop in loops]
            draws = [np.random.default_rng(seed) for seed in seeds]
            step = self._step_model(place) if near is None else near.draw_many(draws).step
            return run_abreast(
                task, controller, stand_in, step, acting, starts, seeds, np.array(rows), np.array(held), box
            )
        return [
            run_on_surrogate(
                task,
                stand_in,
                Fenced(
                    self._find_model(place) if near is None else near.draw(np.random.default_rng(loop.seed)),
                    *box,
                    acting.take(i),
                ),
                controller,
                starts[i],
                reference=rows[i],
                u_reference=held[i],
                options=LoopOptions(noise=stand_in.noise, rng=loop.seed),
            )
            for i, loop in enumerate(loops)
        ]

    def _find_start(self, loop: DrawnLoop, stand_in: Surrogate | NeighbourMap) -> Float[np.ndarray, " n"]:
        """Return ζ of a start, with its past where the stand-in has the same embedding as the rows of the data."""
        near = self.neighbours
        embedding = stand_in.embedding if isinstance(stand_in, NeighbourMap) else stand_in.model.embedding
        rests = loop.past is None or near is None or embedding != near.embedding
        return stand_in.start(loop.x0) if rests or loop.past is None else loop.past

    def _find_rows(self, loop: DrawnLoop, ahead: int) -> tuple[Float[np.ndarray, "rows nr"], Float[np.ndarray, "T nu"]]:
        """Return the reference of a loop, with so many rows that are only seen ahead, and the inputs without cost."""
        task, place = self.task, max(loop.place, 0)
        given = not isinstance(task.cost.u_target, str)  # by numbers, which count from the start of a loop
        if place not in self._inputs:
            every = task.reference[:-1] if task.moves or given else task.reference[:1]
            self._inputs[place] = self.surrogates[place].find_reference_inputs(task.cost, task.limits, every)
        at = np.minimum(loop.first + np.arange(task.steps), len(task.reference) - 1)
        held = self._inputs[place]
        rows = read_reference(task, loop.first, task.steps + 1 + ahead)
        return rows, held[np.minimum(at - given * loop.first, len(held) - 1)]

    def _find_model(self, place: int, *, reads: bool = True) -> StepMap:
        """Return a learned model as a plant; each is built once."""
        key = place, reads and self.surrogates[place].feedthrough
        if key not in self._plants:
            self._plants[key] = self.surrogates[place].plant(reads=reads)
        return self._plants[key]

    def _step_model(self, place: int) -> CrowdStep:
        plant = self._find_model(max(place, 0), reads=False)
        return lambda Z, U, which: plant.rollouts(Z, U[:, None])[:, 1]
