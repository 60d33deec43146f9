# pyright: basic
"""Page: a report in Markdown, written part by part, its pictures beside it, and its curves in one .rrd."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from koopmpc import checks, disk
from koopmpc.errors import DataError
from koopmpc.figures.style import save
from koopmpc.interrupts import heard
from koopmpc.recording.blueprint import color, draw_line, framed, write_page
from koopmpc.recording.description import drawable
from koopmpc.recording.rrd import file_recording
from koopmpc.validate.text import markdown_table

if TYPE_CHECKING:
    from koopmpc.figures.style import Figure


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


@dataclass
class Page:
    """Headings, paragraphs, tables, code and pictures in the order in which they are added.

    Pictures have relative paths, so the report may be copied to any place together with them.

    Attributes
    ----------
    folder
        Where the report lies.
    beside
        Name of the folder inside `folder` that holds the pictures; "" puts them beside the report.
    parts
        Markdown of each part; the report has a blank line between two of them.
    curves
        Curves that a recording shows beside the same text.
    """

    folder: Path
    beside: str = ""
    parts: list[str] = field(default_factory=list[str])
    curves: list[Curves] = field(default_factory=list[Curves])

    def text(self, *paragraphs: str) -> None:
        """Add headings or paragraphs; line breaks inside one become blanks."""
        self.parts.extend(" ".join(paragraph.split()) for paragraph in paragraphs)

    def items(self, lines: Iterable[str]) -> None:
        """Add a list with one item for each line; line breaks inside one become blanks."""
        self.parts.append("\n".join(f"- {' '.join(line.split())}" for line in lines))

    def code(self, text: str, language: str = "text") -> None:
        """Add a block that is shown as it stands."""
        self.parts.append(f"```{language}\n{text}\n```")

    def table(self, headings: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
        """Add a table; a | inside a cell is escaped."""
        self.parts.append(markdown_table(headings, rows))

    def picture(self, name: str, caption: str, made: "Figure") -> None:
        """Save the figure as <name>.png and add it with its caption.

        Raises
        ------
        LogError
            The picture cannot be written; then the page stays as it was.
        """
        path = Path(self.beside, f"{name}.png")
        save(made, self.folder / path)
        self.parts.append(f"![{caption}]({path.as_posix()})\n\n*{caption}*")

    def curve(self, title: str, dt: float, columns: Sequence[str], values: Mapping[str, np.ndarray]) -> None:
        """Add curves to the recording: one tab, a plot for each column, a line for each name in `values`."""
        self.curves.append(Curves(title, dt, tuple(columns), dict(values)))

    @property
    def markdown(self) -> str:
        """The whole report as Markdown."""
        return "\n\n".join(self.parts) + "\n"

    @property
    def words(self) -> str:
        """The report without its pictures, for a recording."""
        return "\n\n".join(part for part in self.parts if not part.startswith("![")) + "\n"

    def write(self, name: str = "report.md") -> Path:
        """Write the report into `folder` and return its path.

        Raises
        ------
        LogError
            The file cannot be written.
        """
        path = self.folder / name
        with disk.writing(path) as stream:
            stream.write(self.markdown.encode())
        return path
