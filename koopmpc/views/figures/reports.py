# pyright: basic
"""Figures of reports: panels of curves, and comparisons of controllers in a sweep."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.loop.run import Run
from koopmpc.views.figures.series import draw_limits
from koopmpc.views.figures.style import REFERENCE, draw_legend, fit_label, label_time, line_style, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class CurvePanel:
    """One panel of curves.

    Attributes
    ----------
    x, y
        Labels of the axes, with units.
    curves
        Pairs of x and y by name, (T,) each; entries that are not finite are left out.
    title
        Title above the panel.
    log
        The logarithmic axes: "x", "y" or "xy".
    points
        Draw points instead of lines.
    ylim
        Lowest and highest y; by default the range of the curves.
    at
        Values of y that are marked by a line.
    """

    x: str
    y: str
    curves: Mapping[str, tuple[ArrayLike, ArrayLike]]
    title: str = ""
    log: Literal["", "x", "y", "xy"] = ""
    points: bool = False
    ylim: tuple[float, float] | None = None
    at: Sequence[float] = ()


@styled
def draw_panels(panels: Sequence[CurvePanel], columns: int = 2) -> "Figure":
    """Draw panels row by row, `columns` in a row; curves of one name have the same style in all panels.

    Raises
    ------
    DataError
        There is no panel.
    ShapeError
        A curve does not have one y for each x.
    """
    if not panels:
        raise DataError("there is no panel to draw; pass at least one")
    columns = min(columns, len(panels))
    rows = -(-len(panels) // columns)
    # height of a row of panels [in]
    drawing, grid = make_figure(
        rows, columns, width="two columns" if columns > 1 else "one column", height=0.5 + 2.1 * rows
    )
    names = list(dict.fromkeys(name for panel in panels for name in panel.curves))
    for axes, panel in zip(grid.flat, panels, strict=False):
        _draw_panel(axes, panel, names)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    draw_legend(drawing, grid.flat[: len(panels)], 4 if columns > 1 else 3)
    return drawing


def _draw_panel(axes: Any, panel: CurvePanel, names: list[str]) -> None:
    for value in panel.at:
        axes.axhline(value, **REFERENCE)
    for name, (x, y) in panel.curves.items():
        x = checks.array(x, f"x of {name!r}", (None,), finite=False)
        y = checks.array(y, f"y of {name!r}", (None,), finite=False)
        if len(x) != len(y):
            raise ShapeError(f"{name!r} has {len(x)} x and {len(y)} y; pass one y for each x")
        look = line_style(names.index(name), len(x))
        if panel.points:
            look |= {"linestyle": "none", "markevery": 1}
        axes.plot(x, y, **look, label=name)
    axes.set(xlabel=panel.x, ylabel=panel.y, title=panel.title)
    if "x" in panel.log:
        axes.set_xscale("log")
    if "y" in panel.log:
        axes.set_yscale("log")
    if panel.ylim is not None:
        axes.set_ylim(*panel.ylim)


@styled
def draw_profiles(ratios: Mapping[str, np.ndarray]) -> "Figure":
    """Draw the share of runs whose cost is at most τ times the best cost; a run that fails has the ratio inf."""
    drawing, axes = make_figure(1, width="two columns", height=2.8)
    panel = axes[0, 0]
    most = 10.0  # ratio of costs
    grid = np.geomspace(1.0, most, 400)
    for i, (name, values) in enumerate(ratios.items()):
        share = np.searchsorted(np.sort(values), grid, side="right") / max(len(values), 1)
        panel.plot(grid, share, label=name, **line_style(i, len(grid)))
    panel.set(xscale="log", xlim=(1.0, most), ylim=(-0.02, 1.02))
    panel.set(xlabel="τ: cost over the best controller's of the same start", ylabel="share of runs within τ")
    panel.set_xticks([1, 1.5, 2, 3, 5, 10], ["1", "1.5", "2", "3", "5", "10"], minor=False)
    panel.minorticks_off()
    draw_legend(drawing, [panel], 4)
    return drawing


@styled
def draw_step_times(hot: Mapping[str, np.ndarray], cold: Mapping[str, np.ndarray]) -> "Figure":
    """Draw quantiles over runs of the median step time: bars for 25 to 75 % and 5 to 95 %, crosses for cold caches."""
    drawing, axes = make_figure(1, width="two columns", height=0.6 + 0.28 * len(hot))
    panel = axes[0, 0]
    for i, (name, seconds) in enumerate(hot.items()):
        good = seconds[np.isfinite(seconds) & (seconds > 0)] * 1e6
        if len(good):
            low, first, middle, third, high = np.quantile(good, [0.05, 0.25, 0.5, 0.75, 0.95])
            panel.plot([low, high], [i, i], color="#000000", linewidth=0.8)
            panel.plot([first, third], [i, i], color="#000000", linewidth=4.0, solid_capstyle="butt", alpha=0.55)
            panel.plot([middle], [i], "o", color="#000000", label="median of a run, hot" if i == 0 else None)
        cold_times = cold.get(name, np.empty(0))
        cold_times = cold_times[np.isfinite(cold_times)] * 1e6
        label = "median after 4 ms of sleep, cold" if i == 0 else None
        panel.plot(cold_times, np.full(len(cold_times), i), "x", color="#8c1d18", label=label)
    panel.set(xscale="log", xlabel="time of a step [µs]", ylim=(len(hot) - 0.5, -0.5))
    panel.set_yticks(range(len(hot)), list(hot))
    draw_legend(drawing, [panel], 2)
    return drawing


@styled
def draw_attraction(starts_by_name: Mapping[str, tuple[np.ndarray, np.ndarray]], names: Sequence[str]) -> "Figure":
    """Draw initial states in a panel for each controller: circles reach their reference, crosses do not."""
    columns = 3
    rows = -(-len(starts_by_name) // columns)
    drawing, axes = make_figure(rows, columns, width="two columns", height=2.1 * rows + 0.3, sharex=True, sharey=True)
    for panel, (name, (starts, reached)) in zip(axes.ravel(), starts_by_name.items(), strict=False):
        size = 14.0 if len(starts) < 200 else 4.0
        panel.scatter(*starts[reached].T, s=size, marker="o", color="#0072b2", linewidths=0.0, label="reaches")
        panel.scatter(*starts[~reached].T, s=size, marker="x", color="#8c1d18", linewidths=0.8, label="does not reach")
        panel.set_title(f"{name}: {100 * reached.mean():.0f} %")
    for panel in axes.ravel()[len(starts_by_name) :]:
        panel.set_visible(False)
    for panel in axes[-1]:
        panel.set_xlabel(names[0])
    for panel in axes[:, 0]:
        panel.set_ylabel(names[1])
    draw_legend(drawing, [axes[0, 0]], 2)
    return drawing


def _add_near_limits(axes: Any, run: Run, kind: str, i: int) -> None:
    """Draw the limits of a state or an input; those farther away than the curves reach do not widen the axis."""
    low, high = axes.get_ylim()
    near = [value for value in draw_limits(axes, run, kind, i) if 2 * low - high <= value <= 2 * high - low]
    margin = 0.05 * (high - low)
    axes.set_ylim(min([low, *(value - margin for value in near)]), max([high, *(value + margin for value in near)]))


@styled
def draw_trajectories(runs: Mapping[str, Run]) -> "Figure":
    """Draw the first four states and the first input of runs of one case over time, a panel each, with their limits."""
    first = next(iter(runs.values()))
    states = list(range(min(len(first.states), 4)))
    rows = len(states) + 1
    drawing, axes = make_figure(rows, width="two columns", height=1.15 * rows + 0.5, sharex=True)
    for i, (name, run) in enumerate(runs.items()):
        for panel, j in zip(axes[:, 0], states, strict=False):
            panel.plot(run.time, run.X[:, j], label=name, **line_style(i))
        axes[-1, 0].step(run.time[:-1], run.U[:, 0], where="post", **line_style(i))
    for panel, j in zip(axes[:, 0], states, strict=False):
        panel.set_ylabel(**fit_label(first.states[j], 1.0))
        if first.reference.shape[1] == len(first.states):
            panel.plot(first.time, first.reference[:, j], label="reference", **REFERENCE)
        _add_near_limits(panel, first, "states", j)
    _add_near_limits(axes[-1, 0], first, "inputs", 0)
    axes[-1, 0].set_xlabel(label_time(first.metadata))
    axes[-1, 0].set_ylabel(**fit_label(first.inputs[0], 1.0))
    draw_legend(drawing, axes[:, 0], 4)
    return drawing
