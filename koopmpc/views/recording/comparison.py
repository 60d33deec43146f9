# pyright: basic
"""record_comparison: several runs in one set of plots: states, inputs, cost so far, and a table of their metrics."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.base.errors import KoopmpcError, LogError
from koopmpc.base.text import format_markdown_table
from koopmpc.loop.metrics import metrics, running_cost
from koopmpc.loop.run import Run
from koopmpc.views.recording.blueprint import find_limits, limit_rows
from koopmpc.views.recording.description import table_figures, title_of
from koopmpc.views.recording.plots import INK, Plot, Series, color, readable, record_plots, shared_time
from koopmpc.views.recording.reader import load_run


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
    drawn, plots = _describe_plots(runs, names, states, inputs)
    time = shared_time(max(run.steps * run.dt for run in runs))
    ends = [[c[np.isfinite(c)] for c in curves if c is not None] for *_, curves in drawn]
    axes = [readable(np.concatenate(values).tolist(), 8.0) for values in ends]
    layout = rrb.Horizontal(
        rrb.Vertical(*(plot.view(axis_x=time, axis_y=axis) for plot, axis in zip(plots, axes, strict=True))),
        rrb.TextDocumentView(origin="metrics", name="Metrics"),
        column_shares=[1.5, 1.0],  # the table names figures and holds a column a run,
    )
    metrics = f"{heading}{_table(runs, names)}"
    record_plots(path, "koopmpc-comparison", " against ".join(names), plots, layout, metrics=metrics)


Drawn = list[tuple[str, str, list[np.ndarray | None]]]  # entity, title, values of each run


def _describe_plots(
    runs: Sequence[Run], names: Sequence[str], states: Sequence[str], inputs: Sequence[str]
) -> tuple[Drawn, list[Plot]]:
    """Return what is drawn in each plot: states, inputs, the cost so far; each with its references and limits."""
    drawn: Drawn = [(f"state/{i}", name, _curves(runs, name, "states", "X")) for i, name in enumerate(states)]
    drawn += [(f"input/{j}", name, _curves(runs, name, "inputs", "U")) for j, name in enumerate(inputs)]
    drawn = drawn[:8]  # plots of states and inputs in one column
    costs = [_cost(run) for run in runs]
    drawn += [("cost", "Cost so far", costs)] if any(values is not None for values in costs) else []
    plots: list[Plot] = []
    for entity, title, curves in drawn:
        series = [
            Series(f"{entity}/{r + 1}", [(names[r], color(r), 2.0, values)], run.dt, held=entity.startswith("input"))
            for r, (run, values) in enumerate(zip(runs, curves, strict=True))
            if values is not None
        ]
        series += [
            Series(f"{entity}/mark/{r}", [(name, shade, 1.0, values)], dt)
            for r, (name, shade, values, dt) in enumerate(_marks(runs, title))
        ]
        plots.append(Plot(entity, title, series, legend=not plots))
    return drawn, plots


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
            found.setdefault(key, ("reference", INK.reference, values, run.dt))
        for kind in ("states", "inputs"):
            limits = [limit for limit in find_limits(run, kind) if limit.name == title]
            lines = limit_rows(run, kind, limits, np.arange(run.steps + (kind == "states")))
            for values in lines.T:
                if np.ptp(values) == 0:
                    line = ("limits", INK.limit, np.full(2, values[0]), run.steps * run.dt)
                    found.setdefault(b"l" + values[:1].tobytes(), line)
                else:
                    found.setdefault(b"l" + values.tobytes(), ("limits", INK.limit, values, run.dt))
    return list(found.values())


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
