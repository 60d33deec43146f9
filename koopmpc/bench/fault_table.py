"""One case under faults: a line a fault, a column a controller."""

from collections.abc import Sequence

from rich import box
from rich.table import Table

from koopmpc.bench.results import Row

FAULT_LEGEND = (
    "Under faults: a controller's cost as a multiple of its own without the fault; lost, where only the fault "
    "keeps it from the reference; –, where it does not reach without the fault either. In brackets, the steps "
    "whose input came from a fallback. LQR has no solver to fail, and a Koopman or linear MPC solves nothing "
    "where no limit is active."
)


def under_faults(title: str, rows: Sequence[Row]) -> Table:
    """Return the runs of one case that had a fault, against those that had none."""
    whole = {row.controller: row for row in rows if row.fault is None}
    found = {(row.fault, row.controller): row for row in rows if row.fault is not None}
    lines = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        min_width=len(title),
        padding=0,  # the box has a blank between columns
        show_edge=False,
    )
    lines.add_column("fault", no_wrap=True)
    for controller in whole:
        lines.add_column(controller.replace("-", "\n"), justify="right", no_wrap=True)
    for fault in dict.fromkeys(fault for fault, _ in found):
        cells = [_cell(found[fault, name], whole[name]) for name in whole]
        failed = any(found[fault, name].failure for name in whole)
        lines.add_row(fault, *cells, style="red" if failed else None)
    return lines


def _cell(row: Row, whole: Row) -> str:
    """Return how a controller did under a fault."""
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
