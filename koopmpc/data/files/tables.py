"""A user's own table as episodes: a row a time step, a column a state or an input."""

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from numbers import Real
from pathlib import Path

import numpy as np
from jaxtyping import Float

from koopmpc.base import checks, disk
from koopmpc.base.errors import ColumnWarning, DataError, FitWarning, KoopmpcError, LogError, NoInputWarning
from koopmpc.data.episodes import Episodes
from koopmpc.data.files.columns import ColumnRoles, TableSettings, drop_unit, find_roles, is_clock, is_episode
from koopmpc.data.files.formats import LogTable
from koopmpc.data.files.sampling import Signals, episodes_from, read_clock, resample, restarts, sample_time

SAVED = ("episode", "step", "time [s]")
"""First columns of a table that `Episodes.save` wrote, in which an empty last row tells the inputs of an episode."""

_COUNTER = re.compile(r"|unnamed: \d+|index|idx|row|sample|count|counter")


def is_a_number(cell: object) -> bool:
    """Return whether a cell of a table is a real number, or the text of one in ASCII.

    Python reads 1_000 and the digits of all scripts; the parsers of tables do not, and leave such a column as text.
    """
    text = str(cell)
    if not text.isascii() or "_" in text:
        return False
    try:
        float(text)
    except ValueError:
        return False
    return True


def pick_driving(names: Sequence[str], columns: Mapping[str, np.ndarray]) -> list[str] | None:
    """Return the columns of a saved table that are empty in the last row of each episode; None of any other table."""
    if tuple(names[: len(SAVED)]) != SAVED or any(name not in columns for name in names):
        return None
    episode = columns[SAVED[0]]
    last = np.append(episode[1:] != episode[:-1], True)
    return [name for name in names[len(SAVED) :] if np.array_equal(_is_missing(columns[name]), last)]


def _is_missing(column: np.ndarray) -> np.ndarray:
    return np.array([cell is None or cell != cell for cell in column])


@dataclass(frozen=True, eq=False)
class _Assigned:
    """The columns of a table by their roles: `values` holds states, inputs and disturbances as numbers."""

    roles: ColumnRoles
    columns: Mapping[str, np.ndarray]
    values: Mapping[str, Float[np.ndarray, " M"]]
    time: Float[np.ndarray, " M"] | None  # [s]


def read_table(file: Path, table: LogTable, told: TableSettings) -> Episodes:
    """Return the episodes of a plain table; `load_episodes` says what its columns mean."""
    where = str(file)
    table = _rename_columns(table.with_units(), told, where)
    told = told.match_names(table.names)
    found = _assign_columns(table, told, where)
    roles = found.roles
    if found.time is None and told.resample is not None:
        raise DataError(f"{where} has no column of time to resample by; its columns are {', '.join(table.names)}")
    parts = _split_rows(found, where)
    dt = _choose_step(table, told, found, parts, where)
    if told.resample is not None:
        _affordable(parts, dt, len(roles.values), where)
        parts = resample(parts, dt, where)
    if roles.guessed:
        _doubt(roles, found.values, where, alone=told.inputs is None and not roles.inputs)
    try:
        return Episodes(episodes_from(parts, dt, where), dt, roles.states, roles.inputs, roles.disturbances)
    except KoopmpcError as error:
        if str(error).startswith(where):
            raise
        raise DataError(f"{where}: {error}") from error


def _assign_columns(table: LogTable, told: TableSettings, where: str) -> _Assigned:
    """Return the columns by their roles, and time in seconds; warn of columns that have none."""
    names, columns = table.names, _convert_columns(table, told, where)
    numeric = [name for name in names if name in columns and columns[name].dtype.kind in "fiub"]
    clock = None if table.named else _find_clock(names, columns, told, where)
    roles = find_roles(names, numeric, told, where, pick_driving(names, columns), clock)
    if roles.targets:
        warnings.warn(f"{where}: {_say_set_points(roles.targets)}", FitWarning, stacklevel=3)
    values = {name: checks.array(columns[name], f"{where}: {name}", (None,), finite=False) for name in roles.values}
    for name, column in values.items():
        _plausible(column, name, where)
    if told.states is None and roles.guessed:
        roles = _without_counters(roles, values, where)
    _warn_of_text(columns, told, where)
    time = None
    if roles.time is not None and not (roles.time == clock and told.dt is not None):
        time = read_clock(checks.array(columns[roles.time], roles.time, (None,), finite=False), roles, where)
    return _Assigned(roles, columns, values, time)


def _is_value(name: str, told: TableSettings) -> bool:
    """Return whether a column must hold numbers: the caller names it, or a role is guessed and it labels no rows."""
    return name in told.named or (None in (told.states, told.inputs) and not is_clock(name) and not is_episode(name))


def _convert_columns(table: LogTable, told: TableSettings, where: str) -> dict[str, np.ndarray]:
    if not any(map(len, table.columns.values())):
        raise DataError(f"{where} has columns and no row in them; leave the file out")
    return {
        name: _numbers(column, name, where) if _is_value(name, told) else column
        for name, column in table.columns.items()
    }


def _warn_of_text(columns: Mapping[str, np.ndarray], told: TableSettings, where: str) -> None:
    text = [name for name, column in columns.items() if column.dtype.kind == "O" and _is_value(name, told)]
    if text and None in (told.states, told.inputs):
        warnings.warn(
            f"{where}: {', '.join(map(repr, text))} hold{'s' * (len(text) == 1)} text, and no part of it is a state or "
            "an input; write numbers, or pass states= and inputs=",
            FitWarning,
            stacklevel=4,
        )


def _split_rows(found: _Assigned, where: str) -> list[Signals]:
    """Return the rows of each episode, in the order of their steps, and cut where a recorder was restarted."""
    roles, values = found.roles, found.values
    rows = len(next(iter(values.values())))
    number, step = np.zeros(rows, dtype=np.intp), None
    if roles.episode is not None:
        number = _number_episodes(found.columns[roles.episode], where)
    if roles.step is not None and found.time is None:
        step = checks.array(found.columns[roles.step], f"{where}: step", (None,))
    X, U, W = (
        np.array([values[name] for name in some]).reshape(len(some), rows).T.copy()
        for some in (roles.states, roles.inputs, roles.disturbances)
    )
    parts: list[Signals] = []
    for e in range(int(number.max(initial=-1)) + 1):
        here = np.flatnonzero(number == e)
        if step is not None:
            here = here[np.argsort(step[here], kind="stable")]
            if (np.diff(step[here]) != 1).any():
                raise DataError(f"{where}, episode {e}: steps are missing or come twice; split it there")
        time = None if found.time is None else found.time[here]
        parts += restarts(Signals(time, X[here], U[here], W[here], here + 1, roles.states), where)
    return parts


def _choose_step(table: LogTable, told: TableSettings, found: _Assigned, parts: list[Signals], where: str) -> float:
    """Return the sample time [s]: as given, as the file states it, or as its clock shows it."""
    dt = told.resample if told.resample is not None else told.dt
    if found.time is not None:
        usual = sample_time([part.time for part in parts if part.time is not None], where)
        if dt is None and table.names[: len(SAVED)] == SAVED:
            dt = _find_exact_step(found.columns[SAVED[1]], found.time)
        dt = usual if dt is None else dt
    elif dt is None:
        dt = table.dt
    if dt is None:
        even = next((name for name in found.roles.states if _even(found.values[name])), None)
        clock = "" if even is None else f"; {even!r} looks like it: rename it by columns="
        raise DataError(
            f"{where} does not say its sample time: pass dt=, or add a column 'time [s]'{clock}; its columns are "
            f"{', '.join(table.names)}"
        )
    return checks.positive(dt, "dt", "s")


def _say_set_points(names: Sequence[str]) -> str:
    listed = " and ".join(filter(None, [", ".join(map(repr, names[:-1])), repr(names[-1])]))
    what, them = ("is a set point", "it") if len(names) == 1 else ("are set points", "them")
    by = "by its name" if len(names) == 1 else "by their names"
    return f"{listed} {what} of a controller {by}, and left out; a fit with --goal follows {them}: --set-point"


def _rename_columns(table: LogTable, told: TableSettings, where: str) -> LogTable:
    """Return the table with the names that the caller gives to all columns."""
    count = len(table.names)
    if told.columns is None:
        if not table.named and not told.roles:
            first = ", ".join(f"{table.columns[name][0]:g}" for name in table.names[:4])
            raise LogError(
                f"{where} has no line of names: its first row is {first}; write one above it, or pass columns= with "
                f"{count} names a,b,… or inputs= with the numbers of the columns that are inputs, 1 to {count}"
            )
        return table
    return table.renamed(told.rename(table.names, where))


def _find_clock(names: Sequence[str], columns: Mapping[str, np.ndarray], told: TableSettings, where: str) -> str | None:
    """Return the first column of a table without names where it grows by the same in each row, as time does."""
    first = names[0]
    if first in told.named or columns[first].dtype.kind not in "fiu" or not _even(columns[first]):
        return None
    if told.dt is None:
        warnings.warn(
            f"{where}: column 1 grows by the same in each row and is taken for the time in seconds; pass dt=, or "
            "columns= with names such as 'time [min]'",
            FitWarning,
            stacklevel=3,
        )
    return first


def _numbers(column: np.ndarray, name: str, where: str) -> np.ndarray:
    """Return a column of objects as floats, None as NaN; return a column of text unchanged."""
    if column.dtype.kind != "O":
        return column
    present = [cell for cell in column if cell is not None]
    if present and all(isinstance(cell, Real | Decimal) for cell in present):
        return np.array([np.nan if cell is None else float(cell) for cell in column])
    like = sum(map(_like_a_number, present))
    if like == 0 or 2 * like < len(present):
        return column
    row, cell = next((i, cell) for i, cell in enumerate(column) if cell is not None and not is_a_number(cell))
    raise DataError(
        f"{where}: {name!r} holds {str(cell)!r} in row {row + 1}, which is not a real number; repair the cell, leave "
        "it empty where the value is missing, or name the columns to use: pass states= and inputs="
    )


def _like_a_number(cell: object) -> bool:
    try:
        complex(str(cell).strip().replace(",", "."))
    except ValueError:
        return False
    return True


def _plausible(
    column: Float[np.ndarray, " M"], name: str, where: str, *, many: int = 100, absurd: float = 1e6, most: float = 1e30
) -> None:
    """Raise where a cell of `many` or more is `absurd` times larger than 99 % of them, or above what models compute."""
    size = np.abs(column[np.isfinite(column)])
    if len(size) < many:
        return
    usual, largest = float(np.quantile(size, 0.99, method="lower")), float(size.max())
    if largest > most or (usual > 0 and largest > absurd * usual):
        row = int(np.nanargmax(np.where(np.isfinite(column), np.abs(column), np.nan)))
        raise DataError(
            f"{where}: {name!r} is {column[row]:g} in row {row + 1}, where 99 % of its cells are within {usual:.3g}; "
            "repair the cell, or leave it empty"
        )


def _find_exact_step(step: np.ndarray, time: Float[np.ndarray, " M"]) -> float | None:
    """Return dt where the times are those of step · dt to the bit, as in a table that was saved; else None."""
    first = time[step == 1]
    return float(first[0]) if len(first) and np.array_equal(time, step * first[0]) else None


def _affordable(parts: list[Signals], dt: float, columns: int, where: str) -> None:
    """Raise where the resampled rows do not fit into memory."""
    rows = sum(float(np.nanmax(p.time) - np.nanmin(p.time)) / dt for p in parts if p.time is not None and len(p.time))
    free = disk.memory()
    if free is not None and 16 * rows * columns > free:
        raise DataError(
            f"{where}: resample={dt:g} makes {rows:.3g} rows of {columns} columns, {16e-9 * rows * columns:.3g} GB, "
            f"and {free / 1e9:.3g} GB are free; pass a longer sample time"
        )


def _doubt(found: ColumnRoles, table: Mapping[str, np.ndarray], where: str, *, alone: bool) -> None:
    """Warn of roles that may be guessed wrongly, and of columns that are constant or repeat another."""
    if alone:
        stepped = [name for name in found.states if _is_stepped(table[name])]
        advice = "pass inputs= if some of them are inputs"
        if 0 < len(stepped) < len(found.states):
            hold = "holds its" if len(stepped) == 1 else "hold their"
            advice = f"of these {', '.join(stepped)} {hold} value from row to row, as inputs do: pass inputs="
        missing = f"{where}: no column is named as an input"
        others = ", ".join(found.states)
        doubt = f"{missing}, so the plant is taken to run by itself; its states are {others}; {advice}"
        question = (
            f"{missing}; its columns are {others}; "
            + advice.replace("if some of them are inputs", "with those that drive the plant")
            + ", or inputs=[] if nothing drives it"
        )
        warnings.warn(NoInputWarning(doubt, question), stacklevel=3)
    for i, name in enumerate(found.values):
        column = table[name][np.isfinite(table[name])]
        if len(column) and np.ptp(column) == 0:
            warnings.warn(
                f"{where}: {name!r} is {column[0]:g} throughout; leave it out: pass states= and inputs=",
                ColumnWarning,
                stacklevel=3,
            )
            continue
        for other in found.values[:i]:
            if np.array_equal(table[name], table[other], equal_nan=True):
                warnings.warn(
                    f"{where}: {name!r} repeats {other!r}; leave one out: pass states= and inputs=",
                    ColumnWarning,
                    stacklevel=3,
                )


def _without_counters(found: ColumnRoles, table: dict[str, np.ndarray], where: str) -> ColumnRoles:
    """Return the roles without states that number the rows, such as the index that pandas writes."""
    for name in found.states:
        if _COUNTER.fullmatch(drop_unit(name)) and len(found.states) > 1 and (np.diff(table[name]) == 1).all():
            warnings.warn(f"{where}: {name!r} numbers the rows and is left out", FitWarning, stacklevel=3)
            found = replace(found, states=tuple(other for other in found.states if other != name))
        elif found.time is None and _even(table[name]):
            warnings.warn(
                f"{where}: {name!r} grows by the same in each row and is taken for a state; where it is time, name it "
                "'time [s]'",
                FitWarning,
                stacklevel=3,
            )
    return found


def _even(column: Float[np.ndarray, " M"]) -> bool:
    """Return True for ten rows or more that grow by the same, as time does."""
    changes = np.diff(column)
    return len(changes) >= 9 and bool((changes > 0).all() and np.ptp(changes) <= 1e-3 * changes.max())


def _is_stepped(column: Float[np.ndarray, " M"]) -> bool:
    """Return True for a column that changes, and repeats its last value in more than half of the rows."""
    changes = np.diff(column[np.isfinite(column)])
    return 0 < int(np.count_nonzero(changes)) < len(changes) / 2


def _number_episodes(labels: np.ndarray, where: str) -> np.ndarray:
    """Return 0, 1, … for the labels in the order in which they first come."""
    if _is_missing(labels).any():
        raise DataError(f"{where} has rows whose episode is null; give each row the name of its episode")
    known: dict[object, int] = {}
    return np.array([known.setdefault(label, len(known)) for label in labels.tolist()], dtype=np.intp)
