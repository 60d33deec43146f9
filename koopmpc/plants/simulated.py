"""Plants that hold their state: what hardware offers, and a step map in its place."""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError
from koopmpc.plants.dynamics import Dynamics
from koopmpc.plants.step_map import StepMap


@runtime_checkable
class Plant(Protocol):
    """What `simulate` and `collect` drive: hardware, another simulator, or a `SimulatedPlant`."""

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

    @property
    def state(self) -> np.ndarray | None:
        """The true x (nx,), where it can be known."""
        ...

    def reset(self, x0: ArrayLike, rng: np.random.Generator | int) -> np.ndarray:
        """Go to x0 (nx,) and return y (ny,)."""
        ...

    def step(self, u: ArrayLike) -> np.ndarray:
        """Hold u (nu,) for dt and return the new y (ny,)."""
        ...


def require_plant(plant: object) -> None:
    """Raise where `plant` cannot be driven, naming what it lacks."""
    if isinstance(plant, Dynamics):
        raise DataError(
            f"the plant is {type(plant).__name__}, ẋ = f(x, u) without a sample time; discretize it first: "
            "km.discretize(dynamics, dt)"
        )
    advice = (
        "a Plant has dt [s], states, inputs and outputs (names), state (x, or None where it is hidden), "
        "reset(x0, rng) -> y and step(u) -> y; or pass a StepMap"
    )
    needed = ("dt", "states", "inputs", "outputs", "state", "reset", "step")
    checks.members(plant, "the plant", needed, advice)


class SimulatedPlant:
    """x⁺ = F(x, u) + w, y = h(x): a `StepMap` that remembers its state."""

    def __init__(self, step_map: StepMap) -> None:
        self.step_map = step_map
        self._x: Float[np.ndarray, " nx"] | None = None

    @property
    def dt(self) -> float:
        """Sample time [s]."""
        return self.step_map.dt

    @property
    def states(self) -> tuple[str, ...]:
        """Names of x."""
        return self.step_map.states

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of u."""
        return self.step_map.inputs

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of y."""
        return self.step_map.outputs

    @property
    def state(self) -> Float[np.ndarray, " nx"] | None:
        """A copy of x (nx,); None before the first `reset`."""
        return None if self._x is None else self._x.copy()

    def reset(self, x0: ArrayLike, rng: np.random.Generator | int = 0) -> Float[np.ndarray, " ny"]:
        """Go to x0 (nx,) and return y (ny,); nothing here is random, `rng` is the protocol's."""
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
