"""Episodes in files, to the bit: .npz and .parquet."""

import json
from collections.abc import Sequence
from functools import reduce
from os import PathLike
from pathlib import Path

import numpy as np

from koopmpc import checks
from koopmpc.data import parquet
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.npz import read_arrays
from koopmpc.data.tables import read_table
from koopmpc.errors import DataError, LogError


def save_episodes(episodes: Episodes, path: str | PathLike[str]) -> None:
    """Write the episodes to a .npz or .parquet file; `Episodes.save` is this."""
    file = Path(path)
    suffix = _suffix(file)
    X = np.concatenate([episode.X for episode in episodes])
    driven = episodes.driven()  # U with W behind it
    U = np.concatenate([episode.U for episode in driven])
    steps = np.array([len(episode) for episode in episodes])
    # Python writes a float so that it reads back to the bit.
    names = {"states": episodes.states, "inputs": episodes.inputs, "disturbances": episodes.disturbances}
    about = json.dumps({"dt": episodes.dt, **names})
    if suffix == ".parquet":
        parquet.check_names(driven.states + driven.inputs)
    with checks.writing(file) as stream:
        if suffix == ".parquet":
            parquet.write(stream, X, U, steps, driven.states + driven.inputs, about)
        else:
            np.savez(stream, X=X, U=U, steps=steps, about=np.array(about))


def load_episodes(
    path: str | PathLike[str],
    *more: str | PathLike[str],
    dt: float | None = None,
    states: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
) -> Episodes:
    """Read the episodes of one file, or of several as one set.

    Files that `Episodes.save` wrote say themselves what they hold. A plain .parquet table is read where it is told:
    a row a time step; a column each state and input; a column ``episode`` where there are several, of numbers or
    names; a column ``step`` where the rows are not in order. The inputs of an episode's last row are not read.

    Parameters
    ----------
    path, more
        .npz or .parquet.
    dt
        Sample time of a plain table [s].
    states, inputs
        The names of its columns; ``inputs=[]`` where there are none.

    Raises
    ------
    LogError
        A file is missing, is cut, or holds no episodes.
    DataError
        The suffix is neither .npz nor .parquet, the files have unequal dt or names, or a plain table lacks a
        column, or a step.
    """
    return reduce(Episodes.__add__, [_read(Path(file), dt, states, inputs) for file in (path, *more)])


def _read(
    file: Path, dt: float | None, states: Sequence[str] | None, inputs: Sequence[str] | None
) -> Episodes:
    suffix = _suffix(file)
    checks.existing(file, parquet.ADVICE)
    if suffix == ".parquet" and not parquet.described(file):
        return read_table(file, dt, states, inputs)
    if not (dt is None and states is None and inputs is None):
        raise DataError(f"{file} says itself what it holds; leave out dt, states and inputs")
    try:
        X, U, steps, text = parquet.read(file) if suffix == ".parquet" else _read_npz(file)
        about = json.loads(text)
        disturbances = about.get("disturbances", [])
        nu = U.shape[1] - len(disturbances)
        parts_X = np.split(X, np.cumsum(steps + 1)[:-1])
        parts_U = np.split(U, np.cumsum(steps)[:-1])
        parts = zip(parts_X, parts_U, strict=True)
        episodes = [Episode(X=one, U=other[:, :nu], W=other[:, nu:]) for one, other in parts]
        return Episodes(episodes, about["dt"], about["states"], about["inputs"], disturbances)
    except (KeyError, TypeError, ValueError) as error:
        raise LogError(f"{file} holds no episodes that can be read: {error}; {parquet.ADVICE}") from error


def _read_npz(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
    held = read_arrays(file, ("X", "U", "steps", "about"))
    return held["X"], held["U"], held["steps"], str(held["about"])


def _suffix(file: Path) -> str:
    if file.suffix not in (".npz", ".parquet"):
        raise DataError(f"episodes are kept in .npz or .parquet files, not in {file.name!r}; rename it")
    return file.suffix
