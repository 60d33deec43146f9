"""A user's own table as episodes: a row a time step, a column a state or an input."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.data import parquet
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import DataError, KoopmpcError


def read_table(
    file: Path, dt: float | None, states: Sequence[str] | None, inputs: Sequence[str] | None
) -> Episodes:
    """Return the episodes of a plain .parquet table; `load_episodes` says what its columns mean.

    Raises
    ------
    DataError
        Something is not told, a column is missing, or its rows are no whole episodes.
    """
    names = parquet.names(file)
    if dt is None or states is None or inputs is None:
        missing = [n for n, v in (("dt", dt), ("states", states), ("inputs", inputs)) if v is None]
        raise DataError(
            f"{file} is a table that does not say what it holds: pass {', '.join(f'{n}=' for n in missing)}; "
            f"its columns are {', '.join(names)}"
        )
    for what, given in (("states", states), ("inputs", inputs)):
        if isinstance(given, str):
            raise DataError(f"{what} is {given!r}; pass a tuple of names")
    own = (*states, *inputs)
    for name in own:
        if names.count(name) != 1:
            has = "has two columns" if name in names else "has no column"
            raise DataError(f"{file} {has} {name!r}; its columns are {', '.join(names)}")
    index = [name for name in ("episode", "step") if names.count(name) == 1 and name not in own]
    columns = parquet.columns(file, [*index, *own])
    rows = len(next(iter(columns.values()))) if columns else 0
    episode = _numbered(columns["episode"], file) if "episode" in index else np.zeros(rows, dtype=np.intp)
    step = checks.array(columns["step"], f"{file}: step", (None,)) if "step" in index else np.arange(rows)
    order = np.lexsort((step, episode))
    table = {
        name: checks.array(columns[name], f"{file}: {name}", (None,), finite=False)[order] for name in own
    }
    X, U = (_stacked([table[name] for name in some], rows) for some in (states, inputs))
    found: list[Episode] = []
    for e in range(int(episode.max(initial=-1)) + 1):
        here = episode[order] == e
        if "step" in index and (np.diff(step[order][here]) != 1).any():
            raise DataError(f"{file}, episode {e}: steps are missing or come twice; split it there")
        try:
            found.append(Episode(X=X[here], U=U[here][:-1]))
        except KoopmpcError as error:
            raise DataError(f"{file}, episode {e}: {error}") from error
    return Episodes(found, dt, tuple(states), tuple(inputs))


def _numbered(labels: np.ndarray, file: Path) -> np.ndarray:
    """Return 0, 1, … for the labels in the order in which they first come."""
    if any(label is None or label != label for label in labels):
        raise DataError(f"{file} has rows whose episode is null; give each row the name of its episode")
    _, first, number = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.intp)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[number]


def _stacked(columns: list[np.ndarray], rows: int) -> Float[np.ndarray, "rows n"]:
    return np.stack(columns, axis=1) if columns else np.empty((rows, 0))
