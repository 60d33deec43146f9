"""The page and the pictures of a fit."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc import checks
from koopmpc.data.episodes import Episodes
from koopmpc.figures.comparisons import error
from koopmpc.figures.eigenvalues import spectrum
from koopmpc.figures.series import rollout
from koopmpc.figures.style import save
from koopmpc.synthesis.selection import Selection
from koopmpc.validate.report import TrustReport
from koopmpc.validate.scoring import Score, score

_ROLLOUTS = 3
Pictures = list[tuple[str, str]]


@dataclass(frozen=True, eq=False)
class Page:
    """The texts and pictures (name, caption) of a report."""

    understood: str
    chosen: str
    trust: str
    pictures: Pictures
    usage: str
    failures: tuple[str, ...]


def drawn(
    selection: Selection,
    report: TrustReport,
    plain: Score,
    held_out: Episodes,
    folder: Path,
    failures: list[str],
) -> Pictures:
    """Draw error against horizon, forecasts and spectrum; return (name, caption) of those that could be drawn."""
    predictor, horizon = selection.predictor, selection.horizon
    finite = bool(np.isfinite(report.band.width).all())
    bands = report.band if finite else report.score
    around = "band that holds whole forecasts nine times in ten" if finite else "5 to 95 % of the errors"

    def errors() -> Any:
        named = {selection.best.kind: report.score}
        if selection.linear is not None and selection.linear is not predictor:
            named["best linear"] = score(selection.linear, held_out, horizon)
        named["plain linear"] = plain
        return error(named, width="two columns")

    plots: list[tuple[str, str, Callable[[], Any]]] = [
        (
            "error.png",
            "Errors on held-out episodes against the steps ahead, beside those of x⁺ = A x + B u + c.",
            errors,
        )
    ]
    for i, episode in enumerate(list(held_out)[:_ROLLOUTS]):
        plots.append(
            (
                f"rollout-{i}.png",
                f"Forecast of held-out episode {i} from its start, and the {around}.",
                partial(rollout, predictor, episode, horizon, bands),
            )
        )
    plots.append(
        (
            "spectrum.png",
            "Eigenvalues of A and the unit circle; crosses are spurious on the held-out episodes.",
            partial(spectrum, predictor, report.residuals),
        )
    )
    made: Pictures = []
    for name, caption, plot in plots:
        try:
            save(plot(), folder / name)
            made.append((name, caption))
        except Exception as failure:  # a picture that cannot be drawn must not cost the model
            failures.append(f"{name}: {type(failure).__name__}: {failure}")
    return made


def write_page(path: Path, page: Page) -> None:
    """Write the report in Markdown.

    Raises
    ------
    LogError
        The path cannot be written.
    """
    lines = ["# Model report", "", page.trust.partition("\n")[0], ""]
    lines += ["```python", page.usage, "```", ""]
    for title, text in (("Data", page.understood), ("Trust", page.trust), ("Choice", page.chosen)):
        lines += [f"## {title}", "", "```text", text, "```", ""]
        if title == "Trust":
            for name, caption in page.pictures:
                lines += [f"![{caption}]({name})", "", caption, ""]
    if page.failures:
        lines += ["## What could not be made", "", *(f"- {failure}" for failure in page.failures), ""]
    with checks.writing(path) as stream:
        stream.write("\n".join(lines).encode())
