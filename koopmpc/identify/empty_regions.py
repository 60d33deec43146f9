"""The largest rectangles of pairs of coordinates in which there is no sample, in words."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from koopmpc.lifting.base import short
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
        Of the area of that box.
    """

    names: tuple[str, str]
    low: Float[np.ndarray, "2"]
    high: Float[np.ndarray, "2"]
    share: float

    def __str__(self) -> str:
        """Return e.g. ``"theta in [1.2, 2.1] with omega > 3 was never visited"``."""
        parts = [
            _interval(short(name), float(low), float(high))
            for name, low, high in zip(self.names, self.low, self.high, strict=True)
        ]
        return f"{' with '.join(part for part in parts if part)} was never visited"


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
    strips = total[:, last] - total[:, first]  # of each interval of the first coordinate
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


def _interval(name: str, low: float, high: float) -> str:
    if np.isinf(low) and np.isinf(high):
        return ""
    if np.isinf(high):
        return f"{name} > {low:.3g}"
    return f"{name} < {high:.3g}" if np.isinf(low) else f"{name} in [{low:.3g}, {high:.3g}]"
