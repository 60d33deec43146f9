"""choose_controller: the best row that is confirmed on all data, its finalists, the ends of its plans, its margin."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from koopmpc.base.errors import DataError
from koopmpc.data.source import source_of
from koopmpc.synthesis.choice import DesignRow, choose_row
from koopmpc.synthesis.loops.finalists import choose_finalist, find_room_to_stop, list_finalists, watch_data
from koopmpc.synthesis.loops.judging import is_confirmed
from koopmpc.synthesis.loops.margin import keep_limits
from koopmpc.synthesis.loops.neighbours import NeighbourMap
from koopmpc.synthesis.loops.pool import LoopPool
from koopmpc.synthesis.options import DesignOptions
from koopmpc.synthesis.rates import CoveragePromise
from koopmpc.synthesis.rounds import JudgedRows
from koopmpc.synthesis.search.recipe import Designed, Nearness, get_model


@dataclass(frozen=True, eq=False)
class ChosenController:
    """The controller of a design, and what it was chosen from."""

    judged: JudgedRows  # the leaderboard, with the task and its data
    # controller, best: the controller, fitted to all data, and the place of its row in the leaderboard
    controller: Designed
    best: int
    # linear, best_linear: the best linear controller, and the place of its row; both None if none was confirmed
    linear: Designed | None
    best_linear: int | None
    standby: Any  # plain linear controller of the states alone; None if no such model was tried
    pool: LoopPool  # the distribution of fresh loops
    compared: int = 0  # number of loops in which finalists were compared
    promise: CoveragePromise | None = None  # what the margin promises; None where no share of loops was asked for
    notes: tuple[str, ...] = ()  # how the choice came about, in sentences


def choose_controller(
    judged: JudgedRows, options: DesignOptions, few: int, rng: np.random.Generator
) -> ChosenController:
    """Return the best confirmed controller; `few` is the number of loops in Python, 0 for no finalists."""
    chosen = _confirm_best(judged, options)
    if few:
        chosen = _compare_finalists(chosen, options, rng)
        chosen = _leave_room_to_stop(chosen, rng)
    if options.promised is not None:
        chosen = _keep_promise(chosen, options.promised, few, rng)
    return chosen


def _confirm_best(judged: JudgedRows, options: DesignOptions) -> ChosenController:
    rows, test = judged.rows, judged.test
    place = choose_row(rows, unstable=judged.unstable)
    place_linear = choose_row(rows, "linear", unstable=judged.unstable)
    assert place is not None, "the last round is never empty"
    controller, best, notes = _confirm_first(judged, options, place)
    linear, best_linear = controller, best
    if place_linear != best:
        linear, best_linear, more = _confirm_first(judged, options, place_linear)
        notes = [*notes, *more]
    if controller is None or best is None:
        raise DataError(
            "no controller that was fitted to all data does on the surrogates what it did when fitted to two folds; "
            "collect more episodes, which cover the reference and the way to it"
        )
    neighbours = NeighbourMap.of(
        test.episodes,
        test.surrogates[0].model.embedding,
        test.surrogates[0].noise,
        test.ignored,
        test.turning,
        feedthrough=bool(options.feedthrough),
    )
    return ChosenController(
        judged=judged,
        controller=controller,
        best=best,
        linear=linear,
        best_linear=best_linear,
        standby=_fit_standby(judged, options),
        pool=LoopPool(test.task, test.surrogates, neighbours, test.low, test.high),
        notes=tuple(notes),
    )


def fit_row(judged: JudgedRows, options: DesignOptions, place: int) -> tuple[Designed | None, list[str]]:
    """Return the controller of a row fitted to all data, if it is confirmed, and notes; None where it is not.

    Else it is fitted to the episodes of the choice, in which those that were too short took no part.
    """
    recipe, outcome, test, data = judged.rows[place].recipe, judged.outcomes[place], judged.test, judged.plan.posed.data
    title, near, notes = judged.rows[place].title, None, list[str]()
    if recipe.weighted:
        near = Nearness.of(outcome.visited, test.episodes)
    raw, hidden = source_of(judged.plan.raw), recipe.candidate.has_hidden_state
    sets = [(data.source, data.measured_source), (source_of(test.episodes), raw)]
    for smoothed, measured in sets[: 1 + any(len(one) < judged.plan.shortest for one in data.held)]:
        learned = measured if hidden else smoothed
        model = data.mark(recipe.fit(learned, near, workers=options.workers, scheduler=options.scheduler))
        controller = recipe.controller(model, test.task.cost, test.limits(outcome.band), test.task.horizon)
        if is_confirmed(test, controller, outcome):
            if smoothed is not data.source:
                notes.append(
                    f"{title} is fitted without the episodes that took no part in the choice: with them it does worse "
                    "on the surrogates"
                )
            # begins without what it saw of the surrogates
            return watch_data(recipe, model, controller, data.measured), notes
    return None, [*notes, f"passed over: {title}, for fitted to all data it does worse than fitted to two folds"]


def _confirm_first(
    judged: JudgedRows, options: DesignOptions, place: int | None
) -> tuple[Designed | None, int | None, list[str]]:
    """Return the first confirmed controller, its row and notes: of the chosen row, or of the next best of its kind."""
    rows, notes = judged.rows, list[str]()
    if place is None:
        return None, None, notes
    kind = None if rows[place].recipe.candidate.bilinear else "linear"
    others = [i for i, row in enumerate(rows) if row.off and i != place and kind in (None, row.recipe.candidate.kind)]
    for i in (place, *others):
        controller, said = fit_row(judged, options, i)
        notes += said
        if controller is not None:
            return controller, i, notes
    return None, None, notes


def _fit_standby(judged: JudgedRows, options: DesignOptions) -> Any:
    """Return the plain linear controller with Q_N = Q, fitted to all data; None where none was judged."""
    rows, test, data = judged.rows, judged.test, judged.plan.posed.data
    plain = [i for i, row in enumerate(rows) if row.recipe.candidate.name == "x, 1" and row.recipe.tail == 0]
    if not plain or not judged.outcomes[plain[0]].models:
        return None
    recipe = replace(rows[plain[0]].recipe, estimator=None)
    model = data.mark(recipe.fit(data.source, workers=options.workers, scheduler=options.scheduler))
    limits = test.limits(judged.outcomes[plain[0]].band)
    return recipe.controller(model, test.task.cost, limits, test.task.horizon)


def _compare_finalists(chosen: ChosenController, options: DesignOptions, rng: np.random.Generator) -> ChosenController:
    """Return the finalist that fresh loops prefer; the one chosen before where none is better."""
    rows: Sequence[DesignRow] = chosen.judged.rows
    others = list_finalists(rows, chosen.best)
    if not others:
        return chosen
    fits = [(i, *fit_row(chosen.judged, options, i)) for i in others]
    tried = [(i, controller, notes) for i, controller, notes in fits if controller is not None]
    place, compared, why = choose_finalist(chosen.pool, [chosen.controller, *(one for _, one, _ in tried)], rng)
    if not place:
        return replace(chosen, compared=compared)
    i, controller, notes = tried[place - 1]
    said = f"{rows[i].title} takes the place of {rows[chosen.best].title}: {why}"
    chosen = replace(chosen, controller=controller, best=i, compared=compared, notes=(*chosen.notes, said, *notes))
    if rows[i].recipe.candidate.kind == "linear":
        return replace(chosen, linear=controller, best_linear=i)
    return chosen


def _leave_room_to_stop(chosen: ChosenController, rng: np.random.Generator) -> ChosenController:
    """Return the controller with an end of its plans, where these are too short to stop before a limit."""
    recipe, controller = chosen.judged.rows[chosen.best].recipe, chosen.controller
    limits, why = find_room_to_stop(chosen.pool, recipe, controller, chosen.judged.test.episodes, rng)
    if not why:
        return chosen
    task, model = chosen.judged.test.task, get_model(controller)
    stopping = recipe.controller(model, task.cost, limits, task.horizon)
    return replace(
        chosen,
        controller=watch_data(recipe, model, stopping, chosen.judged.plan.posed.data.measured),
        linear=stopping if chosen.linear is controller else chosen.linear,
        notes=(*chosen.notes, why),
    )


def _keep_promise(chosen: ChosenController, share: float, loops: int, rng: np.random.Generator) -> ChosenController:
    """Return the controller with the least margin with which this share of loops keeps the limits, and the promise."""
    judged, controller = chosen.judged, chosen.controller
    recipe, band, task = judged.rows[chosen.best].recipe, judged.outcomes[chosen.best].band, judged.test.task
    promise, limits = keep_limits(judged.test, chosen.pool, recipe, controller, band, share, loops, rng)
    if limits.margin is not None:
        model = get_model(controller)
        inside = recipe.controller(model, task.cost, limits, task.horizon)
        controller = watch_data(recipe, model, inside, judged.plan.posed.data.measured)
    return replace(chosen, controller=controller, promise=promise)
