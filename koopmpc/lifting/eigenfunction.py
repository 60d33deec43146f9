"""Eigenfunction: a combination φ(x) of observables that obeys φ̇ = λ φ + β(x) u, a linear equation of its own."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import ShapeError
from koopmpc.lifting.base import Lifting, short
from koopmpc.plants.graph import Graph
from koopmpc.values import freeze


@dataclass(frozen=True, eq=False)
class Eigenfunction(Lifting):
    """φ(x) = Σ cⱼ ψⱼ(x) with φ̇ = λ φ + Σᵢ βᵢ(x) uᵢ along the motion of the plant; a conserved energy has λ = 0.

    As a lifting it has one observable, φ, or two where λ is complex, Re φ and Im φ: costs, limits, models and
    controllers take it as they take any other.

    Attributes
    ----------
    lifting
        ψ, of nz observables, bound to the states.
    coefficients
        (1, nz), c; or (2, nz), Re c and Im c.
    rates
        λ [1/s] as (Re,) or (Re, Im).
    drive
        (1 or 2, nu, nz), βᵢ(x) = Σⱼ drive[i, j] ψⱼ(x); nu is 0 where the data had no inputs.
    label
        Name of the observable.
    residual
        Root-mean-square of φ̇ − λ φ − β u on the fitted data, as a share of ‖∇φ‖ times the speed of the states, both in
        their standard deviations.
    error
        Root-mean-square error of φ over whole held-out episodes, predicted from its first value, as a share of
        ‖∇φ‖ in standard deviations of the states: 1 means that φ moves as any function does.
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
        """Return itself: it is bound to the states of its data."""
        if len(states) != len(self.bound_states):
            raise ShapeError(f"{self.label} is of {len(self.bound_states)} states, and there are {len(states)}")
        return self

    @property
    def eigenvalue(self) -> complex:
        """λ [1/s]."""
        return complex(*self.rates)

    @property
    def nu(self) -> int:
        """Number of inputs whose effect is known."""
        return self.drive.shape[1]

    def scaled(self, by: float, label: str | None = None) -> "Eigenfunction":
        """Return `by` times φ: an eigenfunction is found up to a factor."""
        return replace(self, coefficients=by * self.coefficients, drive=by * self.drive, label=label or self.label)

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the label, or those of real and imaginary part."""
        return (self.label,) if len(self.rates) == 1 else (f"Re {self.label}", f"Im {self.label}")

    def formula(self, x: ca.SX) -> ca.SX:
        """Return φ(x), or Re φ and Im φ."""
        return ca.DM(self.coefficients) @ self.lifting.formula(x)

    def effect(self, x: ca.SX) -> ca.SX:
        """Return β(x), (1, nu), of a real φ."""
        return (ca.DM(self.drive[0]) @ self.lifting.formula(x)).T

    def values(self, X: ArrayLike) -> Complex[np.ndarray, " M"] | Float[np.ndarray, " M"]:
        """Return φ at rows of states (M, nx): real, or complex where λ is."""
        return _joined(self(checks.array(X, "X", (None, len(self.bound_states)))).T)

    def gradient(self, X: ArrayLike) -> Complex[np.ndarray, "M nx"] | Float[np.ndarray, "M nx"]:
        """Return ∂φ/∂x at rows of states (M, nx)."""
        J = jacobians(self.lifting, checks.array(X, "X", (None, len(self.bound_states))))
        return _joined(np.einsum("pj,mji->pmi", self.coefficients, J))

    def __str__(self) -> str:
        """Return the formula with four digits, and λ."""
        c = _joined(self.coefficients)
        terms = [f"({v:.4g}) {short(name)}" for v, name in zip(c, self.lifting.names, strict=True) if v != 0]
        value = self.rates[0] if len(self.rates) == 1 else self.eigenvalue
        return f"{self.label} = {' + '.join(terms)}, λ = {value:.4g} 1/s, error {self.error:.2g}"


def _joined(parts: Float[np.ndarray, "p ..."]) -> Complex[np.ndarray, "..."] | Float[np.ndarray, "..."]:
    return parts[0] if len(parts) == 1 else parts[0] + 1j * parts[1]


def jacobians(lifting: Lifting, X: Float[np.ndarray, "M nx"]) -> Float[np.ndarray, "M nz nx"]:
    """Return ∂ψ/∂x at rows of states, exactly, by CasADi's derivatives."""
    x = ca.SX.sym("x", X.shape[1])
    J = ca.densify(ca.jacobian(lifting.symbolic(x), x))
    graph = Graph.trace(ca.Function("jacobian", [x], [ca.vec(J.T)]))
    return graph.evaluate(X).reshape(len(X), lifting.nz, X.shape[1])
