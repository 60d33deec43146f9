"""prepare_test: the conditions under which candidates of a design are judged, and the surrogates that they control."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.data.angles import find_angles
from koopmpc.data.episodes import Episodes
from koopmpc.lifting.state import State
from koopmpc.parallel import Workers
from koopmpc.synthesis.asked import (
    DesignTask,
    find_outside_data,
    find_outside_limits,
    find_poor_logs,
    limit_margins,
)
from koopmpc.synthesis.candidates import Recipe
from koopmpc.synthesis.cross_validation import Folds, drop_fold, select_fold
from koopmpc.synthesis.judging import Condition, LoopTest
from koopmpc.synthesis.surrogates import Surrogate, explain_unreachable, find_ignored_states, fit_surrogate

FOLDS = 3  # folds of the data; models are fitted to two of them
OFF = 0.2  # in half of the final runs the inputs act by this share more or less
STRETCHES = 4  # runs start at this many places of a long reference
TURNS = 0.9 * 2 * np.pi  # [rad] an angle whose range in the data is larger makes whole turns


def prepare_test(
    folds: Folds,
    asked: DesignTask,
    pair: Sequence[Recipe],
    tighten: bool,
    noise: Float[np.ndarray, " nx"],
    pool: Workers,
    raw: Episodes | None = None,
) -> tuple[LoopTest, list[str], bool]:
    """Return the conditions of all closed loops, doubts about the task, and whether the goal can be held.

    For each fold and each family there is a surrogate that is fitted to the two other folds. A model that does not know
    fold k is tested on two surrogates, which do not know fold k + 1 and fold k + 2. Hidden states learn from the `raw`
    episodes.
    """
    data = folds.episodes
    wanted: list[Condition] = []
    for gain, families in ((1.0, (0, 1)), (1.0 + OFF, (1,)), (1.0 - OFF, (0,))):
        for k in range(FOLDS):
            for family in families:
                number, j = 2 * ((k + 1 + family) % FOLDS) + family, len(wanted)
                row = asked.late * (j % STRETCHES) // (STRETCHES - 1)
                start = asked.starts[j % len(asked.starts)]
                wanted.append(Condition(k, number, gain, start, row, np.zeros((0, data.nu))))
    mine = [[j for j, one in enumerate(wanted) if one.surrogate == number] for number in range(FOLDS * len(pair))]
    tasks = [
        _StandIn(recipe, i, tuple((wanted[j].gain, wanted[j].first) for j in mine[i * len(pair) + family]))
        for i in range(FOLDS)
        for family, recipe in enumerate(pair)
    ]
    surrogates: list[Surrogate] = []
    conditions = list(wanted)
    for places, (one, inputs) in zip(mine, pool.map(partial(_fit_task, folds, asked, noise), tasks), strict=True):
        surrogates.append(one)
        for j, rows in zip(places, inputs, strict=True):
            conditions[j] = replace(wanted[j], u_reference=rows)
    X = np.concatenate([episode.X for episode in data])
    turning = [i for i in find_angles(data.states, X) if asked.high[i] - asked.low[i] > TURNS]
    ignored = find_ignored_states(surrogates[0], X)
    turning = sorted({*asked.angles, *turning} - {*ignored})
    free = sorted({*turning, *ignored})
    of = asked.cost.of.bind(data.states)
    tracked = [int(i) for i in of.state_indices] if isinstance(of, State) else []
    low, high = asked.hull(free, tracked)
    room = limit_margins(asked, data) if tighten else None
    test = LoopTest(
        asked,
        data,
        folds.fold,
        tuple(surrogates),
        tuple(conditions),
        low,
        high,
        room,
        noise,
        tuple(ignored),
        tuple(turning),
        raw,
    )
    unreachable = explain_unreachable(surrogates[0], asked)
    holds = not asked.moves and not unreachable
    return (
        test,
        [
            *unreachable,
            *find_outside_limits(asked, data),
            *find_outside_data(asked, data, tracked, free),
            *find_poor_logs(asked, data, tracked),
        ],
        holds,
    )


class _StandIn(NamedTuple):
    """A task: fit the surrogate of a recipe without a fold, for runs with (gain, first row of the reference)."""

    recipe: Recipe
    out: int
    runs: tuple[tuple[float, int], ...]


def _fit_task(
    folds: Folds, asked: DesignTask, noise: Float[np.ndarray, " nx"], task: _StandIn
) -> tuple[Surrogate, list[Float[np.ndarray, "T nu"]]]:
    """Return the surrogate and the `Condition.u_reference` of each run on it."""
    data, fold = folds.episodes, folds.fold
    one = fit_surrogate(task.recipe, drop_fold(data, fold, task.out), select_fold(data, fold, task.out), noise)
    cost, limits = asked.cost, asked.limits
    rows = [(gain, asked.reference[first : first + asked.steps]) for gain, first in task.runs]
    inputs = [one.find_reference_inputs(cost, limits, part, gain) for gain, part in rows]
    return one, inputs
