"""Continuous-time models ẋ = f(x, u), y = h(x) in CasADi operations, and the integrators that make x⁺ = F(x, u)."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.scene import Scene, Shape
from koopmpc.base.values import Named

_Symbol = Any  # ca.SX of equations, ca.MX of foreign code
_Pair = tuple[ca.SX, ca.SX]  # the type of x and u for checkers: both kinds have the same operations


class Dynamics(Named, ABC):
    """A plant ẋ = f(x, u), y = h(x): a frozen dataclass whose fields are the parameters, with units.

    `states` and `inputs` name the rows of x and u, unit included: ``("theta [rad]", "omega [rad/s]")``. `disturbances`
    names what is measured and cannot be set, such as the weather: its values follow the inputs in the u of `rhs`.

    Examples
    --------
    >>> import koopmpc as km
    >>> import casadi as ca
    >>> class Spring(km.Dynamics):
    ...     states, inputs = ("position [m]", "velocity [m/s]"), ("force [N]",)
    ...     def rhs(self, x, u):
    ...         return ca.vertcat(x[1], u[0] - x[0] - 2 * x[0] ** 3)
    ...
    >>> km.discretize(Spring(), dt=0.05)([0.5, 0.0], [1.0]).round(4)
    array([0.5003, 0.0125])
    """

    states: ClassVar[tuple[str, ...]]
    inputs: ClassVar[tuple[str, ...]]
    disturbances: ClassVar[tuple[str, ...]] = ()

    @abstractmethod
    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = f(x, u): (nx, 1) from x (nx, 1) and u (nu + nw, 1), the inputs and then the measured disturbances."""

    def measure(self, x: ca.SX) -> ca.SX:
        """Return y = h(x): (ny, 1) from x (nx, 1); the whole state unless overridden."""
        return x

    def scene(self, x: np.ndarray, u: np.ndarray) -> Sequence[Shape] | None:
        """Return the shapes that draw x (nx,) and u (nu,), with the same names at each call; None draws nothing."""
        return None


def find_scene(dynamics: Dynamics) -> Scene | None:
    """Return the `scene` method of `dynamics`, or None if its class does not define one."""
    draw = dynamics.scene
    return None if type(dynamics).scene is Dynamics.scene else lambda x, u: draw(x, u) or ()


@raise_swallowed()
def build_right_side(dynamics: Dynamics) -> ca.Function:
    """Return f of ẋ = f(x, u) as a CasADi function of x (nx) and u (nu), measured disturbances last.

    Raises
    ------
    ShapeError
        `rhs` returns another number of rows than there are states.
    DataError
        `rhs` does not return a CasADi expression, or returns one with symbols other than x and u.
    """
    checks.members(dynamics, "dynamics", ("states", "inputs", "rhs"), "pass one of your subclass of km.Dynamics")
    _check_names(dynamics)
    x, u = ca.SX.sym("x", dynamics.nx), ca.SX.sym("u", dynamics.nu + dynamics.nw)
    value = _check_expression(dynamics.rhs(x, u), f"{type(dynamics).__name__}.rhs", ca.vertcat(x, u), dynamics.nx)
    return ca.Function("f", [x, u], [value], ["x", "u"], ["dx"])


@raise_swallowed()
def split_inputs(F: ca.Function, nu: int, nw: int) -> ca.Function:
    """Return F(x, u, w) of F(x, [u; w]); F itself without disturbances."""
    if not nw:
        return F
    x, u, w = ca.MX.sym("x", F.size1_in(0)), ca.MX.sym("u", nu), ca.MX.sym("w", nw)
    split = ca.Function("F", [x, u, w], [F(x, ca.vertcat(u, w))], ["x", "u", "w"], ["x_next"])
    return split.expand("F") if F.is_a("SXFunction") else split


@raise_swallowed()
def build_output(dynamics: Dynamics) -> tuple[ca.Function, tuple[str, ...]]:
    """Return h of y = h(x), and the names of y: an output that is a state has the state's name."""
    _check_names(dynamics)
    x = ca.SX.sym("x", dynamics.nx)
    value = _check_expression(dynamics.measure(x), f"{type(dynamics).__name__}.measure", x)
    names: list[str] = []
    states = [(name, x[j]) for j, name in enumerate(dynamics.states)]
    for i in range(value.size1()):
        measured = value[i]
        equal_states = [name for name, state in states if ca.is_equal(measured, state)]
        names.append(equal_states[0] if equal_states else f"y{i}")
    return ca.Function("h", [x], [value], ["x"], ["y"]), tuple(names)


def _check_expression(value: object, name: str, known: ca.SX, rows: int | None = None) -> ca.SX:
    """Return the value as a dense column; raise if it is not an expression, or holds symbols other than `known`."""
    if not isinstance(value, ca.SX | ca.DM):
        raise DataError(f"{name} returned {checks.article(value)}; return one column, ca.vertcat(...)")
    column = ca.SX(value)
    if column.size2() != 1 or (rows is not None and column.size1() != rows):
        expected = f"({rows}, 1), one row a state" if rows is not None else "one column"
        raise ShapeError(f"{name} returned shape {column.shape}, expected {expected}")
    free = [str(symbol) for symbol in ca.symvar(column) if not ca.depends_on(symbol, known)]
    if free:
        raise DataError(f"{name} holds free symbols {free}; make them parameters with numbers")
    return ca.densify(column)


def _check_names(dynamics: Dynamics) -> None:
    """Check that states and inputs are tuples of names, and that there is a state."""
    for field in ("states", "inputs", "disturbances"):
        names = cast("object", getattr(dynamics, field, None))
        if not isinstance(names, tuple) or not all(isinstance(n, str) for n in cast("tuple[object]", names)):
            raise DataError(f"{type(dynamics).__name__}.{field} is {names!r}; pass a tuple of names: ('theta [rad]',)")
    if not dynamics.states:
        raise DataError(f"{type(dynamics).__name__}.states is empty; name at least one state")


class Integrator(ABC):
    """A one-step method that turns ẋ = f(x, u) into x⁺ = F(x, u), with u constant over the step."""

    @abstractmethod
    def step(self, f: ca.Function, dt: float) -> ca.Function:
        """Return F of x⁺ = F(x, u) from f of ẋ = f(x, u), dt [s]."""


def check_integrator(given: object) -> None:
    """Raise a DataError for an object without the method `step` of an integrator."""
    how = "pass an integrator, as km.RK4()"
    checks.members(given, "the integrator", ("step",), how)
    checks.takes(cast("Integrator", given).step, "the integrator's step", 2, how)


@dataclass(frozen=True)
class Euler(Integrator):
    """x⁺ = x + dt f(x, u): order 1."""

    def step(self, f: ca.Function, dt: float) -> ca.Function:
        """Return F of x⁺ = F(x, u)."""
        x, u = cast("_Pair", _make_symbols(f))
        return _explicit_step(x, u, x + dt * f(x, u))


@dataclass(frozen=True)
class RK4(Integrator):
    """The classical Runge–Kutta method, explicit, of order 4 (Hairer, Nørsett & Wanner 1993, II.1).

    Parameters
    ----------
    substeps
        Equal steps in one sample, at least 1.
    """

    substeps: int = 1

    def __post_init__(self) -> None:
        checks.count(self.substeps, "substeps")

    def step(self, f: ca.Function, dt: float) -> ca.Function:
        """Return F of x⁺ = F(x, u)."""
        x, u = cast("_Pair", _make_symbols(f))
        x_next, h = x, dt / self.substeps
        for _ in range(self.substeps):
            k1 = f(x_next, u)
            k2 = f(x_next + h / 2 * k1, u)
            k3 = f(x_next + h / 2 * k2, u)
            k4 = f(x_next + h * k3, u)
            x_next = x_next + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return _explicit_step(x, u, x_next)


@dataclass(frozen=True)
class ImplicitMidpoint(Integrator):
    """x⁺ = x + dt f((x + x⁺)/2, u): order 2, symplectic (Hairer, Lubich & Wanner 2006, VI.4)."""

    def step(self, f: ca.Function, dt: float) -> ca.Function:
        """Return F of x⁺ = F(x, u)."""
        return _build_collocation(f, dt, 1)


@dataclass(frozen=True)
class Collocation(Integrator):
    """Collocation at Gauss points: order 2·degree, A-stable (Hairer & Wanner 1996, IV.5).

    Parameters
    ----------
    degree
        Number of Gauss points in one sample, at least 1.
    """

    degree: int = 3

    def __post_init__(self) -> None:
        checks.count(self.degree, "degree")

    def step(self, f: ca.Function, dt: float) -> ca.Function:
        """Return F of x⁺ = F(x, u)."""
        return _build_collocation(f, dt, self.degree)


@dataclass(frozen=True)
class CVODES(Integrator):
    """Variable order and step to the stated local tolerances, for stiff plants (Hindmarsh et al. 2005).

    Parameters
    ----------
    rtol, atol
        Relative tolerance, and absolute tolerance in the units of the states; both above zero.
    """

    rtol: float = 1e-9
    atol: float = 1e-9

    def __post_init__(self) -> None:
        checks.positive(self.rtol, "rtol")
        checks.positive(self.atol, "atol")

    def step(self, f: ca.Function, dt: float) -> ca.Function:
        """Return F of x⁺ = F(x, u)."""
        if not ca.has_integrator("cvodes"):
            raise DataError("this CasADi has no CVODES; use Collocation or RK4 with substeps")
        x, u = cast("_Pair", _make_symbols(f))
        options = {"reltol": self.rtol, "abstol": self.atol, "disable_internal_warnings": True}
        flow = ca.integrator("flow", "cvodes", {"x": x, "u": u, "ode": f(x, u)}, 0, dt, options)
        X, U = ca.MX.sym("x", x.size1()), ca.MX.sym("u", u.size1())
        return _implicit_step(X, U, flow(x0=X, u=U)["xf"])


def _build_collocation(f: ca.Function, dt: float, stages: int) -> ca.Function:
    """x⁺ = x + Σ bⱼ kⱼ with kᵢ = dt f(x + Σ aᵢⱼ kⱼ, u), solved by Newton and differentiated implicitly.

    The unknowns are kᵢ / s with s = 1 + |x| + |dt f(x, u)|. Newton's method stops when its step is small: one tolerance
    then suits all units. It also suits stiff plants, whose residual never falls to the rounding error of its terms.
    """
    a, b = gauss_legendre(stages)
    x, u = cast("_Pair", _make_symbols(f))
    nx = x.size1()
    slope = dt * f(x, u)
    scale = 1 + ca.fabs(x) + ca.fabs(slope)
    unknown = type(x).sym("k", nx, stages)
    K = unknown * ca.repmat(scale, 1, stages)
    rows = [unknown[:, i] - dt * f(x + K @ ca.DM(a[i]), u) / scale for i in range(stages)]
    residual = ca.Function("residual", [ca.vec(unknown), x, u], [ca.vertcat(*rows)])
    options = {"max_iter": 50, "abstol": 1e-15, "abstolStep": 1e-11}  # the last Newton step squares the error
    newton = ca.rootfinder("newton", "fast_newton", residual, options)
    start = ca.Function("start", [x, u], [ca.repmat(slope / scale, stages, 1), scale])
    X, U = ca.MX.sym("x", nx), ca.MX.sym("u", u.size1())
    guess, unit = start(X, U)
    K_solved = ca.reshape(newton(guess, X, U), nx, stages)
    return _implicit_step(X, U, X + unit * (K_solved @ ca.DM(b)))


def gauss_legendre(stages: int) -> tuple[Float[np.ndarray, "s s"], Float[np.ndarray, " s"]]:
    """Return Butcher's a (s, s) and b (s,) of Gauss–Legendre collocation.

    aᵢⱼ = bⱼ (cᵢ + ½ Σ_{k=1}^{s−1} P_k(σⱼ) (P_{k+1}(σᵢ) − P_{k−1}(σᵢ))) with σ = 2c − 1: the Lagrange
    basis written in Legendre polynomials, whose integrals are known.
    """
    sigma, weight = np.polynomial.legendre.leggauss(stages)
    P = np.polynomial.legendre.legvander(sigma, stages)
    k = np.arange(1, stages)
    b = weight / 2
    a = b * ((sigma[:, None] + 1) / 2 + 0.5 * (P[:, k + 1] - P[:, k - 1]) @ P[:, k].T)
    return a, b


def _make_symbols(f: ca.Function) -> tuple[_Symbol, _Symbol]:
    """Return x and u as scalars; as matrices where f is foreign code, which takes no scalar symbols."""
    kind: Any = ca.SX if f.is_a("SXFunction") else ca.MX
    return kind.sym("x", f.size1_in(0)), kind.sym("u", f.size1_in(1))


def _explicit_step(x: _Symbol, u: _Symbol, x_next: _Symbol) -> ca.Function:
    return ca.Function("F", [x, u], [x_next], ["x", "u"], ["x_next"], {"cse": True})


def _implicit_step(x: ca.MX, u: ca.MX, x_next: ca.MX) -> ca.Function:
    return ca.Function("F", [x, u], [x_next], ["x", "u"], ["x_next"])
