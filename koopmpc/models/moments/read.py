"""The moments of a whole source: its parts are read by workers, and a pilot chooses between sums and a factor."""

from collections.abc import Callable, Iterable, Sequence, Sized
from dataclasses import dataclass, replace
from functools import reduce
from itertools import islice
from typing import Any, Literal, NamedTuple, TypedDict, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.parallel import Progress, map_tasks
from koopmpc.base.values import Arrays, from_data, to_data
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.source import Changed, Held, Part, Source, source_of
from koopmpc.lifting.base import Lifting, bind_lifting
from koopmpc.models.moments.moments import Moments
from koopmpc.models.moments.rows import ROWS, GramSums, TriangularFactor, lift_chunks, row_columns, split_chunks

Route = Literal["gram", "qr"]
Weights = Callable[[Episode], ArrayLike] | Sequence[ArrayLike] | Float[np.ndarray, "..."]
Steps = list[Float[np.ndarray, " T"]]  # the weights of each episode, one for each step

_WELL_CONDITIONED = 1e6  # up to this scaled cond(Z) Gram sums lose no accuracy
_PILOT = 4  # the pilot reads at most so many parts, and at least so many chunks


class ReadOptions(TypedDict, total=False):
    """Options of reading that every fit accepts: the weights of the pairs and the workers; see `second_moments`."""

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

    Each part of the source is summed from zero, chunk by chunk, and the parts are added in order. So memory does not
    grow with the data. For one BLAS build and thread count the result is the same to the bit in this process, in local
    processes and on a cluster.

    Parameters
    ----------
    episodes
        Episodes, or a Source: ``km.data.Files("logs")``, ``km.data.Stream(iterator)``.
    lifting
        ψ; it is bound to the states, or to ζ of the embedding.
    embedding
        ψ acts on ζ, the state and its past, as `Delay` makes it.
    route
        "gram" sums products, "qr" updates a triangular factor. By default a pilot chooses: it sums chunks sampled from
        up to 4 parts. If their scaled condition number is at most 1e6, the other chunks are added to these Gram sums.
        If it is larger, or if that of all data is, everything is read by "qr". So is a stream that can be read only
        once.
    bilinear
        Put u⊗ψ(x) into the rows, for z⁺ = A z + B u + Σ uᵢ Nᵢ z.
    weights
        The weight w ≥ 0 of each pair; by default 1. For Episodes a sequence with one item for each episode: a number,
        or an array (T,) with a weight for each step. For any source: a function from an Episode to such an item. An
        embedding of d steps uses the last T − d weights of an episode. Residuals are weighted means, so a common factor
        has no effect.
    workers, scheduler, progress
        As in `koopmpc.base.parallel.map_tasks`: processes, a Dask cluster, and a function to call after each part.

    Raises
    ------
    DataError
        An observable is not finite on the data; a weight is negative, or all weights are 0; a file differs from the
        first one in dt or names; a stream is read twice; an argument has the wrong type.
    ShapeError
        The weights do not fit the episodes.
    LogError
        A file cannot be read.
    KoopmpcError
        A worker died on the same part each time, or no scheduler answers.
    """
    source = source_of(episodes)
    if embedding is not None:
        checks.kind(embedding, "embedding", Delay, "pass km.Delay(2), or leave it out")
        embedding = embedding.match(source.states, source.inputs)
        source = embedding.source(source)
    bound = bind_lifting(lifting, source.states)
    reading = _ReadTask(None, bound, source.inputs, bilinear, _align_weights(weights, source))
    zero = Moments(bound, source.inputs, source.dt, 0, 0.0, "", np.empty((0, 0)), bilinear, embedding)

    def read(route: Route, done: dict[int, tuple[int, ...]]) -> Iterable[Moments]:
        """Yield the moments of the parts in order, without the chunks in `done`."""
        parts = source.parts()
        lazy = (replace(reading, part=p, route=route, done=done.get(i, ())) for i, p in enumerate(parts))
        tasks = list(lazy) if isinstance(parts, Sized) else lazy
        for sums in map_tasks(read_part, tasks, workers=workers, scheduler=scheduler, progress=progress):
            yield replace(zero, route=route, **sums._asdict())

    if route is None and not source.replayable:
        route = "qr"
    if route is None:
        pilot, done, complete = _run_pilot(source, reading)
        total = replace(zero, route="gram", **pilot._asdict())
        if not total.samples or total.condition <= _WELL_CONDITIONED:
            if not complete:
                total = reduce(Moments.__add__, read("gram", done), total)
            if not total.samples:
                raise DataError(_NO_WEIGHT)
            if complete or total.condition <= _WELL_CONDITIONED:
                return total
    total = reduce(Moments.__add__, read(route or "qr", {}))
    if not total.samples:
        raise DataError(_NO_WEIGHT)
    return total


_NO_WEIGHT = "all weights are 0; give some pair a weight above 0"


class _Sums(NamedTuple):
    """Σ w dᵀd or its triangular factor, the number of pairs with a weight above 0, and Σ w."""

    sums: Float[np.ndarray, "nd nd"]
    samples: int
    weight: float


@dataclass(frozen=True, eq=False)
class _ReadTask:
    """A task for a worker: sum the rows d = [ψ(x) u u⊗ψ(x) ψ(x⁺)] of one part.

    Attributes
    ----------
    part
        The part that holds the episodes; None in a template of tasks.
    lifting, inputs, bilinear
        They define the rows. The bound ψ crosses processes as data, so that a user's own lifting can.
    weights
        Weights of the steps; None weighs all by 1.
    route
        "gram" for Σ w dᵀd, "qr" for its triangular factor.
    done
        Numbers of the chunks that the pilot has summed.
    """

    part: Part | None
    lifting: Lifting
    inputs: tuple[str, ...]
    bilinear: bool
    weights: Weights | None
    route: Route = "gram"
    done: tuple[int, ...] = ()

    def __str__(self) -> str:
        return str(self.part)

    def __reduce__(self) -> tuple[Any, ...]:
        arrays: Arrays = {}
        rest = (self.inputs, self.bilinear, self.weights, self.route, self.done)
        return _unpack, (self.part, to_data(self.lifting, arrays), arrays, *rest)


def _unpack(part: Part, lifting: Any, arrays: Arrays, *rest: Any) -> _ReadTask:
    return _ReadTask(part, from_data(lifting, arrays), *rest)


def read_part(reading: _ReadTask) -> _Sums:
    """Return the sums of one part: chunks of fixed size, lifted, added in order and forgotten."""
    assert reading.part is not None, "a task has a part"
    episodes = reading.part.load()
    done = set(reading.done)
    which = [i for i in range(len(split_chunks(episodes))) if i not in done] if done else None
    return _sum_chunks(reading, episodes, which)


def _sum_chunks(reading: _ReadTask, episodes: Episodes, which: Sequence[int] | None) -> _Sums:
    """Return the sums of these chunks of the episodes, by default of all."""
    weights = None if reading.weights is None else _check_weights(reading.weights, episodes)
    columns = row_columns(reading.lifting, reading.inputs, reading.bilinear)
    names, total, samples, weight = columns.names, None, 0, 0.0
    for chunk in lift_chunks(episodes, columns, which, weights):
        if total is None:
            total = (GramSums if reading.route == "gram" else TriangularFactor)(chunk.P.shape[1], chunk.nz)
        count = len(chunk.P) - len(chunk.last)
        samples += count if chunk.weights is None else int(np.count_nonzero(chunk.weights))
        weight += count if chunk.weights is None else float(chunk.weights.sum())
        with np.errstate(invalid="ignore", over="ignore"):  # the check below names an observable that is not finite
            total.add(chunk)
        bad = np.flatnonzero(~np.isfinite(total.size))
        if bad.size:
            raise DataError(
                f"the observable {names[int(bad[0])]!r} is NaN, infinite or above 1e154 in {reading.part}; "
                "drop it, or the episodes where it is"
            )
    sums = np.zeros((len(names), len(names))) if total is None else total.sums
    return _Sums(sums, samples, weight)


def _run_pilot(source: Source, reading: _ReadTask) -> tuple[_Sums, dict[int, tuple[int, ...]], bool]:
    """Return Gram sums of chunks sampled from a few parts, their numbers by part, and whether these are all chunks."""
    parts = source.parts()
    if isinstance(parts, list):
        complete = len(parts) <= _PILOT
        chosen = {i: parts[i] for i in (range(len(parts)) if complete else space_evenly(len(parts), _PILOT))}
    else:
        chosen, complete = dict(enumerate(islice(parts, _PILOT))), False
    width = reading.lifting.nz + len(reading.inputs) * (1 + reading.lifting.nz * reading.bilinear)
    limit = -(-max(_PILOT, -(-4 * width // ROWS)) // len(chosen))
    done: dict[int, tuple[int, ...]] = {}
    pilots: list[_Sums] = []
    for i, part in chosen.items():
        episodes = part.load()
        count = -(-sum(len(e.U) for e in episodes.episodes) // ROWS)
        done[i] = tuple(range(count) if count <= limit else space_evenly(count, limit))
        complete = complete and len(done[i]) == count
        pilots.append(_sum_chunks(replace(reading, part=part), episodes, done[i]))
    sums = reduce(np.add, (pilot.sums for pilot in pilots))
    return _Sums(sums, sum(p.samples for p in pilots), sum(p.weight for p in pilots)), done, complete


def space_evenly(total: int, wanted: int) -> list[int]:
    """Return at most `wanted` of the indices 0 … total − 1, evenly spread."""
    if wanted == 1:
        return [0]
    return sorted({round(i * (total - 1) / (wanted - 1)) for i in range(wanted)})


def _check_weights(weights: Weights, episodes: Episodes) -> Steps:
    """Return the weight of each step of each episode.

    Raises
    ------
    ShapeError
        There are more or fewer items than episodes, or an item is neither a number nor an array of one a step.
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
    for i, step_weights in enumerate(steps):
        if step_weights.min() < 0:
            raise DataError(f"the weight of episode {i} is {step_weights.min():g}; weights are 0 or above")
    return steps


def _align_weights(weights: Weights | None, source: Source) -> Weights | None:
    """Return the weights of the steps that `source` keeps: an embedding drops the first steps of each episode.

    Raises
    ------
    DataError
        They are a list, and the source is not made from Episodes: another source has no known order.
    """
    if weights is None or callable(weights):
        return weights
    dropped, inner = 0, source
    while isinstance(inner, Changed):
        dropped, inner = dropped + inner.history, inner.source
    if not isinstance(inner, Held):
        raise DataError("weights are a list, which needs the order of Episodes; pass a function of an Episode")
    return [steps[dropped:] for steps in _check_weights(weights, inner.episodes) if len(steps) > dropped]
