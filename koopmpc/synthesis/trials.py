"""cross_validate_models: the models of a design, each fitted to two folds and forecast over the third."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np

from koopmpc.base.errors import DataError
from koopmpc.base.parallel import Workers, report_stage
from koopmpc.data.episodes import Episodes
from koopmpc.lifting.composed import Present
from koopmpc.lifting.state import State
from koopmpc.synthesis.loops.conditions import FOLDS
from koopmpc.synthesis.options import DesignOptions
from koopmpc.synthesis.pose import PosedTask
from koopmpc.synthesis.search.candidates import Candidate, list_candidates
from koopmpc.synthesis.search.cross_validation import LEAST, RIDGES, Trial, Tried, cross_validate
from koopmpc.synthesis.search.folds import Folds, make_folds
from koopmpc.synthesis.search.hidden_states import propose_hidden_states
from koopmpc.synthesis.search.prepare import list_delays
from koopmpc.synthesis.task import LENGTHS, DesignTask
from koopmpc.validate.memory import Memory


@dataclass(frozen=True, eq=False)
class PlannedTrials:
    """Models to try, and the folds that they are judged on."""

    posed: PosedTask  # the task and its data
    # folds, raw: episodes in three folds, and the same episodes as they were measured
    folds: Folds
    raw: Episodes
    trials: Sequence[Trial]  # one for each candidate
    shortest: int  # steps that an episode needs to be in a fold
    memory: Memory | None  # what shows a hidden state; None where nothing does
    notes: tuple[str, ...]  # sentences on short episodes

    def run(self, pool: Workers, options: DesignOptions) -> tuple[list[Tried], float]:
        """Return the result of each trial, and the least ridge of models with delays."""
        told = report_stage(options.progress, "models")
        results = pool.map(cross_validate, self.trials, told, size=lambda trial: trial.candidate.size)
        return results, max(min(result.misfit for result in results) / np.sqrt(10), LEAST)


def plan_trials(posed: PosedTask, options: DesignOptions, draw: np.random.Generator) -> PlannedTrials:
    """Return the trials of all candidates on three folds."""
    task, held, measured = posed.task, posed.data.held, posed.data.measured
    past, memory = list_delays(posed.data, options.delays)
    models = _list_models(held, task, options, past, draw)
    if memory is not None and options.delays is None and posed.data.record and _tracks_states(task):
        proposed = propose_hidden_states(measured, options.bilinear, report_stage(options.progress, "hidden states"))
        models += [one for one in proposed if _has_folds(held, task.horizon, one.delays)]
    first = max(one.delays for one in models)
    forecast = _fit_forecast(held, task.horizon, first)
    again = deepcopy(draw)
    folds = make_folds(held, forecast + first, FOLDS, draw)
    raw = folds.episodes if held is measured else make_folds(measured, forecast + first, FOLDS, again).episodes
    if folds.number < FOLDS:
        raise DataError(
            f"{len(held)} episodes give {folds.number} folds, and a design needs {FOLDS}: one to judge on and two to "
            f"learn from; pass more episodes of {forecast + first} steps or more, or a shorter horizon"
        )
    trials = [
        Trial(one, folds.episodes, folds.fold, forecast, first, RIDGES if one.structure is None else (0.0,), True, raw)
        for one in models
    ]
    notes = (*_describe_lengths(task, held, forecast), *folds.notes)
    return PlannedTrials(posed, folds, raw, trials, forecast + first, memory, notes)


def _describe_lengths(task: DesignTask, held: Episodes, forecast: int) -> list[str]:
    """Return sentences where loops are longer than episodes, or forecasts shorter than plans."""
    said, longest = list[str](), max(len(one) for one in held)
    if task.steps > max(longest, LENGTHS.run * task.horizon):
        why = "since the reference moves" if task.moves else "until a linear loop on the data settles, at most 120"
        said.append(
            f"loops take {task.steps} steps, {why}; no episode is longer than {longest}, so what comes later rests on "
            "stand-ins that no log has followed so far"
        )
    if forecast < task.horizon:
        said.append(f"models were judged {forecast} steps ahead, not {task.horizon}, for episodes are no longer")
    return said


def _tracks_states(task: DesignTask) -> bool:
    """Return whether cost and limits are of states alone, which models with a hidden state have as outputs."""
    return all(of is None or isinstance(of, State) for of in (task.cost.of, task.limits.of))


def _fit_forecast(episodes: Episodes, ahead: int, past: int) -> int:
    """Return how far models are judged: as far as a controller plans, or as half of the episodes allow."""
    return min(ahead, max(int(np.median([len(episode) for episode in episodes])) - past, 1))


def _has_folds(episodes: Episodes, ahead: int, past: int) -> bool:
    """Return whether episodes give as many folds as a design needs, with so many past rows."""
    needed = _fit_forecast(episodes, ahead, past) + past
    try:
        return make_folds(episodes, needed, FOLDS, np.random.default_rng(0)).number == FOLDS
    except DataError:
        return False


def _list_models(
    held: Episodes, task: DesignTask, options: DesignOptions, past: Sequence[int], draw: np.random.Generator
) -> list[Candidate]:
    """Return the models to try; each lifting includes the observables of cost and limits."""
    models = list_candidates(options.candidates, held, past, options.bilinear, draw)
    asking = [of for of in (task.cost.of, task.limits.of) if of is not None and not isinstance(of, State)]
    needed = [of.bind(held.states) for of in asking]
    if not needed:
        return models

    def complete(one: Candidate) -> Candidate:
        """Return the candidate with these observables first; of two observables with one name the first is kept."""
        first = [Present(of).bind(one.lifting.bound_states) for of in needed] if one.delays else needed
        return replace(one, lifting=sum([*first[1:], one.lifting], first[0])).bind(held.states, held.inputs)

    return [complete(one) for one in models]
