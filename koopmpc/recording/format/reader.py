# pyright: basic
"""load_run: a log back into the Run that was written, to the bit."""

import warnings
from pathlib import Path

import numpy as np

from koopmpc.control.move import Fallback, Status
from koopmpc.data.episodes import Episodes
from koopmpc.data.sampling import Signals, episodes_from
from koopmpc.disk import path_of
from koopmpc.errors import LogError
from koopmpc.loop.run import About, Plans, Run
from koopmpc.recording.description import from_json
from koopmpc.recording.format.rrd import DRAWN, NO_SOLVER, Entity, LogColumns, naming, read_columns


def load_run(path: str | Path) -> Run:
    """Return the Run that `record` or a `Recorder` wrote to `path`, equal to the bit.

    A log that was cut short, or whose writer died, yields the steps that are whole, and a UserWarning.

    Raises
    ------
    LogError
        The file is missing, no log of koopmpc, damaged, or holds no whole step.
    """
    path = path_of(path)
    log = read_columns(path, tuple(f"/{entity}" for entity in Entity if entity not in DRAWN))
    with naming(path):
        return _run(log, path)


def _run(log: LogColumns, path: Path) -> Run:
    about, planned_steps = about_of(log, path)
    X, reference = log.vectors(Entity.STATE), log.vectors(Entity.REFERENCE)
    U = log.vectors(Entity.INPUT)
    seconds = log.held(Entity.SOLVER, "seconds", log.column(Entity.SOLVER) / 1e3)
    iterations = log.held(Entity.SOLVER, "iterations", np.zeros(len(seconds), dtype=np.int64))
    counts = [len(X) - 1, len(seconds)]
    counts += [len(U)] if about.inputs else []
    counts += [len(reference) - 1] if len(reference) else []
    steps = min(counts)
    if steps < 1:
        raise LogError(f"{path} holds no whole step; its run ended before the second state was written")
    end = log.static(Entity.METRICS, "steps")
    total = planned_steps if end is None else end
    if total != steps:
        of = "" if total is None else f" of {total}"
        warnings.warn(
            f"{path} ends after step {steps}{of}: the file was cut short or its writer did not close it; "
            "the run holds what is there",
            UserWarning,
            stacklevel=3,
        )
    elif end is None or log.torn:
        warnings.warn(f"{path}: its end is cut, all {steps} steps are there", UserWarning, stacklevel=3)
    if end == steps and (changed := log.changed()):
        raise LogError(f"{path} is damaged: {', '.join(changed)} no longer hold what was written; take another copy")
    status, fallback = _statuses(log, steps, path)
    return Run(
        X=X[: steps + 1],
        Y=_measured(log, X)[: steps + 1],
        U=U[:steps] if len(U) else np.empty((steps, 0)),
        reference=reference[: steps + 1] if len(reference) else np.empty((steps + 1, 0)),
        status=status,
        fallback=fallback,
        solve_time=seconds[:steps],
        iterations=iterations[:steps].astype(np.int64),
        plans=_plans(log, steps),
        u_reference=_sparse(log, Entity.INPUT_REFERENCE, steps, len(about.inputs)),
        slack=_sparse(log, Entity.SLACK, steps, 1)[:, 0],
        known=_sparse(log, Entity.KNOWN, steps, 1, absent=-1.0)[:, 0].astype(np.int64),
        solver=_solvers(log, steps),
        **about.about(),
    )


def about_of(log: LogColumns, path: Path) -> tuple[About, int | None]:
    """Return what does not change in a run, and its number of steps where it was known beforehand."""
    text = log.static(Entity.DESCRIPTION, "json")
    if text is None:
        raise LogError(
            f"{path} is a Rerun recording, but no log of koopmpc: it has no description, or was cut before it"
        )
    try:
        return from_json(text)
    except LogError as error:
        raise LogError(f"{path} is damaged or of another version: {error}") from error


def _measured(log: LogColumns, X: np.ndarray) -> np.ndarray:
    """Return the measurements: the states, except in the rows that were written separately."""
    k, values = log.matrix(Entity.MEASUREMENT)
    if not len(k):
        return X.copy()
    if values.shape[1] != X.shape[1]:
        return values
    Y = X.copy()
    inside = k < len(Y)
    Y[k[inside]] = values[inside]
    return Y


def _sparse(log: LogColumns, entity: str, steps: int, width: int, absent: float = 0.0) -> np.ndarray:
    """Return the rows of an entity, `absent` where no row was written."""
    k, values = log.matrix(entity)
    held, inside = np.full((steps, width), absent), k < steps
    if len(k):
        held[k[inside]] = values[inside]
    return held


def _statuses(log: LogColumns, steps: int, path: Path) -> tuple[tuple[Status, ...], tuple[Fallback, ...]]:
    """Return status and fallback of each step: the last change at or before it."""
    k, _, words = log.rows(Entity.STATUS, "state")
    if not len(k) or k[0] != 0:
        raise LogError(f"{path} lacks the status of its first step; it was not written by koopmpc")
    try:
        pairs = [_pair(word) for word in words.to_pylist()]
    except KeyError as error:
        raise LogError(f"{path} holds the status {error}, which this version of koopmpc does not know") from error
    held = [pairs[i] for i in np.searchsorted(k, np.arange(steps), side="right") - 1]
    return tuple(s for s, _ in held), tuple(f for _, f in held)


def _solvers(log: LogColumns, steps: int) -> tuple[str, ...]:
    """Return the solver of each step: the last change at or before it; older logs have none."""
    k, _, words = log.rows(Entity.QP, "state")
    names = [NO_SOLVER, *(words.to_pylist() if len(k) else [])]
    held = np.searchsorted(k, np.arange(steps), side="right")
    return tuple("" if names[i] == NO_SOLVER else names[i] for i in held)


def _pair(word: str) -> tuple[Status, Fallback]:
    status, _, fallback = word.partition(" → ")
    return Status[status], Fallback[fallback or "NONE"]


def _plans(log: LogColumns, steps: int) -> Plans | None:
    """Return the plans, NaN where a step had none; None where no step had one."""
    parts = []
    for entity in (Entity.PLAN_STATES, Entity.PLAN_INPUTS):
        k, values = log.matrix(entity)
        width = log.static(entity, "last_width")
        if width is None or not len(k):
            return None
        whole = np.full((steps, values.shape[1] // width, width), np.nan)
        inside = k < steps
        whole[k[inside]] = values[inside].reshape(-1, *whole.shape[1:])
        parts.append(whole)
    return Plans(*parts)


def run_episodes(path: Path) -> Episodes:
    """Return the inputs and states of a run's log, or its measurements where the plant hides them all, as episodes.

    A row with a missing value ends an episode.

    Raises
    ------
    LogError
        The log is missing, damaged, or was not written by koopmpc.
    DataError
        The run has no two steps in sequence whose state is known.
    """
    run = load_run(path)
    steps = len(run.U)
    U = np.vstack([run.U, np.full((1, run.U.shape[1]), np.nan)])
    hidden = not np.isfinite(run.X).any()
    X, names = (run.Y, run.outputs) if hidden else (run.X, run.states)
    signals = Signals(None, X, U, np.empty((steps + 1, 0)), np.arange(steps + 1))
    return Episodes(episodes_from([signals], run.dt, str(path)), run.dt, names, run.inputs)
