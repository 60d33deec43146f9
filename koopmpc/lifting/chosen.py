"""States chosen by index or by name."""

from collections.abc import Sequence

import numpy as np

from koopmpc.errors import DataError
from koopmpc.lifting.base import short

Chosen = int | str | Sequence[int | str]


def index(state: int | str, states: Sequence[str], who: str) -> int:
    """Return the index of a state given by its index, or by its name with or without the unit.

    Raises
    ------
    DataError
        There is no such state; `who` asked for it.
    """
    if isinstance(state, str):
        found = [i for i, name in enumerate(states) if state in (name, short(name))]
        if len(found) == 1:
            return found[0]
    elif -len(states) <= state < len(states):
        return state % len(states)
    raise DataError(
        f"{who} is asked for state {state!r}; the states are {', '.join(states)}, or 0 … {len(states) - 1}"
    )


def indices(chosen: Chosen | None, states: Sequence[str], who: str) -> list[int]:
    """Return the indices of the chosen states; of all of them where `chosen` is None."""
    if chosen is None:
        return list(range(len(states)))
    some = [chosen] if isinstance(chosen, int | str) else chosen
    return [index(state, states, who) for state in some]


def frozen(chosen: Chosen | None) -> tuple[int | str, ...] | None:
    """Return what a frozen dataclass keeps of a choice: a tuple of ints and names, or None for all."""
    if chosen is None:
        return None
    some = [chosen] if isinstance(chosen, int | str | np.integer) else chosen
    return tuple(state if isinstance(state, str) else int(state) for state in some)
