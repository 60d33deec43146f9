"""sweep: run every controller on every case of every problem; each run makes a log and a row of results."""

import traceback
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from koopmpc import disk
from koopmpc.bench.controllers import CONTROLLERS, LEARNED, Prepared, controller_names
from koopmpc.bench.problem import Case, Problem
from koopmpc.bench.results import RunRow, failures, reached, write_results
from koopmpc.codegen.compiled import Compiled
from koopmpc.codegen.compiled import compiled as built
from koopmpc.control.limits import Limits
from koopmpc.control.move import Controller
from koopmpc.errors import DataError, FullDiskError, ProblemError
from koopmpc.loop.faults import (
    ActuatorDelay,
    ActuatorLoss,
    DroppedSamples,
    Fault,
    FrozenSensor,
    NaNSensor,
    SolverFailure,
)
from koopmpc.loop.metrics import metrics
from koopmpc.loop.run import Run
from koopmpc.loop.simulate import StepObserver, predictor_of, simulate
from koopmpc.recording.format.reader import load_run
from koopmpc.recording.recorder import Recorder, record
from koopmpc.recording.viewer import find_viewer, why_none

RESULTS = "results.parquet"  # beside the logs of the runs
FAULTS: dict[str, Fault] = {
    "nan-sensor": NaNSensor(probability=0.1),
    "frozen-sensor": FrozenSensor(begin=10, end=15),
    "dropped-samples": DroppedSamples(0.2),
    "actuator-loss": ActuatorLoss(0.5),
    "actuator-delay": ActuatorDelay(1),
    "solver-failure": SolverFailure(0.2),
}


class _Task(NamedTuple):
    """One run: the names of its case, its controller and its fault."""

    case: str
    controller: str
    fault: str | None


def sweep(
    problems: Iterable[Problem],
    controllers: Sequence[str] | None = None,
    *,
    folder: str | Path,
    faults: bool = False,
    monitor: bool = False,
    live: bool = False,
    compiled: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> list[RunRow]:
    """Run each controller on each case of each problem, and judge all by the same cost and limits.

    Parameters
    ----------
    problems
        The problems; `load_problem("cart_pole:recover")` holds one case alone.
    controllers
        Some of lqr, koopman-lqr, linear-mpc, koopman-mpc, offset-free, bilinear-mpc, bilinear-offset, nonlinear-mpc,
        adaptive and designed; by default the controllers that each problem names, where it names none the first eight.
    folder
        Receives <problem>-<case>-<controller>.rrd for each run, and results.parquet; it is made where it is missing.
    faults
        Whether to run each case again under each of `FAULTS`; their logs end in <controller>-<fault>.rrd.
    monitor
        Whether MPC of learned models says at each step whether it is like the data; `metrics` counts those that are
        not, and the logs keep them.
    live
        Whether to stream each run to a Rerun viewer; one is opened where none is up. Without a viewer there is one
        UserWarning, and the runs are recorded all the same.
    compiled
        Whether to run those controllers in C that `km.compiled` can build; the others stay in Python. A run's metadata
        say which it was.
    progress
        Called with (name of the run, runs done, runs in all).

    Returns
    -------
    rows
        One row for each run. An exception ends that run alone and becomes the `failure` of its row.

    Raises
    ------
    ProblemError
        There is no such controller, or a case is given twice.
    FullDiskError
        The disk is full; the runs that are finished, and their results.parquet, are kept.
    """
    asked, problems, folder = controller_names(controllers), list(problems), Path(folder)
    cases = [f"{problem.name}:{case}" for problem in problems for case in problem.cases]
    twice = next((case for case in cases if cases.count(case) > 1), None)
    if twice is not None:
        raise ProblemError(f"{twice} comes twice, and its logs would have one name; run it once, or rename a file")
    folder.mkdir(parents=True, exist_ok=True)
    if live and find_viewer() is None:
        live = False
        warnings.warn(f"{why_none()}; the runs are recorded all the same", UserWarning, stacklevel=2)
    tasks = [
        (problem, _Task(case, name, fault))
        for problem in problems
        for case in problem.cases
        for fault in (None, *(possible_faults(problem.limits_of(case)) if faults else ()))
        for name in (asked if controllers else controller_names(problem.controllers))
    ]
    rows: list[RunRow] = []
    parts: Prepared | None = None
    for problem, task in tasks:
        if parts is None or parts.problem is not problem:
            parts = Prepared(problem, monitored=monitor)
        if progress is not None:
            progress(f"{problem.name}:{' '.join(filter(None, task))}", len(rows), len(tasks))
        rows.append(_row(parts, task, folder, live, compiled))
        write_results(rows, folder / RESULTS)  # after every run, for the next one may be interrupted
    if not tasks:
        write_results(rows, folder / RESULTS)
    if progress is not None:
        progress("done", len(tasks), len(tasks))
    return rows


def possible_faults(limits: Limits) -> tuple[str, ...]:
    """Return the names of the faults that can occur: without input limits an actuator has no range to lose."""
    limited = any(end is not None and np.isfinite(end).any() for end in (limits.u_min, limits.u_max))
    return tuple(name for name in FAULTS if limited or name != "actuator-loss")


def _row(parts: Prepared, task: _Task, folder: Path, live: bool, compiled: bool) -> RunRow:
    """Run one task, compute its figures, write its log and read it back; an exception becomes the row's failure."""
    problem, (case, name, fault) = parts.problem.name, task
    log = folder / ("-".join((problem, *filter(None, task))) + ".rrd")
    try:
        run = _run(parts, task, live, compiled)
        judged, found = (metrics(run), reached(run)), failures(run, parts.problem.cases[case].steps)
    except FullDiskError:
        raise
    except Exception as error:  # the other runs go on; the exit code says that one failed
        return RunRow(problem, case, name, failure=_described(error, log), fault=fault)
    try:
        found += _recorded(run, log)
        if load_run(log) != run:
            found.append(f"{log.name} does not read back equal to the run")
    except FullDiskError:
        raise
    except Exception as error:  # the figures of the run are kept without its log
        found.append(_described(error, log))
    kept = log if log.exists() else None
    training = parts.training_time if name in LEARNED else 0.0
    return RunRow(problem, case, name, *judged, training, kept, "; ".join(found) or None, fault)


def _described(error: Exception, log: Path) -> str:
    """Return the error in one line, and write its traceback beside the log."""
    trace = log.with_suffix(".txt")
    with disk.writing(trace) as stream:
        stream.write("".join(traceback.format_exception(error)).encode())
    return f"{type(error).__name__}: {error} (the whole traceback is in {trace.name})"


def _recorded(run: Run, log: Path) -> list[str]:
    """Write the log; where its scene cannot be drawn, write it without the scene and return why."""
    try:
        record(run, log)
    except FullDiskError:
        raise
    except Exception as error:
        if run.scene is None:
            raise
        record(replace(run, scene=None), log)
        return [f"the log is without its scene: drawing scene(x, u) raised {_described(error, log)}"]
    return []


def _run(parts: Prepared, task: _Task, live: bool, compiled: bool) -> Run:
    """Return the run of one controller on one case."""
    problem, case, plant = parts.problem, parts.problem.cases[task.case], parts.truth_of(task.case)
    limits = problem.limits_of(task.case)
    controller = CONTROLLERS[task.controller](parts, limits)
    if compiled:
        with suppress(DataError):  # what cannot be written in C stays in Python
            controller = built(controller)
    injected = () if task.fault is None else (FAULTS[task.fault],)
    in_c = {"compiled": isinstance(controller, Compiled)} if compiled else {}
    held = parts.u_reference(task.case)
    _warm_up(controller, parts, case)
    about: dict[str, Any] = {
        "cost": problem.cost,
        "limits": limits,
        "angles": tuple(problem.angles),
        "metadata": _metadata(problem, task, injected) | in_c,
    }
    scene = problem.scene or getattr(plant, "scene", None)

    def closed_loop(*observers: StepObserver) -> Run:
        run = simulate(
            plant,
            controller,
            x0=case.x0,
            reference=case.reference,
            steps=case.steps,
            u_reference=held,
            noise=case.noise,
            faults=(*case.faults, *injected),
            observers=observers,
            plans=True,
            **about,
        )
        return replace(run, scene=scene)

    if not live:
        return closed_loop()
    names: dict[str, Any] = {"dt": plant.dt, "states": plant.states, "inputs": plant.inputs, "outputs": plant.outputs}
    with Recorder(live=True, **names, **about, scene=scene, model=predictor_of(controller)) as viewer:
        return closed_loop(viewer)


def _warm_up(controller: Controller, parts: Prepared, case: Case) -> None:
    """Call the controller twice and reset it, so that the cost of first calls is no part of a step's time."""
    y = parts.step_map.measure(case.x0)
    reference = np.atleast_1d(np.asarray(case.reference))
    row = reference if reference.ndim == 1 else reference[0]
    ahead = np.tile(row, (controller.horizon + 1, 1))
    controller.reset(case.x0)
    for _ in range(2):
        controller(y, ahead)
    controller.reset(case.x0)


def _metadata(problem: Problem, task: _Task, injected: Sequence[Fault]) -> dict[str, Any]:
    training = problem.training
    known: dict[str, Any] = {
        "problem": problem.name,
        "title": problem.title,
        "case": task.case,
        "controller": task.controller,
        "horizon": problem.horizon,
        "ridge": problem.ridge,
        "training": {"episodes": training.episodes, "steps": training.steps, "seed": training.seed},
    }
    return known | ({"fault": task.fault, "faults": [str(broken) for broken in injected]} if injected else {})
