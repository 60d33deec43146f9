"""Ctrl-C in libraries written in C, which take it for a failure of their own.

CasADi asks Python for signals while a solver or an integrator runs or an expression is built, but takes the
KeyboardInterrupt that comes of it for a failed evaluation: ipopt then reports a failure, CVODES no next state, fatrop
nothing at all. This file imports the standard library alone, for `koopmpc.apps.cli` imports it before anything else.
"""

import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = 130  # exit code of a program that Ctrl-C ended
_MASK = getattr(signal, "pthread_sigmask", None)  # Windows has none


@contextmanager
def raise_swallowed() -> Generator[None]:
    """Raise KeyboardInterrupt at the end of the block if one came in it and was swallowed.

    A handler that raises nothing, as that of a loop that ends after its step, goes on as it meant to. Handlers belong
    to the main thread; in any other one this does nothing. It costs about 3 µs.
    """
    handler = signal.getsignal(signal.SIGINT)
    if not callable(handler) or threading.current_thread() is not threading.main_thread():
        yield
        return
    interrupts: list[int] = []

    def note_interrupt(number: int, frame: FrameType | None) -> None:
        try:
            handler(number, frame)
        except KeyboardInterrupt:
            interrupts.append(number)
            raise

    try:
        signal.signal(signal.SIGINT, note_interrupt)
        yield
    except Exception:
        if interrupts:
            raise KeyboardInterrupt from None
        raise
    finally:
        signal.signal(signal.SIGINT, handler)
    if interrupts:
        raise KeyboardInterrupt


def call_uninterrupted(call: Callable[[], object]) -> None:
    """Call while SIGINT waits: Python raises KeyboardInterrupt right after, some milliseconds later.

    Processes and threads that start meanwhile inherit the blocked signal, which is this thread's to answer.
    """
    if _MASK is None:
        call()
        return
    before = _MASK(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        call()
    finally:
        _MASK(signal.SIG_SETMASK, before)
