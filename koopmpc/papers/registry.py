"""The papers that can be reproduced, and how their claims are judged.

A paper is a folder here whose paper.py defines `paper`. docs/<name>.md is the report.md of its reproduction, and
docs/<name>/ holds the pictures: copy both after a change.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from importlib import import_module
from pathlib import Path

from rich.table import Table

from koopmpc.bench.table import plain_table
from koopmpc.checks import nearest
from koopmpc.errors import ProblemError


class Verdict(Enum):
    """The verdict of our measurements on a claim."""

    HOLDS = "holds"
    IN_PART = "holds in part"
    FAILS = "does not hold"


@dataclass(frozen=True)
class Claim:
    """One claim of a paper in our words: where it stands, the verdict, and the reason for it."""

    where: str
    says: str
    verdict: Verdict
    why: str


def judged(where: str, says: str, *, holds: bool, why: str, in_part: bool = False) -> Claim:
    """Return the claim with its verdict: it holds, else it holds in part, else it does not hold."""
    verdict = Verdict.HOLDS if holds else Verdict.IN_PART if in_part else Verdict.FAILS
    return Claim(where, says, verdict, why)


def verdict_table(title: str, claims: Sequence[Claim]) -> Table:
    """Return a table with one line for each claim."""
    lines = plain_table(title, padding=(0, 1, 0, 0))
    for heading in ("where", "claim", "verdict", "why"):
        lines.add_column(heading)
    for claim in claims:
        lines.add_row(claim.where, claim.says, claim.verdict.value, claim.why)
    return lines


PAPERS = ("snyder",)


@dataclass(frozen=True)
class Reproduction:
    """A paper done again: each claim with its verdict, and the paths of the report and of the recording."""

    claims: tuple[Claim, ...]
    report: Path
    recording: Path


@dataclass(frozen=True)
class Paper:
    """A paper: its name and title, and the function that reproduces it.

    `reproduce(folder, quick, progress)` writes report.md, the figures in the folder of the paper's name and one .rrd.
    `quick` keeps every part but shortens what takes long; the tests use it. `progress` is called with what runs now.
    """

    name: str
    title: str
    reproduce: Callable[[Path, bool, Callable[[str], None]], Reproduction]


def find_paper(name: str) -> Paper:
    """Return the paper with this name.

    Raises
    ------
    ProblemError
        There is no such paper; the message names the nearest.
    """
    if name not in PAPERS:
        raise ProblemError(f"there is no paper {name!r}{nearest(name, PAPERS)}; there are {', '.join(PAPERS)}")
    return import_module(f"koopmpc.papers.{name}.paper").paper
