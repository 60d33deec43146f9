"""Rows d = [ψ(x) u u⊗ψ(x) ψ(x⁺)]: their columns, the chunks in which states are lifted, their sums and factors."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg.lapack import dtpqrt

from koopmpc.data.episodes import Episodes
from koopmpc.lifting.base import CONSTANT, Lifting
from koopmpc.lifting.state import State

ROWS = 1023  # snapshot pairs in a chunk: with the last state they make 1024 rows, which stay in the cache
_PANEL = 4, 16  # columns that dtpqrt eliminates at once, the fastest numbers below _MANY rows and from _MANY rows on
_MANY = 256

Triangle = Float[np.ndarray, "nd nd"]
Table = Float[np.ndarray, "m nd"]


@dataclass(frozen=True, eq=False)
class RowColumns:
    """The columns of the rows d = [ψ(x) u u⊗ψ(x) ψ(x⁺)], where the states that ψ lacks are appended to ψ(x)."""

    full: Lifting  # ψ, then the states that it lacks
    # indices of the observables in u⊗ψ(x): all without the Constant, because u · 1 is u; empty if not bilinear
    products: Int[np.ndarray, " np"]
    names: tuple[str, ...]  # name of each column
    regressors: Int[np.ndarray, " n"]  # the columns of ψ(x), u and u⊗ψ(x)
    targets: Int[np.ndarray, " m"]  # the columns of ψ(x⁺), the appended states last


def row_columns(lifting: Lifting, inputs: tuple[str, ...], bilinear: bool) -> RowColumns:
    """Return the columns for the bound ψ and these inputs."""
    points = lifting.bound_states
    full = lifting if set(points) <= set(lifting.names) else lifting + State().bind(points)
    products = np.array([i for i, name in enumerate(lifting.names) if bilinear and name != CONSTANT], dtype=np.intp)
    names = full.names + inputs + tuple(f"{u} * {lifting.names[int(i)]}" for u in inputs for i in products)
    first = len(names)
    return RowColumns(
        full,
        products,
        names + full.names,
        np.concatenate([np.arange(lifting.nz), np.arange(full.nz, first)]),
        np.arange(first, first + full.nz),
    )


Piece = tuple[int, int, int]
"""The pairs x_k → x_{k+1}, first ≤ k < last, of one episode: its number, first and last."""


def split_chunks(episodes: Episodes, rows: int = ROWS) -> list[list[Piece]]:
    """Return all pairs in order, in lists of pieces of `rows` pairs (the last may hold fewer)."""
    result: list[list[Piece]] = [[]]
    room = rows
    for i, episode in enumerate(episodes.episodes):
        first, length = 0, len(episode.U)
        while first < length:
            if room == 0:
                result.append([])
                room = rows
            last = min(first + room, length)
            result[-1].append((i, first, last))
            room -= last - first
            first = last
    return result


class LiftedChunk(NamedTuple):
    """The rows p = [ψ(x) u u⊗ψ(x)] of a chunk, one row for each state; u = 0 in the last row of a piece."""

    P: Float[np.ndarray, "m n"]  # the rows of all pieces, one piece after the other
    # indices of the first and the last row of each piece. Such a row is part of one pair, any other of two
    first: Int[np.ndarray, " k"]
    last: Int[np.ndarray, " k"]
    nz: int  # number of observables
    weights: Float[np.ndarray, " M"] | None = None  # w of each pair; None weighs all by 1

    def pairs(self) -> Float[np.ndarray, "M nd"]:
        """Return the rows [p ψ(x⁺)] of the pairs, each times the root of its weight."""
        n = self.P.shape[1]
        D = np.empty((len(self.P) - len(self.last), n + self.nz))
        D[:, :n] = _without(self.P, self.last)
        D[:, n:] = _without(self.P[:, : self.nz], self.first)
        if self.weights is not None:
            D *= np.sqrt(self.weights)[:, None]
        return D


def lift_chunks(
    episodes: Episodes,
    columns: RowColumns,
    weights: list[Float[np.ndarray, " _"]] | None = None,
) -> Iterator[LiftedChunk]:
    """Yield the lifted chunks; each overwrites the memory of the one before."""
    of, lifting, products = episodes.episodes, columns.full, columns.products
    nz, nu = lifting.nz, len(episodes.inputs)
    n = len(columns.names) - nz
    space = np.empty((2 * ROWS, n))  # fresh memory costs as much as the rows
    for chunk in split_chunks(episodes):
        last = np.cumsum([end - first + 1 for _, first, end in chunk]) - 1
        first = np.concatenate([[0], last[:-1] + 1])
        P = space[: int(last[-1]) + 1]
        lifting.lift_into(concatenate_parts([of[i].X[start : end + 1] for i, start, end in chunk]), P[:, :nz])
        if nu:
            U = P[:, nz : nz + nu]
            inputs = concatenate_parts([of[i].U[start:end] for i, start, end in chunk])
            U[:] = np.insert(inputs, last - np.arange(len(last)), 0.0, axis=0)
            for i, start in enumerate(range(nz + nu, n, max(len(products), 1))):
                np.multiply(U[:, i : i + 1], P[:, products], out=P[:, start : start + len(products)])
        w = None if weights is None else np.concatenate([weights[i][start:end] for i, start, end in chunk])
        yield LiftedChunk(P, first, last, nz, w)


def concatenate_parts(parts: Sequence[Float[np.ndarray, "_ n"]]) -> Float[np.ndarray, "M n"]:
    """Return the parts as one array; a single one is not copied."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _without(P: Float[np.ndarray, "m n"], rows: Int[np.ndarray, " k"]) -> Float[np.ndarray, "M n"]:
    """Return P without these rows, the first or the last row of each piece; for a single piece this is a view."""
    if len(rows) > 1:
        return np.delete(P, rows, axis=0)
    return P[1:] if rows[0] == 0 else P[:-1]


def absorb(R: Triangle, rows: Table) -> None:
    """Turn R, an array in Fortran order, into the triangular factor of [R; rows] in place."""
    if len(rows):
        panel = min(_PANEL[len(rows) >= _MANY], len(R))
        info = dtpqrt(0, panel, R, np.array(rows, order="F"), overwrite_a=1, overwrite_b=1)[3]
        assert info == 0, f"dtpqrt refused argument {-info}"


def empty_factor(nd: int) -> Triangle:
    """Return the factor of no rows."""
    return np.zeros((nd, nd), order="F")


class GramSums:
    """Sums of products over chunks, where the products of a state are computed once.

    In a piece of consecutive states, Σ ψψᵀ and Σ ψ⁺ψ⁺ᵀ share all states except the first and the last. So the products
    of the shared rows are computed once, and those of the end rows are added; no subtraction loses digits.
    """

    def __init__(self, n: int, nz: int) -> None:
        self._n = n
        self._now, self._cross, self._next = np.zeros((n, n)), np.zeros((n, nz)), np.zeros((nz, nz))
        self._both, self._beside = np.empty((n, n)), np.empty((n, nz))

    def add(self, chunk: LiftedChunk) -> None:
        """Add Σ w dᵀd of one chunk; this overwrites rows of the chunk."""
        if chunk.weights is not None:
            self._add_weighted(chunk.pairs())
            return
        P, first, last, nz, _ = chunk
        at_ends = np.unique(np.concatenate([first, last - 1]))  # pairs with the first or the last state of a piece
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
        """Σ w d² of each column, which is finite only if the column is."""
        return np.concatenate([self._now.diagonal(), self._next.diagonal()])

    @property
    def sums(self) -> Float[np.ndarray, "nd nd"]:
        """Σ dᵀd."""
        return np.block([[self._now, self._cross], [self._cross.T, self._next]])


class TriangularFactor:
    """The triangular factor R of the rows of chunks, RᵀR = Σ w dᵀd; it has twice the digits of the sums."""

    def __init__(self, n: int, nz: int) -> None:
        self._R = empty_factor(n + nz)
        self.size = np.zeros(n + nz)

    def add(self, chunk: LiftedChunk) -> None:
        """Absorb the rows of one chunk."""
        D = chunk.pairs()
        self.size = np.abs(D).max(axis=0)
        absorb(self._R, D)

    @property
    def sums(self) -> Float[np.ndarray, "nd nd"]:
        """R."""
        return np.ascontiguousarray(self._R)


class ForgettingMemory:
    """The factor of all rows, each weighted by forgetting^age.

    A row of R is one equation r·k = t of the triangular system R K = T. Forgetting multiplies it by √λ. Without new
    rows along a direction its equation would fade until noise alone decides it (wind-up). So forgetting stops at a
    floor: an equation whose information r_jj² falls below `keep` times its maximum so far is scaled back to that floor.
    Both sides are scaled, so K does not change.
    """

    def __init__(self, nd: int, n: int, forgetting: float, keep: float) -> None:
        self._R, self._n = empty_factor(nd), n
        self._forgetting, self._keep = forgetting, keep
        self._most = np.zeros(n)
        self._weight = 0.0

    def push(self, rows: Table) -> None:
        """Absorb rows, the newest last."""
        R, self._weight = self._take_in(self._R, rows)
        if self._forgetting < 1.0:
            diagonal = np.abs(R.diagonal()[: self._n])
            np.maximum(self._most, diagonal, out=self._most)
            floor = np.sqrt(self._keep) * self._most
            low = np.flatnonzero((diagonal < floor) & (diagonal > 0))
            R[low] *= (floor[low] / diagonal[low])[:, None]

    @property
    def R(self) -> Triangle:
        """The factor of the rows pushed so far; `push` overwrites it."""
        return self._R

    def factor(self, pending: Table) -> tuple[Triangle, float]:
        """Return R and the sum of weights of all rows, the pending ones included."""
        return self._take_in(self._R.copy(order="F"), pending)

    def _take_in(self, R: Triangle, rows: Table) -> tuple[Triangle, float]:
        if self._forgetting == 1.0:
            absorb(R, rows)
            return R, self._weight + len(rows)
        R *= self._forgetting ** (0.5 * len(rows))
        weights = self._forgetting ** np.arange(len(rows) - 1.0, -1.0, -1.0)
        absorb(R, rows * np.sqrt(weights)[:, None])
        return R, self._weight * self._forgetting ** len(rows) + float(weights.sum())


class WindowMemory:
    """The factor of the last `length` rows, as a queue made of two stacks, in which nothing is subtracted.

    The back stack absorbs new blocks. The front stack holds a factor for each old block: that of the block and of all
    later blocks in the front. Dropping a factor therefore removes the oldest block. When the front is empty, the back
    becomes the front. Each row is absorbed twice, errors do not add up over time, and about 2 · length rows are held in
    memory. The step that turns the back into the front costs as much as `length` updates.
    """

    def __init__(self, nd: int, length: int, block: int) -> None:
        self._nd, self._length, self._block = nd, length, block
        self._front: deque[tuple[Triangle, Table]] = deque()
        self._back: list[Table] = []
        self._R = empty_factor(nd)

    def push(self, rows: Table) -> None:
        """Absorb a block of rows, the newest last."""
        absorb(self._R, rows)
        self._back.append(rows.copy())
        self._drop(0)

    def factor(self, pending: Table) -> tuple[Triangle, float]:
        """Return R and the number of rows in the window, whose last rows are the pending ones."""
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
        return R, float(self._length_held - old + len(pending))

    @property
    def _length_held(self) -> int:
        return (len(self._front) + len(self._back)) * self._block

    def _drop(self, waiting: int) -> int:
        """Drop the blocks before the window; return the number of rows of the oldest block that lie before it."""
        while self._length_held + waiting - self._length >= self._block:
            self._turn()
            self._front.popleft()
        return max(self._length_held + waiting - self._length, 0)

    def _turn(self) -> None:
        """Turn the back into the front if the front is empty."""
        if not self._front:
            R = empty_factor(self._nd)
            for rows in reversed(self._back):
                absorb(R, rows)
                self._front.appendleft((R.copy(order="F"), rows))
            self._back, self._R = [], empty_factor(self._nd)
