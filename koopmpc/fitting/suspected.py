"""Suspected rows of logs: left out only where models forecast sound, unseen rows better without them."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import DataError, KoopmpcError, hide_fit_warnings
from koopmpc.identify.fits.edmd import edmd
from koopmpc.lifting.state import Constant, Monomials, State
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.synthesis.search.data import is_record
from koopmpc.validate.logs.audit import Remainder
from koopmpc.validate.logs.log import LogFault, Place
from koopmpc.validate.scoring import forecast_errors

WILD = ("spikes", "lost samples", "jump", "clock reset", "mixed sampling", "repeated episode")  # always left out
SHORT = ("spikes", "lost samples")  # wild readings that neighbours replace in a record
_BRIDGED = 3  # rows of a wild reading, at most, that neighbours replace
_FOLDS = 4  # stretches that are left out in turn
_AHEAD = 10  # steps of the forecasts that judge
_PAST = 2  # past rows of the models
_QUADRATIC = 3  # states and inputs up to which the models hold products of two
_STARTS = 400  # forecasts of one stretch, at most
_MARGIN = 0.95  # the median error must fall to this share, or the rows stay
_LEAST = 20  # forecasts that a comparison needs


def decide_places(episodes: Episodes, faults: Sequence[LogFault]) -> set[str]:
    """Return the kinds of faults whose rows are to be left out.

    Rows that are wild readings, gaps or copies of others always are, and so are all rows at fault where the data are
    many episodes. In a record, a sensor at rest, at its limit, coarse or slow shows equal rows that may be sound. They
    go only if a model that does not learn from them has the smaller median error of forecasts over unseen rows that no
    check suspects: 5 % smaller over all stretches, and smaller on three stretches of four.

    Parameters
    ----------
    episodes
        The logs.
    faults
        What the audit found.
    """
    named = {fault.name for fault in faults if fault.places}
    doubtful = named - set(WILD)
    if not doubtful or not is_record(episodes):
        return named
    wild = [place for fault in faults if fault.name in WILD for place in fault.places]
    chosen = named & set(WILD)
    for name in sorted(doubtful):
        own = [place for fault in faults if fault.name == name for place in fault.places]
        every = [place for fault in faults for place in fault.places]
        if gains_without(episodes, own, every, wild):
            chosen.add(name)
    return chosen


def bridge_spikes(episodes: Episodes, faults: Sequence[LogFault]) -> tuple[Episodes, set[str]]:
    """Return records with single wild readings on the line between their neighbours, and the kinds of faults so mended.

    A record that is cut at each of them falls into pieces too short for a free run. Lost samples in longer rows, and
    those at an end, stay, and so do many short episodes.
    """
    short = {
        fault.name
        for fault in faults
        if fault.name in SHORT and all(p.last - p.first <= _BRIDGED for p in fault.places) and fault.places
    }
    if not short or not is_record(episodes):
        return episodes, set()
    mended = [e.X.copy() for e in episodes]
    for fault in faults:
        for place in fault.places if fault.name in short else ():
            X, ends = mended[place.episode], [place.first - 1, place.last]
            ends = [row for row in ends if 0 <= row < len(X)]
            for i in (episodes.states.index(name) for name in fault.columns if name in episodes.states):
                X[place.first : place.last, i] = np.interp(range(place.first, place.last), ends, X[ends, i])
    return episodes.with_episodes([e.with_states(X) for e, X in zip(episodes, mended, strict=True)]), short


def gains_without(
    episodes: Episodes, places: Sequence[Place], suspected: Sequence[Place], wild: Sequence[Place] = ()
) -> bool:
    """Return whether models that do not learn from `places` forecast rows better that are in no `suspected` place.

    Parameters
    ----------
    episodes
        The logs.
    places
        Rows that may be left out.
    suspected
        All rows at fault, which judge nothing.
    wild
        Rows that no model learns from.
    """
    ratios: list[float] = []
    with hide_fit_warnings():
        for fold in range(_FOLDS):
            try:
                whole = _median_error(episodes, fold, wild, suspected)
                less = _median_error(episodes, fold, [*wild, *places], suspected)
            except KoopmpcError:  # too few rows on one side
                continue
            ratios.append(np.log(max(less, 1e-12) / max(whole, 1e-12)))
    enough = len(ratios) >= _FOLDS // 2
    return bool(enough and np.mean(ratios) < np.log(_MARGIN) and np.mean(np.array(ratios) < 0) >= 0.75)


def _median_error(episodes: Episodes, fold: int, out: Sequence[Place], suspected: Sequence[Place]) -> float:
    """Return the median error of forecasts, in spreads, over one stretch of each record by a model of the others."""
    spans = [(len(e) * fold // _FOLDS, len(e) * (fold + 1) // _FOLDS) for e in episodes]
    learned = _cut(episodes, out, spans, inside=False)
    judged = _cut(episodes, suspected, spans, inside=True)
    past = Delay(_PAST).match(episodes.states, episodes.inputs)
    lifting = State() + Constant()
    if episodes.nx + episodes.nu <= _QUADRATIC:
        lifting = State() + Constant() + Monomials(2)
    model = edmd(learned, lifting, embedding=past, ridge=1e-6)
    gaps = _forecast(model, judged)
    scale = np.concatenate([e.X for e in episodes]).std(axis=0)
    sizes = np.sqrt(np.mean((gaps / np.where(scale > 0, scale, 1.0)) ** 2, axis=(0, 2)))
    return float(np.median(np.minimum(sizes, 1e6)))


def _cut(episodes: Episodes, places: Sequence[Place], spans: Sequence[tuple[int, int]], *, inside: bool) -> Episodes:
    """Return pieces without these rows that lie inside of the spans, or outside, long enough for a forecast."""
    rest = Remainder.of(episodes).without(places)
    pieces: list[Episode] = []
    for piece, origin in zip(rest.data, rest.origins, strict=True) if rest is not None else ():
        low, high = (min(max(row - origin.first, 0), len(piece)) for row in spans[origin.episode])
        pieces += [piece.cut(a, b) for a, b in ([(low, high)] if inside else [(0, low), (high, len(piece))]) if b > a]
    least = _PAST + (_AHEAD if inside else 1)
    long = [piece for piece in pieces if len(piece) >= least]
    if not long:
        raise DataError("no piece is long enough")
    return episodes.with_episodes(long)


def _forecast(model: LinearPredictor, judged: Episodes) -> Float[np.ndarray, "horizon starts nx"]:
    """Return the errors of forecasts that begin at evenly spread rows."""
    points = model.embed(judged)
    count = sum(len(e) - _AHEAD + 1 for e in points)
    if count < _LEAST:
        raise DataError("too few rows judge a forecast")
    apart = -(-count // _STARTS)
    starts = [np.arange(0, len(e) - _AHEAD + 1, apart) for e in points]
    return np.concatenate([gap for gap, _ in forecast_errors(model, points, starts, _AHEAD)], axis=1)
