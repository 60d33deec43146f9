# pyright: basic
"""LogFile: the bytes of a recording on their way to the disk, so that a full disk never makes Rerun wait.

Rerun's own file writer stops at the first error, and waits for ever for what it could not write. It therefore writes
into a pipe. A thread takes the bytes out and writes them; after an error it still takes them, and drops them.
"""

import os
import re
import zlib
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any, BinaryIO

from koopmpc import disk
from koopmpc.errors import LogError

_MARK, _BLANK = b"koopmpc-crc32:", b"x7k2q9zp"
_CHECK = re.compile(rb"koopmpc-crc32:([0-9a-f]{8})")
_PIECE = 1 << 20  # bytes
_PATIENCE = 10.0  # [s] for the thread to end once Rerun has closed the pipe
_PIPES = Path("/dev/fd")  # where a process opens a pipe of its own by name; Windows has no such folder

# What follows the checksum keeps the compression of a chunk from taking its last digits for a repetition.
CHECK = (_MARK + _BLANK).decode() + "~Qj5wK"
"""Text that stands once near the end of a log: a checksum of the whole file takes the place of its last 8 letters."""


class LogFile:
    """A file that a Rerun recording is written to.

    Parameters
    ----------
    path
        The file, an .rrd; folders on the way to it are made.
    growing
        The file is to be there while it is written: in its place where nothing is there yet, else beside it as
        ``<name>.part``. What is there when a disk is full or the process dies is kept. Otherwise the file is written
        beside and takes its place at the end.

    Raises
    ------
    LogError
        The path is no .rrd, or cannot be written.
    """

    def __init__(self, path: str | Path, *, growing: bool = False) -> None:
        self.path, self.growing = disk.target(path), growing
        if Path(path).suffix.lower() != ".rrd":
            raise LogError(f"{path} would be a Rerun log under another name; name it {Path(path).stem}.rrd")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if not growing:
                self.part = disk.beside(self.path)
            else:
                self.part = self.path.with_name(f"{self.path.name}{disk.PART}") if self.path.exists() else self.path
            self._file: BinaryIO = self.part.open("wb", buffering=0)
        except OSError as error:
            raise disk.refused(self.path, error) from error
        self._failure: OSError | None = None
        self._sum = self._length = 0
        self._place: int | None = None  # of the checksum
        self._tail = b""
        self._thread: Thread | None = None

    def attach(self, rec: Any, *more: Any) -> None:
        """Make this file the sink of a recording, beside other sinks."""
        import rerun as rr

        if not _PIPES.is_dir():
            rec.set_sinks(rr.FileSink(self.part), *more)
            return
        end, begin = os.pipe()
        try:
            thread = Thread(target=self._pump, args=(end,), name="koopmpc-log", daemon=True)
            thread.start()
            self._thread = thread  # which is waited for only where it runs: an interrupt may come while it starts
            rec.set_sinks(rr.FileSink(f"{_PIPES}/{begin}"), *more)
        finally:
            os.close(begin)  # Rerun holds one of its own

    def check(self) -> None:
        """Raise LogError where something could not be written."""
        if self._failure is not None:
            raise disk.refused(self.path, self._failure) from self._failure

    def close(self) -> None:
        """Finish the file, once the recording is disconnected.

        Raises
        ------
        LogError
            Something could not be written.
        """
        try:
            self._ended()
            self.check()
            if self._place is not None:
                self._file.seek(self._place)
                self._file.write(f"{self._sum:08x}".encode())
            if self.part != self.path:
                disk.settle(self.part, self.path, self._file.fileno())
        except OSError as error:
            self.discard()
            raise error if isinstance(error, LogError) else disk.refused(self.path, error) from error
        except BaseException:
            self.discard()
            raise
        self._file.close()

    def discard(self) -> None:
        """Give up: a growing file is left as far as it was written, any other is removed."""
        with suppress(OSError):
            self._ended()
            self._file.close()
        if self.part.is_file() and not (self.growing and self._length):
            self.part.unlink(missing_ok=True)

    def _ended(self) -> None:
        if self._thread is not None:
            self._thread.join(_PATIENCE)
            if self._thread.is_alive():
                raise LogError(f"{self.path} cannot be written: Rerun did not end within {_PATIENCE:g} s")

    def _pump(self, end: int) -> None:
        """Take all bytes out of the pipe, until Rerun closes it."""
        with os.fdopen(end, "rb", buffering=0) as pipe:
            while piece := pipe.read(_PIECE):
                if self._failure is not None:
                    continue
                try:
                    self._write(piece)
                except OSError as error:
                    self._failure = error

    def _write(self, piece: bytes) -> None:
        rest = memoryview(piece)
        while rest:
            rest = rest[self._file.write(rest) :]
        known = self._tail + piece
        found = known.rfind(_MARK + _BLANK)
        if found >= 0:
            self._place = self._length - len(self._tail) + found + len(_MARK)
        self._length += len(piece)
        self._sum = zlib.crc32(piece, self._sum)
        self._tail = known[-len(_MARK + _BLANK) + 1 :]


def intact(path: Path) -> bool:
    """Return whether the file is, to the bit, the one that was written: its checksum stands in it and is right."""
    from mmap import ACCESS_READ, mmap

    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        start = data.rfind(_MARK)
        found = None if start < 0 else _CHECK.match(data, start)
        if found is None:
            return False
        total, place = 0, start + len(_MARK)
        for begin, stop in ((0, place), (place + len(_BLANK), len(data))):
            for first in range(begin, stop, _PIECE):
                total = zlib.crc32(data[first : min(first + _PIECE, stop)], total)
            total = zlib.crc32(_BLANK, total) if begin == 0 else total
        return total == int(found.group(1), 16)
