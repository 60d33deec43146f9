"""Products of powers of the states."""

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.lifting.base import Lifting, short
from koopmpc.values import freeze


@dataclass(frozen=True, eq=False)
class Monomials(Lifting):
    """ψ(x) = all x₁^a₁ … xₙ^aₙ of total degree a₁ + … + aₙ from 2 to `degree`, in graded order.

    Degree 1 is `State`, degree 0 is `Constant`; add them where they are wanted.
    """

    degree: int

    def __post_init__(self) -> None:
        freeze(self, degree=checks.count(self.degree, "degree", 2))

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"theta^2*omega"``."""
        names = [short(state) for state in states]
        powers = (Counter(factors) for factors in _factors(len(states), self.degree))
        return tuple("*".join(names[i] + (f"^{p}" if p > 1 else "") for i, p in each.items()) for each in powers)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return each monomial as one of a degree less times a state."""
        known: dict[tuple[int, ...], ca.SX] = {(i,): x[i] for i in range(x.shape[0])}
        for factors in self._all:
            known[factors] = known[factors[:-1]] * x[factors[-1]]
        return ca.vertcat(*(known[factors] for factors in self._all))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        known: dict[tuple[int, ...], np.ndarray] = {(i,): column for i, column in enumerate(x)}
        for j, factors in enumerate(self._all):
            product = known[factors[:-1]] * x[factors[-1]]
            if len(factors) < self.degree:
                known[factors] = product
            Z[:, j] = product

    @cached_property
    def _all(self) -> list[tuple[int, ...]]:
        return _factors(len(self.bound_states), self.degree)


def _factors(nx: int, degree: int) -> list[tuple[int, ...]]:
    """Return the monomials of degree 2 … `degree` as ascending lists of state indices."""
    return [c for d in range(2, degree + 1) for c in combinations_with_replacement(range(nx), d)]
