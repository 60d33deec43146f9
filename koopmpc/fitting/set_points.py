"""take_set_points: set points in logs of closed loops, apart from the signals that act on the plant."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import DataError
from koopmpc.fitting.repair import DividedData


def take_set_points(
    split: DividedData, names: Sequence[str]
) -> tuple[DividedData, list[Float[np.ndarray, "T nr"]] | None]:
    """Return the data without the columns of set points, and these columns for each fitted episode.

    Parameters
    ----------
    split
        Data that were read with the set points among the measured disturbances.
    names
        Names of the set points; with none nothing is taken out.

    Raises
    ------
    DataError
        A set point is not in the logs, or the logs are larger than memory.
    """
    if not names:
        return split, None
    if not isinstance(split.fitted, Episodes):
        raise DataError("--set-point goes with logs that fit into memory; pass fewer logs")
    missing = [name for name in names if name not in split.fitted.disturbances]
    if missing:
        raise DataError(f"the logs lack the column {missing[0]}; --set-point names columns of a table")
    taken = [split.fitted.disturbances.index(name) for name in names]
    signals = [e.W[:, taken] for e in split.fitted]

    def drop(episodes: Episodes) -> Episodes:
        kept = [i for i, name in enumerate(episodes.disturbances) if name not in names]
        left = [Episode(X=e.X, U=e.U, W=e.W[:, kept]) for e in episodes]
        return Episodes(
            left, episodes.dt, episodes.states, episodes.inputs, tuple(episodes.disturbances[i] for i in kept)
        )

    return (
        replace(split, fitted=drop(split.fitted), seen=drop(split.seen), held_out=drop(split.held_out), learned=None),
        signals,
    )
