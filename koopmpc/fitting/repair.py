"""Repairs of logs, each reported: columns that stand still or repeat others are dropped, angles are unwrapped."""

import warnings
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.source import Changed, Source
from koopmpc.errors import ColumnWarning, DataError, FitWarning
from koopmpc.synthesis.candidates import jumps


@dataclass(frozen=True)
class Repair:
    """Episodes with some columns alone, and with angles that run on; what was done is in `notes`.

    Attributes
    ----------
    states, inputs, disturbances
        Indices of the columns that are kept.
    unwrapped
        Indices of the states, before any was left out, that are unwrapped along each episode.
    notes
        What was found, in sentences.
    """

    states: tuple[int, ...]
    inputs: tuple[int, ...]
    disturbances: tuple[int, ...]
    unwrapped: tuple[int, ...]
    notes: tuple[str, ...]

    def __call__(self, episodes: Episodes) -> Episodes:
        """Return the repaired episodes; themselves where there is nothing to repair."""
        if not self.notes:
            return episodes
        made: list[Episode] = []
        for e in episodes:
            X = e.X.copy()
            if self.unwrapped:
                X[:, self.unwrapped] = np.unwrap(X[:, self.unwrapped], axis=0)
            made.append(Episode(X=X[:, self.states], U=e.U[:, self.inputs], W=e.W[:, self.disturbances]))
        return Episodes(made, episodes.dt, *self._names(episodes))

    def source(self, source: Source) -> Source:
        """Return the source of repaired episodes."""
        return Changed(source, self, *self._names(source)) if self.notes else source

    def _names(self, of: Episodes | Source) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
        return (
            tuple(of.states[i] for i in self.states),
            tuple(of.inputs[i] for i in self.inputs),
            tuple(of.disturbances[i] for i in self.disturbances),
        )


def needed(episodes: Episodes) -> Repair:
    """Return the repairs that these episodes need.

    Raises
    ------
    DataError
        No state moves.
    """
    notes: list[str] = []
    X = np.concatenate([e.X for e in episodes])
    driven = np.concatenate([np.hstack([e.U, e.W]) for e in episodes])
    nu = episodes.nu
    states = _useful(X, episodes.states, notes)
    both = _useful(driven, (*episodes.inputs, *episodes.disturbances), notes)
    if not states:
        raise DataError(
            f"no state moves: {', '.join(episodes.states)} are constant; check the columns, or pass --states"
        )
    turns = {i: count for i, count in jumps(episodes).items() if i in states}
    for i, count in turns.items():
        notes.append(
            f"{episodes.states[i]} jumped by 2π {count} times and was unwrapped along each episode; the model "
            "continues it beyond ±π"
        )
    return Repair(
        tuple(states),
        tuple(i for i in both if i < nu),
        tuple(i - nu for i in both if i >= nu),
        tuple(turns),
        tuple(notes),
    )


def _useful(columns: Float[np.ndarray, "m n"], names: tuple[str, ...], notes: list[str]) -> list[int]:
    """Return the columns that move and repeat none before."""
    kept: list[int] = []
    for i, name in enumerate(names):
        column = columns[:, i]
        twin = next((names[j] for j in kept if np.array_equal(column, columns[:, j])), None)
        if np.ptp(column) == 0:
            notes.append(f"left out: {name} is {column[0]:g} throughout")
        elif twin is not None:
            notes.append(f"left out: {name} repeats {twin}")
        else:
            kept.append(i)
    return kept


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
