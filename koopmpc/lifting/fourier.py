"""Harmonics of angles."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.errors import DataError
from koopmpc.lifting.base import Lifting, short


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
    states: int | str | Sequence[int | str] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "harmonics", checks.count(self.harmonics, "harmonics"))
        if self.states is not None:
            chosen = (self.states,) if isinstance(self.states, int | str | np.integer) else self.states
            object.__setattr__(self, "states", tuple(s if isinstance(s, str) else int(s) for s in chosen))

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"sin(theta)"`` and ``"cos(2 theta)"``."""
        return tuple(
            f"{function}({'' if k == 1 else f'{k} '}{short(states[i])})"
            for i in self._indices(states)
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
        return self._indices(self._states)

    def _indices(self, states: tuple[str, ...]) -> list[int]:
        if self.states is None:
            return list(range(len(states)))
        chosen = [self.states] if isinstance(self.states, int | str) else self.states
        return [_index(state, states) for state in chosen]


def _index(state: int | str, states: tuple[str, ...]) -> int:
    if isinstance(state, str):
        found = [i for i, name in enumerate(states) if state in (name, short(name))]
        if len(found) == 1:
            return found[0]
    elif -len(states) <= state < len(states):
        return state % len(states)
    raise DataError(
        f"Fourier is asked for state {state!r}; the states are {', '.join(states)}, or 0 … {len(states) - 1}"
    )
