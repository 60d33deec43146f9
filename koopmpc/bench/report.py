"""write_report: a sweep as one HTML file without a network, and the same as Markdown and CSV."""

import csv
import html
import io
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, fields
from itertools import groupby
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from jaxtyping import Float
from rich.console import Group
from rich.table import Table

from koopmpc import disk
from koopmpc.bench.results import ORACLE, RunRow
from koopmpc.bench.store import load_rows, manifest_of
from koopmpc.control.move import Fallback, Status
from koopmpc.figures.reports import attraction, profiles, times, trajectories
from koopmpc.figures.style import svg
from koopmpc.loop.metrics import duration
from koopmpc.loop.run import Run
from koopmpc.recording.description import STATUS_WORDS
from koopmpc.recording.reader import load_run
from koopmpc.validate.text import markdown_table, plain_table

_SURE = (0.025, 0.975)  # the ends of an interval
_STARTS = 10  # from which a map of starts is drawn
_LOGS = 12  # runs over one another, at most


@dataclass(frozen=True)
class Summary:
    """The runs of one controller under one condition, over starts and seeds; intervals hold a median with 95 %."""

    case: str
    condition: str
    controller: str
    runs: int
    failed: int
    reached: float
    cost: float
    cost_low: float
    cost_high: float
    ratio: float
    ratio_low: float
    ratio_high: float
    violation: float
    worst_violation: float
    fell_back: float
    p50: float
    p99: float
    cold_p50: float


def median_interval(values: Float[np.ndarray, " n"]) -> tuple[float, float, float]:
    """Return the median of n values, and the ends of its 95 % interval by the ideal bootstrap; NaN without a value.

    A resample has Bin(n, k/n) values up to x_(k), so its median is at most x_(k) where these are half of it or more:
    with probability P(Bin(n, k/n) ≥ m) = I_{k/n}(m, n − m + 1), which needs no drawing. The ends are the first x_(k) at
    which this is 2.5 % for the lower median, m = ⌈n/2⌉, and 97.5 % for the upper one, m = ⌊n/2⌋ + 1.
    """
    from scipy.stats import beta

    ordered = np.sort(values[np.isfinite(values)])
    n = len(ordered)
    if not n:
        return float("nan"), float("nan"), float("nan")
    low, high = (
        ordered[int(np.ceil(n * beta.ppf(share, m, n - m + 1))) - 1]
        for share, m in zip(_SURE, ((n + 1) // 2, n // 2 + 1), strict=True)
    )
    return float(np.median(ordered)), float(low), float(high)


def condition_of(row: RunRow) -> str:
    """Return what is not as usual in a run, "–" where all is."""
    parts = [row.fault or "", f"noise {row.noise:g}" if row.noise else "", f"wrong {row.wrong:g}" if row.wrong else ""]
    return ", ".join(filter(None, parts)) or "–"


def summaries(rows: Sequence[RunRow]) -> list[Summary]:
    """Return a summary for each case, condition and controller."""
    best = {_pair(row): row.metrics.cost for row in rows if row.controller == ORACLE and row.metrics is not None}
    found: list[Summary] = []
    groups: dict[tuple[str, str, str], list[RunRow]] = {}
    for row in rows:
        groups.setdefault((f"{row.problem}:{row.case}", condition_of(row), row.controller), []).append(row)
    for key, own in groups.items():
        measured = [(row, row.metrics) for row in own if row.metrics is not None]
        costs = np.array([figures.cost for _, figures in measured])
        oracle = np.array([best.get(_pair(row), np.nan) for row, _ in measured])
        with np.errstate(all="ignore"):
            ratios = np.where(oracle > 0, costs / oracle, np.nan)
        over = np.array([figures.violation for _, figures in measured])
        steps = sum(sum(figures.status.values()) for _, figures in measured)
        kept = sum(figures.fallback.get(Fallback.NONE.name, 0) for _, figures in measured)
        hot = np.array([(f.solve_time_p50, f.solve_time_p99) for _, f in measured]).reshape(-1, 2)
        cold = np.array([row.cold_p50 for row, _ in measured])
        cold = cold[np.isfinite(cold)]
        found.append(
            Summary(
                *key,
                runs=len(own),
                failed=sum(row.failure is not None for row in own),
                reached=sum(row.reached for row in own) / len(own),
                **dict(zip(("cost", "cost_low", "cost_high"), median_interval(costs), strict=True)),
                **dict(zip(("ratio", "ratio_low", "ratio_high"), median_interval(ratios), strict=True)),
                violation=float(np.median(over)) if len(over) else float("nan"),
                worst_violation=float(over.max(initial=0.0)),
                fell_back=1.0 - kept / steps if steps else float("nan"),
                p50=float(np.median(hot[:, 0])) if len(hot) else float("nan"),
                p99=float(np.median(hot[:, 1])) if len(hot) else float("nan"),
                cold_p50=float(np.median(cold)) if len(cold) else float("nan"),
            )
        )
    return found


def _pair(row: RunRow) -> tuple[Any, ...]:
    """Return what two controllers' runs have in common."""
    return (row.problem, row.case, row.fault, row.noise, row.wrong, row.start)


_HEADINGS = ("controller", "condition", "runs", "reach", "cost", "ratio", "over", "fell back", "p50", "p99", "cold")
_WHOLE = ("controller", "runs", "reach", "p50", "p99", "cold")  # columns of a terminal that are not wrapped


def _cells(own: Summary) -> tuple[str, ...]:
    def between(middle: float, low: float, high: float) -> str:
        if np.isnan(middle):
            return "–"
        return f"{middle:.4g}" + (f" [{low:.4g}, {high:.4g}]" if own.runs > 1 else "")

    def time(value: float) -> str:
        return "–" if np.isnan(value) else duration(value)

    return (
        own.controller,
        own.condition,
        f"{own.runs}" + (f" ({own.failed} failed)" if own.failed else ""),
        f"{100 * own.reached:.0f} %",
        between(own.cost, own.cost_low, own.cost_high),
        between(own.ratio, own.ratio_low, own.ratio_high),
        f"{own.violation:.2g} ({own.worst_violation:.2g})" if own.worst_violation else "0",
        f"{100 * own.fell_back:.1f} %" if own.fell_back > 0 else "0",
        time(own.p50),
        time(own.p99),
        time(own.cold_p50),
    )


def summary_table(rows: Sequence[RunRow]) -> Group:
    """Return the summaries as tables for a terminal, one for each case; columns in which all is 0 or – are left out."""
    parts: list[Table] = []
    for case, group in groupby(summaries(rows), key=lambda each: each.case):
        found = list(group)
        cells = np.array([_cells(own) for own in found])
        told = [i for i in range(len(_HEADINGS)) if i == 0 or not np.isin(cells[:, i], ("0", "–")).all()]
        lines = plain_table(case, (), padding=(0, 0, 0, 1))
        for i in told:
            lines.add_column(_HEADINGS[i], justify="right" if i > 1 else "left", no_wrap=_HEADINGS[i] in _WHOLE)
        for own, row in zip(found, cells[:, told], strict=True):
            lines.add_row(*row, style="red" if own.failed else None)
        parts.append(lines)
    return Group(*parts)


def write_report(folder: str | Path) -> Path:
    """Write report.html, report.md and summary.csv into a sweep's folder, of the runs that are finished.

    Raises
    ------
    LogError
        The folder holds no sweep with a finished run, or cannot be written.
    """
    folder = Path(folder)
    rows, about = load_rows(folder), manifest_of(folder)
    found = summaries(rows)
    table = io.StringIO()
    out = csv.writer(table)
    out.writerow([field.name for field in fields(Summary)])
    out.writerows(astuple(each) for each in found)
    sections = list(_sections(rows, found, folder))
    for name, text in (
        ("summary.csv", table.getvalue()),
        ("report.md", _markdown(rows, about, sections)),
        ("report.html", _html(rows, about, sections)),
    ):
        with disk.writing(folder / name) as stream:
            stream.write(text.encode())
    return folder / "report.html"


@dataclass(frozen=True)
class _Section:
    """A heading, a table under it, and pictures with their captions."""

    title: str
    headings: tuple[str, ...]
    lines: list[tuple[str, ...]]
    pictures: list[tuple[str, str]]
    logs: list[str]


def _sections(rows: Sequence[RunRow], found: Sequence[Summary], folder: Path) -> Iterable[_Section]:
    for title, group in groupby(found, key=lambda each: each.case):
        own = [row for row in rows if f"{row.problem}:{row.case}" == title]
        usual = [row for row in own if condition_of(row) == "–"] or own
        lines = [_cells(summary) for summary in group]
        logs = [row.log.name for row in own if row.log is not None and row.log.is_file()]
        yield _Section(title, _HEADINGS, lines, list(_pictures(own, usual, folder)), logs)
    lines = [(case, name, *counts) for case, name, counts in _statuses(rows)]
    whole = list(_profile(rows)) if len({each.case for each in found}) > 1 else []
    yield _Section("All cases", ("case", "controller", "steps", "how steps ended"), lines, whole, [])


def _pictures(own: Sequence[RunRow], usual: Sequence[RunRow], folder: Path) -> Iterable[tuple[str, str]]:
    """Yield pictures of one case as SVG with their captions."""
    names = list(dict.fromkeys(row.controller for row in own))
    yield from _profile(own)
    measured = {name: [row for row in usual if row.controller == name and row.metrics is not None] for name in names}
    hot = {name: np.array([r.metrics.solve_time_p50 for r in own if r.metrics]) for name, own in measured.items()}
    cold = {name: np.array([row.cold_p50 for row in own]) for name, own in measured.items()}
    yield svg(times(hot, cold)), "Time of a step: median over runs, middle half, and 5 to 95 %; × with cold caches."
    starts = {name: np.array([row.x0 for row in own]) for name, own in measured.items() if len(own) >= _STARTS}
    runs = _logged(usual, folder)
    if starts and next(iter(starts.values())).shape[1] > 1:
        spread = np.ptp(np.vstack(list(starts.values())), axis=0)
        i, j = (int(k) for k in np.sort(np.argsort(-spread, kind="stable")[:2]))
        named: tuple[str, ...] = next(iter(runs.values())).states if runs else ()
        states: list[str] = [*named, *(f"state {k}" for k in range(len(named), len(spread)))]
        reached = {name: np.array([row.reached for row in measured[name]]) for name in starts}
        mapped = {name: (values[:, [i, j]], reached[name]) for name, values in starts.items()}
        alone = "" if len(usual) == len(own) else ", without noise and with the plant as it is"
        yield (
            svg(attraction(mapped, [states[i], states[j]])),
            f"Initial states that reach their reference, and not{alone}.",
        )
    if runs:
        yield svg(trajectories(runs)), "The case's own start."


def _profile(rows: Sequence[RunRow]) -> Iterable[tuple[str, str]]:
    """Yield the performance profile of these runs, where there is something to compare."""
    names = list(dict.fromkeys(row.controller for row in rows))
    least: dict[tuple[Any, ...], float] = {}
    for row in rows:
        if row.reached and row.metrics is not None:
            least[_pair(row)] = min(row.metrics.cost, least.get(_pair(row), np.inf))
    ratios: dict[str, list[float]] = {name: [] for name in names}
    for row in rows:
        best, own = least.get(_pair(row), np.nan), row.metrics
        ratios[row.controller].append(own.cost / best if row.reached and own is not None and best > 0 else np.inf)
    if len(names) > 1 and len(rows) > len(names):
        made = profiles({name: np.array(values) for name, values in ratios.items()})
        yield svg(made), "Performance profile: the share of runs whose cost is within τ of the best controller's."


def _logged(usual: Sequence[RunRow], folder: Path) -> dict[str, Run]:
    """Return the runs from the case's own start that have a log, by controller."""
    own = [row for row in usual if row.start == row.seed == 0 and row.log is not None and row.log.is_file()]
    return {row.controller: load_run(folder / row.log.name) for row in own[:_LOGS] if row.log is not None}


def _statuses(rows: Sequence[RunRow]) -> Iterable[tuple[str, str, tuple[str, str]]]:
    groups: dict[tuple[str, str], dict[str, int]] = {}
    for row in rows:
        counts = groups.setdefault((f"{row.problem}:{row.case}", row.controller), {})
        if row.metrics is not None:
            for name, count in row.metrics.status.items():
                counts[name] = counts.get(name, 0) + count
    for (case, controller), counts in groups.items():
        total = sum(counts.values())
        parts = [f"{100 * n / total:.3g} % {STATUS_WORDS[Status[name]]}" for name, n in counts.items() if n]
        yield case, controller, (str(total), ", ".join(parts))


def _intro(rows: Sequence[RunRow], about: dict[str, Any]) -> list[str]:
    """Return the paragraphs before the tables."""
    asked, machine = about["asked"], about["machine"]
    failed = [row for row in rows if row.failure is not None]

    def shares(name: str) -> str:
        return ", ".join(f"{100 * share:g} %" for share in asked[name])

    lines = [
        f"{len(rows)} runs: starts {asked['starts']}, sets of training data {asked['seeds']}, noise {shares('noise')},"
        f" parameters wrong by {shares('wrong')}{', with faults' if asked['faults'] else ''}."
        " Costs are medians with 95 % intervals by bootstrap over starts and seeds; ratio is to nonlinear-mpc from the"
        " same start; over is the median violation, the largest in brackets; p50 and p99 are times of a step with hot"
        " caches, cold its median after 4 ms of sleep.",
        f"{machine['processor']}, {machine['cores']} cores, load {machine['load']} at the start, BLAS threads"
        f" {machine['blas_threads'] or 'not limited'}; "
        + ", ".join(f"{name} {number}" for name, number in machine["versions"].items())
        + ".",
    ]
    doubt = (
        [f"the load was {machine['load']} on {machine['cores']} cores"] if machine["load"] > machine["cores"] else []
    )
    doubt += [] if machine["blas_threads"] == "1" else ["BLAS was not limited to one thread"]
    if doubt:
        lines.append(f"Step times are not to be trusted: {', and '.join(doubt)}.")
    lines += [f"{row.name} failed: {row.failure}" for row in failed[:20]]
    return [*lines, f"{len(failed) - 20} more failed."] if len(failed) > 20 else lines


def _markdown(rows: Sequence[RunRow], about: dict[str, Any], sections: Sequence[_Section]) -> str:
    parts = ["# Sweep", *_intro(rows, about)]
    for each in sections:
        parts += [f"## {each.title}", markdown_table(each.headings, each.lines)]
        parts += ["Logs: " + ", ".join(f"[{log}]({log})" for log in each.logs)] if each.logs else []
    return "\n\n".join(parts) + "\n"


_STYLE = """
body{font:16px/1.5 system-ui,sans-serif;color:#111;background:#fff;max-width:1100px;margin:0 auto;padding:1rem}
h1{font-size:1.5rem}h2{font-size:1.2rem;margin-top:2.5rem;border-top:1px solid #bbb;padding-top:1rem}
.wide{overflow-x:auto}table{border-collapse:collapse;font-size:.85rem;font-variant-numeric:tabular-nums}
th,td{padding:.25rem .6rem;text-align:right;white-space:nowrap;border-bottom:1px solid #ddd}
th:first-child,td:first-child,th:nth-child(2),td:nth-child(2){text-align:left}
th{border-bottom:2px solid #555}figure{margin:1.5rem 0;overflow-x:auto}
figure svg{width:100%;min-width:560px;height:auto}figcaption{font-size:.85rem;color:#333}
details{font-size:.85rem}a{color:#003a7d;overflow-wrap:anywhere}
"""


def _html(rows: Sequence[RunRow], about: dict[str, Any], sections: Sequence[_Section]) -> str:
    safe = html.escape
    parts = [f"<p>{safe(text)}</p>" for text in _intro(rows, about)]
    for each in sections:
        head = "".join(f"<th>{safe(cell)}</th>" for cell in each.headings)
        body = "".join("<tr>" + "".join(f"<td>{safe(cell)}</td>" for cell in row) + "</tr>" for row in each.lines)
        parts.append(f"<h2>{safe(each.title)}</h2><div class=wide><table><tr>{head}</tr>{body}</table></div>")
        parts += [
            f"<figure>{_own_ids(picture)}<figcaption>{safe(text)}</figcaption></figure>"
            for picture, text in each.pictures
        ]
        if each.logs:
            links = ", ".join(f'<a href="{safe(log)}">{safe(log)}</a>' for log in each.logs)
            parts.append(f"<details><summary>{len(each.logs)} logs</summary>{links}</details>")
    start = '<!doctype html><html lang="en"><head><meta charset="utf-8">'
    view = '<meta name="viewport" content="width=device-width,initial-scale=1"><title>Sweep</title>'
    return f"{start}{view}<style>{_STYLE}</style></head><body><h1>Sweep</h1>{''.join(parts)}</body></html>"


def _own_ids(picture: str) -> str:
    """Return an SVG whose ids no other of the page has: references to them would end in the first."""
    mark = f"p{crc32(picture.encode()):x}-"
    for before in ('id="', 'href="#', "url(#"):
        picture = picture.replace(before, before + mark)
    return picture
