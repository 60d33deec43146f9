"""black_box: a plant from a function x⁺ = step(x, u), whatever is behind it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError, ShapeError
from koopmpc.plants.step_map import SimulatedPlant
from koopmpc.scene import Scene
from koopmpc.values import Named

StepFunction = Callable[[Float[np.ndarray, " nx"], Float[np.ndarray, " nu"]], ArrayLike]
MeasureFunction = Callable[[Float[np.ndarray, " nx"]], ArrayLike]


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
    copies of x (nx,) and u (nu,), and must depend on nothing else. A plant with a state of its own, such as hardware,
    is any object with the members of `km.Plant` instead.

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
            raise DataError(f"{name} is a {type(function).__name__}; pass a function")
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
        return _returned(self.function(state, move), "step(x, u)", self.states)

    def measure(self, x: ArrayLike) -> Float[np.ndarray, " ny"]:
        """Return y (ny,) from x (nx,)."""
        state = checks.array(x, "x", (self.nx,), finite=False)
        return state if self.output is None else _returned(self.output(state), "measure(x)", self.outputs)


def _returned(value: ArrayLike | None, what: str, names: tuple[str, ...]) -> Float[np.ndarray, " n"]:
    """Return what a function gave as a vector of its own; a scalar is one value."""
    if value is None:
        raise DataError(f"{what} returned None; return {len(names)} values: {', '.join(names)}")
    result = np.atleast_1d(checks.array(value, f"what {what} returned", finite=False))
    if result.shape != (len(names),):
        raise ShapeError(f"{what} returned shape {result.shape}, expected ({len(names)},): {', '.join(names)}")
    return result
