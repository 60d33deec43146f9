"""The papers that are done again, by name: each a module of its name here that defines `paper`.

docs/<name>.md is the report.md of such a run, and docs/<name>/ its pictures: copy both after a change.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from koopmpc.bench.names import nearest
from koopmpc.bench.reproduce.verdicts import Claim
from koopmpc.errors import ProblemError

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
        raise ProblemError(
            f"there is no paper {name!r}{nearest(name, PAPERS)}; there are {', '.join(PAPERS)}"
        )
    return import_module(f"koopmpc.bench.reproduce.{name}").paper
