"""One run of a sweep: a controller on a case, its figures, and its log; and the same run again from that log."""

import re
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from koopmpc.apps.bench.controllers import Prepared, is_learned
from koopmpc.apps.bench.problem import Problem
from koopmpc.apps.bench.problem_files import load_problem
from koopmpc.apps.bench.store import RunRow, reached
from koopmpc.base import disk
from koopmpc.base.errors import DataError, FullDiskError, LogError, ProblemError
from koopmpc.codegen.compiled import Compiled
from koopmpc.codegen.compiled import compiled as built
from koopmpc.control.move import Controller
from koopmpc.loop.controllers import count_disturbances, predictor_of
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
from koopmpc.loop.realtime import in_real_time
from koopmpc.loop.rows import MOVE_COLUMNS, columns_of_moves
from koopmpc.loop.run import SECONDS, Run
from koopmpc.loop.simulate import LoopOptions, StepObserver, simulate
from koopmpc.plants.step_map import StepMap
from koopmpc.views.recording.reader import load_run
from koopmpc.views.recording.recorder import Recorder, RecorderOptions
from koopmpc.views.recording.writer import record

_TIME_UNITS = {"milliseconds": "ms", "minutes": "min", "hours": "h", "days": "d"}
FAULTS: dict[str, Fault] = {
    "nan-sensor": NaNSensor(probability=0.1),
    "frozen-sensor": FrozenSensor(begin=10, end=15),
    "dropped-samples": DroppedSamples(0.2),
    "actuator-loss": ActuatorLoss(0.5),
    "actuator-delay": ActuatorDelay(1),
    "solver-failure": SolverFailure(0.2),
}
_COLD_STEPS = 25  # time this many steps with cold caches
_SLEEP = 0.004  # sleep before each of them [s]

_TOLERANCE = 1e-9  # relative violation of an input limit that counts as rounding


def run_and_log(parts: Prepared, row: RunRow, folder: Path, *, logged: bool, **how: bool) -> RunRow:
    """Run what `row` names, and return it with its figures; `how` is passed to `run_closed_loop`.

    A run that is `logged`, or that failed, is written to a log, which is read back; one that is logged is also timed
    with cold caches. An exception becomes the row's failure.
    """
    begin, log = time.perf_counter(), folder / f"{row.name}.rrd"
    row = replace(row, x0=tuple(parts.initial_state(row.case, row.start).tolist()))
    try:
        run = run_closed_loop(parts, row, plans=logged, **how)
        figures, arrived = metrics(run), reached(run)
        found = failures(run, parts.problem.cases[row.case].steps)
    except FullDiskError:
        raise
    except Exception as error:  # the other runs go on; the exit code says that one failed
        return replace(row, failure=_describe_error(error, log), elapsed=time.perf_counter() - begin)
    if logged or found:
        try:
            found += _record_log(run, log)
            if load_run(log) != run:
                found.append(f"{log.name} does not read back equal to the run")
        except FullDiskError:
            raise
        except Exception as error:  # the figures of the run are kept without its log
            found.append(_describe_error(error, log))
    usual = logged and row.fault is None and not row.noise and not row.wrong
    p50, p99 = _cold(parts.controller(row.controller, row.case), run) if usual else (row.cold_p50, row.cold_p99)
    return replace(
        row,
        metrics=figures,
        reached=arrived,
        training_time=parts.training_time if is_learned(row.controller) else 0.0,
        log=log if log.exists() else None,
        failure="; ".join(found) or None,
        elapsed=time.perf_counter() - begin,
        cold_p50=p50,
        cold_p99=p99,
    )


def failures(run: Run, steps: int) -> list[str]:
    """Return why a run did not end as it should: steps missing, u not finite or beyond a limit, no status."""
    found: list[str] = []
    if run.steps != steps:
        found.append(f"it took {run.steps} of {steps} steps")
    if not np.isfinite(run.U).all():
        k = int(np.argwhere(~np.isfinite(run.U))[0][0])
        found.append(f"u is {run.U[k]} at step {k}")
    elif run.limits is not None:
        low, high = run.limits.input_rows(run.U.shape[1], 0, len(run.U))
        beyond = np.maximum(low - run.U, run.U - high)
        room = _TOLERANCE * (1.0 + np.abs(run.U))
        if (beyond > room).any():
            k = int(np.argmax((beyond - room).max(axis=1)))
            found.append(f"u = {run.U[k]} at step {k} is {beyond[k].max():.3g} beyond a hard limit")
    if len(run.status) != run.steps:
        found.append(f"{len(run.status)} of {run.steps} steps have a status")
    return found


def _describe_error(error: Exception, log: Path) -> str:
    """Return the error in one line, and write its traceback beside the log."""
    trace = log.with_suffix(".txt")
    with disk.writing(trace) as stream:
        stream.write("".join(traceback.format_exception(error)).encode())
    return f"{type(error).__name__}: {error} (the whole traceback is in {trace.name})"


def _record_log(run: Run, log: Path) -> list[str]:
    """Write the log; where its scene cannot be drawn, write it without the scene and return why."""
    try:
        record(run, log)
    except FullDiskError:
        raise
    except Exception as error:
        if run.scene is None:
            raise
        record(replace(run, scene=None), log)
        return [f"the log is without its scene: drawing scene(x, u) raised {_describe_error(error, log)}"]
    return []


def run_closed_loop(
    parts: Prepared, row: RunRow, *, plans: bool, live: bool = False, paced: bool = False, compiled: bool = False
) -> Run:
    """Return the run that `row` names, from its x0; `live` in a viewer, `paced` as fast as its plant would be."""
    problem, case = parts.problem, parts.problem.cases[row.case]
    plant = parts.perturb_plant(row.case, row.wrong, row.start) if row.wrong else parts.truth_of(row.case)
    held = parts.find_held_inputs(row.case, plant) if row.wrong else parts.u_reference(row.case)
    controller = parts.controller(row.controller, row.case)
    if compiled:
        with suppress(DataError):  # what cannot be written in C stays in Python
            controller = built(controller)
    in_c = {"compiled": isinstance(controller, Compiled)} if compiled else {}
    monitored = {"monitor": True} if parts.monitor_data is not None else {}
    injected = () if row.fault is None else (FAULTS[row.fault],)
    _warm_up(controller, parts, row.case)
    judged: dict[str, Any] = {"cost": problem.cost, "limits": problem.limits_of(row.case)}
    about: dict[str, Any] = {
        "angles": tuple(problem.angles),
        "metadata": _metadata(parts, row, injected) | in_c | monitored,
    }
    own = 0.0 if case.noise is None else np.asarray(case.noise, dtype=np.float64)
    noise = np.hypot(own, row.noise * parts.spread) if row.noise else case.noise
    scene = problem.scene or getattr(plant, "scene", None)

    pace = (in_real_time(plant.dt * SECONDS[find_time_unit(problem)]),) if paced else ()

    def simulate_with(*observers: StepObserver) -> Run:
        run = simulate(
            plant,
            controller,
            x0=row.x0,
            reference=case.reference,
            steps=case.steps,
            options=LoopOptions(
                u_reference=held, noise=noise, faults=(*case.faults, *injected), rng=row.start, plans=plans, **about
            ),
            measured=problem.measured_of(row.case),
            observers=(*observers, *pace),
            **judged,
        )
        return replace(run, scene=scene)

    if not live:
        return simulate_with()
    names: dict[str, Any] = {"dt": plant.dt, "states": plant.states, "inputs": plant.inputs}
    options = RecorderOptions(outputs=plant.outputs, scene=scene, model=predictor_of(controller), **about)
    with Recorder(live=True, **names, **judged, options=options) as viewer:
        return simulate_with(viewer)


def _warm_up(controller: Controller, parts: Prepared, name: str) -> None:
    """Call the controller twice and reset it, so that measured step times leave out the cost of first calls."""
    case, told = parts.problem.cases[name], _tell(controller, parts.problem.measured_of(name), 0)
    y = parts.step_map.measure(case.x0)
    reference = np.atleast_1d(np.asarray(case.reference))
    row = reference if reference.ndim == 1 else reference[0]
    ahead = np.tile(row, (controller.horizon + 1, 1))
    controller.reset(case.x0)
    for _ in range(2):
        controller(y, ahead, **told)
    controller.reset(case.x0)


def _tell(controller: Controller, W: ArrayLike | None, k: int) -> dict[str, Any]:
    """Return w of a call at step k, the last row of W repeated; nothing where the controller's model has none."""
    if W is None or count_disturbances(controller) == 0:
        return {}
    rows = np.asarray(W)
    return {"w": rows[np.minimum(np.arange(k, k + max(controller.horizon, 1)), len(rows) - 1)]}


def _cold(controller: Controller, run: Run) -> tuple[float, float]:
    """Return median and 99 % quantile of the first steps, asked for again with a sleep before each [s]."""
    times: list[float] = []
    controller.reset(run.X[0] if np.isfinite(run.X[0]).all() else None)
    for k in range(min(run.steps, _COLD_STEPS)):
        time.sleep(_SLEEP)
        told = _tell(controller, run.metadata.get("measured"), k)
        begin = time.perf_counter()
        controller(run.Y[k], run.reference[k : k + controller.horizon + 1], run.U[k - 1] if k else None, **told)
        times.append(time.perf_counter() - begin)
    p50, p99 = np.quantile(times, [0.5, 0.99])
    return float(p50), float(p99)


def find_time_unit(problem: Problem) -> str:
    """Return the unit of dt: s, unless the docstring of the file that holds the dynamics says "Time in hours"."""
    module = sys.modules.get(type(problem.dynamics).__module__)
    words = re.search(r"\bTime in (\w+)", getattr(module, "__doc__", None) or "")
    return _TIME_UNITS.get(words[1], "s") if words else "s"


def _metadata(parts: Prepared, row: RunRow, injected: Sequence[Fault]) -> dict[str, Any]:
    problem, training = parts.problem, parts.problem.training
    known: dict[str, Any] = {
        "problem": problem.name,
        "title": problem.title,
        "case": row.case,
        "controller": row.controller,
        "horizon": problem.horizon,
        "ridge": problem.ridge,
        "training": {"episodes": training.episodes, "steps": training.steps, "seed": training.seed + row.seed},
    }
    sweep = {name: getattr(row, name) for name in ("start", "seed", "noise", "wrong") if getattr(row, name)}
    unit = find_time_unit(problem)
    known |= {"time unit": unit} if unit != "s" else {}
    known |= {"file": problem.file} if problem.file else {}
    known |= {"sweep": sweep} if sweep else {}
    return known | ({"fault": row.fault, "faults": [str(broken) for broken in injected]} if injected else {})


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


def replay_log(log: str | Path, *, plant: StepMap | None = None, controller: Controller | None = None) -> Replayed:
    """Run again what a log holds, and compare to the bit.

    A log of `koopmpc run`, `koopmpc bench` or `km.sweep` names all that ran: problem, data, start, noise and faults. Of
    any other log, as of `km.simulate` or `km.realtime`, pass what ran: the `plant` gets the logged inputs, from each
    logged state, and the `controller` the logged measurements and references, with their preview.

    Raises
    ------
    LogError
        The log cannot be read, or does not say what ran and nothing is passed; it is of a run with faults that the log
        of a problem alone can repeat.
    ProblemError
        The problem's file is no longer there, or has no such case.
    """
    logged = load_run(log)
    if plant is not None or controller is not None:
        run = _again(logged, plant, controller, Path(log))
        return Replayed(logged, run, tuple(_differences(logged, run)))
    known = logged.metadata
    if not {"problem", "case", "controller"} <= known.keys() or "training" not in known:
        raise LogError(
            f"{log} does not say which problem, case and controller ran; logs of `koopmpc run` and `koopmpc bench` do. "
            "In Python pass what ran: km.bench.replay_log(log, plant=…, controller=…)"
        )
    file = str(known.get("file", ""))
    problem = load_problem(f"{file if Path(file).is_file() else known['problem']}:{known['case']}")
    own: dict[str, Any] = dict(known.get("sweep", {}))
    row = RunRow(problem.name, str(known["case"]), str(known["controller"]), fault=known.get("fault"))
    row = replace(row, **{name: type(getattr(row, name))(value) for name, value in own.items()})
    trained = known["training"]["seed"] - row.seed
    if trained != problem.training.seed:
        raise ProblemError(f"{problem.name} trains with seed {problem.training.seed}, the log's run did with {trained}")
    parts = Prepared(problem, row.seed, monitored=bool(known.get("monitor")))
    row = replace(row, x0=tuple(parts.initial_state(row.case, row.start).tolist()))
    run = run_closed_loop(parts, row, plans=logged.plans is not None, compiled=bool(known.get("compiled")))
    return Replayed(logged, run, tuple(_differences(logged, run)))


def _again(logged: Run, plant: StepMap | None, controller: Controller | None, log: Path) -> Run:
    """Return the logged run with the states that the plant makes of its inputs, and the controller's moves."""
    if "faults" in logged.metadata:
        faults = ", ".join(logged.metadata["faults"])
        raise LogError(f"{log} is of a run with faults, {faults}: they cannot be made again from it")
    X, U, W, moves = logged.X, logged.U, logged.metadata.get("measured"), dict[str, Any]()
    if plant is not None:
        if np.isnan(X).any():
            raise LogError(f"{log} does not hold the states of its plant: pass the controller alone")
        if plant.nw and W is None:
            raise LogError(f"{log} does not hold what disturbed its plant: pass the controller alone")
        told = np.asarray(W if plant.nw else np.empty((len(U), 0)), dtype=np.float64)
        X = np.vstack([X[:1], *(plant(x, u, w)[None] for x, u, w in zip(X, U, told, strict=False))])
    if controller is not None:
        N = controller.horizon
        rows = np.vstack([logged.reference, np.repeat(logged.reference[-1:], N, axis=0)])
        controller.reset(None if np.isnan(X[0]).any() else X[0])
        made = [
            controller(
                logged.Y[k],
                rows[k : k + N + 1],
                U[k - 1] if k else None,
                **_tell(controller, W, k),
            )
            for k in range(logged.steps)
        ]
        U = np.array([move.u for move in made], dtype=np.float64)
        moves = columns_of_moves(made)
        moves |= {column.name: getattr(logged, column.name) for column in MOVE_COLUMNS if column.timed}
    return replace(logged, X=X, U=U, **moves)


def _differences(logged: Run, run: Run) -> Iterator[str]:
    """Yield each column that differs, with the first step at which it does."""
    timed = [column.name for column in MOVE_COLUMNS if column.timed]
    for name in (each for each in logged.columns() if each not in timed):
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
