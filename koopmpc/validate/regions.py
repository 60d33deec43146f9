"""Coverage: the part of the state and input space that the data visited."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.episodes import Episodes
from koopmpc.errors import DataError, ShapeError
from koopmpc.validate.text import quantity
from koopmpc.values import Value

_SAID = 0.05  # share of the pair's box from which an empty rectangle is worth a sentence


@dataclass(frozen=True, eq=False)
class Region(Value):
    """A rectangle of two coordinates that no sample lies in.

    Attributes
    ----------
    names
        The two coordinates.
    low, high
        (2,) its corners; infinite where it reaches the edge of the box that was looked at.
    share
        Share of the area of that box.
    """

    names: tuple[str, str]
    low: Float[np.ndarray, "2"]
    high: Float[np.ndarray, "2"]
    share: float

    def __str__(self) -> str:
        """Return e.g. ``"theta in [1.2, 2.1] rad with omega > 3 rad/s was never visited"``."""
        ends = zip(self.names, self.low.tolist(), self.high.tolist(), strict=True)
        parts = [quantity(name, _interval(low, high)) for name, low, high in ends if np.isfinite([low, high]).any()]
        return f"{' with '.join(parts)} was never visited"


def empty_regions(
    names: tuple[str, ...],
    low: Float[np.ndarray, " n"],
    high: Float[np.ndarray, " n"],
    held: Bool[np.ndarray, "np bins bins"],
) -> tuple[Region, ...]:
    """Return the largest empty rectangle of each pair, the largest first; those below 5 % of the box are left out."""
    if not held.size:
        return ()
    bins = held.shape[1]
    first, last = np.triu_indices(bins)
    last = last + 1
    total = np.zeros((len(held), bins + 1, bins + 1), dtype=np.int64)
    total[:, 1:, 1:] = held.cumsum(axis=1).cumsum(axis=2)
    strips = total[:, last] - total[:, first]  # samples in each interval of the first coordinate
    area = np.outer(last - first, last - first)
    box = list(zip(low.tolist(), high.tolist(), strict=True))
    found: list[Region] = []
    for strip, (i, j) in zip(strips, combinations(range(len(names)), 2), strict=True):
        free = np.where(strip[:, last] == strip[:, first], area, 0)
        a, b = np.unravel_index(int(free.argmax()), free.shape)
        share = float(free[a, b]) / bins**2
        if share < _SAID or high[i] == low[i] or high[j] == low[j]:
            continue
        edges = np.array([_edges(int(first[k]), int(last[k]), bins, *box[c]) for k, c in ((a, i), (b, j))])
        found.append(Region((names[i], names[j]), edges[:, 0].copy(), edges[:, 1].copy(), share))
    found.sort(key=lambda region: -region.share)
    return tuple({str(region): region for region in found}.values())


def _edges(first: int, last: int, bins: int, low: float, high: float) -> tuple[float, float]:
    width = (high - low) / bins
    return (-np.inf if first == 0 else low + first * width), (np.inf if last == bins else low + last * width)


def _interval(low: float, high: float) -> str:
    if np.isinf(high):
        return f"> {low:.3g}"
    return f"< {high:.3g}" if np.isinf(low) else f"in [{low:.3g}, {high:.3g}]"


_ROWS = 4096  # samples that are binned at once
_BINS = 10  # bins of a coordinate, at most
_IN_CELL = 10  # samples that a cell of a pair holds on average, at least
_PAIRED = 40  # coordinates up to which pairs are looked at


@dataclass(frozen=True, eq=False)
class Coverage(Value):
    """The regions of the samples (x_k, u_k) of a data set, in bins of each coordinate and of each pair.

    Attributes
    ----------
    names
        States, then inputs.
    nx
        Number of states.
    low, high
        (n,) the box that is looked at: the range of the data, wider where asked for.
    seen_low, seen_high
        (n,) the range of the data.
    counts
        (n, bins) samples in each bin of each coordinate.
    pairs
        (n(n−1)/2, bins, bins) samples in each cell of each pair of coordinates, in the order (0, 1), (0, 2), …;
        none for more than 40 coordinates.
    samples
        M, the number of samples.
    """

    names: tuple[str, ...]
    nx: int
    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    seen_low: Float[np.ndarray, " n"]
    seen_high: Float[np.ndarray, " n"]
    counts: Int[np.ndarray, "n bins"]
    pairs: Int[np.ndarray, "np bins bins"]
    samples: int

    @property
    def bins(self) -> int:
        """Number of bins of each coordinate."""
        return self.counts.shape[1]

    @property
    def occupied(self) -> Float[np.ndarray, " n"]:
        """(n,) share of the bins of each coordinate that hold a sample."""
        return np.mean(self.counts > 0, axis=1)

    @cached_property
    def empty(self) -> tuple[Region, ...]:
        """The largest empty rectangle of each pair, those above 5 % of the pair's box, the largest first."""
        return empty_regions(self.names, self.low, self.high, self.pairs > 0)

    def share(self, x: ArrayLike, u: ArrayLike | None = None) -> Float[np.ndarray, "..."]:
        """Return the share, 0 … 1, of the coordinates and pairs of (x, u) that lie in cells that the data visited.

        Parameters
        ----------
        x
            (nx,), or rows (M, nx).
        u
            (nu,), or (M, nu); without it only the states count.
        """
        rows = checks.array(x, "x", finite=False)
        single = rows.ndim == 1
        parts = [np.atleast_2d(rows)]
        if u is not None:
            parts.append(np.atleast_2d(checks.array(u, "u", finite=False)))
        wanted = self.nx if u is None else len(self.names)
        if rows.ndim > 2 or sum(part.shape[1] for part in parts) != wanted or len({*map(len, parts)}) > 1:
            shapes = " and ".join(str(np.shape(part)) for part in (x, u) if part is not None)
            raise ShapeError(
                f"x and u have shapes {shapes}, the coverage has {self.nx} states and "
                f"{len(self.names) - self.nx} inputs; pass (nx,) and (nu,), or rows of both"
            )
        V = np.concatenate(parts, axis=1) if len(parts) > 1 else parts[0]
        cells, inside = self._cells(V)
        hits = [self._held[np.arange(wanted), cells] & inside]
        if len(self.pairs):
            first, second, order = self._columns[wanted]
            hits.append(self._paired[order, cells[:, first], cells[:, second]] & inside[:, first] & inside[:, second])
        result = np.mean(np.concatenate(hits, axis=1), axis=1)
        return result.reshape(()) if single else result

    def seen(self, x: ArrayLike, u: ArrayLike | None = None) -> Bool[np.ndarray, "..."]:
        """Return True for each coordinate and each pair of (x, u) that lies in a cell that the data visited.

        True for every sample of the data; false outside their range. For use in a closed loop: a state that was
        never seen is one where the model extrapolates.
        """
        return np.asarray(self.share(x, u) == 1.0)

    def _cells(self, V: Float[np.ndarray, "M n"]) -> tuple[np.ndarray, np.ndarray]:
        n = V.shape[1]
        return _cells(V, self.low[:n], self.high[:n], self.bins), np.logical_and(
            self.seen_low[:n] <= V, self.seen_high[:n] >= V
        )

    @cached_property
    def _held(self) -> np.ndarray:
        return self.counts > 0

    @cached_property
    def _paired(self) -> np.ndarray:
        return self.pairs > 0

    @cached_property
    def _columns(self) -> dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """First and second coordinate of the pairs among the first `wanted`, and their places."""
        every = np.array(list(combinations(range(len(self.names)), 2)), dtype=np.intp).reshape(-1, 2)
        places = {wanted: np.flatnonzero(every[:, 1] < wanted) for wanted in (self.nx, len(self.names))}
        return {wanted: (every[order, 0], every[order, 1], order) for wanted, order in places.items()}


def coverage(
    episodes: Episodes, *, low: ArrayLike | None = None, high: ArrayLike | None = None, bins: int | None = None
) -> Coverage:
    """Return the regions in which the samples (x_k, u_k), k < T, of these episodes lie.

    Parameters
    ----------
    episodes
        What a model was fitted to.
    low, high
        (nx + nu,) the box in which the model will be used, infinite where there is none; where the data reach
        beyond it, their range counts. By default the range of the data.
    bins
        Number of bins of each coordinate; by default 10, or fewer where a cell of a pair would hold fewer than 10
        samples on average.

    Raises
    ------
    DataError
        The box is crossed.
    """
    n = episodes.nx + episodes.nu
    samples = sum(len(episode) for episode in episodes)
    bins = min(_BINS, max(int(np.sqrt(samples / _IN_CELL)), 2)) if bins is None else checks.count(bins, "bins")
    seen_low, seen_high = np.full(n, np.inf), np.full(n, -np.inf)
    for rows in _rows(episodes):
        seen_low, seen_high = np.minimum(seen_low, rows.min(axis=0)), np.maximum(seen_high, rows.max(axis=0))
    asked_low = np.full(n, np.inf) if low is None else checks.vector(low, "low", n, infinite=True)
    asked_high = np.full(n, -np.inf) if high is None else checks.vector(high, "high", n, infinite=True)
    if low is not None and high is not None:
        checks.crossed(asked_low, asked_high, "coverage")
    box_low = np.where(np.isfinite(asked_low), np.minimum(asked_low, seen_low), seen_low)
    box_high = np.where(np.isfinite(asked_high), np.maximum(asked_high, seen_high), seen_high)
    if not np.isfinite(box_high - box_low).all():
        raise DataError("the range of the data is beyond 1.8e308; scale the states")
    index = list(combinations(range(n), 2)) if n <= _PAIRED else []
    counts = np.zeros((n, bins), dtype=np.int64)
    pairs = np.zeros((len(index), bins, bins), dtype=np.int64)
    for rows in _rows(episodes):
        cells = _cells(rows, box_low, box_high, bins).T
        for i, column in enumerate(cells):
            counts[i] += np.bincount(column, minlength=bins)
        for p, (i, j) in enumerate(index):
            pairs[p] += np.bincount(cells[i] * bins + cells[j], minlength=bins**2).reshape(bins, bins)
    names = episodes.states + episodes.inputs
    return Coverage(names, episodes.nx, box_low, box_high, seen_low, seen_high, counts, pairs, samples)


def _rows(episodes: Episodes) -> Iterator[Float[np.ndarray, "M n"]]:
    """Yield the samples [x u], many short episodes or a part of a long one at once."""
    waiting: list[np.ndarray] = []
    held = 0
    for episode in episodes:
        for first in range(0, len(episode), _ROWS):
            U = episode.U[first : first + _ROWS]
            waiting.append(np.hstack([episode.X[first : first + len(U)], U]))
            held += len(U)
            if held >= _ROWS:
                yield np.concatenate(waiting)
                waiting, held = [], 0
    if waiting:
        yield np.concatenate(waiting)


def _cells(
    rows: Float[np.ndarray, "M n"], low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"], bins: int
) -> Int[np.ndarray, "M n"]:
    """Return the bin of each entry, the first or last where it lies outside or is NaN."""
    width = np.where(high > low, high - low, 1.0)
    place = (np.clip(np.nan_to_num(rows), low, high) - low) / width
    return np.minimum((place * bins).astype(np.intp), bins - 1)
