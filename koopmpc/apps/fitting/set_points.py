"""take_set_points: set points in logs of closed loops, apart from the signals that act on the plant."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from koopmpc.apps.fitting.logs import DividedData
from koopmpc.base.errors import DataError
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.files.columns import drop_unit


def take_set_points(
    split: DividedData, names: Sequence[str]
) -> tuple[DividedData, list[Float[np.ndarray, "T nr"]] | None]:
    """Return the data without the columns of set points, and these columns for each fitted episode.

    Parameters
    ----------
    split
        Data that were read with the set points among the measured disturbances.
    names
        Names of the set points, with or without units; with none nothing is taken out.

    Raises
    ------
    DataError
        A set point is not in the logs, or the logs are larger than memory.
    """
    if not names:
        return split, None
    if not isinstance(split.fitted, Episodes):
        raise DataError("--set-point goes with logs that fit into memory; pass fewer logs")
    taken = _find_places(split.fitted, names)
    signals = [e.W[:, taken] for e in split.fitted]
    fitted, seen, held_out = (drop_set_points(each, names) for each in (split.fitted, split.seen, split.held_out))
    return replace(split, fitted=fitted, seen=seen, held_out=held_out, learned=None), signals


def drop_set_points(episodes: Episodes, names: Sequence[str]) -> Episodes:
    """Return the episodes without these measured disturbances.

    Raises
    ------
    DataError
        A set point is not in the logs.
    """
    taken = _find_places(episodes, names)
    kept = [i for i in range(len(episodes.disturbances)) if i not in taken]
    left = [Episode(X=e.X, U=e.U, W=e.W[:, kept]) for e in episodes]
    names_left = tuple(episodes.disturbances[i] for i in kept)
    return Episodes(left, episodes.dt, episodes.states, episodes.inputs, names_left)


def _find_places(episodes: Episodes, names: Sequence[str]) -> list[int]:
    """Return the places of set points among the measured disturbances, whose units the names may leave out."""
    known = list(episodes.disturbances)
    stems = [drop_unit(name) for name in known]
    places: list[int] = []
    for name in names:
        if name not in known and stems.count(name.strip().lower()) != 1:
            raise DataError(f"the logs lack the column {name}; --set-point names columns of a table")
        places.append(known.index(name) if name in known else stems.index(name.strip().lower()))
    return places
