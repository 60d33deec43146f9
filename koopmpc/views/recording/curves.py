# pyright: basic
"""record_curves: the curves of a report as one .rrd, a tab for each, with its text beside them."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.page import Curves
from koopmpc.views.recording.blueprint import color, draw_line, frame_views, write_page
from koopmpc.views.recording.description import drawable
from koopmpc.views.recording.rrd import file_recording


@raise_swallowed()  # Python drops a Ctrl-C that comes while a recording is deleted
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
    if not tabs:
        raise DataError("there is no curve to record; pass at least one tab")
    slugs = [_slug(tab.title) for tab in tabs]
    twice = next((slug for slug in slugs if slugs.count(slug) > 1), None)
    if twice is not None:
        raise DataError(f"two tabs are called {twice!r}; name each by a title of its own")
    tables = [_tables(tab) for tab in tabs]
    with file_recording(path, application, _blueprint(tabs, slugs)) as rec:
        write_page(rec, "page", page)
        for tab, slug, curves in zip(tabs, slugs, tables, strict=True):
            for j, column in enumerate(tab.columns):
                for i, (name, X) in enumerate(curves.items()):
                    entity = f"{slug}/{_slug(column)}/{i}_{_slug(name)}"  # drawn in this order: the truth below
                    draw_line(rec, entity, name, color(i), 2.0, X[:, j], tab.dt)


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

    return frame_views(
        rrb.Horizontal(
            rrb.Tabs(*(plots(tab, slug) for tab, slug in zip(tabs, slugs, strict=True))),
            rrb.TextDocumentView(origin="page", name="Report"),
            column_shares=[3.0, 2.0],
        )
    )


def _slug(name: str) -> str:
    """Return the name as part of an entity's path."""
    return re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or "curve"
