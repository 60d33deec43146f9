"""The command that explains the words of tables, reports and pictures, which stand in words.toml."""

import tomllib
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from koopmpc.apps.cli.console import console, friendly
from koopmpc.base.errors import ProblemError


def explain(
    term: Annotated[
        list[str] | None,
        typer.Argument(help="A word of a table, a report or a picture, or a case; all words if left out."),
    ] = None,
) -> None:
    """Explain a word that stands in a table, a report or a picture."""
    from koopmpc.apps.bench.controllers import CONTROLLERS
    from koopmpc.apps.bench.measured import describe_cases
    from koopmpc.base.checks import nearest

    words = tomllib.loads(Path(__file__).with_name("words.toml").read_text("utf-8"))
    out, terms = console(), words | {name: entry.explanation for name, entry in CONTROLLERS.items()}
    if not term:
        for name, text in terms.items():
            out.print(Text.assemble((name, "bold"), f": {text}"))
        return
    known, asked = {name.lower(): text for name, text in terms.items()}, " ".join(term)
    key = " ".join(asked.lower().split())
    with friendly():
        if key not in known and (cases := describe_cases(asked)):
            for text in cases:
                out.print(Text(text))
            return
        if key not in known:
            raise ProblemError(f"there is no term {asked!r}{nearest(key, known)}; there are {', '.join(terms)}")
    out.print(Text(known[key]))
