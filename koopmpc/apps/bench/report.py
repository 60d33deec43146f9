"""What a sweep found, in tables for a terminal, and by `write_report` as one HTML file, as Markdown and as CSV."""

import csv
import io
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from koopmpc.apps.bench.store import ORACLE, RunRow, load_rows, manifest_of
from koopmpc.base import disk
from koopmpc.base.page import Page, PagePart
from koopmpc.base.terminal import build_plain_table
from koopmpc.base.text import format_duration
from koopmpc.control.move import Fallback, Status
from koopmpc.loop.metrics import Metrics
from koopmpc.loop.run import Run
from koopmpc.views.figures.reports import draw_attraction, draw_profiles, draw_step_times, draw_trajectories
from koopmpc.views.figures.style import render_svg
from koopmpc.views.recording.description import STATUS_WORDS
from koopmpc.views.recording.reader import load_run

LEGEND = "cost: of the run; ratio: to nonlinear-mpc's, which knows the equations; off: error at the end."
TIMES = "p50, p99: time of a step, in Python. `koopmpc explain WORD` explains every word, for example free."
BELOW = "A ratio below 1: nonlinear-mpc is not optimal there. See `koopmpc explain {case}`."
UNDER_FAULTS = "under faults: cost over that without the fault (steps that fell back). See `koopmpc explain WORD`."


def results_table(rows: Sequence[RunRow]) -> RenderableType:
    """Return one table for each case, each failure in full and once, and what the columns mean, within 100 columns."""
    cases = groupby(rows, key=lambda row: (row.problem, row.case))
    return Group(*(case_table(list(group)) for _, group in cases), explain_results(rows))


def case_table(rows: Sequence[RunRow], unit: str = "s") -> RenderableType:
    """Return the table of the runs of one case, and the one under faults; `unit` is that of the plant's time."""
    title = f"{rows[0].problem}:{rows[0].case}"
    table = _case(title, [row for row in rows if row.fault is None], unit)
    broken = any(row.fault is not None for row in rows)
    return Group(table, _under_faults(f"{title} under faults", rows)) if broken else table


def explain_results(rows: Sequence[RunRow]) -> RenderableType:
    """Return each failure in full and once, and what the columns mean."""
    failed: dict[str, list[str]] = {}
    for row in rows:
        if row.failure is not None:
            what = " ".join(filter(None, (f"{row.problem}:{row.case}", row.controller, row.fault)))
            failed.setdefault(row.failure, []).append(what)
    parts = [Text(f"{', '.join(which)}: {failure}", style="red") for failure, which in failed.items()]
    broken = any(row.fault is not None for row in rows)
    better = _find_better(rows)
    if better is not None:
        parts.append(Text(BELOW.format(case=better)))
    return Group(*parts, Text(f"{LEGEND}\n{UNDER_FAULTS if broken else TIMES}", style="dim"))


def _find_better(rows: Sequence[RunRow], *, share: float = 0.9) -> str | None:
    """Return the first case, as ``"problem:case"``, in which a cost is below this share of nonlinear-mpc's."""
    costs = [(f"{row.problem}:{row.case}", row.metrics.cost, row) for row in rows if row.metrics and not row.fault]
    oracles = {case: cost for case, cost, row in costs if row.controller == ORACLE}
    return next((case for case, cost, _ in costs if cost < share * oracles.get(case, -np.inf)), None)


def _case(title: str, rows: list[RunRow], unit: str) -> Table:
    lines = build_plain_table(title, (), padding=(0, 0, 0, 1))
    lines.add_column("controller", no_wrap=True)
    violated = any(row.metrics is not None and row.metrics.violation > 0 for row in rows)
    for heading in ("cost", "ratio", "settles", "off", *["over"] * violated, "p50", "p99"):
        lines.add_column(heading, justify="right", no_wrap=True)
    lines.add_column("steps")
    oracle = next((row.metrics.cost for row in rows if row.controller == ORACLE and row.metrics), np.nan)
    for row in rows:
        if row.metrics is None:
            lines.add_row(row.controller, "raised", style="red")
        else:
            cells = _run_cells(row, row.metrics, oracle, violated, unit)
            lines.add_row(row.controller, *cells, style="red" if row.failure else None)
    learned = max((row.training_time for row in rows), default=0.0)
    if learned:
        lines.caption = f"Koopman model learned from data in {format_duration(learned)}"
        lines.caption_justify = "left"
    return lines


def _run_cells(row: RunRow, figures: Metrics, oracle: float, violated: bool, unit: str) -> Iterator[str]:
    """Yield the cells of a run after the controller's name."""
    yield f"{figures.cost:.1f}" if figures.cost < 1e5 else f"{figures.cost:.2g}"
    ratio = figures.cost / oracle if oracle > 0 else np.nan
    yield "–" if np.isnan(ratio) else f"{ratio:.3f}" if ratio < 100 else f"{ratio:.1g}"
    if np.isnan(figures.settling_time) and np.isfinite(figures.cost):
        yield "starts there"
    elif not row.reached:
        yield "does not reach"
    else:
        yield f"{figures.settling_time:.2f} {unit}" if np.isfinite(figures.settling_time) else "within 5 %"
    yield f"{np.abs(figures.final_error).max():.1g}"
    if violated:
        yield f"{figures.violation:.2g}"
    yield format_duration(figures.solve_time_p50)
    yield format_duration(figures.solve_time_p99)
    counts = ", ".join(f"{count} {STATUS_WORDS[Status[name]]}" for name, count in figures.status.items())
    yield counts + ("" if figures.unknown is None else f"; {figures.unknown} unknown")


def _under_faults(title: str, rows: Sequence[RunRow]) -> Table:
    """Return a table of the runs of one case with a line for each controller, relative to its run without faults."""
    whole = {row.controller: row for row in rows if row.fault is None}
    found = {(row.fault, row.controller): row for row in rows if row.fault is not None}
    # Without padding the box still has a blank between columns.
    lines = build_plain_table(title, (), min_width=len(title), padding=0, show_edge=False)
    faults = list(dict.fromkeys(fault for fault, _ in found))
    lines.add_column("controller", no_wrap=True)
    for fault in faults:
        lines.add_column(str(fault).replace("-", "\n"), justify="right", no_wrap=True)
    for name, own in whole.items():
        cells = [_cell(found[fault, name], own) for fault in faults]
        failed = any(found[fault, name].failure for fault in faults)
        lines.add_row(name, *cells, style="red" if failed else None)
    return lines


def _cell(row: RunRow, whole: RunRow) -> str:
    """Return the cell of a run under a fault: its cost over that of the run without the fault, or a word."""
    if row.metrics is None:
        return "raised"
    if not row.reached:
        word = "lost" if whole.reached else "–"
    elif whole.metrics is not None and whole.metrics.cost > 0:
        ratio = row.metrics.cost / whole.metrics.cost
        word = f"{ratio:.3f}" if ratio < 100 else f"{ratio:.1g}"
    else:
        word = "reaches"
    fell_back = sum(count for name, count in row.metrics.fallback.items() if name != "NONE")
    return f"{word} ({fell_back})" if fell_back else word


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
    from scipy.special import betaincinv

    ordered = np.sort(values[np.isfinite(values)])
    n = len(ordered)
    if not n:
        return float("nan"), float("nan"), float("nan")
    low, high = (
        ordered[int(np.ceil(n * betaincinv(m, n - m + 1, share))) - 1]
        for share, m in zip((0.025, 0.975), ((n + 1) // 2, n // 2 + 1), strict=True)
    )
    return float(np.median(ordered)), float(low), float(high)


def condition_of(row: RunRow) -> str:
    """Return what is not as usual in a run, "–" where all is."""
    parts = [row.fault or "", f"noise {row.noise:g}" if row.noise else "", f"wrong {row.wrong:g}" if row.wrong else ""]
    return ", ".join(filter(None, parts)) or "–"


def summaries(rows: Sequence[RunRow]) -> list[Summary]:
    """Return a summary for each case, condition and controller."""
    best = {_pair(row): row.metrics.cost for row in rows if row.controller == ORACLE and row.metrics is not None}
    groups: dict[tuple[str, str, str], list[RunRow]] = {}
    for row in rows:
        groups.setdefault((f"{row.problem}:{row.case}", condition_of(row), row.controller), []).append(row)
    return [_summarise(key, own, best) for key, own in groups.items()]


def _summarise(key: tuple[str, str, str], rows: Sequence[RunRow], best: Mapping[tuple[Any, ...], float]) -> Summary:
    """Return the summary of these runs; `best` holds the costs of nonlinear-mpc by `_pair`."""
    ended = [row for row in rows if row.metrics is not None]
    figures = [row.metrics for row in ended if row.metrics is not None]
    costs, oracle = np.array([each.cost for each in figures]), np.array([best.get(_pair(row), np.nan) for row in ended])
    with np.errstate(all="ignore"):
        ratios = np.where(oracle > 0, costs / oracle, np.nan)
    steps = sum(sum(each.status.values()) for each in figures)
    kept = sum(each.fallback.get(Fallback.NONE.name, 0) for each in figures)
    return Summary(
        *key,
        runs=len(rows),
        failed=sum(row.failure is not None for row in rows),
        reached=sum(row.reached for row in rows) / len(rows),
        **dict(zip(("cost", "cost_low", "cost_high"), median_interval(costs), strict=True)),
        **dict(zip(("ratio", "ratio_low", "ratio_high"), median_interval(ratios), strict=True)),
        violation=_median([each.violation for each in figures]),
        worst_violation=float(np.max([each.violation for each in figures], initial=0.0)),
        fell_back=1.0 - kept / steps if steps else float("nan"),
        p50=_median([each.solve_time_p50 for each in figures]),
        p99=_median([each.solve_time_p99 for each in figures]),
        cold_p50=_median([row.cold_p50 for row in rows if np.isfinite(row.cold_p50)]),
    )


def _median(values: Sequence[float]) -> float:
    """Return the median, NaN of no values."""
    return float(np.median(values)) if values else float("nan")


def _pair(row: RunRow) -> tuple[Any, ...]:
    """Return what two controllers' runs have in common."""
    return (row.problem, row.case, row.fault, row.noise, row.wrong, row.start)


_HEADINGS = ("controller", "condition", "runs", "reach", "cost", "ratio", "over", "fell back", "p50", "p99", "cold")
_WHOLE = ("controller", "runs", "reach", "p50", "p99", "cold")  # columns of a terminal that are not wrapped


def _summary_cells(own: Summary) -> tuple[str, ...]:
    def between(middle: float, low: float, high: float) -> str:
        if np.isnan(middle):
            return "–"
        return f"{middle:.4g}" + (f" [{low:.4g}, {high:.4g}]" if own.runs > 1 else "")

    def time(value: float) -> str:
        return "–" if np.isnan(value) else format_duration(value)

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


def build_summary_table(rows: Sequence[RunRow]) -> Group:
    """Return the summaries as tables for a terminal, one for each case; columns in which all is 0 or – are left out."""
    parts: list[Table] = []
    for case, group in groupby(summaries(rows), key=lambda each: each.case):
        found = list(group)
        cells = np.array([_summary_cells(own) for own in found])
        told = [i for i in range(len(_HEADINGS)) if i == 0 or not np.isin(cells[:, i], ("0", "–")).all()]
        lines = build_plain_table(case, (), padding=(0, 0, 0, 1))
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
    with disk.writing(folder / "summary.csv") as stream:
        stream.write(table.getvalue().encode())
    page = Page(folder, title="Sweep")
    page.parts.append(PagePart("# Sweep"))
    page.text(*_intro(rows, about))
    cases = [(title, list(group)) for title, group in groupby(found, key=lambda each: each.case)]
    for title, group in cases:
        own = [row for row in rows if f"{row.problem}:{row.case}" == title]
        page.heading(title)
        page.table(_HEADINGS, [_summary_cells(summary) for summary in group], words=True)
        page.pictures(_draw_case(own, folder))
        if logs := [row.log.name for row in own if row.log is not None and row.log.is_file()]:
            page.links("logs", logs)
    page.heading("All cases")
    page.table(("case", "controller", "steps", "how steps ended"), list(_statuses(rows)), words=True)
    page.pictures(_profile(rows) if len(cases) > 1 else ())
    page.write()
    return page.write("report.html")


def _draw_case(own: Sequence[RunRow], folder: Path, *, most: int = 12, starts: int = 10) -> Iterable[tuple[str, str]]:
    """Yield pictures of the runs of one case as SVG with their captions.

    At most `most` runs lie over one another, and a map of starts is drawn of controllers with at least `starts` runs.
    """
    yield from _profile(own)
    usual = [row for row in own if condition_of(row) == "–"] or own
    measured = [row for row in usual if row.metrics is not None]
    ended = {row.controller: [each for each in measured if each.controller == row.controller] for row in own}
    hot = {name: np.array([r.metrics.solve_time_p50 for r in rows if r.metrics]) for name, rows in ended.items()}
    cold = {name: np.array([row.cold_p50 for row in rows]) for name, rows in ended.items()}
    times = "Time of a step: median over runs, middle half, and 5 to 95 %; × with cold caches."
    yield render_svg(draw_step_times(hot, cold)), times
    paths = [(row.controller, folder / f"{row.name}.rrd") for row in usual if row.start == row.seed == 0]
    logs = [(name, path) for name, path in paths if path.is_file()]
    runs = {name: load_run(path) for name, path in logs[:most]}
    many = {name: rows for name, rows in ended.items() if len(rows) >= starts}
    alone = ", without noise and with the plant as it is" * (len(usual) != len(own))
    if many and len(next(iter(many.values()))[0].x0) > 1:
        yield _draw_starts(many, runs), f"Initial states that reach their reference, and not{alone}."
    if runs:
        yield render_svg(draw_trajectories(runs)), "The case's own start."


def _draw_starts(rows: Mapping[str, Sequence[RunRow]], runs: Mapping[str, Run]) -> str:
    """Return a map of starts over the two states that differ most among them; a run knows their names."""
    named = next(iter(runs.values())).states if runs else ()
    starts = {name: np.array([row.x0 for row in own]) for name, own in rows.items()}
    spread = np.ptp(np.vstack(list(starts.values())), axis=0)
    shown = np.sort(np.argsort(-spread, kind="stable")[:2])
    states: list[str] = [*named, *(f"state {k}" for k in range(len(named), len(spread)))]
    mapped = {name: (starts[name][:, shown], np.array([row.reached for row in own])) for name, own in rows.items()}
    return render_svg(draw_attraction(mapped, [states[int(k)] for k in shown]))


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
        made = draw_profiles({name: np.array(values) for name, values in ratios.items()})
        yield (
            render_svg(made),
            "Performance profile: the share of runs whose cost is within τ of the best controller's.",
        )


def _statuses(rows: Sequence[RunRow]) -> Iterable[tuple[str, ...]]:
    """Yield how the steps of each case and controller ended, over all runs."""
    groups: dict[tuple[str, str], Counter[str]] = {}
    for row in rows:
        counts = groups.setdefault((f"{row.problem}:{row.case}", row.controller), Counter())
        if row.metrics is not None:
            counts.update(row.metrics.status)
    for key, counts in groups.items():
        total = counts.total()
        parts = [f"{100 * n / total:.3g} % {STATUS_WORDS[Status[name]]}" for name, n in counts.items() if n]
        yield *key, str(total), ", ".join(parts)


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
    doubt = [f"the load was {machine['load']} on {machine['cores']} cores"] * (machine["load"] > machine["cores"])
    doubt += ["BLAS was not limited to one thread"] * (machine["blas_threads"] != "1")
    if doubt:
        lines.append(f"Step times are not to be trusted: {', and '.join(doubt)}.")
    lines += [f"{row.name} failed: {row.failure}" for row in failed[:20]]
    return [*lines, f"{len(failed) - 20} more failed."] if len(failed) > 20 else lines
