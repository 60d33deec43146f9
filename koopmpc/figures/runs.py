# pyright: basic
"""plot_runs: several closed loops over each other, states and inputs, a column a task."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from koopmpc.errors import DataError
from koopmpc.figures.style import LIMIT, REFERENCE, figure, line, styled
from koopmpc.loop.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PANEL = 0.95  # height [in]
_BEYOND = 0.5  # spans of what most runs do that one may leave and stay in the picture


@styled
def plot_runs(tasks: Mapping[str, Mapping[str, Run]]) -> "Figure":
    """Draw each state and input over time, a curve a run, with reference and input limits.

    Parameters
    ----------
    tasks
        A column each: its title, and its runs by the name of the controller. All of one plant.

    Raises
    ------
    DataError
        There is no run, or the runs are of different plants.
    """
    runs = [run for each in tasks.values() for run in each.values()]
    if not runs or not all(tasks.values()):
        raise DataError("there is no run to draw; pass at least one a column")
    states, inputs = runs[0].states, runs[0].inputs
    if any((run.states, run.inputs) != (states, inputs) for run in runs):
        raise DataError("the runs have different states or inputs; draw one plant a figure")
    rows = len(states) + len(inputs)
    wide = "two columns" if len(tasks) > 1 else "one column"
    made, grid = figure(rows, len(tasks), width=wide, height=0.85 + _PANEL * rows, sharex="col")
    names = list(dict.fromkeys(name for each in tasks.values() for name in each))
    for column, (title, each) in zip(grid.T, tasks.items(), strict=True):
        _column(column, each, names)
        column[0].set_title(title)
        column[-1].set_xlabel("time [s]")
    for panel, name in zip(grid[:, 0], (*states, *inputs), strict=True):
        panel.set_ylabel(name)
    made.align_ylabels(list(grid[:, 0]))
    handles: dict[str, Any] = {}
    for panel in grid.ravel():
        found, labels = panel.get_legend_handles_labels()
        handles |= dict(zip(labels, found, strict=True))
    made.legend(list(handles.values()), list(handles), loc="outside upper center", ncols=min(len(handles), 4))
    return made


def _column(panels: Any, runs: Mapping[str, Run], names: list[str]) -> None:
    first = next(iter(runs.values()))
    nx = len(first.states)
    tracked = first.cost is None or first.cost.of.bind(first.states).names == first.states
    for i, panel in enumerate(panels):
        drawn = [run.X[:, i] if i < nx else run.U[:, i - nx] for run in runs.values()]
        for name, run, values in zip(runs, runs.values(), drawn, strict=True):
            panel.plot(run.time[: len(values)], values, **line(names.index(name), len(values)), label=name)
        extra = np.empty(0)
        if i < nx and tracked:
            panel.plot(first.time, first.reference[:, i], **REFERENCE, label="reference")
            extra = first.reference[:, i]
        elif i >= nx and first.limits is not None:
            extra = np.array([v[i - nx] for v in first.limits.inputs(len(first.inputs)) if np.isfinite(v[i - nx])])
            for value in extra:
                panel.axhline(value, **LIMIT, label="limit")
        panel.set_ylim(*_room(drawn, extra))
        panel.set_xlim(0.0, first.time[-1])


def _room(drawn: list[np.ndarray], extra: np.ndarray) -> tuple[float, float]:
    """Return an axis that shows all that the median run does, and half as much beyond it."""
    lows, highs = [float(v.min()) for v in drawn], [float(v.max()) for v in drawn]
    low, high = float(np.median(lows)), float(np.median(highs))
    low, high = min([low, *extra.tolist()]), max([high, *extra.tolist()])
    span = (high - low) or 1.0
    bottom, top = (
        max(min([low, *lows]), low - _BEYOND * span),
        min(max([high, *highs]), high + _BEYOND * span),
    )
    return bottom - 0.06 * span, top + 0.06 * span
