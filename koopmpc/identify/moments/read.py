"""The moments of all that a source holds: by which route, from which parts, read by whom."""

from collections.abc import Iterable, Sized
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import islice
from typing import Any, Literal, TypedDict

import numpy as np
from jaxtyping import Float, Int

from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Part, Source, source_of
from koopmpc.errors import DataError
from koopmpc.identify.moments.moments import Moments, multiplied, product_names, with_states
from koopmpc.identify.moments.rows import ROWS, Weights, changed, chunks, lifted, weights_of
from koopmpc.identify.moments.sums import Factor, Gram
from koopmpc.lifting.base import Lifting, lifting_of
from koopmpc.parallel import Progress, map_tasks
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


_WELL_CONDITIONED = 1e6  # scaled cond(Z) up to which normal equations lose nothing
_PILOT = 4  # parts, and least number of chunks, that choose the route


class How(TypedDict, total=False):
    """How the moments are read; the fits take these keywords, too, and `moments` says what they mean."""

    weights: Weights | None
    workers: int | None
    scheduler: str | None
    progress: Progress | None


def second_moments(
    episodes: Episodes | Source,
    lifting: Lifting,
    *,
    embedding: Delay | None = None,
    route: Route | None = None,
    bilinear: bool = False,
    weights: Weights | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Moments:
    """Return Σ w dᵀd, or its triangular factor, over the rows d = [ψ(x) u ψ(x⁺)] of all snapshot pairs.

    Each part of the source is summed from zero, in chunks that are lifted, added in order and forgotten, and the
    parts are added in order: memory does not grow with the data, and with one BLAS build and thread count the
    result is the same to the bit here, on local processes and on a cluster.

    Parameters
    ----------
    episodes
        Episodes, or a Source: ``Files("logs")``, ``Stream(iterator)``.
    lifting
        ψ; it is bound to the states, or to ζ of the embedding.
    embedding
        ψ acts on ζ, the state and its past, as `Delay` makes it.
    route
        "gram" sums products, "qr" updates a triangular factor. By default the scaled condition number of a
        pilot, chunks sampled from up to 4 parts, chooses: Gram up to 1e6, else QR; if the whole turns out worse,
        it is read again. A stream that can be read only once is summed in QR.
    bilinear
        Put u⊗ψ(x) into the rows, for z⁺ = A z + B u + Σ uᵢ Nᵢ z.
    weights
        w of each pair, 0 or above; by default 1. With Episodes one item an episode, a number or (T,), one a step,
        of which an embedding of d steps leaves the last T − d; with any source a function Episode → number or
        (T,). They weigh pairs against each other: residuals are weighted means, and a common factor changes nothing.
    workers, scheduler, progress
        As in `koopmpc.parallel.map_tasks`: local processes, a Dask cluster, and what is called after each part.

    Raises
    ------
    DataError
        An observable is not finite on the data; a weight is negative, or all are 0; a file differs from the first
        one in dt or names; a stream is read twice; an argument is of another kind.
    ShapeError
        The weights do not fit the episodes.
    LogError
        A file cannot be read.
    KoopmpcError
        A worker died on the same part each time, or no scheduler answers.
    """
    source = source_of(episodes)
    if embedding is not None:
        embedding = embedding.fitted(source.states, source.inputs)
        source = embedding.source(source)
    bound = lifting_of(lifting).bind(source.states)
    weights = changed(weights, source)
    task = _Task(source, bound, multiplied(bound, bilinear), bilinear, weights, embedding)

    def whole(route: Route) -> Moments:
        parts = source.parts()
        readings = (task.reading(part, route) for part in parts)
        every = list(readings) if isinstance(parts, Sized) else readings
        return task.total(map_tasks(read, every, workers=workers, scheduler=scheduler, progress=progress), route)

    if route is None and not source.replayable:
        route = "qr"
    if route is not None:
        return whole(route)
    pilot, complete = task.pilot()
    if pilot.condition <= _WELL_CONDITIONED:
        total = pilot if complete else whole("gram")
        if total.condition <= _WELL_CONDITIONED:
            return total
    return whole("qr")


@dataclass(frozen=True, eq=False)
class _Task:
    """What a call of `moments` asks for."""

    source: Source
    lifting: Lifting
    products: Int[np.ndarray, " np"]
    bilinear: bool
    weights: Weights | None
    embedding: Delay | None

    @cached_property
    def full(self) -> Lifting:
        return with_states(self.lifting)

    def reading(self, part: Part, route: Route, limit: int | None = None) -> Reading:
        inputs, names = self.source.inputs, self.full.names
        every = (*names, *inputs, *product_names(self.full, inputs, self.products), *names)
        return Reading(part, self.full, every, self.products, route, self.weights, limit)

    def pilot(self) -> tuple[Moments, bool]:
        """Return Gram sums of chunks sampled from a few parts, and whether they are all there are."""
        parts = self.source.parts()
        if isinstance(parts, list):
            chosen = [parts[i] for i in spread(len(parts), _PILOT)]
            every = len(chosen) == len(parts)
        else:
            chosen, every = list(islice(parts, _PILOT)), False
        width = self.lifting.nz + self.source.nu * (1 + len(self.products))
        limit = -(-max(_PILOT, -(-4 * width // ROWS)) // len(chosen))
        read_now = [read(self.reading(part, "gram", limit)) for part in chosen]
        return self.total(read_now, "gram"), every and all(sums.whole for sums in read_now)

    def total(self, parts: Iterable[Sums], route: Route) -> Moments:
        """Return the sums of the parts, added in their order."""
        source = self.source
        every = (
            Moments(
                lifting=self.lifting,
                inputs=source.inputs,
                dt=source.dt,
                samples=s.samples,
                weight=s.weight,
                route=route,
                sums=s.sums,
                bilinear=self.bilinear,
                embedding=self.embedding,
            )
            for s in parts
        )
        result = reduce(Moments.__add__, every)
        if result.samples == 0:
            raise DataError("all weights are 0; give some pair a weight above 0")
        return result
