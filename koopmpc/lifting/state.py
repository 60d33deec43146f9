"""The state itself, or some of it."""

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.lifting.base import CONSTANT, Chosen, Lifting, frozen, indices
from koopmpc.values import freeze


@dataclass(frozen=True, eq=False)
class State(Lifting):
    """ψ(x) = x, or the chosen xᵢ; the observables have the states' full names.

    Parameters
    ----------
    states
        The chosen states, by index or by name, with or without the unit; all of them by default.
    """

    states: Chosen | None = None

    def __post_init__(self) -> None:
        freeze(self, states=frozen(self.states))

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the chosen states."""
        return tuple(states[i] for i in indices(self.states, states, "State"))

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the chosen states."""
        return x if self.whole else x[self.chosen]

    def lift_into(self, X: Float[np.ndarray, "M nx"], Z: Float[np.ndarray, "M nz"]) -> None:
        """Write the chosen states of the rows of X; rows need not be turned into columns for it."""
        Z[:] = X if self.whole else X[:, self.chosen]

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        Z[:] = (x if self.whole else x[self.chosen]).T

    @property
    def whole(self) -> bool:
        """Whether it is all of the state, in its order."""
        return self.states is None

    @cached_property
    def chosen(self) -> list[int]:
        """Indices of the chosen states, once bound."""
        return indices(self.states, self.bound_states, "State")


@dataclass(frozen=True, eq=False)
class Constant(Lifting):
    """ψ(x) = 1; the observable is named ``"1"``."""

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the one name."""
        return (CONSTANT,)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return 1."""
        return ca.SX(1)

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        Z[:] = 1.0
