"""The second moments of one part of a source, summed from zero: the task that is sent to workers."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Int

from koopmpc.data.source import Part
from koopmpc.errors import DataError
from koopmpc.identify.chunks import ROWS, chunks, lifted
from koopmpc.identify.sums import Factor, Gram
from koopmpc.identify.weights import Weights, weights_of
from koopmpc.lifting.base import Lifting
from koopmpc.values import Arrays, from_data, to_data

Route = Literal["gram", "qr"]


@dataclass(frozen=True, eq=False)
class Reading:
    """What is to be summed: the rows d = [ψ(x) u u⊗ψ(x) ψ(x⁺)] of a part.

    Attributes
    ----------
    part
        Where the episodes are from.
    lifting
        ψ with all states; it crosses processes as data, so that a lifting of the user's own does too.
    names
        Of the columns.
    products
        The observables that u is multiplied with.
    route
        "gram" for Σ dᵀd, "qr" for its triangular factor.
    weights
        Of the steps; none weighs them all 1.
    limit
        Read at most so many chunks, evenly spread.
    """

    part: Part
    lifting: Lifting
    names: tuple[str, ...]
    products: Int[np.ndarray, " np"]
    route: Route
    weights: Weights | None = None
    limit: int | None = None

    def __str__(self) -> str:
        return str(self.part)

    def __reduce__(self) -> tuple[Any, ...]:
        arrays: Arrays = {}
        rest = (self.part, self.names, self.products, self.route, self.weights, self.limit)
        return _unpacked, (to_data(self.lifting, arrays), arrays, *rest)


@dataclass(frozen=True, eq=False)
class Sums:
    """Σ w dᵀd, or R with RᵀR equal to it; pairs of weight above 0, Σ w, and whether every chunk was read."""

    sums: Float[np.ndarray, "nd nd"]
    samples: int
    weight: float
    whole: bool


def read(task: Reading) -> Sums:
    """Return the sums of one part: chunks of fixed size, lifted, added in order and forgotten."""
    episodes = task.part.load()
    pieces = chunks(episodes)
    which = range(len(pieces)) if task.limit is None else spread(len(pieces), task.limit)
    steps = None if task.weights is None else weights_of(task.weights, episodes)
    nz = task.lifting.nz
    n = len(task.names) - nz
    total = Gram(n, nz) if task.route == "gram" else Factor(n, nz)
    samples, weight = 0, 0.0
    space = np.empty((2 * ROWS, n))
    for i in which:
        chunk = lifted(episodes, task.lifting, pieces[i], task.products, space)
        count = len(chunk.P) - len(chunk.last)
        w = None if steps is None else np.concatenate([steps[e][first:last] for e, first, last in pieces[i]])
        samples += count if w is None else int(np.count_nonzero(w))
        weight += count if w is None else float(w.sum())
        with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is named below
            total.add(chunk, w)
        _require_finite(total.size, task)
    return Sums(total.sums, samples, weight, len(which) == len(pieces))


def spread(total: int, wanted: int) -> list[int]:
    """Return at most `wanted` of the indices 0 … total − 1, evenly spread."""
    if wanted == 1:
        return [0]
    return sorted({round(i * (total - 1) / (wanted - 1)) for i in range(wanted)})


def _require_finite(size: Float[np.ndarray, " nd"], task: Reading) -> None:
    bad = np.flatnonzero(~np.isfinite(size))
    if bad.size:
        raise DataError(
            f"the observable {task.names[int(bad[0])]!r} is NaN, infinite or above 1e154 in {task.part}; "
            "drop it, or the episodes where it is"
        )


def _unpacked(lifting: Any, arrays: Arrays, part: Part, *rest: Any) -> Reading:
    return Reading(part, from_data(lifting, arrays), *rest)
