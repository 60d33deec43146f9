"""pose_task: the task of a design on its data: horizon, episodes that count, noise, and doubts."""

from dataclasses import dataclass, replace

from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Limits
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.estimate.kalman import NOT_TOGETHER
from koopmpc.synthesis.doubts import find_stray_episodes, find_unweighted_limits
from koopmpc.synthesis.options import DesignOptions
from koopmpc.synthesis.search.prepare import PreparedData, prepare_data, take_out_noise
from koopmpc.synthesis.task import DesignTask, check_task, choose_horizon

MOVED = (
    "the inputs act on outputs at once, and were moved up by one row: the controller's filter takes a reading as "
    "h(x, u) of the input before; model.align(logs) moves them in other logs"
)


@dataclass(frozen=True, eq=False)
class ControlGoal:
    """What is asked of the controller: cost, limits, reference, and the horizon and starts if these are given."""

    cost: Cost
    limits: Limits | None
    reference: ArrayLike
    horizon: int | None
    starts: ArrayLike | None


@dataclass(frozen=True, eq=False)
class PosedTask:
    """A task on data that are ready for trials."""

    task: DesignTask  # cost, limits, horizon, reference and starts, checked
    data: PreparedData  # the prepared data, without stray episodes
    notes: tuple[str, ...]  # what was done to the data, and where the horizon comes from
    doubts: tuple[str, ...]  # episodes that were left out
    advice: tuple[str, ...]  # limits that the cost does not weigh


def pose_task(data: Episodes | Source, goal: ControlGoal, options: DesignOptions) -> PosedTask:
    """Return the task on these data."""
    ahead = 1 if goal.horizon is None else checks.count(goal.horizon, "horizon")
    if source_of(data).nu == 0:
        raise DataError("the data have no inputs, so there is nothing to control; give each Episode its U")
    prepared = prepare_data(data, options, feedback=not options.feedthrough, feedthrough=MOVED)
    if options.feedthrough and prepared.source.nw:
        raise DataError(NOT_TOGETHER)
    held, notes = prepared.held, prepared.notes

    def check(episodes: Episodes) -> DesignTask:
        return check_task(episodes, goal.cost, goal.limits, ahead, goal.reference, goal.starts, options.angles)

    task = check(held)
    if goal.horizon is None:
        ahead, sentence = choose_horizon(held, goal.cost, goal.limits, goal.reference)
        task, notes = check(held), (*notes, sentence)
    unweighted, stray = find_unweighted_limits(task, held), find_stray_episodes(held, task)
    if stray:
        held = held.with_episodes([episode for k, episode in enumerate(held) if k not in stray])
        task, source = check(held), source_of(held)
        if prepared.sampled:
            said = f"chosen on and fitted to a sample of {len(held)} episodes, without those left out"
            notes = (said, *notes[len(prepared.sampled) :])
        prepared = replace(prepared, source=source, held=held, measured_source=source, measured=held)
    smoothed = take_out_noise(replace(prepared, notes=notes))
    return PosedTask(task, smoothed, smoothed.notes, tuple(stray.values()), tuple(unweighted))
