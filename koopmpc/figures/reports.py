# pyright: basic
"""The figures of reports: any curves in panels, and what a sweep shows of controllers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError, ShapeError
from koopmpc.figures.style import REFERENCE, figure, legend, line, styled
from koopmpc.loop.run import Run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HEIGHT = 2.1  # of a row of panels [in]
_WORST = 10.0  # ratio at which a performance profile ends
_PANELS = 3  # regions of attraction in a row


@dataclass(frozen=True)
class Plot:
    """One panel.

    Attributes
    ----------
    x, y
        What the axes show, with units.
    curves
        Pairs of x and y by name, (T,) each; what is not finite is left out.
    title
        Above the panel.
    log
        The axes that are logarithmic: "x", "y" or "xy".
    points
        Draw points and no lines.
    ylim
        Lowest and highest y shown; by default all.
    at
        Values of y to mark by a line.
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
def plots(given: Sequence[Plot], columns: int = 2) -> "Figure":
    """Draw panels row by row, so many in a row; a name has the same line in all of them.

    Raises
    ------
    DataError
        There is no panel.
    ShapeError
        A curve does not have one y for each x.
    """
    if not given:
        raise DataError("there is no panel to draw; pass at least one")
    columns = min(columns, len(given))
    rows = -(-len(given) // columns)
    made, grid = figure(
        rows, columns, width="two columns" if columns > 1 else "one column", height=0.5 + _HEIGHT * rows
    )
    names = list(dict.fromkeys(name for panel in given for name in panel.curves))
    for axes, panel in zip(grid.flat, given, strict=False):
        _draw(axes, panel, names)
    for axes in grid.flat[len(given) :]:
        axes.set_visible(False)
    legend(made, grid.flat[: len(given)], 4 if columns > 1 else 3)
    return made


def _draw(axes: Any, panel: Plot, names: list[str]) -> None:
    for value in panel.at:
        axes.axhline(value, **REFERENCE)
    for name, (x, y) in panel.curves.items():
        x = checks.array(x, f"x of {name!r}", (None,), finite=False)
        y = checks.array(y, f"y of {name!r}", (None,), finite=False)
        if len(x) != len(y):
            raise ShapeError(f"{name!r} has {len(x)} x and {len(y)} y; pass one y for each x")
        look = line(names.index(name), len(x))
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
def profiles(ratios: Mapping[str, np.ndarray]) -> "Figure":
    """Draw the share of runs whose cost is at most τ times the best one's, inf where a run did not reach."""
    made, axes = figure(1, width="two columns", height=2.8)
    panel = axes[0, 0]
    grid = np.geomspace(1.0, _WORST, 400)
    for i, (name, found) in enumerate(ratios.items()):
        share = np.searchsorted(np.sort(found), grid, side="right") / max(len(found), 1)
        panel.plot(grid, share, label=name, **line(i, len(grid)))
    panel.set(xscale="log", xlim=(1.0, _WORST), ylim=(-0.02, 1.02))
    panel.set(xlabel="τ: cost over the best controller's of the same start", ylabel="share of runs within τ")
    panel.set_xticks([1, 1.5, 2, 3, 5, 10], ["1", "1.5", "2", "3", "5", "10"], minor=False)
    panel.minorticks_off()
    legend(made, [panel], 4)
    return made


@styled
def times(hot: Mapping[str, np.ndarray], cold: Mapping[str, np.ndarray]) -> "Figure":
    """Draw the medians of the steps of all runs: the middle half, 5 to 95 %, and × where caches are cold."""
    made, axes = figure(1, width="two columns", height=0.6 + 0.28 * len(hot))
    panel = axes[0, 0]
    for i, (name, found) in enumerate(hot.items()):
        good = found[np.isfinite(found) & (found > 0)] * 1e6
        if len(good):
            low, first, middle, third, high = np.quantile(good, [0.05, 0.25, 0.5, 0.75, 0.95])
            panel.plot([low, high], [i, i], color="#000000", linewidth=0.8)
            panel.plot([first, third], [i, i], color="#000000", linewidth=4.0, solid_capstyle="butt", alpha=0.55)
            panel.plot([middle], [i], "o", color="#000000", label="median of a run, hot" if i == 0 else None)
        chilled = cold.get(name, np.empty(0))
        chilled = chilled[np.isfinite(chilled)] * 1e6
        label = "median after 4 ms of sleep, cold" if i == 0 else None
        panel.plot(chilled, np.full(len(chilled), i), "x", color="#8c1d18", label=label)
    panel.set(xscale="log", xlabel="time of a step [µs]", ylim=(len(hot) - 0.5, -0.5))
    panel.set_yticks(range(len(hot)), list(hot))
    legend(made, [panel], 2)
    return made


@styled
def attraction(found: Mapping[str, tuple[np.ndarray, np.ndarray]], names: Sequence[str]) -> "Figure":
    """Draw which initial states reach their reference: filled circles do, crosses do not; a panel a controller."""
    rows = -(-len(found) // _PANELS)
    made, axes = figure(rows, _PANELS, width="two columns", height=2.1 * rows + 0.3, sharex=True, sharey=True)
    for panel, (name, (starts, reached)) in zip(axes.ravel(), found.items(), strict=False):
        size = 14.0 if len(starts) < 200 else 4.0
        panel.scatter(*starts[reached].T, s=size, marker="o", color="#0072b2", linewidths=0.0, label="reaches")
        panel.scatter(*starts[~reached].T, s=size, marker="x", color="#8c1d18", linewidths=0.8, label="does not reach")
        panel.set_title(f"{name}: {100 * reached.mean():.0f} %")
    for panel in axes.ravel()[len(found) :]:
        panel.set_visible(False)
    for panel in axes[-1]:
        panel.set_xlabel(names[0])
    for panel in axes[:, 0]:
        panel.set_ylabel(names[1])
    legend(made, [axes[0, 0]], 2)
    return made


@styled
def trajectories(runs: Mapping[str, Run]) -> "Figure":
    """Draw the states and inputs of runs of one case over time, a panel each."""
    first = next(iter(runs.values()))
    states = list(range(min(len(first.states), 4)))
    rows = len(states) + 1
    made, axes = figure(rows, width="two columns", height=1.15 * rows + 0.5, sharex=True)
    for i, (name, run) in enumerate(runs.items()):
        for panel, j in zip(axes[:, 0], states, strict=False):
            panel.plot(run.time, run.X[:, j], label=name, **line(i))
        axes[-1, 0].step(run.time[:-1], run.U[:, 0], where="post", **line(i))
    for panel, j in zip(axes[:, 0], states, strict=False):
        panel.set_ylabel(first.states[j])
        if first.cost is None or first.reference.shape[1] == len(first.states):
            panel.plot(first.time, first.reference[:, j], label="reference", **REFERENCE)
    axes[-1, 0].set(ylabel=first.inputs[0], xlabel="time [s]")
    legend(made, axes[:, 0], 4)
    return made
