"""Ctrl-C and SIGTERM: no library swallows them, what must be whole is done first, and the program ends with one line.

This file imports the standard library alone, and what takes milliseconds only where it is used, so that its handlers
stand before anything else is imported.

CasADi asks Python for signals while a solver or an integrator runs, but takes the KeyboardInterrupt that comes of it
for a failed evaluation: ipopt then reports a failure, CVODES no next state, fatrop nothing at all. Python drops one
that comes while an object is deleted.
"""

import atexit
import io
import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from functools import partial
from importlib import import_module
from types import FrameType, ModuleType, TracebackType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import socket
    from pathlib import Path

Handler = Callable[[int, FrameType | None], Any]
INTERRUPTED = 130  # exit code of a program that Ctrl-C ended
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_PATIENCE = 0.5  # end the process from another thread if it still runs this long after a signal [s]
_PART = ".part"  # suffix of a file that is being written, as in koopmpc.disk
_RUNS = ".rrd"  # suffix of a file that is counted, not named
_SHOWN = 5  # name at most this many files
_MASK = getattr(signal, "pthread_sigmask", None)  # Windows has none
_BLOCK = int(getattr(signal, "SIG_BLOCK", 0))
_UNBLOCK = int(getattr(signal, "SIG_UNBLOCK", 0))
_SET_MASK = int(getattr(signal, "SIG_SETMASK", 0))
_SIGINT = (int(signal.SIGINT),)  # numbers, of which Python looks up no names: 1 µs less


@contextmanager
def raise_swallowed() -> Generator[None]:
    """Raise at the end of the block what a handler of Ctrl-C or SIGTERM raised in it, where that was swallowed.

    A handler that raises nothing, as that of a loop that ends after its step, goes on as it meant to. Handlers belong
    to the main thread; in any other one this does nothing. It costs about 5 µs.
    """
    came: list[BaseException] = []  # copies: a raised exception holds the frames that hold this list

    def call_handler(handler: Handler, number: int, frame: FrameType | None) -> None:
        try:
            handler(number, frame)
        except BaseException as error:
            came.append(type(error)(*error.args))
            raise

    try:
        with _replace_handlers(call_handler):
            yield
    except GeneratorExit:  # an interrupt came while the block was entered
        raise
    except BaseException:
        if came:
            raise came[0] from None
        raise
    if came:
        raise came[0]


@contextmanager
def defer_interrupts() -> Generator[None]:
    """Call the handlers of Ctrl-C and SIGTERM at the end of the block: what stands in it is done as a whole.

    Handlers belong to the main thread; in any other one this does nothing.
    """
    came: list[tuple[int, Handler]] = []
    try:
        with _replace_handlers(lambda handler, number, _: came.append((number, handler))):
            yield
    finally:
        for number, handler in came:
            handler(number, None)


def import_whole(name: str) -> ModuleType:
    """Import a library that takes a Ctrl-C for the lack of one of its parts, as CVXPY does with solvers.

    The interrupt is answered once the library is there as a whole.
    """
    with defer_interrupts():
        return import_module(name)


@contextmanager
def _replace_handlers(call: Callable[[Handler, int, FrameType | None], None]) -> Generator[None]:
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


def call_uninterrupted(call: Callable[[], object]) -> None:
    """Call while SIGINT waits: Python raises KeyboardInterrupt right after, some milliseconds later.

    Processes and threads that start meanwhile inherit the blocked signal, which is this thread's to answer.
    """
    if _MASK is None:
        call()
        return
    try:
        before = _MASK(_BLOCK, _SIGINT)
    except BaseException:  # a KeyboardInterrupt that came just before is raised once the signal is blocked
        _MASK(_UNBLOCK, _SIGINT)
        raise
    try:
        call()
    finally:
        _MASK(_SET_MASK, before)


class Ending:
    """A context in which signals end the program; `folder` is where the call writes.

    A signal raises KeyboardInterrupt, which unwinds the call. Inside a library written in C this may take long, and
    some swallow the exception. So a thread ends the process if it still runs after a while.
    """

    folder: "Path | None" = None
    _said = False
    _came = False

    def __enter__(self) -> None:
        if threading.current_thread() is not threading.main_thread():
            return
        try:
            atexit.register(self._finish)  # before any library, so it is called as the last
            for number in _SIGNALS:
                signal.signal(number, self._interrupt)
            import socket

            ends, begins = socket.socketpair()
            begins.setblocking(False)
            signal.set_wakeup_fd(begins.fileno(), warn_on_full_buffer=False)
            self._begins = begins  # kept open
            threading.Thread(target=self._watch, args=(ends,), name="koopmpc-ending", daemon=True).start()
        except KeyboardInterrupt as error:  # Python leaves no block that was not entered
            self.__exit__(type(error), error, None)
            raise

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        interrupted = isinstance(error, KeyboardInterrupt)
        if interrupted or (isinstance(error, SystemExit) and error.code == INTERRUPTED):
            for number in _SIGNALS:  # the process ends, and one line says so
                signal.signal(number, signal.SIG_IGN)
            self._say()
            os._exit(INTERRUPTED)  # unloading all modules would take most of a second

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        self._came = True
        sys.stderr = io.StringIO()  # CasADi warns of the exception, which would be a second line
        raise KeyboardInterrupt

    def _finish(self) -> None:
        """End with the exit code of a signal that came while the program left; ignore a later one: all is done.

        Python takes its handlers away before it unloads modules, and the system would end the process by the signal.
        """
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)
        if self._came:
            self._say()
            os._exit(INTERRUPTED)

    def _watch(self, ends: "socket.socket") -> None:
        """End the process if it still runs a while after a signal, whatever the main thread does."""
        while True:
            if set(ends.recv(64)) & set(_SIGNALS):
                time.sleep(_PATIENCE)
                self._say()
                os._exit(INTERRUPTED)

    def _say(self) -> None:
        """Write the one line, and remove files that are half written."""
        if self._said:
            return
        self._said = True
        with suppress(Exception):
            sys.stdout.flush()
        with suppress(OSError):
            os.write(2, f"interrupted; {clean_folder(self.folder)}\n".encode())


def clean_folder(folder: "Path | None") -> str:
    """Return which files of a call are whole; remove the others, and the folder if it is then empty."""
    files: list[Path] = []
    for path in sorted(folder.rglob("*")) if folder is not None and folder.is_dir() else ():
        if path.suffix == _PART and path.name.startswith("."):
            with suppress(OSError):
                path.unlink()
        elif path.is_file():
            files.append(path)
    if folder is None or not files:
        for empty in [] if folder is None else [*sorted(folder.rglob("*"), reverse=True), folder]:
            with suppress(OSError):
                empty.rmdir()
        return "nothing was written"
    kinds = Counter(path.suffix for path in files)
    runs = kinds[_RUNS]
    names = [path.relative_to(folder).as_posix() for path in files if path.suffix != _RUNS]
    told = [f"{runs} finished run{'s' * (runs > 1)}"] if runs else []
    told += names[:_SHOWN] + ([f"{len(names) - _SHOWN} more files"] if len(names) > _SHOWN else [])
    return f"kept in {folder}: {', '.join(told)}"


ENDING = Ending()
"""How this process ends; a command sets its `folder`."""
