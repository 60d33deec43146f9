"""Page: a report in Markdown, written part by part, with its pictures and its curves."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from koopmpc import disk
from koopmpc.text import format_markdown_table


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
        self.parts.append(format_markdown_table(headings, rows))

    def picture(self, name: str, caption: str, save: Callable[[Path], None]) -> None:
        """Have `save` write the picture <name>.png, and add it with its caption.

        Raises
        ------
        LogError
            The picture cannot be written; then the page stays as it was.
        """
        path = Path(self.beside, f"{name}.png")
        save(self.folder / path)
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
