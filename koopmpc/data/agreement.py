"""Sets of episodes that must be of one plant: the same sample time and the same names."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isclose

from koopmpc.data.episodes import Episodes
from koopmpc.errors import DataError

_CLOSE = 1e-6  # relative; clocks that wrote the files round


@dataclass(frozen=True)
class About:
    """What the first set says: its sample time [s] and names, and where it is from."""

    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    disturbances: tuple[str, ...]
    place: str

    def check(self, episodes: Episodes, place: str) -> None:
        """Raise where the episodes at `place` are not of the same plant.

        Raises
        ------
        DataError
            They differ in dt or in names.
        """
        if not isclose(self.dt, episodes.dt, rel_tol=_CLOSE):
            raise DataError(
                f"{place} has dt = {episodes.dt!r} s, {self.place} has {self.dt!r} s; resample one of them"
            )
        for mine, theirs, what in (
            (self.states, episodes.states, "states"),
            (self.inputs, episodes.inputs, "inputs"),
            (self.disturbances, episodes.disturbances, "disturbances"),
        ):
            if mine != theirs:
                raise DataError(
                    f"{place} names the {what} {_listed(theirs)}, {self.place} {_listed(mine)}; "
                    "rename them, or leave it out"
                )


def about(episodes: Episodes, place: str) -> About:
    """Return what the episodes at `place` say."""
    return About(episodes.dt, episodes.states, episodes.inputs, episodes.disturbances, place)


def joined(sets: Sequence[Episodes]) -> Episodes:
    """Return sets of one plant as one, dt and names those of the first."""
    first = sets[0]
    if len(sets) == 1:
        return first
    every = [episode for one in sets for episode in one]
    return Episodes(every, first.dt, first.states, first.inputs, first.disturbances)


def _listed(names: tuple[str, ...]) -> str:
    return ", ".join(map(repr, names)) or "none"
