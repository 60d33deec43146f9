"""Files on disk: a save is written beside the file and takes its place at the end; what a .npz claims is checked first.

An interrupt, an error or a full disk in the middle of a save leaves the file that was there before.
"""

import errno
import io
import math
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Generator
from contextlib import contextmanager, suppress
from multiprocessing.util import Finalize
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO, cast
from zipfile import ZipFile, is_zipfile

import numpy as np

from koopmpc.base.errors import DataError, FullDiskError, LogError
from koopmpc.base.interrupts import raise_swallowed

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_DEFLATED = 1100  # deflate makes a member at most 1032 times smaller
PART = ".part"  # ends the name of a file that is being written


def path_of(path: object, advice: str = "pass text or a pathlib.Path") -> Path:
    """Return the path; DataError where it is neither text nor a path."""
    if isinstance(path, str | PathLike):
        return Path(os.fsdecode(cast("str", path)))
    raise DataError(f"{path!r} is not a path; {advice}")


def existing(path: str | PathLike[str], advice: str) -> Path:
    """Return the path of a file that is there; `advice` ends the message where it is not."""
    file = path_of(path, advice)
    if file.is_dir():
        raise LogError(f"{file} is a folder; {advice}")
    if not file.exists():
        raise LogError(f"{file} does not exist; {advice}")
    return file


@contextmanager
def writing(path: str | PathLike[str]) -> Generator[BinaryIO]:
    """Open a new file beside `path`, its folders made; at the end it takes the place of `path`.

    After an exception or an interrupt the new file is removed, and what stood at `path` is as it was. A symbolic link
    keeps pointing to its file, whose permissions stay. A device or a pipe is written directly.

    Raises
    ------
    FullDiskError
        There is no room for the file.
    LogError
        The system refuses to write there, or `path` is a folder.
    """
    file = target(path)
    stream: _Stream | None = None
    with raise_swallowed():  # numpy closes a zip with an error of its own, which would hide the interrupt
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            part = beside(file)
            try:  # before the file is there, so that no interrupt leaves it
                stream = _Stream(part, "wb" if part == file else "xb")
                with io.BufferedWriter(stream) as buffered:
                    yield cast("BinaryIO", buffered)
                    buffered.flush()
                    settle(part, file, stream.fileno())
            except BaseException:
                if part != file:
                    part.unlink(missing_ok=True)
                raise
        except Exception as error:
            failure = stream.failure if stream is not None else None
            if failure is None and not isinstance(error, OSError):
                raise
            raise explain_failure(file, failure or cast("OSError", error)) from error


def target(path: str | PathLike[str]) -> Path:
    """Return the file behind symbolic links; refuse a folder, and a file that may not be written."""
    file = path_of(path)
    if file.is_dir():
        raise LogError(f"{file} is a folder; pass the path of a file in it")
    with suppress(OSError):  # a loop of links is refused when it is opened
        file = file.resolve() if file.is_symlink() else file
    if file.exists() and not os.access(file, os.W_OK):
        raise explain_failure(file, PermissionError(errno.EACCES, os.strerror(errno.EACCES)))
    return file


def beside(file: Path) -> Path:
    """Return the path of a new file beside this one; a device or a pipe itself."""
    if file.exists() and not file.is_file():
        return file
    return file.with_name(f".{file.name[:80]}.{secrets.token_hex(4)}{PART}")


def settle(part: Path, file: Path, number: int) -> None:
    """Let the finished file with this descriptor take the place of `file`, with the permissions of what stood there."""
    if part == file:
        return
    os.fsync(number)  # a disk that is full may say so only now
    with suppress(OSError):
        part.chmod(stat.S_IMODE(file.stat().st_mode))
    part.replace(file)


def explain_failure(file: Path, error: OSError) -> LogError:
    """Return the error that says why this file cannot be written, and whether an old one is still there."""
    kept = "; the file that was there is as it was" if file.is_file() else ""
    why = error.strerror or str(error)
    if error.errno in _FULL:
        return FullDiskError(f"{file} cannot be written: {why}{kept}; make room, or pass another path")
    return LogError(f"{file} cannot be written: {why}{kept}; pass another path")


class _Stream(io.FileIO):
    """A file that remembers what the system refused: libraries that write turn it into errors of their own."""

    failure: OSError | None = None

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            self.failure = error
            raise


class Members:
    """The arrays of a .npz file, each read when it is asked for; the others take no memory.

    A pickle is never opened. Before an array is allocated, its size must be what its member holds, and fit into
    memory; the checksum of a member covers all of it.

    Raises
    ------
    ValueError
        The file cannot be read; the message says why.
    """

    def __init__(self, file: Path) -> None:
        if not is_zipfile(file):
            raise ValueError("it is no .npz file, or was cut")
        with _translate_errors():
            self._zip = ZipFile(file)
        self._infos = {info.filename.removesuffix(".npy"): info for info in self._zip.infolist()}

    def __enter__(self) -> "Members":
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()

    def __getitem__(self, name: str) -> np.ndarray:
        """Return the array; ValueError where it is damaged or too large."""
        info = self._infos[name]
        affordable(info.file_size, info.filename)
        with _translate_errors(), self._zip.open(info) as stream:
            version = np.lib.format.read_magic(stream)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(stream)
            held = stream.tell() + math.prod(shape) * dtype.itemsize
            if held != info.file_size or held > _DEFLATED * info.compress_size:
                raise ValueError("the array is not of the size of its member")
        with _translate_errors(), self._zip.open(info) as stream:
            array = np.lib.format.read_array(stream, allow_pickle=False)
            if stream.read(1):  # at the end of the member its checksum was compared
                raise ValueError("the member goes on behind its array")
        return array

    def require(self, *names: str) -> None:
        """Raise ValueError where one of these arrays is missing."""
        missing = [name for name in names if name not in self._infos]
        if missing:
            held = ", ".join(self._infos) or "nothing"
            raise ValueError(f"it is of another program: it holds {held}, and lacks {', '.join(missing)}")


@contextmanager
def _translate_errors() -> Generator[None]:
    """Turn the dozen kinds of errors of zipfile and numpy, some of which advise to trust the file, into one."""
    try:
        yield
    except Exception as error:
        raise ValueError("it is damaged, or holds something other than arrays of numbers") from error


def affordable(size: int, what: str) -> None:
    """Raise a ValueError that names both numbers where so many bytes do not fit into the memory that is free."""
    free = memory()
    if free is not None and size > free:
        raise ValueError(f"{what} would take {size / 1e9:.3g} GB, and {free / 1e9:.3g} GB are free")


def memory() -> int | None:
    """Return the bytes of memory that are free, None where the system does not say."""
    with suppress(OSError, ValueError, IndexError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    return None


def make_temporary_folder() -> Path:
    """Return a new folder for what this process needs until it ends; it is removed then."""
    folder = tempfile.mkdtemp(prefix="koopmpc-")
    Finalize(None, shutil.rmtree, (folder, True), exitpriority=0)  # worker processes do not run atexit
    return Path(folder)
