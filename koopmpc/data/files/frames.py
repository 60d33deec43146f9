# pyright: basic
"""DataFrames of pandas: tables in memory, as episodes and back. pandas is imported when it is used."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.base import checks
from koopmpc.base.errors import DataError, KoopmpcError, install
from koopmpc.data.episodes import Episodes
from koopmpc.data.files.columns import TableSettings
from koopmpc.data.files.formats import LogTable
from koopmpc.data.files.tables import read_table

_FRAME = Path("the DataFrame")  # its place in messages
_TIME = "time [s]"  # name of the clock
_EPISODE = "episode"  # name of the column that tells episodes apart


def is_frame(given: object) -> bool:
    """Return whether an object is a DataFrame; nothing is imported to find out."""
    pandas = sys.modules.get("pandas")
    return pandas is not None and isinstance(given, pandas.DataFrame)


def read_frame(frame: Any, settings: TableSettings, by: str | None = None, time: str | None = None) -> Episodes:
    """Return the episodes of a DataFrame; `Episodes.from_frame` says what the columns mean."""
    if not is_frame(frame):
        raise DataError(f"frame is {checks.article(frame)}; pass a pandas.DataFrame")
    names = [str(name) for name in frame.columns]
    columns = {name: np.asarray(frame.iloc[:, i]) for i, name in enumerate(names) if names.count(name) == 1}
    if time is None and str(frame.index.dtype).startswith("datetime"):
        columns = {_TIME: np.asarray(frame.index), **columns}
        names = [_TIME, *names]
    for role, column, own in (("by", by, _EPISODE), ("time", time, _TIME)):
        if column is None:
            continue
        if column not in columns:
            raise DataError(f"the DataFrame has no column {column!r} for {role}=; its columns are {', '.join(names)}")
        names[names.index(column)] = own
        columns = {own if name == column else name: values for name, values in columns.items()}
    clocks = {name: values for name, values in columns.items() if values.dtype.kind in "mM"}
    for name, values in clocks.items():
        first = values[~np.isnat(values)][:1]
        zero = first if values.dtype.kind == "M" else np.zeros(1, dtype=values.dtype)
        columns[name] = (values - zero) / np.timedelta64(1, "ns") * 1e-9 if len(first) else np.full(len(values), np.nan)
    return read_table(_FRAME, LogTable(tuple(names), columns), settings)


def build_frame(columns: dict[str, Any]) -> Any:
    """Return a DataFrame of these columns."""
    try:
        import pandas as pd
    except ModuleNotFoundError as error:
        raise KoopmpcError(
            f"to_frame makes a pandas.DataFrame, and pandas is not installed; {install('pandas')}"
        ) from error
    return pd.DataFrame(columns)


def list_columns(episodes: Episodes) -> dict[str, np.ndarray]:
    """Return episode, step, time and all signals, a row a time step; inputs of an episode's last row are NaN."""
    rows = [len(episode) + 1 for episode in episodes]
    step = np.concatenate([np.arange(count) for count in rows])
    columns: dict[str, np.ndarray] = {"episode": np.repeat(np.arange(len(rows)), rows), "step": step}
    columns[_TIME] = step * episodes.dt
    X = np.concatenate([episode.X for episode in episodes])
    driven = [np.vstack([np.hstack([e.U, e.W]), np.full((1, episodes.nu + episodes.nw), np.nan)]) for e in episodes]
    names: Sequence[str] = (*episodes.states, *episodes.inputs, *episodes.disturbances)
    return columns | dict(zip(names, np.hstack([X, np.concatenate(driven)]).T, strict=True))
