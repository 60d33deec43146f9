"""The constant one: it lets z⁺ = A z + B u be affine."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.lifting.base import Lifting


@dataclass(frozen=True, eq=False)
class Constant(Lifting):
    """ψ(x) = 1; the observable is named ``"1"``."""

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the one name."""
        return ("1",)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return 1."""
        return ca.SX(1)

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        Z[:] = 1.0
