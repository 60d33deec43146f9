"""What a part is summed into: Σ w dᵀd over the rows d = [p ψ(x⁺)] of its pairs, or its triangular factor."""

import numpy as np
from jaxtyping import Float

from koopmpc.identify.chunks import Lifted
from koopmpc.identify.factor import absorb, empty


class Gram:
    """Sums of products over chunks, each state multiplied once.

    Inside a piece of consecutive states Σ ψ⁺ψ⁺ᵀ is Σ ψψᵀ but for the first and the last state. So the rows between
    are multiplied once, and what the ends have of their own is added; nothing is subtracted, so no digits are lost.

    Parameters
    ----------
    n
        Columns of p = [ψ(x) u u⊗ψ(x)].
    nz
        Those of ψ.
    """

    def __init__(self, n: int, nz: int) -> None:
        self._n, self._nz = n, nz
        self._now, self._cross, self._next = np.zeros((n, n)), np.zeros((n, nz)), np.zeros((nz, nz))
        self._both, self._beside = np.empty((n, n)), np.empty((n, nz))

    def add(self, chunk: Lifted, weights: Float[np.ndarray, " M"] | None) -> None:
        """Add Σ w dᵀd of one chunk; its rows are used up."""
        if weights is not None:
            self._add_weighted(chunk.pairs(weights))
            return
        P, first, last, nz = chunk
        at_ends = np.unique(np.concatenate([first, last - 1]))  # pairs of a first or a last state
        now, after = P[at_ends], P[at_ends + 1, :nz]
        starts, stops = P[first], P[last, :nz]
        P[first] = P[last] = 0.0
        np.matmul(P.T, P, out=self._both)
        np.matmul(P[:-1].T, P[1:, :nz], out=self._beside)
        self._now += self._both
        self._now += starts.T @ starts
        self._next += self._both[:nz, :nz]
        self._next += stops.T @ stops
        self._cross += self._beside
        self._cross += now.T @ after

    def _add_weighted(self, D: Float[np.ndarray, "M nd"]) -> None:
        n, products = self._n, D.T @ D
        self._now += products[:n, :n]
        self._cross += products[:n, n:]
        self._next += products[n:, n:]

    @property
    def size(self) -> Float[np.ndarray, " nd"]:
        """A number for each column that is finite only if the column is: Σ w d²."""
        return np.concatenate([self._now.diagonal(), self._next.diagonal()])

    @property
    def sums(self) -> Float[np.ndarray, "nd nd"]:
        """Σ dᵀd."""
        return np.block([[self._now, self._cross], [self._cross.T, self._next]])


class Factor:
    """The triangular factor R of the rows of chunks, RᵀR = Σ w dᵀd: twice the digits of the sums.

    Parameters
    ----------
    n, nz
        As for `Gram`.
    """

    def __init__(self, n: int, nz: int) -> None:
        self._R = empty(n + nz)
        self.size = np.zeros(n + nz)

    def add(self, chunk: Lifted, weights: Float[np.ndarray, " M"] | None) -> None:
        """Take in the rows of one chunk."""
        D = chunk.pairs(weights)
        self.size = np.abs(D).max(axis=0)
        absorb(self._R, D)

    @property
    def sums(self) -> Float[np.ndarray, "nd nd"]:
        """R."""
        return np.ascontiguousarray(self._R)
