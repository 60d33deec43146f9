# pyright: basic
"""RunRow: the figures of one run of the bench, whether it ended as it should, and results.parquet."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc import disk
from koopmpc.control.move import Fallback, Status
from koopmpc.loop.metrics import Metrics, tracking_error
from koopmpc.loop.run import Run

ORACLE = "nonlinear-mpc"
REACHED = 0.05  # the band around the reference, as a share of the first weighted error
_TOLERANCE = 1e-9  # relative violation of an input limit that counts as rounding


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


def row_to_view(rows: Sequence[RunRow]) -> RunRow | None:
    """Return the run to look at first: the koopman-mpc that reaches and costs most compared with nonlinear-mpc.

    Without such a comparison it is the first run of koopman-mpc, else the first run that has a log.
    """
    logged = [row for row in rows if row.log is not None and row.fault is None]
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


_NAMES = ("problem", "case", "controller", "fault")
_FIGURES: dict[str, type] = {
    "cost": float,
    "tracking_rmse": np.ndarray,
    "final_error": np.ndarray,
    "violation": float,
    "input_violation": float,
    "effort": float,
    "settling_time": float,
    "solve_time_p50": float,
    "solve_time_p99": float,
    "solve_time_max": float,
    "late": int,
    "unknown": int,
}


def write_results(rows: Sequence[RunRow], path: Path) -> None:
    """Write the rows as .parquet: vectors are lists, `status` and `fallback` have a field for every name."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    number, whole, text, vector = pa.float64(), pa.int64(), pa.string(), pa.list_(pa.float64())
    kinds = {float: number, int: whole, np.ndarray: vector}
    columns: list[tuple[str, Any]] = [(name, text) for name in _NAMES]
    for name, kind in _FIGURES.items():
        columns.append((name, kinds[kind]))
    columns += [("status", pa.struct([(s.name, whole) for s in Status]))]
    columns += [("fallback", pa.struct([(f.name, whole) for f in Fallback]))]
    columns += [("reached", pa.bool_()), ("training_time", number), ("log", text), ("failure", text)]
    table = pa.Table.from_pylist([_record(row) for row in rows], schema=pa.schema(columns))
    with disk.writing(path) as stream:
        pq.write_table(table, stream, write_page_checksum=True)


def _record(row: RunRow) -> dict[str, Any]:
    """Return the row as a record of the table; the figures of a run that raised are missing."""
    record: dict[str, Any] = {name: getattr(row, name) for name in (*_NAMES, "failure")}
    record |= {"reached": row.reached, "training_time": row.training_time, "log": row.log and row.log.name}
    if row.metrics is not None:
        record |= {name: getattr(row.metrics, name) for name in _FIGURES}
        record["status"] = {s.name: row.metrics.status.get(s.name, 0) for s in Status}
        record["fallback"] = {f.name: row.metrics.fallback.get(f.name, 0) for f in Fallback}
    return record
