"""The store of a sweep: an SQLite file of what was asked for and of a row for each finished run, and the table of all.

The process that sweeps writes alone, a transaction a run: kill -9 loses only runs that are under way. It always has a
transaction open, so that a second sweep in the folder is refused, while others may read. The journal is SQLite's
rollback journal, for a write-ahead log needs memory that network folders do not share. Each text is kept with its
checksum: a row that does not match is reported and left out. The table, results.parquet, is a copy of the rows, written
at the end and renamed when complete.
"""

import json
import os
import platform
import sqlite3
import warnings
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast, get_type_hints

import numpy as np

from koopmpc.base import disk
from koopmpc.base.errors import FullDiskError, LogError, ProblemError
from koopmpc.base.values import checksum
from koopmpc.control.move import Fallback, Status
from koopmpc.loop.metrics import Metrics, tracking_error, weigh_error
from koopmpc.loop.run import Run

STORE = "sweep.sqlite"
OLD_MANIFEST = "sweep.json"  # of an edition before 0.1.0, which wrote a file of lines for each batch of runs
RESULTS = "results.parquet"  # beside the logs of the runs
ORACLE = "nonlinear-mpc"
REACHED = 0.05  # the band around the reference, as a share of the first weighted error
KEY = ("problem", "case", "controller", "fault", "noise", "wrong", "seed", "start")
_ASKED = "asked"  # name of the text that says what was asked for; the other texts are rows of runs
_TABLE = "CREATE TABLE IF NOT EXISTS texts (name TEXT PRIMARY KEY, text TEXT NOT NULL, checksum INTEGER NOT NULL)"


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


def write_results(rows: Sequence[RunRow], path: Path) -> None:
    """Write the rows as .parquet: vectors are lists, `status` and `fallback` have a field for every name."""
    import pyarrow
    from pyarrow import parquet

    pa, pq = cast("Any", pyarrow), cast("Any", parquet)  # they have no types
    vector = pa.list_(pa.float64())
    plain = {str: pa.string(), float: pa.float64(), int: pa.int64(), bool: pa.bool_(), np.ndarray: vector}
    counts = {kind: pa.struct([(each.name, pa.int64()) for each in kind]) for kind in (Status, Fallback)}
    schema = pa.schema([(name, (plain | counts)[kind]) for name, kind in _KINDS.items()])
    records = [record_of(row) for row in rows]
    for record in records:
        for kind, name in ((Status, "status"), (Fallback, "fallback")):
            if record[name] is not None:
                record[name] = {each.name: record[name].get(each.name, 0) for each in kind}
    with disk.writing(path) as stream:
        pq.write_table(pa.Table.from_pylist(records, schema=schema), stream, write_page_checksum=True)


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


class Store:
    """The open store of a sweep; `asked` and `machine` say what was asked for, and where."""

    def __init__(self, file: sqlite3.Connection, path: Path) -> None:
        self._file, self._path, self._folder = file, path, path.parent
        texts = _read_texts(file, path)
        self.about: dict[str, Any] | None = texts.pop(_ASKED, None)
        self.rows = {row.key: row for row in (parse_row(text, path.parent) for text in texts.values())}

    def write(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a text, and keep the transaction that tells other sweeps that this one is at work."""
        text = json.dumps(content)
        with _translate_errors(self._path):
            values = (name, text, checksum(name.encode(), text.encode()))
            self._file.execute("INSERT OR REPLACE INTO texts VALUES (?, ?, ?)", values)
            self._file.execute("COMMIT")
            self._file.execute("BEGIN IMMEDIATE")

    def add(self, row: RunRow) -> RunRow:
        """Write a finished run, and return its row as it is read back."""
        record = record_of(row)
        self.write(row.name, record)
        self.rows[row.key] = parse_row(record, self._folder)
        return self.rows[row.key]


@contextmanager
def open_sweep(folder: Path, asked: Mapping[str, Any]) -> Generator[Store]:
    """Claim the folder for the sweep that is asked for, and yield its store; a sweep that was broken off goes on.

    Raises
    ------
    ProblemError
        The folder holds another sweep, or another process is at work in it.
    """
    path = folder / STORE
    asked = json.loads(json.dumps(asked))
    _refuse_old(folder, ProblemError)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.touch()
    except OSError as error:
        raise disk.explain_failure(path, error) from error
    with closing(sqlite3.connect(path, timeout=0, isolation_level=None)) as file:
        with _translate_errors(path):
            try:
                file.execute("BEGIN IMMEDIATE")
            except sqlite3.OperationalError as error:
                if error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY:
                    raise ProblemError(
                        f"another process runs a sweep in {folder}; wait for it, or pass another folder"
                    ) from error
                raise
            file.execute("PRAGMA busy_timeout = 60000")  # [ms] wait for those who read while a run is written
            file.execute(_TABLE)
            store = Store(file, path)
        if store.about is not None and store.about["asked"] != asked:
            names = [name for name in asked if store.about["asked"].get(name) != asked[name]]
            raise ProblemError(f"{folder} holds another sweep, of other {', '.join(names)}; pass another folder")
        if store.about is None:
            store.about = {"asked": asked, "machine": machine()}
            store.write(_ASKED, store.about)
        yield store


def load_rows(folder: str | Path) -> list[RunRow]:
    """Return the finished runs of a sweep's folder, each once.

    Raises
    ------
    LogError
        The folder holds no sweep.
    """
    return list(read_store(_find_store(Path(folder))).rows.values())


def manifest_of(folder: str | Path) -> dict[str, Any]:
    """Return what was asked for in a sweep's folder, and on which machine.

    Raises
    ------
    LogError
        The folder holds no sweep, or the file is damaged.
    """
    about = read_store(_find_store(Path(folder))).about
    if about is None:
        raise LogError(f"{folder} holds no sweep: what was asked for is missing or damaged in {STORE}")
    return about


def _find_store(folder: Path) -> Path:
    _refuse_old(folder, LogError)
    path = folder / STORE
    if not path.is_file():
        raise LogError(f"{folder} holds no sweep: there is no {STORE} in it; pass the folder of `koopmpc bench`")
    return path


def read_store(path: Path) -> Store:
    """Return what the file of a sweep holds; it may be written meanwhile."""
    with _translate_errors(path), closing(sqlite3.connect(path.resolve().as_uri() + "?mode=ro", uri=True)) as file:
        return Store(file, path)


def _refuse_old(folder: Path, kind: type[Exception]) -> None:
    if (folder / OLD_MANIFEST).is_file() and not (folder / STORE).exists():
        raise kind(
            f"{folder} holds a sweep of an edition before 0.1.0, in {OLD_MANIFEST}; run it again in another folder"
        )


def _read_texts(file: sqlite3.Connection, path: Path) -> dict[str, dict[str, Any]]:
    """Return the texts whose checksums are right; warn of the others, and of a file whose parts do not fit."""
    contents: dict[str, dict[str, Any]] = {}
    damaged = 0
    if not file.execute("SELECT count(*) FROM sqlite_schema WHERE name = 'texts'").fetchone()[0]:
        return contents  # the sweep was broken off before it wrote
    for name, text, check in file.execute("SELECT name, text, checksum FROM texts"):
        if isinstance(name, str) and isinstance(text, str) and checksum(name.encode(), text.encode()) == check:
            contents[name] = json.loads(text)
        else:
            damaged += 1
    if damaged or file.execute("PRAGMA integrity_check(1)").fetchone() != ("ok",):
        warnings.warn(
            f"{path}: {damaged or 'some'} rows are damaged and were left out; the same sweep in this folder does their "
            "runs again",
            UserWarning,
            stacklevel=4,
        )
    return contents


@contextmanager
def _translate_errors(path: Path) -> Generator[None]:
    """Turn errors of SQLite into those of koopmpc."""
    try:
        yield
    except (sqlite3.Error, UnicodeDecodeError) as error:
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF  # the other bytes are details
        if code in (sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR):
            raise FullDiskError(
                f"{path} cannot be written: {error}; the finished runs are kept, make room and run it again"
            ) from error
        if code in (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_PERM):
            raise LogError(f"{path} cannot be written or read: {error}; pass another folder") from error
        raise LogError(f"{path} is damaged ({error}); pass another folder, or remove it") from error


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
