"""The discrete-time plant x⁺ = F(x, u), y = h(x): immutable, and as a plant that remembers its state."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError, ShapeError
from koopmpc.plants.batch import Batch, march, warn_of
from koopmpc.plants.dynamics import Dynamics, Sampled, drawn_by, output, right_side
from koopmpc.plants.integrators import RK4, Integrator
from koopmpc.plants.routines import Buffered, dense
from koopmpc.scene import Scene
from koopmpc.values import Named, Value, freeze


@dataclass(frozen=True, eq=False)
class Affine(Value):
    """x⁺ ≈ A x + B u + c: A (nx, nx), B (nx, nu), c (nx,)."""

    A: Float[np.ndarray, "nx nx"]
    B: Float[np.ndarray, "nx nu"]
    c: Float[np.ndarray, " nx"]


@dataclass(frozen=True, eq=False, init=False)
class StepMap(Named):
    """x⁺ = F(x, u), y = h(x), one sample of dt [s].

    Parameters
    ----------
    F
        CasADi function of x (nx) and u (nu, may be 0) that returns x⁺ (nx). Made of SX it runs in batches.
    dt
        Sample time [s].
    h
        CasADi function of x that returns y (ny); by default y = x.
    states, inputs, outputs
        Names with units; by default x0, x1, …; u0, …; and the states' names or y0, ….
    scene
        scene(x, u) → shapes, for the animation in the logs; pickling leaves it out.

    Raises
    ------
    ShapeError
        F or h takes or returns other shapes, or there are more or fewer names than rows.
    DataError
        dt is not above zero.
    """

    F: ca.Function
    h: ca.Function
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    scene: Scene | None = field(default=None, compare=False)

    def __init__(
        self,
        F: ca.Function,
        dt: float,
        h: ca.Function | None = None,
        states: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
        scene: Scene | None = None,
    ) -> None:
        _check_signature(F, "F", 2)
        nx, nu = F.size1_in(0), F.size1_in(1)
        if F.size1_out(0) != nx:
            raise ShapeError(f"F returns {F.size1_out(0)} rows, expected {nx}, one a state")
        if h is None:
            x = ca.SX.sym("x", nx)
            h = ca.Function("h", [x], [x], ["x"], ["y"])
            outputs = checks.names(states, "states", "x", nx) if outputs is None else outputs
        _check_signature(h, "h", 1)
        if h.size1_in(0) != nx:
            raise ShapeError(f"h takes {h.size1_in(0)} states, F has {nx}; pass h of the same x")
        freeze(
            self,
            F=dense(F),
            h=dense(h),
            dt=checks.positive(dt, "dt", "s"),
            states=checks.names(states, "states", "x", nx),
            inputs=checks.names(inputs, "inputs", "u", nu),
            outputs=checks.names(outputs, "outputs", "y", h.size1_out(0)),
            scene=scene,
        )

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.outputs)

    def __call__(self, x: ArrayLike, u: ArrayLike) -> Float[np.ndarray, " nx"]:
        """x⁺ = F(x, u): (nx,) from x (nx,) and u (nu,).

        NaN passes through; where an implicit method finds no x⁺ the answer is NaN, with a RuntimeWarning.
        """
        x, u = _vector(x, "x", len(self.states)), _vector(u, "u", len(self.inputs))
        x_next = np.empty(self.nx)
        self.advance(x, u, x_next)
        return x_next

    def advance(
        self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"], x_next: Float[np.ndarray, " nx"]
    ) -> None:
        """Write F(x, u) into `x_next`, as a call returns it, but without looking at the arguments."""
        step = self._step
        x_place, u_place = step.arguments
        x_place[:], u_place[:] = x, u
        try:
            step.evaluate()
        except RuntimeError as error:
            warn_of(error, x, u)
            x_next[:] = np.nan
        else:
            x_next[:] = step.results[0]

    def measure(self, x: ArrayLike) -> Float[np.ndarray, " ny"]:
        """Return y = h(x): (ny,) from x (nx,)."""
        if self.measures_all:
            return _vector(x, "x", len(self.states)).copy()
        output = self._output
        output.arguments[0][:] = _vector(x, "x", len(self.states))
        output.evaluate()
        return output.results[0].copy()

    def rollout(self, x0: ArrayLike, U: ArrayLike) -> Float[np.ndarray, "steps nx"]:
        """x_{k+1} = F(x_k, u_k): X (T+1, nx) from x0 (nx,) and U (T, nu); the bits of T single calls."""
        start = checks.array(x0, "x0", (self.nx,))
        moves = checks.array(U, "U", (None, self.nu))
        X = np.empty((len(moves) + 1, self.nx))
        X[0] = start
        march(self._step, X, moves)
        return X

    def rollouts(self, X0: ArrayLike, U: ArrayLike) -> Float[np.ndarray, "episodes steps nx"]:
        """x_{k+1} = F(x_k, u_k) for E episodes at once: X (E, T+1, nx) from X0 (E, nx) and U (E, T, nu)."""
        starts = checks.array(X0, "X0", (None, self.nx))
        moves = checks.array(U, "U", (len(starts), None, self.nu))
        X = np.empty((len(starts), moves.shape[1] + 1, self.nx))
        X[:, 0] = starts
        self._batch.fill(X, moves)
        return X

    def linearize(self, x: ArrayLike, u: ArrayLike) -> Affine:
        """x⁺ ≈ A x + B u + c about (x*, u*): A = ∂F/∂x, B = ∂F/∂u exactly, c = F(x*, u*) − A x* − B u*."""
        x, u = checks.array(x, "x", (self.nx,)), checks.vector(u, "u", self.nu)
        x_next, columns_A, columns_B = self._jacobians(x, u)
        A = np.ascontiguousarray(columns_A.reshape(self.nx, self.nx).T)
        B = np.ascontiguousarray(columns_B.reshape(self.nu, self.nx).T)
        return Affine(A, B, x_next - A @ x - B @ u)

    @cached_property
    def _step(self) -> Buffered:
        return Buffered(self.F)

    @cached_property
    def _batch(self) -> Batch:
        return Batch(self._step)

    @cached_property
    def measures_all(self) -> bool:
        """Whether y = x."""
        x = ca.SX.sym("x", self.nx)
        return self.ny == self.nx and self.h.is_a("SXFunction") and ca.is_equal(self.h(x), x, 1)

    @cached_property
    def _output(self) -> Buffered:
        return Buffered(self.h)

    @cached_property
    def _jacobians(self) -> Buffered:
        x, u = ca.MX.sym("x", self.nx), ca.MX.sym("u", self.nu)
        x_next = self.F(x, u)
        A, B = ca.densify(ca.jacobian(x_next, x)), ca.densify(ca.jacobian(x_next, u))
        together = ca.Function("linearize", [x, u], [x_next, A, B])
        return Buffered(together.expand("linearize", {"cse": True}) if self.F.is_a("SXFunction") else together)

    def __getstate__(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "scene"}


@runtime_checkable
class Transition(Sampled, Protocol):
    """x⁺ = F(x, u), y = h(x): what a `SimulatedPlant` needs of a step map."""

    @property
    def nx(self) -> int:
        """Number of states."""
        ...

    @property
    def scene(self) -> Scene | None:
        """scene(x, u) → shapes, None where there is none."""
        ...

    def __call__(self, x: ArrayLike, u: ArrayLike) -> Float[np.ndarray, " nx"]:
        """x⁺ = F(x, u)."""
        ...

    def measure(self, x: ArrayLike) -> Float[np.ndarray, " ny"]:
        """Return y = h(x)."""
        ...


class SimulatedPlant:
    """x⁺ = F(x, u) + w, y = h(x): a `StepMap`, or the map of a `black_box`, that remembers its state."""

    def __init__(self, step_map: Transition) -> None:
        checks.members(
            step_map, "the step map", ("dt", "nx", "measure"), "discretize dynamics; a Plant is one as it is"
        )
        self.step_map, self.dt, self.scene = step_map, step_map.dt, step_map.scene
        self.states, self.inputs, self.outputs = step_map.states, step_map.inputs, step_map.outputs
        self._x: Float[np.ndarray, " nx"] | None = None

    @property
    def state(self) -> Float[np.ndarray, " nx"] | None:
        """A copy of x (nx,); None before the first `reset`."""
        return None if self._x is None else self._x.copy()

    def reset(self, x0: ArrayLike | None, rng: np.random.Generator | int = 0) -> Float[np.ndarray, " ny"]:
        """Go to x0 (nx,) and return y (ny,); nothing here is random, `rng` is the protocol's."""
        if x0 is None:
            raise DataError("a simulated plant has no state of its own to begin in; pass x0")
        self._x = checks.array(x0, "x0", (self.step_map.nx,))
        return self.step_map.measure(self._x)

    def step(self, u: ArrayLike, disturbance: ArrayLike | None = None) -> Float[np.ndarray, " ny"]:
        """Return y (ny,) after x ← F(x, u) + `disturbance` (nx,).

        Raises
        ------
        DataError
            The plant was never reset.
        ShapeError
            u or the disturbance has another shape.
        """
        if self._x is None:
            raise DataError("the plant has no state yet; call reset(x0, rng) before step")
        x_next = self.step_map(self._x, u)
        if disturbance is not None:
            x_next += checks.array(disturbance, "disturbance", (self.step_map.nx,))
        self._x = x_next
        return self.step_map.measure(x_next)


def discretize(dynamics: Dynamics, dt: float, integrator: Integrator = RK4()) -> StepMap:  # noqa: B008
    """Return x⁺ = F(x, u) of ẋ = f(x, u) over one sample, u held.

    Parameters
    ----------
    dynamics
        ẋ = f(x, u), y = h(x), with the names of states and inputs.
    dt
        Sample time [s].
    integrator
        Euler, RK4, ImplicitMidpoint, Collocation or CVODES.

    Raises
    ------
    DataError
        dt is not above zero.
    ShapeError
        `dynamics.rhs` returns another number of rows than there are states.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> plant([0.1, 0.0], [0.0]).round(4)  # one step; plant.rollout(x0, U) takes many
    array([0.1006, 0.0245])
    >>> plant.linearize([0.0, 0.0], [0.0]).B.round(4)
    array([[0.0003],
           [0.0125]])
    """
    checks.positive(dt, "dt", "s")
    F = integrator.step(right_side(dynamics), dt)
    h, outputs = output(dynamics)
    return StepMap(F, dt, h, dynamics.states, dynamics.inputs, outputs, drawn_by(dynamics))


def _vector(value: ArrayLike, name: str, length: int) -> Float[np.ndarray, " n"]:
    """Return `value` as float64 (length,): itself where it is one, for this is the control path."""
    if type(value) is np.ndarray and value.dtype == np.float64 and value.shape == (length,):
        return value
    result = checks.array(value, name, finite=False)
    return (
        result.reshape(1) if result.ndim == 0 and length == 1 else checks.array(result, name, (length,), finite=False)
    )


def _check_signature(function: ca.Function, name: str, arguments: int) -> None:
    checks.members(function, name, ("n_in", "n_out"), "pass a casadi Function")
    wanted = "(x, u)" if arguments == 2 else "(x)"
    if function.n_in() != arguments or function.n_out() != 1:
        raise ShapeError(
            f"{name} has {function.n_in()} arguments and {function.n_out()} results, "
            f"expected {name}{wanted} with one result"
        )
    sizes = [function.size2_in(i) for i in range(arguments) if function.size1_in(i)] + [function.size2_out(0)]
    if any(columns != 1 for columns in sizes):
        raise ShapeError(f"{name} is {function}, expected columns: {name}{wanted} with one column each")
