"""What a part is summed into: Σ w dᵀd over the rows d = [p ψ(x⁺)] of its pairs, or its triangular factor."""

from collections import deque

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dtpqrt

from koopmpc.identify.moments.rows import Lifted

_PANEL = 4, 16  # columns that dtpqrt eliminates at once: fastest for few rows, for many
_MANY = 256

Triangle = Float[np.ndarray, "nd nd"]
Table = Float[np.ndarray, "m nd"]


def absorb(R: Triangle, rows: Table) -> None:
    """Turn R into the triangular factor of [R; rows], in place; R is in Fortran's order."""
    if len(rows):
        panel = min(_PANEL[len(rows) >= _MANY], len(R))
        info = dtpqrt(0, panel, R, np.array(rows, order="F"), overwrite_a=1, overwrite_b=1)[3]
        assert info == 0, f"dtpqrt refused argument {-info}"


def empty(nd: int) -> Triangle:
    """Return the factor of no rows."""
    return np.zeros((nd, nd), order="F")


class Forgetting:
    """The factor of all rows, each weighted by forgetting^age.

    A row of R is one equation r·k = t of the triangular system R K = T. Forgetting multiplies it by √λ. Where no
    new row speaks about its direction it would fade to nothing, and the next bit of noise would decide (wind-up). So
    an equation whose information r_jj² falls below `keep` times the most that it ever was is forgotten no further: it
    is scaled back to that floor, left side and right side together, which leaves K as it is.

    Parameters
    ----------
    nd, n
        Columns of a row, and how many of them are regressors.
    forgetting
        λ in (0, 1].
    keep
        The floor, as a share of information.
    """

    def __init__(self, nd: int, n: int, forgetting: float, keep: float) -> None:
        self._R, self._n = empty(nd), n
        self._forgetting, self._keep = forgetting, keep
        self._most = np.zeros(n)
        self._weight = 0.0

    def push(self, rows: Table) -> None:
        """Take in rows, the newest last."""
        R, self._weight = self._joined(self._R, rows)
        if self._forgetting < 1.0:
            held = np.abs(R.diagonal()[: self._n])
            np.maximum(self._most, held, out=self._most)
            floor = np.sqrt(self._keep) * self._most
            low = np.flatnonzero((held < floor) & (held > 0))
            R[low] *= (floor[low] / held[low])[:, None]

    def factor(self, pending: Table) -> tuple[Triangle, float]:
        """Return R and the sum of weights of all rows, with those that wait."""
        return self._joined(self._R.copy(order="F"), pending)

    def _joined(self, R: Triangle, rows: Table) -> tuple[Triangle, float]:
        if self._forgetting == 1.0:
            absorb(R, rows)
            return R, self._weight + len(rows)
        R *= self._forgetting ** (0.5 * len(rows))
        weights = self._forgetting ** np.arange(len(rows) - 1.0, -1.0, -1.0)
        absorb(R, rows * np.sqrt(weights)[:, None])
        return R, self._weight * self._forgetting ** len(rows) + float(weights.sum())


class Window:
    """The factor of the last `length` rows, as of a queue made of two stacks: nothing is ever subtracted.

    New blocks are absorbed at the back. For old ones the front holds one factor for each block: of it and all later
    ones of the front, so the oldest leaves by dropping a factor. When the front is used up, the back becomes the
    front. A row is absorbed twice in its life, errors do not add up over time, and it takes the memory of about
    2 · length rows. Turning the back into the front takes one step that costs as much as `length` updates.

    Parameters
    ----------
    nd
        Columns of a row.
    length
        Rows in the window.
    block
        Rows that come at once.
    """

    def __init__(self, nd: int, length: int, block: int) -> None:
        self._nd, self._length, self._block = nd, length, block
        self._front: deque[tuple[Triangle, Table]] = deque()
        self._back: list[Table] = []
        self._R = empty(nd)

    def push(self, rows: Table) -> None:
        """Take in a block of rows, the newest last."""
        absorb(self._R, rows)
        self._back.append(rows.copy())
        self._drop(0)

    def factor(self, pending: Table) -> tuple[Triangle, float]:
        """Return R and the number of rows in the window, the last of them those that wait."""
        pending = pending[-self._length :]
        old = self._drop(len(pending))
        if old:
            self._turn()
        R = self._R.copy(order="F")
        if old:
            absorb(R, self._front[0][1][old:])
        if len(self._front) > bool(old):
            absorb(R, self._front[bool(old)][0])
        absorb(R, pending)
        return R, float(self._held - old + len(pending))

    @property
    def _held(self) -> int:
        return (len(self._front) + len(self._back)) * self._block

    def _drop(self, waiting: int) -> int:
        """Let blocks go that lie before the window; return how many rows of the oldest one do."""
        while self._held + waiting - self._length >= self._block:
            self._turn()
            self._front.popleft()
        return max(self._held + waiting - self._length, 0)

    def _turn(self) -> None:
        """Make the back the front where that is empty."""
        if not self._front:
            R = empty(self._nd)
            for rows in reversed(self._back):
                absorb(R, rows)
                self._front.appendleft((R.copy(order="F"), rows))
            self._back, self._R = [], empty(self._nd)


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
