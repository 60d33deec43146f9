# pyright: basic
"""The door to pyarrow: episodes as one table, a row a time step, a column a state or an input."""

import json
from pathlib import Path

import numpy as np

from koopmpc.errors import DataError

_KEY = b"koopmpc.episodes"


def write(
    path: Path, X: np.ndarray, U: np.ndarray, steps: np.ndarray, names: tuple[str, ...], about: str
) -> None:
    """Write the stacked rows; the inputs of an episode's last row are null, for none was applied there.

    Raises
    ------
    DataError
        A state or an input is named like one of the table's own columns.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    for name in ("episode", "step"):
        if name in names:
            raise DataError(
                f"a .parquet file has a column {name!r} of its own; rename the state, or save as .npz"
            )
    episode, step = _index(steps)
    last = step == steps[episode]
    full = np.zeros((len(X), U.shape[1]))
    full[~last] = U
    columns = [pa.array(column) for column in (episode, step, *X.T)]
    columns += [pa.array(column, mask=last) for column in full.T]
    table = pa.table(columns, names=["episode", "step", *names])
    pq.write_table(table.replace_schema_metadata({_KEY: about.encode()}), path)


def read(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
    """Return X, U, the steps of each episode, and the text beside them.

    Raises
    ------
    ValueError, OSError
        It is no such table, or pyarrow cannot read it.
    """
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    metadata = table.schema.metadata or {}
    if _KEY not in metadata:
        raise ValueError("the table does not say dt, states and inputs")
    about = metadata[_KEY].decode()
    named = json.loads(about)
    episode, step = (table[name].to_numpy() for name in ("episode", "step"))
    steps = np.bincount(episode) - 1
    expected = _index(steps)
    if not (np.array_equal(episode, expected[0]) and np.array_equal(step, expected[1])):
        raise ValueError("rows are missing or out of order")
    last = step == steps[episode]
    X = [table[name].to_numpy() for name in named["states"]]
    U = [table[name].to_numpy()[~last] for name in named["inputs"]]
    return (
        np.stack(X, axis=1),
        np.array(U).reshape(len(U), -1).T if U else np.empty((steps.sum(), 0)),
        steps,
        about,
    )


def _index(steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the episode and the step of every row."""
    rows = steps + 1
    first = np.cumsum(rows) - rows
    return np.repeat(np.arange(len(steps)), rows), np.arange(rows.sum()) - np.repeat(first, rows)
