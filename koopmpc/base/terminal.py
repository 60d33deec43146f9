"""Reports in a terminal: tables, labelled lines and paragraphs in 100 columns, by rich."""

from collections.abc import Iterable, Iterator, Sequence
from io import StringIO
from typing import Any

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.table import Column, Table

WIDTH = 100  # columns of a report
_WIDEST = 200  # columns of its tables, at most
_SHOWN = 15  # a leaderboard prints this many of its first rows
_HEADED = box.Box("    \n    \n -- \n    \n    \n    \n    \n    \n", ascii=True)  # Rerun's font has this line too


def render_text(*parts: RenderableType) -> str:
    """Return the parts below one another as plain text: no colours, no blanks at the ends of lines.

    Words are broken at 100 columns; a table of numbers is as wide as its cells.
    """
    stream = StringIO()
    console = Console(
        file=stream,
        width=_WIDEST,
        color_system=None,
        markup=False,
        emoji=False,
        highlight=False,
        legacy_windows=False,
        force_jupyter=False,  # there rich would display the text instead
    )
    for part in parts:
        console.print(part, width=_WIDEST if isinstance(part, Table) and part.box is _HEADED else WIDTH)
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines()).rstrip()


def build_table(headings: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> Table:
    """Return a table whose first `left` columns hold words, and the others numbers; a heading may have two lines."""
    made = Table(box=_HEADED, show_edge=False, padding=(0, 1, 0, 0), pad_edge=False)
    for i, heading in enumerate(headings):
        made.add_column(heading, justify="left" if i < left else "right", no_wrap=True, vertical="bottom")
    for row in rows:
        made.add_row(*row)
    return made


def build_leaderboard(
    headings: Sequence[str], rows: Sequence[Sequence[str]], chosen: int, linear: int | None, extra: Iterable[int] = ()
) -> tuple[Table, int]:
    """Return the table of the first 15 rows, those chosen and `extra`, and how many rows it leaves out.

    → marks the chosen row, and l the best linear one where it is another.
    """
    marks = {**({} if linear is None else {linear: "l"}), chosen: "→"}
    shown = sorted({*range(min(_SHOWN, len(rows))), *marks, *extra})
    return build_table(["", *headings], [[marks.get(i, ""), *rows[i]] for i in shown], left=2), len(rows) - len(shown)


def build_plain_table(title: str, words: Sequence[str], numbers: Sequence[str] = (), **settings: Any) -> Table:
    """Return an empty table with its title at the left, one rule below the headings, and numbers to the right."""
    headers = [*words, *(Column(heading, justify="right") for heading in numbers)]
    return _Plain(*headers, title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, **settings)


class _Plain(Table):
    """A table whose columns stand closer where the terminal is narrow."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[Any]:
        if options.max_width < WIDTH:
            self.padding = 0
        yield from super().__rich_console__(console, options)


def label_lines(pairs: Iterable[tuple[str, str]]) -> Table:
    """Return lines of text, each behind its label and broken beside it; an empty label continues the one before."""
    made = Table.grid(padding=(0, 2, 0, 0), pad_edge=False)
    made.add_column(no_wrap=True)
    made.add_column()
    for label, text in pairs:
        made.add_row(label, text)
    return made
