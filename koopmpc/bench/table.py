"""The bench as a table to read: one table a case, one line a controller."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby

import numpy as np
from jaxtyping import Float
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from koopmpc.bench.fault_table import FAULT_LEGEND, under_faults
from koopmpc.bench.results import Row
from koopmpc.loop.metrics import Metrics

ORACLE = "nonlinear-mpc"

_STATUS = {
    "UNCONSTRAINED": "free",
    "OPTIMAL": "optimal",
    "SOFTENED": "softened",
    "SATURATED": "clipped",
    "MAX_ITERATIONS": "unfinished",
    "TIME_LIMIT": "out of time",
    "INFEASIBLE": "infeasible",
    "BAD_MEASUREMENT": "bad y",
    "FAILED": "failed",
}

LEGEND = (
    "cost: Σ‖x−r‖²_Q + ‖u‖²_R over the run, and its ratio to nonlinear-mpc. settles: time until the weighted "
    "error stays below 2 % of its first value. off: largest entry of x−r at the end. over: largest violation of "
    "a state or output limit. p50, p99: time of a step. Steps: free, the unconstrained optimum met all limits; "
    "optimal, a QP or NLP was solved; unfinished, it was not, and a fallback took over; clipped, the feedback was "
    "cut to the input limits."
)


def table(rows: Sequence[Row]) -> RenderableType:
    """Return one table for each case, the failures in full, and what the columns mean; 100 columns are enough."""
    parts: list[RenderableType] = []
    for (problem, case), group in groupby(rows, key=lambda row: (row.problem, row.case)):
        ran = list(group)
        parts.append(_case(f"{problem}:{case}", [row for row in ran if row.fault is None]))
        if any(row.fault is not None for row in ran):
            parts.append(under_faults(f"{problem}:{case} under faults", ran))
    for row in rows:
        if row.failure is not None:
            what = " ".join(filter(None, (f"{row.problem}:{row.case}", row.controller, row.fault)))
            parts.append(Text(f"{what}: {row.failure}", style="red"))
    parts.append(Text(LEGEND, style="dim"))
    if any(row.fault is not None for row in rows):
        parts.append(Text(FAULT_LEGEND, style="dim"))
    return Group(*parts)


def figures(metrics: Metrics) -> RenderableType:
    """Return all metrics of one run, a line each."""
    lines = Table(box=None, show_header=False)
    lines.add_column(style="bold")
    lines.add_column()
    for name, value in _lines(metrics):
        lines.add_row(name, value)
    return lines


def duration(seconds: float) -> str:
    """Return a time in µs, ms or s with three digits: ``"13.0 µs"``."""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.3g} µs"


def _case(title: str, rows: list[Row]) -> Table:
    lines = Table(
        title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, padding=(0, 0, 0, 1)
    )
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


def _cells(row: Row, figures: Metrics, oracle: float, violated: bool) -> Iterator[str]:
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
    yield _counts(figures.status)


def _counts(status: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {_STATUS[name]}" for name, count in status.items())


def _lines(metrics: Metrics) -> Iterator[tuple[str, str]]:
    yield "cost", f"{metrics.cost:.6g}"
    yield "tracking rmse", _vector(metrics.tracking_rmse)
    yield "final error", _vector(metrics.final_error)
    yield "violation", f"{metrics.violation:.3g}"
    yield "input violation", f"{metrics.input_violation:.3g}"
    yield "effort", f"{metrics.effort:.6g}"
    settles = np.isfinite(metrics.settling_time)
    yield "settling time", f"{metrics.settling_time:.3g} s" if settles else "does not settle"
    times = (metrics.solve_time_p50, metrics.solve_time_p99, metrics.solve_time_max)
    yield "solve time p50, p99, max", ", ".join(duration(t) for t in times)
    yield "steps later than dt", str(metrics.late)
    yield "status", _named(metrics.status)
    yield "fallback", _named(metrics.fallback)


def _vector(values: Float[np.ndarray, " n"]) -> str:
    return "[" + ", ".join(f"{v:.4g}" for v in values) + "]"


def _named(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())
