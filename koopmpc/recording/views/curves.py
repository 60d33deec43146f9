# pyright: basic
"""record_curves: trajectories and what models make of them, one tab a figure, and a page to read, in one .rrd."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError
from koopmpc.interrupts import heard
from koopmpc.recording.description import drawable
from koopmpc.recording.format.writer import file_recording, times
from koopmpc.recording.views.blueprint import color, framed


@dataclass(frozen=True)
class Curves:
    """One tab: curves over the same times, a plot a column, a line a name.

    Attributes
    ----------
    title
        Title of the tab; each title occurs once.
    dt
        Sample time [s].
    columns
        Names with units: one plot each.
    values
        By name, (T, columns) each; values that are not finite are left out.
    """

    title: str
    dt: float
    columns: Sequence[str]
    values: Mapping[str, ArrayLike]


@heard  # Python drops a Ctrl-C that comes while a recording is deleted
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
    import rerun as rr

    if not tabs:
        raise DataError("there is no curve to record; pass at least one tab")
    slugs = [_slug(tab.title) for tab in tabs]
    twice = next((slug for slug in slugs if slugs.count(slug) > 1), None)
    if twice is not None:
        raise DataError(f"two tabs are called {twice!r}; name each by a title of its own")
    tables = [_tables(tab) for tab in tabs]
    with file_recording(path, application, _blueprint(tabs, slugs)) as rec:
        rec.log("page", rr.TextDocument(drawable(page), media_type="text/markdown"), static=True)
        for tab, slug, curves in zip(tabs, slugs, tables, strict=True):
            for j, column in enumerate(tab.columns):
                for i, (name, X) in enumerate(curves.items()):
                    k = np.flatnonzero(np.isfinite(X[:, j]))
                    if not len(k):
                        continue  # the viewer crashes on a timeline without rows
                    entity = f"{slug}/{_slug(column)}/{i}_{_slug(name)}"  # drawn in this order: the truth below
                    rec.log(entity, rr.SeriesLines(names=drawable(name), colors=color(i), widths=2.0), static=True)
                    rec.send_columns(entity, times(k, tab.dt), rr.Scalars.columns(scalars=X[k, j]))


def _tables(tab: Curves) -> dict[str, np.ndarray]:
    checks.positive(tab.dt, "dt", "s")
    width = (None, len(tab.columns))
    return {name: checks.array(X, name, width, finite=False) for name, X in tab.values.items()}


def _blueprint(tabs: Sequence[Curves], slugs: Sequence[str]) -> Any:
    import rerun.blueprint as rrb

    def plots(tab: Curves, slug: str) -> Any:
        views = [
            rrb.TimeSeriesView(
                origin=f"{slug}/{_slug(column)}",
                name=drawable(column),
                plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=j == 0),
            )
            for j, column in enumerate(tab.columns)
        ]
        return rrb.Vertical(*views, name=drawable(tab.title))

    return framed(
        rrb.Horizontal(
            rrb.Tabs(*(plots(tab, slug) for tab, slug in zip(tabs, slugs, strict=True))),
            rrb.TextDocumentView(origin="page", name="Report"),
            column_shares=[3.0, 2.0],
        )
    )


def _slug(name: str) -> str:
    """Return the name as part of an entity's path."""
    return re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or "curve"
