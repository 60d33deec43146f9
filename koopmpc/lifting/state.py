"""The state itself."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.lifting.base import Lifting


@dataclass(frozen=True, eq=False)
class State(Lifting):
    """ψ(x) = x; the observables have the states' full names."""

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the states' names."""
        return states

    def formula(self, x: ca.SX) -> ca.SX:
        """Return x."""
        return x

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        Z[:] = x.T
