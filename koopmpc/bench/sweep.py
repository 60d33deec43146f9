"""sweep: problems × controllers × starts × seeds × noise × wrong parameters × faults, into a store that survives."""

import json
import pickle
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from functools import lru_cache, partial
from itertools import groupby, islice, product
from pathlib import Path
from typing import Any, NamedTuple, cast
from uuid import uuid4

import numpy as np

from koopmpc import checks, disk
from koopmpc.bench.controllers import Prepared, controller_names, is_learned
from koopmpc.bench.problem import Problem, load_problem
from koopmpc.bench.single import FAULTS, log_run, measure_run
from koopmpc.bench.store import RESULTS, ROWS, Journal, RunRow, load_rows, next_batch, open_sweep, write_results
from koopmpc.control.limits import Limits
from koopmpc.errors import DataError, ProblemError
from koopmpc.loop.run import Run
from koopmpc.parallel import map_tasks
from koopmpc.recording.viewer import find_viewer, why_none
from koopmpc.values import fingerprint, to_data

MODELS = "models"  # beside the logs: what was learned
_BATCHES = 40  # give each worker about this many batches
_LARGEST = 50  # put at most this many runs into a batch
_EACH = 100  # make each run a batch of its own if there are at most this many
_FIRST = 5.0  # write results.parquet for the first time after this time [s]
_SHARE = 100.0  # write results.parquet again after this many times the time that writing takes
_HELD = 3.0  # let logs wait for the table of their case while its loops take less than this time [s]
_DEATHS = 3  # a run fails if it would begin for this time after its workers died


class _Grid(NamedTuple):
    """What is the same for all batches: how to find the problems, and where and how runs are written."""

    name: str  # another one for each call of `sweep`, so that no worker takes another's controllers
    problems: dict[str, "Problem | bytes | str"]
    folder: Path
    log_starts: int
    live: bool
    paced: bool
    monitor: bool
    compiled: bool


def sweep(
    problems: Iterable[Problem],
    controllers: Sequence[str] | None = None,
    *,
    folder: str | Path,
    starts: int = 1,
    seeds: int = 1,
    noise: Sequence[float] = (0.0,),
    wrong: Sequence[float] = (0.0,),
    faults: bool = False,
    monitor: bool = False,
    compiled: bool = False,
    log_starts: int = 1,
    workers: int | None = None,
    scheduler: str | None = None,
    live: bool = False,
    paced: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
    on_case: Callable[[list[RunRow]], None] | None = None,
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
        Receives sweep.json, a line for each run in rows/, results.parquet, models/, and for runs that are logged
        <problem>-<case>-<controller>.rrd. Workers on other machines must reach it by the same path.
    starts
        Initial states of each case: its own, and starts − 1 drawn from the box in which training data begin.
    seeds
        Sets of training data, each of its own seed; a model is learned once for each.
    noise
        Standard deviations of the measurement noise, as shares of that of each output in the training data.
    wrong
        Largest shares by which the parameters of the driven plant, the number fields of its Dynamics, are off.
    faults
        Whether to run each case again under each of `FAULTS`; their logs end in <controller>-<fault>.rrd.
    monitor
        Whether MPC of learned models says at each step whether it is like the data; `metrics` counts those that are
        not, and the logs keep them.
    compiled
        Whether to run those controllers in C that `km.compiled` can build; the others stay in Python. A run's metadata
        say which it was.
    log_starts
        How many starts of each case have logs; a run that failed has one too.
    workers, scheduler
        As in `map_tasks`: local processes, or a Dask cluster at tcp://host:port.
    live
        Whether to stream each run to a Rerun viewer; one is opened where none is up. Without a viewer there is one
        UserWarning, and the runs are recorded all the same. Runs of this process only.
    paced
        Whether each run takes as long as its plant would, to be watched.
    progress
        Called with (name of the run, runs done, runs in all).
    on_case
        Called with all runs of a case when the last one has ended; cases come in their order. In this process it does
        not wait for the logs of loops that take less than three seconds: they come afterwards, after Ctrl-C, too.

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
    folder = disk.path_of(folder)
    checks.members(problems, "problems", ("__iter__",), "pass a list of what km.load_problem returns")
    problems = list(problems)
    for problem in problems:
        checks.kind(problem, "a problem", Problem, "load it with km.load_problem")
    rows = _rows(problems, controllers, starts, seeds, noise, wrong, faults)
    alone = scheduler is None and (workers is None or workers == 1)
    if live and not alone:
        raise ProblemError("live= shows runs of this process; leave out workers= and scheduler=")
    sent = {f"{p.name}:{case}": p if alone else _sendable(p) for p in problems for case in p.cases}
    if live and find_viewer() is None:
        live = False
        warnings.warn(f"{why_none()}; the runs are recorded all the same", UserWarning, stacklevel=2)
    asked: dict[str, Any] = {
        "problems": [_print_of(problem) for problem in problems],
        "controllers": list(dict.fromkeys(row.controller for row in rows)),
        "starts": starts,
        "seeds": seeds,
        "noise": list(map(float, noise)),
        "wrong": list(map(float, wrong)),
        "faults": faults,
        "monitor": monitor,
        "compiled": compiled,
    }
    with open_sweep(folder, asked):
        done = {row.key: row for row in load_rows(folder)}
        left = [row for row in rows if row.key not in done]
        grid = _Grid(uuid4().hex, dict(sent), folder.resolve(), log_starts, live, paced, monitor, compiled)
        where: dict[str, Any] = {"workers": workers, "scheduler": scheduler}

        cases = deque(list(group) for _, group in groupby(rows, key=lambda row: (row.problem, row.case)))

        def say(what: str) -> None:
            if progress is not None:
                progress(what.replace("-", ":", 1), len(done), len(rows))
            while on_case is not None and cases and all(row.key in done for row in cases[0]):
                on_case(_in_order(cases.popleft(), done))

        say(left[0].name if left else "done")
        due = time.monotonic() + _FIRST
        try:
            wanted = [row for row in left if is_learned(row.controller) or row.noise]
            models = {(row.problem, row.seed): (f"{row.problem}:{row.case}", row.seed) for row in reversed(wanted)}
            learn = partial(_learn, grid, asked["controllers"])
            for _ in map_tasks(learn, list(reversed(models.values())), **where):
                pass
            held = alone and on_case is not None

            def add_ended(row: RunRow) -> None:
                done[row.key] = row
                say(row.name)

            batches = _batches(left, workers or 1, next_batch(folder), by_case=held)
            for finished in map_tasks(partial(_do, grid, on_end=add_ended if held else None), batches, **where):
                done |= {row.key: replace(row, log=row.log and folder / row.log.name) for row in finished}
                say(finished[-1].name if len(done) < len(rows) else "done")
                if (begin := time.monotonic()) >= due:
                    write_results(_in_order(rows, done), folder / RESULTS)
                    due = begin + _SHARE * (time.monotonic() - begin)
        except BaseException:  # Ctrl-C, above all: runs of the batch under way are finished, too
            done = {row.key: row for row in load_rows(folder)}
            raise
        finally:
            write_results(_in_order(rows, done), folder / RESULTS)
    return _in_order(rows, done)


def _rows(
    problems: Sequence[Problem],
    controllers: Sequence[str] | None,
    starts: int,
    seeds: int,
    noise: Sequence[float],
    wrong: Sequence[float],
    faults: bool,
) -> list[RunRow]:
    """Return the runs that are asked for, without their figures."""
    asked = controller_names(controllers)
    cases = [f"{problem.name}:{case}" for problem in problems for case in problem.cases]
    twice = next((case for case in cases if cases.count(case) > 1), None)
    if twice is not None:
        raise ProblemError(f"{twice} comes twice, and its logs would have one name; run it once, or rename a file")
    for name, shares in (("noise", noise), ("wrong", wrong)):
        values = checks.array(shares, name, (None,))
        if not len(values) or (values < 0).any() or len(set(values.tolist())) != len(values):
            raise ProblemError(f"{name} is {list(shares)}; pass shares of zero or more, each once, such as [0, 0.01]")
    rows: list[RunRow] = []
    for problem, case in ((each, case) for each in problems for case in each.cases):
        names = asked if controllers else controller_names(problem.controllers)
        broken = (None, *(possible_faults(problem.limits_of(case)) if faults else ()))
        for fault, n, w, seed, name in product(broken, noise, wrong, range(checks.count(seeds, "seeds")), names):
            if seed and not is_learned(name):
                continue  # it learns nothing, so all seeds are one
            row = RunRow(problem.name, case, name, fault=fault, noise=float(n), wrong=float(w), seed=seed)
            rows.extend(replace(row, start=start) for start in range(checks.count(starts, "starts")))
    if any(row.wrong for row in rows):
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


def _learn(grid: _Grid, controllers: Sequence[str], model: tuple[str, int]) -> None:
    """Learn for all workers what the controllers need of a problem, one of whose cases is named, and a seed.

    Where that raises, the runs say so.
    """
    case, seed = model
    parts = _prepare(grid.name, grid.problems[case], seed, grid.folder, grid.monitor)
    with suppress(Exception):  # whatever the data or a plant of the user raise
        parts.save_models(controllers)


def _batches(rows: Sequence[RunRow], workers: int, first: int, *, by_case: bool) -> list[tuple[int, list[RunRow]]]:
    """Return the runs in batches, each with the number of its file, the least of which is `first`.

    Sending one takes a tenth of a millisecond, about as long as a short run. With `by_case` a batch holds runs of one
    case, as many as it may.
    """
    size = 1 if len(rows) <= _EACH else min(max(1, len(rows) // (_BATCHES * workers)), _LARGEST)
    groups = [iter(rows)]
    if by_case:
        size = _LARGEST
        groups = [iter(list(group)) for _, group in groupby(rows, key=lambda row: (row.problem, row.case))]
    return list(enumerate((batch for taken in groups for batch in _take(taken, size)), first))


def _take(rows: Iterator[RunRow], size: int) -> Iterator[list[RunRow]]:
    """Yield the rows, `size` at a time."""
    return iter(lambda: list(islice(rows, size)), [])


def _do(
    grid: _Grid, batch: tuple[int, list[RunRow]], *, on_end: Callable[[RunRow], None] | None = None
) -> list[RunRow]:
    """Do the runs of a batch one after the other; those that a worker which died had finished are not run again.

    Their lines go to the file of the batch's number. With `on_end`, which is called with each run that has ended, logs
    wait until the last loop has ended, or loops and logs have taken `_HELD`; Ctrl-C writes those that wait, a second
    gives them up.
    """
    number, rows = batch
    due = time.monotonic() + (0.0 if on_end is None else _HELD)
    with Journal(grid.folder / ROWS / f"{number:06d}.jsonl") as journal:
        finished = [journal.rows[row.key] for row in rows if row.key in journal.rows]
        left = [row for row in rows if row.key not in journal.rows]
        done: RunRow | None = None
        waiting: deque[tuple[RunRow, Run | None]] = deque()

        def log_waiting() -> None:
            nonlocal done
            while waiting:
                if done is not None:
                    journal.turn(done, None)
                done = _log(grid, *waiting[0])
                finished.append(done)
                waiting.popleft()

        try:
            for row in left:
                died = journal.turn(done, row)
                done = None
                waiting.append(_measure(grid, row, died))
                if on_end is not None:
                    on_end(waiting[-1][0])
                if row is left[-1] or time.monotonic() >= due:
                    log_waiting()
        except KeyboardInterrupt:
            if on_end is not None:  # the table of these runs may be out
                log_waiting()
                journal.turn(done, None)
            raise
        journal.turn(done, None)
    return finished


def _measure(grid: _Grid, row: RunRow, died: int) -> tuple[RunRow, Run | None]:
    """Return the row with its figures, and its run, None where it raised or its worker `died` too often."""
    if died + 1 >= _DEATHS:
        return replace(row, failure=f"its worker process died {died} times"), None
    how = {"live": grid.live, "paced": grid.paced, "compiled": grid.compiled}
    return measure_run(_parts_of(grid, row), row, grid.folder, logged=row.start < grid.log_starts, **how)


def _log(grid: _Grid, row: RunRow, run: Run | None) -> RunRow:
    """Return the row of a run that has ended, with its log where it has one."""
    if run is None:
        return row
    return log_run(_parts_of(grid, row), row, run, grid.folder, logged=row.start < grid.log_starts)


def _parts_of(grid: _Grid, row: RunRow) -> Prepared:
    sent = grid.problems[f"{row.problem}:{row.case}"]
    return _prepare(grid.name, sent, row.seed, grid.folder, grid.monitor)


def _in_order(rows: Sequence[RunRow], done: dict[tuple[Any, ...], RunRow]) -> list[RunRow]:
    """Return the finished runs, in the order in which they were asked for."""
    return [done[row.key] for row in rows if row.key in done]
