"""What finished runs say: `inspect_logs`, a log and its worst moments; `compare_runs`, what got worse from A to B."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from rich.table import Table

from koopmpc.apps.bench.row_filter import RowFilter
from koopmpc.apps.bench.store import RunRow, load_rows, reached
from koopmpc.base import checks
from koopmpc.base.errors import KoopmpcError, LogError
from koopmpc.base.terminal import build_plain_table
from koopmpc.base.text import format_duration
from koopmpc.control.move import Fallback, Status
from koopmpc.loop.metrics import Metrics, beyond, find_late, metrics
from koopmpc.loop.run import Run
from koopmpc.views.recording.model import ModelLog, load_model_log
from koopmpc.views.recording.reader import load_run
from koopmpc.views.recording.writer import record

_MOST = 5  # moments of one kind that are named
SURE = 0.05  # a regression needs a p below this where there are enough pairs to reach it
_ENOUGH = 6  # pairs from which the signed-rank test can reach SURE


class Moment(NamedTuple):
    """A step to go to: what happened at which time."""

    k: int
    time: float
    what: str

    def __str__(self) -> str:
        """Return time, step and what happened in one line."""
        return f"{self.time:9.3f} s  step {self.k:<6} {self.what}"


@dataclass(frozen=True, eq=False)
class Inspected:
    """One log: what ran, its figures, its worst moments; `cut` says what is missing, `refused` why it is not read."""

    path: Path
    title: str
    values: Mapping[str, Any]
    metrics: Metrics | None = None
    moments: tuple[Moment, ...] = ()
    cut: str | None = None
    refused: str | None = None
    repaired: Path | None = None
    model: ModelLog | None = None

    def __str__(self) -> str:
        """Return the figures, a line each, and the moments."""
        figures = str(self.metrics) if self.model is None else _figures(self.model)
        lines = [figures] + ([f"cut: {self.cut}"] if self.cut else [])
        return "\n".join([*lines, "", "worst moments", *map(str, self.moments)])


def inspect_logs(logs: Sequence[str | Path], where: str | None = None, *, repair: bool = False) -> Iterator[Inspected]:
    """Yield what each log holds, folders by their .rrd files.

    Parameters
    ----------
    logs
        Paths of logs, or of folders.
    where
        Which logs are of interest: comparisons of figures and names, ``"violation > 0.01 and controller == 'lqr'"``.
    repair
        Write a log that was cut, as far as it is whole, to <name>.repaired.rrd beside it.

    Raises
    ------
    DataError
        `where` is no such comparison.
    LogError
        There is no log.
    """
    wanted = None if where is None else RowFilter(where)
    paths = [
        path for given in map(Path, logs) for path in (sorted(given.rglob("*.rrd")) if given.is_dir() else [given])
    ]
    if not paths:
        raise LogError(f"there is no log in {', '.join(map(str, logs))}; pass the .rrd of a run, or a folder of them")
    for path in paths:
        found = _inspect(path, repair=repair)
        if wanted is None or (found.refused is None and wanted.holds(found.values)):
            yield found


def _inspect(path: Path, *, repair: bool) -> Inspected:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            run = load_run(path)
            figures = metrics(run)
        except KoopmpcError as error:
            return _of_model(path) or Inspected(path, str(path), {}, refused=str(error))
    cut = next((str(each.message) for each in told if issubclass(each.category, UserWarning)), None)
    repaired = None
    if repair and cut is not None:
        repaired = path.with_name(f"{path.stem}.repaired.rrd")
        record(run, repaired)
    names = {key: str(run.metadata[key]) for key in ("problem", "case", "controller", "fault") if key in run.metadata}
    title = " ".join(names.values()) or str(path)
    return Inspected(path, title, _values(run, figures, names), figures, worst_moments(run), cut, repaired=repaired)


def _of_model(path: Path) -> Inspected | None:
    """Return what the log of a model holds; None if the file is not a log."""
    try:
        model = load_model_log(path)
    except LogError:
        return None  # what `load_run` said of it stands
    found: list[Moment] = []
    for i, state in enumerate(model.states):
        errors = {r: np.abs(p - truth) for (r, j), (p, truth, _) in model.forecasts.items() if j == i}
        if errors:
            r = max(errors, key=lambda each: float(np.nanmax(errors[each], initial=-1.0)))
            k = int(np.nanargmax(errors[r]))
            found.append(Moment(k, k * model.dt, f"largest error of {state}: {errors[r][k]:.4g}, episode {r}"))
    for (r, i), (_, truth, band) in model.forecasts.items():
        outside = np.zeros(0, bool) if band is None else (truth < band[:, 0]) | (truth > band[:, 1])
        if outside.any():
            k = int(np.argmax(outside))
            found.append(Moment(k, k * model.dt, f"{model.states[i]} leaves its band, episode {r}"))
    radius = {"spectral_radius": float(model.facts["spectral radius"])}
    return Inspected(
        path, f"model of {', '.join(model.states)}", _NONE | radius, moments=tuple(sorted(found)), model=model
    )


def _figures(model: ModelLog) -> str:
    """Return what the model is, and its errors one step, half of the horizon and the whole horizon ahead."""
    lines = [f"{name:<25} {value}" for name, value in model.facts.items()]
    for state, errors in zip(model.states, model.errors, strict=True):
        ahead = sorted({1, (len(errors) + 1) // 2, len(errors)})
        words = ", ".join(f"{errors[n - 1]:.3g} after {n}" for n in ahead)
        lines.append(f"{'error of ' + state:<25} {words} step{'s' * (len(errors) > 1)}")
    return "\n".join(lines)


_NONE: dict[str, Any] = {
    **dict.fromkeys(("problem", "case", "controller", "fault"), ""),
    **dict.fromkeys(("steps", "fallbacks", "reached", "unknown", "spectral_radius"), float("nan")),
    **{
        field.name: float("nan")
        for field in fields(Metrics)
        if field.type in ("float", "int", "int | None", float, int)
    },
}  # figures that a log does not have: no comparison with NaN holds


def _values(run: Run, figures: Metrics, names: Mapping[str, str]) -> dict[str, Any]:
    """Return what `--where` may ask for."""
    scalars = {name: value for name, value in vars(figures).items() if isinstance(value, int | float)}
    fell = sum(count for name, count in figures.fallback.items() if name != Fallback.NONE.name)
    more = {"steps": run.steps, "fallbacks": fell, "reached": reached(run), "unknown": figures.unknown or 0}
    return {**_NONE, **names, **scalars, **more}


@np.errstate(invalid="ignore", over="ignore")
def worst_moments(run: Run) -> tuple[Moment, ...]:
    """Return the largest violation, the slowest step, and where fallbacks, unknown and late steps begin, by time."""
    found: list[Moment] = []

    def at(k: int, what: str) -> None:
        found.append(Moment(k, k * run.dt, what))

    excess = beyond(run)
    if excess.size and np.nanmax(excess, initial=0.0) > 0:
        k = int(np.nanargmax(excess))
        at(k, f"largest violation: {excess[k]:.4g}")
    k = int(np.argmax(run.solve_time))
    at(k, f"slowest step: {format_duration(float(run.solve_time[k]))}, {run.status[k].name}")
    fell: tuple[Fallback, ...] = run.fallback
    ended: tuple[Status, ...] = run.status
    masks = {
        "fallback": np.array([each is not Fallback.NONE for each in run.fallback]),
        "unknown state": run.known == 0,
        "later than dt": find_late(run),
    }
    for name, mask in masks.items():
        begins = np.flatnonzero(mask & ~np.concatenate([[False], mask[:-1]]))
        for k in map(int, begins[:_MOST]):
            length = int(np.argmin(np.append(mask[k:], False)))
            more = f"{fell[k].name} after {ended[k].name}, " if name == "fallback" else ""
            at(k, f"{name}: {more}{length} step{'s' * (length > 1)}")
        if len(begins) > _MOST:
            at(int(begins[_MOST]), f"{name}: {len(begins) - _MOST} more times from here on")
    return tuple(sorted(found))


def inspection_table(found: Sequence[Inspected]) -> Table:
    """Return one line for each log; logs of one name are distinguished by their folders."""
    names = [each.path.name for each in found]
    shown = [
        f"{each.path.parent.name}/{name}" if names.count(name) > 1 else name
        for each, name in zip(found, names, strict=True)
    ]
    lines = build_plain_table(f"{len(found)} logs", ())
    lines.add_column("log", overflow="fold")
    for heading in ("cost", "violation", "late", "fell back", "slowest", ""):
        lines.add_column(heading, justify="right", no_wrap=True)
    for each, name in zip(found, shown, strict=True):
        if each.refused is not None:
            lines.add_row(name, "refused", style="red")
        elif each.metrics is None:
            lines.add_row(name, *("–",) * 5, "model")
        else:
            own = each.metrics
            cells = (f"{own.cost:.5g}", f"{own.violation:.2g}", str(own.late), str(each.values["fallbacks"]))
            lines.add_row(name, *cells, format_duration(own.solve_time_max), "cut" if each.cut else "")
    return lines


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
    """What `compare_runs` found; `regressions` are the pairs in which B is worse."""

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
        lines = build_plain_table("B / A", ("run",), ("figure", "pairs", "median B / A", "p", "lost", ""))
        for each in self.pairs:
            p = "–" if np.isnan(each.p) else f"{each.p:.2g}"
            cells = (each.figure, str(each.shared), f"{each.ratio:.4g}", p, str(each.lost))
            lines.add_row(each.what, *cells, "worse" if each.worse else "", style="red" if each.worse else None)
        return lines

    def __str__(self) -> str:
        """Return the verdict in one line."""
        alone = (
            f"; {self.alone} run{' is' if self.alone == 1 else 's are'} in one of the two only" if self.alone else ""
        )
        compared = f"{len(self.pairs)} comparison{'' if len(self.pairs) == 1 else 's'}"
        worse = len(self.regressions)
        if not worse:
            return f"no regression beyond {self.threshold:.1%} in {compared}{alone}"
        return f"{worse} of {compared} {'is' if worse == 1 else 'are'} worse by more than {self.threshold:.1%}{alone}"


def compare_runs(a: str | Path, b: str | Path, *, threshold: float = 0.02, times: bool = False) -> Compared:
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
        One of them holds no sweep and is not a log, or they have no run in common.
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
        found.extend(_compare_figure(what, figure, pairs, threshold) for figure in figures)
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


def _compare_figure(what: str, figure: str, pairs: list[tuple[RunRow, RunRow]], threshold: float) -> Pairs:
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
