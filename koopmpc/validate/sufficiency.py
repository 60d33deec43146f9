"""Checks that data suffice for a fit: coverage of the state space, excitation of the inputs."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.text import with_unit
from koopmpc.base.values import Value
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.models.moments.solve import scale_to_unit_norm

_BLOCK_ROWS = 4096  # samples that are binned in one block
_MOST_BINS = 10  # default number of bins of a coordinate, if the data are enough
_CELL_SAMPLES = 10  # the default number of bins leaves on average this many samples in a cell of a pair
_MOST_PAIRED = 40  # count cells of pairs up to this number of coordinates
_BLOCK_WINDOWS = 4096  # windows of the inputs in one block
_NOTABLE = 0.05  # report an empty rectangle if its share of the pair's box is at least this


@dataclass(frozen=True, eq=False)
class Region(Value):
    """A rectangle in the plane of two coordinates that contains no sample.

    Attributes
    ----------
    names
        The two coordinates.
    low, high
        (2,) its corners; infinite where the rectangle reaches the edge of the box.
    share
        Its share of the area of the box.
    """

    names: tuple[str, str]
    low: Float[np.ndarray, "2"]
    high: Float[np.ndarray, "2"]
    share: float

    def __str__(self) -> str:
        """Return e.g. ``"theta in [1.2, 2.1] rad with omega > 3 rad/s was never visited"``."""
        return f"{self.where} was never visited"

    @property
    def where(self) -> str:
        """Its two intervals, e.g. ``"theta in [1.2, 2.1] rad with omega > 3 rad/s"``."""
        ends = zip(self.names, self.low.tolist(), self.high.tolist(), strict=True)
        parts = [
            with_unit(name, _format_interval(low, high)) for name, low, high in ends if np.isfinite([low, high]).any()
        ]
        return " with ".join(parts)


@dataclass(frozen=True, eq=False)
class Coverage(Value):
    """Counts of the samples (x_k, u_k) of a data set, in bins of each coordinate and cells of each pair.

    Attributes
    ----------
    names
        States, then inputs.
    nx
        Number of states.
    low, high
        (n,) the box of the bins: the range of the data, or a wider one that the caller asked for.
    seen_low, seen_high
        (n,) the range of the data.
    counts
        (n, bins) samples in each bin of each coordinate.
    pairs
        (n(n−1)/2, bins, bins) samples in each cell of each pair of coordinates, in the order (0, 1), (0, 2), …;
        empty for more than 40 coordinates.
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
        """(n,) share of the bins of each coordinate that contain a sample."""
        return np.mean(self.counts > 0, axis=1)

    @cached_property
    def empty(self) -> tuple[Region, ...]:
        """The largest empty rectangle of each pair in descending order; those below 5 % of the box are left out."""
        if not self.pairs.size:
            return ()
        names, low, high, bins = self.names, self.low, self.high, self.bins
        first, last = np.triu_indices(bins)
        last = last + 1
        total = np.zeros((len(self.pairs), bins + 1, bins + 1), dtype=np.int64)
        total[:, 1:, 1:] = self._occupied_cells.cumsum(axis=1).cumsum(axis=2)
        strips = total[:, last] - total[:, first]  # cells with samples in each interval of the first coordinate
        area = np.outer(last - first, last - first)
        box = list(zip(low.tolist(), high.tolist(), strict=True))
        regions: list[Region] = []
        for strip, (i, j) in zip(strips, combinations(range(len(names)), 2), strict=True):
            free = np.where(strip[:, last] == strip[:, first], area, 0)
            a, b = np.unravel_index(int(free.argmax()), free.shape)
            share = float(free[a, b]) / bins**2
            if share < _NOTABLE or high[i] == low[i] or high[j] == low[j]:
                continue
            edges = np.array([_bin_edges(int(first[k]), int(last[k]), bins, *box[c]) for k, c in ((a, i), (b, j))])
            regions.append(Region((names[i], names[j]), edges[:, 0].copy(), edges[:, 1].copy(), share))
        regions.sort(key=lambda region: -region.share)
        return tuple({str(region): region for region in regions}.values())

    def share(self, x: ArrayLike, u: ArrayLike | None = None) -> Float[np.ndarray, "..."]:
        """Return the share, 0 … 1, of the coordinates and pairs of (x, u) that lie in visited bins and cells.

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
        cells = _cells(V, self.low[:wanted], self.high[:wanted], self.bins)
        inside = (self.seen_low[:wanted] <= V) & (self.seen_high[:wanted] >= V)
        hits = [self._occupied_bins[np.arange(wanted), cells] & inside]
        if len(self.pairs):
            first, second, order = self._columns[wanted]
            visited = self._occupied_cells[order, cells[:, first], cells[:, second]]
            hits.append(visited & inside[:, first] & inside[:, second])
        result = np.mean(np.concatenate(hits, axis=1), axis=1)
        return result.reshape(()) if single else result

    def seen(self, x: ArrayLike, u: ArrayLike | None = None) -> Bool[np.ndarray, "..."]:
        """Return True where all coordinates and pairs of (x, u) lie in visited bins and cells.

        The result is True for every sample of the data and False outside their range. In a closed loop, False means
        that the model extrapolates.
        """
        return np.asarray(self.share(x, u) == 1.0)

    @cached_property
    def _occupied_bins(self) -> np.ndarray:
        return self.counts > 0

    @cached_property
    def _occupied_cells(self) -> np.ndarray:
        return self.pairs > 0

    @cached_property
    def _columns(self) -> dict[int, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """First and second coordinate, and index, of the pairs of the states and of the pairs of all coordinates."""
        all_pairs = np.array(list(combinations(range(len(self.names)), 2)), dtype=np.intp).reshape(-1, 2)
        indices = {wanted: np.flatnonzero(all_pairs[:, 1] < wanted) for wanted in (self.nx, len(self.names))}
        return {wanted: (all_pairs[order, 0], all_pairs[order, 1], order) for wanted, order in indices.items()}


def _bin_edges(first: int, last: int, bins: int, low: float, high: float) -> tuple[float, float]:
    width = (high - low) / bins
    return (-np.inf if first == 0 else low + first * width), (np.inf if last == bins else low + last * width)


def _format_interval(low: float, high: float) -> str:
    if np.isinf(high):
        return f"> {low:.3g}"
    return f"< {high:.3g}" if np.isinf(low) else f"in [{low:.3g}, {high:.3g}]"


def coverage(
    episodes: Episodes, *, low: ArrayLike | None = None, high: ArrayLike | None = None, bins: int | None = None
) -> Coverage:
    """Count the samples (x_k, u_k), k < T, of these episodes in bins of each coordinate and cells of each pair.

    Parameters
    ----------
    episodes
        The episodes that a model was fitted to.
    low, high
        (nx + nu,) the box in which the model will be used, by default the range of the data. An infinite entry stands
        for the range of the data. If the data reach beyond the box, it is widened to their range.
    bins
        Number of bins of each coordinate; by default 10, or fewer if the cells of a pair would otherwise contain
        fewer than 10 samples on average.

    Raises
    ------
    DataError
        An entry of `low` is above that of `high`.
    """
    n = episodes_of(episodes).nx + episodes.nu
    samples = sum(len(episode) for episode in episodes)
    bins = (
        min(_MOST_BINS, max(int(np.sqrt(samples / _CELL_SAMPLES)), 2)) if bins is None else checks.count(bins, "bins")
    )
    seen_low, seen_high = np.full(n, np.inf), np.full(n, -np.inf)
    for rows in _sample_blocks(episodes):
        seen_low, seen_high = np.minimum(seen_low, rows.min(axis=0)), np.maximum(seen_high, rows.max(axis=0))
    asked_low = np.full(n, np.inf) if low is None else checks.vector(low, "low", n, infinite=True)
    asked_high = np.full(n, -np.inf) if high is None else checks.vector(high, "high", n, infinite=True)
    if low is not None and high is not None:
        checks.refuse_crossed(asked_low, asked_high, "coverage")
    box_low = np.where(np.isfinite(asked_low), np.minimum(asked_low, seen_low), seen_low)
    box_high = np.where(np.isfinite(asked_high), np.maximum(asked_high, seen_high), seen_high)
    if not np.isfinite(box_high - box_low).all():
        raise DataError("the range of the data is beyond 1.8e308; scale the states")
    index = list(combinations(range(n), 2)) if n <= _MOST_PAIRED else []
    counts = np.zeros((n, bins), dtype=np.int64)
    pairs = np.zeros((len(index), bins, bins), dtype=np.int64)
    for rows in _sample_blocks(episodes):
        cells = _cells(rows, box_low, box_high, bins).T
        for i, column in enumerate(cells):
            counts[i] += np.bincount(column, minlength=bins)
        for p, (i, j) in enumerate(index):
            pairs[p] += np.bincount(cells[i] * bins + cells[j], minlength=bins**2).reshape(bins, bins)
    names = episodes.states + episodes.inputs
    return Coverage(names, episodes.nx, box_low, box_high, seen_low, seen_high, counts, pairs, samples)


def _sample_blocks(episodes: Episodes) -> Iterator[Float[np.ndarray, "M n"]]:
    """Yield the samples [x u] in blocks, from many short episodes or a part of a long one."""
    pieces: list[np.ndarray] = []
    count = 0
    for episode in episodes:
        for first in range(0, len(episode), _BLOCK_ROWS):
            U = episode.U[first : first + _BLOCK_ROWS]
            pieces.append(np.hstack([episode.X[first : first + len(U)], U]))
            count += len(U)
            if count >= _BLOCK_ROWS:
                yield np.concatenate(pieces)
                pieces, count = [], 0
    if pieces:
        yield np.concatenate(pieces)


def _cells(
    rows: Float[np.ndarray, "M n"], low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"], bins: int
) -> Int[np.ndarray, "M n"]:
    """Return the bin of each entry; an entry outside the box is put into the first or last bin."""
    width = np.where(high > low, high - low, 1.0)
    place = (np.clip(np.nan_to_num(rows), low, high) - low) / width
    return np.minimum((place * bins).astype(np.intp), bins - 1)


@dataclass(frozen=True, eq=False)
class Persistency(Value):
    """The order to which the inputs are persistently exciting.

    Attributes
    ----------
    order
        The largest L ≤ `asked` for which the windows (u_k, …, u_{k+L−1}) of all episodes span R^(nu L).
    asked
        The largest order that was tested.
    conditions
        (asked,) condition number of the windows of each order 1 … asked, for inputs scaled to unit norm; infinite
        above `order`.
    windows
        Number of windows of `asked` steps.
    """

    order: int
    asked: int
    conditions: Float[np.ndarray, " asked"]
    windows: int


def persistency(episodes: Episodes, order: int) -> Persistency:
    """Return the largest L ≤ `order` for which the block-Hankel matrix of the inputs has full row rank nu L.

    If the inputs are exciting of order n + 1, the data [x; u] of a controllable linear system with n states have full
    rank, and its A and B can be identified. A sum of m sines has order 2m, a constant has order 1, and white noise has
    any order that the length of the data allows. A window never spans two episodes.

    Parameters
    ----------
    episodes
        Episodes with inputs.
    order
        The largest L to test.

    Raises
    ------
    DataError
        There are no inputs, or no episode is as long as `order`.

    References
    ----------
    Willems et al., "A note on persistency of excitation", Syst. Control Lett. 54, 2005; for several episodes van
    Waarde et al., "Willems' fundamental lemma for state-space systems and its extension to multiple datasets",
    IEEE Control Syst. Lett. 4, 2020.
    """
    episodes, order = episodes_of(episodes), checks.count(order, "order")
    if episodes.nu == 0:
        raise DataError("the episodes have no inputs; persistency needs episodes with inputs")
    longest = max(len(episode) for episode in episodes)
    if longest < order:
        raise DataError(f"order is {order}, the longest episode has {longest} steps; pass {longest} or less")
    width = episodes.nu * order
    R, windows = np.zeros((0, width)), 0
    pieces: list[np.ndarray] = []
    count = 0
    for episode in episodes:
        for first in range(0, len(episode) - order + 1, _BLOCK_WINDOWS):
            U = episode.U[first : first + _BLOCK_WINDOWS + order - 1]
            build_table = np.lib.stride_tricks.sliding_window_view(U, order, axis=0)
            pieces.append(build_table.transpose(0, 2, 1).reshape(len(build_table), width))
            count += len(build_table)
            if count >= _BLOCK_WINDOWS:
                R, windows = np.linalg.qr(np.concatenate([R, *pieces]), mode="r"), windows + count
                pieces, count = [], 0
    R, windows = np.linalg.qr(np.concatenate([R, *pieces]), mode="r"), windows + count
    R = scale_to_unit_norm(np.asarray(R, dtype=np.float64))
    cut = np.finfo(float).eps * max(windows, width)
    conditions = np.full(order, np.inf)
    for L in range(1, order + 1):
        s = np.linalg.svd(R[:, : episodes.nu * L], compute_uv=False)
        if len(s) < episodes.nu * L or s[-1] <= cut * s[0]:
            break
        conditions[L - 1] = s[0] / s[-1]
    return Persistency(int(np.isfinite(conditions).sum()), order, conditions, windows)
