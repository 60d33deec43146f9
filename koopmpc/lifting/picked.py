"""Some observables of another lifting."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca

from koopmpc.errors import DataError
from koopmpc.lifting.base import Lifting


@dataclass(frozen=True, eq=False)
class Picked(Lifting):
    """ψ(x) = the observables of another lifting at `which`, under their own names; the others are not computed.

    Parameters
    ----------
    lifting
        Where they are picked from.
    which
        Their indices.

    Raises
    ------
    DataError
        An index is none of the lifting's.
    """

    lifting: Lifting
    which: tuple[int, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "which", tuple(int(i) for i in self.which))

    def bind(self, states: Sequence[str]) -> "Picked":
        """Return the copy on the bound lifting."""
        bound = replace(self, lifting=self.lifting.bind(states), bound=tuple(states))
        bad = [i for i in self.which if not 0 <= i < bound.lifting.nz]
        if bad:
            raise DataError(f"which holds {bad[0]}; the lifting has observables 0 … {bound.lifting.nz - 1}")
        return bound

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the chosen ones."""
        return tuple(self.lifting.names[i] for i in self.which)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the chosen ones."""
        z = self.lifting.formula(x)
        return ca.vertcat(*(z[i] for i in self.which))
