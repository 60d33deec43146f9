"""sweep: problems × controllers × starts × seeds × noise × wrong parameters × faults, into a store that survives."""

import json
import pickle
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, fields, is_dataclass, replace
from functools import lru_cache, partial
from itertools import groupby, product
from pathlib import Path
from typing import Any, NamedTuple, cast
from uuid import uuid4

import numpy as np

from koopmpc.apps.bench.controllers import Prepared, controller_names, is_learned
from koopmpc.apps.bench.options import SweepOptions
from koopmpc.apps.bench.problem import Problem
from koopmpc.apps.bench.problem_files import load_problem
from koopmpc.apps.bench.single import FAULTS, log_run, measure_run
from koopmpc.apps.bench.store import RESULTS, RunRow, Store, open_sweep, write_results
from koopmpc.base import checks, disk
from koopmpc.base.errors import DataError, ProblemError, WorkerError, refuse_moved
from koopmpc.base.parallel import map_tasks
from koopmpc.base.values import fingerprint, to_data
from koopmpc.control.ask.limits import Limits
from koopmpc.loop.run import Run
from koopmpc.views.recording.viewer import find_viewer, why_none

MODELS = "models"  # beside the logs: what was learned
_FIRST = 5.0  # write results.parquet for the first time after this time [s]
_SHARE = 100.0  # write results.parquet again after this many times the time that writing takes
_HELD = 3.0  # let logs wait for the table of their case while its loops take less than this time [s]
_NOT_ASKED = ("workers", "scheduler", "live", "paced", "log_starts")  # options that change no figure of a run


class _Grid(NamedTuple):
    """What is the same for all runs: how to find the problems, and where and how runs are written."""

    name: str  # another one for each call of `sweep`, so that no worker takes another's controllers
    problems: dict[str, "Problem | bytes | str"]
    folder: Path
    options: SweepOptions


def sweep(
    problems: Iterable[Problem],
    controllers: Sequence[str] | None = None,
    *,
    folder: str | Path,
    options: SweepOptions | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    on_case: Callable[[list[RunRow]], None] | None = None,
    **moved: Any,
) -> list[RunRow]:
    """Run each controller on each case of each problem, and judge all by the same cost and limits.

    Runs that are finished are kept: call it again with the same arguments, after a crash or kill -9, and it goes on.
    All controllers meet the same initial states, noise and wrong parameters.

    Parameters
    ----------
    problems
        The problems; `load_problem("cart_pole:recover")` holds one case alone.
    controllers
        Some of lqr, koopman-lqr, linear-mpc, koopman-mpc, offset-free, bilinear-mpc, bilinear-offset, nonlinear-mpc,
        adaptive, pid, designed, or laws of `register_law`; by default the controllers that each problem names, where
        it names none the first eight.
    folder
        Receives sweep.sqlite, results.parquet, models/, and for runs that are logged
        <problem>-<case>-<controller>.rrd. Workers on other machines must reach it by the same path.
    options
        Which runs, where, and what is shown; `SweepOptions()` by default.
    progress
        Called with (name of the run, runs done, runs in all).
    on_case
        Called with all runs of a case when the last one has ended; cases come in their order. In this process it does
        not wait for the logs of loops that take less than three seconds: they come afterwards, after Ctrl-C, too.
    **moved
        Refused: what were keywords are fields of `options`.

    Returns
    -------
    rows
        One row for each run. An exception ends that run alone and becomes the `failure` of its row.

    Raises
    ------
    ProblemError
        There is no such controller, a case is given twice, the folder holds another sweep, or a problem cannot be sent.
    FullDiskError
        The disk is full; the runs that are finished are kept.
    """
    refuse_moved(moved, SweepOptions, "km.bench.SweepOptions")
    options = SweepOptions() if options is None else options
    folder = disk.path_of(folder)
    checks.members(problems, "problems", ("__iter__",), "pass a list of what km.load_problem returns")
    problems = list(problems)
    for problem in problems:
        checks.kind(problem, "a problem", Problem, "load it with km.load_problem")
    rows = _list_runs(problems, controllers, options)
    sent = {f"{p.name}:{case}": p if options.is_here else _sendable(p) for p in problems for case in p.cases}
    if options.live and find_viewer() is None:
        options = replace(options, live=False)
        warnings.warn(f"{why_none()}; the runs are recorded all the same", UserWarning, stacklevel=2)
    asked: dict[str, Any] = {
        "problems": [_print_of(problem) for problem in problems],
        "controllers": list(dict.fromkeys(row.controller for row in rows)),
        **{name: value for name, value in asdict(options).items() if name not in _NOT_ASKED},
    }
    grid = _Grid(uuid4().hex, dict(sent), folder.resolve(), options)
    with open_sweep(folder, asked) as store:
        shown = _Shown(rows, store, progress, on_case)
        left = [row for row in rows if row.key not in store.rows]
        shown.say(left[0].name if left else "done")
        due = time.monotonic() + _FIRST
        try:
            _learn_all(grid, asked["controllers"], left)
            here = options.is_here and on_case is not None
            for row in _run_here(grid, left, shown) if here else _send_runs(grid, left):
                shown.end(store.add(row))
                if (begin := time.monotonic()) >= due:
                    write_results(_in_order(rows, store.rows), folder / RESULTS)
                    due = begin + _SHARE * (time.monotonic() - begin)
        finally:
            write_results(_in_order(rows, store.rows), folder / RESULTS)
        return _in_order(rows, store.rows)


class _Shown:
    """What callers see of a sweep that goes on: names, numbers, and cases that have ended."""

    def __init__(
        self,
        rows: Sequence[RunRow],
        store: Store,
        progress: Callable[[str, int, int], None] | None,
        on_case: Callable[[list[RunRow]], None] | None,
    ) -> None:
        self._count, self._progress, self._on_case = len(rows), progress, on_case
        self._ended = store.rows.copy()
        self._cases = [list(group) for _, group in groupby(rows, key=_case_of)]

    def end(self, row: RunRow) -> None:
        """Show that a run has ended, whose log may still be written."""
        if row.key not in self._ended:
            self._ended[row.key] = row
            self.say(row.name if len(self._ended) < self._count else "done")

    def say(self, what: str) -> None:
        """Show what runs or has ended."""
        if self._progress is not None:
            self._progress(what.replace("-", ":", 1), len(self._ended), self._count)
        while self._on_case is not None and self._cases and all(row.key in self._ended for row in self._cases[0]):
            self._on_case(_in_order(self._cases.pop(0), self._ended))


def _list_runs(problems: Sequence[Problem], controllers: Sequence[str] | None, options: SweepOptions) -> list[RunRow]:
    """Return the runs that are asked for, without their figures."""
    asked = controller_names(controllers)
    cases = [f"{problem.name}:{case}" for problem in problems for case in problem.cases]
    twice = next((case for case in cases if cases.count(case) > 1), None)
    if twice is not None:
        raise ProblemError(f"{twice} comes twice, and its logs would have one name; run it once, or rename a file")
    rows: list[RunRow] = []
    for problem, case in ((each, case) for each in problems for case in each.cases):
        names = asked if controllers else controller_names(problem.controllers)
        broken = (None, *(possible_faults(problem.limits_of(case)) if options.faults else ()))
        for fault, n, w, seed, name in product(broken, options.noise, options.wrong, range(options.seeds), names):
            if seed and not is_learned(name):
                continue  # it learns nothing, so all seeds are one
            row = RunRow(problem.name, case, name, fault=fault, noise=n, wrong=w, seed=seed)
            rows.extend(replace(row, start=start) for start in range(options.starts))
    if any(options.wrong):
        for problem in problems:
            parts = Prepared(problem)
            for case in problem.cases:
                parts.perturb_plant(case, 0.0, 0)  # raises where there is nothing to be wrong
    return rows


def possible_faults(limits: Limits) -> tuple[str, ...]:
    """Return the names of the faults that can occur: without input limits an actuator has no range to lose."""
    limited = any(
        end is not None and np.isfinite(checks.list_values(end)).any() for end in (limits.u_min, limits.u_max)
    )
    return tuple(name for name in FAULTS if limited or name != "actuator-loss")


def _print_of(problem: Problem) -> dict[str, Any]:
    """Return what tells one problem from another, and how to load it again."""
    file = Path(problem.file) if problem.file else None
    content = file.read_bytes() if file is not None and file.is_file() else json.dumps(_tree_of(problem)).encode()
    return {"file": problem.file, "cases": list(problem.cases), "sha256": fingerprint(content)}


def _tree_of(value: Any) -> Any:
    """Return every number and name that a value holds, the same in each process."""
    try:
        return to_data(value)
    except DataError:
        if isinstance(value, Mapping):
            return [[str(key), _tree_of(item)] for key, item in cast("Mapping[Any, Any]", value).items()]
        if isinstance(value, tuple | list):
            return [_tree_of(item) for item in cast("Sequence[Any]", value)]
        if is_dataclass(value):
            return [type(value).__qualname__, *(_tree_of(getattr(value, part.name)) for part in fields(value))]
        return getattr(value, "__qualname__", type(value).__qualname__)


def _sendable(problem: Problem) -> bytes | str:
    """Return the problem as a worker gets it: its file, or a pickle.

    Raises
    ------
    ProblemError
        It has no file, and does not pickle.
    """
    if problem.file:
        return problem.file
    try:
        return pickle.dumps(problem)
    except Exception as error:
        raise ProblemError(
            f"the problem {problem.name!r} cannot be sent to worker processes ({error}); save it in a file and load it "
            "with km.load_problem, or run with workers=1"
        ) from error


@lru_cache(maxsize=8)
def _prepare(grid_name: str, sent: "Problem | bytes | str", seed: int, folder: Path, monitored: bool) -> Prepared:
    """Return the parts of a problem, once for each process and call of `sweep`."""
    problem = sent if isinstance(sent, Problem) else load_problem(sent) if isinstance(sent, str) else pickle.loads(sent)
    return Prepared(problem, seed, folder / MODELS, monitored=monitored)


def _learn_all(grid: _Grid, controllers: Sequence[str], rows: Sequence[RunRow]) -> None:
    """Learn what the controllers need of each problem and seed, once for all workers."""
    learned = [row for row in rows if is_learned(row.controller) or row.noise]
    models = {(row.problem, row.seed): (f"{row.problem}:{row.case}", row.seed) for row in reversed(learned)}
    tasks = list(reversed(models.values()))
    for _ in map_tasks(partial(_learn, grid, controllers), tasks, **_places(grid)):
        pass


def _learn(grid: _Grid, controllers: Sequence[str], model: tuple[str, int]) -> None:
    """Learn what the controllers need of a problem, one of whose cases is named; where that raises, the runs say so."""
    case, seed = model
    parts = _prepare(grid.name, grid.problems[case], seed, grid.folder, grid.options.monitor)
    with suppress(Exception):  # whatever the data or a plant of the user raise
        parts.save_models(controllers)


def _places(grid: _Grid) -> dict[str, Any]:
    return {"workers": grid.options.workers, "scheduler": grid.options.scheduler}


def _send_runs(grid: _Grid, rows: Sequence[RunRow]) -> Iterator[RunRow]:
    """Yield each run in its order; one whose workers die each time fails, and the others go on."""
    left = list(rows)
    while left:
        try:
            for row in map_tasks(partial(_run, grid), left.copy(), **_places(grid)):
                left.pop(0)
                yield row if row.log is None else replace(row, log=grid.folder / row.log.name)
        except WorkerError as error:
            yield replace(left.pop(0), failure=f"its worker process died: {error}")


def _run(grid: _Grid, row: RunRow) -> RunRow:
    return _log(grid, *_measure(grid, row))


def _run_here(grid: _Grid, rows: Sequence[RunRow], shown: _Shown) -> Iterator[RunRow]:
    """Yield each run; logs of a case wait for its table while its loops and logs take less than `_HELD`.

    Ctrl-C writes those that wait; a second one keeps their figures without logs.
    """
    waiting: list[tuple[RunRow, Run | None]] = []

    def log_waiting() -> Iterator[RunRow]:
        while waiting:
            row = _log(grid, *waiting[0])
            waiting.pop(0)
            yield row

    for _, case in groupby(rows, key=_case_of):
        due = time.monotonic() + _HELD
        try:
            for row in case:
                waiting.append(_measure(grid, row))
                shown.end(waiting[-1][0])
                if time.monotonic() >= due:
                    yield from log_waiting()
            yield from log_waiting()
        except KeyboardInterrupt:
            try:
                yield from log_waiting()
            except KeyboardInterrupt:
                yield from (row for row, _ in waiting)
            raise


def _measure(grid: _Grid, row: RunRow) -> tuple[RunRow, Run | None]:
    """Return the row with its figures, and its run, None where it raised."""
    how = {name: getattr(grid.options, name) for name in ("live", "paced", "compiled")}
    logged = row.start < grid.options.log_starts
    return measure_run(_parts_of(grid, row), row, grid.folder, logged=logged, **how)


def _log(grid: _Grid, row: RunRow, run: Run | None) -> RunRow:
    """Return the row of a run that has ended, with its log where it has one."""
    if run is None:
        return row
    return log_run(_parts_of(grid, row), row, run, grid.folder, logged=row.start < grid.options.log_starts)


def _parts_of(grid: _Grid, row: RunRow) -> Prepared:
    sent = grid.problems[f"{row.problem}:{row.case}"]
    return _prepare(grid.name, sent, row.seed, grid.folder, grid.options.monitor)


def _case_of(row: RunRow) -> tuple[str, str]:
    return row.problem, row.case


def _in_order(rows: Sequence[RunRow], ended: Mapping[tuple[Any, ...], RunRow]) -> list[RunRow]:
    """Return the finished runs, in the order in which they were asked for."""
    return [ended[row.key] for row in rows if row.key in ended]
