# pyright: basic
"""A RerunLog goes into one .rrd, or to the viewer; LogColumns reads the file back.

The file ends with a checksum of all its bytes, for Rerun's reader returns changed values in silence, and may end the
process that reads a damaged file: a file that was closed is read only if it is to the bit what was written.
"""

import re
import struct
import tempfile
import uuid
import warnings
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np

from koopmpc.base import disk
from koopmpc.base.errors import DataError, LogError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import checksum
from koopmpc.views.recording.description import drawable

_MARK = b"koopmpc-crc32:"  # stands before the checksum of a file
_BLANK = b"x7k2q9zp"  # holds the place of the checksum until the file is closed
_GUARD = b"~Qj5wK"  # keeps the compression of a chunk from taking the last digits for a repetition
_CHECK = re.compile(re.escape(_MARK) + rb"([0-9a-f]{8})")
_MAGIC = b"RRF2"  # first bytes of a file
_END = b"RRF2FOOT"  # a whole file of Rerun's ends with these and 4 bytes more
_FILE_HEADER = 12  # bytes before the first message
_MESSAGE_HEADER = 16  # bytes: kind and length of a message
_FLUSH = 3.0  # longest wait for a sink [s]


class RerunLog:
    """A Rerun recording: a context manager that ends it, or discards it after an error.

    Parameters
    ----------
    application
        Rerun keeps the layouts that people make by it.
    path
        The file, an .rrd; folders on the way to it are made. None: everything goes to `viewer`.
    viewer
        The address of a viewer that is up.
    growing
        The file is to be there while it is written: in its place where nothing is there yet, else beside it as
        ``<name>.part``. What is there when a disk is full or the process dies is kept. Otherwise the file is written
        beside and takes its place at the end.

    Raises
    ------
    LogError
        The path is no .rrd, or cannot be written.
    """

    def __init__(
        self, application: str, *, path: str | Path | None, viewer: str | None = None, growing: bool = False
    ) -> None:
        import rerun as rr
        import rerun_bindings

        self.application, self.growing = application, growing
        self._file: BinaryIO | None = None
        self._stream: Any = None
        self._sum = self._length = 0
        self.rec: Any = None
        try:
            with raise_swallowed():  # no Ctrl-C between the file and its name leaves it behind
                if path is not None:
                    self._open(path)
                # Rerun keeps what has ended until it is asked, and would also drop a recording of the user's rr.init
                if rr.get_global_data_recording() is None:
                    rerun_bindings.flush_and_cleanup_orphaned_recordings()
                self.rec = rr.RecordingStream(application, recording_id=uuid.uuid4())
            if path is None:
                self.rec.set_sinks(rr.GrpcSink(viewer))
            else:
                self._stream = self.rec.binary_stream()
        except BaseException:  # a Ctrl-C
            self.discard()
            raise

    def _open(self, path: str | Path) -> None:
        self.path = disk.target(path)
        if Path(path).suffix.lower() != ".rrd":
            raise LogError(f"{path} would be a Rerun log under another name; name it {Path(path).stem}.rrd")
        with self._explaining():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if not self.growing:
                self.part = disk.beside(self.path)
            else:
                self.part = self.path.with_name(f"{self.path.name}{disk.PART}") if self.path.exists() else self.path
            self._file = self.part.open("wb", buffering=0)

    def __enter__(self) -> "RerunLog":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the log; discard it after an error."""
        try:
            if error is None:
                self._close()
        finally:
            self.discard()

    def style(self, entity: str, *archetypes: Any) -> None:
        """Log what does not change of an entity."""
        self.rec.log(entity, *archetypes, static=True)

    def page(self, entity: str, text: str, *more: Any) -> None:
        """Log Markdown that does not change, and `more` of the same entity."""
        import rerun as rr

        self.style(entity, rr.TextDocument(drawable(text), media_type=rr.MediaType.MARKDOWN), *more)

    def rows(self, entity: str, k: np.ndarray, dt: float, columns: Any) -> None:
        """Log rows at steps `k` on two timelines: step, and sim_time = k dt to the nanosecond."""
        import rerun as rr

        nanoseconds = np.rint(k * dt * 1e9).astype("timedelta64[ns]")
        times = [rr.TimeColumn("step", sequence=k), rr.TimeColumn("sim_time", duration=nanoseconds)]
        self.rec.send_columns(entity, times, columns)

    def lay_out(self, layout: Any) -> None:
        """Send a blueprint, as ``rec.send_blueprint`` does, which keeps its memory and two threads for ever."""
        import rerun as rr
        import rerun_bindings

        with raise_swallowed():
            own = rerun_bindings.new_blueprint(
                application_id=self.application, make_default=False, make_thread_default=False, default_enabled=True
            )
            stream = rr.RecordingStream._from_native(own)
            stream.set_time("blueprint", sequence=0)
            layout.to_blueprint()._log_to_stream(stream)
            storage = stream.memory_recording().storage
            rerun_bindings.send_blueprint(storage, False, True, recording=self.rec.to_native())
            stream.disconnect()  # else what it holds and the stream hold each other
            del stream

    def flush(self) -> None:
        """Hand on what was written, to a viewer within three seconds; raise where the disk refuses it."""
        self.rec.flush(timeout_sec=_FLUSH)
        if self._file is not None and self.growing:
            self._append(self._read_messages())

    def _close(self) -> None:
        """Write the rest and the checksum, and put the file in its place."""
        import rerun as rr

        self.style("checksum", rr.AnyValues(check=(_MARK + _BLANK + _GUARD).decode()))
        if self._file is None:
            self.rec.flush(timeout_sec=_FLUSH)
            return
        rest = self._read_messages() if self.growing else self._stream.read()  # which flushes without a limit in time
        self._append(rest.replace(_MARK + _BLANK, _MARK + b"%08x" % checksum(rest, start=self._sum)))
        with self._explaining():
            disk.settle(self.part, self.path, self._file.fileno())
        self._file.close()
        self._file = None

    def discard(self) -> None:
        """Let go of the recording; a growing file is left as far as it was written, any other is removed."""
        with raise_swallowed():
            if self._stream is not None:
                self._stream.read()  # else Rerun prints that it drops what nobody has read
            if self._file is not None:
                self._file.close()
                if self.part.is_file() and not (self.growing and self._length):
                    self.part.unlink(missing_ok=True)
            if self.rec is not None:
                self.rec.disconnect()
            self.rec = self._file = self._stream = None

    def _read_messages(self) -> bytes:
        """Return the messages that wait; Rerun makes a whole file of them, with a header and an end."""
        data = self._stream.read() or b""
        return data[0 if not self._length else _FILE_HEADER : _find_end(data)]

    def _append(self, data: bytes) -> None:
        self._sum = checksum(data, start=self._sum)
        rest = memoryview(data)
        with self._explaining():
            while rest:
                count = self._file.write(rest) if self._file is not None else len(rest)
                self._length += count
                rest = rest[count:]

    @contextmanager
    def _explaining(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise disk.explain_failure(self.path, error) from error


def _find_end(data: bytes) -> int:
    """Return where the last whole message of a file ends: a header, then messages with their kind and length first."""
    end = _FILE_HEADER
    while end + _MESSAGE_HEADER <= len(data):
        kind, length = struct.unpack_from("<QQ", data, end)
        # largest kind of a message; 0 is that of the end
        if not 0 < kind <= 3 or end + _MESSAGE_HEADER + length > len(data):
            break
        end += _MESSAGE_HEADER + length
    return end


def check_log(path: Path) -> None:
    """Check that `path` is a file that starts as an .rrd does; the rest of the file is not read.

    Raises
    ------
    LogError
        The file is missing, a folder, cannot be opened, or is no .rrd.
    """
    file = disk.existing(path, "pass the .rrd of a run")
    try:
        with file.open("rb") as stream:
            start = stream.read(len(_MAGIC))
    except OSError as error:
        raise LogError(f"{path} cannot be read: {error.strerror}") from error
    if start != _MAGIC:
        raise LogError(f"{path} is not a log of koopmpc: it does not start as an .rrd file does")


class LogColumns:
    """The columns of some entities of a log, by (entity, component); `closed` says that the log was closed.

    A log that was not closed, or was cut, has what stands in its whole messages.

    Raises
    ------
    LogError
        The file is missing, no .rrd, or no longer what was written.
    """

    def __init__(self, path: Path, *entities: str) -> None:
        check_log(path)
        self.path = path
        data = path.read_bytes()
        start = data.rfind(_MARK)
        check = None if start < 0 else _CHECK.match(data, start)
        whole_messages = _find_end(data)
        cut = data[-12:-4] != _END and whole_messages < len(data)
        if check is not None and not cut:
            place = start + len(_MARK)
            if checksum(memoryview(data)[:place], _BLANK, memoryview(data)[place + len(_BLANK) :]) != int(check[1], 16):
                raise LogError(f"{path} is damaged: it no longer holds what was written; take another copy")
        self._parts: dict[tuple[str, str], list[tuple[Any, Any]]] = {}
        copied = data[:whole_messages] if cut else b""
        del data, check
        with _copied(path, copied) as whole:
            try:
                self._read(whole, entities)
            except (KeyboardInterrupt, SystemExit):
                raise
            except BaseException as error:  # Rerun raises many kinds; a panic derives from this one alone
                said = str(error).partition("\n")[0].replace(str(whole), str(path))
                raise LogError(f"{path} is not a log, or is damaged: {said}") from error
        # a viewer that saves what was streamed to it writes the last row without a checksum
        self.closed = not cut and any(component == "check" for _, component in self._parts)

    def _read(self, path: Path, entities: tuple[str, ...]) -> None:
        import pyarrow as pa
        from rerun.chunk import RrdReader

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # load_run itself warns of a missing end
            chunks = (
                RrdReader(path).stream().filter(content=[f"/{name}" for name in ("checksum", *entities)]).to_chunks()
            )
        for chunk in chunks:
            if not chunk.is_static and "step" not in chunk.timeline_names:
                continue  # not written by koopmpc
            batch = chunk.to_record_batch()
            k = None if chunk.is_static else batch.column("step").cast(pa.int64()).to_numpy(zero_copy_only=False)
            for name in batch.schema.names:
                if (batch.schema.field(name).metadata or {}).get(b"rerun:kind") == b"data":
                    key = chunk.entity_path.removeprefix("/"), name.split(":")[-1]
                    self._parts.setdefault(key, []).append((k, batch.column(name)))

    @contextmanager
    def reading(self) -> Generator[None]:
        """Raise LogError with the name of the file where its columns are not what koopmpc writes.

        Raises
        ------
        LogError
            The block failed on a value that it took from the columns.
        """
        try:
            yield
        except (ArithmeticError, AttributeError, LookupError, NotImplementedError, TypeError, ValueError) as error:
            raise LogError(f"{self.path} is damaged: {error}") from error

    def entities(self) -> list[str]:
        """Return the entities that have data."""
        return list(dict.fromkeys(entity for entity, _ in self._parts))

    def static(self, entity: str, component: str) -> Any:
        """Return the one value that does not change, or None."""
        parts = self._parts.get((entity, component))
        return None if parts is None else parts[-1][1].to_pylist()[-1][0]

    def lists(self, entity: str, component: str = "scalars") -> tuple[np.ndarray, Any]:
        """Return the steps of a component in their order, and an Arrow array with a list of values for each."""
        import pyarrow as pa

        parts = [(k, values) for k, values in self._parts.get((entity, component), []) if k is not None]
        if not parts:
            return np.empty(0, dtype=np.int64), pa.array([], pa.list_(pa.float64()))
        k, values = np.concatenate([k for k, _ in parts]), pa.concat_arrays([values for _, values in parts])
        order = np.argsort(k, kind="stable")
        return k[order], values.take(pa.array(order)) if (np.diff(k) < 0).any() else values

    def words(self, entity: str, component: str = "state") -> tuple[np.ndarray, list[str]]:
        """Return the steps and the one word of each."""
        k, values = self.lists(entity, component)
        return k, values.flatten().to_pylist()

    def matrix(self, entity: str, component: str = "scalars") -> tuple[np.ndarray, np.ndarray]:
        """Return the steps that have numbers, and a row of them each."""
        k, values = self.lists(entity, component)
        widths = values.value_lengths().to_numpy(zero_copy_only=False)
        k, widths = k[widths > 0], widths[widths > 0]
        if len(widths) and (widths != widths[0]).any():
            raise DataError(f"{entity} has rows of different lengths")
        flat = values.flatten().to_numpy(zero_copy_only=False)
        return k, np.array(flat).reshape(len(k), int(widths[0]) if len(widths) else 0)

    def vectors(self, entity: str) -> np.ndarray:
        """Return the rows 0, 1, … up to the first that is missing."""
        k, values = self.matrix(entity)
        gaps = np.flatnonzero(k != np.arange(len(k)))
        return values[: gaps[0]] if len(gaps) else values

    def fill(self, entity: str, component: str, rows: np.ndarray) -> np.ndarray:
        """Return a copy of `rows` with those that the log has; what lies beyond their end is left out."""
        k, values = self.matrix(entity, component)
        filled, inside = rows.copy(), k < len(rows)
        if len(k):
            filled[k[inside]] = values[inside].reshape(-1, *rows.shape[1:])
        return filled


@contextmanager
def _copied(path: Path, data: bytes) -> Iterator[Path]:
    """Yield a file with these bytes; `path` itself where there are none."""
    if not data:
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "whole.rrd"
        copy.write_bytes(data)
        yield copy
