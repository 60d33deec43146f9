"""The start of a run for several controllers in one, whose models may have different states."""

from collections.abc import Iterable

from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.move import Controller
from koopmpc.errors import ShapeError
from koopmpc.loop.simulate import start_for, start_sizes


def join_start_sizes(parts: Iterable[Controller]) -> frozenset[int]:
    """Return the numbers of states of all models that the controllers hold."""
    return frozenset[int]().union(*map(start_sizes, parts))


def reset_parts(parts: Iterable[Controller], x0: ArrayLike | None, u_prev: ArrayLike | None) -> None:
    """Begin a run with each controller; one whose model has another number of states begins without x0.

    Raises
    ------
    ShapeError, DataError
        x0 is no vector of finite numbers, or no model has as many states.
    """
    parts = list(parts)
    sizes = sorted(join_start_sizes(parts))
    start = None if x0 is None else checks.array(x0, "x0", None if sizes else (None,))
    if start is not None and sizes and start.shape not in [(size,) for size in sizes]:
        expected = " or ".join(f"({size},)" for size in sizes)
        raise ShapeError(f"x0 has shape {start.shape}, expected {expected}, the states of a model in it; or pass None")
    for part in parts:
        part.reset(start_for(part, start), u_prev)
