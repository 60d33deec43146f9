"""Sums and products of liftings: a + b stacks observables, a * b multiplies them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.lifting.base import CONSTANT, Indices, Lifting, short


@dataclass(frozen=True, eq=False)
class Sum(Lifting):
    """ψ(x) = [ψ₁(x); ψ₂(x); …] without observables that an earlier part holds by name; written ``a + b``."""

    parts: tuple[Lifting, ...]

    def bind(self, states: Sequence[str]) -> "Sum":
        """Return the sum of the bound parts."""
        return Sum(tuple(part.bind(states) for part in self.parts), bound=tuple(states))

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of all parts, each once."""
        return tuple(dict.fromkeys(name for part in self.parts for name in part.names))

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the new observables of each part, one under the other."""
        columns = [part.formula(x) for part in self.parts]
        return ca.vertcat(*(z[int(i)] for z, new in zip(columns, self._new, strict=True) for i in new))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        ends = accumulate(len(new) for new in self._new)
        for part, new, end in zip(self.parts, self._new, ends, strict=True):
            own = Z[:, end - len(new) : end]
            if len(new) == part.nz:
                part._fill(x, own)
            elif len(new):
                whole = np.empty((len(Z), part.nz))
                part._fill(x, whole)
                own[:] = whole[:, new]

    @cached_property
    def _new(self) -> tuple[Indices, ...]:
        """For each part the indices of the observables that no earlier part names."""
        held: set[str] = set()
        new: list[Indices] = []
        for part in self.parts:
            new.append(np.array([i for i, name in enumerate(part.names) if name not in held], dtype=np.intp))
            held.update(part.names)
        return tuple(new)


@dataclass(frozen=True, eq=False)
class Product(Lifting):
    """ψ(x) = aᵢ(x) bⱼ(x) for every i and j; written ``a * b``.

    A product that comes twice, as x₁ x₂ and x₂ x₁ do, is held once. Factors of a name stand in one order,
    states first and without their units, so ``State() * State()`` names what ``Monomials(2)`` does.
    """

    first: Lifting
    second: Lifting

    def bind(self, states: Sequence[str]) -> "Product":
        """Return the product of the bound liftings."""
        bound = Product(self.first.bind(states), self.second.bind(states), bound=tuple(states))
        _ = bound.names
        return bound

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"omega*sin(theta)"`` and ``"theta^2"``."""
        return tuple(self._pairs)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the products, the first lifting's observables the slow index."""
        a, b = self.first.formula(x), self.second.formula(x)
        return ca.vertcat(*(a[int(i)] * b[int(j)] for i, j in self._pairs.values()))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        a, b = np.empty((len(Z), self.first.nz)), np.empty((len(Z), self.second.nz))
        self.first._fill(x, a)
        self.second._fill(x, b)
        left, right = np.array(list(self._pairs.values()), dtype=np.intp).T
        np.multiply(a[:, left], b[:, right], out=Z)

    @cached_property
    def _pairs(self) -> dict[str, tuple[int, int]]:
        """Indices of the two factors by the name of their product; of those with one name the first."""
        plain = [short(state) for state in self.bound_states]
        names = plain if len(set(plain)) == len(plain) else list(self.bound_states)
        order = {state: (i, name) for i, (state, name) in enumerate(zip(self.bound_states, names, strict=True))}
        found: dict[str, tuple[int, int]] = {}
        for i, left in enumerate(self.first.names):
            for j, right in enumerate(self.second.names):
                found.setdefault(_name(left, right, order), (i, j))
        return found


def _name(left: str, right: str, states: dict[str, tuple[int, str]]) -> str:
    """Return the name of the product; `states` gives the place and the plain name of each state."""
    if CONSTANT in (left, right):
        return right if left == CONSTANT else left
    pair = sorted((left, right), key=lambda name: (name not in states, states.get(name, (0, ""))[0], name))
    a, b = (states[name][1] if name in states else name for name in pair)
    if left == right:
        return f"({a})^2" if "*" in a or "^" in a else f"{a}^2"
    return f"{a}*{b}"
