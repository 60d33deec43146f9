"""Whether data suffice for a fit: the space that they visited, the excitation of the inputs, and feedback in them."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.errors import DataError, ShapeError
from koopmpc.identify.moments.moments import Moments, both_sides
from koopmpc.identify.solve import norms, orthonormal, unit
from koopmpc.lifting.base import Lifting
from koopmpc.validate.residuals import moments_of
from koopmpc.validate.scoring import AnyPredictor
from koopmpc.validate.text import quantity
from koopmpc.values import Value

_ROWS = 4096  # samples that are binned at once
_BINS = 10  # bins of a coordinate, at most
_IN_CELL = 10  # samples that a cell of a pair holds on average, at least
_PAIRED = 40  # coordinates up to which pairs are looked at
_WINDOWS = 4096  # windows of the inputs that are held at once
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
        if not self.pairs.size:
            return ()
        names, low, high, bins = self.names, self.low, self.high, self.bins
        first, last = np.triu_indices(bins)
        last = last + 1
        total = np.zeros((len(self.pairs), bins + 1, bins + 1), dtype=np.int64)
        total[:, 1:, 1:] = self._paired.cumsum(axis=1).cumsum(axis=2)
        strips = total[:, last] - total[:, first]  # cells with samples in each interval of the first coordinate
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
        cells = _cells(V, self.low[:wanted], self.high[:wanted], self.bins)
        inside = (self.seen_low[:wanted] <= V) & (self.seen_high[:wanted] >= V)
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


def _edges(first: int, last: int, bins: int, low: float, high: float) -> tuple[float, float]:
    width = (high - low) / bins
    return (-np.inf if first == 0 else low + first * width), (np.inf if last == bins else low + last * width)


def _interval(low: float, high: float) -> str:
    if np.isinf(high):
        return f"> {low:.3g}"
    return f"< {high:.3g}" if np.isinf(low) else f"in [{low:.3g}, {high:.3g}]"


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


@dataclass(frozen=True, eq=False)
class Persistency(Value):
    """The order to which the inputs are persistently exciting.

    Attributes
    ----------
    order
        The largest L ≤ `asked` for which the windows (u_k, …, u_{k+L−1}) of all episodes span R^(nu L).
    asked
        The largest order that was looked at.
    conditions
        (asked,) condition number of the windows of each order 1 … asked, on inputs of unit norm; infinite beyond
        `order`.
    windows
        Number of windows of `asked` steps.
    """

    order: int
    asked: int
    conditions: Float[np.ndarray, " asked"]
    windows: int


def persistency(episodes: Episodes, order: int) -> Persistency:
    """Return up to which order L ≤ `order` the block-Hankel matrix of the inputs has full row rank nu L.

    Inputs of order n + 1 make [x; u] of a controllable linear system of n states full rank, so that its A and B
    can be found. A sum of m sines is of order 2m, a constant of order 1, white noise of any order that the data
    are long enough for. Windows never span two episodes.

    Parameters
    ----------
    episodes
        Episodes with inputs.
    order
        The largest L to look at.

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
    order = checks.count(order, "order")
    if episodes.nu == 0:
        raise DataError("the episodes have no inputs, so there is no excitation to look at")
    longest = max(len(episode) for episode in episodes)
    if longest < order:
        raise DataError(f"order is {order}, the longest episode has {longest} steps; pass {longest} or less")
    width = episodes.nu * order
    R, windows = np.zeros((0, width)), 0
    waiting: list[np.ndarray] = []
    held = 0
    for episode in episodes:
        for first in range(0, len(episode) - order + 1, _WINDOWS):
            piece = episode.U[first : first + _WINDOWS + order - 1]
            table = np.lib.stride_tricks.sliding_window_view(piece, order, axis=0)
            waiting.append(table.transpose(0, 2, 1).reshape(len(table), width))
            held += len(table)
            if held >= _WINDOWS:
                R, windows = np.linalg.qr(np.concatenate([R, *waiting]), mode="r"), windows + held
                waiting, held = [], 0
    R, windows = np.linalg.qr(np.concatenate([R, *waiting]), mode="r"), windows + held
    R = unit(np.asarray(R, dtype=np.float64))
    cut = np.finfo(float).eps * max(windows, width)
    conditions = np.full(order, np.inf)
    for L in range(1, order + 1):
        s = np.linalg.svd(R[:, : episodes.nu * L], compute_uv=False)
        if len(s) < episodes.nu * L or s[-1] <= cut * s[0]:
            break
        conditions[L - 1] = s[0] / s[-1]
    return Persistency(int(np.isfinite(conditions).sum()), order, conditions, windows)


def feedback_share(
    episodes: Episodes | Source, lifting: Lifting | AnyPredictor, *, embedding: Delay | None = None
) -> Float[np.ndarray, " nu"]:
    """Return for each input the share R² of its energy that is a linear function of ψ(x), 0 … 1.

    At 1 the input was a feedback u = K ψ(x), and A and B cannot be told apart. Where ψ holds a Constant, the energy
    is that around the mean.

    Parameters
    ----------
    episodes
        Episodes with inputs, or a source of them; measured disturbances count as inputs behind u.
    lifting
        ψ; or a predictor, for its lifting and embedding.
    embedding
        What a lifting of the state and its past acts on.

    Raises
    ------
    ShapeError, DataError
        The episodes and the predictor differ in states, inputs, disturbances or dt.
    """
    return explained_inputs(moments_of(episodes, lifting, embedding=embedding))


def explained_inputs(total: Moments) -> Float[np.ndarray, " nu"]:
    """Return the shares of `feedback_share` from the moments, in the order of their inputs."""
    P, _, cut = both_sides(total)
    nz, nu = total.nz, len(total.inputs)
    one = total.lifting.constant_index
    constant = [] if one is None else [one]
    U = P[:, nz : nz + nu]
    around = _outside(U, P[:, constant], cut)
    left = _outside(U, P[:, :nz], cut)
    varies = around > cut * norms(U)
    return 1.0 - np.divide(left**2, around**2, out=np.zeros(nu), where=varies)


def _outside(U: Float[np.ndarray, "m nu"], columns: Float[np.ndarray, "m n"], cut: float) -> Float[np.ndarray, " nu"]:
    """Return the norm of what each column of U has outside the span of `columns`."""
    if columns.shape[1] == 0:
        return norms(U)
    basis = orthonormal(columns, cut)
    return norms(U - basis @ (basis.T @ U))
