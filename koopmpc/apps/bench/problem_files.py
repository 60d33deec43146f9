"""Files that hold a problem: which there are, how one is loaded, and how a new one begins."""

import ast
import importlib.util
import sys
import traceback
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from koopmpc.apps.bench.problem import Problem
from koopmpc.base import checks, disk
from koopmpc.base.checks import nearest
from koopmpc.base.errors import ProblemError
from koopmpc.base.values import fingerprint

DEFAULT = ("bilinear_motor:step", "cart_pole", "cart_pole_swing", "pendulum", "van_der_pol:track")  # a minute's bench
_PACKAGE = Path(__file__).resolve().parents[2]


class Entry(NamedTuple):
    """A problem file: its name, the first line of its docstring, and its path."""

    name: str
    title: str
    path: Path


def shipped() -> tuple[Path, ...]:
    """Return the problem files that come with koopmpc, inside the wheel or beside the package in a checkout."""
    wheel = _PACKAGE / "problems"
    return tuple(_files(wheel if wheel.is_dir() else _PACKAGE.parent / "problems"))


def list_problems() -> tuple[Entry, ...]:
    """Return every problem that can be loaded by name: those in ./problems first, then the shipped ones."""
    return tuple(Entry(name, _title(path), path) for name, path in _paths().items())


def load_problem(problem: str | Path) -> Problem:
    """Load a problem by path or name; ``"cart_pole:recover"`` keeps one of its cases.

    Parameters
    ----------
    problem
        A path, or a name: it is looked up as a path, then in ./problems, then among the shipped problems. The file is
        run as Python: load only files that you trust.

    Raises
    ------
    ProblemError
        There is no such problem or case, the file raises, or it defines no `problem`.

    Examples
    --------
    >>> import koopmpc as km
    >>> problem = km.load_problem("pendulum")  # or the path of your own file
    >>> problem.dt, list(problem.cases)
    (0.05, ['upright', 'hang', 'hold'])
    """
    checks.kind(problem, "problem", (str, Path), "pass a problem's name or the path of its file")
    text = str(problem)
    path, case = _find(text), ""
    name, colon, last = text.rpartition(":")
    if path is None and colon and last[:1] not in ("/", "\\"):  # the colon in C:\spring.py belongs to the drive
        path, text, case = _find(name), name, last
    if path is None:
        raise ProblemError(_unknown(text))
    if path.suffix != ".py":
        raise ProblemError(f"{path} is not a problem: a problem is a Python file; `koopmpc fit {path}` reads data")
    loaded = _load(path)
    return loaded.select(case) if case else loaded


def new_problem(name: str | Path) -> Path:
    """Write a commented problem that runs, a mass on a spring, to <name>.py in the current folder; return its path.

    Raises
    ------
    ProblemError
        The name cannot be that of a Python file, or the file is there already.
    LogError
        The file cannot be written.
    """
    path = Path(name)
    path = path if path.suffix == ".py" else path.with_name(f"{path.name}.py")
    if not path.stem.isidentifier():
        raise ProblemError(f"{path.stem!r} is not a name for a problem; use letters, digits and _, a letter first")
    if path.exists():
        raise ProblemError(f"{path} exists already and is kept as it is; choose another name")
    with disk.writing(path) as file:
        file.write((Path(__file__).parent / "template.txt").read_bytes())
    return path


def _paths() -> dict[str, Path]:
    """The problem files that have a name, without what they say of themselves."""
    found: dict[str, Path] = {}
    for path in (*_files(Path("problems")), *shipped()):
        found.setdefault(path.stem, path)
    return found


def _find(text: str) -> Path | None:
    path = Path(text)
    with suppress(OSError):  # of a name that is too long for a file
        if path.is_file():
            return path
    return _paths().get(text)  # no title: reading all of them takes longer than the problem itself


def _unknown(text: str) -> str:
    folder = False
    with suppress(OSError):
        folder = Path(text).is_dir()
    if folder:
        inside = ", ".join(str(path) for path in _files(Path(text))) or "there is none in it"
        return f"{text} is a folder; pass the path of one problem file: {inside}"
    if text.endswith(".py") or "/" in text or "\\" in text:
        return f"there is no file {text}; pass the path of a problem file, or a name that `koopmpc list` shows"
    names = list(_paths())
    return f"there is no problem {text!r}{nearest(text, names)}; there are {', '.join(names)}, or pass a path"


def _load(path: Path) -> Problem:
    """Run the file and return its `problem` with name and title."""
    path = path.resolve()
    module_name = f"koopmpc_problem_{path.stem}_{fingerprint(str(path).encode())[:8]}"
    spec = importlib.util.spec_from_loader(module_name, loader=None, origin=str(path))
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    module.__file__ = str(path)
    sys.modules[module_name] = module  # dataclasses look up their module by name
    try:
        exec(compile(path.read_bytes(), str(path), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:  # a file that calls exit() must not end the program
        sys.modules.pop(module_name)
        raise ProblemError(f"{path}{_line(error, path)}: {type(error).__name__}: {error}") from error
    loaded = module.__dict__.get("problem")
    if not isinstance(loaded, Problem):
        got = "nothing of that name" if loaded is None else checks.article(loaded)
        raise ProblemError(f"{path} must define `problem = km.Problem(...)`, but holds {got}; see a file in problems/")
    return replace(loaded, name=path.stem, title=_first_line(module.__doc__)).of_file(str(path))


def _line(error: BaseException, path: Path) -> str:
    if isinstance(error, SyntaxError):
        return f", line {error.lineno}"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    return f", line {lines[-1]}" if lines else ""


def _title(path: Path) -> str:
    try:
        return _first_line(ast.get_docstring(ast.parse(path.read_bytes())))
    except (SyntaxError, ValueError):
        return "(this file is not valid Python)"


def _first_line(docstring: str | None) -> str:
    return (docstring or "").strip().split("\n")[0]


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.glob("*.py")) if not path.stem.startswith("_"))
