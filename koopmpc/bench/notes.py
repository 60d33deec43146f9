"""Warnings of a fit as sentences of its report: each once, and those of many files in a few lines."""

import warnings
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from pathlib import Path

from koopmpc.errors import ColumnWarning, FitWarning

_SHOWN = 6  # files of which a report says what each of them needs


@contextmanager
def noted(notes: list[str]) -> Generator[None]:
    """Collect the text of each FitWarning, once, instead of showing it.

    A ColumnWarning is left out: one file says nothing of all, over which `needed` decides.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", FitWarning)
        yield
    for one in caught:
        if not issubclass(one.category, FitWarning):
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
        elif not issubclass(one.category, ColumnWarning) and str(one.message) not in notes:
            notes.append(str(one.message))


def shortened(notes: Iterable[str], files: Iterable[Path]) -> list[str]:
    """Return the notes, those that files share in one line, and of those that differ by file the first few."""
    known = {str(file) for file in files}
    of: dict[str, list[str]] = {}
    for note in notes:
        file, _, said = note.partition(": ")
        if file in known:
            of.setdefault(said, []).append(file)
        else:
            of[note] = []
    short: list[str] = []
    alone = 0
    for said, where in of.items():
        if len(where) > 1:
            short.append(f"{where[0]} and {len(where) - 1} more files: {said}")
        elif where and alone < _SHOWN:
            short.append(f"{where[0]}: {said}")
        elif not where:
            short.append(said)
        alone += len(where) == 1
    if alone > _SHOWN:
        short.append(f"{alone - _SHOWN} more files have such notes of their own; load_episodes says them")
    return short
