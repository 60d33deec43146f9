"""The papers that are done again, by name: each a folder of its name here, whose paper.py defines `paper`.

docs/<name>.md is the report.md of such a run, and docs/<name>/ its pictures: copy both after a change.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from importlib import import_module
from pathlib import Path

from rich import box
from rich.table import Table

from koopmpc.checks import nearest
from koopmpc.errors import ProblemError


class Verdict(Enum):
    """What measurements say of a claim."""

    HOLDS = "holds"
    IN_PART = "holds in part"
    FAILS = "does not hold"


@dataclass(frozen=True)
class Claim:
    """One claim: where it stands, in our words; the verdict, and why."""

    where: str
    says: str
    verdict: Verdict
    why: str


def judged(where: str, says: str, *, holds: bool, why: str, in_part: bool = False) -> Claim:
    """Return the claim with its verdict: holds, else in part, else not."""
    verdict = Verdict.HOLDS if holds else Verdict.IN_PART if in_part else Verdict.FAILS
    return Claim(where, says, verdict, why)


def verdict_table(title: str, claims: Sequence[Claim]) -> Table:
    """Return one line a claim."""
    lines = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in ("where", "claim", "verdict", "why"):
        lines.add_column(heading)
    for claim in claims:
        lines.add_row(claim.where, claim.says, claim.verdict.value, claim.why)
    return lines


PAPERS = ("snyder",)
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Outcome:
    """What came of a paper: each claim with its verdict, and the files that say it all."""

    claims: tuple[Claim, ...]
    report: Path
    recording: Path


@dataclass(frozen=True)
class Paper:
    """A paper: its name and title, and the function that does it again.

    `reproduce(folder, quick, progress)` writes report.md, the figures in the folder of the paper's name and one .rrd.
    `quick` keeps every part but shortens what takes long: for tests.
    """

    name: str
    title: str
    reproduce: Callable[[Path, bool, Progress], Outcome]


def find_paper(name: str) -> Paper:
    """Return the paper of this name.

    Raises
    ------
    ProblemError
        There is none; the message names the nearest.
    """
    if name not in PAPERS:
        raise ProblemError(f"there is no paper {name!r}{nearest(name, PAPERS)}; there are {', '.join(PAPERS)}")
    return import_module(f"koopmpc.papers.{name}.paper").paper
