"""Liftings made of other liftings: sums, products, projections, selections, scaled states and eigenfunctions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate

import casadi as ca
import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import checksum, freeze
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.lifting.base import CONSTANT, Indices, Lifting, check_lifting, strip_unit
from koopmpc.plants.graph import Graph


@dataclass(frozen=True, eq=False)
class Sum(Lifting):
    """ψ(x) = [ψ₁(x); ψ₂(x); …], written ``a + b``; an observable whose name an earlier part has is left out."""

    parts: tuple[Lifting, ...]

    def bind(self, states: Sequence[str]) -> "Sum":
        """Return the sum of the bound parts."""
        return Sum(tuple(part.bind(states) for part in self.parts), bound=tuple(states))

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of all parts, each once."""
        return tuple(dict.fromkeys(name for part in self.parts for name in part.names))

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the new observables of each part, one under the other."""
        columns = [part.formula(x) for part in self.parts]
        return ca.vertcat(*(z[int(i)] for z, new in zip(columns, self._new, strict=True) for i in new))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        ends = accumulate(len(new) for new in self._new)
        for part, new, end in zip(self.parts, self._new, ends, strict=True):
            columns = Z[:, end - len(new) : end]
            if len(new) == part.nz:
                part._fill(x, columns)
            elif len(new):
                whole = np.empty((len(Z), part.nz))
                part._fill(x, whole)
                columns[:] = whole[:, new]

    @cached_property
    def _new(self) -> tuple[Indices, ...]:
        """For each part the indices of the observables that no earlier part names."""
        earlier: set[str] = set()
        new: list[Indices] = []
        for part in self.parts:
            new.append(np.array([i for i, name in enumerate(part.names) if name not in earlier], dtype=np.intp))
            earlier.update(part.names)
        return tuple(new)


@dataclass(frozen=True, eq=False)
class Product(Lifting):
    """ψ(x) = aᵢ(x) bⱼ(x) for every i and j; written ``a * b``.

    Equal products, such as x₁ x₂ and x₂ x₁, occur once. A name lists its factors in one order, states first and
    without units, so ``State() * State()`` has the names of ``Monomials(2)``.
    """

    first: Lifting
    second: Lifting

    def bind(self, states: Sequence[str]) -> "Product":
        """Return the product of the bound liftings."""
        bound = Product(self.first.bind(states), self.second.bind(states), bound=tuple(states))
        _ = bound.names
        return bound

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"omega*sin(theta)"`` and ``"theta^2"``."""
        return tuple(self._pairs)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the products; the index of the second lifting runs fastest."""
        a, b = self.first.formula(x), self.second.formula(x)
        return ca.vertcat(*(a[int(i)] * b[int(j)] for i, j in self._pairs.values()))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        a, b = np.empty((len(Z), self.first.nz)), np.empty((len(Z), self.second.nz))
        self.first._fill(x, a)
        self.second._fill(x, b)
        left, right = np.array(list(self._pairs.values()), dtype=np.intp).T
        np.multiply(a[:, left], b[:, right], out=Z)

    @cached_property
    def _pairs(self) -> dict[str, tuple[int, int]]:
        """Indices of the two factors by the name of their product; of equal names the first pair counts."""
        plain = [strip_unit(state) for state in self.bound_states]
        names = plain if len(set(plain)) == len(plain) else list(self.bound_states)
        order = {state: (i, name) for i, (state, name) in enumerate(zip(self.bound_states, names, strict=True))}
        pairs: dict[str, tuple[int, int]] = {}
        for i, left in enumerate(self.first.names):
            for j, right in enumerate(self.second.names):
                pairs.setdefault(_name_product(left, right, order), (i, j))
        return pairs


def _name_product(left: str, right: str, states: dict[str, tuple[int, str]]) -> str:
    """Return the name of the product; `states` holds the position and the name without unit of each state."""
    if CONSTANT in (left, right):
        return right if left == CONSTANT else left
    pair = sorted((left, right), key=lambda name: (name not in states, states.get(name, (0, ""))[0], name))
    a, b = (states[name][1] if name in states else name for name in pair)
    if left == right:
        return f"({a})^2" if "*" in a or "^" in a else f"{a}^2"
    return f"{a}*{b}"


@dataclass(frozen=True, eq=False)
class Projected(Lifting):
    """z = basisᵀ ψ(x): r coordinates of another lifting, as a rank-truncated fit uses them.

    Parameters
    ----------
    lifting
        ψ, of nz observables.
    basis
        (nz, r), one direction a column.

    Raises
    ------
    ShapeError
        The number of rows in the basis differs from the number of observables.
    """

    lifting: Lifting
    basis: Float[np.ndarray, "nz r"]

    def __post_init__(self) -> None:
        freeze(self, basis=checks.array(self.basis, "basis", (None, None)))

    def bind(self, states: Sequence[str]) -> "Projected":
        """Return the copy on the bound lifting."""
        bound = replace(self, lifting=self.lifting.bind(states), bound=tuple(states))
        if bound.lifting.nz != len(self.basis):
            raise ShapeError(
                f"basis has {len(self.basis)} rows, the lifting returns {bound.lifting.nz} observables; "
                "pass the lifting that the basis was made for"
            )
        return bound

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return ``"z0", "z1", …``."""
        return tuple(f"z{j}" for j in range(self.basis.shape[1]))

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the r coordinates basisᵀ ψ(x)."""
        return ca.DM(np.ascontiguousarray(self.basis.T)) @ self.lifting.formula(x)

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M r"]) -> None:
        whole = np.empty((len(Z), len(self.basis)))
        self.lifting._fill(x, whole)
        np.matmul(whole, self.basis, out=Z)


@dataclass(frozen=True, eq=False)
class Picked(Lifting):
    """ψ(x) = the observables of another lifting at the indices `which`, with their names; no other one is computed.

    Parameters
    ----------
    lifting
        The lifting that holds the observables.
    which
        Indices of the observables to keep.

    Raises
    ------
    DataError
        An index is not below the number of observables.
    """

    lifting: Lifting
    which: tuple[int, ...]

    def __post_init__(self) -> None:
        freeze(self, which=tuple(int(i) for i in self.which))

    def bind(self, states: Sequence[str]) -> "Picked":
        """Return the copy on the bound lifting."""
        bound = replace(self, lifting=self.lifting.bind(states), bound=tuple(states))
        bad = [i for i in self.which if not 0 <= i < bound.lifting.nz]
        if bad:
            raise DataError(f"which holds {bad[0]}; the lifting has observables 0 … {bound.lifting.nz - 1}")
        return bound

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the chosen observables."""
        return tuple(self.lifting.names[i] for i in self.which)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the chosen observables."""
        z = self.lifting.formula(x)
        return ca.vertcat(*(z[i] for i in self.which))


@dataclass(frozen=True, eq=False)
class Present(Lifting):
    """ψ(ζ) = ψ(x) for a point ζ = [x; u_{k−1}; x_{k−1}; …] of delays: the observables of the present state x.

    Parameters
    ----------
    lifting
        ψ, bound to the names of x.

    Raises
    ------
    ShapeError
        ζ does not begin with these states.
    """

    lifting: Lifting

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the lifting's own observables."""
        x = self.lifting.bound_states
        if states[: len(x)] != x:
            raise ShapeError(f"the states are {', '.join(states)}; they must begin with {', '.join(x)}")
        return self.lifting.names

    def formula(self, x: ca.SX) -> ca.SX:
        """Return ψ of the first entries of ζ."""
        return self.lifting.formula(x[: len(self.lifting.bound_states)])

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        self.lifting._fill(np.ascontiguousarray(x[: len(self.lifting.bound_states)]), Z)


@dataclass(frozen=True, eq=False, init=False)
class Standardized(Lifting):
    """ψ(x) = inner((x − mean) / scale): the inner lifting sees states of mean 0 and spread 1.

    A lifting with a width or a distance (Gaussian, ThinPlate, RandomFourier) then weighs every state alike, whatever
    its unit, and its centres and widths are in standard deviations. `Standardized.of(episodes, lifting)` computes mean
    and scale from data.

    Parameters
    ----------
    lifting
        The inner lifting.
    mean, scale
        (nx,) in the states' units; scale above zero.

    Raises
    ------
    ShapeError
        Mean or scale has more or fewer entries than there are states.
    DataError
        A scale is not above zero.
    """

    lifting: Lifting
    mean: Float[np.ndarray, " nx"]
    scale: Float[np.ndarray, " nx"]

    def __init__(
        self, lifting: Lifting, mean: ArrayLike, scale: ArrayLike, *, bound: tuple[str, ...] | None = None
    ) -> None:
        center = checks.array(mean, "mean", (None,))
        spread = checks.array(scale, "scale", center.shape)
        if (spread <= 0).any():
            raise DataError(f"scale holds {spread.min():g}; it must be above zero for every state")
        freeze(self, lifting=check_lifting(lifting), mean=center, scale=spread, bound=bound)

    @classmethod
    def of(cls, episodes: Episodes | Source, lifting: Lifting) -> "Standardized":
        """Return the lifting standardized by the mean and the standard deviation of the states in these data.

        The states are x_0 … x_{T−1} of each episode, read part by part. A state that does not move has scale 1.

        Raises
        ------
        DataError
            The source can be read only once, and the fit must read it.
        """
        source = source_of(episodes)
        if not source.replayable:
            raise DataError("a stream is read once, by the fit; take Standardized.of from some episodes of it")
        rows, mean, squares = 0, np.zeros(source.nx), np.zeros(source.nx)
        for part in source.parts():
            for episode in part.load():  # Chan, Golub & LeVeque 1983: merge the means and sums of squares of two sets
                X = episode.X[:-1]
                episode_mean, rows = X.mean(axis=0), rows + len(X)
                step = (episode_mean - mean) * len(X) / rows
                squares += ((X - episode_mean) ** 2).sum(axis=0) + (episode_mean - mean) * step * (rows - len(X))
                mean = mean + step
        scale = np.sqrt(squares / max(rows, 1))
        still = scale <= 1e-12 * np.abs(mean)
        return cls(lifting, mean, np.where(still, 1.0, scale))

    def bind(self, states: Sequence[str]) -> "Standardized":
        """Return the copy on the bound inner lifting."""
        if len(states) != len(self.mean):
            raise ShapeError(
                f"mean and scale have {len(self.mean)} entries and there are {len(states)} states "
                f"({', '.join(states)}); standardize by data of these states"
            )
        bound = Standardized(self.lifting.bind(states), self.mean, self.scale, bound=tuple(states))
        _ = bound.names
        return bound

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the inner names, each with ``~`` and a checksum of mean and scale: a name fixes the function."""
        tag = f"~{checksum(self.mean.tobytes(), self.scale.tobytes()):08x}"
        return tuple(name if name == CONSTANT else name + tag for name in self.lifting.bind(states).names)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the inner formula of the standardized states."""
        return self.lifting.formula((x - ca.DM(self.mean)) / ca.DM(self.scale))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        self.lifting._fill((x - self.mean[:, None]) / self.scale[:, None], Z)


@dataclass(frozen=True, eq=False)
class Eigenfunction(Lifting):
    """φ(x) = Σ cⱼ ψⱼ(x) with φ̇ = λ φ + Σᵢ βᵢ(x) uᵢ along the motion of the plant; a conserved energy has λ = 0.

    As a lifting it has the observable φ, or Re φ and Im φ if λ is complex. Costs, limits, models and controllers
    accept it like any other lifting.

    Attributes
    ----------
    lifting
        ψ, of nz observables, bound to the states.
    coefficients
        (1, nz), c; or (2, nz), Re c and Im c.
    rates
        λ [1/s] as (Re,) or (Re, Im).
    drive
        (1 or 2, nu, nz), βᵢ(x) = Σⱼ drive[i, j] ψⱼ(x); nu is 0 if the data had no inputs.
    label
        Name of the observable.
    residual
        Root-mean-square of φ̇ − λ φ − β u on the fitted data, as a share of ‖∇φ‖ times the speed of the states, both in
        their standard deviations.
    error
        Root-mean-square error of φ over whole held-out episodes, predicted from its first value, as a share of
        ‖∇φ‖ in standard deviations of the states. An error of 1 means that the prediction is worthless.
    """

    lifting: Lifting
    coefficients: Float[np.ndarray, "p nz"]
    rates: tuple[float, ...]
    drive: Float[np.ndarray, "p nu nz"]
    label: str = "φ"
    residual: float = 0.0
    error: float = 0.0

    def __post_init__(self) -> None:
        p = len(self.rates)
        c = checks.array(self.coefficients, "coefficients", (p, self.lifting.nz))
        drive = checks.array(self.drive, "drive", (p, None, self.lifting.nz))
        freeze(self, coefficients=c, drive=drive, bound=self.lifting.bound_states)

    def bind(self, states: Sequence[str]) -> "Eigenfunction":
        """Return itself: it is already bound to the states of its data."""
        if len(states) != len(self.bound_states):
            raise ShapeError(f"{self.label} is a function of {len(self.bound_states)} states, got {len(states)}")
        return self

    @property
    def eigenvalue(self) -> complex:
        """λ [1/s]."""
        return complex(*self.rates)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.drive.shape[1]

    def scaled(self, by: float, label: str | None = None) -> "Eigenfunction":
        """Return `by` times φ, which is an eigenfunction too."""
        return replace(self, coefficients=by * self.coefficients, drive=by * self.drive, label=label or self.label)

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the label, or the names of the real and the imaginary part."""
        return (self.label,) if len(self.rates) == 1 else (f"Re {self.label}", f"Im {self.label}")

    def formula(self, x: ca.SX) -> ca.SX:
        """Return φ(x), or Re φ and Im φ."""
        return ca.DM(self.coefficients) @ self.lifting.formula(x)

    def effect(self, x: ca.SX) -> ca.SX:
        """Return β(x), (1, nu), of a real φ."""
        return (ca.DM(self.drive[0]) @ self.lifting.formula(x)).T

    def values(self, X: ArrayLike) -> Complex[np.ndarray, " M"] | Float[np.ndarray, " M"]:
        """Return φ at rows of states (M, nx): complex if λ is, else real."""
        return _combine_parts(self(checks.array(X, "X", (None, len(self.bound_states)))).T)

    def gradient(self, X: ArrayLike) -> Complex[np.ndarray, "M nx"] | Float[np.ndarray, "M nx"]:
        """Return ∂φ/∂x at rows of states (M, nx)."""
        J = evaluate_jacobians(self.lifting, checks.array(X, "X", (None, len(self.bound_states))))
        return _combine_parts(np.einsum("pj,mji->pmi", self.coefficients, J))

    def __str__(self) -> str:
        """Return the formula with four digits, and λ."""
        c = _combine_parts(self.coefficients)
        terms = [f"({v:.4g}) {strip_unit(name)}" for v, name in zip(c, self.lifting.names, strict=True) if v != 0]
        value = self.rates[0] if len(self.rates) == 1 else self.eigenvalue
        return f"{self.label} = {' + '.join(terms)}, λ = {value:.4g} 1/s, error {self.error:.2g}"


def _combine_parts(parts: Float[np.ndarray, "p ..."]) -> Complex[np.ndarray, "..."] | Float[np.ndarray, "..."]:
    return parts[0] if len(parts) == 1 else parts[0] + 1j * parts[1]


@raise_swallowed()
def evaluate_jacobians(lifting: Lifting, X: Float[np.ndarray, "M nx"]) -> Float[np.ndarray, "M nz nx"]:
    """Return ∂ψ/∂x at rows of states, exactly, by CasADi's derivatives."""
    x = ca.SX.sym("x", X.shape[1])
    J = ca.densify(ca.jacobian(lifting.symbolic(x), x))
    graph = Graph.trace(ca.Function("jacobian", [x], [ca.vec(J.T)]))
    return graph.evaluate(X).reshape(len(X), lifting.nz, X.shape[1])
