"""select: lifting, embedding, ridge and kind of model, chosen by multi-step cross-validation over episodes.

Of long records the best of each kind also run freely over stretches that no fit saw, and that decides.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import FitWarning, refuse_moved
from koopmpc.base.parallel import map_tasks, report_stage
from koopmpc.data.angles import count_wraps
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.models.moments.read import ReadOptions
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.models.records.structure import Structure, find_forecast_horizon
from koopmpc.synthesis.options import SearchOptions, check_options
from koopmpc.synthesis.search.candidates import (
    Candidate,
    check_delays,
    find_constant_states,
    fit_candidate,
    list_candidates,
)
from koopmpc.synthesis.search.cross_validation import EXACT, LEAST, RIDGES, Trial, Tried, check_ridges, cross_validate
from koopmpc.synthesis.search.data import is_record
from koopmpc.synthesis.search.folds import Folds, make_folds, usual_horizon
from koopmpc.synthesis.search.free_runs import judge_finalists, run_structure
from koopmpc.synthesis.search.hidden_states import judge_hidden_states
from koopmpc.synthesis.search.leaderboard import LeaderboardRow, Selection, choose_model, make_row
from koopmpc.synthesis.search.prepare import PreparedData, list_delays, prepare_data, take_out_noise
from koopmpc.synthesis.search.records import propose_structures, refine_structure
from koopmpc.validate.scoring import AnyPredictor

ENOUGH = 1e-2  # error of a forecast, as a share of the states' spread, below which a controller gains nothing
ROUGH = "the chosen model is fitted to the rows as they were measured: smoothed ones forecast unseen rows no better"
FEEDTHROUGH = (
    "the inputs act on outputs at once, and were moved up by one row: give a controller's estimator feedthrough=True; "
    "model.align(logs) moves them in other logs"
)


def select(
    data: Episodes | Source,
    *,
    horizon: int | None = None,
    folds: int = 5,
    ridges: ArrayLike | None = None,
    relift: bool = True,
    options: SearchOptions | None = None,
    **moved: Any,
) -> Selection:
    """Choose the model with min over models of max over folds of the mean log error, h = 1 … horizon steps ahead.

    Each candidate is fitted to all folds but one and rolled out over that one, over the whole horizon, for a model
    with small one-step errors need not predict a horizon well. Its score is the geometric mean of its errors over the
    horizon, so that the next step counts as much as the last one, where the errors of an unstable plant are largest;
    the winner is fitted to all data. An error is relative to the state's standard
    deviation, so neither units nor where zero is count; a forecast that runs away counts as infinite, and no such
    model is taken while there is another. The models are ranked by their worst fold, and of all within one standard
    error of the best the smallest is taken (Breiman et al. 1984), one with delays only where that halves the error, and
    a linear one that grows three times as much over the horizon as the smallest one, max(ρ(A), 1)ʰ, only where that
    halves the error at the horizon's end.

    Fewer than ten long episodes of at most four states are records. On records sparse polynomials of up to 12 past rows
    are tried too, as `km.identify.narx` finds them, and hidden states, as `km.identify.subspace`,
    `km.identify.polynomial_state_space` and `km.identify.neural_state_space` find them; the best models of each kind
    run freely over stretches that no fit saw. The geometric mean of their errors in free run and in forecasts of the
    horizon then decides, over all kinds together and without a rule on delays. A model whose free run leaves three
    times the range of the data is taken only where all do. If models with the inputs one row up err by 20 % less, and
    nothing speaks of feedback, the log's input column is late: the model has ``input_lead`` 1, and
    ``model.align(logs)`` moves the inputs of other logs.

    A source larger than memory is chosen on a sample of it, whole episodes from evenly spread parts; the winner is
    then fitted to all of it, part by part.

    Parameters
    ----------
    data
        Several episodes, for no fold cuts through one, or a Source that can be read again. Fewer than twice the folds
        are cut into blocks first, and the notes say so.
    horizon
        Steps ahead: pass the controller's horizon. By default 20; fewer, and a note says so, where most of the
        data are in shorter episodes.
    folds
        At least 2.
    ridges
        Weights to try, as in `edmd`; those below 1e-9 are raised to it. Linear models without delays are fitted with
        ``towards="affine"``, see `edmd`. By default 1e-9 to 1e-3 by decades, for models with delays from ε² on, ε the
        share of the states' spread that the best candidate misses in one step: what the data hold of noise, or of what
        no candidate knows. Noise ε in the regressors adds M ε² σ² = ε² ‖p − p̄‖² to the diagonal of PᵀP, which is a
        ridge ε² on deviations of unit norm. With less, a state and its past, which are almost functions of each other,
        get large weights of opposite signs, which cancel on the training data alone.
    relift
        Judge a bilinear model by forecasts that lift afresh at each step, as BilinearMPC plans, `step_map()` simulates
        and `score(relift=True)` measures; then errors below 1 % of the spread are all alike, for a controller corrects
        them at the next step, and small models go wrong less where there are few data. False: by forecasts in z, as
        `rollout` predicts and a linear model is judged, and as exactly as the data allow.
    options
        What is tried, what is done to the data first, and where it is computed, see `SearchOptions`.

    Raises
    ------
    DataError
        Too few steps for two folds of one horizon; a stream that can be read once only; no candidate; a negative ridge;
        feedthrough of data without inputs.
    KoopmpcError
        A worker died on the same task each time, or no scheduler answers.

    Warns
    -----
    FitWarning
        A state jumps by 2π: it was wrapped, and no model can follow that; every candidate's forecasts run away; or the
        chosen fit itself is doubtful.

    References
    ----------
    Breiman, Friedman, Olshen & Stone, "Classification and Regression Trees", 1984, section 3.4.3.
    """
    if moved:
        refuse_moved(moved, SearchOptions, "km.SearchOptions")
    options = check_options(options, SearchOptions)
    draw = checks.generator(options.rng)
    weights, folds = RIDGES if ridges is None else check_ridges(ridges), checks.count(folds, "folds", 2)
    ahead = None if horizon is None else checks.count(horizon, "horizon")
    feedback = isinstance(data, Episodes) and not (options.candidates is None and is_record(data))
    prepared = prepare_data(data, options, feedback=feedback, feedthrough=FEEDTHROUGH)
    for sentence in _list_doubts(prepared.held):
        warnings.warn(sentence, FitWarning, stacklevel=2)
    prepared = take_out_noise(prepared)
    plan = _plan_search(prepared, options, (ahead, folds), draw)
    trials = _list_trials(plan, weights, relift)
    told = report_stage(options.progress, "candidates")
    results = list(
        map_tasks(cross_validate, trials, workers=options.workers, scheduler=options.scheduler, progress=told)
    )
    # on a grid of decades the one nearest to ε² is the first
    floor = LEAST if ridges is not None else min(result.misfit for result in results) / np.sqrt(10)
    ranked = _choose_row(plan, options, results, floor, ENOUGH if relift else EXACT)
    for place, which in (
        (ranked.chosen, f"all {len(ranked.rows)} candidates"),
        (ranked.linear, "all linear candidates"),
    ):
        if not np.isfinite(ranked.rows[place].worst):
            warnings.warn(
                f"the forecasts of {which} run away within {plan.horizon} steps, and the smallest is taken: trust no "
                "controller of it; pass a shorter horizon, or candidates that know the plant",
                FitWarning,
                stacklevel=2,
            )
            break
    return _fit_chosen(plan, options, ranked)


@dataclass(frozen=True, eq=False)
class SearchPlan:
    """What a search tries, and on which folds."""

    data: PreparedData  # the prepared data
    candidates: Sequence[Candidate]  # bound candidates
    # folds, rough: episodes in folds, and the same episodes as they were measured
    folds: Folds
    rough: Episodes
    first: int  # past steps of the longest embedding: forecasts start there
    # horizon, near: steps ahead that models are judged by, and those of the short forecasts of free runs
    horizon: int
    near: int
    hidden: bool  # the data show a hidden state
    notes: tuple[str, ...]  # what was done to the data, in sentences


def _list_doubts(held: Episodes) -> list[str]:
    """Return sentences on columns that no model can follow."""
    wrapped = [
        f"{held.states[i]} jumps by 2π {count} times: it was wrapped, and a model of it as a state cannot follow; "
        "unwrap it first, with numpy.unwrap along each episode"
        for i, count in count_wraps(held).items()
    ]
    return wrapped + [
        f"{name} is constant in these data, so what it does cannot be learned; excite it, or leave it out"
        for name in find_constant_states(held)
    ]


def _plan_search(
    data: PreparedData, options: SearchOptions, sizes: tuple[int | None, int], draw: np.random.Generator
) -> SearchPlan:
    """Return the candidates and the folds; `sizes` are the horizon that was asked for, and the number of folds."""
    (horizon, folds), held, measured, delays = sizes, data.held, data.measured, options.delays
    past, memory = check_delays((0, 1, 2) if delays is None else delays), None
    if not data.record:
        past, memory = list_delays(data, delays)
    candidates = list_candidates(options.candidates, held, past, options.bilinear, draw)
    if data.record:
        told = report_stage(options.progress, "sparse polynomials")
        candidates += propose_structures(measured, None if delays is None else past, options.bilinear, told)
    first = max(one.delays for one in candidates)
    ahead, short = usual_horizon(held, first) if horizon is None else (horizon, ())
    near = max(ahead, find_forecast_horizon(measured)) if data.record and horizon is None else ahead
    dealt = make_folds(held, ahead + first, folds, draw)
    rough = make_folds(measured, ahead + first, folds, draw).episodes if data.record else dealt.episodes
    seen = () if memory is None else (f"{memory}; models with delays are tried, and need not halve the error",)
    notes = (*data.notes, *seen, *short, *dealt.notes)
    return SearchPlan(data, candidates, dealt, rough, first, ahead, near, memory is not None, notes)


def _list_trials(plan: SearchPlan, ridges: tuple[float, ...], relift: bool) -> list[Trial]:
    """Return a trial for each candidate; sparse polynomials are fitted without a ridge to the rows as measured."""
    fold, ahead, first = plan.folds.fold, plan.horizon, plan.first
    return [
        Trial(one, plan.folds.episodes, fold, ahead, first, ridges, relift=relift)
        if one.structure is None
        else Trial(one, plan.rough, fold, ahead, first, (0.0,))
        for one in plan.candidates
    ]


@dataclass(frozen=True, eq=False)
class RankedRows:
    """The leaderboard, and the places of the best row, of the best linear one, and of the best of each kind."""

    rows: tuple[LeaderboardRow, ...]
    chosen: int
    kinds: Mapping[str, int]
    notes: tuple[str, ...] = ()

    @property
    def linear(self) -> int:
        """Place of the best linear row; that of the best one where no linear one was tried."""
        return self.kinds.get("linear", self.chosen)


def _choose_row(
    plan: SearchPlan, options: SearchOptions, results: Sequence[Tried], floor: float, alike: float
) -> RankedRows:
    """Return the leaderboard with its choice: by free runs for records, else by the worst fold."""
    rows = tuple(sorted((make_row(result, floor) for result in results), key=lambda row: (row.worst, row.size)))
    if plan.data.record:
        return _choose_by_free_runs(plan, options, rows)
    kinds = {row.kind for row in rows}
    found = {
        kind: choose_model(rows, kind, alike, hidden=plan.hidden) for kind in ("linear", "bilinear") if kind in kinds
    }
    chosen = choose_model(rows, alike=alike, hidden=plan.hidden)
    return RankedRows(rows, chosen, found | ({"bilinear": chosen} if rows[chosen].bilinear else {}))


def _choose_by_free_runs(plan: SearchPlan, options: SearchOptions, rows: tuple[LeaderboardRow, ...]) -> RankedRows:
    held, measured = plan.data.held, plan.data.measured
    both = bool(options.bilinear) and held.nu > 0
    told = report_stage(options.progress, "hidden states")
    sparse = {one.kind: one.structure for one in plan.candidates if isinstance(one.structure, Structure)}
    rival = min((one.error for one in sparse.values()), default=np.inf)
    runs = {kind: run_structure(one, measured, plan.first, plan.near) for kind, one in sparse.items()}
    ran = judge_hidden_states(measured, plan.first, plan.horizon, both, rival, ran=runs, short=plan.near, progress=told)
    told = report_stage(options.progress, "free runs")
    rows, chosen, found = judge_finalists(rows, held, measured, plan.first, plan.near, runs, told, ran)
    rough = held is not measured and (rows[chosen].rough or rows[chosen].structure is not None)
    return RankedRows(rows, chosen, found, (ROUGH,) * rough)


def _fit_chosen(plan: SearchPlan, options: SearchOptions, ranked: RankedRows) -> Selection:
    """Return the selection: the best row, and the best of each kind, fitted to all data."""
    data, rows, refined = plan.data, ranked.rows, dict[int, int]()

    def refit(place: int) -> AnyPredictor:
        row = rows[place]
        told = report_stage(options.progress, f"fit of {row.title}")
        read = ReadOptions(workers=options.workers, scheduler=options.scheduler, progress=told)
        smoothed = row.structure is None and not row.rough
        model = fit_candidate(row.candidate, data.source if smoothed else data.measured_source, row.ridge, read)
        if isinstance(row.structure, Structure):
            model, refined[place] = refine_structure(row.structure, model, data.measured, plan.first, plan.near)
        return data.mark(model)

    models = {place: refit(place) for place in dict.fromkeys([*ranked.kinds.values(), ranked.chosen])}
    best_linear = models[ranked.linear]
    best_bilinear = models[ranked.kinds.get("bilinear", ranked.chosen)]
    return Selection(
        predictor=models[ranked.chosen],
        linear=best_linear if isinstance(best_linear, LinearPredictor) else None,
        leaderboard=rows,
        chosen=ranked.chosen,
        chosen_linear=ranked.linear,
        horizon=plan.horizon,
        folds=plan.folds.number,
        notes=(*plan.notes, *ranked.notes),
        bilinear=best_bilinear if isinstance(best_bilinear, BilinearPredictor) else None,
        refined=refined.get(ranked.chosen, 0),
    )
