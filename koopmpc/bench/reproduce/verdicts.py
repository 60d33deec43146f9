"""Claims of a paper, and what became of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from rich import box
from rich.table import Table


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
    lines = Table(
        title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0)
    )
    for heading in ("where", "claim", "verdict", "why"):
        lines.add_column(heading)
    for claim in claims:
        lines.add_row(claim.where, claim.says, claim.verdict.value, claim.why)
    return lines
