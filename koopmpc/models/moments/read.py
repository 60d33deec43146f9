"""The moments of a whole source: its parts are read by workers, and the condition chooses sums or a factor."""

from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass, replace
from functools import partial
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
from koopmpc.models.moments.rows import GramSums, TriangularFactor, lift_chunks, row_columns

Route = Literal["gram", "qr"]
Weights = Callable[[Episode], ArrayLike] | Sequence[ArrayLike] | Float[np.ndarray, "..."]
Steps = list[Float[np.ndarray, " T"]]  # the weights of each episode, one for each step

_WELL_CONDITIONED = 1e6  # up to this scaled cond(Z) Gram sums lose no accuracy
_PILOT = 4  # ill-conditioned sums are given up after so many parts, of fewer parts after so many chunks of the first
_PAIRS = 4  # pairs a regressor that such a judgement needs, at least


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
        "gram" sums products, "qr" updates a triangular factor. By default products are summed. If their scaled
        condition number is above 1e6, for the first parts or chunks or for all data, everything is read again by "qr".
        A stream that can be read only once is read by "qr".
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

    run: Callable[..., Iterator[_Sums | None]] = partial(map, read_part)
    if (workers, scheduler, progress) != (None, None, None):
        run = partial(map_tasks, read_part, workers=workers, scheduler=scheduler, progress=progress)
    if route is None and source.replayable:
        total = _add_up(source, reading, replace(zero, route="gram"), run, judged=True)
        if total is not None:
            return total
    total = _add_up(source, reading, replace(zero, route=route or "qr"), run, judged=False)
    assert total is not None, "it was not judged"
    return total


def _add_up(
    source: Source, reading: "_ReadTask", zero: Moments, run: Callable[..., Iterator["_Sums | None"]], *, judged: bool
) -> Moments | None:
    """Return the moments of all parts, added in order; None where `judged` Gram sums turn out ill-conditioned."""
    parts, total = source.parts(), zero
    few, route = judged and isinstance(parts, Sized) and len(parts) < _PILOT, cast("Route", zero.route)
    lazy = (replace(reading, part=part, route=route, judged=few and i == 0) for i, part in enumerate(parts))
    tasks = list(lazy) if isinstance(parts, Sized) else lazy
    for i, sums in enumerate(run(tasks), 1):
        if sums is None:
            return None
        each = replace(zero, **sums._asdict())
        total = total + each if total.samples else each
        enough = i == _PILOT and total.samples >= _PAIRS * total.columns.regressors.size
        if judged and enough and total.condition > _WELL_CONDITIONED:
            return None
    if not total.samples:
        raise DataError("all weights are 0; give some pair a weight above 0")
    return None if judged and total.condition > _WELL_CONDITIONED else total


class _Sums(NamedTuple):
    """Σ w dᵀd or its triangular factor, the number of pairs with a weight above 0, and Σ w."""

    sums: Float[np.ndarray, "nd nd"]
    samples: int
    weight: float


@dataclass(frozen=True, eq=False)
class _ReadTask:
    """A task for a worker: sum the rows d = [ψ(x) u u⊗ψ(x) ψ(x⁺)] of one part."""

    part: Part | None  # the part that holds the episodes; None in a template of tasks
    # they define the rows. The bound ψ crosses processes as data, so that a user's own lifting can
    lifting: Lifting
    inputs: tuple[str, ...]
    bilinear: bool
    weights: Weights | None  # weights of the steps; None weighs all by 1
    route: Route = "gram"  # "gram" for Σ w dᵀd, "qr" for its triangular factor
    judged: bool = False  # give the sums up if those of the first chunks are ill-conditioned

    def __str__(self) -> str:
        return str(self.part)

    def __reduce__(self) -> tuple[Any, ...]:
        arrays: Arrays = {}
        rest = (self.inputs, self.bilinear, self.weights, self.route, self.judged)
        return _unpack, (self.part, to_data(self.lifting, arrays), arrays, *rest)


def _unpack(part: Part, lifting: Any, arrays: Arrays, *rest: Any) -> _ReadTask:
    return _ReadTask(part, from_data(lifting, arrays), *rest)


def read_part(reading: _ReadTask) -> _Sums | None:
    """Return the sums of one part: chunks of fixed size, lifted, added in order and forgotten; None if given up."""
    assert reading.part is not None, "a task has a part"
    episodes = reading.part.load()
    weights = None if reading.weights is None else _check_weights(reading.weights, episodes)
    columns = row_columns(reading.lifting, reading.inputs, reading.bilinear)
    names, total, samples, weight, judged = columns.names, None, 0, 0.0, reading.judged
    for i, chunk in enumerate(lift_chunks(episodes, columns, weights), 1):
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
        if judged and i >= _PILOT and samples >= _PAIRS * columns.regressors.size:
            judged, defined = False, (reading.lifting, reading.inputs, 1.0)
            if Moments(*defined, samples, weight, "gram", total.sums, reading.bilinear).condition > _WELL_CONDITIONED:
                return None
    sums = np.zeros((len(names), len(names))) if total is None else total.sums
    return _Sums(sums, samples, weight)


def space_evenly(total: int, wanted: int) -> list[int]:
    """Return at most `wanted` of the indices 0 … total − 1, evenly spread."""
    if wanted == 1:
        return [0]
    return sorted({round(i * (total - 1) / (wanted - 1)) for i in range(wanted)})


def _check_weights(weights: Weights, episodes: Episodes) -> Steps:
    """Return the weight of each step of each episode."""
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
    """Return the weights of the steps that `source` keeps: an embedding drops the first steps of each episode."""
    if weights is None or callable(weights):
        return weights
    dropped, inner = 0, source
    while isinstance(inner, Changed):
        dropped, inner = dropped + inner.history, inner.source
    if not isinstance(inner, Held):
        raise DataError("weights are a list, which needs the order of Episodes; pass a function of an Episode")
    return [steps[dropped:] for steps in _check_weights(weights, inner.episodes) if len(steps) > dropped]
