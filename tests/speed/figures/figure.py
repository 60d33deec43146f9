"""Figure: a row of docs/speed.md. A file of figures imports no test, so that an old commit can run it."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Figure:
    """One measured figure.

    Parameters
    ----------
    what
        The first cell of its row.
    prepare
        Makes what is measured, once, and returns a function: called again and again, it returns [s] of CPU time, or a
        pair, these and the seconds of the yardstick.
    yardstick
        What the figure is divided by; empty where there is nothing.
    goal
        What was asked of it.
    """

    what: str
    prepare: Callable[[], Callable[[], float | tuple[float, float]]]
    yardstick: str = ""
    goal: str = ""


def cpu_time_of_rows(call: Callable[..., Any], rows: list[tuple[Any, ...]]) -> float:
    """Return the mean CPU time [s] of calls with these arguments, one after the other."""
    start = time.process_time()
    for arguments in rows:
        call(*arguments)
    return (time.process_time() - start) / len(rows)
