"""Reduced liftings: a projection on a few directions, and a choice of observables."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.errors import DataError, ShapeError
from koopmpc.lifting.base import Lifting
from koopmpc.values import freeze


@dataclass(frozen=True, eq=False)
class Projected(Lifting):
    """z = basisᵀ ψ(x): r coordinates of another lifting, as a rank-truncated fit uses them.

    Parameters
    ----------
    lifting
        ψ, of nz observables.
    basis
        (nz, r), a direction a column.

    Raises
    ------
    ShapeError
        The basis has not one row for each observable.
    """

    lifting: Lifting
    basis: Float[np.ndarray, "nz r"]

    def __post_init__(self) -> None:
        freeze(self, basis=checks.array(self.basis, "basis", (None, None)))

    def bind(self, states: Sequence[str]) -> "Projected":
        """Return the copy on the bound lifting."""
        bound = replace(self, lifting=self.lifting.bind(states), bound=tuple(states))
        if bound.lifting.nz != len(self.basis):
            raise ShapeError(
                f"basis has {len(self.basis)} rows, the lifting returns {bound.lifting.nz} observables; "
                "pass the lifting that the basis was made for"
            )
        return bound

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return ``"z0", "z1", …``."""
        return tuple(f"z{j}" for j in range(self.basis.shape[1]))

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the r coordinates basisᵀ ψ(x)."""
        return ca.DM(np.ascontiguousarray(self.basis.T)) @ self.lifting.formula(x)

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M r"]) -> None:
        whole = np.empty((len(Z), len(self.basis)))
        self.lifting._fill(x, whole)
        np.matmul(whole, self.basis, out=Z)


@dataclass(frozen=True, eq=False)
class Picked(Lifting):
    """ψ(x) = the observables of another lifting at `which`, under their own names; the others are not computed.

    Parameters
    ----------
    lifting
        The lifting that holds the observables.
    which
        Indices of the observables to keep.

    Raises
    ------
    DataError
        An index is not below the number of observables.
    """

    lifting: Lifting
    which: tuple[int, ...]

    def __post_init__(self) -> None:
        freeze(self, which=tuple(int(i) for i in self.which))

    def bind(self, states: Sequence[str]) -> "Picked":
        """Return the copy on the bound lifting."""
        bound = replace(self, lifting=self.lifting.bind(states), bound=tuple(states))
        bad = [i for i in self.which if not 0 <= i < bound.lifting.nz]
        if bad:
            raise DataError(f"which holds {bad[0]}; the lifting has observables 0 … {bound.lifting.nz - 1}")
        return bound

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the chosen observables."""
        return tuple(self.lifting.names[i] for i in self.which)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the chosen observables."""
        z = self.lifting.formula(x)
        return ca.vertcat(*(z[i] for i in self.which))
