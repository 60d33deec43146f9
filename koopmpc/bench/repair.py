"""What logs bring that no model can use, put right and said: columns that stand still or repeat, wrapped angles."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.source import Changed, Source
from koopmpc.errors import DataError
from koopmpc.identify.candidates import jumps


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
    """Return what these episodes need.

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
