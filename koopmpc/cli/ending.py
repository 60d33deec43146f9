"""Ending: how Ctrl-C and SIGTERM end the program, and what it says of the files of the call.

A signal raises KeyboardInterrupt, which unwinds the call. Inside a library written in C this may take long, and some
swallow the exception. So a thread ends the process if it still runs after a while.
"""

import os
import signal
import socket
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from types import FrameType, TracebackType

INTERRUPTED = 130  # the exit code of a program that Ctrl-C ended
_PATIENCE = 0.5  # [s] from the signal until the process is ended from outside
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_PART = ".part"  # of a file that is being written, as in koopmpc.disk
_RUNS, _SHOWN = ".rrd", 5


class Ending:
    """A context in which signals end the program; `folder` is where the call writes.

    This file imports the standard library alone, so that the context stands before anything else is imported.
    """

    folder: Path | None = None
    _said = False

    def __enter__(self) -> None:
        if threading.current_thread() is not threading.main_thread():
            return
        try:
            for number in _SIGNALS:
                signal.signal(number, self._interrupt)
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
        raise KeyboardInterrupt

    def _watch(self, ends: socket.socket) -> None:
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
            os.write(2, f"interrupted; {kept(self.folder)}\n".encode())


def kept(folder: Path | None) -> str:
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
