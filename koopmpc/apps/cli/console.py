"""What all commands share: the console, folders of calls, progress, and errors as one line."""

import os
import re
import shlex
import shutil
import sys
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.text import Text

from koopmpc.apps.cli.ending import ENDING
from koopmpc.base.errors import DataError, FitWarning, FullDiskError, KoopmpcError, LogError


def split(names: str) -> list[str]:
    """Return the names in ``"a, b"``; an empty text has none."""
    return [name.strip() for name in names.split(",") if name.strip()]


def split_columns(text: str) -> dict[str, str] | list[str]:
    """Return old → new of the names in ``"old=new, old=new"``, or the names in ``"a, b"``.

    Raises
    ------
    DataError
        A part is no such pair.
    """
    if "=" not in text:
        return split(text)
    pairs = [part.rpartition("=") for part in split(text)]
    wrong = next((new for old, _, new in pairs if not old.strip() or not new.strip()), None)
    if wrong is not None:
        raise DataError(f"--columns {text!r} must be a list of old=new; for example --columns 'y1=theta,y2=omega'")
    return {old.strip(): new.strip() for old, _, new in pairs}


def find_program() -> list[str]:
    """Return the command that calls this program from here: its name if that is on PATH, else its path."""
    beside = shutil.which("koopmpc", path=str(Path(sys.executable).parent))
    if beside is None:
        return [near(sys.executable), "-m", "koopmpc"]
    known = shutil.which("koopmpc")
    return ["koopmpc" if known is not None and Path(known).samefile(beside) else near(beside)]


def format_command(*words: object) -> str:
    """Return the line of a shell that calls this program with these words."""
    return shlex.join([*find_program(), *map(str, words)])


def near(path: str) -> str:
    """Return the path, relative to the current folder where that is shorter."""
    try:
        return min(os.path.relpath(path), path, key=len)
    except ValueError:  # on another drive
        return path


class Bar:
    """A progress bar on stderr; calling it with (what, done, total) moves it."""

    def __init__(self, shown: Any, first: str) -> None:
        self._shown, self._task = shown, shown.add_task(first, total=None)

    def __call__(self, what: str, done: int, total: int | None) -> None:
        """Show what is under way, and how many of all are done."""
        self._shown.update(self._task, description=what[:40], completed=done, total=total)

    def print(self, text: Any) -> None:
        """Print to stdout above the bar."""
        self._shown.stop()
        console().print(text)
        self._shown.start()


@contextmanager
def bar(first: str, *, rate: bool = False) -> Generator[Bar]:
    """Show a progress bar on stderr and yield it.

    With `rate` it shows how many are done in a second, and how long the rest takes at that rate.
    """
    from rich import progress

    class Rate(progress.ProgressColumn):
        def render(self, task: progress.Task) -> Text:
            return Text("" if task.speed is None else f"{task.speed:.3g}/s")

    class Count(progress.MofNCompleteColumn):
        def render(self, task: progress.Task) -> Text:
            return Text("") if task.total is None else super().render(task)  # else it shows "0/?"

    columns = [progress.TextColumn("{task.description:40}"), progress.BarColumn(), Count()]
    columns += [progress.TimeElapsedColumn(), *((Rate(), progress.TimeRemainingColumn()) if rate else ())]
    with progress.Progress(*columns, console=Console(stderr=True), transient=True) as shown:
        yield Bar(shown, first)


def console() -> Console:
    """Return the console of stdout, 100 columns wide if stdout is not a terminal."""
    out = Console()
    return out if out.is_terminal else Console(width=100)


def say(text: str, style: str = "") -> None:
    """Print text to stdout whose lines are not broken, so that a path in it can be copied."""
    console().print(Text(text, style=style), soft_wrap=True)


def new_folder(logs: Path, what: str) -> Path:
    """Make and return logs/<time>-<what>; a number follows where two calls share a second.

    Raises
    ------
    LogError
        `what` is a path, or no folder can be made there.
    """
    if not what or Path(what).name != what:
        raise LogError(f"--name is {what!r}, and ends the name of one folder; leave out what makes it a path")
    stem = f"{datetime.now():%Y-%m-%dT%H-%M-%S}-{what}"
    tries = 0
    while True:
        folder = logs / (stem if tries == 0 else f"{stem}-{tries}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            tries += 1
        except OSError as error:
            raise LogError(
                f"--logs {logs}: no folder can be made there, {error.strerror}; pass a folder that you may write to"
            ) from error
        else:
            ENDING.folder = folder
            return folder


@contextmanager
def folder_of(logs: Path, what: str) -> Generator[Path]:
    """Yield a new folder; an error of koopmpc takes it away again where nothing was written."""
    folder = new_folder(logs, what)
    try:
        yield folder
    except KoopmpcError:
        if not any(folder.iterdir()):
            folder.rmdir()
        raise


def new_file(path: Path, text: str) -> Path:
    """Write a file that is not there yet, and return its path."""
    try:
        with path.open("x") as stream:
            stream.write(text)
    except FileExistsError as error:
        raise LogError(f"{path} is there already; move it away first, or pass it with --goal") from error
    except OSError as error:
        raise LogError(f"{path} cannot be written: {error.strerror}") from error
    return path


_OPTION = re.compile(r"\b(dt|states|inputs|columns|resample|horizon|workers|scheduler)=(\[\])?( ?)")
_SUBJECT = re.compile(r"(^|: )(dt|resample|horizon|workers|scheduler|runs)(?= is )")


def as_options(message: str) -> str:
    """Return the message with the options of this program in place of Python's arguments."""
    told = (
        _OPTION.sub(lambda f: f"--{f.group(1)} " + ('""' + f.group(3)) * (f.group(2) is not None), message)
        .replace(" ;", ";")
        .replace(" ,", ",")
    )
    return _SUBJECT.sub(r"\1--\2", told)


def say_page(address: str, port: int, data: int) -> None:
    """Print where a browser finds the viewer that is served here, and how to reach it from another machine."""
    say(f"open {address}", "bold")
    tunnel = f"ssh -L {port}:127.0.0.1:{port} -L {data}:127.0.0.1:{data} HOST"
    say(f"from another machine first: {tunnel}\nCtrl-C ends it")


@contextmanager
def friendly() -> Generator[None]:
    """Show each warning and error of koopmpc as one message on stderr; an error exits with 2, a full disk with 1."""
    err, shown = Console(stderr=True), set[str]()

    def show(message: Warning | str, category: type[Warning], *rest: Any, **more: Any) -> None:
        if str(message) not in shown:
            err.print(Text.assemble((f"{category.__name__}: ", "yellow"), as_options(str(message))), soft_wrap=True)
        shown.add(str(message))

    with warnings.catch_warnings():
        warnings.simplefilter("always", FitWarning)
        warnings.showwarning = show
        try:
            yield
        except KoopmpcError as error:
            err.print(Text.assemble((f"{type(error).__name__}: ", "red"), as_options(str(error))), soft_wrap=True)
            raise typer.Exit(1 if isinstance(error, FullDiskError) else 2) from error
