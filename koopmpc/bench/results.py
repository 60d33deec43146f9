# pyright: basic
"""RunRow: the figures of one run of the bench and whether it ended as it should, as results.parquet and as tables."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from koopmpc import disk
from koopmpc.control.move import Fallback, Status
from koopmpc.loop.metrics import Metrics, duration, tracking_error
from koopmpc.loop.run import Run
from koopmpc.recording.description import STATUS_WORDS
from koopmpc.validate.text import plain_table

RESULTS = "results.parquet"  # beside the logs of the runs
ORACLE = "nonlinear-mpc"
REACHED = 0.05  # the band around the reference, as a share of the first weighted error
_TOLERANCE = 1e-9  # relative violation of an input limit that counts as rounding


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


def failures(run: Run, steps: int) -> list[str]:
    """Return why a run did not end as it should: steps missing, u not finite or beyond a limit, no status."""
    found: list[str] = []
    if run.steps != steps:
        found.append(f"it took {run.steps} of {steps} steps")
    if not np.isfinite(run.U).all():
        k = int(np.argwhere(~np.isfinite(run.U))[0][0])
        found.append(f"u is {run.U[k]} at step {k}")
    elif run.limits is not None:
        low, high = run.limits.inputs(run.U.shape[1])
        beyond = np.maximum(low - run.U, run.U - high)
        room = _TOLERANCE * (1.0 + np.abs(run.U))
        if (beyond > room).any():
            k = int(np.argmax((beyond - room).max(axis=1)))
            found.append(f"u = {run.U[k]} at step {k} is {beyond[k].max():.3g} beyond a hard limit")
    if len(run.status) != run.steps:
        found.append(f"{len(run.status)} of {run.steps} steps have a status")
    return found


@np.errstate(invalid="ignore", over="ignore")  # a state that diverged does not reach the reference
def reached(run: Run) -> bool:
    """Return True where √(eᵀQe) stays below 5 % of its first value over the last tenth of the run.

    A run that starts on its reference is measured against its largest error.
    """
    error = tracking_error(run)
    Q = np.eye(error.shape[1]) if run.cost is None else run.cost.matrices(error.shape[1], run.U.shape[1])[0]
    weighted = np.sqrt(np.einsum("ki,ij,kj->k", error, Q, error))
    scale = weighted[0] if weighted[0] > 0 else weighted.max()
    last = weighted[-max(1, len(weighted) // 10) :]
    return bool((last <= REACHED * scale).all() and np.isfinite(last).all())


_FIGURES: dict[str, type] = {
    "cost": float, "tracking_rmse": np.ndarray, "final_error": np.ndarray, "violation": float, "violation_share": float,
    "input_violation": float, "effort": float, "settling_time": float, "solve_time_p50": float, "solve_time_p99": float,
    "solve_time_max": float, "late": int, "unknown": int,
}  # fmt: skip
_KINDS: dict[str, type] = {
    "problem": str, "case": str, "controller": str, "fault": str, "noise": float, "wrong": float, "seed": int,
    "start": int, "x0": np.ndarray, **_FIGURES, "status": Status, "fallback": Fallback, "reached": bool,
    "training_time": float, "elapsed": float, "cold_p50": float, "cold_p99": float, "log": str, "failure": str,
}  # fmt: skip
_ROWS = 5000  # in a group of the table


def write_results(rows: Sequence[RunRow], path: Path) -> None:
    """Write the rows as .parquet: vectors are lists, `status` and `fallback` have a field for every name."""
    import pyarrow as pa
    import pyarrow.parquet as pq

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
    """Return the row as numbers, names and lists; the figures of a run that raised are None."""
    record: dict[str, Any] = {name: getattr(row, name, None) for name in _KINDS}
    record |= {"log": row.log and row.log.name, "x0": list(row.x0)}
    if row.metrics is not None:
        record |= {name: getattr(row.metrics, name) for name in (*_FIGURES, "status", "fallback")}
        record |= {name: record[name].tolist() for name, kind in _FIGURES.items() if kind is np.ndarray}
        record |= {name: dict(record[name]) for name in ("status", "fallback")}
        record["solver"] = dict(row.metrics.solver)
    return record


def row_of(record: Mapping[str, Any], folder: Path) -> RunRow:
    """Return the row that `record_of` made this record of; its log lies in `folder`."""
    figures = None
    if record["status"] is not None:
        values: dict[str, Any] = {name: record[name] for name in (*_FIGURES, "status", "fallback", "solver")}
        values |= {name: np.array(values[name]) for name, kind in _FIGURES.items() if kind is np.ndarray}
        figures = Metrics(**values)
    own = {name: value for name, value in record.items() if name in _OWN}
    log = None if record["log"] is None else folder / record["log"]
    return RunRow(**own, metrics=figures, log=log, x0=tuple(record["x0"]))


_OWN = tuple(field.name for field in fields(RunRow) if field.name not in ("metrics", "log", "x0"))


def _under_faults(title: str, rows: Sequence[RunRow]) -> Table:
    """Return a table of the runs of one case with a line for each controller, relative to its run without faults."""
    whole = {row.controller: row for row in rows if row.fault is None}
    found = {(row.fault, row.controller): row for row in rows if row.fault is not None}
    # Without padding the box still has a blank between columns.
    lines = plain_table(title, (), min_width=len(title), padding=0, show_edge=False)
    faults = list(dict.fromkeys(fault for fault, _ in found))
    lines.add_column("controller", no_wrap=True)
    for fault in faults:
        lines.add_column(str(fault).replace("-", "\n"), justify="right", no_wrap=True)
    for name, own in whole.items():
        cells = [_cell(found[fault, name], own) for fault in faults]
        failed = any(found[fault, name].failure for fault in faults)
        lines.add_row(name, *cells, style="red" if failed else None)
    return lines


def _cell(row: RunRow, whole: RunRow) -> str:
    """Return the cell of a run under a fault: its cost over that of the run without the fault, or a word."""
    if row.metrics is None:
        return "raised"
    if not row.reached:
        word = "lost" if whole.reached else "–"
    elif whole.metrics is not None and whole.metrics.cost > 0:
        ratio = row.metrics.cost / whole.metrics.cost
        word = f"{ratio:.3f}" if ratio < 100 else f"{ratio:.1g}"
    else:
        word = "reaches"
    fell_back = sum(count for name, count in row.metrics.fallback.items() if name != "NONE")
    return f"{word} ({fell_back})" if fell_back else word


LEGEND = "cost: of the run; ratio: to nonlinear-mpc's, which knows the equations; off: error at the end."
TIMES = "p50, p99: time of a step, in Python. `koopmpc explain WORD` explains every word, for example free."
UNDER_FAULTS = "under faults: cost over that without the fault (steps that fell back). See `koopmpc explain WORD`."


def results_table(rows: Sequence[RunRow]) -> RenderableType:
    """Return one table for each case, each failure in full and once, and what the columns mean, within 100 columns."""
    parts: list[RenderableType] = []
    for (problem, case), group in groupby(rows, key=lambda row: (row.problem, row.case)):
        ran = list(group)
        parts.append(_case(f"{problem}:{case}", [row for row in ran if row.fault is None]))
        if any(row.fault is not None for row in ran):
            parts.append(_under_faults(f"{problem}:{case} under faults", ran))
    failed: dict[str, list[str]] = {}
    for row in rows:
        if row.failure is not None:
            what = " ".join(filter(None, (f"{row.problem}:{row.case}", row.controller, row.fault)))
            failed.setdefault(row.failure, []).append(what)
    parts += [Text(f"{', '.join(which)}: {failure}", style="red") for failure, which in failed.items()]
    broken = any(row.fault is not None for row in rows)
    parts.append(Text(f"{LEGEND}\n{UNDER_FAULTS if broken else TIMES}", style="dim"))
    return Group(*parts)


def _case(title: str, rows: list[RunRow]) -> Table:
    lines = plain_table(title, (), padding=(0, 0, 0, 1))
    lines.add_column("controller", no_wrap=True)
    measured = [row.metrics for row in rows if row.metrics is not None]
    violated = any(figures.violation > 0 for figures in measured)
    for heading in ("cost", "ratio", "settles", "off", *["over"] * violated, "p50", "p99"):
        lines.add_column(heading, justify="right", no_wrap=True)
    lines.add_column("steps")
    oracle = next((row.metrics.cost for row in rows if row.controller == ORACLE and row.metrics), np.nan)
    for row in rows:
        if row.metrics is None:
            lines.add_row(row.controller, "raised", style="red")
        else:
            cells = _cells(row, row.metrics, oracle, violated)
            lines.add_row(row.controller, *cells, style="red" if row.failure else None)
    learned = max((row.training_time for row in rows), default=0.0)
    if learned:
        lines.caption = f"Koopman model learned from data in {duration(learned)}"
        lines.caption_justify = "left"
    return lines


def _cells(row: RunRow, figures: Metrics, oracle: float, violated: bool) -> Iterator[str]:
    yield f"{figures.cost:.1f}" if figures.cost < 1e5 else f"{figures.cost:.2g}"
    ratio = figures.cost / oracle if oracle > 0 else np.nan
    yield "–" if np.isnan(ratio) else f"{ratio:.3f}" if ratio < 100 else f"{ratio:.1g}"
    if not row.reached:
        yield "does not reach"
    else:
        yield f"{figures.settling_time:.2f} s" if np.isfinite(figures.settling_time) else "within 5 %"
    yield f"{np.abs(figures.final_error).max():.1g}"
    if violated:
        yield f"{figures.violation:.2g}"
    yield duration(figures.solve_time_p50)
    yield duration(figures.solve_time_p99)
    yield _counts(figures.status) + ("" if figures.unknown is None else f"; {figures.unknown} unknown")


def _counts(status: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {STATUS_WORDS[Status[name]]}" for name, count in status.items())
