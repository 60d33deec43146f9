# pyright: basic
"""load_run makes the columns of a log the Run that was written."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.base.disk import path_of
from koopmpc.base.errors import LogError
from koopmpc.control.move import Fallback, Status
from koopmpc.data.episodes import Episodes
from koopmpc.data.files.formats import LogFormat, register_format
from koopmpc.data.files.sampling import Signals, episodes_from
from koopmpc.loop.rows import MOVE_COLUMNS, Plans
from koopmpc.loop.run import About, Run
from koopmpc.views.recording.description import NO_WORD, READ, WORDS, Entity, from_json, sparse_columns
from koopmpc.views.recording.rrd import LogColumns


def load_run(path: str | Path) -> Run:
    """Return the Run that `record` or a `Recorder` wrote to `path`, equal to the bit.

    A log that was cut short, or whose writer died, yields the steps that are whole, and a UserWarning.

    Raises
    ------
    LogError
        The file is missing, no log of koopmpc, damaged, or holds no whole step.
    """
    log = LogColumns(path_of(path), *READ, *(column.log for column in MOVE_COLUMNS if column.log))
    with log.reading():
        about, planned_steps = about_of(log)
        X, reference, U = (log.vectors(entity) for entity in (Entity.STATE, Entity.REFERENCE, Entity.INPUT))
        ms = log.vectors(Entity.SOLVER).reshape(-1)
        counts = [len(X) - 1, len(ms)]
        counts += [len(U)] if about.inputs else []
        counts += [len(reference) - 1] if len(reference) else []
        steps = min(counts)
        if steps < 1:
            raise LogError(f"{log.path} holds no whole step; its run ended before the second state was written")
        ended = log.static(Entity.METRICS, "steps")  # a recording that a viewer saved may hold fewer rows
        if not log.closed or ended not in (None, steps):
            _warn_of_cut(log.path, steps, planned_steps if ended is None else ended)
        columns = sparse_columns(X, ms, len(about.outputs), len(about.inputs))
        return Run(
            X=X[: steps + 1],
            U=U[:steps] if len(U) else np.empty((steps, 0)),
            reference=reference[: steps + 1] if len(reference) else np.empty((steps + 1, 0)),
            plans=_read_plans(log, steps),
            **{
                name: log.fill(entity, component, absent)[: steps + (name == "Y")]
                for name, (entity, component, absent) in columns.items()
            },
            **{
                name: tuple("" if word == NO_WORD else word for word in _read_words(log, entity, steps))
                for entity, name in WORDS.items()
            },
            **_read_status(log, steps),
            **about.about(),
        )


def _warn_of_cut(path: Path, steps: int, planned: int | None) -> None:
    """Warn that a log was cut, or not closed."""
    of = "" if planned is None else f" of {planned}"
    said = f"{path} ends after step {steps}{of}: the file was cut short or "
    said += "its writer did not close it; the run holds what is there"
    if steps == planned:
        said = f"{path}: its end is cut, all {steps} steps are there"
    warnings.warn(said, UserWarning, stacklevel=3)


def _read_words(log: LogColumns, entity: str, steps: int) -> list[str]:
    """Return the word of each step: the last change at or before it."""
    k, changes = log.words(entity)
    words = [NO_WORD, *changes]
    return [words[i] for i in np.searchsorted(k, np.arange(steps), side="right")]


def _read_status(log: LogColumns, steps: int) -> dict[str, Any]:
    """Return status and fallback of each step."""
    words = _read_words(log, Entity.STATUS, steps)
    if NO_WORD in words:
        raise LogError(f"{log.path} lacks the status of its first step; it was not written by koopmpc")
    ends = [word.partition(" → ") for word in words]
    try:
        return {
            "status": tuple(Status[status] for status, _, _ in ends),
            "fallback": tuple(Fallback[fallback or "NONE"] for *_, fallback in ends),
        }
    except KeyError as error:
        raise LogError(f"{log.path} holds the status {error}, which this version of koopmpc does not know") from error


def _read_plans(log: LogColumns, steps: int) -> Plans | None:
    """Return the plans, NaN where a step had none; None where no step had one."""
    parts = []
    for entity in (Entity.PLAN_STATES, Entity.PLAN_INPUTS):
        width = log.static(entity, "last_width")
        length = log.matrix(entity)[1].shape[1]
        if width is None or not length:
            return None
        parts.append(log.fill(entity, "scalars", np.full((steps, length // width, width), np.nan)))
    return Plans(*parts)


def about_of(log: LogColumns) -> tuple[About, int | None]:
    """Return what does not change in a run, and its number of steps where it was known beforehand."""
    text = log.static(Entity.DESCRIPTION, "json")
    if text is None:
        raise LogError(
            f"{log.path} is a Rerun recording, but no log of koopmpc: it has no description, or was cut before it"
        )
    try:
        return from_json(text)
    except LogError as error:
        raise LogError(f"{log.path} is damaged or of another version: {error}") from error


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


register_format(LogFormat((".rrd",), run_episodes))
