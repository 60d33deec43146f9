"""The papers that can be reproduced, their claims and verdicts, and the pages that `koopmpc reproduce` writes.

A paper is a `Paper` in a file or folder of problems/papers/, which uses `km` alone: `km.papers` serves what papers
share. docs/papers/ holds the pages and pictures that `koopmpc reproduce` writes; copy them there after a change.
"""

import sys
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from inspect import cleandoc
from pathlib import Path
from time import perf_counter
from types import ModuleType
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike
from rich.table import Table

from koopmpc.base.checks import nearest
from koopmpc.base.errors import ProblemError
from koopmpc.base.page import Page
from koopmpc.base.parallel import map_tasks
from koopmpc.base.terminal import build_plain_table
from koopmpc.views.figures.reports import CurvePanel, draw_panels
from koopmpc.views.figures.style import save
from koopmpc.views.recording.plots import record_curves

__all__ = [
    "PAPERS",
    "Claim",
    "CurvePanel",
    "Page",
    "Paper",
    "Verdict",
    "add_verdicts",
    "compare_value",
    "draw_curves",
    "draw_panels",
    "find_paper",
    "format_values",
    "import_paper_module",
    "judge_claim",
    "make_paper",
    "make_verdict_table",
    "percent",
    "relative_error",
    "reproduce_all",
    "summarise_claims",
]
PAPERS = ("snyder", "brunton", "proctor", "williams", "korda", "dictionary", "kaiser", "kic", "kernel")
_PACKAGE = "koopmpc_papers"  # name under which problems/papers/ is imported, from a checkout and from the wheel
_MODULES = {  # papers that share a module with other papers of their authors
    **dict.fromkeys(("brunton", "kic"), "proctor"),
    **dict.fromkeys(("williams", "kernel", "dictionary"), "kevrekidis"),
}

_VERDICTS = ("where", "the paper", "verdict", "ours, or why")
_ROUNDING = 1e-10  # smaller entries are written as 0
_DIVERGED = 100.0  # a larger relative error is written as "diverges"
TellPart = Callable[[str], None]  # is called with the name of the part that runs


class Verdict(Enum):
    """Verdict on a claim by our measurements."""

    HOLDS = "holds"
    IN_PART = "holds in part"
    FAILS = "does not hold"


@dataclass(frozen=True)
class Claim:
    """One claim of a paper in our words, with its place in the paper, the verdict, and our value or the reason.

    A correct library must reproduce `required` claims; the command fails if one of them does not hold.
    """

    where: str
    says: str
    verdict: Verdict
    why: str
    required: bool = False


def judge_claim(
    where: str, says: str, *, holds: bool, why: str, in_part: bool = False, required: bool = False
) -> Claim:
    """Return the claim with its verdict: HOLDS, otherwise IN_PART, otherwise FAILS."""
    verdict = Verdict.HOLDS if holds else Verdict.IN_PART if in_part else Verdict.FAILS
    return Claim(where, says, verdict, why, required)


def compare_value(
    where: str, paper: ArrayLike, ours: ArrayLike, spread: float, unit: str = "", digits: int = 6
) -> Claim:
    """Return the required claim that our value is the paper's: |ours − paper| ≤ spread, entry by entry."""
    says = f"{format_values(paper, digits)} ± {spread:.2g}{unit and ' ' + unit}"
    gap = float(np.abs(np.asarray(ours) - np.asarray(paper)).max())
    return judge_claim(
        where, says, holds=gap <= spread, why=f"{format_values(ours, digits + 1)}, off by {gap:.1g}", required=True
    )


def format_values(values: ArrayLike, digits: int) -> str:
    """Return a number, a vector or a matrix as text; entries below 1e-10 are rounding and are written as 0."""
    rows = np.atleast_2d(np.where(np.abs(values) < _ROUNDING, 0.0, values))
    return "; ".join(" ".join(f"{float(value):.{digits}g}" for value in row) for row in rows)


def relative_error(X: Float[np.ndarray, "T1 nx"], truth: Float[np.ndarray, "T1 nx"]) -> float:
    """Return ‖X − truth‖ / ‖truth‖ over all entries; inf if X overflowed."""
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.linalg.norm(X - truth) / np.linalg.norm(truth))
    return error if np.isfinite(error) else np.inf


def percent(error: float) -> str:
    """Return a relative error in % with three digits, or "diverges" if it is above 100 or NaN."""
    if not error < _DIVERGED:
        return "diverges"
    value = 100 * error
    return f"{value:.3g}" if value == 0 or value >= 1e-3 else f"{value:.1e}"


def make_verdict_table(title: str, claims: Sequence[Claim]) -> Table:
    """Return a table with one line for each claim."""
    lines = build_plain_table(title, _VERDICTS, padding=(0, 1, 0, 0))
    for claim in claims:
        lines.add_row(claim.where, claim.says, claim.verdict.value, claim.why)
    return lines


def add_verdicts(page: Page, claims: Sequence[Claim]) -> None:
    """Add a table with one line for each claim to a page."""
    page.table(_VERDICTS, [(c.where, c.says, f"**{c.verdict.value}**", c.why) for c in claims])


def summarise_claims(claims: Sequence[Claim]) -> str:
    """Return a text with the numbers of claims that hold, hold in part and do not hold."""
    count = Counter(claim.verdict for claim in claims)
    plural = {Verdict.HOLDS: "hold", Verdict.IN_PART: "hold in part", Verdict.FAILS: "do not hold"}
    return ", ".join(f"{count[verdict]} {word}" for verdict, word in plural.items())


def draw_curves(
    page: Page, name: str, caption: str, dt: float, columns: Sequence[str], values: Mapping[str, np.ndarray]
) -> None:
    """Draw curves over time, a panel for each column and a line for each name, and add them to the recording.

    Parameters
    ----------
    page
        The page.
    name, caption
        Name of the picture's file, and its caption, which is also the title of a tab in the recording.
    dt
        Sample time [s].
    columns
        Names with units.
    values
        By name, (T, columns) each; curves may differ in length.
    """
    panels = [
        CurvePanel("time [s]", column, {curve: (dt * np.arange(len(X)), X[:, i]) for curve, X in values.items()})
        for i, column in enumerate(columns)
    ]
    page.picture(name, caption, partial(save, draw_panels(panels)))
    longest = max(len(X) for X in values.values())
    padded = {c: np.pad(X, ((0, longest - len(X)), (0, 0)), constant_values=np.nan) for c, X in values.items()}
    page.curve(caption, dt, columns, padded)


@dataclass(frozen=True)
class Reproduction:
    """Result of reproducing a paper: its claims with verdicts, and the paths of the page and of the recording."""

    claims: tuple[Claim, ...]
    report: Path
    recording: Path

    @property
    def failures(self) -> tuple[Claim, ...]:
        """The required claims that do not hold."""
        return tuple(claim for claim in self.claims if claim.required and claim.verdict is not Verdict.HOLDS)


@dataclass(frozen=True)
class Paper:
    """A paper: its name, its title, and the function that reproduces it.

    Attributes
    ----------
    name, title
        Name in the command, and heading of the page.
    work
        Function of a page, `quick` and `progress`. It adds tables, pictures and at least one curve to the page, and
        returns the claims. If `quick`, it shortens long computations but keeps every part; the tests use this.
    about
        Description of the paper, equations and settings first, in paragraphs separated by blank lines. The page then
        begins with the title, the description, and the table of all claims. Without it, `work` writes the whole page.
    """

    name: str
    title: str
    work: Callable[[Page, bool, TellPart], Sequence[Claim]]
    about: str | None = None

    def reproduce(self, folder: Path, quick: bool, progress: TellPart) -> Reproduction:
        """Write <name>.md, the pictures in the folder <name>, and <name>.rrd with all curves."""
        page = Page(folder, beside=self.name)
        claims = tuple(self.work(page, quick, progress))
        if self.about is not None:
            body, page.parts = page.parts, []
            page.text(f"# {self.title}", *self.about.split("\n\n"))
            page.text(
                f"`koopmpc reproduce {self.name}` writes this page. Of {len(claims)} claims {summarise_claims(claims)}."
            )
            add_verdicts(page, claims)
            page.parts += body
        progress("page and recording")
        report, recording = page.write(f"{self.name}.md"), folder / f"{self.name}.rrd"
        record_curves(page.curves, recording, application=f"koopmpc-reproduce-{self.name}", page=page.words)
        return Reproduction(claims, report, recording)


def make_paper(
    name: str, text: str | None, work: Callable[[Page, bool, TellPart], Sequence[Claim]], **numbers: object
) -> Paper:
    """Return a paper with the title and description in the docstring `text`; {name} in it stands for an argument."""
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
    module = import_paper_module(_MODULES.get(name, name))
    return next(value for value in vars(module).values() if isinstance(value, Paper) and value.name == name)


def import_paper_module(name: str) -> ModuleType:
    """Import a module of problems/papers/, as "korda" or "snyder.theory", from the checkout or from the wheel."""
    if _PACKAGE not in sys.modules:
        home = Path(__file__).parents[1]
        folder = next(path for path in (home / "problems", home.parent / "problems") if path.is_dir()) / "papers"
        spec = spec_from_file_location(_PACKAGE, folder / "__init__.py", submodule_search_locations=[str(folder)])
        assert spec is not None
        assert spec.loader is not None
        sys.modules[_PACKAGE] = package = module_from_spec(spec)
        spec.loader.exec_module(package)
    return import_module(f"{_PACKAGE}.{name}")


class TimedReproduction(NamedTuple):
    """Result of reproducing a paper, and the time that it took [s]."""

    paper: str
    outcome: Reproduction
    seconds: float


def time_paper(name: str, folder: Path, quick: bool) -> TimedReproduction:
    """Reproduce the paper of this name and measure the time."""
    start = perf_counter()
    outcome = find_paper(name).reproduce(folder, quick, lambda words: None)
    return TimedReproduction(name, outcome, perf_counter() - start)


def reproduce_all(folder: Path, quick: bool, tell: TellPart, workers: int = 2) -> list[TimedReproduction]:
    """Reproduce every paper in `folder`, several in parallel, and write index.md, a table of them.

    Raises
    ------
    LogError
        A file cannot be written.
    """

    def progress(done: int, total: int | None) -> None:
        tell(f"{done} of {total} papers done")

    task = partial(time_paper, folder=folder, quick=quick)
    results = list(map_tasks(task, PAPERS, workers=workers, progress=progress))
    page = Page(folder)
    page.text(
        "# Papers, done again",
        """Each page is written by `koopmpc reproduce NAME`, all of them by `koopmpc reproduce --all`: claims in our
        words, the paper's figure with its spread, ours, and a verdict. The command exits with 1 where a number is
        missed that a correct library must reproduce.""",
    )
    page.table(
        SUMMARY,
        [
            (f"[{find_paper(done.paper).title}]({done.paper}.md)", *count_verdicts(done.outcome.claims))
            for done in results
        ],
    )
    page.write("index.md")
    return results


SUMMARY = ("paper", "claims", "hold", "in part", "do not hold")


def count_verdicts(claims: Sequence[Claim]) -> tuple[int, ...]:
    """Return the entries of a line below `SUMMARY` after the first."""
    return len(claims), *(sum(claim.verdict is verdict for claim in claims) for verdict in Verdict)


def make_summary_table(results: Sequence[TimedReproduction]) -> Table:
    """Return a table with one line for each paper."""
    lines = build_plain_table("Papers", (*SUMMARY, "required", "missed", "time [s]"), padding=(0, 1, 0, 0))
    for done in results:
        claims, failures = done.outcome.claims, done.outcome.failures
        required = sum(claim.required for claim in claims)
        lines.add_row(done.paper, *map(str, (*count_verdicts(claims), required, len(failures))), f"{done.seconds:.0f}")
    return lines
