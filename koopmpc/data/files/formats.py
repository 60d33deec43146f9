"""LogFormat: what a file format of logs registers, and the one register that all readers of logs ask.

A new format is a file with a reader that calls `register_format`, and its line at the joint "log formats" of
``koopmpc/__init__.py``.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float

from koopmpc.base import disk
from koopmpc.base.errors import DataError, LogError, install
from koopmpc.base.lazy import load_joint
from koopmpc.data.episodes import Episodes, PlantSignature
from koopmpc.data.source import Part

ADVICE = "pass a file that Episodes.save wrote, or a table as .csv or .parquet"


@dataclass(frozen=True, eq=False)
class LogTable:
    """Columns of a log whose roles its file does not state; `load_episodes` infers them or is given them.

    Attributes
    ----------
    names
        Names of all columns, in order; a name that stands twice is here twice.
    columns
        The columns whose names stand once, (rows,) each: numbers with NaN where a value is missing, or objects.
    units
        Units of columns that the file states beside their names; they join the names as ``"theta [rad]"``.
    dt
        Sample time [s], where the file states it. It counts if there is no column of time and the caller gives none.
    named
        False for a file without names: its columns are called ``"column 1"``, ``"column 2"``, ….
    """

    names: tuple[str, ...]
    columns: Mapping[str, np.ndarray]
    units: Mapping[str, str] = field(default_factory=dict[str, str])
    dt: float | None = None
    named: bool = True

    def with_units(self) -> "LogTable":
        """Return the table whose names carry the units."""
        known = {name: f"{name} [{unit}]" for name, unit in self.units.items() if unit and "[" not in name}
        columns = {known.get(name, name): column for name, column in self.columns.items()}
        return LogTable(tuple(known.get(name, name) for name in self.names), columns, {}, self.dt, self.named)

    def renamed(self, names: Sequence[str]) -> "LogTable":
        """Return the table with other names of its columns, in the same order."""
        new = dict(zip(self.names, names, strict=True))
        columns = {new[name]: column for name, column in self.columns.items()}
        return replace(self, names=tuple(names), columns=columns, named=True)


@dataclass(frozen=True, eq=False)
class LogFormat:
    """A format of logs.

    Attributes
    ----------
    suffixes
        Ends of file names, with the dot.
    read
        Path → Episodes, if the file states sample time and roles; → LogTable, if all columns share their rows; else →
        Recording.
    write
        Write Episodes to a file that is open; None for a format that is only read.
    parts
        (path, history, signature, keywords of `load_episodes`) → the parts of a large file, as `Source.parts` has them,
        or None if this file cannot be read in parts. None for a format whose files are always read whole.
    extra
        The extra of koopmpc that installs what `read` imports.
    folders
        Whether files with these suffixes are read where a folder is given; not for suffixes of many other programs.
    """

    suffixes: tuple[str, ...]
    read: Callable[[Path], "Episodes | LogTable | Recording"]
    write: Callable[[BinaryIO, Episodes], None] | None = None
    parts: Callable[[Path, int, PlantSignature | None, Mapping[str, Any]], list[Part] | None] | None = None
    extra: str | None = None
    folders: bool = True


Samples = tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]


@dataclass(frozen=True)
class Channel:
    """One signal of a recording.

    Attributes
    ----------
    name
        Its name in the file, without the unit.
    unit
        Its unit, where the file states one.
    count
        Number of its samples.
    """

    name: str
    unit: str
    count: int

    @property
    def title(self) -> str:
        """Name and unit, as ``"theta [rad]"``."""
        return f"{self.name} [{self.unit}]" if self.unit and "[" not in self.name else self.name


class Recording(ABC):
    """A log that is open for reading. Times are in seconds since the recording's own zero."""

    @abstractmethod
    def channels(self) -> tuple[Channel, ...]:
        """Return the channels of numbers, in the order of the file."""

    @abstractmethod
    def span(self) -> tuple[float, float]:
        """Return the first and the last time of any channel [s]."""

    @abstractmethod
    def read(
        self, names: Sequence[str], begin: float = -np.inf, end: float = np.inf, count: int | None = None
    ) -> list[Samples]:
        """Return times [s] and values of channels from `begin` to `end`; of each the first `count` at most."""


_JOINT = "log formats"
_FORMATS: dict[str, LogFormat] = {}


def register_format(log_format: LogFormat) -> None:
    """Have files with these suffixes read by this format."""
    _FORMATS.update(dict.fromkeys(log_format.suffixes, log_format))


def list_suffixes(*, writable: bool = False, folders: bool = False) -> list[str]:
    """Return the suffixes of formats in the order of the joint; only those written, or read in folders, if asked."""
    files = load_joint(_JOINT)
    order = {suffix: files.index(home) for suffix, f in _FORMATS.items() if (home := f.read.__module__) in files}
    suffixes = [
        suffix
        for suffix, log_format in _FORMATS.items()
        if (log_format.write is not None or not writable) and (log_format.folders or not folders)
    ]
    return sorted(suffixes, key=lambda suffix: order.get(suffix, len(files)))


def find_format(file: Path, *, writable: bool = False) -> LogFormat:
    """Return the format of a file by its suffix."""
    suffix = file.suffix.lower()
    load_joint(_JOINT, until=lambda: suffix in _FORMATS)
    log_format = _FORMATS.get(suffix)
    if log_format is None or (writable and log_format.write is None):
        known = ", ".join(list_suffixes(writable=writable))
        raise DataError(f"episodes are kept in {known} files, not in {file.name!r}; rename it")
    return log_format


def read_log(file: Path) -> Episodes | LogTable | Recording:
    """Return what the reader of the file's format makes of it."""
    log_format = find_format(file)
    disk.existing(file, ADVICE)
    try:
        return log_format.read(file)
    except ModuleNotFoundError as error:
        if log_format.extra is None:
            raise
        raise LogError(
            f"{file}: {error.name} reads {file.suffix} files and is not installed; {install(log_format.extra)}"
        ) from error
