"""prepare_test: the conditions under which candidates of a design are judged, and the surrogates that they control."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.base.parallel import Workers
from koopmpc.control.ask.limits import Limits
from koopmpc.data.angles import find_angles
from koopmpc.data.episodes import Episodes
from koopmpc.lifting.base import strip_unit
from koopmpc.lifting.state import State
from koopmpc.plants.step_map import StepMap
from koopmpc.synthesis.doubts import (
    explain_unreachable,
    find_outside_data,
    find_outside_limits,
    find_poor_logs,
    limit_margins,
)
from koopmpc.synthesis.loops.surrogates import Surrogate, find_ignored_states, fit_surrogate
from koopmpc.synthesis.search.folds import Folds, drop_fold, select_fold
from koopmpc.synthesis.search.recipe import Recipe
from koopmpc.synthesis.task import DesignTask

LESS = 0.5  # weight of a run with inputs 20 % off; other runs have weight 1


@dataclass(frozen=True, eq=False)
class Condition:
    """One run of a controller whose model was fitted without a fold."""

    fold: int  # the fold that the model does not know
    surrogate: int  # number of the surrogate that is controlled; it knows that fold
    gain: float  # factor on the effect of the inputs; 1 is as in the data
    x0: Float[np.ndarray, " nx"]  # (nx,) start
    first: int  # row of the reference at which the run begins
    # (T, nu) inputs without cost: those of the cost if it names them, else those that hold the reference on this
    # surrogate
    u_reference: Float[np.ndarray, "T nu"]


@dataclass(frozen=True, eq=False)
class LoopTest:
    """The task, the data in folds, the surrogates and the conditions of all runs.

    A run that leaves the box from `low` to `high` is lost. The margins of controllers to the limits are at most `room`
    (nx,); None for no margins. `noise` is the (nx,) standard deviation of the noise that a smoother took out of the
    data. `ignored` are states that nothing depends on, `turning` angles that make whole turns. Hidden states learn from
    `raw`, the episodes as they were measured; None where nothing was smoothed. `doubts` are sentences about the task;
    the goal `holds` if the reference is constant and an input inside the limits holds it.
    """

    task: DesignTask
    episodes: Episodes
    fold: tuple[int, ...]
    surrogates: tuple[Surrogate, ...]
    conditions: tuple[Condition, ...]
    low: Float[np.ndarray, " nx"]
    high: Float[np.ndarray, " nx"]
    room: Float[np.ndarray, " nx"] | None
    noise: Float[np.ndarray, " nx"]
    ignored: tuple[int, ...] = ()
    turning: tuple[int, ...] = ()
    raw: Episodes | None = None
    doubts: tuple[str, ...] = ()
    holds: bool = False

    def limits(self, band: Float[np.ndarray, "h nx"]) -> Limits:
        """Return the limits of a controller whose model has these errors."""
        if self.room is None:
            return self.task.limits
        width = np.where(np.isfinite(band), band, self.task.high - self.task.low)
        limits = self.task.limits.tightened(np.minimum(width, self.room), states=self.episodes.states)
        said = tuple(
            f"{strip_unit(self.episodes.states[i])}: the margin is {self.room[i]:.4g}, half way from the reference to "
            f"the limit, though the errors ask for up to {width[:, i].max():.4g}"
            for i in np.flatnonzero((np.asarray(limits.margin) == self.room).any(axis=0))
        )
        return replace(limits, capped=(*limits.capped, *said))

    @property
    def nominal(self) -> list[int]:
        """The conditions in which the inputs act as in the data."""
        return [i for i, condition in enumerate(self.conditions) if condition.gain == 1.0]

    @property
    def weights(self) -> Float[np.ndarray, " conditions"]:
        """The weight of each condition in a score; inputs as in the data weigh more."""
        return np.array([1.0 if one.gain == 1.0 else LESS for one in self.conditions])

    def plant(self, condition: Condition) -> StepMap:
        """Return the plant of a condition; each plant is built once in a process."""
        key = condition.surrogate, condition.gain
        if key not in self._plants:
            self._plants[key] = self.surrogates[condition.surrogate].plant(condition.gain)
        return self._plants[key]

    @cached_property
    def _plants(self) -> dict[tuple[int, float], StepMap]:
        return {}


FOLDS = 3  # folds of the data; models are fitted to two of them
OFF = 0.2  # in half of the final runs the inputs act by this share more or less
STRETCHES = 4  # runs start at this many places of a long reference
TURNS = 0.9 * 2 * np.pi  # [rad] an angle whose range in the data is larger makes whole turns


def prepare_test(
    folds: Folds,
    task: DesignTask,
    pair: Sequence[Recipe],
    tighten: bool,
    noise: Float[np.ndarray, " nx"],
    pool: Workers,
    raw: Episodes | None = None,
) -> LoopTest:
    """Return the conditions of all closed loops, with doubts about the task, and whether the goal can be held.

    For each fold and each family there is a surrogate that is fitted to the two other folds. A model that does not know
    fold k is tested on two surrogates, which do not know fold k + 1 and fold k + 2. Hidden states learn from the `raw`
    episodes.
    """
    data, wanted = folds.episodes, _list_conditions(task, folds.episodes.nu)
    mine = [[j for j, one in enumerate(wanted) if one.surrogate == number] for number in range(FOLDS * len(pair))]
    tasks = [
        _SurrogateTask(recipe, i, tuple((wanted[j].gain, wanted[j].first) for j in mine[i * len(pair) + family]))
        for i in range(FOLDS)
        for family, recipe in enumerate(pair)
    ]
    surrogates: list[Surrogate] = []
    conditions = list(wanted)
    for places, (one, inputs) in zip(mine, pool.map(partial(_fit_task, folds, task, noise), tasks), strict=True):
        surrogates.append(one)
        for j, rows in zip(places, inputs, strict=True):
            conditions[j] = replace(wanted[j], u_reference=rows)
    X = np.concatenate([episode.X for episode in data])
    turning = [i for i in find_angles(data.states, X) if task.high[i] - task.low[i] > TURNS]
    ignored = find_ignored_states(surrogates[0], X)
    turning = sorted({*task.angles, *turning} - {*ignored})
    free = sorted({*turning, *ignored})
    of = task.cost.of.bind(data.states)
    tracked = [int(i) for i in of.state_indices] if isinstance(of, State) else []
    low, high = task.hull(free, tracked)
    room = limit_margins(task, data) if tighten else None
    unreachable = explain_unreachable(surrogates[0], task)
    doubts = [*unreachable, *find_outside_limits(task, data), *find_outside_data(task, data, tracked, free)]
    return LoopTest(
        task=task,
        episodes=data,
        fold=folds.fold,
        surrogates=tuple(surrogates),
        conditions=tuple(conditions),
        low=low,
        high=high,
        room=room,
        noise=noise,
        ignored=tuple(ignored),
        turning=tuple(turning),
        raw=raw,
        doubts=(*doubts, *find_poor_logs(task, data, tracked)),
        holds=not task.moves and not unreachable,
    )


def _list_conditions(task: DesignTask, nu: int) -> list[Condition]:
    """Return the conditions of all runs, without the inputs that cost nothing."""
    wanted: list[Condition] = []
    for gain, families in ((1.0, (0, 1)), (1.0 + OFF, (1,)), (1.0 - OFF, (0,))):
        for k in range(FOLDS):
            for family in families:
                number, j = 2 * ((k + 1 + family) % FOLDS) + family, len(wanted)
                row = task.late * (j % STRETCHES) // (STRETCHES - 1)
                start = task.starts[j % len(task.starts)]
                wanted.append(Condition(k, number, gain, start, row, np.zeros((0, nu))))
    return wanted


class _SurrogateTask(NamedTuple):
    """A task: fit the surrogate of a recipe without a fold, for runs with (gain, first row of the reference)."""

    recipe: Recipe
    out: int
    runs: tuple[tuple[float, int], ...]


def _fit_task(
    folds: Folds, task: DesignTask, noise: Float[np.ndarray, " nx"], job: _SurrogateTask
) -> tuple[Surrogate, list[Float[np.ndarray, "T nu"]]]:
    """Return the surrogate and the `Condition.u_reference` of each run on it."""
    data, fold = folds.episodes, folds.fold
    one = fit_surrogate(job.recipe, drop_fold(data, fold, job.out), select_fold(data, fold, job.out), noise)
    cost, limits = task.cost, task.limits
    rows = [(gain, task.reference[first : first + task.steps]) for gain, first in job.runs]
    inputs = [one.find_reference_inputs(cost, limits, part, gain) for gain, part in rows]
    return one, inputs
