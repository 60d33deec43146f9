"""The moments of all that a source holds: by which route, from which parts, read by whom."""

from collections.abc import Iterable, Sized
from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import islice
from typing import TypedDict

import numpy as np
from jaxtyping import Int

from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Part, Source, source_of
from koopmpc.errors import DataError
from koopmpc.identify.chunks import ROWS
from koopmpc.identify.moments import Moments, multiplied, product_names, with_states
from koopmpc.identify.reading import Reading, Route, Sums, read, spread
from koopmpc.identify.weights import Weights, changed
from koopmpc.lifting.base import Lifting, lifting_of
from koopmpc.parallel import Progress, map_tasks

_WELL_CONDITIONED = 1e6  # scaled cond(Z) up to which normal equations lose nothing
_PILOT = 4  # parts, and least number of chunks, that choose the route


class How(TypedDict, total=False):
    """How the moments are read; the fits take these keywords, too, and `moments` says what they mean."""

    weights: Weights | None
    workers: int | None
    scheduler: str | None
    progress: Progress | None


def moments(
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
        return task.total(
            map_tasks(read, every, workers=workers, scheduler=scheduler, progress=progress), route
        )

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
