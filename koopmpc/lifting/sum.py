"""The sum of liftings: one under the other."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.lifting.base import Indices, Lifting


@dataclass(frozen=True, eq=False)
class Sum(Lifting):
    """ψ(x) = [ψ₁(x); ψ₂(x); …] without what an earlier part names already; written ``a + b``."""

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
