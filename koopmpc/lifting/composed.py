"""Liftings made of another lifting: projections, selections, scaled or bounded states, and eigenfunctions."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
from koopmpc.lifting.base import CONSTANT, Lifting, check_lifting, strip_unit
from koopmpc.plants.graph import Graph


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

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return ``"z0", "z1", …``."""
        if self.lifting.nz != len(self.basis):
            raise ShapeError(
                f"basis has {len(self.basis)} rows, the lifting returns {self.lifting.nz} observables; "
                "pass the lifting that the basis was made for"
            )
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
    """ψ(x) = the observables of another lifting at the indices `which`, with their names; no other one is computed."""

    lifting: Lifting
    which: tuple[int, ...]

    def __post_init__(self) -> None:
        freeze(self, which=tuple(int(i) for i in self.which))

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the chosen observables."""
        bad = [i for i in self.which if not 0 <= i < self.lifting.nz]
        if bad:
            raise DataError(f"which holds {bad[0]}; the lifting has observables 0 … {self.lifting.nz - 1}")
        return tuple(self.lifting.names[i] for i in self.which)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the chosen observables."""
        z = self.lifting.formula(x)
        return ca.vertcat(*(z[i] for i in self.which))


@dataclass(frozen=True, eq=False)
class Present(Lifting):
    """ψ(ζ) = ψ(x) for a point ζ = [x; u_{k−1}; x_{k−1}; …] of delays: the observables of the present state x."""

    lifting: Lifting

    def bind(self, states: Sequence[str]) -> "Present":
        """Return the copy on these names of ζ; its lifting stays bound to those of x."""
        bound = replace(self, bound=tuple(states))
        _ = bound.names  # checks the states
        return bound

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

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the inner names, each with ``~`` and a checksum of mean and scale: a name fixes the function."""
        return _tag_names(
            self.lifting, states, "~", "standardize by data of these states", ("mean", self.mean), ("scale", self.scale)
        )

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the inner formula of the standardized states."""
        return self.lifting.formula((x - ca.DM(self.mean)) / ca.DM(self.scale))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        self.lifting._fill((x - self.mean[:, None]) / self.scale[:, None], Z)


@dataclass(frozen=True, eq=False, init=False)
class Saturated(Lifting):
    """ψ(x) = inner(min(max(x, low), high)): a polynomial that does not grow where no data were.

    Parameters
    ----------
    lifting
        The inner lifting.
    low, high
        (nx,) in the states' units, ±inf where a state has no bound.

    Raises
    ------
    ShapeError
        The bounds have more or fewer entries than there are states.
    DataError
        A low bound is not below the high one.

    Examples
    --------
    >>> import koopmpc as km
    >>> from koopmpc.lifting import Saturated
    >>> square = Saturated(km.Monomials(2), low=[-1.0], high=[1.0])
    >>> square.bind(["x"])([[0.5], [1.0], [7.0]]).ravel().tolist()
    [0.25, 1.0, 1.0]
    """

    lifting: Lifting
    low: Float[np.ndarray, " nx"]
    high: Float[np.ndarray, " nx"]

    def __init__(
        self, lifting: Lifting, low: ArrayLike, high: ArrayLike, *, bound: tuple[str, ...] | None = None
    ) -> None:
        least = checks.array(low, "low", (None,), infinite=True)
        most = checks.array(high, "high", least.shape, infinite=True)
        if not (least < most).all():
            raise DataError("low must be below high for every state")
        freeze(self, lifting=check_lifting(lifting), low=least, high=most, bound=bound)

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the inner names, each with ``|`` and a checksum of the bounds: a name fixes the function."""
        return _tag_names(self.lifting, states, "|", "pass one for each", ("low", self.low), ("high", self.high))

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the inner formula of the bounded states."""
        inside = [_bound(x[i], low, high) for i, (low, high) in enumerate(zip(self.low, self.high, strict=True))]
        return self.lifting.formula(ca.vertcat(*inside))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        self.lifting._fill(np.clip(x, self.low[:, None], self.high[:, None]), Z)


def _bound(x: ca.SX, low: float, high: float) -> ca.SX:
    x = ca.fmin(x, high) if np.isfinite(high) else x
    return ca.fmax(x, low) if np.isfinite(low) else x


def _tag_names(
    lifting: Lifting, states: tuple[str, ...], sign: str, advice: str, *values: tuple[str, Float[np.ndarray, " nx"]]
) -> tuple[str, ...]:
    """Return the names of a lifting, each with a sign and a checksum of these values, one number for each state."""
    what, parts = " and ".join(name for name, _ in values), [value for _, value in values]
    if len(states) != len(parts[0]):
        raise ShapeError(
            f"{what} have {len(parts[0])} entries and there are {len(states)} states ({', '.join(states)}); {advice}"
        )
    tag = f"{sign}{checksum(*(value.tobytes() for value in parts)):08x}"
    return tuple(name if name == CONSTANT else name + tag for name in lifting.names)


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
