"""Faults of logs before a fit: rows are left out or bridged, and columns are left out or unwrapped.

Suspected rows of a record are left out only where models forecast sound, unseen rows better without them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.base.errors import DataError, KoopmpcError, hide_fit_warnings
from koopmpc.base.text import with_unit
from koopmpc.data.angles import count_wraps
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.source import Changed, Source
from koopmpc.lifting.state import Constant, Monomials, State
from koopmpc.models.fits.edmd import edmd
from koopmpc.models.predictors import LinearPredictor
from koopmpc.synthesis.search.data import is_record
from koopmpc.validate.logs.audit import Remainder, audit
from koopmpc.validate.logs.log import LogFault, Place, Repair, list_places
from koopmpc.validate.scoring import forecast_errors

_BRIDGED = 3  # rows of a wild reading, at most, that neighbours replace
_FOLDS = 4  # stretches that are left out in turn
_AHEAD = 10  # steps of the forecasts that judge
_PAST = 2  # past rows of the models
_QUADRATIC = 3  # states and inputs up to which the models hold products of two
_STARTS = 400  # forecasts of one stretch, at most
_MARGIN = 0.95  # the median error must fall to this share, or the rows stay
_FORECASTS = 20  # forecasts that a comparison needs
_LEAST = 0.5  # rows at fault are left out if at least this share of the steps remains


class Audited(NamedTuple):
    """Episodes after the audit."""

    rest: Episodes  # without the rows that `decide_places` leaves out
    notes: tuple[str, ...]  # the faults, with what was done about each, in sentences
    delay: int  # steps of the past that a model needs for signals that are late
    origins: tuple[Place, ...]  # place of each of these episodes in the logs
    doubtful: tuple[Place, ...]  # places that are suspected, and were kept


def audit_episodes(episodes: Episodes, *, cut: bool = True) -> Audited:
    """Return the episodes without the rows that `decide_places` leaves out, unless less than half of the steps remain.

    With `cut` False the episodes are only a sample of the data, so that nothing can be left out.
    """
    report = audit(_drop_repeats(episodes))
    left, kinds, mended, out = Remainder.of(episodes), set[str](), set[str](), set[str]()
    if cut:
        kinds = decide_places(episodes, report.faults)
        bridged, mended = bridge_spikes(episodes, report.faults)
        left = Remainder.of(bridged)
        bad = [place for fault in report.faults if fault.name in kinds - mended for place in fault.places]
        sound = left.without(bad) if bad else None
        if sound is not None and sum(map(len, sound.data)) >= _LEAST * sum(map(len, episodes)):
            left, out = sound, kinds - mended
    to_leave_out = kinds if cut else {fault.name for fault in report.faults}
    notes = [
        f"{fault.name}: {_locate_fault(fault, episodes)}; {_say_repair(fault, mended, out, to_leave_out)}"
        for fault in report.faults
        if fault.repair is not Repair.COLUMN  # `find_repairs` says what it does
    ]
    notes += [f"input timing: {doubt}" for doubt in report.doubts]
    if report.memory is not None and report.memory.shows_hidden_state:
        notes.append(f"hidden state: {report.memory}; models with delays are tried")
    kept = [fault for fault in report.faults if fault.name not in out | mended]
    doubtful = tuple(place for fault in kept for place in fault.places)
    return Audited(left.data, tuple(notes), report.delay, left.origins, doubtful)


def _say_repair(fault: LogFault, mended: set[str], out: set[str], to_leave_out: set[str]) -> str:
    """Return what is done about a fault whose kind was mended, left out, or should have been left out."""
    if fault.name in mended:
        return "these readings were replaced by the line between their neighbours"
    if fault.places and fault.name in out:
        return "these rows were left out"
    if fault.places and fault.name not in to_leave_out:
        return "these rows were kept: models without them forecast the other rows no better"
    if fault.steps:
        return f"models that see {fault.steps} steps of the past are tried: embedding=km.Delay({fault.steps})"
    return fault.do


def _drop_repeats(episodes: Episodes) -> Episodes:
    """Return the episodes without columns that repeat another one: beside its copy no input seems to act on a state."""

    def find_first(columns: Float[np.ndarray, "m n"]) -> list[int]:
        return [i for i in range(columns.shape[1]) if not (columns[:, :i] == columns[:, [i]]).all(axis=0).any()]

    X, V = (np.concatenate(rows) for rows in zip(*((e.X, np.hstack([e.U, e.W])) for e in episodes), strict=True))
    nu, driven = episodes.nu, find_first(V)
    states, inputs = find_first(X), [i for i in driven if i < nu]
    return ColumnRepair(tuple(states), tuple(inputs), tuple(i - nu for i in driven if i >= nu), (), ("repeats",))(
        episodes
    )


_NAMED = 3  # places of a fault that a note names


def _locate_fault(fault: LogFault, episodes: Episodes) -> str:
    """Return what is wrong; of episodes that were read from tables the places are named by file, line and value."""
    if any(episodes[place.episode].origin is None for place in fault.places):
        return fault.says
    named = "; ".join(_locate(place, fault.columns, episodes) for place in fault.places[:_NAMED])
    rest = f"; and {len(fault.places) - _NAMED} more" if len(fault.places) > _NAMED else ""
    return fault.says.replace(list_places(fault.places), named + rest)


def _locate(place: Place, columns: tuple[str, ...], episodes: Episodes) -> str:
    """Return file and lines of the rows at fault; for a single row of a single state its value too."""
    episode = episodes[place.episode]
    assert episode.origin is not None
    state = next((name for name in columns if name in episodes.states), None)
    if state is None or place.last > place.first + 1:
        first, last = episode.origin.numbers[episode.origin.at[[place.first, place.last - 1]]]
        return episode.origin.place(int(first), int(last))
    sound = episode.X[max(place.first - 1, 0), episodes.states.index(state)]
    number, value = episode.origin.locate(place.first, state, float(sound))
    return f"{episode.origin.place(number)} ({with_unit(state, f'= {value:.5g}')})"


@dataclass(frozen=True)
class ColumnRepair:
    """What is done to episodes before a fit: some columns are left out, and angles are unwrapped."""

    states: tuple[int, ...]  # indices of the columns that are kept
    inputs: tuple[int, ...]
    disturbances: tuple[int, ...]
    unwrapped: tuple[int, ...]  # indices of the states, before any was left out, that are unwrapped along each episode
    notes: tuple[str, ...]  # what was found, in sentences

    def __call__(self, episodes: Episodes) -> Episodes:
        """Return the repaired episodes, or the episodes themselves where there is nothing to repair."""
        if not self.notes:
            return episodes
        repaired: list[Episode] = []
        for e in episodes:
            X = e.X.copy()
            if self.unwrapped:
                X[:, self.unwrapped] = np.unwrap(X[:, self.unwrapped], axis=0)
            U, W = e.U[:, self.inputs], e.W[:, self.disturbances]
            repaired.append(Episode(X=X[:, self.states], U=U, W=W, origin=e.origin))
        return Episodes(repaired, episodes.dt, *self._names(episodes))

    def source(self, source: Source) -> Source:
        """Return the source of repaired episodes."""
        return Changed(source, self, *self._names(source)) if self.notes else source

    def _names(self, of: Episodes | Source) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
        return (
            tuple(of.states[i] for i in self.states),
            tuple(of.inputs[i] for i in self.inputs),
            tuple(of.disturbances[i] for i in self.disturbances),
        )


def find_repairs(episodes: Episodes) -> ColumnRepair:
    """Return the repairs that these episodes need; a DataError where no state moves, or no input."""
    notes: list[str] = []
    X = np.concatenate([e.X for e in episodes])
    driven = np.concatenate([np.hstack([e.U, e.W]) for e in episodes])
    nu = episodes.nu
    states = _find_useful(X, episodes.states, notes)
    both = _find_useful(driven, (*episodes.inputs, *episodes.disturbances), notes)
    if not states:
        raise DataError(
            f"no state moves: {', '.join(episodes.states)} are constant; check the columns, or pass --states"
        )
    if nu and not [i for i in both if i < nu] and not np.ptp(driven[:, :nu], axis=0).any():
        still = ", ".join(
            f"{name} is {value:g} throughout" for name, value in zip(episodes.inputs, driven[0], strict=False)
        )
        raise DataError(
            f"no input moves: {still}, so what it does cannot be learned; record a run in which it moves, or name "
            'other columns: --inputs "u", or --states "y" --inputs "" for a plant that runs by itself'
        )
    turns = {i: count for i, count in count_wraps(episodes).items() if i in states}
    for i, count in turns.items():
        notes.append(
            f"{episodes.states[i]} jumped by 2π {count} times and was unwrapped along each episode; the model "
            "continues it beyond ±π"
        )
    return ColumnRepair(
        tuple(states),
        tuple(i for i in both if i < nu),
        tuple(i - nu for i in both if i >= nu),
        tuple(turns),
        tuple(notes),
    )


def _find_useful(columns: Float[np.ndarray, "m n"], names: tuple[str, ...], notes: list[str]) -> list[int]:
    """Return the columns that move and do not repeat an earlier one."""
    kept: list[int] = []
    for i, name in enumerate(names):
        column = columns[:, i]
        twin = next((names[j] for j in kept if np.array_equal(column, columns[:, j])), None)
        if np.ptp(column) == 0:
            notes.append(f"left out: {name} is {column[0]:g} throughout, so what it does cannot be learned")
        elif twin is not None:
            notes.append(f"left out: {name} repeats {twin}")
        else:
            kept.append(i)
    return kept


def decide_places(episodes: Episodes, faults: Sequence[LogFault]) -> set[str]:
    """Return the kinds of faults whose rows are to be left out.

    Rows that are wild readings, gaps or copies of others always are, and so are all rows at fault where the data are
    many episodes. In a record, a sensor at rest, at its limit, coarse or slow shows equal rows that may be sound. They
    go only if a model that does not learn from them has the smaller median error of forecasts over unseen rows that no
    check suspects: 5 % smaller over all stretches, and smaller on three stretches of four.
    """
    chosen = {fault.name for fault in faults if fault.places}
    if not is_record(episodes):
        return chosen
    wild = [p for fault in faults if fault.repair is not Repair.TRY_WITHOUT for p in fault.places]
    suspected = [p for fault in faults for p in fault.places]
    for name in sorted({fault.name for fault in faults if fault.places and fault.repair is Repair.TRY_WITHOUT}):
        places = [p for fault in faults if fault.name == name for p in fault.places]
        if not gains_without(episodes, places, suspected, wild):
            chosen.remove(name)
    return chosen


def bridge_spikes(episodes: Episodes, faults: Sequence[LogFault]) -> tuple[Episodes, set[str]]:
    """Return records with single wild readings on the line between their neighbours, and the kinds of faults so mended.

    A record that is cut at each of them falls into pieces too short for a free run. Lost samples in longer rows, and
    those at an end, stay, and so do many short episodes.
    """
    short = {
        fault.name
        for fault in faults
        if fault.repair is Repair.BRIDGE and all(p.last - p.first <= _BRIDGED for p in fault.places) and fault.places
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

    Rows at fault, `suspected`, judge nothing, and no model learns from those that are `wild`.
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
    if count < _FORECASTS:
        raise DataError("too few rows judge a forecast")
    apart = -(-count // _STARTS)
    starts = [np.arange(0, len(e) - _AHEAD + 1, apart) for e in points]
    return np.concatenate([gap for gap, _ in forecast_errors(model, points, starts, _AHEAD)], axis=1)
