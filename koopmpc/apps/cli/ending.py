"""Ctrl-C and SIGTERM in commands: exit code 130 and one line, which says what is kept.

This file imports the standard library alone, so that its handlers stand before anything else is imported.
"""

import gc
import io
import os
import signal
import sys
from collections import Counter
from contextlib import suppress
from pathlib import Path
from traceback import clear_frames
from types import FrameType, TracebackType

from koopmpc.base.interrupts import INTERRUPTED

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_REPEAT = 1.0  # raise the interrupt again after this time, until the command ends: a library may have swallowed it [s]
_PART = ".part"  # suffix of a file that is being written, as in koopmpc.base.disk
_RUNS = ".rrd"  # suffix of a file that is counted, not named
_SHOWN = 5  # name at most this many files


class Ending:
    """A context in which signals end the program; `folder` is where the command writes."""

    folder: Path | None = None
    _interrupted = False

    def __enter__(self) -> None:
        for number in _SIGNALS:
            signal.signal(number, self._interrupt)

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        self._interrupted = True
        sys.stderr = io.StringIO()  # CasADi warns of the exception, which would be a second line
        if hasattr(signal, "setitimer"):  # Windows has none
            signal.signal(signal.SIGALRM, self._interrupt)
            signal.setitimer(signal.ITIMER_REAL, _REPEAT)
        raise KeyboardInterrupt

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number in (*_SIGNALS, getattr(signal, "SIGALRM", signal.SIGINT)):
            signal.signal(number, signal.SIG_IGN)
        if self._interrupted:
            with suppress(Exception):
                sys.stdout.flush()
            with suppress(OSError):
                os.write(2, f"interrupted; {clean_folder(self.folder)}\n".encode())
            clear_frames(trace)
            gc.collect()  # gives back the semaphores of worker processes, of which a tracker would warn
            os._exit(INTERRUPTED)  # after an interrupt inside `exec` Python would end by the signal, and not with 130


def clean_folder(folder: Path | None) -> str:
    """Return which files of a command are whole; remove the others, and the folder if it is then empty."""
    paths = sorted(folder.rglob("*"), reverse=True) if folder is not None and folder.is_dir() else []
    files: list[Path] = []
    for path in paths:
        if path.suffix == _PART and path.name.startswith("."):
            with suppress(OSError):
                path.unlink()
        elif path.is_file():
            files.insert(0, path)
    if folder is None or not files:
        for empty in [] if folder is None else [*paths, folder]:
            with suppress(OSError):
                empty.rmdir()
        return "nothing was written"
    runs = Counter(path.suffix for path in files)[_RUNS]
    names = [path.relative_to(folder).as_posix() for path in files if path.suffix != _RUNS]
    kept = [f"{runs} finished run{'s' * (runs > 1)}"] if runs else []
    kept += names[:_SHOWN] + ([f"{len(names) - _SHOWN} more files"] if len(names) > _SHOWN else [])
    return f"kept in {folder}: {', '.join(kept)}"


ENDING = Ending()
"""How this process ends; a command sets its `folder`."""
