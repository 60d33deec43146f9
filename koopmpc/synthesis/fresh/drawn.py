"""LoopPool: independent loops of a controller on stand-ins; each draws its stand-in, start, input gain and noise."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.loop.metrics import metrics, violation_shares
from koopmpc.plants.plant import Transition
from koopmpc.synthesis.asked import DesignTask
from koopmpc.synthesis.fresh.loops import GAIN, NEIGHBOURS, OF, draw_starts
from koopmpc.synthesis.fresh.neighbours import NeighbourMap
from koopmpc.synthesis.judging import run_on_surrogate
from koopmpc.synthesis.surrogates import Surrogate

KEPT = 0.01  # a loop keeps its limits if it violates none by more than this share of its range
_PLACES = 4  # a loop begins at one of so many places of a long reference


class DrawnLoop(NamedTuple):
    """One loop: where it starts, what stands in for the plant (−1 for nearest neighbours), and its other draws."""

    x0: Float[np.ndarray, " nx"]
    place: int
    gain: float
    first: int
    seed: int


class LoopResult(NamedTuple):
    """Cost and largest violation of a loop, as a share of the limit's range; both infinite where it was lost."""

    cost: float
    violation: float

    @property
    def keeps(self) -> bool:
        """Whether the loop was not lost and kept its limits."""
        return self.violation <= KEPT


@dataclass(frozen=True, eq=False)
class LoopPool:
    """The distribution of loops: two in three on bootstrapped nearest neighbours, the others on a learned model.

    Starts are those of the task, moved by up to 5 % of the data's range. On nearest neighbours inputs act by up to
    10 % more or less. A loop is lost if it leaves the box from `low` to `high`.
    """

    asked: DesignTask
    surrogates: tuple[Surrogate, ...]
    neighbours: NeighbourMap | None
    low: Float[np.ndarray, " nx"]
    high: Float[np.ndarray, " nx"]
    _plants: dict[int, Transition] = field(default_factory=dict[int, Transition])
    _inputs: dict[tuple[int, int], Float[np.ndarray, "T nu"]] = field(default_factory=dict[tuple[int, int], Any])

    def draw(self, count: int, rng: np.random.Generator) -> list[DrawnLoop]:
        """Return independent loops."""
        starts, many = draw_starts(self.asked, count, rng), len(self.surrogates)
        places = rng.integers(many, size=count)
        if self.neighbours is not None:
            places = np.where(rng.uniform(size=count) < NEIGHBOURS / OF, -1, places)
        gains = 1 + GAIN * rng.uniform(-1, 1, count)
        firsts = self.asked.late * rng.integers(_PLACES, size=count) // (_PLACES - 1)
        seeds = rng.integers(2**31, size=count)
        return [
            DrawnLoop(starts[i], int(places[i]), float(gains[i]), int(firsts[i]), int(seeds[i])) for i in range(count)
        ]

    def run(self, controller: Any, loop: DrawnLoop) -> LoopResult:
        """Return what became of a loop."""
        asked, place, own = self.asked, loop.place, self.neighbours
        stand_in: Surrogate | NeighbourMap = self.surrogates[place]
        if place < 0 and own is not None:
            stand_in, plant = own, own.draw(np.random.default_rng(loop.seed), loop.gain)
        else:
            if place not in self._plants:
                self._plants[place] = self.surrogates[place].plant()
            plant = self._plants[place]
        rows = asked.reference[loop.first : loop.first + asked.steps + 1]
        key = max(place, 0), loop.first
        if key not in self._inputs:
            self._inputs[key] = self.surrogates[key[0]].find_reference_inputs(asked.cost, asked.limits, rows[:-1])
        done = run_on_surrogate(
            asked,
            stand_in,
            plant,
            controller,
            loop.x0,
            box=(self.low, self.high),
            reference=rows,
            u_reference=self._inputs[key],
            rng=loop.seed,
        )
        if done is None:
            return LoopResult(np.inf, np.inf)
        cost, over = metrics(done).cost, float(violation_shares(done, asked.limit_sizes)[1:].max(initial=0.0))
        return LoopResult(cost, over) if np.isfinite(cost) else LoopResult(np.inf, np.inf)
