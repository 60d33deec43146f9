"""The bench as text: one table for each case, one line for each controller."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from koopmpc.bench.results import ORACLE, RunRow
from koopmpc.control.move import Status
from koopmpc.loop.metrics import Metrics, duration
from koopmpc.recording.description import STATUS_WORDS


def plain_table(title: str, **settings: Any) -> Table:
    """Return an empty table with its title at the left and one rule below the headings."""
    return Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, **settings)


def _under_faults(title: str, rows: Sequence[RunRow]) -> Table:
    """Return a table of the runs of one case with a line for each controller, relative to its run without faults."""
    whole = {row.controller: row for row in rows if row.fault is None}
    found = {(row.fault, row.controller): row for row in rows if row.fault is not None}
    # Without padding the box still has a blank between columns.
    lines = plain_table(title, min_width=len(title), padding=0, show_edge=False)
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
    lines = plain_table(title, padding=(0, 0, 0, 1))
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
