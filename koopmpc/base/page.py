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
        body = f"<h1>{escape(self.title)}</h1>{''.join(part.html for part in self.parts)}"
        return f'<!doctype html><html lang="en"><head>{head}<style>{_STYLE}</style></head><body>{body}</body></html>\n'

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
