"""Episodes in .npz files: the stacked rows and their names, equal to the bit."""

import json
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from koopmpc.base import disk
from koopmpc.base.errors import LogError
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.files.formats import ADVICE, LogFormat, register_format


def describe_episodes(episodes: Episodes) -> str:
    """Return sample time and names as JSON; Python writes a float so that it reads back to the bit."""
    names = {"states": episodes.states, "inputs": episodes.inputs, "disturbances": episodes.disturbances}
    return json.dumps({"dt": episodes.dt, **names})


def stack_episodes(episodes: Episodes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the stacked rows X, the stacked rows [U W], and the steps of each episode."""
    X = np.concatenate([episode.X for episode in episodes])
    U = np.concatenate([episode.U for episode in episodes.driven()])
    return X, U, np.array([len(episode) for episode in episodes])


def split_rows(X: np.ndarray, U: np.ndarray, steps: np.ndarray, about: str) -> Episodes:
    """Return the episodes of stacked rows; the reverse of `stack_episodes` and `describe_episodes`."""
    named: dict[str, Any] = json.loads(about)
    nu = U.shape[1] - len(named["disturbances"])
    rows = zip(np.split(X, np.cumsum(steps + 1)[:-1]), np.split(U, np.cumsum(steps)[:-1]), strict=True)
    episodes = [Episode(X=x, U=u[:, :nu], W=u[:, nu:]) for x, u in rows]
    return Episodes(episodes, named["dt"], named["states"], named["inputs"], named["disturbances"])


def write_npz(stream: BinaryIO, episodes: Episodes) -> None:
    """Write the episodes."""
    X, U, steps = stack_episodes(episodes)
    np.savez(stream, X=X, U=U, steps=steps, about=np.array(describe_episodes(episodes)))


def read_npz(file: Path) -> Episodes:
    """Return the episodes of a file that `write_npz` wrote."""
    try:
        with disk.Members(file) as members:
            members.require("X", "U", "steps", "about")
            return split_rows(members["X"], members["U"], members["steps"], str(members["about"]))
    except (KeyError, TypeError, ValueError) as error:
        raise LogError(f"{file} holds no episodes that can be read: {error}; {ADVICE}") from error


register_format(LogFormat((".npz",), read_npz, write_npz))
