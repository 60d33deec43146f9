"""Second moments of the rows [ψ(x) u ψ(x⁺)], or [ψ(x) u u⊗ψ(x) ψ(x⁺)]: all that the regressions need."""

import warnings
from collections.abc import Iterable, Sized
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from itertools import islice
from typing import TypedDict

import numpy as np
from jaxtyping import Float, Int

from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Held, Part, Source, source_of
from koopmpc.errors import DataError, FitWarning
from koopmpc.identify.chunks import ROWS
from koopmpc.identify.factor import absorb
from koopmpc.identify.reading import Reading, Route, Sums, read, spread
from koopmpc.identify.solve import Rows, norms
from koopmpc.identify.weights import Weights
from koopmpc.lifting.base import Lifting, lifting_of
from koopmpc.lifting.constant import Constant
from koopmpc.lifting.state import State
from koopmpc.parallel import Progress, map_tasks
from koopmpc.values import Value

_WELL_CONDITIONED = 1e6  # scaled cond(Z) up to which normal equations lose nothing
_PILOT = 4  # parts, and least number of chunks, that choose the route


@dataclass(frozen=True, eq=False)
class Moments(Value):
    """Second moments of the rows d = [ψ(x) u ψ(x⁺)] of M snapshot pairs: G = Σ w dᵀd, or R with RᵀR = Σ w dᵀd.

    They add: ``a + b`` are the moments of both data sets, in any grouping, to rounding. Where ψ lacks a
    state, the state is appended to it in these rows, so that C and the residuals need no second pass.

    Attributes
    ----------
    lifting
        ψ, bound to the states, or to ζ of the embedding.
    inputs
        Names with units; none for an autonomous system.
    dt
        Sample time [s].
    samples
        M, the pairs of weight above 0.
    weight
        Σ w; M where the pairs are not weighted.
    route
        "gram" for raw sums of products, "qr" for the triangular factor: twice the digits, six times the cost.
    sums
        G or R, (nd, nd).
    bilinear
        The rows are [ψ(x) u u⊗ψ(x) ψ(x⁺)]; a Constant is left out of the products, for u times it is u.
    embedding
        Where ψ acts on ζ, what makes it.
    """

    lifting: Lifting
    inputs: tuple[str, ...]
    dt: float
    samples: int
    weight: float
    route: str
    sums: Float[np.ndarray, "nd nd"]
    bilinear: bool = False
    embedding: Delay | None = None

    @cached_property
    def full(self) -> Lifting:
        """The lifting, then the states that it lacks."""
        return _with_states(self.lifting)

    @property
    def nz(self) -> int:
        """Number of observables in ψ."""
        return self.lifting.nz

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states x, without their past."""
        return self.lifting._states if self.embedding is None else self.embedding.states

    @property
    def products(self) -> Int[np.ndarray, " np"]:
        """Observables in u⊗ψ(x): all but a Constant, or none."""
        return _products(self.lifting, self.bilinear)

    @property
    def regressors(self) -> Int[np.ndarray, " n"]:
        """Columns of ψ(x), u and u⊗ψ(x)."""
        return np.concatenate([np.arange(self.nz), np.arange(self.full.nz, self._first)])

    @property
    def targets(self) -> Int[np.ndarray, " n"]:
        """Columns of ψ(x⁺), the appended states last."""
        return np.arange(self._first, self._first + self.full.nz)

    @property
    def _first(self) -> int:
        return self.full.nz + len(self.inputs) * (1 + len(self.products))

    @property
    def condition(self) -> float:
        """Condition number of the regressors on unit-norm columns, those that are 0 throughout left out."""
        columns = self.rows(self.regressors, self.targets[:0]).P
        size = norms(columns)
        s = np.linalg.svd(columns[:, size > 0] / size[size > 0], compute_uv=False)
        if self.samples < len(s):
            return np.inf
        return float(s[0] / s[-1]) if s.size and s[-1] > 0 else (np.inf if s.size else 1.0)

    def __add__(self, other: "Moments") -> "Moments":
        """Return the moments of both data sets; R + G becomes G and warns, for it loses R's digits."""
        mine = (self.lifting, self.inputs, self.dt, self.bilinear, self.embedding)
        if mine != (other.lifting, other.inputs, other.dt, other.bilinear, other.embedding):
            raise DataError(
                "the moments differ in lifting, inputs or dt, or one is bilinear; "
                "add moments of one plant in one lifting only"
            )
        both = replace(self, samples=self.samples + other.samples, weight=self.weight + other.weight)
        if self.route == other.route == "qr":
            R = self.sums.copy(order="F")
            absorb(R, other.sums)
            return replace(both, sums=np.ascontiguousarray(R))
        if self.route != other.route:
            warnings.warn(
                "a triangular factor was added to Gram sums: the result is Gram sums, with half the digits; "
                'read both with route="qr"',
                FitWarning,
                stacklevel=2,
            )
        return replace(both, route="gram", sums=self._gram() + other._gram())

    def rows(self, regressors: Int[np.ndarray, " n"], targets: Int[np.ndarray, " m"]) -> Rows:
        """Return a few rows [P T] with the same second moments as these columns of all M rows.

        Weights are taken with mean 1, so that a root of the mean over M rows is one over the weighted rows.
        """
        n, scale = len(regressors), self.samples / self.weight
        if self.route == "qr":
            R = _triangle(np.sqrt(scale) * self.sums[:, np.concatenate([regressors, targets])])
            return Rows(R[:n, :n], R[:n, n:], np.sum(R[n:, n:] ** 2, axis=0), self.samples)
        G = scale * self.sums
        size = np.sqrt(G.diagonal()[regressors])
        size[size == 0] = 1.0
        values, vectors = np.linalg.eigh(G[np.ix_(regressors, regressors)] / np.outer(size, size))
        # an eigenvalue below this is rounding of the sums
        held = values > np.finfo(float).eps * max(self.samples, n) * values.max(initial=0.0)
        root = np.sqrt(np.where(held, values, 0.0))
        P = root[:, None] * vectors.T * size
        inverse = np.where(held, 1.0, 0.0) / np.where(held, root, 1.0)
        T = inverse[:, None] * (vectors.T @ (G[np.ix_(regressors, targets)] / size[:, None]))
        rest = np.maximum(G.diagonal()[targets] - np.sum(T**2, axis=0), 0.0)
        return Rows(P, T, rest, self.samples)

    def _gram(self) -> Float[np.ndarray, "nd nd"]:
        return self.sums if self.route == "gram" else self.sums.T @ self.sums


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
        w of each pair, 0 or above; by default 1. With Episodes one item an episode, a number or (T,), one a step;
        with any source a function Episode → number or (T,). They weigh pairs against each other: residuals are
        weighted means, and a common factor changes nothing.
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
    if not (weights is None or callable(weights) or isinstance(source, Held)):
        raise DataError(
            "weights are a list, which only Episodes have an order for; pass a function of an Episode"
        )
    task = _Task(source, bound, _products(bound, bilinear), bilinear, weights, embedding)

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
        return _with_states(self.lifting)

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


def _products(lifting: Lifting, bilinear: bool) -> Int[np.ndarray, " np"]:
    one = Constant().bind(lifting._states).names[0]
    return np.array([i for i, name in enumerate(lifting.names) if bilinear and name != one], dtype=np.intp)


def product_names(
    lifting: Lifting, inputs: tuple[str, ...], products: Int[np.ndarray, " np"]
) -> tuple[str, ...]:
    """Return ``"force [N] * theta [rad]"``, …, in the order of u⊗ψ(x)."""
    return tuple(f"{u} * {lifting.names[int(i)]}" for u in inputs for i in products)


def _triangle(columns: Float[np.ndarray, "nd n"]) -> Float[np.ndarray, "k n"]:
    return np.asarray(np.linalg.qr(columns, mode="r"), dtype=np.float64)


def _with_states(lifting: Lifting) -> Lifting:
    states = State().bind(lifting._states)
    return lifting if set(states.names) <= set(lifting.names) else lifting + states
