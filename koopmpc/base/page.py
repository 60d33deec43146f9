"""Page: a report written part by part, as Markdown with its pictures beside it, or as one HTML file."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import numpy as np
from numpy.typing import ArrayLike

from koopmpc.base import disk
from koopmpc.base.text import format_markdown_table


@dataclass(frozen=True)
class Curves:
    """One tab: curves over the same times, a plot a column, a line a name."""

    title: str  # of the tab; each title occurs once
    dt: float  # sample time [s]
    columns: Sequence[str]  # names with units: one plot each
    values: Mapping[str, ArrayLike]  # by name, (T, columns) each; values that are not finite are left out


class PagePart(NamedTuple):
    """One part of a page as Markdown and as HTML, in which all texts are escaped; "" where it is of the other alone."""

    markdown: str = ""
    html: str = ""


@dataclass
class Page:
    """Headings, paragraphs, tables, code and pictures in the order in which they are added.

    The Markdown has a blank line between two parts. Its pictures have relative paths, so the report may be copied to
    any place together with them. The HTML is one file for readers without koopmpc: its pictures are inside it.
    """

    folder: Path  # where the report lies
    beside: str = ""  # name of the folder inside `folder` that holds the pictures; "" puts them beside the report
    title: str = ""  # of the HTML, its first heading
    parts: list[PagePart] = field(default_factory=list[PagePart])
    curves: list[Curves] = field(default_factory=list[Curves])  # a recording shows them beside the same text
    _pictures: int = 0

    def heading(self, text: str, level: int = 2) -> None:
        """Add a heading."""
        self.parts.append(PagePart(f"{'#' * level} {text}", f"<h{level}>{escape(text)}</h{level}>"))

    def text(self, *paragraphs: str) -> None:
        """Add paragraphs, in Markdown headings too; line breaks inside one become blanks."""
        for paragraph in paragraphs:
            plain = " ".join(paragraph.split())
            self.parts.append(PagePart(plain, f"<p>{escape(plain)}</p>"))

    def items(self, lines: Iterable[str]) -> None:
        """Add a list with one item for each line; line breaks inside one become blanks."""
        plain = [" ".join(line.split()) for line in lines]
        html = "".join(f"<li>{escape(line)}</li>" for line in plain)
        self.parts.append(PagePart("\n".join(f"- {line}" for line in plain), f"<ul>{html}</ul>"))

    def code(self, text: str, language: str = "text") -> None:
        """Add a block that is shown as it stands."""
        self.parts.append(PagePart(f"```{language}\n{text}\n```", f"<pre>{escape(text)}</pre>"))

    def table(self, headings: Sequence[str], rows: Iterable[Sequence[object]], *, words: bool = False) -> None:
        """Add a table; in HTML its first column is set as words, and with `words` the second one too."""
        rows = list(rows)
        head = "".join(f"<th>{escape(cell)}</th>" for cell in headings)
        lines = ["".join(f"<td>{escape(str(cell))}</td>" for cell in row) for row in rows]
        body, looks = "".join(f"<tr>{line}</tr>" for line in lines), ' class="words"' if words else ""
        html = f'<div class="wide"><table{looks}><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
        self.parts.append(PagePart(format_markdown_table(headings, rows), html))

    def picture(self, name: str, caption: str, save: Callable[[Path], None]) -> None:
        """Have `save` write the picture <name>.png, and add it with its caption to the Markdown.

        Raises
        ------
        LogError
            The picture cannot be written; then the page stays as it was.
        """
        path = Path(self.beside, f"{name}.png")
        save(self.folder / path)
        self.parts.append(PagePart(f"![{caption}]({path.as_posix()})\n\n*{caption}*"))

    def pictures(self, pictures: Iterable[tuple[str, str]]) -> None:
        """Add pictures to the HTML, side by side where there is room: pairs of an <svg> element and its caption."""
        figures: list[str] = []
        for svg, caption in pictures:
            self._pictures += 1
            for before in ('id="', 'href="#', "url(#"):  # else references would end in the first picture of the page
                svg = svg.replace(before, f"{before}p{self._pictures}-")
            named = svg.replace("<svg ", f'<svg role="img" aria-label="{escape(caption)}" ', 1)
            figures.append(f"<figure>{named}<figcaption>{escape(caption)}</figcaption></figure>")
        self.parts.append(PagePart(html=f'<div class="grid">{"".join(figures)}</div>'))

    def verdict(self, kind: str, *lines: str) -> None:
        """Add a box with a bold first line to the HTML; `kind` is "good", "bad" or "doubt" and colours its edge."""
        first, *rest = (escape(line) for line in lines)
        paragraphs = "".join(f"<p>{line}</p>" for line in rest)
        self.parts.append(PagePart(html=f'<div class="said {escape(kind)}"><p><b>{first}</b></p>{paragraphs}</div>'))

    def links(self, title: str, files: Sequence[str]) -> None:
        """Add links to files beside the page, in HTML folded up under their title."""
        plain = ", ".join(f"[{file}]({file})" for file in files)
        lines = ", ".join(f'<a href="{quote(file)}">{escape(file)}</a>' for file in files)
        html = f"<details><summary>{len(files)} {escape(title)}</summary><p>{lines}</p></details>"
        self.parts.append(PagePart(f"{title.capitalize()}: {plain}", html))

    def curve(self, title: str, dt: float, columns: Sequence[str], values: Mapping[str, np.ndarray]) -> None:
        """Add curves to the recording: one tab, a plot for each column, a line for each name in `values`."""
        self.curves.append(Curves(title, dt, tuple(columns), dict(values)))

    @property
    def markdown(self) -> str:
        """The whole report as Markdown."""
        return "\n\n".join(part.markdown for part in self.parts if part.markdown) + "\n"

    @property
    def words(self) -> str:
        """The report without its pictures, for a recording."""
        texts = [part.markdown for part in self.parts if not part.markdown.startswith("![")]
        return "\n\n".join(filter(None, texts)) + "\n"

    @property
    def html(self) -> str:
        """The whole report as an HTML document that needs no other file, no network and no script."""
        head = (
            f'<meta charset="utf-8"><meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
            f'<meta name="viewport" content="width=device-width,initial-scale=1"><title>{escape(self.title)}</title>'
        )
        style = Path(__file__).with_name("page.css").read_text("utf-8")
        body = f"<h1>{escape(self.title)}</h1>{''.join(part.html for part in self.parts)}"
        return f'<!doctype html><html lang="en"><head>{head}<style>{style}</style></head><body>{body}</body></html>\n'

    def write(self, name: str = "report.md") -> Path:
        """Write the report into `folder`, as HTML where the name ends in .html, and return its path.

        Raises
        ------
        LogError
            The file cannot be written.
        """
        path = self.folder / name
        with disk.writing(path) as stream:
            stream.write((self.html if path.suffix == ".html" else self.markdown).encode())
        return path


_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"  # a browser loads nothing from elsewhere
