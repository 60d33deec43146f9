"""Logs before a fit: they are read, audited and repaired, and episodes are held out to judge the model."""

import warnings
from collections.abc import Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.apps.bench.store import RESULTS
from koopmpc.apps.fitting.repair import audit_episodes, find_repairs
from koopmpc.base.errors import ColumnWarning, DataError, FitWarning, NoInputWarning
from koopmpc.data.episodes import Episode, Episodes, join_sets
from koopmpc.data.files.folder import Files
from koopmpc.data.files.notes import ResampledWarning, name_files, name_resampled
from koopmpc.data.files.sampling import UnevenSamplingError
from koopmpc.data.files.tables import SAVED
from koopmpc.data.pace import find_pace
from koopmpc.data.source import Held, Source, Subset
from koopmpc.models.records.narx import DELAYS
from koopmpc.synthesis.search.data import is_record, replace_glitches, take_sample
from koopmpc.synthesis.search.folds import cut_blocks, usual_horizon
from koopmpc.validate.logs.summary import LogExcerpt, excerpt_logs

Data = str | PathLike[str] | Iterable[str | PathLike[str]]
_SHORTER = "pass a shorter --horizon, or more data"  # advice if too few episodes are as long as the horizon


def read_logs(
    data: Data,
    horizon: int | None,
    rng: np.random.Generator,
    reading: Mapping[str, Any],
    short: str = _SHORTER,
    *,
    ask: bool = True,
) -> "DividedData":
    """Return the data of logs as `divide_files` makes them; the notes begin with how the logs were read.

    `reading` holds keywords of `load_episodes`. Unequal steps are interpolated to their median, or a number of two
    digits near it, unless ``resample`` is given, and a note says so.

    Raises
    ------
    DataError
        As `divide_files`; with `ask` also where no column has the name of an input and the caller names none.
    """
    reading, logs, notes = dict(reading), find_logs(data), list[str]()
    with collect_notes(notes):
        if ask:
            warnings.simplefilter("error", NoInputWarning)
        try:
            files = Files(logs, **reading)
            split = divide_files(files, horizon, rng, short)
        except NoInputWarning as missing:
            raise DataError(missing.question) from missing
        except UnevenSamplingError as uneven:
            if "resample" in reading:
                raise
            reading["resample"] = round_step(uneven.dt)
            files = Files(logs, **reading)
            split = divide_files(files, horizon, rng, short)
    how = [*shorten_notes(notes, files.files), *describe_guesses(files.files, reading)]
    return replace(split, notes=(*how, *split.notes), reading=reading)


def round_step(dt: float, *, near: float = 0.005) -> float:
    """Return the sample time of two digits that is within the share `near` of a median step [s], or else the median."""
    plain = float(f"{dt:.2g}")
    return plain if abs(dt - plain) <= near * plain else dt


def find_logs(data: Data) -> Data:
    """Return the .rrd logs of a folder of runs, which also holds their table; anything else is returned as it is."""
    if isinstance(data, str | PathLike) and (Path(data) / RESULTS).is_file():
        return sorted(Path(data).glob("*.rrd"))
    return data


def describe_guesses(files: Iterable[str | PathLike[str]], reading: Mapping[str, Any]) -> list[str]:
    """Return a sentence if the names of columns alone say which are inputs: tables, and no roles in `reading`."""
    tables = [Path(file) for file in files if Path(file).suffix.lower() == ".csv"]
    if "inputs" in reading or not tables:
        return []
    with tables[0].open("rb") as stream:
        if stream.readline().startswith(",".join(SAVED).encode()):  # episodes that were saved, with their roles
            return []
    return ["which columns are inputs was guessed from their names; --inputs u,v and --states a,b say it"]


@contextmanager
def collect_notes(notes: list[str]) -> Generator[None]:
    """Collect the text of each FitWarning, once, instead of showing it.

    A ColumnWarning is about one file and is dropped: `find_repairs` judges each column by all files.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FitWarning)
        yield
    resampled: dict[str, ResampledWarning] = {}
    for one in caught:
        if isinstance(one.message, ResampledWarning):
            resampled.setdefault(one.message.file, one.message)
        elif not issubclass(one.category, FitWarning):
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
        elif not issubclass(one.category, ColumnWarning) and str(one.message) not in notes:
            notes.append(str(one.message))
    if resampled:
        notes.insert(0, name_resampled(list(resampled.values())))


def shorten_notes(notes: Iterable[str], files: Iterable[Path], *, shown: int = 6) -> list[str]:
    """Return the notes: one line for a note that files share, and the first few of those that only one file has."""
    known = [str(file) for file in files]
    of: dict[str, list[str]] = {}
    for note in notes:
        file, _, text = note.partition(": ")
        if file in known:
            of.setdefault(text, []).append(file)
        else:
            of[note] = []
    alone = [text for text, where in of.items() if len(where) == 1]
    short = [
        f"{name_files(where, known) if len(where) > 1 else where[0]}: {text}" if where else text
        for text, where in of.items()
        if text not in alone[shown:]
    ]
    if len(alone) > shown:
        short.append(f"{len(alone) - shown} more files have notes of their own; load_episodes shows them")
    return short


IN_MEMORY = 150_000_000  # files up to this size [bytes] are read as a whole; beyond, the fit reads them part by part
PAST = 2  # models look back at most this many steps
_SHARE = 0.2  # hold out this share of the episodes
_FEWEST = 4  # blocks of a held-out end that are too few for a band
_ENOUGH = 12  # bands are finite with at least this many held-out episodes
_JUDGED = 10_000  # a report is made of at most about this many steps


@dataclass(frozen=True, eq=False)
class DividedData:
    """The data that a model is fitted to, and the held-out episodes that judge it."""

    fitted: Source | Episodes  # a source may be larger than memory
    seen: Episodes  # some of the fitted episodes, which stand for the training data in the report
    held_out: Episodes  # the fit of the judged model does not see them
    horizon: int  # steps ahead
    size: str  # the amount of data, in words
    notes: tuple[str, ...]  # how the logs were read and what was done to the data, in sentences
    delay: int  # steps of the past that a model needs for signals that are late
    reading: Mapping[str, Any] = field(default_factory=dict[str, Any])  # keywords that read the same data again
    learned: Episodes | None = None  # records without their held-out ends, to which the model to judge is fitted
    excerpt: LogExcerpt | None = None  # rows as they were read, for pictures, with marks where they were repaired
    verdict: int | None = None  # steps ahead of the verdict, where they are others than those of the choice

    @property
    def ahead(self) -> int:
        """Steps ahead of the verdict."""
        return self.horizon if self.verdict is None else self.verdict


def divide_files(files: Files, horizon: int | None, rng: np.random.Generator, short: str = _SHORTER) -> DividedData:
    """Hold out a fifth of the episodes, or of blocks of a few long ones; of files beyond memory a tenth of the parts.

    `short` is the advice where too few episodes are as long as the horizon.
    """
    parts = files.parts()
    size = sum(file.stat().st_size for file in files.files)
    amount = f"{len(files.files)} file{'s' * (len(files.files) > 1)}, {_format_bytes(size)}"
    if size <= IN_MEMORY or len(parts) < 2:
        logs = join_sets([part.load() for part in parts])
        episodes, faults, delay, origins, doubtful = audit_episodes(logs)
        repair = find_repairs(episodes)
        whole = repair(episodes)
        _, sound, replaced = replace_glitches(Held(whole), whole)
        notes = (*faults, *repair.notes, *replaced)
        unwrapped = [episodes.states[i] for i in repair.unwrapped]
        split = _divide_episodes(drop_origins(sound), horizon, rng, amount, notes, delay, short)
        return replace(split, excerpt=excerpt_logs(logs, sound, origins, doubtful, unwrapped))
    logs = take_sample(files, _JUDGED)[0]
    episodes, faults, delay, *_ = audit_episodes(logs, cut=False)
    repair = find_repairs(episodes)
    past = max(PAST, delay)
    source, _, replaced = replace_glitches(repair.source(files), repair(episodes))
    count = max(len(parts) // 10, 1)
    out = {int((i + 0.5) * len(parts) / count) for i in range(count)}
    rest = Subset(source, [i for i in range(len(parts)) if i not in out])
    judged, _ = take_sample(Subset(source, sorted(out)), _JUDGED)
    ahead = usual_horizon(judged, past)[0] if horizon is None else horizon
    held_out = _keep_long(list(judged), ahead + past)
    if len(held_out) < 2:
        held_out = _keep_long([b for e in judged for b in cut_blocks(e, 2 * (ahead + past))], ahead + past)
    if len(held_out) < 2:
        raise DataError(_say_too_short(len(judged), ahead + past, short))
    seen, _ = take_sample(rest, _JUDGED)
    note = (
        f"larger than {_format_bytes(IN_MEMORY)}, so read in {len(parts)} parts: {len(out)} of them "
        f"{'is' if len(out) == 1 else 'are'} held out, and the fit reads the others one by one"
    )
    return DividedData(
        rest,
        judged.with_episodes(_keep_long(list(seen), ahead + past)),
        judged.with_episodes(held_out),
        ahead,
        amount,
        (*faults, *repair.notes, *replaced, note),
        delay,
        excerpt=excerpt_logs(logs),
    )


def _divide_episodes(
    episodes: Episodes,
    horizon: int | None,
    rng: np.random.Generator,
    files: str,
    repaired: tuple[str, ...],
    delay: int,
    short: str,
) -> DividedData:
    past = max(PAST, delay)
    lengths = [len(episode) for episode in episodes]
    same = f"{min(lengths)} to " * (min(lengths) != max(lengths))
    number = len(episodes)
    size = f"{files}: {number} episode{'s' * (number > 1)} of {same}{max(lengths)} steps, {sum(lengths)} in all"
    ahead = usual_horizon(episodes, past)[0] if horizon is None else horizon
    shortest = ahead + past
    whole = list(episodes)
    notes: tuple[str, ...] = ()
    if is_record(episodes):
        return _divide_records(episodes, ahead, size, repaired, delay, follow=horizon is None)
    if len(_keep_long(whole, shortest)) < _ENOUGH:
        block = max(2 * shortest, min(sum(lengths) // (4 * _ENOUGH), _JUDGED // _ENOUGH))
        whole = [piece for episode in episodes for piece in cut_blocks(episode, block)]
        if len(whole) > number:
            notes = (
                f"too few episodes to hold some out: cut into {len(whole)} blocks of about {block} steps; a held-out "
                "block lies between those of the fit, so its errors may be too small",
            )
    long = [i for i, episode in enumerate(whole) if len(episode) >= shortest]
    if len(long) < 4:
        raise DataError(_say_too_short(len(episodes), shortest, short))
    count = max(round(_SHARE * len(long)), min(_ENOUGH, len(long) // 3), 2)
    # blocks in order are held out evenly spread, episodes at random
    order = [int((i + 0.5) * len(long) / count) for i in range(count)]
    drawn = order if notes else [int(i) for i in rng.permutation(len(long))[:count]]
    out = {long[i] for i in drawn}
    train = episodes.with_episodes([episode for i, episode in enumerate(whole) if i not in out])
    seen, _ = take_sample(Held(episodes.with_episodes(_keep_long(list(train), shortest))), _JUDGED)
    held_out, _ = take_sample(Held(episodes.with_episodes([whole[i] for i in sorted(out)])), _JUDGED)
    return DividedData(
        train,
        episodes.with_episodes(_keep_long(list(seen), shortest)),
        held_out,
        ahead,
        size,
        (*repaired, *notes),
        delay,
    )


def _divide_records(
    records: Episodes, ahead: int, size: str, repaired: tuple[str, ...], delay: int, *, follow: bool
) -> DividedData:
    """Hold out the last fifth of each record, in blocks, to judge; choice and last fit take the whole record.

    With `follow` the verdict looks as far ahead as the outputs remember, but `_ENOUGH` blocks are to remain, or
    `_FEWEST` of a record that is too short for `_ENOUGH` of the usual horizon, and so for a band.
    """
    past, verdict = max(delay, *DELAYS), None
    held = [min(len(e) - round((1 - _SHARE) * len(e)), _JUDGED) for e in records]
    least = _ENOUGH if _longest_block(held, _ENOUGH) - past >= ahead else _FEWEST
    pace: int = find_pace(records) if follow else 0
    longer = min(pace, _longest_block(held, least) - past)
    if longer > ahead:
        verdict = longer
    shortest = (verdict or ahead) + past
    learned: list[Episode] = []
    held_out: list[Episode] = []
    for record in records:
        last = len(record)
        first = max(round((1 - _SHARE) * last), last - _JUDGED)
        learned.append(record.cut(0, round((1 - _SHARE) * last)))
        block = max(shortest, (last - first) // _ENOUGH)
        held_out += _keep_long(cut_blocks(record.cut(first, last), block), shortest)
    if len(held_out) < 2:
        raise DataError(
            f"{len(records)} record{'s' * (len(records) > 1)} of at most {max(map(len, records))} steps: the last "
            f"fifth must hold two blocks of {shortest} steps, horizon and past rows, so {round(2 * shortest / _SHARE)} "
            f"in all; {_SHORTER}"
        )
    note = (
        f"the last fifth of {'each' if len(records) > 1 else 'the'} record is held out, in {len(held_out)} blocks; "
        "the chosen model is fitted without it to be judged, and then to all rows"
    )
    notes = (*repaired, note)
    if verdict is not None:
        seconds = f"{verdict * records.dt:.3g} s"
        why = "since the outputs remember that long"
        if verdict < pace:
            why = f"which the held-out rows leave; the outputs remember {pace} steps, so a longer record tells more"
        notes = (*notes, f"judged {verdict} steps = {seconds} ahead, {why}")
    train = records.with_episodes(learned)
    seen, _ = take_sample(Held(train), _JUDGED)
    judged = records.with_episodes(held_out)
    return DividedData(records, seen, judged, ahead, size, notes, delay, learned=train, verdict=verdict)


def _longest_block(lengths: Sequence[int], count: int) -> int:
    """Return the most steps of a block of which these lengths hold so many, none of them across two lengths."""
    most = range(sum(lengths) // count, 0, -1)
    return next((steps for steps in most if sum(length // steps for length in lengths) >= count), 0)


def drop_origins(episodes: Episodes) -> Episodes:
    """Return the episodes without their places in files, which other processes need not be sent."""
    return episodes.with_episodes([Episode(X=e.X, U=e.U, W=e.W) for e in episodes])


def _keep_long(episodes: Sequence[Episode], shortest: int) -> list[Episode]:
    return [episode for episode in episodes if len(episode) >= shortest]


def _say_too_short(episodes: int, shortest: int, advice: str) -> str:
    return (
        f"{episodes} episode{'s' * (episodes > 1)} of these lengths give too few of {shortest} steps, horizon "
        f"and delays, to fit to some and judge by others; {advice}"
    )


def _format_bytes(size: int) -> str:
    for unit, one in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if size >= one:
            return f"{size / one:.3g} {unit}"
    return f"{size} B"
