"""Plants that run: the protocol that `simulate` and `collect` use, a step map with a state, and black-box functions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.scene import Scene
from koopmpc.base.values import Named
from koopmpc.plants.dynamics import Dynamics

StepFunction = Callable[[Float[np.ndarray, " nx"], Float[np.ndarray, " nu"]], ArrayLike]
MeasureFunction = Callable[[Float[np.ndarray, " nx"]], ArrayLike]


class Sampled(Protocol):
    """An object with a sample time, and with names of its states, inputs and outputs."""

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

    Two more members are optional. `ended` is a text: empty while the episode goes on, then the reason why the plant
    ended it. `scene` is a function scene(x, u) → shapes for the animation in the logs.
    """

    @property
    def state(self) -> np.ndarray | None:
        """The true x (nx,), or None if it is hidden."""
        ...

    def reset(self, x0: ArrayLike | None, rng: np.random.Generator | int) -> np.ndarray:
        """Begin an episode at x0 (nx,), or without x0 in the plant's present state, and return y (ny,)."""
        ...

    def step(self, u: ArrayLike) -> np.ndarray:
        """Hold u (nu,) for dt and return the new y (ny,)."""
        ...


def require_plant(plant: object) -> None:
    """Raise a DataError that names the missing member if `plant` is not a Plant."""
    if isinstance(plant, Dynamics):
        raise DataError(
            f"the plant is {type(plant).__name__}, ẋ = f(x, u) without a sample time; discretize it first: "
            "km.discretize(dynamics, dt)"
        )
    advice = (
        "a Plant has dt [s], states, inputs and outputs (names), state (x, or None if it is hidden), "
        "reset(x0, rng) -> y and step(u) -> y; or pass a StepMap, or km.black_box(f, dt=…, states=…, inputs=…) of "
        "a function x⁺ = f(x, u)"
    )
    needed = ("dt", "states", "inputs", "outputs", "state", "reset", "step")
    checks.members(plant, "the plant", needed, advice)


def read_measurement(value: object, ny: int | None, k: int) -> Float[np.ndarray, " ny"]:
    """Return the measurement of a plant at step k as a new array."""
    try:
        y = None if value is None else np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        y = None
    if y is None:
        raise DataError(
            f"the plant returned {type(value).__name__} at step {k}; reset and step must return y, one number an output"
        )
    if y.ndim != 1 or (ny is not None and len(y) != ny):
        expected = "(ny,)" if ny is None else f"({ny},), as at reset"
        raise ShapeError(f"the plant returned y of shape {y.shape} at step {k}, expected {expected}")
    return y


@runtime_checkable
class Transition(Sampled, Protocol):
    """The members of a step map x⁺ = F(x, u), y = h(x) that a `SimulatedPlant` uses."""

    @property
    def nx(self) -> int:
        """Number of states."""
        ...

    @property
    def scene(self) -> Scene | None:
        """scene(x, u) → shapes, or None."""
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
            step_map, "the step map", ("dt", "nx", "measure"), "discretize dynamics; pass a Plant without a wrapper"
        )
        if getattr(step_map, "nw", 0):
            raise DataError(
                "the map has measured disturbances: pass it to simulate or collect as it is, with measured="
            )
        self.step_map, self.dt, self.scene = step_map, step_map.dt, step_map.scene
        self.states, self.inputs, self.outputs = step_map.states, step_map.inputs, step_map.outputs
        self._x: Float[np.ndarray, " nx"] | None = None

    @property
    def state(self) -> Float[np.ndarray, " nx"] | None:
        """A copy of x (nx,); None before the first `reset`."""
        return None if self._x is None else self._x.copy()

    def reset(self, x0: ArrayLike | None, rng: np.random.Generator | int = 0) -> Float[np.ndarray, " ny"]:
        """Set the state to x0 (nx,) and return y (ny,); `rng` is not used, because nothing here is random."""
        if x0 is None:
            raise DataError("a simulated plant has no present state to begin in; pass x0")
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


def black_box(
    step: StepFunction,
    *,
    dt: float,
    states: Sequence[str],
    inputs: Sequence[str],
    measure: MeasureFunction | None = None,
    outputs: Sequence[str] | None = None,
    scene: Scene | None = None,
) -> SimulatedPlant:
    """Return the plant x⁺ = step(x, u), y = measure(x), for `collect` and `simulate`.

    The function is called once a sample and may hold anything: another simulator, a table, compiled code. It gets
    copies of x (nx,) and u (nu,), and must depend on nothing else. For a plant that keeps its own state, such as
    hardware, pass an object with the members of `km.plants.Plant` instead.

    Parameters
    ----------
    step
        step(x, u) → x⁺, (nx,).
    dt
        Sample time [s].
    states, inputs
        Names with units: ``("theta [rad]", "omega [rad/s]")``; their numbers are nx and nu.
    measure
        measure(x) → y, (ny,); by default y = x.
    outputs
        Names of y; needed with `measure`, and only then.
    scene
        scene(x, u) → shapes, for the animation in the logs.

    Raises
    ------
    DataError
        `step` or `measure` cannot be called, dt is not above zero, or there is no state.
    ShapeError
        Later, where a function returns another number of values than there are names.

    Examples
    --------
    >>> import koopmpc as km
    >>> def tank(x, u):
    ...     return [x[0] + 0.5 * u[0] - 0.02 * max(x[0], 0.0) ** 0.5]
    ...
    >>> plant = km.black_box(tank, dt=1.0, states=["level [m]"], inputs=["inflow [m³/s]"])
    >>> km.collect(plant, km.Uniform(0.2, 2.0), km.Noise(0.0, 0.1), episodes=3, steps=10)[0].X.shape
    (11, 1)
    """
    for function, name in ((step, "step"), (measure, "measure")):
        if function is not None and not callable(function):
            raise DataError(f"{name} is {checks.article(function)}; pass a function")
    if (measure is None) != (outputs is None):
        raise DataError("measure and outputs belong together: pass the function and the names of y, or neither")
    states, inputs = checks.texts(states, "states"), checks.texts(inputs, "inputs")
    if not states:
        raise DataError("states is empty; name at least one state")
    named = tuple(checks.names(states, "states", "x", len(states)))
    return SimulatedPlant(
        BlackBox(
            function=step,
            dt=checks.positive(dt, "dt", "s"),
            states=named,
            inputs=checks.names(inputs, "inputs", "u", len(inputs)),
            outputs=named if outputs is None else checks.names(outputs, "outputs", "y", len(outputs)),
            output=measure,
            scene=scene,
        )
    )


@dataclass(frozen=True, eq=False)
class BlackBox(Named):
    """x⁺ = function(x, u), y = output(x), checked at every call; a `SimulatedPlant` remembers the state."""

    function: StepFunction
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    output: MeasureFunction | None
    scene: Scene | None

    def __call__(self, x: ArrayLike, u: ArrayLike) -> Float[np.ndarray, " nx"]:
        """x⁺ (nx,) from x (nx,) and u (nu,)."""
        state = checks.array(x, "x", (self.nx,), finite=False)
        move = checks.vector(u, "u", self.nu)
        return _check_result(self.function(state, move), "step(x, u)", self.states)

    def measure(self, x: ArrayLike) -> Float[np.ndarray, " ny"]:
        """Return y (ny,) from x (nx,)."""
        state = checks.array(x, "x", (self.nx,), finite=False)
        return state if self.output is None else _check_result(self.output(state), "measure(x)", self.outputs)


def _check_result(value: ArrayLike | None, what: str, names: tuple[str, ...]) -> Float[np.ndarray, " n"]:
    """Return what a user's function returned as a new vector; a scalar counts as one value."""
    if value is None:
        raise DataError(f"{what} returned None; return {len(names)} values: {', '.join(names)}")
    result = np.atleast_1d(checks.array(value, f"what {what} returned", finite=False))
    if result.shape != (len(names),):
        raise ShapeError(f"{what} returned shape {result.shape}, expected ({len(names)},): {', '.join(names)}")
    return result
