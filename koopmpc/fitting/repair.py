"""Logs before a fit: they are read, audited and repaired, and episodes are held out to judge the model."""

import warnings
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc.bench.store import RESULTS
from koopmpc.data.episodes import Episode, Episodes, joined
from koopmpc.data.sampling import UnevenSamplingError
from koopmpc.data.source import Changed, Held, Source, Subset
from koopmpc.data.storage import Files
from koopmpc.errors import ColumnWarning, DataError, FitWarning
from koopmpc.synthesis.candidates import jumps
from koopmpc.synthesis.cross_validation import blocks, sampled, usual_horizon
from koopmpc.validate.logs.audit import audit

Data = str | PathLike[str] | Iterable[str | PathLike[str]]
_OWN = b"# koopmpc.episodes"  # a table that begins so was written by Episodes.save
_SHORTER = "pass a shorter --horizon, or more data"  # what to do where too few episodes are as long as the horizon


def read(
    data: Data,
    horizon: int | None,
    rng: np.random.Generator,
    memory: int,
    told: Mapping[str, Any],
    short: str = _SHORTER,
) -> tuple["Divided", list[str]]:
    """Return the data of logs as `divided` makes them, and notes on how they were read.

    Where their steps are unequal they are interpolated, and a note says so. `told` holds keywords of `load_episodes`,
    None for those that nobody gave; with ``resample`` among them the steps are left to that.
    """
    told = {name: value for name, value in told.items() if value is not None}
    logs, notes = logs_of(data), list[str]()
    with noted(notes):
        try:
            files = Files(logs, **told)
            split = divided(files, horizon, rng, memory, short)
        except UnevenSamplingError as uneven:
            if "resample" in told:
                raise
            notes.append(f"{str(uneven).rpartition('; pass')[0]}; interpolated to {uneven.dt:g} s")
            files = Files(logs, **told, resample=uneven.dt)
            split = divided(files, horizon, rng, memory, short)
    return split, [*shortened(notes, files.files), *guessed(files.files, told)]


def logs_of(data: Data) -> Data:
    """Return the .rrd logs of a folder of runs, which also holds their table; anything else is returned as it is."""
    if isinstance(data, str | PathLike) and (Path(data) / RESULTS).is_file():
        return sorted(Path(data).glob("*.rrd"))
    return data


def guessed(files: Iterable[str | PathLike[str]], told: Mapping[str, Any]) -> list[str]:
    """Return a sentence where names of columns alone say which are inputs: tables, and nobody told the roles."""
    tables = [Path(file) for file in files if Path(file).suffix.lower() == ".csv"]
    if "inputs" in told or not tables:
        return []
    with tables[0].open("rb") as stream:
        if stream.read(len(_OWN)) == _OWN:  # episodes that were saved, with their roles
            return []
    return ["which columns are inputs was guessed from their names; --inputs u,v and --states a,b say it"]


_REPAIRED = ("constant input", "repeated column", "wrapped angle")  # `needed` puts these right, and says so
_LEAST = 0.5  # share of the steps that must be left once rows at fault are left out


def audited(episodes: Episodes, *, cut: bool = True) -> tuple[Episodes, tuple[str, ...], int]:
    """Return the episodes without the rows at fault, unless that would leave less than half of the steps.

    Beside them stand the faults, with what was done about each, in sentences, and the steps of the past that a model
    needs for signals that are late. With `cut` False the episodes are only a sample of the data, so that nothing can be
    left out.
    """
    report = audit(episodes)
    rest = episodes
    if cut and any(fault.places for fault in report.faults):
        with suppress(DataError):  # every row is at fault
            left = report.without_faults(episodes)
            if sum(map(len, left)) >= _LEAST * sum(map(len, episodes)):
                rest = left
    notes: list[str] = []
    for fault in report.faults:
        if fault.name in _REPAIRED:
            continue
        if fault.places and rest is not episodes:
            done = "these rows were left out"
        elif fault.steps:
            done = f"models that see {fault.steps} steps of the past are tried: embedding=km.Delay({fault.steps})"
        else:
            done = fault.do
        notes.append(f"{fault.name}: {fault.says}; {done}")
    return rest, tuple(notes), report.delay


@dataclass(frozen=True)
class Repair:
    """What is done to episodes before a fit: some columns are left out, and angles are unwrapped; `notes` say it all.

    Attributes
    ----------
    states, inputs, disturbances
        Indices of the columns that are kept.
    unwrapped
        Indices of the states, before any was left out, that are unwrapped along each episode.
    notes
        What was found, in sentences.
    """

    states: tuple[int, ...]
    inputs: tuple[int, ...]
    disturbances: tuple[int, ...]
    unwrapped: tuple[int, ...]
    notes: tuple[str, ...]

    def __call__(self, episodes: Episodes) -> Episodes:
        """Return the repaired episodes, or the episodes themselves where there is nothing to repair."""
        if not self.notes:
            return episodes
        made: list[Episode] = []
        for e in episodes:
            X = e.X.copy()
            if self.unwrapped:
                X[:, self.unwrapped] = np.unwrap(X[:, self.unwrapped], axis=0)
            made.append(Episode(X=X[:, self.states], U=e.U[:, self.inputs], W=e.W[:, self.disturbances]))
        return Episodes(made, episodes.dt, *self._names(episodes))

    def source(self, source: Source) -> Source:
        """Return the source of repaired episodes."""
        return Changed(source, self, *self._names(source)) if self.notes else source

    def _names(self, of: Episodes | Source) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
        return (
            tuple(of.states[i] for i in self.states),
            tuple(of.inputs[i] for i in self.inputs),
            tuple(of.disturbances[i] for i in self.disturbances),
        )


def needed(episodes: Episodes) -> Repair:
    """Return the repairs that these episodes need.

    Raises
    ------
    DataError
        No state moves.
    """
    notes: list[str] = []
    X = np.concatenate([e.X for e in episodes])
    driven = np.concatenate([np.hstack([e.U, e.W]) for e in episodes])
    nu = episodes.nu
    states = _useful(X, episodes.states, notes)
    both = _useful(driven, (*episodes.inputs, *episodes.disturbances), notes)
    if not states:
        raise DataError(
            f"no state moves: {', '.join(episodes.states)} are constant; check the columns, or pass --states"
        )
    turns = {i: count for i, count in jumps(episodes).items() if i in states}
    for i, count in turns.items():
        notes.append(
            f"{episodes.states[i]} jumped by 2π {count} times and was unwrapped along each episode; the model "
            "continues it beyond ±π"
        )
    return Repair(
        tuple(states),
        tuple(i for i in both if i < nu),
        tuple(i - nu for i in both if i >= nu),
        tuple(turns),
        tuple(notes),
    )


def _useful(columns: Float[np.ndarray, "m n"], names: tuple[str, ...], notes: list[str]) -> list[int]:
    """Return the columns that move and are no copy of an earlier one."""
    kept: list[int] = []
    for i, name in enumerate(names):
        column = columns[:, i]
        twin = next((names[j] for j in kept if np.array_equal(column, columns[:, j])), None)
        if np.ptp(column) == 0:
            notes.append(f"left out: {name} is {column[0]:g} throughout")
        elif twin is not None:
            notes.append(f"left out: {name} repeats {twin}")
        else:
            kept.append(i)
    return kept


_SHOWN = 6  # files of which a report says what each of them needs


@contextmanager
def noted(notes: list[str]) -> Generator[None]:
    """Collect the text of each FitWarning, once, instead of showing it.

    A ColumnWarning is about one file and is dropped: `needed` judges each column by all files.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FitWarning)
        yield
    for one in caught:
        if not issubclass(one.category, FitWarning):
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
        elif not issubclass(one.category, ColumnWarning) and str(one.message) not in notes:
            notes.append(str(one.message))


def shortened(notes: Iterable[str], files: Iterable[Path]) -> list[str]:
    """Return the notes: one line for a note that files share, and the first few of those that only one file has."""
    known = {str(file) for file in files}
    of: dict[str, list[str]] = {}
    for note in notes:
        file, _, said = note.partition(": ")
        if file in known:
            of.setdefault(said, []).append(file)
        else:
            of[note] = []
    short: list[str] = []
    alone = 0
    for said, where in of.items():
        if len(where) > 1:
            short.append(f"{where[0]} and {len(where) - 1} more files: {said}")
        elif where and alone < _SHOWN:
            short.append(f"{where[0]}: {said}")
        elif not where:
            short.append(said)
        alone += len(where) == 1
    if alone > _SHOWN:
        short.append(f"{alone - _SHOWN} more files have notes of their own; load_episodes shows them")
    return short


IN_MEMORY = 150_000_000  # bytes of files that are read as a whole
PAST = 2  # steps that a model may look back
_SHARE = 0.2  # share of the episodes that is held out
_ENOUGH = 12  # held-out episodes from which on bands are finite
_JUDGED = 10_000  # steps that a report is made of


@dataclass(frozen=True, eq=False)
class Divided:
    """The data that a model is fitted to, and the held-out episodes that judge it.

    Attributes
    ----------
    fitted
        A source, larger than memory if need be.
    seen
        Some of the fitted episodes, which stand for the training data in the report.
    held_out
        Episodes that no fit sees.
    horizon
        Steps ahead.
    size
        The amount of data, in words.
    notes
        What was done to the data, in sentences.
    delay
        Steps of the past that a model needs for signals that are late.
    """

    fitted: Source | Episodes
    seen: Episodes
    held_out: Episodes
    horizon: int
    size: str
    notes: tuple[str, ...]
    delay: int


def divided(
    files: Files,
    horizon: int | None,
    rng: np.random.Generator,
    memory: int,
    short: str = _SHORTER,
) -> Divided:
    """Hold out a fifth of the episodes, or of blocks of a few long ones; beyond `memory` a tenth of the parts.

    `short` is what to do where too few episodes are as long as the horizon.

    Raises
    ------
    DataError
        Too few episodes are as long as the horizon.
    """
    parts = files.parts()
    size = sum(file.stat().st_size for file in files.files)
    told = f"{len(files.files)} file{'s' * (len(files.files) > 1)}, {_bytes(size)}"
    if size <= memory or len(parts) < 2:
        episodes, faults, delay = audited(joined([part.load() for part in parts]))
        repair = needed(episodes)
        return _in_memory(repair(episodes), horizon, rng, told, (*faults, *repair.notes), delay, short)
    episodes, faults, delay = audited(sampled(files, _JUDGED)[0], cut=False)
    repair = needed(episodes)
    past = max(PAST, delay)
    source = repair.source(files)
    count = max(len(parts) // 10, 1)
    out = {int((i + 0.5) * len(parts) / count) for i in range(count)}
    rest = Subset(source, [i for i in range(len(parts)) if i not in out])
    judged, _ = sampled(Subset(source, sorted(out)), _JUDGED)
    ahead = usual_horizon(judged, past)[0] if horizon is None else horizon
    held_out = _long(list(judged), ahead + past)
    if len(held_out) < 2:
        held_out = _long([b for e in judged for b in blocks(e, 2 * (ahead + past))], ahead + past)
    if len(held_out) < 2:
        raise DataError(_too_short(len(judged), ahead, short))
    seen, _ = sampled(rest, _JUDGED)
    note = (
        f"larger than {_bytes(memory)}, so read in {len(parts)} parts: {len(out)} of them "
        f"{'is' if len(out) == 1 else 'are'} held out, and the fit reads the others one by one"
    )
    return Divided(
        rest,
        judged.with_episodes(_long(list(seen), ahead + past)),
        judged.with_episodes(held_out),
        ahead,
        told,
        (*faults, *repair.notes, note),
        delay,
    )


def _in_memory(
    episodes: Episodes,
    horizon: int | None,
    rng: np.random.Generator,
    files: str,
    repaired: tuple[str, ...],
    delay: int,
    short: str,
) -> Divided:
    past = max(PAST, delay)
    lengths = [len(episode) for episode in episodes]
    same = "" if min(lengths) == max(lengths) else f"{min(lengths)} to "
    number = len(episodes)
    told = f"{files}: {number} episode{'s' * (number > 1)} of {same}{max(lengths)} steps, {sum(lengths)} in all"
    ahead = usual_horizon(episodes, past)[0] if horizon is None else horizon
    needed = ahead + past
    whole = list(episodes)
    notes: tuple[str, ...] = ()
    if len(_long(whole, needed)) < _ENOUGH:
        block = max(2 * needed, min(sum(lengths) // (4 * _ENOUGH), _JUDGED // _ENOUGH))
        whole = [piece for episode in episodes for piece in blocks(episode, block)]
        if len(whole) > number:
            notes = (
                f"too few episodes to hold some out: cut into {len(whole)} blocks of about {block} steps; a held-out "
                "block lies between those of the fit, so its errors may be too small",
            )
    long = [i for i, episode in enumerate(whole) if len(episode) >= needed]
    if len(long) < 4:
        raise DataError(_too_short(len(episodes), ahead, short))
    count = max(round(_SHARE * len(long)), min(_ENOUGH, len(long) // 3), 2)
    # blocks in order are held out evenly spread, episodes at random
    order = [int((i + 0.5) * len(long) / count) for i in range(count)]
    drawn = order if notes else [int(i) for i in rng.permutation(len(long))[:count]]
    out = {long[i] for i in drawn}
    train = episodes.with_episodes([episode for i, episode in enumerate(whole) if i not in out])
    seen, _ = sampled(Held(episodes.with_episodes(_long(list(train), needed))), _JUDGED)
    held_out, _ = sampled(Held(episodes.with_episodes([whole[i] for i in sorted(out)])), _JUDGED)
    return Divided(
        train, episodes.with_episodes(_long(list(seen), needed)), held_out, ahead, told, (*repaired, *notes), delay
    )


def _long(episodes: Sequence[Episode], needed: int) -> list[Episode]:
    return [episode for episode in episodes if len(episode) >= needed]


def _too_short(episodes: int, horizon: int, advice: str) -> str:
    return (
        f"{episodes} episode{'s' * (episodes > 1)} of these lengths give too few of {horizon + PAST} steps, horizon "
        f"and delays, to fit to some and judge by others; {advice}"
    )


def _bytes(size: int) -> str:
    for unit, one in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= one:
            return f"{size / one:.3g} {unit}"
    return f"{size} B"
