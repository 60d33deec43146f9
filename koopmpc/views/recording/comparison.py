# pyright: basic
"""record_comparison: several runs in one set of plots: states, inputs, cost so far, and a table of their metrics."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.base.errors import KoopmpcError, LogError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.text import format_markdown_table
from koopmpc.loop.metrics import metrics, running_cost
from koopmpc.loop.run import Run
from koopmpc.views.recording.blueprint import (
    LIMIT,
    REFERENCE,
    color,
    draw_line,
    frame_views,
    limit_lines,
    readable,
    shared_time,
    write_page,
)
from koopmpc.views.recording.description import drawable, table_figures, title_of
from koopmpc.views.recording.reader import load_run
from koopmpc.views.recording.rrd import file_recording


@raise_swallowed()  # Python drops a Ctrl-C that comes while a recording is deleted
def record_comparison(logs: Sequence[str | Path], path: str | Path) -> None:
    """Write the runs of several logs as one .rrd, with a colour each run in every plot.

    A state or an input is drawn for the runs that have it, by its name. Time begins at 0 in each run.

    Parameters
    ----------
    logs
        At least two logs of runs.
    path
        The .rrd to write.

    Raises
    ------
    LogError
        A log is missing, damaged, or none of a run; there are less than two; no state or input is common to two runs;
        the path cannot be written.
    """
    import rerun.blueprint as rrb

    if len(logs) < 2:
        raise LogError("a comparison needs two logs or more; pass them all, or leave --compare out")
    runs = [load_run(log) for log in logs]
    names, heading = _names(runs, [Path(log) for log in logs])
    states = _in_order([run.states for run in runs])
    inputs = _in_order([run.inputs for run in runs])
    if max(sum(name in (*run.states, *run.inputs) for run in runs) for name in (*states, *inputs)) < 2:
        raise LogError(f"the runs of {', '.join(map(str, logs))} have no state and no input in common")
    costs = [_cost(run) for run in runs]
    plots = [(f"state/{i}", name, _curves(runs, name, "states", "X")) for i, name in enumerate(states)]
    plots += [(f"input/{j}", name, _curves(runs, name, "inputs", "U")) for j, name in enumerate(inputs)]
    plots = plots[:8]  # plots of states and inputs in one column
    plots += [("cost", "Cost so far", costs)] if any(values is not None for values in costs) else []
    longest = max(run.steps * run.dt for run in runs)
    layout = rrb.Horizontal(
        rrb.Vertical(
            *(_view(entity, title, curves, i == 0, longest) for i, (entity, title, curves) in enumerate(plots))
        ),
        rrb.TextDocumentView(origin="metrics", name="Metrics"),
        column_shares=[1.5, 1.0],  # the table names figures and holds a column a run,
    )
    with file_recording(path, "koopmpc-comparison", frame_views(layout)) as rec:
        rec.send_recording_name(drawable(" against ".join(names)))
        for entity, title, curves in plots:
            for r, (run, values) in enumerate(zip(runs, curves, strict=True)):
                if values is not None:
                    held = {"interpolation_mode": "StepAfter"} if entity.startswith("input") else {}
                    draw_line(rec, f"{entity}/{r + 1}", names[r], color(r), 2.0, values, run.dt, **held)
            for r, (name, shade, values, dt) in enumerate(_marks(runs, title)):
                draw_line(rec, f"{entity}/mark/{r}", name, shade, 1.0, values, dt)
        write_page(rec, "metrics", f"{heading}{_table(runs, names)}")


def _names(runs: Sequence[Run], paths: Sequence[Path]) -> tuple[list[str], str]:
    """Return the title of each run, without what all of them share; and that, in bold, to stand above the table.

    Where two titles are the same they have the name of the file too.
    """
    titles = [title_of(run).split(" · ") for run in runs]
    shared = [part for part in titles[0] if all(part in other for other in titles)]
    short = [" · ".join(part for part in title if part not in shared) for title in titles]
    whole = [" · ".join(title) for title in titles]
    chosen = short if all(short) and len(set(short)) == len(short) else whole
    names = [name if chosen.count(name) == 1 else f"{name} ({p})" for name, p in zip(chosen, paths, strict=True)]
    return names, f"**{' · '.join(shared)}**\n\n" if shared else ""


def _in_order(named: Sequence[Sequence[str]]) -> list[str]:
    return list(dict.fromkeys(name for names in named for name in names))


def _curves(runs: Sequence[Run], name: str, names: str, field: str) -> list[np.ndarray | None]:
    """Return the values of one state or input in each run, None where a run has none of this name."""
    found: list[np.ndarray | None] = []
    for run in runs:
        known = getattr(run, names)
        values = getattr(run, field)[:, known.index(name)] if name in known else None
        if values is not None and field == "X" and not np.isfinite(values).any() and name in run.outputs:
            values = run.Y[:, run.outputs.index(name)]  # the plant hides its state
        found.append(values)
    return found


def _cost(run: Run) -> np.ndarray | None:
    try:
        return None if run.cost is None else running_cost(run)
    except KoopmpcError:
        return None


def _marks(runs: Sequence[Run], title: str) -> list[tuple[str, Any, np.ndarray, float]]:
    """Return the references and limits of a plot: name, colour, values, sample time; those that are equal once."""
    found: dict[bytes, tuple[str, Any, np.ndarray, float]] = {}
    for run in runs:
        tracked = run.name_references(run.reference.shape[1])
        if title in tracked:
            values = run.reference[:, tracked.index(title)]
            key = b"r" + (values[:1] if np.ptp(values) == 0 else values).tobytes()
            found.setdefault(key, ("reference", REFERENCE, values, run.dt))
        for kind in ("states", "inputs"):
            lines = limit_lines(run, kind, [title], np.arange(run.steps + (kind == "states")))
            for values in lines.T:
                if np.ptp(values) == 0:
                    line = ("limits", LIMIT, np.full(2, values[0]), run.steps * run.dt)
                    found.setdefault(b"l" + values[:1].tobytes(), line)
                else:
                    found.setdefault(b"l" + values.tobytes(), ("limits", LIMIT, values, run.dt))
    return list(found.values())


def _view(entity: str, title: str, curves: Sequence[np.ndarray | None], first: bool, length: float) -> Any:
    import rerun.blueprint as rrb

    values = np.concatenate([c[np.isfinite(c)] for c in curves if c is not None])
    return rrb.TimeSeriesView(
        origin=entity,
        name=drawable(title),
        axis_x=shared_time(length),
        axis_y=readable(values.tolist(), 8.0),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=first),
    )


def _table(runs: Sequence[Run], names: Sequence[str]) -> str:
    """Return the metrics of all runs, a column each."""
    columns: list[dict[str, str]] = []
    for run in runs:
        try:
            columns.append(table_figures(metrics(run), run, run.reference.shape[1]))
        except (KoopmpcError, ValueError) as error:
            columns.append({"cost": f"cannot be computed: {error}"})
    rows = _in_order([list(column) for column in columns])
    return format_markdown_table(("metric", *names), [(row, *(c.get(row, "") for c in columns)) for row in rows])
