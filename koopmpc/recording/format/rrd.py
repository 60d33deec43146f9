# pyright: basic
"""The columns of a log: one table for the writer and the reader, and how they are read from an .rrd file.

A torn end is cut off, and changed columns are found.
"""

import json
import struct
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from jaxtyping import Float, Int

from koopmpc import disk
from koopmpc.errors import DataError, LogError
from koopmpc.loop.run import Plans, Run, Step, StepRows
from koopmpc.recording.format.logfile import intact
from koopmpc.recording.format.rerun_reader import Column, read, read_in_child


class Entity(StrEnum):
    """Where the columns of a log stand.

    An entity holds rows of numbers in its component "scalars", row k at step k; other components are named beside it.
    What only the viewer draws is in views/: `world`, `model`, `plots`, `title`, and components `koopmpc.View:…`:
    one state alone in single precision, the power of ten of a time.
    """

    DESCRIPTION = "description"  # static: the page that people read, and "json", the same data to the bit
    STATE = "state"  # x_k, NaN where the plant hides it; written last, so a row that has its state is whole
    MEASUREMENT = "measurement"  # y_k, in the rows where it is not x_k to the bit
    REFERENCE = "reference"  # r_k
    INPUT = "control/u"  # u_k as applied
    INPUT_REFERENCE = "control/u_reference"  # the input that holds r_k, in the rows where it is not 0
    INPUT_LIMITS = "control/limits"  # the finite limits of u, at the first and last step of a run or live block
    SLACK = "solver/slack"  # how far the plan breaks a soft limit, in the rows where it does
    KNOWN = "solver/known"  # 1 where the model knows and 0 where it does not, in the rows where a monitor looked
    SOLVER = "solver/time_ms"  # solve time [ms]; "seconds" where it is not ms / 1000 to the bit; "iterations" above 0
    QP = "solver/qp"  # "state": which solver made the move, or "none", in the rows where it changes; "none" before all
    DEADLINE = "solver/deadline_ms"  # dt [ms], at the same steps
    STATUS = "solver/status"  # "state": STATUS or STATUS → FALLBACK, in the rows where it changes
    PLAN_STATES = "prediction/x"  # the planned states of a step, flat; "last_width" is nx
    PLAN_INPUTS = "prediction/u"  # the planned inputs of a step, flat; "last_width" is nu
    FALLBACKS = "log"  # text: a line where a fallback sets in
    METRICS = "metrics"  # static, at the end: a page, "steps", "cost", "effort", "violation", checksums of all columns


DRAWN = (Entity.INPUT_LIMITS, Entity.DEADLINE, Entity.FALLBACKS)  # for people who look; `load_run` needs all others
NO_SOLVER = "none"  # the solver of a step that asked none


_MAGIC, _FOOTER = b"RRF2", b"RRF2FOOT"  # a closed file ends with the second and 4 bytes more
_FILE_HEADER, _MESSAGE_HEADER, _END, _LAST_KIND = 12, 16, 0, 3


class LogColumns:
    """The columns of a recording: rows in order of their step, by (entity, component).

    `torn` says that the file ends within a message.
    """

    def __init__(self, columns: Iterable[Column], entities: tuple[str, ...], torn: bool) -> None:
        self._entities, self.torn = entities, torn
        self._parts: dict[tuple[str, str], list[tuple[Any, Any]]] = {}
        for entity, component, k, values in columns:
            steps = None if k is None else k.to_numpy(zero_copy_only=False).astype(np.int64)
            self._parts.setdefault((entity, component), []).append((steps, values))

    def static(self, entity: str, component: str) -> Any:
        """Return the one value that does not change, or None."""
        parts = self._parts.get(_key(entity, component))
        return None if parts is None else parts[-1][1].to_pylist()[-1][0]

    def entities(self) -> list[str]:
        """Return the entities that have data."""
        return list(dict.fromkeys(entity for entity, _ in self._parts))

    def lists(self, entity: str, component: str) -> tuple[np.ndarray, list[Any]]:
        """Return the steps and the list of values of each row, in order of the steps."""
        parts = [(k, column) for k, column in self._parts.get((entity, component), []) if k is not None]
        pairs = [pair for k, column in parts for pair in zip(k.tolist(), column.to_pylist(), strict=True)]
        pairs.sort(key=lambda pair: pair[0])
        return np.array([k for k, _ in pairs], dtype=np.int64), [values for _, values in pairs]

    def rows(self, entity: str, component: str) -> tuple[np.ndarray, np.ndarray, Any]:
        """Return the steps, the width, and the flat values of a component, in order of the steps."""
        import pyarrow as pa

        parts = self._parts.get(_key(entity, component), [])
        if not parts:
            return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0)
        if parts[0][0] is None:
            return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), parts[-1][1].flatten()
        k = np.concatenate([k for k, _ in parts])
        lists = pa.concat_arrays([column for _, column in parts])
        order = np.argsort(k, kind="stable")
        if (np.diff(k) < 0).any():
            k, lists = k[order], lists.take(pa.array(order))
        widths = lists.value_lengths().to_numpy(zero_copy_only=False)
        return k, widths, lists.flatten()

    def matrix(self, entity: str, component: str = "scalars") -> tuple[np.ndarray, np.ndarray]:
        """Return the steps and one row of values each."""
        k, widths, values = self.rows(entity, component)
        flat = values if isinstance(values, np.ndarray) else values.to_numpy(zero_copy_only=False)
        if len(widths) and (widths != widths[0]).any():
            raise DataError(f"{entity} has rows of different lengths")
        return k, np.array(flat).reshape(len(k), int(widths[0]) if len(widths) else 0)

    def vectors(self, entity: str) -> np.ndarray:
        """Return the rows 0, 1, … up to the first that is missing."""
        k, values = self.matrix(entity)
        return values[: _whole(k)]

    def column(self, entity: str) -> np.ndarray:
        """Return one number a row: 0, 1, … up to the first that is missing."""
        return self.vectors(entity).reshape(-1)

    def held(self, entity: str, component: str, column: np.ndarray) -> np.ndarray:
        """Return `column`, with the numbers of this component in the rows that have one."""
        k, widths, values = self.rows(entity, component)
        k, flat = k[widths > 0], np.array(values)
        inside, found = k < len(column), column.copy()
        found[k[inside]] = flat[inside]
        return found

    def changed(self) -> list[str]:
        """Return the columns that differ from the checksums at the end of the log."""
        sums: dict[str, int] = json.loads(self.static(Entity.METRICS, "sums"))
        places: dict[str, int] = json.loads(self.static(Entity.METRICS, "places") or "{}")  # older logs have none
        bad = [key for key, total in sums.items() if (data := self._data(key)) is not None and crc32(data) != total]
        return bad + [key for key, total in places.items() if key not in bad and self._steps(key) not in (None, total)]

    def _steps(self, key: str) -> int | None:
        """Return the checksum of the steps of a column; None for an entity that is not read."""
        entity, component = key.split(":")
        if entity not in self._entities:
            return None
        return crc32(np.ascontiguousarray(self.rows(entity, component)[0], dtype=np.int64).data)

    def _data(self, key: str) -> Any:
        """Return the bytes of a column for its checksum; None for an entity that is not read."""
        import pyarrow as pa

        entity, component = key.split(":")
        if entity not in self._entities:
            return None
        values = self.rows(entity, component)[2]
        if isinstance(values, pa.StringArray):
            return "".join(values.to_pylist()).encode()
        return np.ascontiguousarray(values).data


def _key(entity: str, component: str) -> tuple[str, str]:
    return f"/{entity.removeprefix('/')}", component


def _whole(k: np.ndarray) -> int:
    """Return the number of rows before the first gap in 0, 1, 2, …."""
    gaps = np.flatnonzero(k != np.arange(len(k)))
    return int(gaps[0]) if len(gaps) else len(k)


def read_columns(path: Path, entities: tuple[str, ...]) -> LogColumns:
    """Return the columns of the `entities` in the file.

    Raises
    ------
    LogError
        The file is missing, no .rrd, or damaged beyond a torn end.
    """
    check_log(path)
    try:
        if intact(path):
            return LogColumns(read(path, entities), entities, torn=False)
        with _whole_messages(path) as (whole, torn):
            return LogColumns(read_in_child(whole, entities, path), entities, torn)
    except LogError:
        raise
    except Exception as error:  # Rerun's reader raises exceptions of many kinds
        raise LogError(f"{path} is no log, or is damaged: {error}") from error


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Raise LogError with the name of the file where its columns are not what koopmpc writes.

    Raises
    ------
    LogError
        The block failed on a value that it took from the columns.
    """
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, NotImplementedError, TypeError, ValueError) as error:
        raise LogError(f"{path} is damaged: {error}") from error


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
        raise LogError(f"{path} is no log of koopmpc: it does not start as an .rrd file does")


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


@dataclass(frozen=True, eq=False, kw_only=True)
class LogBlock(StepRows):
    """Rows k, k+1, … of a run, and the plans of those steps that have one.

    Attributes
    ----------
    k
        The step of the first row.
    planned
        (p,) steps that have a plan.
    plan_X, plan_U
        (p, N+1, nx) and (p, N, nu) their plans.
    """

    k: int
    planned: Int[np.ndarray, " p"]
    plan_X: Float[np.ndarray, "p N1 nx_plan"]
    plan_U: Float[np.ndarray, "p N nu_plan"]

    def cut(self, first: int, last: int) -> "LogBlock":
        """Return rows first … last − 1, counted from this block's own first row."""
        p = slice(*np.searchsorted(self.planned, [self.k + first, self.k + last]))
        plans = (self.planned[p], self.plan_X[p], self.plan_U[p])
        return _block(self.k + first, self.part(first, last), *plans)


def _block(
    k: int,
    rows: StepRows,
    planned: Int[np.ndarray, " p"],
    plan_X: Float[np.ndarray, "p N1 nx_plan"],
    plan_U: Float[np.ndarray, "p N nu_plan"],
) -> LogBlock:
    return LogBlock(**rows.columns(), k=k, planned=planned, plan_X=plan_X, plan_U=plan_U)


def block_of_run(run: Run) -> LogBlock:
    """Return the whole of `run` as one block."""
    plans = Plans(np.empty((0, 0, 0)), np.empty((0, 0, 0))) if run.plans is None else run.plans
    return _block(0, run, np.arange(len(plans.X)), plans.X, plans.U)


def block_of_steps(steps: Sequence[Step], nx: int, *, end: bool) -> LogBlock:
    """Return consecutive steps as a block; with `end`, the state that the last one led to follows."""
    plans = [step.plan for step in steps if step.plan is not None]
    whole = Plans.of(plans) or Plans(np.empty((0, 0, 0)), np.empty((0, 0, 0)))
    planned = np.array([step.k for step in steps if step.plan is not None], dtype=np.int64)
    return _block(steps[0].k, StepRows.of(steps, nx, end=end), planned, whole.X, whole.U)


def blocks(rows: LogBlock, least: int = 100, most: int = 5) -> list[LogBlock]:
    """Return `rows` as consecutive blocks of at least `least` steps, at most `most` of them.

    The state that the last move led to belongs to the last block.
    """
    moves = len(rows.U)
    size = max(least, -(-moves // most))
    starts = range(0, moves - size + 1, size) if moves > size else range(1)
    ends = [*starts[1:], len(rows.X)]
    return [rows.cut(a, b) for a, b in zip(starts, ends, strict=True)]
