"""Episodes in files, to the bit: .npz and .parquet."""

import json
import zipfile
from functools import reduce
from os import PathLike
from pathlib import Path

import numpy as np

from koopmpc.data import parquet
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import DataError, LogError


def save_episodes(episodes: Episodes, path: str | PathLike[str]) -> None:
    """Write the episodes to a .npz or .parquet file; `Episodes.save` is this."""
    file = Path(path)
    suffix = _suffix(file)
    X = np.concatenate([episode.X for episode in episodes])
    U = np.concatenate([episode.U for episode in episodes])
    steps = np.array([len(episode) for episode in episodes])
    # Python writes a float so that it reads back to the bit.
    about = json.dumps({"dt": episodes.dt, "states": episodes.states, "inputs": episodes.inputs})
    if suffix == ".parquet":
        parquet.write(file, X, U, steps, episodes.states + episodes.inputs, about)
    else:
        with file.open("wb") as stream:
            np.savez(stream, X=X, U=U, steps=steps, about=np.array(about))


def load_episodes(path: str | PathLike[str], *more: str | PathLike[str]) -> Episodes:
    """Read the episodes of one file, or of several as one set.

    Raises
    ------
    LogError
        A file is missing, is cut, or holds no episodes.
    DataError
        The suffix is neither .npz nor .parquet, or the files have unequal dt or names.
    """
    return reduce(Episodes.__add__, [_read(Path(file)) for file in (path, *more)])


def _read(file: Path) -> Episodes:
    suffix = _suffix(file)
    if not file.is_file():
        raise LogError(f"{file} is not there; check the path")
    try:
        X, U, steps, text = parquet.read(file) if suffix == ".parquet" else _read_npz(file)
        about = json.loads(text)
        parts_X = np.split(X, np.cumsum(steps + 1)[:-1])
        parts_U = np.split(U, np.cumsum(steps)[:-1])
        episodes = [Episode(X=one, U=other) for one, other in zip(parts_X, parts_U, strict=True)]
        return Episodes(episodes, about["dt"], about["states"], about["inputs"])
    except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as error:
        raise LogError(
            f"{file} holds no episodes that can be read: {error}; pass a file that Episodes.save wrote"
        ) from error


def _read_npz(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, str]:
    # Opened here, for numpy leaves a file that it refuses open.
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as held:
        return held["X"], held["U"], held["steps"], str(held["about"])


def _suffix(file: Path) -> str:
    if file.suffix not in (".npz", ".parquet"):
        raise DataError(f"episodes are kept in .npz or .parquet files, not in {file.name!r}; rename it")
    return file.suffix
