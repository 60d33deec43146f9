"""WindowLayout: where the limits of a plan stand in a table of rows of limits."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Int


class TableColumns(NamedTuple):
    """Where the columns of a kind stand in the table: `first` … `first` + `width` − 1."""

    first: int
    width: int


class WindowLayout(NamedTuple):
    """Where the limits of a plan stand in a table of rows of limits; it is that of every table of this plan.

    Attributes
    ----------
    used
        The lengths of blocks, and which inputs are held so long; an input box holds at each step, too.
    width
        W of the table.
    raw, tight
        Where targets stand, and the tightest limits of targets.
    moves, outputs
        Where the limits of all moves stand; which entries of a plan are outputs.
    entries
        Those of the plan, of its map of a reference that moves, and of that of a single row.
    """

    used: dict[int, Bool[np.ndarray, " nu"]]
    width: int
    raw: TableColumns
    tight: TableColumns
    moves: Int[np.ndarray, " moves"]
    outputs: slice
    entries: tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Int[np.ndarray, " n"]]
