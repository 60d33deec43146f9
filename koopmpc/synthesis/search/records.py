"""Long measured records: late input columns, sparse polynomial candidates, and their refinement."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from koopmpc.base.errors import KoopmpcError
from koopmpc.base.parallel import Progress
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Held
from koopmpc.models.base import change_model
from koopmpc.models.fits.refinement import refine
from koopmpc.models.predictors import BilinearPredictor
from koopmpc.models.records.free_run import PIECE
from koopmpc.models.records.hidden_structure import find_rails
from koopmpc.models.records.narx import DELAYS, choose_structure, search_structures
from koopmpc.models.records.structure import Structure, find_forecast_horizon, fit_structure
from koopmpc.synthesis.search.candidates import Candidate
from koopmpc.synthesis.search.data import smooth_data
from koopmpc.synthesis.search.free_runs import (
    PAYS,
    cut_pieces,
    fit_quietly,
    is_calm,
    is_surely_better,
    leave_quarters,
    measure_stretches,
    run_structure,
)
from koopmpc.synthesis.search.leaderboard import Selection
from koopmpc.validate.closed_loop import is_fed_back
from koopmpc.validate.scoring import AnyPredictor

MARGIN = 0.8  # the input column is moved up if that lowers the error on unseen rows to this share
_PROBE = (2, 4)  # past rows of the models that compare both timings of the inputs
_PROBED = 3000  # rows of each record that these models learn from, at most


def is_late(episodes: Episodes) -> bool:
    """Return whether the log's inputs stand a row too low: models with the inputs moved up do much better.

    Polynomials of degrees 2 and 3 in a few past rows are tried with both timings. The inputs are moved up only if the
    error on unseen rows falls to 80 %, in all but one of the blocks, and no feedback from the outputs can have made it
    fall.
    """
    if not episodes.nu or is_fed_back(episodes):
        return False
    part = episodes.with_episodes([e.cut(0, min(len(e), _PROBED)) for e in episodes])
    try:
        plain, moved = (
            min(search_structures(data, _PROBE, [2, 3], 30), key=lambda one: one.error)
            for data in (part, part.with_inputs_advanced(1))
        )
    except KoopmpcError:  # too short
        return False
    better = int(np.sum(moved.errors < plain.errors))
    return moved.error < MARGIN * plain.error and better >= len(plain.errors) - 1


def propose_structures(
    episodes: Episodes, delays: Sequence[int] | None, bilinear: bool, progress: Progress | None = None
) -> list[Candidate]:
    """Return the best sparse polynomial of these records and the best linear one; none where they are too short.

    The linear one of least error runs over long stretches too. It is taken in place of a smaller one that is as good on
    short pieces if it errs by a tenth less there, or alone stays near the data: of linear models only free runs tell
    slow growth.
    """

    def ask(_: str, done: int, total: int) -> None:
        if progress is not None:
            progress(done, total)

    try:
        tried = DELAYS if delays is None else delays
        found = search_structures(episodes, tried, ask=ask, rails=find_rails(episodes))
    except KoopmpcError:  # too short for any delay
        return []
    kinds = (False, True) if bilinear else (False,)
    same = ([one for one in found if one.is_nonlinear is kind] for kind in kinds)
    chosen = [
        _race(those, episodes) if not those[0].is_nonlinear else choose_structure(those) for those in same if those
    ]
    return [_make_candidate(one).bind(episodes.states, episodes.inputs) for one in chosen]


def _race(found: Sequence[Structure], measured: Episodes) -> Structure:
    """Return the structure that `choose_structure` takes, or the one of least error if it wins on long stretches."""
    small, best = choose_structure(found), min(found, key=lambda one: one.error)
    if best is small or max(map(len, measured)) <= PIECE:
        return small
    first, horizon = max(small.delays, best.delays), find_forecast_horizon(measured)
    own, other = (run_structure(one, measured, first, horizon) for one in (small, best))
    wins = other.error < PAYS * own.error if own.calm == other.calm else other.calm
    return best if wins else small


def _make_candidate(structure: Structure) -> Candidate:
    name = f"{structure.size} terms" + (f", degree {structure.degree}" if structure.is_nonlinear else "")
    return Candidate(name, structure.lifting, structure.delay, structure.is_nonlinear, structure)


def refine_structure(
    structure: Structure, model: AnyPredictor, data: Episodes, first: int, horizon: int
) -> tuple[AnyPredictor, int]:
    """Return the model refined on forecasts of many steps, and of how many; the model and 0 where unseen rows lose.

    In turn the structure is fitted without one quarter of each record and refined there, on segments of 2.5 and of 10
    horizons. Errors in free run and in short forecasts on the halves of the quarters, eight blocks, compare the model
    with the two refinements. A refinement wins if it errs less on most blocks, and by more than one standard error on
    average. The model of all rows is then refined in the same way.
    """
    truth, relift = cut_pieces(data), isinstance(model, BilinearPredictor)
    room = min(map(len, truth)) - max(DELAYS)  # of segments, which have a past
    before, after = list[float](), {h: list[float]() for h in (5 * horizon // 2, 10 * horizon) if h <= room}
    try:
        for spans, learned in leave_quarters(truth, truth, first):
            start = fit_structure(structure, learned)
            before += measure_stretches(start, truth, spans, first, horizon, relift=relift)
            for h, errors in after.items():
                one = _refine_long(start, learned, h)
                errors += measure_stretches(one, truth, spans, first, horizon, relift=relift)
        if not after:
            return model, 0
        best = min(after, key=lambda h: float(np.prod(after[h])))
        if not is_surely_better(np.array(after[best]), np.array(before)):
            return model, 0
        refined = refine(model, truth, horizon=best, held_out=truth)
    except KoopmpcError:  # a record is too short for its segments
        return model, 0
    calm = is_calm(refined, truth, first, relift) or not structure.calm
    return (refined, best) if calm else (model, 0)


def _refine_long(model: AnyPredictor, data: Episodes, horizon: int) -> AnyPredictor:
    """Return the model refined on the episodes that hold a segment of this length and its past."""
    long = data.with_episodes([e for e in data if len(e) >= horizon + max(DELAYS)])
    return refine(model, long, horizon=horizon, held_out=long)


def fit_again(selection: Selection, episodes: Episodes) -> AnyPredictor:
    """Return the chosen model of a selection fitted to other rows: the same observables, ridge and refinement."""
    row, data = selection.best, selection.predictor.align(episodes)
    if row.structure is None and not row.rough:
        data = smooth_data(Held(data), data)[1]
    model = fit_quietly(row.candidate, row.ridge, data)
    if selection.refined:
        pieces = cut_pieces(data)
        if max(map(len, pieces)) >= selection.refined + max(DELAYS):
            model = _refine_long(model, pieces, selection.refined)
    report = model.report
    if selection.predictor.input_lead and report is not None:
        model = change_model(model, report=replace(report, input_lead=selection.predictor.input_lead))
    return model
