"""The papers that can be reproduced: what each says, how its claims are judged, and the page that is written.

A paper is a `Paper` in the module of its name, or in that of its authors. docs/papers/ holds the pages and pictures
that `koopmpc reproduce` writes: copy both after a change.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial
from importlib import import_module
from inspect import cleandoc
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from rich.table import Table

from koopmpc.checks import nearest
from koopmpc.errors import ProblemError
from koopmpc.figures.reports import Plot, plots
from koopmpc.parallel import map_tasks
from koopmpc.recording.page import Page, record_curves
from koopmpc.validate.text import plain_table

PAPERS = ("snyder", "brunton", "proctor", "williams", "korda", "dictionary", "kaiser", "kic", "kernel")
_HOME = {  # papers in a file with others of their authors
    **dict.fromkeys(("brunton", "kic"), "proctor"),
    **dict.fromkeys(("williams", "kernel", "dictionary"), "kevrekidis"),
}

_VERDICTS = ("where", "the paper", "verdict", "ours, or why")
_ROUNDING = 1e-10
_HUGE = 100.0  # a relative error beyond it has no digits worth reading
Tell = Callable[[str], None]  # is called with what runs now


class Verdict(Enum):
    """The verdict of our measurements on a claim."""

    HOLDS = "holds"
    IN_PART = "holds in part"
    FAILS = "does not hold"


@dataclass(frozen=True)
class Claim:
    """One claim of a paper in our words: where it stands, the verdict, and the reason for it, or our figure.

    `required` claims are numbers that a correct library must reproduce: the command fails where one does not hold.
    """

    where: str
    says: str
    verdict: Verdict
    why: str
    required: bool = False


def judged(where: str, says: str, *, holds: bool, why: str, in_part: bool = False, required: bool = False) -> Claim:
    """Return the claim with its verdict: it holds, else it holds in part, else it does not hold."""
    verdict = Verdict.HOLDS if holds else Verdict.IN_PART if in_part else Verdict.FAILS
    return Claim(where, says, verdict, why, required)


def compared(where: str, paper: ArrayLike, ours: ArrayLike, spread: float, unit: str = "", digits: int = 6) -> Claim:
    """Return the required claim that our figure is the paper's: |ours − paper| ≤ spread, entry by entry."""
    says = f"{written(paper, digits)} ± {spread:.2g}{unit and ' ' + unit}"
    gap = float(np.abs(np.asarray(ours) - np.asarray(paper)).max())
    return judged(where, says, holds=gap <= spread, why=f"{written(ours, digits + 1)}, off by {gap:.1g}", required=True)


def written(values: ArrayLike, digits: int) -> str:
    """Return a number, a vector or a matrix as text; what is below 1e-10 is rounding, and is written as 0."""
    rows = np.atleast_2d(np.where(np.abs(values) < _ROUNDING, 0.0, values))
    return "; ".join(" ".join(f"{float(value):.{digits}g}" for value in row) for row in rows)


def relative(X: Float[np.ndarray, "T1 nx"], truth: Float[np.ndarray, "T1 nx"]) -> float:
    """Return ‖X − truth‖ / ‖truth‖ over all entries; inf where X left the finite numbers."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.linalg.norm(X - truth) / np.linalg.norm(truth))
    return error if np.isfinite(error) else np.inf


def percent(error: float) -> str:
    """Return a relative error in %, with three digits; "diverges" where it is huge or not a number."""
    if not error < _HUGE:
        return "diverges"
    value = 100 * error
    return f"{value:.3g}" if value == 0 or value >= 1e-3 else f"{value:.1e}"


def verdict_table(title: str, claims: Sequence[Claim]) -> Table:
    """Return a table with one line for each claim."""
    lines = plain_table(title, _VERDICTS, padding=(0, 1, 0, 0))
    for claim in claims:
        lines.add_row(claim.where, claim.says, claim.verdict.value, claim.why)
    return lines


def verdicts(page: Page, claims: Sequence[Claim]) -> None:
    """Add the same table to a page."""
    page.table(_VERDICTS, [(c.where, c.says, f"**{c.verdict.value}**", c.why) for c in claims])


def summary(claims: Sequence[Claim]) -> str:
    """Return how many claims hold, hold in part and do not hold, as words."""
    count = Counter(claim.verdict for claim in claims)
    plural = {Verdict.HOLDS: "hold", Verdict.IN_PART: "hold in part", Verdict.FAILS: "do not hold"}
    return ", ".join(f"{count[verdict]} {word}" for verdict, word in plural.items())


def show(
    page: Page, name: str, caption: str, dt: float, columns: Sequence[str], values: Mapping[str, np.ndarray]
) -> None:
    """Draw curves over time, a panel for each column and a line for each name; the recording gets them too.

    Parameters
    ----------
    page
        The page.
    name, caption
        Name of the picture's file, and what it shows; the caption is the title of the recording's tab.
    dt
        Sample time [s].
    columns
        Names with units.
    values
        By name, (T, columns) each; curves may differ in length.
    """
    drawn = [
        Plot("time [s]", column, {curve: (dt * np.arange(len(X)), X[:, i]) for curve, X in values.items()})
        for i, column in enumerate(columns)
    ]
    page.picture(name, caption, plots(drawn))
    longest = max(len(X) for X in values.values())
    held = {c: np.pad(X, ((0, longest - len(X)), (0, 0)), constant_values=np.nan) for c, X in values.items()}
    page.curve(caption, dt, columns, held)


@dataclass(frozen=True)
class Reproduction:
    """A paper done again: each claim with its verdict, and the paths of the page and of the recording."""

    claims: tuple[Claim, ...]
    report: Path
    recording: Path

    @property
    def failed(self) -> tuple[Claim, ...]:
        """The required claims that do not hold."""
        return tuple(claim for claim in self.claims if claim.required and claim.verdict is not Verdict.HOLDS)


@dataclass(frozen=True)
class Paper:
    """A paper: its name, its title, and the work that reproduces it.

    Attributes
    ----------
    name, title
        As in the command, and as a heading.
    work
        Called with a page, whether to be quick, and `progress`: adds tables, pictures and at least one curve to the
        page, and returns the claims. A quick one keeps every part and shortens what takes long; the tests use it.
    about
        What the paper is, equations and settings first, in paragraphs with a blank line between them. The page then
        begins with the title, these, and the table of all claims; without it the work writes the whole page.
    """

    name: str
    title: str
    work: Callable[[Page, bool, Tell], Sequence[Claim]]
    about: str | None = None

    def reproduce(self, folder: Path, quick: bool, progress: Tell) -> Reproduction:
        """Write <name>.md, the pictures in the folder <name>, and <name>.rrd with all curves."""
        page = Page(folder, beside=self.name)
        claims = tuple(self.work(page, quick, progress))
        if self.about is not None:
            body, page.parts = page.parts, []
            page.text(f"# {self.title}", *self.about.split("\n\n"))
            page.text(f"`koopmpc reproduce {self.name}` writes this page. Of {len(claims)} claims {summary(claims)}.")
            verdicts(page, claims)
            page.parts += body
        progress("page and recording")
        written, recording = page.write(f"{self.name}.md"), folder / f"{self.name}.rrd"
        record_curves(page.curves, recording, application=f"koopmpc-reproduce-{self.name}", page=page.words)
        return Reproduction(claims, written, recording)


def short(name: str, text: str | None, work: Callable[[Page, bool, Tell], Sequence[Claim]], **numbers: object) -> Paper:
    """Return a paper whose title and opening are a docstring, `text`, in which {name} stands for one of `numbers`."""
    about = cleandoc(text or name)
    title, _, about = (about.format(**numbers) if numbers else about).partition("\n\n")
    return Paper(name, title.rstrip("."), work, about)


def find_paper(name: str) -> Paper:
    """Return the paper with this name.

    Raises
    ------
    ProblemError
        There is no such paper; the message names the nearest.
    """
    if name not in PAPERS:
        raise ProblemError(f"there is no paper {name!r}{nearest(name, PAPERS)}; there are {', '.join(PAPERS)}")
    module = import_module(f"koopmpc.papers.{_HOME.get(name, name)}")
    return next(each for each in vars(module).values() if isinstance(each, Paper) and each.name == name)


class TimedReproduction(NamedTuple):
    """A paper done again, and how long that took [s]."""

    paper: str
    outcome: Reproduction
    seconds: float


def reproduced(name: str, folder: Path, quick: bool) -> TimedReproduction:
    """Reproduce the paper of this name."""
    start = perf_counter()
    outcome = find_paper(name).reproduce(folder, quick, lambda words: None)
    return TimedReproduction(name, outcome, perf_counter() - start)


def reproduce_all(folder: Path, quick: bool, tell: Tell, workers: int = 2) -> list[TimedReproduction]:
    """Reproduce every paper in `folder`, some at once, and write index.md, a table of them.

    Raises
    ------
    LogError
        A file cannot be written.
    """

    def progress(done: int, total: int | None) -> None:
        tell(f"{done} of {total} papers done")

    task = partial(reproduced, folder=folder, quick=quick)
    found = list(map_tasks(task, PAPERS, workers=workers, progress=progress))
    page = Page(folder)
    page.text(
        "# Papers, done again",
        """Each page is written by `koopmpc reproduce NAME`, all of them by `koopmpc reproduce --all`: claims in our
        words, the paper's figure with its spread, ours, and a verdict. The command exits with 1 where a number is
        missed that a correct library must reproduce.""",
    )
    page.table(
        SUMMARY,
        [(f"[{find_paper(each.paper).title}]({each.paper}.md)", *counts(each.outcome.claims)) for each in found],
    )
    page.write("index.md")
    return found


SUMMARY = ("paper", "claims", "hold", "in part", "do not hold")


def counts(claims: Sequence[Claim]) -> tuple[int, ...]:
    """Return the entries of a line below `SUMMARY` after the first."""
    return len(claims), *(sum(claim.verdict is verdict for claim in claims) for verdict in Verdict)


def summary_table(found: Sequence[TimedReproduction]) -> Table:
    """Return a table with one line for each paper, and its time."""
    lines = plain_table("Papers", (*SUMMARY, "required", "missed", "time [s]"), padding=(0, 1, 0, 0))
    for each in found:
        claims, failed = each.outcome.claims, each.outcome.failed
        required = sum(claim.required for claim in claims)
        lines.add_row(each.paper, *map(str, (*counts(claims), required, len(failed))), f"{each.seconds:.0f}")
    return lines
