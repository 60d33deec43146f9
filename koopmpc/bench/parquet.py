"""The rows of a sweep as .parquet."""
# pyright: basic

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.bench.results import Row
from koopmpc.control.move import Fallback, Status

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
}


def write_results(rows: Sequence[Row], path: Path) -> None:
    """Write one row a run as .parquet: vectors are lists, `status` and `fallback` have a field for every name."""
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
    pq.write_table(pa.Table.from_pylist([_record(row) for row in rows], schema=pa.schema(columns)), path)


def _record(row: Row) -> dict[str, Any]:
    """Return one line of the table; the figures of a run that raised are missing."""
    record: dict[str, Any] = {name: getattr(row, name) for name in (*_NAMES, "failure")}
    record |= {"reached": row.reached, "training_time": row.training_time, "log": row.log and row.log.name}
    if row.metrics is not None:
        record |= {name: getattr(row.metrics, name) for name in _FIGURES}
        record["status"] = {s.name: row.metrics.status.get(s.name, 0) for s in Status}
        record["fallback"] = {f.name: row.metrics.fallback.get(f.name, 0) for f in Fallback}
    return record
