# pyright: basic
"""The .rrd file of a log: Rerun's recordings written into it to the last byte or not at all, and its columns read back.

Rerun's own file writer stops at the first error, and waits for ever for what it could not write. It therefore writes
into a pipe. A thread takes the bytes out and writes them; after an error it still takes them, and drops them.

Rerun's reader may end the process on a damaged file: such a file is read in a child process. Run as a module, this
file is that child: it reads a log and writes its columns to its standard output.
"""

import os
import re
import struct
import subprocess
import sys
import tempfile
import uuid
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from threading import Thread
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from koopmpc import disk
from koopmpc.errors import LogError
from koopmpc.interrupts import raise_swallowed
from koopmpc.values import checksum

_MARK = b"koopmpc-crc32:"  # stands before the checksum of a file
_BLANK = b"x7k2q9zp"  # holds the place of the checksum until the file is closed
_CHECK = re.compile(rb"koopmpc-crc32:([0-9a-f]{8})")
_PIECE = 1 << 20  # bytes
_PIPED = 1 << 16  # bytes that a pipe holds; each thread's heap would keep the room of larger pieces for ever
_CLOSING = 10.0  # longest wait for the thread to end once Rerun has closed the pipe [s]
_WRITING = 10.0  # longest wait for a file that is written at once [s]
_PIPES = Path("/dev/fd")  # where a process opens a pipe of its own by name; Windows has no such folder
_MAGIC = b"RRF2"  # first bytes of a file
_FOOTER = b"RRF2FOOT"  # a closed file ends with these and 4 bytes more
_FILE_HEADER = 12  # bytes before the first message
_MESSAGE_HEADER = 16  # bytes: kind and length of a message
_END = 0  # kind of the message that ends a file
_LAST_KIND = 3  # largest kind of a message
_REFUSED = 3  # exit code of a child whose reader said why
_READING = 60.0  # longest wait for a child that reads an empty file [s]
_RATE = 1e6  # a child that reads slower than this ends in an error [bytes/s]

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
            raise disk.explain_failure(self.path, error) from error
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
            raise disk.explain_failure(self.path, self._failure) from self._failure

    def close(self) -> None:
        """Finish the file, once the recording is disconnected.

        Raises
        ------
        LogError
            Something could not be written.
        """
        try:
            self._join()
            self.check()
            if self._place is not None:
                self._file.seek(self._place)
                self._file.write(f"{self._sum:08x}".encode())
            if self.part != self.path:
                disk.settle(self.part, self.path, self._file.fileno())
        except OSError as error:
            self.discard()
            raise error if isinstance(error, LogError) else disk.explain_failure(self.path, error) from error
        except BaseException:
            self.discard()
            raise
        self._file.close()

    def discard(self) -> None:
        """Give up: a growing file is left as far as it was written, any other is removed."""
        with suppress(OSError):
            self._join()
            self._file.close()
        if self.part.is_file() and not (self.growing and self._length):
            self.part.unlink(missing_ok=True)

    def _join(self) -> None:
        if self._thread is not None:
            self._thread.join(_CLOSING)
            if self._thread.is_alive():
                raise LogError(f"{self.path} cannot be written: Rerun did not end within {_CLOSING:g} s")

    def _pump(self, end: int) -> None:
        """Take all bytes out of the pipe, until Rerun closes it."""
        with os.fdopen(end, "rb", buffering=0) as pipe:
            while piece := pipe.read(_PIPED):
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
        self._sum = checksum(piece, start=self._sum)
        self._tail = known[-len(_MARK + _BLANK) + 1 :]


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

    _name(layout.root_container, application)
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


def _name(root: Any, application: str) -> None:
    """Give the parts of a layout the same ids in every log: Rerun keeps each id that it has met, 300 bytes, for ever.

    An id stands for the place and the kind of a part, because a viewer keeps what it knows of a view by its id.
    """
    from rerun.blueprint import Container, VisualizableArchetype, Visualizer

    number = count()

    def give(part: Any) -> Any:
        kind = getattr(part, "class_identifier", type(part).__name__)
        part.id = uuid.uuid5(uuid.NAMESPACE_OID, f"koopmpc {application} {next(number)} {kind}")
        return part

    parts = [root]
    while parts:
        part = give(parts.pop())
        if isinstance(part, Container):
            parts.extend(part.contents)
            continue
        for entity, shown in part.visualizer_overrides.items():
            each = [one.visualizer() if isinstance(one, VisualizableArchetype) else one for one in shown]
            part.visualizer_overrides[entity] = [give(one) if isinstance(one, Visualizer) else one for one in each]


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
        rec.flush(timeout_sec=_WRITING)
        rec.disconnect()
        file.close()
    except BaseException:
        if rec is not None:
            rec.disconnect()
        file.discard()
        raise


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


def read(path: Path, entities: tuple[str, ...]) -> tuple[list[Column], bool]:
    """Return the columns of these entities, and whether the file ends within a message.

    Raises
    ------
    LogError
        Rerun's reader refuses the file, or ended the child that read it.
    """
    if is_intact(path):
        return _read_here(path, entities), False
    with _whole_messages(path) as (whole, torn):
        return _read_in_child(whole, entities, path), torn


def is_intact(path: Path) -> bool:
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
                total = checksum(data[first : min(first + _PIECE, stop)], start=total)
            total = checksum(_BLANK, start=total) if begin == 0 else total
        return total == int(found.group(1), 16)


@contextmanager
def _whole_messages(path: Path) -> Iterator[tuple[Path, bool]]:
    """Yield a file that ends with a whole message, and whether `path` ends within one.

    It is `path` itself, or a copy without its last, torn message.

    An .rrd is a header of 12 bytes and then messages, each with a header of 16 bytes (kind and length, little-endian).
    """
    size, end = path.stat().st_size, _FILE_HEADER
    with path.open("rb") as file:
        file.seek(max(size - 12, 0))
        closed = file.read(8) == _FOOTER
        while not closed and end + _MESSAGE_HEADER <= size:
            file.seek(end)
            kind, length = struct.unpack("<QQ", file.read(_MESSAGE_HEADER))
            if not _END < kind <= _LAST_KIND or end + _MESSAGE_HEADER + length > size:
                break
            end += _MESSAGE_HEADER + length
        if closed or end == size:
            yield path, False
            return
        file.seek(0)
        head = file.read(end)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "whole.rrd"
        copy.write_bytes(head)
        yield copy, True


def _read_here(path: Path, entities: tuple[str, ...]) -> list[Column]:
    """Return the columns of these entities, read in this process."""
    import warnings

    import pyarrow as pa
    from rerun.chunk import RrdReader

    found: list[Column] = []
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
                    found.append(Column(chunk.entity_path, name.split(":")[-1], k, batch.column(name)))
    return found


def _read_in_child(path: Path, entities: tuple[str, ...], told: Path) -> list[Column]:
    """Return the columns of these entities, read in a child process; messages call the file `told`.

    Raises
    ------
    LogError
        Rerun's reader refuses the file, or ended the child.
    """
    import pyarrow as pa

    command = [sys.executable, "-P", "-m", __name__, str(path), *entities]
    places = [str(Path(place).absolute()) for place in sys.path if place]
    patience = _READING + path.stat().st_size / _RATE
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=patience,
            check=False,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(places)},
        )
    except subprocess.TimeoutExpired as error:
        raise LogError(f"{told} is damaged: reading it did not end within {patience:.0f} s") from error
    if done.returncode == _REFUSED:
        said = done.stdout.decode(errors="replace").replace(str(path), str(told))
        raise LogError(f"{told} is not a log, or is damaged: {said}")
    if done.returncode:
        raise LogError(f"{told} is damaged, beyond what can be read: the process that read it ended on it")
    try:
        return list(_read_batches(done.stdout))
    except (pa.ArrowException, KeyError, IndexError) as error:
        raise LogError(f"{told} is damaged: {error}") from error


def _send(columns: Sequence[Column], out: Any) -> None:
    """Write one Arrow stream for each column."""
    import pyarrow as pa

    for column in columns:
        arrays = {"values": column.values} if column.k is None else {"values": column.values, "k": column.k}
        batch = pa.record_batch(arrays, metadata={"entity": column.entity, "component": column.component})
        with pa.ipc.new_stream(out, batch.schema) as stream:
            stream.write_batch(batch)


def _read_batches(data: bytes) -> Iterator[Column]:
    import pyarrow as pa

    source = pa.BufferReader(data)
    while source.tell() < len(data):
        with pa.ipc.open_stream(source) as stream:
            batch = stream.read_next_batch()
            stream.read_all()
        about = batch.schema.metadata
        k = batch.column("k") if "k" in batch.schema.names else None
        yield Column(about[b"entity"].decode(), about[b"component"].decode(), k, batch.column("values"))


def _main() -> int:
    """Answer on a copy of the standard output: what a library prints goes elsewhere."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    path, *entities = sys.argv[1:]
    try:
        columns = _read_here(Path(path), tuple(entities))
    except BaseException as error:  # a panic of the reader in Rerun derives from BaseException alone
        out.write(str(error).partition("\n")[0].encode())
        out.flush()
        return _REFUSED
    _send(columns, out)
    out.flush()
    return 0


if __name__ == "__main__":
    code = _main()
    os._exit(code)  # threads of the reader may not end
