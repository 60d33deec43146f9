"""sweep: problems × controllers × starts × seeds × noise × wrong parameters × faults, into a store that survives."""

import json
import pickle
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
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
from koopmpc.apps.bench.single import FAULTS, run_and_log
from koopmpc.apps.bench.store import RESULTS, RunRow, Store, open_sweep, write_results
from koopmpc.base import checks, disk
from koopmpc.base.errors import DataError, ProblemError, WorkerError, refuse_moved
from koopmpc.base.parallel import map_tasks
from koopmpc.base.values import fingerprint, to_data
from koopmpc.control.ask.limits import Limits
from koopmpc.views.recording.viewer import find_viewer, why_none

MODELS = "models"  # beside the logs: what was learned
_NOT_ASKED = ("workers", "scheduler", "live", "paced", "log_starts")  # options that change no figure of a run


class _Grid(NamedTuple):
    """What is the same for all runs: how to find the problems, and where and how runs are written."""

    name: str  # unique to each call of `sweep`: a worker never reuses the controllers of another
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
        Called with all runs of a case when the last one has ended; cases come in their order.
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
        try:
            _learn_all(grid, asked["controllers"], left)
            for row in _send_runs(grid, left):
                store.add(row)
                shown.say(row.name)
        finally:
            write_results(shown.list_ended(rows), folder / RESULTS)
        return shown.list_ended(rows)


@dataclass
class _Shown:
    """What callers see of a sweep that goes on: names, numbers, and cases that have ended."""

    rows: list[RunRow]
    store: Store
    progress: Callable[[str, int, int], None] | None
    on_case: Callable[[list[RunRow]], None] | None

    def __post_init__(self) -> None:
        self._cases = [list(group) for _, group in groupby(self.rows, key=lambda row: (row.problem, row.case))]

    def say(self, what: str) -> None:
        """Show what runs or has ended."""
        done, total = len(self.store.rows), len(self.rows)
        if self.progress is not None:
            self.progress(what.replace("-", ":", 1) if done < total else "done", done, total)
        while self.on_case is not None and self._cases and all(row.key in self.store.rows for row in self._cases[0]):
            self.on_case(self.list_ended(self._cases.pop(0)))

    def list_ended(self, rows: Sequence[RunRow]) -> list[RunRow]:
        """Return the finished ones of these runs, in the order in which they were asked for."""
        return [self.store.rows[row.key] for row in rows if row.key in self.store.rows]


def _list_runs(problems: Sequence[Problem], controllers: Sequence[str] | None, options: SweepOptions) -> list[RunRow]:
    """Return the runs that are asked for, without their figures."""
    asked = controller_names(controllers)
    cases = [f"{problem.name}:{case}" for problem in problems for case in problem.cases]
    twice = next((case for case in cases if cases.count(case) > 1), None)
    if twice is not None:
        raise ProblemError(f"{twice} comes twice, and its logs would have one name; run it once, or rename a file")
    rows: list[RunRow] = []
    parts = {problem.name: Prepared(problem) for problem in problems}
    for problem, case in ((each, case) for each in problems for case in each.cases):
        if any(options.wrong):
            parts[problem.name].perturb_plant(case, 0.0, 0)  # raises where there is nothing to be wrong
        names = asked if controllers else controller_names(problem.controllers)
        broken = (None, *(possible_faults(problem.limits_of(case)) if options.faults else ()))
        for fault, n, w, seed, name in product(broken, options.noise, options.wrong, range(options.seeds), names):
            if not seed or is_learned(name):  # of what learns nothing all seeds are one
                row = RunRow(problem.name, case, name, fault=fault, noise=n, wrong=w, seed=seed)
                rows.extend(replace(row, start=start) for start in range(options.starts))
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
    """Return the row with its figures, and its log where it has one."""
    parts = _prepare(grid.name, grid.problems[f"{row.problem}:{row.case}"], row.seed, grid.folder, grid.options.monitor)
    how = {name: getattr(grid.options, name) for name in ("live", "paced", "compiled")}
    return run_and_log(parts, row, grid.folder, logged=row.start < grid.options.log_starts, **how)
