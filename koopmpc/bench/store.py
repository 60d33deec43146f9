"""The store of a sweep: what was asked for, a line for each finished run, its `RunRow`, and the table of all rows.

A worker writes the line of a run when the run ends, by one system call: kill -9 loses only runs that are under way.
It holds its file locked meanwhile: a sweep that goes on waits for workers which outlive the sweep that was killed.
Each line, and the manifest, holds a checksum of the rest: a line that does not match is reported and left out. The
table, results.parquet, is a copy of the lines; it is written now and then and at the end, and renamed when complete.
"""

import errno
import json
import os
import platform
import time
import warnings
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from importlib.metadata import version
from io import FileIO
from pathlib import Path
from typing import Any, cast, get_type_hints

import numpy as np

from koopmpc import disk
from koopmpc.control.move import Fallback, Status
from koopmpc.errors import LogError, ProblemError
from koopmpc.loop.metrics import Metrics, tracking_error, weigh_error
from koopmpc.loop.run import Run
from koopmpc.values import checksum

MANIFEST = "sweep.json"
ROWS = "rows"  # folder of the lines of finished runs
FORMAT = "koopmpc-sweep-1"
_LINE = json.JSONEncoder()
_SEAL = "crc32"  # key of a line's checksum
_OUTLIVES = 2.0  # time that a worker gets to end after the sweep that it works for [s]
RESULTS = "results.parquet"  # beside the logs of the runs
ORACLE = "nonlinear-mpc"
REACHED = 0.05  # the band around the reference, as a share of the first weighted error
KEY = ("problem", "case", "controller", "fault", "noise", "wrong", "seed", "start")


@dataclass(frozen=True)
class RunRow:
    """One run of the bench.

    Attributes
    ----------
    problem, case, controller
        Names that identify the run.
    metrics
        Figures of the run; None where it raised.
    reached
        Whether the weighted tracking error stays below 5 % of its first value over the last tenth of the run.
    training_time
        Time to collect the data and fit the model [s]; 0 for controllers that learn nothing.
    log
        Path of the log; None where there is none.
    failure
        Why the run did not end as it should; None where it did. Poor control is no failure.
    fault
        Name of the injected fault; None where there was none.
    start
        0 for the case's own initial state, else the number of the drawn one.
    seed
        What was added to the seed of the training data.
    noise
        Standard deviation of the measurement noise, as a share of that of each output in the training data.
    wrong
        Largest share by which the parameters of the driven plant differ from those that controllers know.
    x0
        The initial state.
    elapsed
        Time of the whole run: controller, loop, figures and log [s].
    cold_p50, cold_p99
        Median and 99 % quantile of a step after 4 ms of sleep [s], NaN where they were not measured.
    """

    problem: str
    case: str
    controller: str
    metrics: Metrics | None = None
    reached: bool = False
    training_time: float = 0.0
    log: Path | None = None
    failure: str | None = None
    fault: str | None = None
    start: int = 0
    seed: int = 0
    noise: float = 0.0
    wrong: float = 0.0
    x0: tuple[float, ...] = ()
    elapsed: float = 0.0
    cold_p50: float = float("nan")
    cold_p99: float = float("nan")

    @property
    def key(self) -> tuple[Any, ...]:
        """What makes this run another than all others of its sweep."""
        return tuple(getattr(self, name) for name in KEY)

    @property
    def name(self) -> str:
        """The name of its log, without the suffix; what is as usual is left out."""
        parts = [self.problem, self.case, self.controller, self.fault]
        parts += [f"{sign}{value:g}" for sign, value in zip("nwsx", self.key[4:], strict=True) if value]
        return "-".join(part for part in parts if part is not None)


@np.errstate(invalid="ignore", over="ignore")  # a state that diverged does not reach the reference
def reached(run: Run) -> bool:
    """Return True where √(eᵀQe) stays below 5 % of its first value over the last tenth of the run.

    A run that starts on its reference is measured against its largest error.
    """
    weighted = weigh_error(run, tracking_error(run))
    scale = weighted[0] if weighted[0] > 0 else weighted.max()
    last = weighted[-max(1, len(weighted) // 10) :]
    return bool((last <= REACHED * scale).all() and np.isfinite(last).all())


def row_to_view(rows: Sequence[RunRow]) -> RunRow | None:
    """Return the run to look at first: the koopman-mpc that reaches and costs most compared with nonlinear-mpc.

    Without such a comparison it is the first run of koopman-mpc, else the first run that has a log.
    """
    logged = [row for row in rows if row.log is not None and not any(row.key[3:])]
    koopman = [row for row in logged if row.controller == "koopman-mpc"]
    oracle = {(row.problem, row.case): row.metrics.cost for row in rows if row.controller == ORACLE and row.metrics}

    def ratio(row: RunRow) -> float:
        best = oracle.get((row.problem, row.case), 0.0)
        return row.metrics.cost / best if row.reached and row.metrics is not None and best > 0 else 0.0

    return max(koopman, key=ratio) if koopman else next(iter(logged), None)


_COUNTS = ("status", "fallback", "solver")  # the figures that count steps by name
_HINTS: dict[str, Any] = get_type_hints(Metrics)
_FIGURES: dict[str, type] = {
    each.name: {float: float, int: int, int | None: int}.get(_HINTS[each.name], np.ndarray)
    for each in fields(Metrics)
    if each.name not in _COUNTS
}
_KINDS: dict[str, type] = {
    "problem": str, "case": str, "controller": str, "fault": str, "noise": float, "wrong": float, "seed": int,
    "start": int, "x0": np.ndarray, **_FIGURES, "status": Status, "fallback": Fallback, "reached": bool,
    "training_time": float, "elapsed": float, "cold_p50": float, "cold_p99": float, "log": str, "failure": str,
}  # fmt: skip
_ROWS = 5000  # in a group of the table


def write_results(rows: Sequence[RunRow], path: Path) -> None:
    """Write the rows as .parquet: vectors are lists, `status` and `fallback` have a field for every name."""
    import pyarrow
    from pyarrow import parquet

    pa, pq = cast("Any", pyarrow), cast("Any", parquet)  # they have no types
    vector = pa.list_(pa.float64())
    plain = {str: pa.string(), float: pa.float64(), int: pa.int64(), bool: pa.bool_(), np.ndarray: vector}
    counts = {kind: pa.struct([(each.name, pa.int64()) for each in kind]) for kind in (Status, Fallback)}
    schema = pa.schema([(name, (plain | counts)[kind]) for name, kind in _KINDS.items()])
    with disk.writing(path) as stream, pq.ParquetWriter(stream, schema, write_page_checksum=True) as writer:
        for first in range(0, max(len(rows), 1), _ROWS):
            records = [record_of(row) for row in rows[first : first + _ROWS]]
            for record in records:
                for kind, name in ((Status, "status"), (Fallback, "fallback")):
                    if record[name] is not None:
                        record[name] = {each.name: record[name].get(each.name, 0) for each in kind}
            writer.write_table(pa.Table.from_pylist(records, schema=schema))


def record_of(row: RunRow) -> dict[str, Any]:
    """Return the row as numbers, names and lists; a run that raised has None in place of figures."""
    record: dict[str, Any] = {name: getattr(row, name, None) for name in _KINDS}
    record |= {"log": row.log and row.log.name, "x0": list(row.x0)}
    if row.metrics is not None:
        record |= {name: getattr(row.metrics, name) for name in _FIGURES}
        record |= {name: record[name].tolist() for name, kind in _FIGURES.items() if kind is np.ndarray}
        record |= {name: dict(getattr(row.metrics, name)) for name in _COUNTS}
    return record


def parse_row(record: Mapping[str, Any], folder: Path) -> RunRow:
    """Return the row that `record_of` made this record of; its log lies in `folder`."""
    figures = None
    if record["status"] is not None:
        values: dict[str, Any] = {name: record[name] for name in (*_FIGURES, *_COUNTS)}
        values |= {name: np.array(values[name]) for name, kind in _FIGURES.items() if kind is np.ndarray}
        figures = Metrics(**values)
    own = {name: value for name, value in record.items() if name in _OWN}
    log = None if record["log"] is None else folder / record["log"]
    return RunRow(**own, metrics=figures, log=log, x0=tuple(record["x0"]))


_OWN = tuple(field.name for field in fields(RunRow) if field.name not in ("metrics", "log", "x0"))


class Journal:
    """The lines of one batch of runs: that a run begins, and what came out of it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        lines = list(_lines(path))
        self.rows = {row.key: row for _, row in lines if row is not None}
        self._begun = [line["begins"] for line, row in lines if row is None]

    def __enter__(self) -> "Journal":
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("ab", buffering=0)
        except OSError as error:
            raise disk.explain_failure(self.path, error) from error
        _lock(self._file)
        if self._file.tell():
            self._write(b"\n")  # the last line was torn, perhaps, when a worker was killed
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        self._file.close()

    def turn(self, done: RunRow | None, following: RunRow | None) -> int:
        """Write what came out of a run, and that the next begins; return how often that has begun in this batch before.

        Both are one system call.
        """
        told = [] if done is None else [record_of(done)]
        told += [] if following is None else [{"begins": following.name}]
        self._write("".join(f"{_LINE.encode(_seal(each))}\n" for each in told).encode())
        return 0 if following is None or not self._begun else self._begun.count(following.name)

    def _write(self, line: bytes) -> None:
        try:
            _whole(self._file, line)
        except OSError as error:
            raise disk.explain_failure(self.path, error) from error


def _whole(file: FileIO, data: bytes) -> None:
    """Write all of the data by one system call; raise where the disk takes a part of it."""
    if file.write(data) != len(data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _seal(content: dict[str, Any]) -> dict[str, Any]:
    """Return the content with the checksum of its text."""
    return {**content, _SEAL: checksum(_LINE.encode(content).encode())}


def _unseal(text: bytes) -> dict[str, Any]:
    """Return the content of a text that holds its checksum.

    Raises
    ------
    ValueError
        The text is cut, no longer what was written, or of an edition that wrote no checksums.
    """
    content: object = json.loads(text)
    if not isinstance(content, dict):
        raise ValueError("it is not a JSON object")
    content = cast("dict[str, Any]", content)
    if _SEAL not in content:
        raise ValueError("it has no checksum: it is of an edition before 0.1.0; run the sweep again")
    if content.pop(_SEAL) != checksum(_LINE.encode(content).encode()):
        raise ValueError("it no longer holds what was written")
    return content


def _lines(path: Path) -> Iterator[tuple[dict[str, Any], RunRow | None]]:
    """Yield each whole line, and the row of a run that it holds.

    A line that was torn is left out, for its run is done again, and so is a damaged one, with a warning.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return
    damaged = 0
    for line in filter(None, data.split(b"\n")):
        try:
            found = _unseal(line)
            yield found, None if "begins" in found else parse_row(found, path.parent.parent)
        except (LookupError, TypeError, ValueError):
            damaged += _SEAL.encode() in line or line.endswith(b"}")
    if damaged:
        warnings.warn(
            f"{path}: {damaged} lines are damaged and were left out; the same sweep in this folder does their runs "
            "again",
            UserWarning,
            stacklevel=3,
        )


def _rows_in(path: Path) -> list[RunRow]:
    return [row for _, row in _lines(path) if row is not None]


def load_rows(folder: str | Path) -> list[RunRow]:
    """Return the finished runs of a sweep's folder, each once.

    Raises
    ------
    LogError
        The folder holds no sweep.
    """
    folder = Path(folder)
    if not (folder / MANIFEST).is_file():
        raise LogError(f"{folder} holds no sweep: there is no {MANIFEST} in it; pass the folder of `koopmpc bench`")
    found: dict[tuple[Any, ...], RunRow] = {}
    for path in sorted((folder / ROWS).glob("*.jsonl")):
        for row in _rows_in(path):
            found.setdefault(row.key, row)
    return list(found.values())


def next_batch(folder: Path) -> int:
    """Return the first number that no batch of this folder has."""
    return 1 + max((int(path.stem) for path in (folder / ROWS).glob("*.jsonl") if path.stem.isdigit()), default=-1)


@contextmanager
def open_sweep(folder: Path, asked: Mapping[str, Any]) -> Generator[dict[str, Any]]:
    """Claim the folder for the sweep that is asked for, and yield its manifest; a sweep that was broken off goes on.

    Raises
    ------
    ProblemError
        The folder holds another sweep, or another process is at work in it.
    """
    path = folder / MANIFEST
    asked = json.loads(json.dumps(asked))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = path.open("a+b", buffering=0)
    except OSError as error:
        raise disk.explain_failure(path, error) from error
    with file:
        _claim(file, folder)
        file.seek(0)
        text = file.read()
        try:
            known = _unseal(text) if text.strip() else {}
        except ValueError as error:
            raise ProblemError(f"{path} is damaged; pass another folder, or remove it: {error}") from error
        if known and known["asked"] != asked:
            names = [name for name in asked if known["asked"].get(name) != asked[name]]
            raise ProblemError(f"{folder} holds another sweep, of other {', '.join(names)}; pass another folder")
        if not known:
            known = {"format": FORMAT, "asked": asked, "machine": machine()}
            file.truncate(0)
            try:
                _whole(file, json.dumps(_seal(known), indent=1).encode())
            except OSError as error:
                file.truncate(0)
                raise disk.explain_failure(path, error) from error
        yield known


def _claim(manifest: FileIO, folder: Path) -> None:
    """Lock the manifest, as long as this process lives, once the workers of a sweep that was killed have ended.

    Raises
    ------
    ProblemError
        Another sweep is at work in the folder, or a worker of one.
    """
    busy, ends = not _lock(manifest), time.monotonic() + _OUTLIVES
    for path in sorted((folder / ROWS).glob("*.jsonl")):
        with path.open("ab", buffering=0) as file:
            while not busy and not _lock(file):
                time.sleep(0.01)
                busy = time.monotonic() >= ends
    if busy:
        raise ProblemError(f"another process runs a sweep in {folder}; wait for it, or pass another folder")


def _lock(file: FileIO) -> bool:
    """Lock the file until it is closed, and return whether no other process has it locked."""
    with suppress(ImportError):  # Windows has no fcntl
        import fcntl

        try:
            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
    return True


def manifest_of(folder: str | Path) -> dict[str, Any]:
    """Return what was asked for in a sweep's folder, and on which machine.

    Raises
    ------
    LogError
        The folder holds no sweep, or the file is damaged.
    """
    path = Path(folder) / MANIFEST
    try:
        return _unseal(path.read_bytes())
    except (OSError, ValueError) as error:
        raise LogError(
            f"{folder} holds no sweep: {MANIFEST} is missing or damaged; pass that of `koopmpc bench`"
        ) from error


def machine() -> dict[str, Any]:
    """Return what step times depend on: processor, cores, load, threads of BLAS, and versions."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    packages = ("koopmpc", "numpy", "scipy", "casadi", "osqp", "daqp")
    return {
        "processor": _processor(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "load": round(load, 2),
        "blas_threads": os.environ.get("OPENBLAS_NUM_THREADS") or os.environ.get("OMP_NUM_THREADS"),
        "versions": {name: version(name) for name in packages},
    }


def _processor() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
