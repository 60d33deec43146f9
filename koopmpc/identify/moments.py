"""Second moments of the rows [ψ(x) u ψ(x⁺)], or [ψ(x) u u⊗ψ(x) ψ(x⁺)]: all that the regressions need."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg.lapack import dtpqrt

from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.errors import DataError, FitWarning
from koopmpc.identify.chunks import ROWS, chunks, table
from koopmpc.identify.solve import Rows, norms
from koopmpc.lifting.base import Lifting, lifting_of
from koopmpc.lifting.constant import Constant
from koopmpc.lifting.state import State
from koopmpc.values import Value

Route = Literal["gram", "qr"]
_WELL_CONDITIONED = 1e6  # scaled cond(Z) up to which normal equations lose nothing
_PILOT = 4  # least number of chunks that choose the route
_PANEL = 16  # columns that dtpqrt eliminates at once


@dataclass(frozen=True, eq=False)
class Moments(Value):
    """Second moments of the rows d = [ψ(x) u ψ(x⁺)] of M snapshot pairs: G = Σ dᵀd, or R with RᵀR = Σ dᵀd.

    They add: ``a + b`` are the moments of both data sets, in any grouping, to rounding. Where ψ lacks a
    state, the state is appended to it in these rows, so that C and the residuals need no second pass.

    Attributes
    ----------
    lifting
        ψ, bound to the states.
    inputs
        Names with units; none for an autonomous system.
    dt
        Sample time [s].
    samples
        M.
    route
        "gram" for raw sums of products, "qr" for the triangular factor: twice the digits, six times the cost.
    sums
        G or R, (nd, nd).
    bilinear
        The rows are [ψ(x) u u⊗ψ(x) ψ(x⁺)]; a Constant is left out of the products, for u times it is u.
    """

    lifting: Lifting
    inputs: tuple[str, ...]
    dt: float
    samples: int
    route: str
    sums: Float[np.ndarray, "nd nd"]
    bilinear: bool = False

    @cached_property
    def full(self) -> Lifting:
        """The lifting, then the states that it lacks."""
        return _with_states(self.lifting)

    @property
    def nz(self) -> int:
        """Number of observables in ψ."""
        return self.lifting.nz

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
        mine = (self.lifting, self.inputs, self.dt, self.bilinear)
        if mine != (other.lifting, other.inputs, other.dt, other.bilinear):
            raise DataError(
                "the moments differ in lifting, inputs or dt, or one is bilinear; "
                "add moments of one plant in one lifting only"
            )
        samples = self.samples + other.samples
        if self.route == other.route == "qr":
            return replace(self, samples=samples, sums=_absorbed(self.sums, other.sums))
        if self.route != other.route:
            warnings.warn(
                "a triangular factor was added to Gram sums: the result is Gram sums, with half the digits; "
                'read both with route="qr"',
                FitWarning,
                stacklevel=2,
            )
        return replace(self, samples=samples, route="gram", sums=self._gram() + other._gram())

    def rows(self, regressors: Int[np.ndarray, " n"], targets: Int[np.ndarray, " m"]) -> Rows:
        """Return a few rows [P T] with the same second moments as these columns of all M rows."""
        n = len(regressors)
        if self.route == "qr":
            R = _triangle(self.sums[:, np.concatenate([regressors, targets])])
            return Rows(R[:n, :n], R[:n, n:], np.sum(R[n:, n:] ** 2, axis=0), self.samples)
        G = self.sums
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


def moments(
    episodes: Episodes, lifting: Lifting, *, route: Route | None = None, bilinear: bool = False
) -> Moments:
    """Return Σ dᵀd, or its triangular factor, over the rows d = [ψ(x) u ψ(x⁺)] of all snapshot pairs.

    Chunks of fixed size are lifted, added in order and forgotten: memory does not grow with the data, and
    one BLAS build and thread count gives one result to the bit. Data too large for memory, or a stream, are
    fed part by part and added: ``moments(part, lifting, route="qr") + …``.

    Parameters
    ----------
    episodes
        At least one step in all.
    lifting
        ψ; it is bound to the episodes' states.
    route
        "gram" sums products, "qr" updates a triangular factor. By default the scaled condition number of a
        pilot of sampled chunks chooses: Gram up to 1e6, else QR; if the whole is worse, it is read again.
    bilinear
        Put u⊗ψ(x) into the rows, for z⁺ = A z + B u + Σ uᵢ Nᵢ z.

    Raises
    ------
    DataError
        An observable is not finite on the data; an argument is of another kind.
    """
    episodes = episodes_of(episodes)
    bound = lifting_of(lifting).bind(episodes.states)
    pieces = chunks(episodes)
    if route is not None:
        return _read(episodes, bound, range(len(pieces)), route, bilinear)
    width = bound.nz + episodes.nu * (1 + len(_products(bound, bilinear)))
    pilot = _spread(len(pieces), max(_PILOT, -(-4 * width // ROWS)))
    first = _read(episodes, bound, pilot, "gram", bilinear)
    if first.condition <= _WELL_CONDITIONED:
        whole = range(len(pieces))
        total = first if len(pilot) == len(pieces) else _read(episodes, bound, whole, "gram", bilinear)
        if total.condition <= _WELL_CONDITIONED:
            return total
    return _read(episodes, bound, range(len(pieces)), "qr", bilinear)


def _spread(total: int, wanted: int) -> list[int]:
    """Return at most `wanted` of the indices 0 … total − 1, evenly spread."""
    return sorted({round(i * (total - 1) / (wanted - 1)) for i in range(wanted)})


def _read(
    episodes: Episodes, lifting: Lifting, which: Sequence[int], route: Route, bilinear: bool
) -> Moments:
    full, pieces, products = _with_states(lifting), chunks(episodes), _products(lifting, bilinear)
    width = 2 * full.nz + episodes.nu * (1 + len(products))
    sums, samples = np.zeros((width, width)), 0
    for i in which:
        D = table(episodes, full, pieces[i], products)
        with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is named below
            sums = sums + D.T @ D if route == "gram" else _absorbed(sums, D)
        samples += len(D)
        size = sums.diagonal() if route == "gram" else np.abs(D).max(axis=0)
        _require_finite(size, full, episodes.inputs, products)
    return Moments(lifting, episodes.inputs, episodes.dt, samples, route, sums, bilinear)


def _products(lifting: Lifting, bilinear: bool) -> Int[np.ndarray, " np"]:
    one = Constant().bind(lifting._states).names[0]
    return np.array([i for i, name in enumerate(lifting.names) if bilinear and name != one], dtype=np.intp)


def _absorbed(R: Float[np.ndarray, "nd nd"], rows: Float[np.ndarray, "m nd"]) -> Float[np.ndarray, "nd nd"]:
    """Return the triangular factor of [R; rows]."""
    if not np.isfinite(rows).all():
        return np.full_like(R, np.nan)
    result, _, _, info = dtpqrt(0, min(_PANEL, len(R)), R, rows)
    assert info == 0, f"dtpqrt refused argument {-info}"
    return np.ascontiguousarray(np.triu(result))


def _triangle(columns: Float[np.ndarray, "nd n"]) -> Float[np.ndarray, "k n"]:
    return np.asarray(np.linalg.qr(columns, mode="r"), dtype=np.float64)


def _require_finite(
    size: Float[np.ndarray, " nd"], full: Lifting, inputs: tuple[str, ...], which: Int[np.ndarray, " np"]
) -> None:
    bad = np.flatnonzero(~np.isfinite(size))
    if bad.size:
        products = product_names(full, inputs, which)
        name = (*full.names, *inputs, *products, *full.names)[int(bad[0])]
        raise DataError(
            f"the observable {name!r} is NaN, infinite or above 1e154 on these data; "
            "drop it, or the episodes where it is"
        )


def product_names(
    lifting: Lifting, inputs: tuple[str, ...], products: Int[np.ndarray, " np"]
) -> tuple[str, ...]:
    """Return ``"force [N] * theta [rad]"``, …, in the order of u⊗ψ(x)."""
    return tuple(f"{u} * {lifting.names[int(i)]}" for u in inputs for i in products)


def _with_states(lifting: Lifting) -> Lifting:
    states = State().bind(lifting._states)
    return lifting if set(states.names) <= set(lifting.names) else lifting + states
