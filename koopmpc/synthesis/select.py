"""select: lifting, embedding, ridge and kind of model, chosen by multi-step cross-validation over episodes.

Of long records the best of each kind also run freely over stretches that no fit saw, and that decides.
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.angles import count_wraps
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.errors import DataError, FitWarning, hide_fit_warnings
from koopmpc.identify.fits.edmd import edmd
from koopmpc.identify.moments.read import ReadOptions
from koopmpc.identify.records.structure import Structure, find_forecast_horizon
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.state import Constant, State
from koopmpc.parallel import Progress, StageProgress, map_tasks
from koopmpc.predict.base import replace_report
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.synthesis.candidates import (
    Candidate,
    check_delays,
    expand_candidates,
    find_constant_states,
    fit_candidate,
    propose_candidates,
)
from koopmpc.synthesis.cross_validation import (
    EXACT,
    LEAST,
    Trial,
    check_ridges,
    cross_validate,
    cut_blocks,
    make_folds,
    replace_glitches,
    smooth_data,
    take_sample,
    usual_horizon,
)
from koopmpc.synthesis.feedback import remove_feedback, require_episodes
from koopmpc.synthesis.hidden_states import judge_hidden_states
from koopmpc.synthesis.leaderboard import Selection, choose_model, make_row
from koopmpc.synthesis.records import (
    advance_inputs,
    is_late,
    judge_finalists,
    propose_structures,
    refine_structure,
    run_structure,
)
from koopmpc.validate.memory import find_hidden_state
from koopmpc.validate.scoring import AnyPredictor, score

FEW = 10  # records are fewer episodes than this, which select would cut into blocks
LONG = 150  # steps: half of the data are in episodes at least as long, so that a free run says something
OUTPUTS = 4  # states of a record at most: with more the search for terms takes too long
ENOUGH = 1e-2  # error of a forecast, as a share of the states' spread, below which a controller gains nothing
_NEAR = 10  # steps of the forecasts that say whether more of the past is worth a trial
_GAINS = 0.9  # it is, where two past steps lower the error of one to this share
_LONGER = (4,)  # then these are tried too
_EPISODES = 8  # of which a quarter is forecast
RIDGES = tuple(10.0**power for power in range(-9, -2))
LATE_COLUMN = (
    "the inputs were moved up by one row: the log's row k holds the outputs after its inputs have acted; "
    "model.align(logs) does the same to other logs"
)
FEEDTHROUGH = (
    "the inputs act on outputs at once, and were moved up by one row: give a controller's estimator feedthrough=True; "
    "model.align(logs) moves them in other logs"
)

ROUGH = "the chosen model is fitted to the rows as they were measured: smoothed ones forecast unseen rows no better"


def is_record(episodes: Episodes) -> bool:
    """Return whether these are a few long records of few signals, on which models run freely."""
    lengths = np.sort([len(episode) for episode in episodes])[::-1]
    half = int(lengths[np.argmax(np.cumsum(lengths) >= lengths.sum() / 2)])
    return len(lengths) < FEW and half >= LONG and episodes.nx <= OUTPUTS and episodes.nw == 0


def check_feedthrough(feedthrough: bool, source: Source) -> None:
    """Raise a DataError where the data cannot be those of a plant whose inputs act on its outputs at once."""
    checks.kind(feedthrough, "feedthrough", (bool, np.bool_), "pass True or False")
    if feedthrough and not source.nu:
        raise DataError("feedthrough says how inputs act, and the data have none; give each Episode its U")


def mark_lead(model: AnyPredictor, lead: int, sentence: str) -> AnyPredictor:
    """Return the model with `lead` as the `input_lead` of its report, and a sentence on it; itself if that is 0."""
    report = model.report
    if not lead or report is None:
        return model
    return replace_report(model, replace(report, input_lead=lead, changes=(*report.changes, sentence)))


def extend_past(past: Sequence[int], learned: Episodes, measured: Episodes) -> list[int]:
    """Return the past steps to try where a hidden state shows: more if two of them forecast better than one.

    Linear models of the `learned` rows forecast `measured` rows of every fourth episode, which they did not see: of
    smoothed rows a model would know from the past what only the future told. Fewer than eight episodes are cut into
    blocks; where these are too short, more past steps are tried.
    """
    if len(measured) < _EPISODES:
        share = -(-_EPISODES // len(measured))
        learned, measured = (
            each.with_episodes([block for e in each for block in cut_blocks(e, max(len(e) // share, 1))])
            for each in (learned, measured)
        )
    unseen = [i for i, e in enumerate(measured) if i % 4 == 0 and len(e) > 3 * max(past)]
    if len(unseen) < 2:
        return [*past, *_LONGER]
    seen = learned.with_episodes([e for i, e in enumerate(learned) if i % 4])
    ahead = min(_NEAR, min(len(measured[i]) for i in unseen) - 2)
    errors: list[float] = []
    with hide_fit_warnings():
        for steps in (1, 2):
            model = edmd(seen, State() + Constant(), embedding=Delay(steps))
            same = measured.with_episodes([measured[i].cut(2 - steps, len(measured[i])) for i in unseen])
            errors.append(float(np.mean(score(model, same, ahead).rmse)))
    return [*past, *_LONGER] if errors[1] < _GAINS * errors[0] else list(past)


def select(
    episodes: Episodes | Source,
    *,
    candidates: Sequence[Candidate | Lifting] | None = None,
    horizon: int | None = None,
    folds: int = 5,
    ridges: ArrayLike | None = None,
    delays: Sequence[int] | None = None,
    bilinear: bool = True,
    relift: bool = True,
    smooth: bool = True,
    feedthrough: bool = False,
    instruments: Sequence[ArrayLike] | None = None,
    sample: int = 30_000,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: StageProgress | None = None,
    rng: np.random.Generator | int = 0,
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
    episodes
        Several episodes, for no fold cuts through one, or a Source that can be read again. Fewer than twice the folds
        are cut into blocks first, and the notes say so.
    candidates
        Liftings, each of which is tried with all `delays` and both kinds; or `Candidate`, each as it stands. By default
        linear, polynomial, trigonometric, radial and random ones, for plants of 2 to 12 states.
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
    delays
        Past steps to try in an embedding; by default 0, 1 and 2, also 4 where the data show a hidden state and two past
        steps forecast better than one, and of records up to 12.
    bilinear
        Try z⁺ = A z + B u + E w + Σ uᵢ Nᵢ z + Σ wⱼ Sⱼ z too, where there are inputs.
    relift
        Judge a bilinear model by forecasts that lift afresh at each step, as BilinearMPC plans, `step_map()` simulates
        and `score(relift=True)` measures; then errors below 1 % of the spread are all alike, for a controller corrects
        them at the next step, and small models go wrong less where there are few data. False: by forecasts in z, as
        `rollout` predicts and a linear model is judged, and as exactly as the data allow.
    smooth
        Replace glitches with a `Mender`, and where the states hold noise, free them of it with a `Smoother`. Least
        squares on noisy states makes an unstable plant look tame, and so do forecasts that begin at them. On records
        fits to the measured rows are tried too, and kept unless smoothing gains on unseen rows. The notes tell what
        was found.
    feedthrough
        The plant has y = h(x, u): row k of the log holds the outputs under u_k. One log cannot tell this from a late
        input column, which `select` looks for otherwise. The inputs are moved one row up in any case; an estimator
        with ``feedthrough=True`` then reads h(x_k, u_{k−1}), for the model's next output is h(x_k, u_k).
    instruments
        For each episode (T, nr) or (T + 1, nr) rows of the set point of the loop that made the logs, or of a signal
        added to its inputs. Where the logs hold feedback, least squares is found biased and unseen rows gain, models
        are fitted to what these rows explain of states and inputs (two-stage method); the notes say whether.
    sample
        Snapshot pairs to choose on, about.
    workers, scheduler
        As in `koopmpc.parallel.map_tasks`: a candidate is a task, and then a part of the source.
    progress
        Called with what is done, how many of it are, and how many there are, None where that is not known.
    rng
        Deals out the episodes, draws centres and features.

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
    draw, used = checks.generator(rng), ""
    checks.kind(smooth, "smooth", (bool, np.bool_), "pass True or False")
    if instruments is not None or (
        smooth and isinstance(episodes, Episodes) and not (candidates is None and is_record(episodes))
    ):
        loop = remove_feedback(require_episodes(episodes), instruments)
        episodes, used = loop.episodes, loop.sentence
        smooth = smooth and not loop.noise.any()
    source = source_of(episodes)
    check_feedthrough(feedthrough, source)
    weights = RIDGES if ridges is None else check_ridges(ridges)
    folds = checks.count(folds, "folds", 2)
    past = check_delays((0, 1, 2) if delays is None else delays)
    held, notes = take_sample(source, checks.count(sample, "sample"))
    notes = (*notes, used) if used else notes
    for i, count in count_wraps(held).items():
        warnings.warn(
            f"{held.states[i]} jumps by 2π {count} times: it was wrapped, and a model of it as a state cannot follow; "
            "unwrap it first, with numpy.unwrap along each episode",
            FitWarning,
            stacklevel=2,
        )
    for name in find_constant_states(held):
        warnings.warn(
            f"{name} is constant in these data, so what it does cannot be learned; excite it, or leave it out",
            FitWarning,
            stacklevel=2,
        )
    checks.kind(bilinear, "bilinear", bool, "pass True or False")
    both = bilinear and source.nu > 0
    record = candidates is None and is_record(held)
    if smooth:
        source, held, replaced = replace_glitches(source, held)
        notes = (*notes, *replaced)
    lead, moved = int(feedthrough or (record and is_late(held))), FEEDTHROUGH if feedthrough else LATE_COLUMN
    if lead:
        source, held = advance_inputs(source, held)
        notes = (*notes, moved)
    measured = source, held
    if smooth:
        source, held, freed, _ = smooth_data(source, held)
        notes = (*notes, *freed)
    memory = find_hidden_state(measured[1]) if max(past) and not record else None
    hidden = memory is not None and memory.shows_hidden_state
    if hidden:
        past = past if delays is not None else extend_past(past, held, measured[1])
        notes = (*notes, f"{memory}; models with delays are tried, and need not halve the error")
    given = (
        propose_candidates(held, past, both, draw)
        if candidates is None
        else expand_candidates(candidates, held, past, both)
    )
    if record:
        told = report_stage(progress, "sparse polynomials")
        given += propose_structures(measured[1], None if delays is None else past, bilinear, told)
    first = max(one.delays for one in given)
    ahead, short = usual_horizon(held, first) if horizon is None else (checks.count(horizon, "horizon"), ())
    nearer = max(ahead, find_forecast_horizon(measured[1])) if record and horizon is None else ahead
    data = make_folds(held, ahead + first, folds, draw)
    rough = make_folds(measured[1], ahead + first, folds, draw).episodes if record else data.episodes
    trials = [
        Trial(one, data.episodes, data.fold, ahead, first, weights, relift=relift)
        if one.structure is None
        else Trial(one, rough, data.fold, ahead, first, (0.0,))
        for one in given
    ]
    told = report_stage(progress, "candidates")
    results = list(map_tasks(cross_validate, trials, workers=workers, scheduler=scheduler, progress=told))
    # on a grid of decades the one nearest to ε² is the first
    floor = LEAST if ridges is not None else min(result.misfit for result in results) / np.sqrt(10)
    rows = tuple(sorted((make_row(result, floor) for result in results), key=lambda row: (row.worst, row.size)))
    alike = ENOUGH if relift else EXACT
    if record:
        told = report_stage(progress, "hidden states")
        sparse = {one.kind: one.structure for one in given if isinstance(one.structure, Structure)}
        rival = min((one.error for one in sparse.values()), default=np.inf)
        runs = {kind: run_structure(one, measured[1], first, nearer) for kind, one in sparse.items()}
        ran = judge_hidden_states(measured[1], first, ahead, both, rival, ran=runs, short=nearer, progress=told)
        told = report_stage(progress, "free runs")
        rows, chosen, found = judge_finalists(rows, held, measured[1], first, nearer, runs, told, ran)
        if held is not measured[1] and (rows[chosen].rough or rows[chosen].structure is not None):
            notes = (*notes, ROUGH)
    else:
        kinds = {row.kind for row in rows}
        found = {
            kind: choose_model(rows, kind, alike, hidden=hidden) for kind in ("linear", "bilinear") if kind in kinds
        }
        chosen = choose_model(rows, alike=alike, hidden=hidden)
        found |= {"bilinear": chosen} if rows[chosen].bilinear else {}
    linear = found.get("linear", chosen)
    for place, which in ((chosen, f"all {len(rows)} candidates"), (linear, "all linear candidates")):
        if not np.isfinite(rows[place].worst):
            warnings.warn(
                f"the forecasts of {which} run away within {ahead} steps, and the smallest is taken: trust no "
                "controller of it; pass a shorter horizon, or candidates that know the plant",
                FitWarning,
                stacklevel=2,
            )
            break

    refined: dict[int, int] = {}

    def refit(place: int) -> AnyPredictor:
        row = rows[place]
        read = ReadOptions(workers=workers, scheduler=scheduler, progress=report_stage(progress, f"fit of {row.title}"))
        smoothed = row.structure is None and not row.rough
        model = fit_candidate(row.candidate, source if smoothed else measured[0], row.ridge, read)
        if isinstance(row.structure, Structure):
            model, refined[place] = refine_structure(row.structure, model, measured[1], first, nearer)
        return mark_lead(model, lead, moved)

    models = {place: refit(place) for place in dict.fromkeys([*found.values(), chosen])}
    best_linear, best_bilinear = models[linear], models[found.get("bilinear", chosen)]
    return Selection(
        predictor=models[chosen],
        linear=best_linear if isinstance(best_linear, LinearPredictor) else None,
        leaderboard=rows,
        chosen=chosen,
        chosen_linear=linear,
        horizon=ahead,
        folds=data.number,
        notes=(*notes, *short, *data.notes),
        bilinear=best_bilinear if isinstance(best_bilinear, BilinearPredictor) else None,
        refined=refined.get(chosen, 0),
    )


def report_stage(progress: StageProgress | None, name: str) -> Progress | None:
    """Return what is called with the progress of one stage."""
    return None if progress is None else partial(progress, name)
