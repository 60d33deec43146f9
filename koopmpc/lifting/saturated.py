"""Saturated: a lifting of states that are held inside bounds, so that it is constant outside of the data."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import checksum, freeze
from koopmpc.lifting.base import CONSTANT, Lifting, check_lifting


@dataclass(frozen=True, eq=False, init=False)
class Saturated(Lifting):
    """ψ(x) = inner(min(max(x, low), high)): a polynomial that does not grow where no data were.

    Parameters
    ----------
    lifting
        The inner lifting.
    low, high
        (nx,) in the states' units, ±inf where a state has no bound.

    Raises
    ------
    ShapeError
        The bounds have more or fewer entries than there are states.
    DataError
        A low bound is not below the high one.

    Examples
    --------
    >>> import koopmpc as km
    >>> from koopmpc.lifting import Saturated
    >>> square = Saturated(km.Monomials(2), low=[-1.0], high=[1.0])
    >>> square.bind(["x"])([[0.5], [1.0], [7.0]]).ravel().tolist()
    [0.25, 1.0, 1.0]
    """

    lifting: Lifting
    low: Float[np.ndarray, " nx"]
    high: Float[np.ndarray, " nx"]

    def __init__(
        self, lifting: Lifting, low: ArrayLike, high: ArrayLike, *, bound: tuple[str, ...] | None = None
    ) -> None:
        least = checks.array(low, "low", (None,), infinite=True)
        most = checks.array(high, "high", least.shape, infinite=True)
        if not (least < most).all():
            raise DataError("low must be below high for every state")
        freeze(self, lifting=check_lifting(lifting), low=least, high=most, bound=bound)

    def bind(self, states: Sequence[str]) -> "Saturated":
        """Return the copy on the bound inner lifting."""
        if len(states) != len(self.low):
            raise ShapeError(
                f"low and high have {len(self.low)} entries and there are {len(states)} states "
                f"({', '.join(states)}); pass one for each"
            )
        bound = Saturated(self.lifting.bind(states), self.low, self.high, bound=tuple(states))
        _ = bound.names
        return bound

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the inner names, each with ``|`` and a checksum of the bounds: a name fixes the function."""
        tag = f"|{checksum(self.low.tobytes(), self.high.tobytes()):08x}"
        return tuple(name if name == CONSTANT else name + tag for name in self.lifting.bind(states).names)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the inner formula of the bounded states."""
        inside = [_bound(x[i], low, high) for i, (low, high) in enumerate(zip(self.low, self.high, strict=True))]
        return self.lifting.formula(ca.vertcat(*inside))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        self.lifting._fill(np.clip(x, self.low[:, None], self.high[:, None]), Z)


def _bound(x: ca.SX, low: float, high: float) -> ca.SX:
    x = ca.fmin(x, high) if np.isfinite(high) else x
    return ca.fmax(x, low) if np.isfinite(low) else x
