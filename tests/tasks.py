"""Functions that tests send to worker processes: they must stand at the top of a module."""

from __future__ import annotations  # nothing of koopmpc is imported before a task needs it

import os
import signal
import threading
import time
from pathlib import Path

import koopmpc as km


def square(x: int) -> int:
    return x * x


def threads(_: int) -> str:
    return os.environ["OPENBLAS_NUM_THREADS"]


def die(_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def die_once(task: tuple[str, int]) -> int:
    """Kill the worker the first time that the third task is done."""
    folder, i = task
    mark = Path(folder) / "died"
    if i == 2 and not mark.exists():
        mark.touch()
        die(i)
    return i


def die_at_two(i: int) -> int:
    if i == 2:
        die(i)
    return i


def kill_at_three(task: tuple[int, int]) -> int:
    """Kill the process of this number with the fourth task."""
    pid, i = task
    if i == 3:
        os.kill(pid, signal.SIGKILL)
    time.sleep(0.05)
    return i


def sleep(task: tuple[str, float]) -> float:
    """Write this process's number into the folder, and return after so many seconds."""
    folder, seconds = task
    (Path(folder) / str(os.getpid())).touch()
    time.sleep(seconds)
    return seconds


def fail(i: int) -> int:
    if i == 1:
        raise km.errors.DataError("the second task is wrong")
    return i


class OddError(Exception):
    """An exception that does not pickle."""

    def __init__(self, one: int, two: int) -> None:
        super().__init__(f"{one} and {two}")


def odd(_: int) -> None:
    raise OddError(1, 2)


def unsendable(_: int) -> object:
    return threading.Lock()


def dying_reader(path: Path) -> km.Episodes:
    """Read the file; kill the worker that reads 1.npz the first time."""
    mark = path.with_suffix(".died")
    if path.name == "1.npz" and not mark.exists():
        mark.touch()
        die(path)
    return _loaded(path)


def always_dying(path: Path) -> km.Episodes:
    """Read the file; kill each worker that reads 1.npz."""
    if path.name == "1.npz":
        die(path)
    return _loaded(path)


def _loaded(path: Path) -> km.Episodes:
    from koopmpc.data.files.load import load_episodes  # km.load_episodes brings all of koopmpc along

    return load_episodes(path)


def by_first_state(episode: km.Episode) -> float:
    return abs(float(episode.X[0, 0]))
