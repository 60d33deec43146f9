"""inspected: what logs hold, their figures recomputed, and their worst moments."""

import ast
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from operator import eq, ge, gt, le, lt, ne
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from koopmpc.bench.results import reached
from koopmpc.control.move import Fallback, Status
from koopmpc.errors import DataError, KoopmpcError, LogError
from koopmpc.loop.metrics import Metrics, beyond, duration, metrics
from koopmpc.loop.run import Run
from koopmpc.recording.model import ModelLog, load_model_log
from koopmpc.recording.reader import load_run
from koopmpc.recording.recorder import record
from koopmpc.validate.text import plain_table

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
    model: ModelLog | None = None

    def __str__(self) -> str:
        """Return the figures, a line each, and the moments."""
        figures = str(self.metrics) if self.model is None else _figures(self.model)
        lines = [figures] + ([f"cut: {self.cut}"] if self.cut else [])
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
    """Return what the log of a model holds; None where the log is none."""
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
    """Return one line for each log; logs of one name are told apart by their folders."""
    names = [each.path.name for each in found]
    shown = [
        f"{each.path.parent.name}/{name}" if names.count(name) > 1 else name
        for each, name in zip(found, names, strict=True)
    ]
    lines = plain_table(f"{len(found)} logs", ())
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
            lines.add_row(name, *cells, duration(own.solve_time_max), "cut" if each.cut else "")
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
