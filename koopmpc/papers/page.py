"""Page: a report in Markdown, part by part; figures and curves go beside it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from koopmpc.recording.views.curves import Curves

_HUGE = 100.0  # a relative error beyond it has no digits worth reading


@dataclass
class Page:
    """What one paper comes to: Markdown, figures under `folder`/`name`, and curves for the recording.

    The report is `folder`/report.md. Its pictures have relative paths, so the report and the folder `name` may be
    copied to any place together.
    """

    name: str
    folder: Path
    parts: list[str] = field(default_factory=list[str])
    curves: list[Curves] = field(default_factory=list[Curves])

    def text(self, *paragraphs: str) -> None:
        """Add headings or paragraphs; the lines of each are joined."""
        self.parts.extend(" ".join(paragraph.split()) for paragraph in paragraphs)

    def table(self, headings: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        """Add a table; a | in a cell is written so that it does not end it."""
        lines = [list(headings), ["---"] * len(headings), *([str(cell) for cell in row] for row in rows)]
        self.parts.append("\n".join(f"| {' | '.join(map(_cell, line))} |" for line in lines))

    def picture(self, name: str, caption: str) -> Path:
        """Add a picture with its caption and return the path that it has to be saved at."""
        self.parts.append(f"![{caption}]({self.name}/{name}.png)\n\n*{caption}*")
        return self.folder / self.name / f"{name}.png"

    def curve(self, title: str, dt: float, columns: Sequence[str], values: Mapping[str, np.ndarray]) -> None:
        """Add curves to the recording."""
        self.curves.append(Curves(title, dt, tuple(columns), dict(values)))

    @property
    def markdown(self) -> str:
        """All parts."""
        return "\n\n".join(self.parts) + "\n"

    @property
    def spoken(self) -> str:
        """All parts but the pictures."""
        return "\n\n".join(part for part in self.parts if not part.startswith("![")) + "\n"


def percent(error: float) -> str:
    """Return a relative error in %, three digits; words where it has none."""
    if not error < _HUGE:
        return "diverges"
    value = 100 * error
    return f"{value:.3g}" if value == 0 or value >= 1e-3 else f"{value:.1e}"


def _cell(text: str) -> str:
    return text.replace("|", r"\|")
