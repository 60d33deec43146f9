# pyright: basic
"""The .rrd file of a log: Rerun's stream of bytes written into it to the last byte or not at all, and read back.

A damaged file may end the process that reads it (Rerun 0.41): a file that is not, to the bit, the one that was written
is tried in a child process first.
"""

import os
import re
import struct
import subprocess
import sys
import tempfile
import uuid
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from koopmpc.base import disk
from koopmpc.base.errors import LogError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import checksum

_MARK = b"koopmpc-crc32:"  # stands before the checksum of a file
_BLANK = b"x7k2q9zp"  # holds the place of the checksum until the file is closed
_CHECK = re.compile(rb"koopmpc-crc32:([0-9a-f]{8})")
_MAGIC = b"RRF2"  # first bytes of a file
_FOOTER = b"RRF2FOOT"  # a closed file ends with these and 4 bytes more
_FILE_HEADER = 12  # bytes before the first message
_MESSAGE_HEADER = 16  # bytes: kind and length of a message
_TRIAL = (
    "import os, sys, rerun.chunk as c; "
    "[chunk.to_record_batch() for chunk in c.RrdReader(sys.argv[1]).stream().to_chunks()]; os._exit(0)"
)

# What follows the checksum keeps the compression of a chunk from taking its last digits for a repetition.
CHECK = (_MARK + _BLANK).decode() + "~Qj5wK"
"""Text that stands once near the end of a log: a checksum of the whole file takes the place of its last 8 letters."""


class LogFile:
    """A file that takes the bytes of a Rerun recording.

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
        with self._explaining():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if not growing:
                self.part = disk.beside(self.path)
            else:
                self.part = self.path.with_name(f"{self.path.name}{disk.PART}") if self.path.exists() else self.path
            self._file: BinaryIO = self.part.open("wb", buffering=0)
        self._stream: Any = None
        self._sum = self._length = 0

    def attach(self, rec: Any) -> None:
        """Make this file the sink of a recording."""
        self._stream = rec.binary_stream()

    def save(self) -> None:
        """Write what the recording holds by now, where the file grows; Rerun would end a file with each piece."""
        if self.growing:
            self._write(_strip(self._stream.read(), first=not self._length))

    def close(self) -> None:
        """Write the rest and the checksum, and put the file in its place.

        Raises
        ------
        LogError
            Something could not be written.
        """
        try:
            rest = self._stream.read()
            rest = _strip(rest, first=not self._length) if self.growing else rest
            self._write(rest.replace(_MARK + _BLANK, _MARK + b"%08x" % checksum(rest, start=self._sum)))
            if self.part != self.path:
                with self._explaining():
                    disk.settle(self.part, self.path, self._file.fileno())
        except BaseException:
            self.discard()
            raise
        self._file.close()

    def discard(self) -> None:
        """Give up: a growing file is left as far as it was written, any other is removed."""
        if self._stream is not None:
            self._stream.read()  # else Rerun prints that it drops what nobody has read
        self._file.close()
        if self.part.is_file() and not (self.growing and self._length):
            self.part.unlink(missing_ok=True)

    def _write(self, data: bytes) -> None:
        self._sum = checksum(data, start=self._sum)
        rest = memoryview(data)
        with self._explaining():
            while rest:
                count = self._file.write(rest)
                self._length += count
                rest = rest[count:]

    @contextmanager
    def _explaining(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise disk.explain_failure(self.path, error) from error


def _strip(data: bytes | None, *, first: bool) -> bytes:
    """Return the messages of a piece without the end of a file, and without its header unless it is the first."""
    end = 0 if data is None else _find_end(len(data), lambda at: data[at : at + _MESSAGE_HEADER])
    return (data or b"")[0 if first else _FILE_HEADER : end]


def _find_end(size: int, read_header: Any) -> int:
    """Return where the last whole message of a file ends; `read_header(at)` returns the header of a message.

    An .rrd is a header of 12 bytes and then messages, each with a header of 16 bytes (kind and length, little-endian).
    """
    end = _FILE_HEADER
    while end + _MESSAGE_HEADER <= size:
        kind, length = struct.unpack("<QQ", read_header(end))
        # largest kind of a message; 0 is that of the end
        if not 0 < kind <= 3 or end + _MESSAGE_HEADER + length > size:
            break
        end += _MESSAGE_HEADER + length
    return end


def new_recording(application: str) -> Any:
    """Return a recording of its own; those that have ended give their memory and threads back.

    Rerun keeps what has ended until it is asked. It would also let go of a recording that the user made global by
    ``rr.init``: where there is one, nothing is asked, and Rerun itself tidies up at the next ``rr.init``.
    """
    import rerun as rr
    import rerun_bindings

    with raise_swallowed():  # Python drops a Ctrl-C that comes in a deletion
        if rr.get_global_data_recording() is None:
            rerun_bindings.flush_and_cleanup_orphaned_recordings()
        return rr.RecordingStream(application, recording_id=uuid.uuid4())


def send_blueprint(rec: Any, application: str, layout: Any) -> None:
    """Send a blueprint, as ``rec.send_blueprint`` does, which keeps its memory and two threads for ever."""
    import rerun as rr
    import rerun_bindings

    with raise_swallowed():
        own = rerun_bindings.new_blueprint(
            application_id=application, make_default=False, make_thread_default=False, default_enabled=True
        )
        stream = rr.RecordingStream._from_native(own)
        stream.set_time("blueprint", sequence=0)
        layout.to_blueprint()._log_to_stream(stream)
        rerun_bindings.send_blueprint(stream.memory_recording().storage, False, True, recording=rec.to_native())
        stream.disconnect()  # else what it holds and the stream hold each other
        del stream


@contextmanager
def file_recording(path: str | Path, application: str, layout: Any) -> Generator[Any]:
    """Yield a recording that is written beside `path`, and takes its place at the end of the block.

    It ends with a checksum: whole, it is read without a process of its own.

    Raises
    ------
    LogError
        The path cannot be written.
    """
    import rerun as rr

    file = LogFile(path)
    rec: Any = None
    try:
        rec = new_recording(application)
        file.attach(rec)
        send_blueprint(rec, application, layout)
        yield rec
        rec.log("checksum", rr.AnyValues(check=CHECK), static=True)
        file.close()
    except BaseException:
        file.discard()
        raise
    finally:
        if rec is not None:
            rec.disconnect()


def times(k: np.ndarray, dt: float) -> list[Any]:
    """Return the two timelines of rows at steps `k`: step, and sim_time = k dt to the nanosecond."""
    import rerun as rr

    nanoseconds = np.rint(k * dt * 1e9).astype("timedelta64[ns]")
    return [rr.TimeColumn("step", sequence=k), rr.TimeColumn("sim_time", duration=nanoseconds)]


def check_log(path: Path) -> None:
    """Check that `path` is a file that starts as an .rrd does; the rest of the file is not read.

    Raises
    ------
    LogError
        The file is missing, a folder, cannot be opened, or is no .rrd.
    """
    try:
        with disk.existing(path, "pass the .rrd of a run").open("rb") as file:
            start = file.read(len(_MAGIC))
    except LogError:
        raise
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror}") from error
    if start != _MAGIC:
        raise LogError(f"{path} is not a log of koopmpc: it does not start as an .rrd file does")


class Column(NamedTuple):
    """A component of an entity in one chunk: `k` are its steps, None where it is static; `values` an Arrow array."""

    entity: str
    component: str
    k: Any
    values: Any


class Contents(NamedTuple):
    """The columns of a file, whether it ends within a message, and whether it is to the bit what was written."""

    columns: list[Column]
    torn: bool
    intact: bool


def read(path: Path, entities: tuple[str, ...]) -> Contents:
    """Return the columns of these entities.

    Raises
    ------
    LogError
        Rerun's reader refuses the file, or ends the child that tried it.
    """
    intact = is_intact(path)
    with _whole_messages(path) as (whole, torn):
        if intact is False:
            _try(whole, path)
        try:
            return Contents(_read_columns(whole, entities), torn, bool(intact))
        except (KeyboardInterrupt, SystemExit):
            raise
        except BaseException as error:  # Rerun raises exceptions of many kinds; a panic derives from this one alone
            said = str(error).partition("\n")[0].replace(str(whole), str(path))
            raise LogError(f"{path} is not a log, or is damaged: {said}") from error


def is_intact(path: Path) -> bool | None:
    """Return whether the checksum in the file is that of the file; None where it holds none, for it was not closed."""
    data = path.read_bytes()
    start = data.rfind(_MARK)
    found = None if start < 0 else _CHECK.match(data, start)
    if found is None:
        return None
    place = start + len(_MARK)
    rest = memoryview(data)[place + len(_BLANK) :]
    return checksum(memoryview(data)[:place], _BLANK, rest) == int(found.group(1), 16)


@contextmanager
def _whole_messages(path: Path) -> Iterator[tuple[Path, bool]]:
    """Yield a file that ends with a whole message, and whether `path` ends within one.

    It is `path` itself, or a copy without its last, torn message.
    """
    size = path.stat().st_size
    with path.open("rb") as file:

        def read_header(at: int) -> bytes:
            file.seek(at)
            return file.read(_MESSAGE_HEADER)

        closed = size >= 12 and read_header(size - 12)[:8] == _FOOTER
        end = size if closed else _find_end(size, read_header)
        if end == size:
            yield path, False
            return
        file.seek(0)
        head = file.read(end)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "whole.rrd"
        copy.write_bytes(head)
        yield copy, True


def _try(path: Path, told: Path) -> None:
    """Read the file in a child process; raise LogError about `told` where that ends the child."""
    done = subprocess.run(
        [sys.executable, "-P", "-c", _TRIAL, str(path)],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(place for place in sys.path if place)},
    )
    if done.returncode == 1:  # an exception, whose last line says why
        said = done.stderr.decode(errors="replace").strip().rpartition("\n")[2].replace(str(path), str(told))
        raise LogError(f"{told} is not a log, or is damaged: {said}")
    if done.returncode:
        raise LogError(f"{told} is damaged, beyond what can be read: the process that read it ended on it")


def _read_columns(path: Path, entities: tuple[str, ...]) -> list[Column]:
    """Return the columns of these entities."""
    import warnings

    import pyarrow as pa
    from rerun.chunk import RrdReader

    columns: list[Column] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # load_run itself warns of a missing end
        for chunk in RrdReader(path).stream().filter(content=list(entities)).to_chunks():
            if not chunk.is_static and "step" not in chunk.timeline_names:
                continue  # not written by koopmpc
            batch = chunk.to_record_batch()
            k = None if chunk.is_static else batch.column("step").cast(pa.int64())
            for name in batch.schema.names:
                metadata = batch.schema.field(name).metadata or {}
                if metadata.get(b"rerun:kind") == b"data":
                    columns.append(Column(chunk.entity_path, name.split(":")[-1], k, batch.column(name)))
    return columns
