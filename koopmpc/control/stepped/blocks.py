"""Move blocking: the steps in which a plan holds its inputs, alike for all inputs or for each its own."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Int

from koopmpc.base import checks
from koopmpc.base.errors import DataError

Blocking = int | Sequence[int]
Moves = Blocking | Mapping[str, Blocking] | None


class MoveBlocks(NamedTuple):
    """The blocks of a plan: an input may change at the first step of each, unless it is `held` there.

    Attributes
    ----------
    lengths
        Steps of each block; they sum to N.
    held
        (blocks, nu) whether an input keeps its value from the block before.
    given
        What makes the same blocks again: `lengths`, or the lengths of each input by its name.
    """

    lengths: tuple[int, ...]
    held: Bool[np.ndarray, "blocks nu"]
    given: tuple[int, ...] | Mapping[str, tuple[int, ...]]

    @property
    def own(self) -> bool:
        """Whether some input has blocks of its own."""
        return bool(self.held.any())

    def origins(self) -> Int[np.ndarray, "blocks nu"]:
        """Return the block that each input's value comes from, in each block."""
        index = np.where(self.held, 0, np.arange(len(self.held))[:, None])
        return np.maximum.accumulate(index, axis=0)


def find_blocks(moves: Blocking | None, horizon: int) -> tuple[int, ...]:
    """Return the lengths of the blocks of steps in which a plan of N steps holds its inputs: move blocking.

    They are N ones, or M moves of which the last is held, or `moves` itself.

    Raises
    ------
    DataError
        The horizon is no whole number above zero; there are more moves than steps; the lengths do not sum to N.
    """
    N = checks.count(horizon, "horizon")
    if moves is None:
        return (1,) * N
    if isinstance(moves, Sequence):
        lengths = tuple(checks.count(b, "a block of moves") for b in moves)
        if sum(lengths) != N:
            raise DataError(f"the blocks of moves {lengths} sum to {sum(lengths)}, the horizon is {N}")
        return lengths
    if not isinstance(cast(object, moves), int | np.integer):
        raise DataError(
            f"moves is {moves!r}; pass how many moves there are, a tuple of the blocks' lengths, or one by the name of"
            ' each input, {"pump": (1, 1, 2, 4)}'
        )
    M = checks.count(moves, "moves")
    if M > N:
        raise DataError(f"moves is {M}, the horizon {N}; a horizon has at most a move a step")
    return (1,) * (M - 1) + (N - M + 1,)


def find_move_blocks(moves: Moves, horizon: int, inputs: Sequence[str]) -> MoveBlocks:
    """Return the blocks of a plan whose inputs have these names; an input that is left out may change at every step.

    Raises
    ------
    DataError
        As `find_blocks`; or a name is unknown, or fits two inputs.
    """
    if not isinstance(moves, Mapping):
        lengths = find_blocks(moves, horizon)
        return MoveBlocks(lengths, np.zeros((len(lengths), len(inputs)), dtype=np.bool_), lengths)
    each = [find_blocks(given, horizon) for given in checks.order_entries(moves, "moves", inputs)]
    starts = [set(np.cumsum([0, *lengths[:-1]]).tolist()) for lengths in each]
    union = sorted(set[int]().union(*starts))
    held = np.array([[start not in own for own in starts] for start in union], dtype=np.bool_)
    lengths = tuple(int(b) for b in np.diff([*union, sum(each[0])]))
    return MoveBlocks(lengths, held, dict(zip(inputs, each, strict=True)) if held.any() else lengths)
