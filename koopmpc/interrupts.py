"""listening, deferred: a Ctrl-C that a library or Python itself swallows is raised all the same.

CasADi asks Python for signals while a solver or an integrator runs, but takes the KeyboardInterrupt that comes of it
for a failed evaluation: ipopt then reports a failure, CVODES no next state, fatrop nothing at all. Python drops one
that comes while an object is deleted.
"""

import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import partial, wraps
from types import FrameType
from typing import Any, TypeVar, cast

Call = TypeVar("Call", bound=Callable[..., Any])
Handler = Callable[[int, FrameType | None], Any]
_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def listening() -> Generator[None]:
    """Raise at the end of the block what a handler of Ctrl-C or SIGTERM raised in it, where that was swallowed.

    A handler that raises nothing, as that of a loop that ends after its step, goes on as it meant to. Handlers belong
    to the main thread; in any other one this does nothing. It costs about 5 µs.
    """
    came: list[BaseException] = []  # copies: the one that is on its way holds its frames, and these would hold it

    def called(handler: Handler, number: int, frame: FrameType | None) -> None:
        try:
            handler(number, frame)
        except BaseException as error:
            came.append(type(error)(*error.args))
            raise

    try:
        with _handled(called):
            yield
    except GeneratorExit:  # it came while the block was entered, and is on its way
        raise
    except BaseException:
        if came:
            raise came[0] from None
        raise
    if came:
        raise came[0]


@contextmanager
def deferred() -> Generator[None]:
    """Call the handlers of Ctrl-C and SIGTERM at the end of the block: what stands in it is done as a whole.

    Handlers belong to the main thread; in any other one this does nothing.
    """
    came: list[tuple[int, Handler]] = []
    try:
        with _handled(lambda handler, number, _: came.append((number, handler))):
            yield
    finally:
        for number, handler in came:
            handler(number, None)


@contextmanager
def _handled(call: Callable[[Handler, int, FrameType | None], None]) -> Generator[None]:
    """Let call(handler, signal, frame) take the place of each handler in this block."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {int(number): signal.getsignal(number) for number in _SIGNALS}
    handlers = {number: handler for number, handler in before.items() if callable(handler)}
    try:
        for number, handler in handlers.items():
            signal.signal(number, partial(call, handler))
        yield
    finally:
        _set(handlers)


def _set(handlers: dict[int, Handler]) -> None:
    """Make these the handlers, each of them also where one raises in between."""
    try:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    except BaseException:
        _set(handlers)
        raise


def heard(call: Call) -> Call:
    """Return the call with `listening` around it."""

    @wraps(call)
    def listened(*arguments: Any, **options: Any) -> Any:
        with listening():
            return call(*arguments, **options)

    return cast("Call", listened)
