# pyright: basic
"""load_run makes the columns of a log the Run that was written."""

import json
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np

from koopmpc.base.disk import path_of
from koopmpc.base.errors import DataError, LogError
from koopmpc.control.move import Fallback, Status
from koopmpc.data.episodes import Episodes
from koopmpc.data.files.formats import LogFormat, register_format
from koopmpc.data.files.sampling import Signals, episodes_from
from koopmpc.loop.rows import MOVE_COLUMNS, MoveColumn, Plans
from koopmpc.loop.run import About, Run
from koopmpc.views.recording.description import DRAWN, NO_WORD, Entity, digest, from_json, sum_plans
from koopmpc.views.recording.rrd import Contents, check_log, read


class LogColumns:
    """The columns of a recording: rows in order of their step, by (entity, component).

    `torn` says that the file ends within a message, `intact` that it is to the bit what was written.
    """

    def __init__(self, contents: Contents) -> None:
        self.torn, self.intact = contents.torn, contents.intact
        self._parts: dict[tuple[str, str], list[tuple[Any, Any]]] = {}
        for entity, component, k, values in contents.columns:
            steps = None if k is None else k.to_numpy(zero_copy_only=False).astype(np.int64)
            self._parts.setdefault((entity, component), []).append((steps, values))

    def static(self, entity: str, component: str) -> Any:
        """Return the one value that does not change, or None."""
        parts = self._parts.get(_key(entity, component))
        return None if parts is None else parts[-1][1].to_pylist()[-1][0]

    def entities(self) -> list[str]:
        """Return the entities that have data."""
        return list(dict.fromkeys(entity for entity, _ in self._parts))

    def lists(self, entity: str, component: str) -> tuple[np.ndarray, list[Any]]:
        """Return the steps and the list of values of each row, in order of the steps."""
        parts = [(k, column) for k, column in self._parts.get(_key(entity, component), []) if k is not None]
        pairs = [pair for k, column in parts for pair in zip(k.tolist(), column.to_pylist(), strict=True)]
        pairs.sort(key=lambda pair: pair[0])
        return np.array([k for k, _ in pairs], dtype=np.int64), [values for _, values in pairs]

    def rows(self, entity: str, component: str) -> tuple[np.ndarray, np.ndarray, Any]:
        """Return the steps, the width, and the flat values of a component, in order of the steps."""
        import pyarrow as pa

        parts = self._parts.get(_key(entity, component), [])
        if not parts:
            return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0)
        if parts[0][0] is None:
            return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), parts[-1][1].flatten()
        k = np.concatenate([k for k, _ in parts])
        lists = pa.concat_arrays([column for _, column in parts])
        order = np.argsort(k, kind="stable")
        if (np.diff(k) < 0).any():
            k, lists = k[order], lists.take(pa.array(order))
        widths = lists.value_lengths().to_numpy(zero_copy_only=False)
        return k, widths, lists.flatten()

    def matrix(self, entity: str, component: str = "scalars") -> tuple[np.ndarray, np.ndarray]:
        """Return the steps and one row of values each."""
        k, widths, values = self.rows(entity, component)
        flat = values if isinstance(values, np.ndarray) else values.to_numpy(zero_copy_only=False)
        if len(widths) and (widths != widths[0]).any():
            raise DataError(f"{entity} has rows of different lengths")
        return k, np.array(flat).reshape(len(k), int(widths[0]) if len(widths) else 0)

    def vectors(self, entity: str) -> np.ndarray:
        """Return the rows 0, 1, … up to the first that is missing."""
        k, values = self.matrix(entity)
        gaps = np.flatnonzero(k != np.arange(len(k)))
        return values[: gaps[0]] if len(gaps) else values

    def fill(self, entity: str, component: str, column: np.ndarray) -> np.ndarray:
        """Return `column`, with the numbers of this component in the rows that have one."""
        k, widths, values = self.rows(entity, component)
        return _fill(column, k[widths > 0], np.array(values))


def _fill(rows: np.ndarray, k: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return a copy of `rows` with these values in its rows k; what lies beyond its end is left out."""
    found, inside = rows.copy(), k < len(rows)
    found[k[inside]] = values[inside]
    return found


def _key(entity: str, component: str) -> tuple[str, str]:
    return f"/{entity.removeprefix('/')}", component


def read_columns(path: Path, entities: tuple[str, ...]) -> LogColumns:
    """Return the columns of the `entities` in the file.

    Raises
    ------
    LogError
        The file is missing, no .rrd, or damaged beyond a torn end.
    """
    check_log(path)
    return LogColumns(read(path, entities))


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Raise LogError with the name of the file where its columns are not what koopmpc writes.

    Raises
    ------
    LogError
        The block failed on a value that it took from the columns.
    """
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, NotImplementedError, TypeError, ValueError) as error:
        raise LogError(f"{path} is damaged: {error}") from error


def load_run(path: str | Path) -> Run:
    """Return the Run that `record` or a `Recorder` wrote to `path`, equal to the bit.

    A log that was cut short, or whose writer died, yields the steps that are whole, and a UserWarning.

    Raises
    ------
    LogError
        The file is missing, no log of koopmpc, damaged, or holds no whole step.
    """
    path = path_of(path)
    entities = [entity for entity in Entity if entity not in DRAWN]
    entities += [column.log for column in MOVE_COLUMNS if column.log]
    log = read_columns(path, tuple(f"/{entity}" for entity in entities))
    with naming(path):
        return _run(log, path)


def _run(log: LogColumns, path: Path) -> Run:
    about, planned_steps = about_of(log, path)
    X, reference = log.vectors(Entity.STATE), log.vectors(Entity.REFERENCE)
    U = log.vectors(Entity.INPUT)
    seconds = log.fill(Entity.SOLVER, "seconds", log.vectors(Entity.SOLVER).reshape(-1) / 1e3)
    iterations = log.fill(Entity.SOLVER, "iterations", np.zeros(len(seconds), dtype=np.int64))
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
    status, fallback = _statuses(log, steps, path)
    run = Run(
        X=X[: steps + 1],
        Y=_read_measurements(log, X)[: steps + 1],
        U=U[:steps] if len(U) else np.empty((steps, 0)),
        reference=reference[: steps + 1] if len(reference) else np.empty((steps + 1, 0)),
        status=status,
        fallback=fallback,
        solve_time=seconds[:steps],
        iterations=iterations[:steps].astype(np.int64),
        plans=_plans(log, steps),
        u_reference=_sparse(log, Entity.INPUT_REFERENCE, steps, len(about.inputs)),
        **{column.name: _move_column(log, column, steps) for column in MOVE_COLUMNS if column.log},
        **about.about(),
    )
    if end == steps:
        _check_digest(log, run, path)
    return run


def _check_digest(log: LogColumns, run: Run, path: Path) -> None:
    """Raise where the run is not the one whose digest stands at the end of the log.

    Logs of before 0.1.0 have no digest: they are read while they are to the bit what was written.
    """
    text = log.static(Entity.METRICS, "digest")
    if text is None and not log.intact:
        raise LogError(f"{path} is damaged, or of an edition before 0.1.0 and changed since; take another copy")
    plans = run.plans
    sums = {} if plans is None else sum_plans(range(run.steps), plans.X, plans.U)
    found = digest(run, log.static(Entity.DESCRIPTION, "json"), sums)
    written = found if text is None else cast("dict[str, int]", json.loads(text))
    if changed := [name for name in written | found if written.get(name) != found.get(name)]:
        raise LogError(f"{path} is damaged: {', '.join(changed)} no longer hold what was written; take another copy")


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


def _read_measurements(log: LogColumns, X: np.ndarray) -> np.ndarray:
    """Return the measurements: the states, except in the rows that were written separately."""
    k, values = log.matrix(Entity.MEASUREMENT)
    if not len(k):
        return X.copy()
    return _fill(X, k, values) if values.shape[1] == X.shape[1] else values


def _sparse(log: LogColumns, entity: str, steps: int, width: int, absent: float = 0.0) -> np.ndarray:
    """Return the rows of an entity, `absent` where no row was written."""
    k, values = log.matrix(entity)
    held = np.full((steps, width), absent)
    return _fill(held, k, values) if len(k) else held


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


def _move_column(log: LogColumns, column: MoveColumn, steps: int) -> Any:
    """Return a column that a log keeps where it differs from the absent value, or where its words change."""
    if column.dtype is not None:
        return _sparse(log, column.log, steps, 1, float(column.absent))[:, 0].astype(column.dtype)
    k, _, words = log.rows(column.log, "state")
    names = [NO_WORD, *(words.to_pylist() if len(k) else [])]
    last = np.searchsorted(k, np.arange(steps), side="right")
    return tuple(column.absent if names[i] == NO_WORD else names[i] for i in last)


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
        parts.append(_fill(whole, k, values.reshape(-1, *whole.shape[1:])))
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


register_format(LogFormat((".rrd",), run_episodes))
