# pyright: basic
"""The door to pyarrow: episodes as one table, a row a time step, a column a state or an input."""

import json
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from koopmpc.errors import DataError, LogError

_KEY = b"koopmpc.episodes"
ADVICE = "pass a file that Episodes.save wrote, or a table as .parquet"


def check_names(names: tuple[str, ...], suffix: str) -> None:
    """Raise where a state or an input is named like one of the table's own columns.

    Raises
    ------
    DataError
        One is.
    """
    for name in ("episode", "step"):
        if name in names:
            raise DataError(f"a {suffix} file has a column {name!r} of its own; rename the state, or save as .npz")


def write(file: BinaryIO, X: np.ndarray, U: np.ndarray, steps: np.ndarray, names: tuple[str, ...], about: str) -> None:
    """Write the stacked rows; the inputs of an episode's last row are null, for none was applied there."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    episode, step = positions(steps)
    last = step == steps[episode]
    full = np.zeros((len(X), U.shape[1]))
    full[~last] = U
    columns = [pa.array(column) for column in (episode, step, *X.T)]
    columns += [pa.array(column, mask=last) for column in full.T]
    table = pa.table(columns, names=["episode", "step", *names])
    pq.write_table(table.replace_schema_metadata({_KEY: about.encode()}), file)


def described(path: Path) -> bool:
    """Return whether the table says what it holds: whether `write` wrote it.

    Raises
    ------
    LogError
        It is no .parquet file.
    """
    return _KEY in (_schema(path).metadata or {})


def names(path: Path) -> list[str]:
    """Return the names of the columns."""
    return _schema(path).names


def columns(path: Path, wanted: list[str]) -> dict[str, np.ndarray]:
    """Return the columns of these names; null is NaN among numbers and None among others.

    Raises
    ------
    LogError
        The file is damaged.
    """
    table = _table(path, wanted)
    return {name: table[name].to_numpy() for name in wanted}


def read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
    """Return X, U, the steps of each episode, and the text beside them, of a table that `write` wrote.

    Raises
    ------
    LogError, ValueError
        It is damaged; its rows were changed.
    """
    table = _table(path)
    metadata = table.schema.metadata
    about = metadata[_KEY].decode()
    named = json.loads(about)
    episode, step = (table[name].to_numpy() for name in ("episode", "step"))
    steps = np.bincount(episode) - 1
    expected = positions(steps)
    if not (np.array_equal(episode, expected[0]) and np.array_equal(step, expected[1])):
        raise ValueError("rows are missing or out of order")
    last = step == steps[episode]
    X = [table[name].to_numpy() for name in named["states"]]
    U = [table[name].to_numpy()[~last] for name in named["inputs"] + named.get("disturbances", [])]
    return (
        np.stack(X, axis=1),
        np.array(U).reshape(len(U), -1).T if U else np.empty((steps.sum(), 0)),
        steps,
        about,
    )


def positions(steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the episode and the step of every row."""
    rows = steps + 1
    first = np.cumsum(rows) - rows
    return np.repeat(np.arange(len(steps)), rows), np.arange(rows.sum()) - np.repeat(first, rows)


def _schema(path: Path) -> Any:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.read_schema(path)
    except (pa.ArrowException, OSError) as error:
        raise LogError(
            f"{path} holds no episodes that can be read: it is no .parquet file, or was cut; {ADVICE}"
        ) from error


def _table(path: Path, wanted: list[str] | None = None) -> Any:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return pq.read_table(path, columns=wanted)
    except (pa.ArrowException, OSError) as error:
        raise LogError(f"{path} holds no episodes that can be read: its columns are damaged; {ADVICE}") from error
