"""Rows d = [ψ(x) u u⊗ψ(x) ψ(x⁺)]: their columns, and the chunks of fixed size in which states are lifted."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from koopmpc.data.episodes import Episodes
from koopmpc.lifting.base import CONSTANT, Lifting
from koopmpc.lifting.state import State

ROWS = 1023  # snapshot pairs lifted at once: with the last state 1024 rows, which stay in the cache


@dataclass(frozen=True, eq=False)
class RowColumns:
    """The columns of the rows d = [ψ(x) u u⊗ψ(x) ψ(x⁺)]; in them the states that ψ lacks are appended to ψ(x).

    Attributes
    ----------
    full
        ψ, then the states that it lacks.
    products
        Indices of the observables in u⊗ψ(x): all but a Constant, since u · 1 is u; none unless the model is bilinear.
    names
        Name of each column.
    regressors
        The columns of ψ(x), u and u⊗ψ(x).
    targets
        The columns of ψ(x⁺), the appended states last.
    """

    full: Lifting
    products: Int[np.ndarray, " np"]
    names: tuple[str, ...]
    regressors: Int[np.ndarray, " n"]
    targets: Int[np.ndarray, " m"]


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


class Piece(NamedTuple):
    """The pairs x_k → x_{k+1}, first ≤ k < last, of one episode."""

    episode: int
    first: int
    last: int


def chunks(episodes: Episodes, rows: int = ROWS) -> list[list[Piece]]:
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
            result[-1].append(Piece(i, first, last))
            room -= last - first
            first = last
    return result


class LiftedChunk(NamedTuple):
    """A chunk in which each state is lifted once: rows p = [ψ(x) u u⊗ψ(x)]; the last state of a piece has u = 0.

    Attributes
    ----------
    P
        The rows, of one piece after the other.
    first, last
        Indices of the first and the last row of each piece. These rows belong to one pair, all others to two.
    nz
        Number of observables.
    weights
        w of each pair; None weighs all by 1.
    """

    P: Float[np.ndarray, "m n"]
    first: Int[np.ndarray, " k"]
    last: Int[np.ndarray, " k"]
    nz: int
    weights: Float[np.ndarray, " M"] | None = None

    def pairs(self) -> Float[np.ndarray, "M nd"]:
        """Return the rows [p ψ(x⁺)] of the pairs, each times the root of its weight."""
        n = self.P.shape[1]
        D = np.empty((len(self.P) - len(self.last), n + self.nz))
        D[:, :n] = _without(self.P, self.last)
        D[:, n:] = _without(self.P[:, : self.nz], self.first)
        if self.weights is not None:
            D *= np.sqrt(self.weights)[:, None]
        return D


def lifted_chunks(
    episodes: Episodes,
    columns: RowColumns,
    which: Sequence[int] | None = None,
    weights: list[Float[np.ndarray, " _"]] | None = None,
) -> Iterator[LiftedChunk]:
    """Yield the chunks of these numbers, by default all, lifted; the memory of one is used again for the next.

    Parameters
    ----------
    episodes
        They have as many inputs as the columns name.
    columns
        What the rows hold.
    which
        Numbers of chunks, in the order of `chunks`.
    weights
        Weight of each step, episode by episode; None weighs all by 1.
    """
    of, lifting, products = episodes.episodes, columns.full, columns.products
    nz, nu = lifting.nz, len(episodes.inputs)
    n = len(columns.names) - nz
    pieces = chunks(episodes)
    space = np.empty((2 * ROWS, n))  # fresh memory costs as much as the rows
    for chunk in pieces if which is None else [pieces[i] for i in which]:
        last = np.cumsum([end - first + 1 for _, first, end in chunk]) - 1
        first = np.concatenate([[0], last[:-1] + 1])
        P = space[: int(last[-1]) + 1]
        lifting.lift_into(_joined([of[i].X[start : end + 1] for i, start, end in chunk]), P[:, :nz])
        if nu:
            U = P[:, nz : nz + nu]
            given = _joined([of[i].U[start:end] for i, start, end in chunk])
            U[:] = np.insert(given, last - np.arange(len(last)), 0.0, axis=0)
            for i, start in enumerate(range(nz + nu, n, max(len(products), 1))):
                np.multiply(U[:, i : i + 1], P[:, products], out=P[:, start : start + len(products)])
        w = None if weights is None else np.concatenate([weights[i][start:end] for i, start, end in chunk])
        yield LiftedChunk(P, first, last, nz, w)


def _joined(parts: list[Float[np.ndarray, "_ n"]]) -> Float[np.ndarray, "M n"]:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _without(P: Float[np.ndarray, "m n"], rows: Int[np.ndarray, " k"]) -> Float[np.ndarray, "M n"]:
    """Return P without these rows, one at each piece's same end; a view where the piece is one."""
    if len(rows) > 1:
        return np.delete(P, rows, axis=0)
    return P[1:] if rows[0] == 0 else P[:-1]
