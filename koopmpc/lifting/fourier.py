"""Harmonics of angles."""

from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.lifting.base import Chosen, Lifting, frozen, indices, short
from koopmpc.values import freeze


@dataclass(frozen=True, eq=False)
class Fourier(Lifting):
    """ψ(x) = sin k xᵢ and cos k xᵢ for k = 1 … `harmonics` and each chosen state i, and nothing else.

    Parameters
    ----------
    harmonics
        Highest multiple k.
    states
        The chosen states, by index or by name, with or without the unit; all of them by default.
    """

    harmonics: int
    states: Chosen | None = None

    def __post_init__(self) -> None:
        freeze(self, harmonics=checks.count(self.harmonics, "harmonics"), states=frozen(self.states))

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"sin(theta)"`` and ``"cos(2 theta)"``."""
        return tuple(
            f"{function}({'' if k == 1 else f'{k} '}{short(states[i])})"
            for i in indices(self.states, states, "Fourier")
            for k in range(1, self.harmonics + 1)
            for function in ("sin", "cos")
        )

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the harmonics, state by state."""
        angles = [k * x[i] for i in self._chosen for k in range(1, self.harmonics + 1)]
        return ca.vertcat(*(function(angle) for angle in angles for function in (ca.sin, ca.cos)))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        j = 0
        for i in self._chosen:
            for k in range(1, self.harmonics + 1):
                angle = k * x[i]
                Z[:, j] = np.sin(angle)
                Z[:, j + 1] = np.cos(angle)
                j += 2

    @cached_property
    def _chosen(self) -> list[int]:
        return indices(self.states, self.bound_states, "Fourier")
