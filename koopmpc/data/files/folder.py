"""Files: a folder of episodes, larger than memory if need be, read part by part."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

from koopmpc.data.episodes import Episodes, PlantSignature, joined
from koopmpc.data.files.parquet import RowGroup, row_groups
from koopmpc.data.files.storage import load_episodes
from koopmpc.data.source import Part, Source
from koopmpc.errors import DataError, KoopmpcError, LogError

Reader = Callable[[Path], Episodes]
SUFFIXES = (".npz", ".parquet", ".csv", ".rrd")
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
        first = cut[0].load() if cut else _read(self.files[0], self._reader)
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
                parts.append(FilePart(tuple(group), self._reader, self._signature))
                group, room = [], _PART
            if cut:
                parts += cut
            else:
                group.append(file)
                room -= size
        if group:
            parts.append(FilePart(tuple(group), self._reader, self._signature))
        return parts

    def _cut(self, file: Path, history: int, plant: PlantSignature | None) -> list[RowGroup] | None:
        """Return the parts of a large file that can be read in groups of rows."""
        if not self._plain or file.suffix != ".parquet" or file.stat().st_size < _LARGE:
            return None
        return row_groups(file, history, plant)


@dataclass(frozen=True, eq=False)
class FilePart(Part):
    """Several files that are read together as one part."""

    files: tuple[Path, ...]
    reader: Reader
    plant: PlantSignature

    def __str__(self) -> str:
        more = len(self.files) - 1
        return f"{self.files[0]}{f' and {more} files after it' if more else ''}"

    def load(self) -> Episodes:
        """Return the episodes of the files; an error names the file."""
        sets: list[Episodes] = []
        for file in self.files:
            sets.append(_read(file, self.reader))
            self.plant.check(sets[-1], str(file))
        return joined(sets)


def _read(file: Path, reader: Reader) -> Episodes:
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
        files = tuple(Path(path) for path in paths)
        if not files:
            raise DataError("there is no path; pass a folder, or at least one file")
        for file in files:
            if not file.is_file():
                raise LogError(f"{file} is no file; pass files, or one folder")
        return files
    folder = Path(paths)
    if folder.is_file():
        return (folder,)
    if not folder.is_dir():
        raise LogError(f"{folder} does not exist; pass a folder of files, or their paths")
    files = tuple(sorted(file for file in folder.iterdir() if file.suffix in SUFFIXES and file.is_file()))
    if not files:
        held = ", ".join(sorted(item.name for item in folder.iterdir())[:5]) or "nothing"
        raise LogError(f"{folder} holds no {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]} file: it holds {held}")
    return files
