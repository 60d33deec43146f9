"""The errors of koopmpc: one root, and each class is also the builtin that it refines."""

import warnings
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn

__all__ = [
    "CertificateError",
    "ColumnWarning",
    "DataError",
    "DefinitenessError",
    "FitWarning",
    "FullDiskError",
    "Hint",
    "KoopmpcError",
    "LogError",
    "NoInputWarning",
    "ObservableError",
    "ProblemError",
    "ShapeError",
    "SourcesOnlyWarning",
    "ThreadError",
    "hide_fit_warnings",
    "install",
]


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__


def install(extra: str) -> str:
    """Return the command that installs an extra: from the folder of a clone, else by name.

    By name pip takes the koopmpc that is installed, whether it came from git or an index, and adds what is missing.
    """
    root = Path(__file__).resolve().parents[2]
    what = f"{root}[{extra}]" if (root / "pyproject.toml").is_file() else f"koopmpc[{extra}]"
    return f"pip install '{what}'"


class KoopmpcError(Exception):
    """Root of every error that koopmpc raises on purpose."""


class ShapeError(KoopmpcError, ValueError):
    """An array has another shape than the mathematics needs."""


class DataError(KoopmpcError, ValueError):
    """Data or settings whose values cannot be used: NaN, crossed limits, too few steps."""


class DefinitenessError(KoopmpcError, ValueError):
    """A weight, or R + BᵀPB, is not positive (semi)definite where it must be."""


class ObservableError(KoopmpcError, LookupError):
    """A cost or a limit names an observable that the lifting does not hold."""


class ProblemError(KoopmpcError, LookupError):
    """A problem, or one of its cases, is unknown or its file does not work."""


class LogError(KoopmpcError, OSError):
    """A file is not a log, no model, or no data of koopmpc, or cannot be read to its end."""


class CertificateError(KoopmpcError, RuntimeError):
    """No certificate was found; the message says which assumption is in the way."""


class ThreadError(KoopmpcError, RuntimeError):
    """Two threads entered one controller at once."""


class WorkerError(KoopmpcError, RuntimeError):
    """A task killed each worker process that ran it."""


class FullDiskError(LogError):
    """There is no room for a file; what stood at its path before is as it was."""


class FitWarning(UserWarning):
    """A fit is doubtful: rank deficient, ill conditioned, or with inputs that feedback made collinear."""


class ColumnWarning(FitWarning):
    """A column of a table says nothing: it is constant in it, or repeats another."""


class NoInputWarning(FitWarning):
    """No column of a table has the name of an input, so that its plant seems to run by itself.

    `question` asks for the inputs, for callers who do not go on without an answer.
    """

    def __init__(self, message: str, question: str) -> None:
        super().__init__(message)
        self.question = question


class SourcesOnlyWarning(UserWarning):
    """A Functional Mock-up Unit that was written holds no machine code, for want of a C compiler."""


def refuse_moved(
    keywords: Mapping[str, object], options: Any, name: str, others: Mapping[str, str] | None = None
) -> None:
    """Raise a TypeError where there is a keyword, which says that it is a field of the dataclass `options` now.

    `others` are keywords that became another field: the old name, and what to pass.
    """
    places = {field.name: f"{field.name}=…" for field in fields(options)} | dict(others or {})
    for word in keywords:
        if word in places:
            raise TypeError(f"{word}= is a field of the options now: pass options={name}({places[word]})")
        raise TypeError(f"there is no argument {word}=, and {name} has no such field")


class Hint:
    """A name that users of other libraries try first; asking for it raises an AttributeError that says what to write.

    `hasattr` is False, and a type checker knows that it never returns.
    """

    def __init__(self, advice: str) -> None:
        self.advice = advice

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, owner: object, kind: type | None = None) -> NoReturn:
        what = getattr(kind, "__name__", "object")
        raise AttributeError(f"{what!r} object has no attribute {self.name!r}; {self.advice}")


@contextmanager
def hide_fit_warnings() -> Generator[None]:
    """Show no FitWarning in this block, whose caller says elsewhere what is doubtful."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)
        yield
