"""`design` chooses a controller with a learned model from data, a cost and limits, by closed loops on surrogates."""

import warnings
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.codegen.compiled import Compiled
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.control.linear.koopman_mpc import KoopmanMPC
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.errors import DataError, FitWarning
from koopmpc.estimate.disturbance import LiftedDisturbance
from koopmpc.estimate.kalman import NOT_TOGETHER
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.composed import Present
from koopmpc.lifting.state import State
from koopmpc.parallel import StageProgress, Workers
from koopmpc.synthesis.asked import (
    RUN,
    DesignTask,
    check_task,
    find_stray_episodes,
    find_unweighted_limits,
)
from koopmpc.synthesis.candidates import (
    Candidate,
    Designed,
    Nearness,
    Recipe,
    check_delays,
    expand_candidates,
    get_model,
    propose_candidates,
)
from koopmpc.synthesis.cross_validation import (
    LEAST,
    Trial,
    Tried,
    cross_validate,
    make_folds,
    replace_glitches,
    smooth_data,
    take_sample,
)
from koopmpc.synthesis.designed import (
    Design,
    DesignRow,
    Evidence,
    ExpectedLoop,
    choose_estimator,
    choose_row,
)
from koopmpc.synthesis.feedback import remove_feedback, require_episodes
from koopmpc.synthesis.fresh.abreast import explain_python, speed_up
from koopmpc.synthesis.fresh.conditions import FOLDS, prepare_test
from koopmpc.synthesis.fresh.coverage import check_coverage, keep_limits
from koopmpc.synthesis.fresh.drawn import KEPT, LoopPool
from koopmpc.synthesis.fresh.horizon import choose_horizon
from koopmpc.synthesis.fresh.loops import (
    choose_finalist,
    compare_longer_horizon,
    describe_outside,
    find_blind_range,
    find_blind_reference,
    find_room_to_stop,
    list_finalists,
    run_fresh_loops,
    watch_data,
)
from koopmpc.synthesis.fresh.neighbours import NeighbourMap
from koopmpc.synthesis.fresh.promise import CoveragePromise
from koopmpc.synthesis.hidden_states import propose_hidden_states
from koopmpc.synthesis.judging import (
    Job,
    LoopTest,
    Outcome,
    average_ratios,
    is_alike,
    is_confirmed,
    judge_job,
    measure_errors,
    rate_runs,
)
from koopmpc.synthesis.records import advance_inputs, is_late
from koopmpc.synthesis.select import (
    LATE_COLUMN,
    RIDGES,
    check_feedthrough,
    extend_past,
    is_record,
    mark_lead,
    report_stage,
)
from koopmpc.synthesis.surrogates import (
    choose_surrogates,
    is_unstable,
)
from koopmpc.text import to_percent
from koopmpc.validate.memory import find_hidden_state

_FIRST_ROUND = 5  # models of each kind that the first round judges by closed loop
_LINEAR = 2  # linear models of the first round that are tried with estimators and both terminal costs
_BILINEAR = 3  # bilinear models of the first round that are tried with an estimator or with weights
_GAINS = (None, 0.05)  # gains of the estimators: the default, and one for noisy measurements
GAINED = 0.01  # another end of the horizon is tried on further models if it costs this share less
MANY = 600  # fresh loops of a controller in machine code
FEW = 60  # fresh loops of one in Python
ALONG = "first rows of {count} records are few: fresh loops start at rows all along them, with the past they had there"
RARELY = 0.01  # share of the fresh loops above which violated limits are advice
WORRY = 0.05  # a bound of lost loops above this is advice
MOVED = (
    "the inputs act on outputs at once, and were moved up by one row: the controller's filter takes a reading as "
    "h(x, u) of the input before; model.align(logs) moves them in other logs"
)
_KEPT = 6000  # steps of the data that a saved design keeps, to compare new logs with


def design(
    data: Episodes | Source,
    cost: Cost,
    limits: Limits | None = None,
    *,
    horizon: int | None = None,
    reference: ArrayLike,
    starts: ArrayLike | None = None,
    angles: Sequence[int] = (),
    candidates: Sequence[Candidate | Lifting] | None = None,
    delays: Sequence[int] | None = None,
    bilinear: bool = True,
    feedthrough: bool = False,
    tighten: bool = True,
    smooth: bool = True,
    instruments: Sequence[ArrayLike] | None = None,
    sample: int = 30_000,
    loops: int | None = None,
    coverage: float | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: StageProgress | None = None,
    rng: np.random.Generator | int = 0,
) -> Design:
    """Choose model and controller by closed loop on learned surrogates of the plant, and fit them to all data.

    1. Folds: episodes that went far away under ordinary inputs are left out, and the others are dealt into three folds.
       Every candidate model is fitted to two folds and forecasts the third over the horizon. A bilinear model is lifted
       at every step, as in its controller. The errors choose the ridges, the five models of each kind for the first
       round, and the two surrogates of the plant.
    2. Surrogates: the bilinear model with the smallest error, and the best one from another family of observables, each
       fitted to every two folds. Their one-step errors give the noise of their measurements.
    3. First round: each model, fitted to two folds, controls surrogates that know the third fold from several starts,
       by BilinearMPC, KoopmanMPC, and plain KoopmanMPC with Q_N = Q. A run takes three horizons, and as long as a
       linear loop on the data takes to settle, at most 120 steps.
    4. Final round: the best models are tried with every estimator and terminal cost, and one is fitted with weights
       around the states that its loops visit. Some surrogates have inputs that act 20 % more or less, since a plant
       differs from its logs.
    5. Choice: the score of a run is its cost × (1 + 10 max(0, violation − 0.5 %)), divided by the best on the same
       surrogate and start. It is at most 20, and 20 if the run leaves the data by half of their range. A controller is
       judged by the geometric mean of its scores, in which runs with inputs 20 % off count half. Of all controllers
       within 0.5 % of the best, whose worst run is within 3 %, the simplest is chosen and fitted to all data.
    6. Confirmation: if the fitted controller loses a run, or costs a quarter more on the surrogates than when fitted to
       two folds, the next best is chosen, and the notes say so.
    7. Finalists: up to three controllers with other models, whose scores are within 3 % of the best, run the same fresh
       loops as the chosen one, the best of them 300 in all. One that loses fewer, keeps more limits, or costs 2 % less
       takes its place. This is left out where a controller does not run as machine code, and with `loops=0`.
    8. Short plans: if one in twenty of 60 fresh loops breaks limits of states, plans have to end where an affine model
       can keep these for 40 more steps with nine tenths of the inputs. That stays if the same loops prefer it.
    9. Fresh loops: the controller runs from starts that took no part in the choice, on nearest neighbours of the data
       and on the surrogates. They give the interval and the bounds of `expected`, and say where it is outside the data.
       Of three records or fewer they start at rows all along them, with the past of these rows.

    Of long records whose input column is one row late the inputs are moved up, as in `select`.

    The choice depends only on the data and `rng`, never on time or on the number of workers.

    Parameters
    ----------
    data
        Episodes, or a Source that can be read again; the choice uses a sample of a source larger than memory.
    cost, limits
        Cost to minimise and limits to keep.
    horizon
        Horizon of the controllers in steps. None: half of the time in which a linear loop on the data settles, 8 to 40
        steps; the notes say which. A given one is kept.
    reference
        (nr,) of the tracked outputs, or rows (T+1, nr), of which the runs take stretches of three horizons, and of at
        least 120 steps where they move.
    starts
        (nx,) or (n, nx) states from which runs begin; by default first states of up to twelve episodes, inside the
        limits.
    angles
        Indices of states whose errors wrap at ±π. These states may leave the range of the data, and so may angles that
        made whole turns in the data, and positions on which nothing depends.
    candidates
        Models to try, as in `select`.
    delays
        Past steps to try in an embedding; by default 0, 1 and 2, and 4 where the data show a hidden state,
        see `select`. Of records that show one, models with a hidden state are tried too.
    bilinear
        Try bilinear models too; the surrogates are then bilinear.
    feedthrough
        The plant has y = h(x, u), see `select`, and a log's row k holds h(x_k, u_k), while a controller reads
        h(x_k, u_{k−1}) before it chooses u_k. Every controller then has a filter that knows it, and estimates a
        disturbance for each output: `LiftedKalman` or `ExtendedKalman` with ``feedthrough=True``. A `LiftedDisturbance`
        needs the model's own state, which no reading holds. Plans weigh and limit h(x_k, u_k) first, against row k + 1
        of a moving reference.
    tighten
        Tighten the limits of every controller (`Limits.tightened`) by its model's errors on the fold that it does not
        know, by at most half of the distance from the reference to the limit.
    smooth
        Replace glitches, and learn from smoothed states if the states contain noise (see `select`); the surrogates
        then measure with this noise. Hidden states learn from the measured rows.
    instruments
        For each episode (T, nr) or (T + 1, nr) rows of the set point of the loop that made the logs, or of a signal
        added to its inputs. Where the logs hold feedback, least squares is found biased and unseen rows gain, models
        are fitted to what these rows explain of states and inputs (two-stage method); the notes say whether.
    sample
        Approximate number of snapshot pairs that the choice uses.
    loops
        Number of fresh loops after the choice; 59 without a failure bound a probability by 5 %, 299 by 1 %. None: 600
        where the controller runs as machine code, 60 where there is no compiler.
    coverage
        Share of loops on stand-ins that are to keep their limits, such as 0.95. The least margin that gives it is
        chosen on `loops` loops (None: 60) and verified on as many others, in place of `tighten`; `promise` of the
        design says what is promised, and the advice says so where no margin gives it.
    workers, scheduler
        As in `koopmpc.parallel.map_tasks`; a task is a model, or a controller with all its runs.
    progress
        Called with the name of the stage, and the numbers of finished tasks and of all tasks.
    rng
        Random generator or seed for the folds, centres and features.

    Raises
    ------
    DataError
        There are too few long episodes for three folds, no inputs, or NaN; or the data are a stream that can be read
        only once; feedthrough with measured disturbances.
    ShapeError
        Reference, starts, weights or limits have other sizes than the data.
    DefinitenessError
        A weight is indefinite.

    Warns
    -----
    FitWarning
        No input inside the limits holds the reference; the reference or a start lies outside the data; an episode is
        left out.
    """
    draw, few = checks.generator(rng), FEW if loops is None else checks.count(loops, "loops", 0)
    wished = None if coverage is None else check_coverage(coverage, few)
    ahead = 1 if horizon is None else checks.count(horizon, "horizon")
    used, projected = "", np.zeros(0)
    for switch, name in ((smooth, "smooth"), (feedthrough, "feedthrough")):
        checks.kind(switch, name, (bool, np.bool_), "pass True or False")
    if instruments is not None or (smooth and not feedthrough and isinstance(data, Episodes)):
        loop = remove_feedback(require_episodes(data), instruments)
        data, projected, used = loop.episodes, loop.noise, loop.sentence
        smooth = smooth and not projected.any()
    source = source_of(data)
    if source.nu == 0:
        raise DataError("the data have no inputs, so there is nothing to control; give each Episode its U")
    check_feedthrough(feedthrough, source)
    feedthrough = bool(feedthrough)
    if feedthrough and source.nw:
        raise DataError(NOT_TOGETHER)
    held, sampled = take_sample(source, checks.count(sample, "sample"))
    notes = (*sampled, used) if used else sampled
    if smooth:
        source, held, replaced = replace_glitches(source, held)
        notes = (*notes, *replaced)
    lead, moved = int(feedthrough or (candidates is None and is_record(held) and is_late(held))), MOVED
    if lead:
        moved = moved if feedthrough else LATE_COLUMN
        source, held = advance_inputs(source, held)
        notes = (*notes, moved)
    if horizon is None:
        check_task(held, cost, limits, ahead, reference, starts, angles)
        ahead, sentence = choose_horizon(held, cost, limits, reference)
        notes = (*notes, sentence)
    asked = check_task(held, cost, limits, ahead, reference, starts, angles)
    unweighted = find_unweighted_limits(asked, held)
    left = find_stray_episodes(held, asked)
    if left:
        held = held.with_episodes([episode for k, episode in enumerate(held) if k not in left])
        asked = check_task(held, cost, limits, ahead, reference, starts, angles)
        source = source_of(held)
        if sampled:
            said = f"chosen on and fitted to a sample of {len(held)} episodes, without those left out"
            notes = (said, *notes[len(sampled) :])
    noise, measured, unsmoothed = projected if projected.any() else np.zeros(held.nx), held, source
    if smooth:
        source, held, freed, noise = smooth_data(source, held)
        notes = (*notes, *freed)
    past = check_delays((0, 1, 2) if delays is None else delays)
    memory = find_hidden_state(measured) if max(past) else None
    hidden = memory is not None and memory.shows_hidden_state
    if hidden and delays is None:
        past = extend_past(past, held, measured)
    models = _list_models(held, asked, candidates, past, bilinear, draw)
    if hidden and delays is None and candidates is None and is_record(held) and _tracks_states(asked):
        proposed = propose_hidden_states(measured, bilinear, report_stage(progress, "hidden states"))
        models += [one for one in proposed if _has_folds(held, ahead, one.delays)]
    first = max(one.delays for one in models)
    forecast = _fit_forecast(held, ahead, first)
    short: list[str] = []
    longest = max(len(one) for one in held)
    if asked.steps > max(longest, RUN * ahead):
        why = "since the reference moves" if asked.moves else "until a linear loop on the data settles, at most 120"
        short = [
            f"loops take {asked.steps} steps, {why}; no episode is longer than {longest}, so what comes later rests on "
            "stand-ins that no log has followed so far"
        ]
    if forecast < ahead:
        short += [f"models were judged {forecast} steps ahead, not {ahead}, for episodes are no longer"]
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
    with Workers(workers, scheduler) as pool:
        results = pool.map(
            cross_validate, trials, report_stage(progress, "models"), size=lambda trial: trial.candidate.size
        )
        floor = max(min(result.misfit for result in results) / np.sqrt(10), LEAST)
        pair = [replace(one, feedthrough=feedthrough) for one in choose_surrogates(results, floor, hidden=hidden)]
        test, doubts, holds = prepare_test(folds, asked, pair, tighten and wished is None, noise, pool, raw)
        doubts = [*left.values(), *doubts]
        for sentence in doubts:
            warnings.warn(sentence, FitWarning, stacklevel=2)
        unstable = is_unstable(test.surrogates, asked)
        screened = [replace(one, feedthrough=feedthrough) for one in _list_first_round(results, floor)]
        rows, outcomes = _judge_rounds(test, screened, unstable, pool, progress)
    best, linear = choose_row(rows, unstable=unstable), choose_row(rows, "linear", unstable=unstable)
    assert best is not None, "the last round is never empty"

    def fit_row(place: int) -> Designed | None:
        recipe, near, outcome = rows[place].recipe, None, outcomes[place]
        if recipe.weighted:
            near = Nearness.of(outcome.visited, test.episodes)
        for data, as_measured in zip(sets, (unsmoothed, source_of(raw)), strict=False):
            learned = as_measured if recipe.candidate.has_hidden_state else data
            model = mark_lead(recipe.fit(learned, near, workers=workers, scheduler=scheduler), lead, moved)
            controller = recipe.controller(model, asked.cost, test.limits(outcome.band), ahead)
            if is_confirmed(test, controller, outcome):
                if data is not source:
                    turned.append(
                        f"{rows[place].title} is fitted without the episodes that took no part in the choice: with "
                        "them it does worse on the surrogates"
                    )
                return watch_data(recipe, model, controller, measured)  # begins without what it saw of the surrogates
        turned.append(
            f"passed over: {rows[place].title}, for fitted to all data it does worse than fitted to two folds"
        )
        return None

    turned: list[str] = []
    sets = [source, source_of(folds.episodes)] if any(len(one) < forecast + first for one in held) else [source]
    controller, best = _confirm_first(fit_row, rows, best)
    simple, linear = (controller, best) if linear == best else _confirm_first(fit_row, rows, linear)
    if controller is None or best is None:
        raise DataError(
            "no controller that was fitted to all data does on the surrogates what it did when fitted to two folds; "
            "collect more episodes, which cover the reference and the way to it"
        )
    plain = next(
        (i for i, row in enumerate(rows) if row.recipe.candidate.name == "x, 1" and row.recipe.tail == 0), None
    )
    standby: Any = None
    if plain is not None and outcomes[plain].models:
        recipe = replace(rows[plain].recipe, estimator=None)
        model = mark_lead(recipe.fit(source, workers=workers, scheduler=scheduler), lead, moved)
        standby = recipe.controller(model, asked.cost, test.limits(outcomes[plain].band), ahead)
    embedding = test.surrogates[0].model.embedding
    alone = test.ignored, test.turning
    noises = test.surrogates[0].noise
    neighbours = NeighbourMap.of(test.episodes, embedding, noises, *alone, feedthrough=feedthrough)
    drawn_from = LoopPool(asked, test.surrogates, neighbours, test.low, test.high)
    compared = 0
    if few and (others := list_finalists(rows, best)):
        said, tried = list(turned), list[tuple[int, Designed, list[str]]]()
        for i in others:
            turned.clear()
            if (one := fit_row(i)) is not None:
                tried.append((i, one, list(turned)))
        place, compared, why = choose_finalist(drawn_from, [controller, *(one for _, one, _ in tried)], draw)
        turned[:] = said
        if place:
            i, controller, fitted = tried[place - 1]
            turned += [f"{rows[i].title} takes the place of {rows[best].title}: {why}", *fitted]
            best = i
            if rows[best].recipe.candidate.kind == "linear":
                simple, linear = controller, best
    held_inputs = next(one.u_reference for one in test.conditions if one.gain == 1.0)
    wide = find_blind_range(test.episodes, asked, neighbours) if few else []
    blind = find_blind_reference(test.episodes, asked, neighbours, held_inputs)
    if few:
        recipe, model = rows[best].recipe, get_model(controller)
        limits, why = find_room_to_stop(drawn_from, recipe, controller, test.episodes, draw)
        if why:
            turned.append(why)
            stopping = recipe.controller(model, asked.cost, limits, ahead)
            simple = stopping if simple is controller else simple
            controller = watch_data(recipe, model, stopping, measured)
    promise: CoveragePromise | None = None
    if wished is not None:
        recipe, band = rows[best].recipe, outcomes[best].band
        promise, limits = keep_limits(test, drawn_from, recipe, controller, band, wished, few, draw)
        if limits.margin is not None:
            model = get_model(controller)
            controller = watch_data(recipe, model, recipe.controller(model, asked.cost, limits, ahead), measured)
    fresh = None
    if few:
        fast = speed_up(controller)
        count = MANY if loops is None and isinstance(fast, Compiled) else few
        if loops is None and count == few:
            why = explain_python(controller)
            notes = (*notes, f"{few} fresh loops ran in place of {MANY}, for {why}; loops={MANY} takes longer")
        fresh = run_fresh_loops(drawn_from, fast, count, draw)
        if asked.along:
            notes = (*notes, ALONG.format(count=len(held)))
        blind = [*describe_outside(test.episodes, asked, fresh), *blind, *wide]
        blind += compare_longer_horizon(drawn_from, rows[best].recipe, controller, fast, draw)
    controller.reset()
    remembered = [] if not hidden else [f"{memory}; models with delays were tried"]
    if hidden and not rows[best].recipe.candidate.delays:
        blind.append(f"{memory}, and the chosen model sees no past rows: measure that state, or compare delays=[4, 8]")
        remembered = []
    expected = replace(_summarise_expected(test, outcomes[best]), fresh=fresh, compared=compared)
    return Design(
        controller=controller,
        linear=simple if isinstance(simple, KoopmanMPC) else None,
        leaderboard=rows,
        chosen=best,
        chosen_linear=linear,
        evidence=Evidence(
            asked, test.surrogates, test.low, test.high, expected, holds, neighbours, _keep_logs(measured), promise
        ),
        advice=(
            *doubts,
            *([] if promise is None or promise.holds else [str(promise)]),
            *blind,
            *_give_advice(rows, best, linear, expected),
            *test.limits(outcomes[best].band).capped,
            *unweighted,
        ),
        notes=(*notes, *short, *folds.notes, *turned, *remembered),
        standby=standby,
    )


def _keep_logs(measured: Episodes) -> Episodes:
    """Return episodes of about so many steps as a comparison with new logs needs, spread evenly over the data."""
    apart = max(sum(map(len, measured)) // _KEPT, 1)
    return measured.with_episodes([Episode(X=e.X, U=e.U, W=e.W) for e in list(measured)[::apart]])


def _confirm_first(
    fit_row: Callable[[int], Designed | None], rows: Sequence[DesignRow], place: int | None
) -> tuple[Designed | None, int | None]:
    """Return the first confirmed controller and its row, trying the chosen row and then the next best of its kind."""
    if place is None:
        return None, None
    kind = None if rows[place].recipe.candidate.bilinear else "linear"
    others = [i for i, row in enumerate(rows) if row.off and i != place and kind in (None, row.recipe.candidate.kind)]
    for i in (place, *others):
        controller = fit_row(i)
        if controller is not None:
            return controller, i
    return None, None


def _tracks_states(asked: DesignTask) -> bool:
    """Return whether cost and limits are of states alone, which models with a hidden state have as outputs."""
    return all(of is None or isinstance(of, State) for of in (asked.cost.of, asked.limits.of))


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
    held: Episodes,
    asked: DesignTask,
    given: Sequence[Candidate | Lifting] | None,
    past: Sequence[int],
    both: bool,
    draw: np.random.Generator,
) -> list[Candidate]:
    """Return the models to try; each lifting includes the observables of cost and limits."""
    models = propose_candidates(held, past, both, draw) if given is None else expand_candidates(given, held, past, both)
    asking = [of for of in (asked.cost.of, asked.limits.of) if of is not None and not isinstance(of, State)]
    needed = [of.bind(held.states) for of in asking]
    if not needed:
        return models

    def complete(one: Candidate) -> Candidate:
        """Return the candidate with these observables first; of two observables with one name the first is kept."""
        first = [Present(of).bind(one.lifting.bound_states) for of in needed] if one.delays else needed
        return replace(one, lifting=sum([*first[1:], one.lifting], first[0])).bind(held.states, held.inputs)

    return [complete(one) for one in models]


def _list_first_round(results: Sequence[Tried], floor: float) -> list[Recipe]:
    """Return the recipes of the first round: the five best models of each kind, and plain linear ones with Q_N = Q.

    Models with a hidden state are few, and all of them are judged. Plain linear models are also tried with the smallest
    ridge, as in a textbook fit.
    """
    places = [tried.best(floor) for tried in results]
    worst = [float(tried.scores[place].max()) for tried, place in zip(results, places, strict=True)]
    ranked = sorted(range(len(results)), key=lambda i: (worst[i], i))
    found: list[Recipe] = []
    for bilinear in (False, True):
        same = [i for i in ranked if results[i].candidate.bilinear == bilinear]
        best = same[:_FIRST_ROUND] + [i for i in same[_FIRST_ROUND:] if results[i].candidate.has_hidden_state]
        found += [Recipe(results[i].candidate, results[i].ridges[places[i]]) for i in best]
    for one, place in zip(results, places, strict=True):
        if one.candidate.name == "x, 1" and not one.candidate.bilinear:
            found += [Recipe(one.candidate, one.ridges[i], tail=0) for i in sorted({0, place})]
    return found


Judged = tuple[Sequence[Recipe], Sequence[Outcome]]  # the recipes of a round, and the outcome of each


def _judge_rounds(
    test: LoopTest, screened: Sequence[Recipe], unstable: bool, pool: Workers, progress: StageProgress | None
) -> tuple[tuple[DesignRow, ...], list[Outcome]]:
    """Return the leaderboard and the outcome of each row.

    The first round judges all models with inputs as in the data. The second judges, in all conditions, the best
    bilinear model with every estimator, and the best linear model with every estimator and terminal cost. The third
    judges the second linear model likewise, and the smallest one that is as good as the best, the next bilinear models
    with the best estimator, and the best bilinear one with weights.
    """
    run, every = partial(judge_job, test), range(len(test.conditions))
    first = pool.map(
        run, [Job(one, test.nominal) for one in screened], report_stage(progress, "closed loops"), size=Job.size
    )
    each, nominal = rate_runs(first), test.weights[test.nominal]
    score = average_ratios(each, nominal)
    error = measure_errors(each, score, nominal)
    places = sorted(range(len(screened)), key=lambda i: (score[i], i))
    ranked = [screened[i] for i in places]
    linear = [one for one in ranked if not one.candidate.bilinear][:_LINEAR]
    near = [screened[i] for i in places if is_alike(score[i], score[places[0]], error[i])]
    small = min((one for one in near if not one.candidate.bilinear), key=lambda one: one.candidate.size, default=None)
    if small is not None and small not in linear:  # else no later round can choose the simplest of equals
        linear.append(small)
    bilinear = [one for one in ranked if one.candidate.bilinear][:_BILINEAR]
    estimators: tuple[LiftedDisturbance | None, ...] = (None, *(LiftedDisturbance(gain=gain) for gain in _GAINS))
    if screened[0].feedthrough:  # each has the filter of a Recipe
        estimators = (None,)
    cost = test.asked.cost
    ends: list[dict[str, Any]] = [{}, {"tail": 0}, {"tail": test.asked.horizon}]
    if test.asked.moves and cost.moves_on:
        ends.append({"rests": True})
    second = [replace(one, estimator=each) for one in bilinear[:1] for each in estimators]
    second += [replace(one, **end) for one in bilinear[:1] for end in ends[1:]]
    third: list[Recipe] = []
    for place, one in enumerate(linear):
        some_ends = (None, 0) if one.tail is None else (0,)
        some = [replace(one, estimator=each, tail=tail) for tail in some_ends for each in estimators]
        if test.asked.moves and one.tail is None:
            some.append(replace(one, tail=test.asked.horizon))
        (second if place == 0 else third).extend(some)
    jobs = _list_jobs(second, screened, first, every)
    outcomes = pool.map(run, jobs, report_stage(progress, "closed loops of the best"), size=Job.size)
    if bilinear:
        tried_ones = average_ratios(rate_runs(outcomes[: len(estimators)]), test.weights)
        best = estimators[choose_estimator(tried_ones.tolist(), unstable=unstable)] if len(estimators) > 1 else None
        tried_ends = average_ratios(
            rate_runs([outcomes[0], *outcomes[len(estimators) : len(estimators) + len(ends) - 1]]), test.weights
        )
        end = ends[int(np.argmin(tried_ends))] if tried_ends.min() < (1 - GAINED) * tried_ends[0] else {}
        if not bilinear[0].candidate.has_hidden_state:  # fits of hidden states know no weights
            third.append(replace(bilinear[0], estimator=best, weighted=True, **end))
        third += [replace(one, estimator=best, **end) for one in bilinear[1:]]
        if end and best is not None:
            third.append(replace(bilinear[0], estimator=best, **end))
    jobs = _list_jobs(third, screened, first, every)
    outcomes += pool.map(run, jobs, report_stage(progress, "closed loops of the last"), size=Job.size)
    return _build_leaderboard(test, (screened, first), ([*second, *third], outcomes))


def _list_jobs(
    chosen: Sequence[Recipe], screened: Sequence[Recipe], outcomes: Sequence[Outcome], every: Sequence[int]
) -> list[Job]:
    """Return the jobs of a later round; they reuse models and runs of the first round."""
    jobs: list[Job] = []
    for one in chosen:
        same = [i for i, other in enumerate(screened) if other == one]
        alike = [i for i, other in enumerate(screened) if other.candidate == one.candidate and other.ridge == one.ridge]
        known = next((outcomes[i] for i in (*same, *alike) if outcomes[i].models), None)
        jobs.append(Job(one, every, known, known_runs=bool(same) and known is outcomes[same[0]]))
    return jobs


def _build_leaderboard(test: LoopTest, screened: Judged, last: Judged) -> tuple[tuple[DesignRow, ...], list[Outcome]]:
    """Return the rows and their outcomes: first the recipes of the final round, the best first, then the others."""
    both: list[tuple[DesignRow, Outcome]] = []
    nominal = test.weights[test.nominal]
    for off, (recipes, outcomes), weights in ((True, last, test.weights), (False, screened, nominal)):
        part: list[tuple[DesignRow, Outcome]] = []
        each = rate_runs(outcomes)
        scores = average_ratios(each, weights)
        errors = measure_errors(each, scores, weights)
        for recipe, outcome, ratio, score, error in zip(recipes, outcomes, each, scores, errors, strict=True):
            known = outcome.violation[np.isfinite(outcome.violation)]
            row = DesignRow(
                recipe=recipe,
                score=float(score),
                worst=float(ratio.max()),
                violation=float(known.max(initial=0.0)),
                lost=int(np.sum(~np.isfinite(outcome.cost))),
                runs=len(ratio),
                off=off,
                error=float(error),
            )
            if off or recipe not in last[0]:  # else it stands above, judged in all conditions
                part.append((row, outcome))
        both += sorted(part, key=lambda pair: pair[0].score)
    return tuple(row for row, _ in both), [outcome for _, outcome in both]


def _summarise_expected(test: LoopTest, outcome: Outcome) -> ExpectedLoop:
    nominal = test.nominal
    off = [j for j in range(len(test.conditions)) if j not in nominal]
    near = [test.conditions[j] for j in nominal]
    known = outcome.broken[np.isfinite(outcome.cost)]
    return ExpectedLoop(
        cost=outcome.cost[nominal],
        cost_off=outcome.cost[off],
        violation=outcome.violation[nominal],
        violation_off=outcome.violation[off],
        broken=float(known.mean()) if known.size else 1.0,
        starts=np.array([one.x0 for one in near]),
        surrogate=tuple(one.surrogate for one in near),
        steps=test.asked.steps,
    )


def _describe_violation(row: DesignRow, expected: ExpectedLoop) -> str:
    """Return by how much limits are violated, by fresh loops of the returned controller if any ran; "" if little."""
    if expected.fresh is None:
        return "" if row.violation <= KEPT else f"{to_percent(row.violation)} of their range"
    known = expected.fresh.violation[np.isfinite(expected.fresh.violation)]
    broken = int(np.sum(known > KEPT))
    if broken <= RARELY * len(known):
        return ""
    return (
        f"{to_percent(float(known.max()))} of their range, in {broken} of {len(expected.fresh.violation)} fresh loops "
        f"by more than {to_percent(KEPT)}"
    )


def _give_advice(rows: Sequence[DesignRow], best: int, linear: int | None, expected: ExpectedLoop) -> list[str]:
    """Return sentences on what limits the closed loop, and which data would help."""
    said: list[str] = []
    row, runs = rows[best], len(expected.cost) + len(expected.cost_off)
    if expected.lost:
        said.append(
            f"{expected.lost} of {runs} runs were lost: the loop went where there are no data, or fell over; collect "
            "episodes around the reference and on the way to it, ask for less, or start nearer; where the plant falls "
            "over by itself, km.stabilise finds a feedback under which it can be excited, from short episodes near its "
            "equilibrium, and without the plant at hand only logs taken under some feedback, with noise on top, will do"
        )
    if expected.fresh is not None and expected.lost_bound > WORRY and np.sum(~np.isfinite(expected.fresh.cost)) > 0:
        said.append(
            f"{int(np.sum(~np.isfinite(expected.fresh.cost)))} of {len(expected.fresh.cost)} fresh loops were lost, so "
            f"that up to {to_percent(expected.lost_bound)} may be: do not switch it on before a `koopmpc check`, and "
            "record episodes where `design.expected.fresh` is lost"
        )
    known = expected.cost[np.isfinite(expected.cost)]
    if not known.size:
        said.append("every run with inputs as in the data was lost: trust no controller of these data")
    if (over := _describe_violation(row, expected)) != "":
        said.append(
            f"limits are violated by up to {over}; collect data near the limits, or ask for limits further inside"
        )
    if row.worst > 2 and not expected.lost:
        said.append(
            f"in its worst run the controller costs {row.worst:.2g} times the best of all in that run: what is best "
            "differs from surrogate to surrogate; more episodes would make them agree"
        )
    if linear is None:
        said.append("no linear model came through")
    elif linear != best and rows[linear].score > 1.2 * row.score:
        said.append(
            f"the best linear controller costs about {rows[linear].score / row.score:.2g} times as much: what an input "
            "does depends on the state"
        )
    return said
