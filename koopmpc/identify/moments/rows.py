"""Snapshot pairs in chunks of fixed size, cut from episodes and never across two of them."""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.source import Changed, Held, Source
from koopmpc.errors import DataError, ShapeError
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
        first, length = 0, len(episode)
        while first < length:
            if room == 0:
                result.append([])
                room = rows
            last = min(first + room, length)
            result[-1].append(Piece(i, first, last))
            room -= last - first
            first = last
    return result


class Lifted(NamedTuple):
    """A chunk, each state lifted once: rows p = [ψ(x) u u⊗ψ(x)]; the last state of a piece has u = 0.

    Attributes
    ----------
    P
        The rows, of one piece after the other.
    first, last
        Where the pieces begin and end: rows that belong to one pair, where all others belong to two.
    nz
        Number of observables.
    """

    P: Float[np.ndarray, "m n"]
    first: Int[np.ndarray, " k"]
    last: Int[np.ndarray, " k"]
    nz: int

    def pairs(self, weights: Float[np.ndarray, " M"] | None = None) -> Float[np.ndarray, "M nd"]:
        """Return the rows [p ψ(x⁺)] of the pairs, each times the root of its weight."""
        n = self.P.shape[1]
        D = np.empty((len(self.P) - len(self.last), n + self.nz))
        D[:, :n] = _without(self.P, self.last)
        D[:, n:] = _without(self.P[:, : self.nz], self.first)
        if weights is not None:
            D *= np.sqrt(weights)[:, None]
        return D


def lifted(
    episodes: Episodes,
    lifting: Lifting,
    chunk: list[Piece],
    products: Int[np.ndarray, " np"] = _NONE,
    space: Float[np.ndarray, "_ n"] | None = None,
) -> Lifted:
    """Return the lifted states of one chunk.

    `products` are the observables that u is multiplied with. The rows are written into `space`, long enough for
    twice the pairs, where it is given: fresh memory costs as much as the rows.
    """
    of, nz, nu = episodes.episodes, lifting.nz, episodes.nu
    last = np.cumsum([end - first + 1 for _, first, end in chunk]) - 1
    first = np.concatenate([[0], last[:-1] + 1])
    count = int(last[-1]) + 1
    P = np.empty((count, nz + nu + nu * len(products))) if space is None else space[:count]
    lifting._lift(_joined([of[i].X[start : end + 1] for i, start, end in chunk]), P[:, :nz])
    if nu:
        U = P[:, nz : nz + nu]
        U[:] = np.insert(
            _joined([of[i].U[start:end] for i, start, end in chunk]), last - np.arange(len(last)), 0.0, axis=0
        )
        for i, start in enumerate(range(nz + nu, P.shape[1], max(len(products), 1))):
            np.multiply(U[:, i : i + 1], P[:, products], out=P[:, start : start + len(products)])
    return Lifted(P, first, last, nz)


def _joined(parts: list[Float[np.ndarray, "_ n"]]) -> Float[np.ndarray, "M n"]:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _without(P: Float[np.ndarray, "m n"], rows: Int[np.ndarray, " k"]) -> Float[np.ndarray, "M n"]:
    """Return P without these rows, one at each piece's same end; a view where the piece is one."""
    if len(rows) > 1:
        return np.delete(P, rows, axis=0)
    return P[1:] if rows[0] == 0 else P[:-1]


Weights = Callable[[Episode], ArrayLike] | Sequence[ArrayLike] | Float[np.ndarray, "..."]
Steps = list[Float[np.ndarray, " T"]]  # of each episode, one a step


def weights_of(weights: Weights, episodes: Episodes) -> Steps:
    """Return the weight of each step of each episode.

    Raises
    ------
    ShapeError
        There is not one item an episode, or an item is neither a number nor one a step.
    DataError
        A weight is below zero or not finite.
    """
    if callable(weights):
        given = [weights(episode) for episode in episodes]
    else:
        single = isinstance(weights, np.ndarray) and weights.ndim == 0
        if single or not isinstance(cast(object, weights), Iterable):
            raise DataError(f"weights is {weights!r}; pass one item an episode, or a function of an Episode")
        given = list(cast("Sequence[ArrayLike]", weights))
        if len(given) != len(episodes):
            raise ShapeError(
                f"there are {len(given)} weights and {len(episodes)} episodes; give each episode a number, or "
                "an array of one a step"
            )
    steps = [
        checks.vector(item, f"the weight of episode {i}", len(episode))
        for i, (item, episode) in enumerate(zip(given, episodes, strict=True))
    ]
    for i, own in enumerate(steps):
        if own.min() < 0:
            raise DataError(f"the weight of episode {i} is {own.min():g}; weights are 0 or above")
    return steps


def changed(weights: Weights | None, source: Source) -> Weights | None:
    """Return the weights that belong to the episodes as `source` changes them: an embedding drops their first steps.

    Raises
    ------
    DataError
        They are a list, and the source is not made from Episodes, which alone have an order that is known.
    """
    if weights is None or callable(weights):
        return weights
    dropped, inner = 0, source
    while isinstance(inner, Changed):
        dropped, inner = dropped + inner.history, inner.source
    if not isinstance(inner, Held):
        raise DataError("weights are a list, which only Episodes have an order for; pass a function of an Episode")
    return [own[dropped:] for own in weights_of(weights, inner.episodes) if len(own) > dropped]
