"""listening: a Ctrl-C that a library swallows is raised all the same.

CasADi asks Python for signals while a solver or an integrator runs, but takes the KeyboardInterrupt that comes of it
for a failed evaluation: ipopt then reports a failure, CVODES no next state, fatrop nothing at all.
"""

import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import wraps
from types import FrameType
from typing import Any, TypeVar, cast

Call = TypeVar("Call", bound=Callable[..., Any])
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def listening() -> Generator[None]:
    """Raise KeyboardInterrupt at the end of the block where a handler of Ctrl-C or SIGTERM was called in it.

    Handlers belong to the main thread; in any other one this does nothing. It costs about 5 µs.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    before = {int(number): signal.getsignal(number) for number in _SIGNALS}

    def note(number: int, frame: FrameType | None) -> None:
        came.append(number)
        handler = before[number]
        if callable(handler):
            handler(number, frame)

    for number, handler in before.items():
        if callable(handler):
            signal.signal(number, note)
    try:
        yield
    finally:
        for number, handler in before.items():
            if callable(handler):
                signal.signal(number, handler)
        if came:
            raise KeyboardInterrupt from None


def heard(call: Call) -> Call:
    """Return the call with `listening` around it."""

    @wraps(call)
    def listened(*arguments: Any, **options: Any) -> Any:
        with listening():
            return call(*arguments, **options)

    return cast("Call", listened)
