"""Functions that tests send to worker processes: they must stand at the top of a module."""

import os
import signal
from pathlib import Path

from koopmpc.errors import DataError


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


def fail(i: int) -> int:
    if i == 1:
        raise DataError("the second task is wrong")
    return i
