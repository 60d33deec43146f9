"""compared: two sweeps, or two logs, run by run: a paired test for each case and controller, and what got worse."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from rich.table import Table

from koopmpc import checks
from koopmpc.bench.results import RunRow, reached
from koopmpc.bench.store import load_rows
from koopmpc.errors import LogError
from koopmpc.loop.metrics import metrics
from koopmpc.recording.reader import load_run
from koopmpc.validate.text import plain_table

SURE = 0.05  # a regression needs a p below this where there are enough pairs to reach it
_ENOUGH = 6  # pairs from which the signed-rank test can reach SURE


class Pairs(NamedTuple):
    """The runs that A and B share of one case and controller.

    `shared` counts them. `ratio` is the median of B / A, `p` that of the signed-rank test of log B / A against zero,
    NaN for fewer than six pairs. `lost` counts the runs that reached their reference in A and not in B.
    """

    what: str
    figure: str
    shared: int
    ratio: float
    p: float
    lost: int
    worse: bool


@dataclass(frozen=True, eq=False)
class Compared:
    """What `compared` found; `regressions` are the pairs in which B is worse."""

    pairs: tuple[Pairs, ...]
    threshold: float
    alone: int

    @property
    def regressions(self) -> tuple[Pairs, ...]:
        """Pairs in which B is worse than A by more than the threshold."""
        return tuple(pair for pair in self.pairs if pair.worse)

    @property
    def table(self) -> Table:
        """A line for each case, controller and figure."""
        lines = plain_table("B / A", ("run",), ("figure", "pairs", "median B / A", "p", "lost", ""))
        for each in self.pairs:
            p = "–" if np.isnan(each.p) else f"{each.p:.2g}"
            cells = (each.figure, str(each.shared), f"{each.ratio:.4g}", p, str(each.lost))
            lines.add_row(each.what, *cells, "worse" if each.worse else "", style="red" if each.worse else None)
        return lines

    def __str__(self) -> str:
        """Return the verdict in one line."""
        alone = f"; {self.alone} runs are in one of the two only" if self.alone else ""
        if not self.regressions:
            return f"no regression beyond {self.threshold:.1%} in {len(self.pairs)} comparisons{alone}"
        share = f"{len(self.regressions)} of {len(self.pairs)} comparisons"
        return f"{share} are worse by more than {self.threshold:.1%}{alone}"


def compared(a: str | Path, b: str | Path, *, threshold: float = 0.02, times: bool = False) -> Compared:
    """Compare the runs that two sweeps, or two logs, have in common; two logs of one case may be of two controllers.

    B is worse where the median of its cost over A's exceeds 1 + threshold, and a two-sided Wilcoxon signed-rank test
    of the logarithms of these ratios gives p < 0.05 where there are at least six pairs; or where a run no longer
    reaches its reference, or fails.

    Parameters
    ----------
    a, b
        Folders of sweeps, or logs.
    threshold
        Share by which B may be worse.
    times
        Whether the median times of a step are compared too.

    Raises
    ------
    LogError
        One of them holds no sweep and is no log, or they have no run in common.
    """
    checks.positive(1.0 + threshold, "1 + threshold", "")
    first, second = _rows(Path(a)), _rows(Path(b))
    if not Path(a).is_dir() and not Path(b).is_dir():
        first, second = _told_apart(*first.values(), *second.values())
    both = sorted(first.keys() & second.keys(), key=str)
    if not both:
        raise LogError(
            f"{a} and {b} have no run in common: two sweeps need the same problem, case, controller, "
            "start, seed and noise, two logs the same problem and case"
        )
    found: list[Pairs] = []
    for group, keys in groupby(both, key=lambda key: key[:6]):
        pairs = [(first[key], second[key]) for key in keys]
        what = " ".join(str(part) for part in group if part)
        figures = ("cost", "solve_time_p50") if times else ("cost",)
        found.extend(_compared(what, figure, pairs, threshold) for figure in figures)
    return Compared(tuple(found), threshold, len(first.keys() ^ second.keys()))


def _rows(path: Path) -> dict[tuple[Any, ...], RunRow]:
    if path.is_dir():
        return {row.key: row for row in load_rows(path)}
    run = load_run(path)
    problem, case, controller = (str(run.metadata.get(name, "")) for name in ("problem", "case", "controller"))
    fault = run.metadata.get("fault")
    row = RunRow(
        problem or "run", case, controller, metrics(run), reached(run), fault=None if fault is None else str(fault)
    )
    return {row.key: row}


def _told_apart(a: RunRow, b: RunRow) -> tuple[dict[tuple[Any, ...], RunRow], dict[tuple[Any, ...], RunRow]]:
    """Return the runs of two logs by their problem and case, and by what B and A are, where these differ."""
    of_a, of_b = (" ".join(filter(None, (row.controller, row.fault))) for row in (a, b))
    which = of_a if of_a == of_b else f"{of_b or 'B'} / {of_a or 'A'}"
    return {(a.problem, a.case, which): a}, {(b.problem, b.case, which): b}


def _compared(what: str, figure: str, pairs: list[tuple[RunRow, RunRow]], threshold: float) -> Pairs:
    from scipy.stats import wilcoxon

    lost = sum((a.reached and not b.reached) or (b.failure is not None and a.failure is None) for a, b in pairs)
    ratios = np.array([value for a, b in pairs for value in _ratio(a, b, figure)])
    ratio = float(np.median(ratios)) if len(ratios) else float("nan")
    logs: Float[np.ndarray, " n"] = np.log(ratios[(ratios > 0) & np.isfinite(ratios)])
    p = float("nan")
    if len(logs) >= _ENOUGH:
        p = float(wilcoxon(logs).pvalue) if logs.any() else 1.0
    worse = ratio > 1.0 + threshold and not p >= SURE
    return Pairs(what, figure, len(pairs), ratio, p, lost, bool(worse or (figure == "cost" and lost > 0)))


def _ratio(a: RunRow, b: RunRow, figure: str) -> Iterator[float]:
    if a.metrics is None or b.metrics is None:
        return
    old, new = getattr(a.metrics, figure), getattr(b.metrics, figure)
    if old > 0 and np.isfinite(old) and np.isfinite(new):
        yield new / old
    elif old == new == 0:
        yield 1.0
