"""Page: a report in Markdown, written part by part, with its pictures and its curves; HtmlPage: one HTML file."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from urllib.parse import quote

import numpy as np
from numpy.typing import ArrayLike

from koopmpc.base import disk
from koopmpc.base.text import format_markdown_table


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


_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;color:#111;background:#fff;max-width:1100px;margin:0 auto;padding:1rem}
h1{font-size:1.5rem;overflow-wrap:anywhere}h2{font-size:1.2rem;margin-top:2.5rem;border-top:1px solid #bbb;
padding-top:1rem}h3{font-size:1rem;margin:1.5rem 0 .5rem}p,li{max-width:46rem;overflow-wrap:anywhere}
.wide{overflow-x:auto;margin:.8rem 0}table{border-collapse:collapse;font-size:.85rem;font-variant-numeric:tabular-nums}
th,td{padding:.25rem .6rem;text-align:right;white-space:nowrap;border-bottom:1px solid #ddd}
th:first-child,td:first-child{text-align:left}.words td:nth-child(2),.words th:nth-child(2){text-align:left;
white-space:normal;min-width:9rem}
th{border-bottom:2px solid #555}figure{margin:1.5rem 0;overflow-x:auto}
figure svg{width:100%;min-width:560px;height:auto}figcaption{font-size:.85rem;color:#333}
.grid{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(20rem,100%),1fr));gap:1rem 1.5rem;margin:1rem 0}
.grid figure{margin:0}.grid figure svg{min-width:0}pre{font:.8rem/1.4 ui-monospace,monospace;background:#f4f4f4;
padding:.7rem;overflow-x:auto}.said{border-left:.35rem solid #555;background:#f4f4f4;padding:.6rem 1rem;max-width:46rem}
.good{border-color:#009e73}.bad{border-color:#8c1d18}.doubt{border-color:#c28e00}.said p{margin:.2rem 0}
details{font-size:.85rem}a{color:#003a7d;overflow-wrap:anywhere}
@media print{body{max-width:none;padding:0;font-size:11px}figure,tr,.said{break-inside:avoid}
h2,h3{break-after:avoid}pre{white-space:pre-wrap;overflow-wrap:anywhere;font-size:.7rem}
.wide,figure{overflow:visible}th,td{white-space:normal;padding:.15rem .35rem;font-size:.7rem}
.grid{grid-template-columns:repeat(2,1fr)}figure svg{min-width:0}}
"""

_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:"  # a browser loads nothing from elsewhere


def _wrap_html(title: str, body: str) -> str:
    """Return a whole HTML document that needs no other file, no network and no script."""
    start = '<!doctype html><html lang="en"><head><meta charset="utf-8">'
    safe = f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
    view = f'<meta name="viewport" content="width=device-width,initial-scale=1"><title>{escape(title)}</title>'
    return f"{start}{safe}{view}<style>{_STYLE}</style></head><body>{body}</body></html>\n"


def _rename_ids(picture: str, mark: str) -> str:
    """Return an SVG whose ids begin with `mark`: references would end in the first picture of a page otherwise."""
    for before in ('id="', 'href="#', "url(#"):
        picture = picture.replace(before, before + mark)
    return picture


@dataclass
class HtmlPage:
    """One HTML file for readers without koopmpc: pictures are inside it, and every text is escaped.

    Attributes
    ----------
    title
        Title of the page, its first heading.
    parts
        HTML of each part.
    """

    title: str
    parts: list[str] = field(default_factory=list[str])
    _pictures: int = 0

    def heading(self, text: str, level: int = 2) -> None:
        """Add a heading."""
        self.parts.append(f"<h{level}>{escape(text)}</h{level}>")

    def text(self, *paragraphs: str) -> None:
        """Add paragraphs."""
        self.parts.extend(f"<p>{escape(paragraph)}</p>" for paragraph in paragraphs)

    def items(self, lines: Iterable[str]) -> None:
        """Add a list with one item for each line."""
        self.parts.append(f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>")

    def verdict(self, kind: str, *lines: str) -> None:
        """Add a box with a bold first line; `kind` is "good", "bad" or "doubt" and colours its edge."""
        first, *rest = (escape(line) for line in lines)
        paragraphs = "".join(f"<p>{line}</p>" for line in rest)
        self.parts.append(f'<div class="said {escape(kind)}"><p><b>{first}</b></p>{paragraphs}</div>')

    def code(self, text: str) -> None:
        """Add a block that is shown as it stands."""
        self.parts.append(f"<pre>{escape(text)}</pre>")

    def table(self, headings: Sequence[str], rows: Iterable[Sequence[object]], *, words: bool = False) -> None:
        """Add a table; its first column holds words, and with `words` the second one too."""
        head = "".join(f"<th>{escape(cell)}</th>" for cell in headings)
        lines = ["".join(f"<td>{escape(str(cell))}</td>" for cell in row) for row in rows]
        body = "".join(f"<tr>{line}</tr>" for line in lines)
        looks = ' class="words"' if words else ""
        self.parts.append(
            f'<div class="wide"><table{looks}><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
        )

    def pictures(self, pictures: Iterable[tuple[str, str]]) -> None:
        """Add pictures side by side where there is room: pairs of an <svg> element and its caption."""
        figures: list[str] = []
        for svg, caption in pictures:
            self._pictures += 1
            named = _rename_ids(svg, f"p{self._pictures}-").replace(
                "<svg ", f'<svg role="img" aria-label="{escape(caption)}" ', 1
            )
            figures.append(f"<figure>{named}<figcaption>{escape(caption)}</figcaption></figure>")
        self.parts.append(f'<div class="grid">{"".join(figures)}</div>')

    def links(self, title: str, files: Iterable[str]) -> None:
        """Add a list of files beside the page, folded up under its title."""
        lines = ", ".join(f'<a href="{quote(file)}">{escape(file)}</a>' for file in files)
        self.parts.append(f"<details><summary>{escape(title)}</summary><p>{lines}</p></details>")

    @property
    def html(self) -> str:
        """The whole document."""
        return _wrap_html(self.title, f"<h1>{escape(self.title)}</h1>{''.join(self.parts)}")

    def write(self, path: Path) -> Path:
        """Write the document and return its path.

        Raises
        ------
        LogError
            The file cannot be written.
        """
        with disk.writing(path) as stream:
            stream.write(self.html.encode())
        return path
