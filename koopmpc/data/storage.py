"""Episodes in .npz, .parquet and .csv files, exact to the bit, in tables of users, and in folders of such files."""

import json
import warnings
from collections.abc import Callable, Iterable, Sequence
from filecmp import cmp
from functools import partial
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc import disk
from koopmpc.data import formats
from koopmpc.data.episodes import Episode, Episodes, PlantSignature, joined
from koopmpc.data.source import Part, Source
from koopmpc.data.tables import Told, read_table
from koopmpc.errors import DataError, FitWarning, KoopmpcError, LogError

ADVICE = "pass a file that Episodes.save wrote, or a table as .csv or .parquet"
_WRITERS = {".parquet": formats.write_parquet, ".csv": formats.write_csv}
SUFFIXES = (".npz", *_WRITERS, ".rrd")


def save_episodes(episodes: Episodes, path: str | PathLike[str]) -> None:
    """Write the episodes to a .npz, .parquet or .csv file; `Episodes.save` is this."""
    file = disk.path_of(path)
    suffix = _suffix(file, SUFFIXES[:-1])
    X = np.concatenate([episode.X for episode in episodes])
    driven = episodes.driven()  # U with W behind it
    U = np.concatenate([episode.U for episode in driven])
    steps = np.array([len(episode) for episode in episodes])
    # Python writes a float so that it reads back to the bit.
    named = {"states": episodes.states, "inputs": episodes.inputs, "disturbances": episodes.disturbances}
    about = json.dumps({"dt": episodes.dt, **named})
    names = driven.states + driven.inputs
    for own in ("episode", "step"):
        if suffix in _WRITERS and own in names:
            raise DataError(f"a {suffix} file has a column {own!r} of its own; rename the state, or save as .npz")
    with disk.writing(file) as stream:
        if suffix in _WRITERS:
            _WRITERS[suffix](stream, X, U, steps, names, about)
        else:
            np.savez(stream, X=X, U=U, steps=steps, about=np.array(about))


def load_episodes(
    path: str | PathLike[str],
    *more: str | PathLike[str],
    dt: float | None = None,
    states: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
    disturbances: Sequence[str] | None = None,
    resample: float | None = None,
) -> Episodes:
    """Read the episodes of one file, or of several as one set.

    Files that `Episodes.save` wrote, and logs of runs, hold their own names and dt. Any other .csv or .parquet is a
    table with a row for each time step and a column for each state and input. A column ``t``, ``time [s]``,
    ``time [ms]`` or ``timestamp`` tells the sample time; where it goes back an episode ends. ``episode``, ``run`` or
    ``trial`` tells episodes apart, by numbers or names; ``step`` orders rows without time. Columns named ``u``, ``u0``,
    ``u_left``, ``force``, ``torque``, ``cmd``, ``input`` and the like are inputs, ``w`` and ``disturbance``
    measured disturbances, all other columns of numbers are states; arguments count before such guesses. The inputs of
    an episode's last row are not read. Missing values and gaps in time cut episodes, and a warning counts them.

    Parameters
    ----------
    path, more
        .npz, .parquet, .csv or .rrd.
    dt
        Sample time of a table without a column of time [s].
    states, inputs, disturbances
        The names of a table's columns; ``inputs=[]`` where there are none.
    resample
        Sample time [s] to interpolate to, for a table whose steps are unequal: states linearly, inputs held.

    Raises
    ------
    LogError
        A file is missing, is cut, or holds no episodes.
    DataError
        The suffix is another, the files have unequal dt or names, a table lacks a column or a step, a column
        of numbers holds a cell that is no number, or its sampling is unequal.

    Warns
    -----
    FitWarning
        There are gaps, columns that are constant or repeat another, or no column with the name of an input.
    """
    told = Told(dt, states, inputs, disturbances, resample)
    files = [disk.path_of(file) for file in (path, *more)]
    sets = [_read(file, told) for file in files]
    plant = PlantSignature.of(sets[0], str(files[0]))
    for file, one in zip(files, sets, strict=True):
        plant.check(one, str(file), tolerance=0.0)
    return joined(sets)


def _read(file: Path, told: Told) -> Episodes:
    suffix = _suffix(file, SUFFIXES)
    disk.existing(file, ADVICE)
    about = formats.csv_about(file) if suffix == ".csv" else None
    if suffix == ".csv" and about is None:
        names, held = formats.csv_columns(file)
        return read_table(file, names, held, told)
    if suffix == ".parquet" and not formats.own_parquet(file):
        names = formats.parquet_names(file)
        distinct = [name for name in names if names.count(name) == 1]
        return read_table(file, names, formats.parquet_columns(file, distinct), told)
    if not told.nothing:
        raise DataError(f"{file} holds its own names and dt; leave out dt, states and inputs")
    if suffix == ".rrd":
        return import_module("koopmpc.recording.reader").run_episodes(file)  # of a room below this one
    try:
        X, U, steps, text = _own(file, suffix, about)
        named = json.loads(text)
        disturbances = named.get("disturbances", [])
        nu = U.shape[1] - len(disturbances)
        parts_X = np.split(X, np.cumsum(steps + 1)[:-1])
        parts_U = np.split(U, np.cumsum(steps)[:-1])
        parts = zip(parts_X, parts_U, strict=True)
        episodes = [Episode(X=one, U=other[:, :nu], W=other[:, nu:]) for one, other in parts]
        return Episodes(episodes, named["dt"], named["states"], named["inputs"], disturbances)
    except (KeyError, TypeError, ValueError) as error:
        raise LogError(f"{file} holds no episodes that can be read: {error}; {ADVICE}") from error


def _own(file: Path, suffix: str, about: str | None) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
    """Return X, U, steps and the text beside them, of a file that `save_episodes` wrote."""
    if about is not None:
        return formats.read_csv(file, about)
    if suffix == ".parquet":
        return formats.read_parquet(file)
    with disk.Members(file) as held:
        held.require("X", "U", "steps", "about")
        return held["X"], held["U"], held["steps"], str(held["about"])


def _suffix(file: Path, known: Sequence[str]) -> str:
    if file.suffix not in known:
        raise DataError(f"episodes are kept in {', '.join(known)} files, not in {file.name!r}; rename it")
    return file.suffix


Reader = Callable[[Path], Episodes]
_PART = 8_000_000  # bytes of a part of several files
_LARGE = 32_000_000  # bytes from which a file is read in groups of rows


class Files(Source):
    """The episodes of a folder's .npz, .parquet, .csv and .rrd files, in the order of their names.

    A part is a file, or several small neighbours, or a group of rows of a large .parquet file that `Episodes.save`
    wrote; it is read when its turn comes, and not kept. All other files are read whole: a .npz of 10 GB needs more
    than 10 GB of memory, the same episodes as .parquet some 10 MB at a time. The first file defines dt and the names,
    and every other file must have the same.

    Parameters
    ----------
    paths
        A folder, or files in the order in which they count.
    reader
        Path → Episodes; `load_episodes` by default. With workers it must be defined at the top of a module.
    reading
        Keywords of `load_episodes` for plain tables: ``dt=``, ``states=``, ``inputs=``, ….

    Raises
    ------
    LogError
        A file is missing or cannot be read, or the folder holds none.
    DataError
        The first file does not fit the keywords, or a reader is given together with keywords.
    """

    def __init__(
        self,
        paths: str | PathLike[str] | Iterable[str | PathLike[str]],
        *,
        reader: Reader | None = None,
        **reading: Any,
    ) -> None:
        if reader is not None and reading:
            raise DataError(f"a reader of your own is given no {', '.join(reading)}; bind them with partial")
        self.files = _found(paths)
        self._reader = partial(load_episodes, **reading) if reader is None else reader
        self._plain = reader is None and not reading
        cut = self._cut(self.files[0], 0, None)
        first = cut[0].load() if cut else _read_folder(self.files[0], self._reader)
        self._signature = PlantSignature.of(first, str(self.files[0]))
        super().__init__(first.dt, first.states, first.inputs, first.disturbances)

    def parts(self, history: int = 0) -> list[Part]:
        """Return the parts in order."""
        parts: list[Part] = []
        group: list[Path] = []
        room = _PART
        for file in self.files:
            size = file.stat().st_size
            cut = self._cut(file, history, self._signature)
            if group and (cut or size > room):
                parts.append(_together(tuple(group), self._reader, self._signature))
                group, room = [], _PART
            if cut:
                parts += cut
            else:
                group.append(file)
                room -= size
        if group:
            parts.append(_together(tuple(group), self._reader, self._signature))
        return parts

    def _cut(self, file: Path, history: int, plant: PlantSignature | None) -> list[Part] | None:
        """Return the parts of a large file that can be read in groups of rows."""
        if not self._plain or file.suffix != ".parquet" or file.stat().st_size < _LARGE:
            return None
        return formats.row_groups(file, history, plant)


def _together(files: tuple[Path, ...], reader: Reader, plant: PlantSignature) -> Part:
    """Return several files as one part."""
    first, *others = files
    more = f" and {len(others)} files after it" if others else ""
    return Part(f"{first}{more}", partial(_read_together, files, reader, plant))


def _read_together(files: tuple[Path, ...], reader: Reader, plant: PlantSignature) -> Episodes:
    """Return the episodes of the files; an error names the file."""
    sets: list[Episodes] = []
    for file in files:
        sets.append(_read_folder(file, reader))
        plant.check(sets[-1], str(file))
    return joined(sets)


def _read_folder(file: Path, reader: Reader) -> Episodes:
    """Return the episodes of the file; an error of the reader names the file."""
    try:
        return reader(file)
    except KoopmpcError as error:
        if str(file) in str(error):
            raise
        raise type(error)(f"{file}: {error}") from error


def _found(paths: str | PathLike[str] | Iterable[str | PathLike[str]]) -> tuple[Path, ...]:
    """Return the files, those of a folder by name."""
    if not isinstance(paths, str | PathLike):
        each = paths if hasattr(paths, "__iter__") else [paths]
        files = tuple(map(disk.path_of, each))
        if not files:
            raise DataError("there is no path; pass a folder, or at least one file")
        for file in files:
            if not file.is_file():
                raise LogError(f"{file} is no file; pass files, or one folder")
        return _distinct(files)
    folder = Path(paths)
    if folder.is_file():
        return (folder,)
    if not folder.is_dir():
        raise LogError(f"{folder} does not exist; pass a folder of files, or their paths")
    files = tuple(sorted(file for file in folder.iterdir() if file.suffix in SUFFIXES and file.is_file()))
    if not files:
        held = ", ".join(sorted(item.name for item in folder.iterdir())[:5]) or "nothing"
        raise LogError(f"{folder} holds no {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]} file: it holds {held}")
    return _distinct(files)


def _distinct(files: tuple[Path, ...]) -> tuple[Path, ...]:
    """Return the files; raise where one stands twice, and warn where two hold the same bytes."""
    known: dict[Path, Path] = {}
    for file in files:
        if file.resolve() in known:
            raise DataError(f"{file} is given twice; its data would count twice")
        known[file.resolve()] = file
    sizes: dict[int, list[Path]] = {}
    for file in files:
        sizes.setdefault(file.stat().st_size, []).append(file)
    for group in sizes.values():
        for i, file in enumerate(group):
            twin = next((other for other in group[:i] if cmp(file, other, shallow=False)), None)
            if twin is not None:
                warnings.warn(f"{file} holds the same bytes as {twin}, and counts beside it", FitWarning, stacklevel=2)
                break
    return files
