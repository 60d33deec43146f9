"""inspected: what logs hold, their figures recomputed, and their worst moments; replayed: the same run again."""

import ast
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import eq, ge, gt, le, lt, ne
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from koopmpc.bench.controllers import Prepared
from koopmpc.bench.library import load_problem
from koopmpc.bench.results import RunRow, reached
from koopmpc.bench.single import closed_loop
from koopmpc.bench.table import plain_table
from koopmpc.control.move import Fallback, Status
from koopmpc.errors import DataError, KoopmpcError, LogError, ProblemError
from koopmpc.loop.metrics import Metrics, beyond, duration, metrics
from koopmpc.loop.run import Run
from koopmpc.recording.format.reader import load_run
from koopmpc.recording.recorder import record

_MOST = 5  # moments of one kind that are named


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

    def __str__(self) -> str:
        """Return the figures, a line each, and the moments."""
        lines = [str(self.metrics)] + ([f"cut: {self.cut}"] if self.cut else [])
        return "\n".join([*lines, "", "worst moments", *map(str, self.moments)])


def inspected(logs: Sequence[str | Path], where: str | None = None, *, repair: bool = False) -> Iterator[Inspected]:
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
    wanted = None if where is None else Where(where)
    paths = [
        path for given in map(Path, logs) for path in (sorted(given.rglob("*.rrd")) if given.is_dir() else [given])
    ]
    if not paths:
        raise LogError(f"there is no log in {', '.join(map(str, logs))}; pass the .rrd of a run, or a folder of them")
    for path in paths:
        found = _inspected(path, repair=repair)
        if wanted is None or (found.refused is None and wanted.holds(found.values)):
            yield found


def _inspected(path: Path, *, repair: bool) -> Inspected:
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            run = load_run(path)
            figures = metrics(run)
        except KoopmpcError as error:
            return Inspected(path, str(path), {}, refused=str(error))
    cut = next((str(each.message) for each in told if issubclass(each.category, UserWarning)), None)
    repaired = None
    if repair and cut is not None:
        repaired = path.with_name(f"{path.stem}.repaired.rrd")
        record(run, repaired)
    names = {key: str(run.metadata[key]) for key in ("problem", "case", "controller", "fault") if key in run.metadata}
    title = " ".join(names.values()) or str(path)
    return Inspected(path, title, _values(run, figures, names), figures, worst_moments(run), cut, repaired=repaired)


def _values(run: Run, figures: Metrics, names: Mapping[str, str]) -> dict[str, Any]:
    """Return what `--where` may ask for."""
    scalars = {name: value for name, value in vars(figures).items() if isinstance(value, int | float)}
    fell = sum(count for name, count in figures.fallback.items() if name != Fallback.NONE.name)
    more = {"steps": run.steps, "fallbacks": fell, "reached": reached(run), "unknown": figures.unknown or 0}
    return {"problem": "", "case": "", "controller": "", "fault": "", **names, **scalars, **more}


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
    at(k, f"slowest step: {duration(float(run.solve_time[k]))}, {run.status[k].name}")
    fell: tuple[Fallback, ...] = run.fallback
    ended: tuple[Status, ...] = run.status
    masks = {
        "fallback": np.array([each is not Fallback.NONE for each in run.fallback]),
        "unknown state": run.known == 0,
        "later than dt": run.solve_time > run.dt,
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
    """Return one line for each log."""
    lines = plain_table(f"{len(found)} logs")
    lines.add_column("log", overflow="fold")
    for heading in ("cost", "violation", "late", "fell back", "slowest", ""):
        lines.add_column(heading, justify="right", no_wrap=True)
    for each in found:
        if each.metrics is None:
            lines.add_row(each.path.name, "refused", style="red")
        else:
            own = each.metrics
            cells = (f"{own.cost:.5g}", f"{own.violation:.2g}", str(own.late), str(each.values["fallbacks"]))
            lines.add_row(each.path.name, *cells, duration(own.solve_time_max), "cut" if each.cut else "")
    return lines


class Where:
    """Comparisons of figures and names with numbers and texts, joined by and, or, not; no code is run.

    Raises
    ------
    DataError
        The text is something else.
    """

    def __init__(self, text: str) -> None:
        self.text = text
        try:
            self._tree = ast.parse(text, mode="eval").body
        except (SyntaxError, ValueError) as error:
            raise DataError(f'--where "{text}" is no comparison; write for example "violation > 0.01"') from error

    def holds(self, values: Mapping[str, Any]) -> bool:
        """Return whether it holds for these figures."""
        return bool(self._value(self._tree, values))

    def _value(self, node: ast.expr, values: Mapping[str, Any]) -> Any:
        match node:
            case ast.Constant(value=value):
                return value
            case ast.Name(id=name):
                if name not in values:
                    raise DataError(
                        f'--where "{self.text}": there is no figure {name!r}; there are {", ".join(values)}'
                    )
                return values[name]
            case ast.UnaryOp(op=ast.Not(), operand=inner):
                return not self._value(inner, values)
            case ast.UnaryOp(op=ast.USub(), operand=inner):
                return -self._value(inner, values)
            case ast.BoolOp(op=op, values=parts):
                every = (bool(self._value(part, values)) for part in parts)
                return all(every) if isinstance(op, ast.And) else any(every)
            case ast.Compare(left=left, ops=ops, comparators=rest):
                sides = [self._value(each, values) for each in (left, *rest)]
                return all(self._compared(op, *pair) for op, *pair in zip(ops, sides[:-1], sides[1:], strict=True))
            case _:
                raise DataError(f'--where "{self.text}" holds more than comparisons, and, or, not')

    def _compared(self, op: ast.cmpop, left: Any, right: Any) -> bool:
        how = _COMPARISONS.get(type(op))
        try:
            if how is not None:
                return how(left, right)
        except TypeError as error:
            raise DataError(f'--where "{self.text}" compares {left!r} with {right!r}') from error
        raise DataError(f'--where "{self.text}" holds more than comparisons, and, or, not')


_COMPARISONS: dict[type[ast.cmpop], Callable[[Any, Any], bool]] = {
    ast.Lt: lt, ast.LtE: le, ast.Gt: gt, ast.GtE: ge, ast.Eq: eq, ast.NotEq: ne,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Replayed:
    """The run of a log and the same run made again; `differences` names what is not the same to the bit."""

    logged: Run
    run: Run
    differences: tuple[str, ...]

    def __str__(self) -> str:
        """Return whether they are the same, in one line or more."""
        if not self.differences:
            return f"the same to the bit: {self.run.steps} steps, states, inputs, statuses and iterations"
        return "not the same: " + "\n".join(self.differences)


def replayed(log: str | Path) -> Replayed:
    """Run again what a log of `koopmpc run` or `koopmpc bench` holds: same problem, data, start, noise and faults.

    Raises
    ------
    LogError
        The log cannot be read, or does not say which problem ran.
    ProblemError
        The problem's file is no longer there, or has no such case.
    """
    logged = load_run(log)
    known = logged.metadata
    if not {"problem", "case", "controller"} <= known.keys() or "training" not in known:
        raise LogError(f"{log} does not say which problem, case and controller ran; logs of `koopmpc run` do")
    file = str(known.get("file", ""))
    problem = load_problem(f"{file if Path(file).is_file() else known['problem']}:{known['case']}")
    own: dict[str, Any] = dict(known.get("sweep", {}))
    row = RunRow(problem.name, str(known["case"]), str(known["controller"]), fault=known.get("fault"))
    row = replace(row, **{name: type(getattr(row, name))(value) for name, value in own.items()})
    trained = known["training"]["seed"] - row.seed
    if trained != problem.training.seed:
        raise ProblemError(f"{problem.name} trains with seed {problem.training.seed}, the log's run did with {trained}")
    parts = Prepared(problem, row.seed, monitored=bool(known.get("monitor")))
    row = replace(row, x0=tuple(parts.start(row.case, row.start).tolist()))
    run = closed_loop(parts, row, plans=logged.plans is not None, compiled=bool(known.get("compiled")))
    return Replayed(logged, run, tuple(_differences(logged, run)))


def _differences(logged: Run, run: Run) -> Iterator[str]:
    """Yield each column that differs, with the first step at which it does."""
    for name in ("X", "Y", "U", "reference", "u_reference", "slack", "iterations", "status", "fallback"):
        old, new = np.asarray(getattr(logged, name)), np.asarray(getattr(run, name))
        if old.shape != new.shape:
            yield f"{name} has shape {new.shape}, the log's {old.shape}"
        else:
            same = (old == new) | ((old != old) & (new != new))  # NaN is NaN
            if not same.all():
                yield f"{name} from step {int(np.argwhere(~same)[0][0])} on"
    if logged.plans != run.plans:
        yield "plans"
    for name in ("cost", "limits", "dt"):
        if getattr(logged, name) != getattr(run, name):
            yield f"{name}: the problem has changed since"
