# pyright: basic
"""Plots of curves over time: what stands at each entity, how it is drawn, and the views and frame around it."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.page import Curves
from koopmpc.base.scene import Color
from koopmpc.views.recording.description import drawable
from koopmpc.views.recording.rrd import RerunLog

PALETTE: tuple[Color, ...] = (
    (88, 166, 255), (255, 166, 87), (86, 211, 160), (240, 120, 170),
    (188, 150, 255), (235, 203, 100), (110, 205, 220), (190, 190, 190),
)  # fmt: skip


@dataclass(frozen=True)
class Ink:
    """Colours of the viewer that mean the same in every log.

    Attributes
    ----------
    limit, reference, prediction, measured
        Curves of a run beside its states and inputs; of the prediction, the words around pictures too.
    truth, band
        Curves of a forecast.
    background, aim
        Of an animation, and the reference in it.
    """

    limit: Color = (232, 84, 84)
    reference: Color = (165, 170, 180)
    prediction: Color = (250, 250, 250)
    measured: Color = (120, 126, 138)
    truth: Color = (225, 228, 232)
    band: Color = (70, 125, 185)
    background: Color = (247, 248, 250)
    aim: Color = (188, 193, 201)


INK = Ink()


def color(i: int) -> Color:
    """Return the colour of the i-th state or input."""
    return PALETTE[i % len(PALETTE)]


Curve = tuple[str, Color, float, np.ndarray]  # name, colour, width [points], one value a step


class Series(NamedTuple):
    """Curves of one entity over the steps first, first + 1, …, `held` from step to step or not.

    One curve alone is written without what is not finite.
    """

    entity: str
    curves: Sequence[Curve]
    dt: float
    first: int = 0
    held: bool = False

    def write(self, log: RerunLog) -> None:
        """Write the look of the curves, and their values."""
        import rerun as rr

        names, colors, widths, columns = (list(part) for part in zip(*self.curves, strict=True))
        values = np.column_stack(columns)
        k = np.flatnonzero(np.isfinite(values[:, 0]) | (len(names) > 1))
        if len(k):  # the viewer crashes on a timeline without rows
            look: dict[str, Any] = {"interpolation_mode": "StepAfter"} if self.held else {}
            drawn = [drawable(name) for name in names]
            log.style(self.entity, rr.SeriesLines(names=drawn, colors=colors, widths=widths, **look))
            scalars = rr.Scalars.columns(scalars=values[k].ravel()).partition([len(names)] * len(k))
            log.rows(self.entity, self.first + k, self.dt, scalars)


@dataclass(frozen=True)
class Plot:
    """One plot: the entity below which its series stand, its title, and whether it names the curves."""

    entity: str
    title: str
    series: Sequence[Series]
    legend: bool = True

    def view(self, corner: str = "RightTop", **axes: Any) -> Any:
        """Return the view of the plot, with its legend in this corner."""
        import rerun.blueprint as rrb

        legend = rrb.PlotLegend(corner=rrb.Corner2D.auto(corner), visible=self.legend)
        return rrb.TimeSeriesView(origin=self.entity, name=drawable(self.title), plot_legend=legend, **axes)


@raise_swallowed()  # Python drops a Ctrl-C that comes while a recording is deleted
def record_plots(
    path: str | Path, application: str, name: str, plots: Sequence[Plot], layout: Any, **pages: str
) -> None:
    """Write plots and pages of Markdown by their entities to one .rrd, laid out so."""
    with RerunLog(application, path=path) as log:
        log.lay_out(frame_views(layout))
        if name:
            log.rec.send_recording_name(drawable(name))
        for plot in plots:
            for series in plot.series:
                series.write(log)
        for entity, text in pages.items():
            log.page(entity, text)


def record_curves(tabs: Sequence[Curves], path: str | Path, *, application: str, page: str) -> None:
    """Write all tabs and the page, as Markdown, to one .rrd.

    Parameters
    ----------
    tabs
        At least one.
    path
        The .rrd.
    application
        Rerun keeps the layouts that people make by it.
    page
        Markdown, beside the plots.

    Raises
    ------
    DataError
        There is no tab, or two have one title.
    ShapeError
        Values do not have a column for each name.
    LogError
        The path cannot be written.
    """
    import rerun.blueprint as rrb

    if not tabs:
        raise DataError("there is no curve to record; pass at least one tab")
    slugs = [_slug(tab.title) for tab in tabs]
    twice = next((slug for slug in slugs if slugs.count(slug) > 1), None)
    if twice is not None:
        raise DataError(f"two tabs are called {twice!r}; name each by a title of its own")
    plots: list[Plot] = []
    views: list[Any] = []
    for tab, slug in zip(tabs, slugs, strict=True):
        dt, width = checks.positive(tab.dt, "dt", "s"), (None, len(tab.columns))
        tables = {name: checks.array(X, name, width, finite=False) for name, X in tab.values.items()}
        shown: list[Plot] = []
        for j, column in enumerate(tab.columns):
            entity = f"{slug}/{_slug(column)}"
            series = [  # drawn in this order: the truth below
                Series(f"{entity}/{i}_{_slug(name)}", [(name, color(i), 2.0, X[:, j])], dt)
                for i, (name, X) in enumerate(tables.items())
            ]
            shown.append(Plot(entity, column, series, legend=j == 0))
        plots += shown
        views.append(rrb.Vertical(*(plot.view() for plot in shown), name=drawable(tab.title)))
    report = rrb.TextDocumentView(origin="page", name="Report")
    layout = rrb.Horizontal(rrb.Tabs(*views), report, column_shares=[3.0, 2.0])
    record_plots(path, application, "", plots, layout, page=page)


def _slug(name: str) -> str:
    """Return the name as part of an entity's path."""
    return re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or "curve"


def frame_views(views: Any) -> Any:
    """Return the layout of a log: `views` over the timeline sim_time, all other panels out of the way."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        views,
        rrb.TimePanel(timeline="sim_time", state="collapsed", play_state="paused"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )


def shared_time(length: float | None) -> Any:
    """Return a time axis that is moved with those of all other plots; for a long run the whole of it, not moved along.

    Of axes that move together, and of a running loop, the viewer shows a minute about the cursor.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    # length of a run whose plots are moved together [s]
    if length is None or length <= 50.0:
        return rrb.TimeAxis(link="LinkToGlobal")
    begin, end = (rrb.TimeRangeBoundary.absolute(seconds=t) for t in (0.0, length))
    return rrb.TimeAxis(view_range=rr.TimeRange(start=begin, end=end))


def readable(values: Sequence[float], ticks: float) -> Any:
    """Return an axis a little wider than `values` that holds two ticks with numbers; None where they span nothing.

    The viewer numbers multiples of 1, 10, 100, … and leaves them out where more than `ticks` would stand close.
    """
    import rerun.blueprint as rrb

    low, high = min(values, default=0.0), max(values, default=0.0)
    # a span that no axis shows
    if not 1e-9 * max(abs(low), abs(high), 1e-9) < high - low < 1e100:
        return None
    tick = 10.0 ** math.floor(math.log10(high - low))
    if high - low > ticks * tick:
        below, above = 10 * tick * math.floor(low / (10 * tick)), 10 * tick * math.ceil(high / (10 * tick))
        if above - below < 15 * tick:
            low, high = below, above
        elif low - below < above - high:
            low = below
        else:
            high = above
    elif math.floor(high / tick) - math.ceil(low / tick) < 1:  # one tick: the nearer of its neighbours comes in
        below, above = tick * math.floor(low / tick), tick * math.ceil(high / tick)
        low, high = (below, high) if low - below < above - high else (low, above)
    margin = 0.08 * (high - low)
    return rrb.ScalarAxis(range=[low - margin, high + margin])
