"""Snapshot pairs in chunks of fixed size, cut from episodes and never across two of them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from koopmpc.data.episodes import Episodes
from koopmpc.lifting.base import Lifting

ROWS = 1023  # snapshot pairs lifted at once: with the last state 1024 rows, which stay in the cache

_NONE = np.zeros(0, dtype=np.intp)


class Piece(NamedTuple):
    """The pairs x_k → x_{k+1}, first ≤ k < last, of one episode."""

    episode: int
    first: int
    last: int


def chunks(episodes: Episodes, rows: int = ROWS) -> list[list[Piece]]:
    """Return all pairs in order, in lists of pieces of `rows` pairs (the last may hold fewer)."""
    result: list[list[Piece]] = [[]]
    room = rows
    for i, episode in enumerate(episodes):
        first = 0
        while first < len(episode):
            if room == 0:
                result.append([])
                room = rows
            last = min(first + room, len(episode))
            result[-1].append(Piece(i, first, last))
            room -= last - first
            first = last
    return result


def table(
    episodes: Episodes,
    lifting: Lifting,
    chunk: list[Piece],
    products: Int[np.ndarray, " np"] = _NONE,
    space: Float[np.ndarray, "_ nd"] | None = None,
) -> Float[np.ndarray, "M nd"]:
    """Return the rows [ψ(x) u u⊗ψ(x) ψ(x⁺)] of one chunk; each state is lifted once.

    `products` are the observables that u is multiplied with; without them the rows are [ψ(x) u ψ(x⁺)]. They are
    written into `space`, of one row more at least, where it is given: fresh memory costs as much as the rows.
    """
    of = episodes.episodes
    nz, nu, cuts = lifting.nz, episodes.nu, len(chunk)
    last = nz + nu + nu * len(products)
    rows = sum(end - first for _, first, end in chunk)
    D = np.empty((rows + 1, last + nz)) if space is None else space[: rows + 1]
    if cuts == 1:
        i, first, end = chunk[0]
        lifting._lift(of[i].X[first : end + 1], D[:, :nz])
        D[:-1, last:] = D[1:, :nz]
        D = D[:-1]
    else:
        D = D[:-1]
        X = np.concatenate([of[i].X[first : end + 1] for i, first, end in chunk])
        Z = np.empty((len(X), nz))
        lifting._lift(X, Z)
        now = np.ones(len(X), dtype=bool)
        now[np.cumsum([end - first + 1 for _, first, end in chunk]) - 1] = False
        D[:, :nz], D[:, last:] = Z[now], Z[1:][now[:-1]]
    if nu:
        U = D[:, nz : nz + nu]
        U[:] = np.concatenate([of[i].U[first:end] for i, first, end in chunk])
        for i, first in enumerate(range(nz + nu, last, max(len(products), 1))):
            np.multiply(U[:, i : i + 1], D[:, products], out=D[:, first : first + len(products)])
    return D
