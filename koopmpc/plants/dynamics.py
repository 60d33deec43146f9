"""Continuous-time models ẋ = f(x, u), y = h(x), written in CasADi operations; the protocol of a plant that runs."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Protocol, cast, runtime_checkable

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError, ShapeError
from koopmpc.scene import Scene, Shape
from koopmpc.values import Named


class Dynamics(Named, ABC):
    """A plant ẋ = f(x, u), y = h(x): a frozen dataclass whose fields are the parameters, with units.

    `states` and `inputs` name the rows of x and u, unit included: ``("theta [rad]", "omega [rad/s]")``.

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

    @abstractmethod
    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = f(x, u): (nx, 1) from x (nx, 1) and u (nu, 1)."""

    def measure(self, x: ca.SX) -> ca.SX:
        """Return y = h(x): (ny, 1) from x (nx, 1); the whole state unless overridden."""
        return x

    def scene(self, x: np.ndarray, u: np.ndarray) -> Sequence[Shape] | None:
        """Return the shapes that draw x (nx,) and u (nu,), always with the same names; None: nothing is drawn."""
        return None


class Sampled(Protocol):
    """What has a sample time, and names for its states, inputs and outputs."""

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        ...

    @property
    def states(self) -> tuple[str, ...]:
        """Names of x, with units."""
        ...

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of u, with units."""
        ...

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of y, with units."""
        ...


@runtime_checkable
class Plant(Sampled, Protocol):
    """A plant that `simulate` and `collect` drive: hardware, another simulator, or a `SimulatedPlant`.

    Two members more are used where a plant has them: `ended`, a text that is empty until the plant itself ends the
    episode and then says why, and `scene`, scene(x, u) → shapes for the animation in the logs.
    """

    @property
    def state(self) -> np.ndarray | None:
        """The true x (nx,), where it can be known."""
        ...

    def reset(self, x0: ArrayLike | None, rng: np.random.Generator | int) -> np.ndarray:
        """Go to x0 (nx,), or begin where the plant is when it is None, and return y (ny,)."""
        ...

    def step(self, u: ArrayLike) -> np.ndarray:
        """Hold u (nu,) for dt and return the new y (ny,)."""
        ...


def require_plant(plant: object) -> None:
    """Raise a DataError that names the missing member where `plant` is no Plant."""
    if isinstance(plant, Dynamics):
        raise DataError(
            f"the plant is {type(plant).__name__}, ẋ = f(x, u) without a sample time; discretize it first: "
            "km.discretize(dynamics, dt)"
        )
    advice = (
        "a Plant has dt [s], states, inputs and outputs (names), state (x, or None where it is hidden), "
        "reset(x0, rng) -> y and step(u) -> y; or pass a StepMap, or km.black_box(f, dt=…, states=…, inputs=…) of "
        "a function x⁺ = f(x, u)"
    )
    needed = ("dt", "states", "inputs", "outputs", "state", "reset", "step")
    checks.members(plant, "the plant", needed, advice)


def reading(value: object, ny: int | None, k: int) -> Float[np.ndarray, " ny"]:
    """Return what a plant measured at step k as an array of its own."""
    try:
        y = None if value is None else np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        y = None
    if y is None:
        raise DataError(
            f"the plant returned {type(value).__name__} at step {k}; reset and step return y, a number each"
        )
    if y.ndim != 1 or (ny is not None and len(y) != ny):
        expected = "(ny,)" if ny is None else f"({ny},), as at reset"
        raise ShapeError(f"the plant returned y of shape {y.shape} at step {k}, expected {expected}")
    return y


def drawn_by(dynamics: Dynamics) -> Scene | None:
    """Return the scene of `dynamics`; None where its class draws none."""
    draw = dynamics.scene
    return None if type(dynamics).scene is Dynamics.scene else lambda x, u: draw(x, u) or ()


def right_side(dynamics: Dynamics) -> ca.Function:
    """Return f of ẋ = f(x, u) as a CasADi function of x (nx) and u (nu).

    Raises
    ------
    ShapeError
        `rhs` returns another number of rows than there are states.
    DataError
        `rhs` returns no CasADi expression, or one with symbols other than x and u.
    """
    checks.members(dynamics, "dynamics", ("states", "inputs", "rhs"), "pass one of your subclass of km.Dynamics")
    _check_names(dynamics)
    x, u = ca.SX.sym("x", dynamics.nx), ca.SX.sym("u", dynamics.nu)
    value = _expression(dynamics.rhs(x, u), f"{type(dynamics).__name__}.rhs", ca.vertcat(x, u), dynamics.nx)
    return ca.Function("f", [x, u], [value], ["x", "u"], ["dx"])


def output(dynamics: Dynamics) -> tuple[ca.Function, tuple[str, ...]]:
    """Return h of y = h(x), and the names of y: a state's own name where h passes that state on."""
    _check_names(dynamics)
    x = ca.SX.sym("x", dynamics.nx)
    value = _expression(dynamics.measure(x), f"{type(dynamics).__name__}.measure", x)
    names: list[str] = []
    states = [(name, x[j]) for j, name in enumerate(dynamics.states)]
    for i in range(value.size1()):
        measured = value[i]
        passed = [name for name, state in states if ca.is_equal(measured, state)]
        names.append(passed[0] if passed else f"y{i}")
    return ca.Function("h", [x], [value], ["x"], ["y"]), tuple(names)


def _expression(value: object, name: str, known: ca.SX, rows: int | None = None) -> ca.SX:
    """Return the value as a dense column; raise where it is no expression, or holds symbols other than `known`."""
    if not isinstance(value, ca.SX | ca.DM):
        raise DataError(f"{name} returned a {type(value).__name__}; return one column, ca.vertcat(...)")
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
    for field in ("states", "inputs"):
        names = cast("object", getattr(dynamics, field, None))
        if not isinstance(names, tuple) or not all(isinstance(n, str) for n in cast("tuple[object]", names)):
            raise DataError(f"{type(dynamics).__name__}.{field} is {names!r}; pass a tuple of names: ('theta [rad]',)")
    if not dynamics.states:
        raise DataError(f"{type(dynamics).__name__}.states is empty; name at least one state")
