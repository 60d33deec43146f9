"""Files: the episodes of a folder, or of a list of files, as a source that is never held whole."""

import warnings
from collections.abc import Callable, Iterable
from filecmp import cmp
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

from koopmpc.base import disk
from koopmpc.base.errors import DataError, FitWarning, KoopmpcError, LogError
from koopmpc.data.episodes import Episodes, PlantSignature, join_sets
from koopmpc.data.files.formats import find_format, list_suffixes
from koopmpc.data.files.frames import is_frame
from koopmpc.data.files.load import load_episodes
from koopmpc.data.source import Part, Source

EpisodesReader = Callable[[Path], Episodes]
_PART = 8_000_000  # bytes of a part of several files


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
        reader: EpisodesReader | None = None,
        **reading: Any,
    ) -> None:
        if reader is not None and reading:
            raise DataError(f"a reader of your own is given no {', '.join(reading)}; bind them with partial")
        self.files = list_files(paths)
        self._reader = partial(load_episodes, **reading) if reader is None else reader
        self._reading = None if reader is not None else reading
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
        if self._reading is None:
            return None
        split = find_format(file).parts
        return None if split is None else split(file, history, plant, self._reading)


def _together(files: tuple[Path, ...], reader: EpisodesReader, plant: PlantSignature) -> Part:
    """Return several files as one part."""
    first, *others = files
    more = f" and {len(others)} files after it" if others else ""
    return Part(f"{first}{more}", partial(_read_together, files, reader, plant))


def _read_together(files: tuple[Path, ...], reader: EpisodesReader, plant: PlantSignature) -> Episodes:
    """Return the episodes of the files; an error names the file."""
    sets: list[Episodes] = []
    for file in files:
        sets.append(_read_folder(file, reader))
        plant.check(sets[-1], str(file))
    return join_sets(sets)


def _read_folder(file: Path, reader: EpisodesReader) -> Episodes:
    """Return the episodes of the file; an error of the reader names the file."""
    try:
        return reader(file)
    except KoopmpcError as error:
        if str(file) in str(error):
            raise
        raise type(error)(f"{file}: {error}") from error


def list_files(paths: str | PathLike[str] | Iterable[str | PathLike[str]]) -> tuple[Path, ...]:
    """Return the files, those of a folder by name."""
    if is_frame(paths):
        raise DataError("a DataFrame is in memory, and no file; pass km.load_episodes(frame) to the fit")
    if not isinstance(paths, str | PathLike):
        each = paths if hasattr(paths, "__iter__") else [paths]
        files = tuple(map(disk.path_of, each))
        if not files:
            raise DataError("there is no path; pass a folder, or at least one file")
        for file in files:
            if not file.is_file():
                raise LogError(f"{file} is not a file; pass files, or one folder")
        return _distinct(files)
    folder = Path(paths)
    if folder.is_file():
        return (folder,)
    if not folder.is_dir():
        raise LogError(f"{folder} does not exist; pass a folder of files, or their paths")
    suffixes = list_suffixes(folders=True)
    files = tuple(sorted(file for file in folder.iterdir() if file.suffix.lower() in suffixes and file.is_file()))
    if not files:
        content = ", ".join(sorted(item.name for item in folder.iterdir())[:5]) or "nothing"
        raise LogError(f"{folder} holds no {', '.join(suffixes[:-1])} or {suffixes[-1]} file: it holds {content}")
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
                warnings.warn(f"{file} holds the same bytes as {twin}; its rows count twice", FitWarning, stacklevel=2)
                break
    return files
