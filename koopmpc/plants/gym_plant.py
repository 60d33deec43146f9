# pyright: basic
"""GymPlant: a Gymnasium environment as a plant."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, install
from koopmpc.base.scene import Scene

try:
    import gymnasium
except ImportError as error:
    raise ImportError(f"GymPlant needs gymnasium, which is not installed: {install('gym')}") from error

_ROUNDING = 1e-5  # relative tolerance for actions and states, which many environments hold in float32


class GymPlant:
    """y = the observation after env.step(u): a Gymnasium environment for `collect` and `simulate`.

    The observation is both y and the state, because an environment shows nothing else. Rewards are not used. The
    environment decides when an episode ends: `ended` is then "terminated" or "truncated", and `collect` ends the
    episode or `simulate` the run. Only `reset` begins another episode. No pair of samples crosses an end.

    Parameters
    ----------
    env
        An environment, or its name for ``gymnasium.make``: "Pendulum-v1". Its observations and actions must be vectors
        (Box), not numbered actions.
    dt
        Sample time [s]; by default the attribute `dt` of the environment.
    states, inputs
        Names with units; by default x0, x1, … and u0, ….
    sin_cos
        Pairs of observations (sin θ, cos θ), by index. θ [rad] replaces the one with the lower index, and the other
        is left out. θ is continuous within an episode and starts between −π and π.
        ``km.plants.GymPlant("Pendulum-v1", sin_cos=[(1, 0)])`` has the states θ and its rate.
    start
        start(env, x0) puts the environment into x0. By default x0 is written into the positions and velocities of a
        MuJoCo environment, and into the attribute `state` of any other; the observation must then equal x0.
    scene
        scene(x, u) → shapes, for the animation in the logs.

    Raises
    ------
    DataError
        The environment's observations or actions are not vectors; its sample time is unknown; a pair of `sin_cos` does
        not name two observations.
    ShapeError
        There are more or fewer names than states or inputs.
    """

    def __init__(
        self,
        env: Any,
        *,
        dt: float | None = None,
        states: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        sin_cos: Sequence[tuple[int, int]] = (),
        start: Callable[[Any, Float[np.ndarray, " nx"]], object] | None = None,
        scene: Scene | None = None,
    ) -> None:
        try:
            self.env = gymnasium.make(env) if isinstance(env, str) else env
        except gymnasium.error.Error as error:
            raise DataError(f"Gymnasium makes no environment {env!r}: {error}") from None
        checks.kind(self.env, "env", gymnasium.Env, "pass an environment, or its name as a text")
        self._core: Any = self.env.unwrapped
        self._name = type(self._core).__name__ if self.env.spec is None else self.env.spec.id
        count = self._width("observation", self.env.observation_space)
        nu = self._width("action", self.env.action_space)
        self._pairs = [(int(s), int(c)) for s, c in sin_cos]
        used = [i for pair in self._pairs for i in pair]
        if len(set(used)) < len(used) or any(not 0 <= i < count for i in used):
            raise DataError(
                f"sin_cos is {list(sin_cos)}; pass pairs of different observations (sin, cos), from 0 to {count - 1}"
            )
        dropped = {max(pair) for pair in self._pairs}
        self._kept = [i for i in range(count) if i not in dropped]
        self.angles = tuple(self._kept.index(min(pair)) for pair in self._pairs)
        self.dt = self._sample_time() if dt is None else checks.positive(dt, "dt", "s")
        self.states = self.outputs = checks.names(states, "states", "x", len(self._kept))
        self.inputs = checks.names(inputs, "inputs", "u", nu)
        space: Any = self.env.action_space
        self.u_min, self.u_max = space.low.astype(np.float64), space.high.astype(np.float64)
        self.ended = "not started"
        self.scene, self._start = scene, start
        self._x: Float[np.ndarray, " nx"] | None = None

    @property
    def state(self) -> Float[np.ndarray, " nx"] | None:
        """A copy of the last observation (nx,); None before the first `reset`."""
        return None if self._x is None else self._x.copy()

    def reset(self, x0: ArrayLike | None, rng: np.random.Generator | int = 0) -> Float[np.ndarray, " nx"]:
        """Begin an episode at x0 (nx,) and return y (nx,); without x0 the environment draws its start by `rng`.

        Raises
        ------
        DataError
            The environment cannot be put into x0.
        """
        seed = int(checks.generator(rng).integers(2**31))
        observation, _ = self.env.reset(seed=seed)
        self._x, self.ended = None, ""
        if x0 is not None:
            wanted = checks.array(x0, "x0", (len(self.states),))
            observation = self._put(wanted)
            observed = self._convert(observation)
            error, angles = observed - wanted, list(self.angles)
            error[angles] = np.angle(np.exp(1j * error[angles]))
            if self._start is None and np.abs(error).max() > _ROUNDING * (1 + np.abs(wanted).max()):
                raise DataError(
                    f"{self._name} was put into x0 = {wanted}, but observes {observed}; pass start=function(env, x0), "
                    "or x0=None to begin where the environment does"
                )
            self._x = wanted  # the angles stay continuous with those of x0
        self._x = self._convert(observation)
        return self._x.copy()

    def step(self, u: ArrayLike) -> Float[np.ndarray, " nx"]:
        """Return y (nx,) after the action u (nu,).

        Raises
        ------
        DataError
            The episode has ended or never begun; u is outside `u_min` … `u_max`, which environments clip silently.
        """
        if self.ended:
            raise DataError(f"the episode of {self._name} has ended ({self.ended}); call reset(x0, rng) before step")
        action = checks.vector(u, "u", len(self.inputs))
        size = 1 + np.abs(action)
        if (action < self.u_min - _ROUNDING * size).any() or (action > self.u_max + _ROUNDING * size).any():
            raise DataError(
                f"u = {action} is beyond the actions of {self._name}, {self.u_min} to {self.u_max}; give the "
                "controller km.Limits(plant.u_min, plant.u_max), and keep the excitation inside them"
            )
        space = self.env.action_space
        observation, _, terminated, truncated, _ = self.env.step(
            np.clip(action, self.u_min, self.u_max).astype(space.dtype).reshape(space.shape)
        )
        self.ended = "terminated" if terminated else "truncated" if truncated else ""
        self._x = self._convert(observation)
        return self._x.copy()

    def _width(self, what: str, space: Any) -> int:
        """Return the number of values of a space."""
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise DataError(
                f"the {what}s of {self._name} are {space}; koopmpc needs vectors of real numbers, Box(…, (n,)). "
                "A wrapper such as gymnasium.wrappers.FlattenObservation makes vectors of some other observations"
            )
        return space.shape[0]

    def _sample_time(self) -> float:
        """Return the attribute dt of the environment; the classic and the MuJoCo environments have it."""
        dt = getattr(self._core, "dt", None)
        if dt is None:
            raise DataError(f"{self._name} does not tell its sample time; pass dt= in s")
        return checks.positive(dt, "dt", "s")

    def _convert(self, observation: Any) -> Float[np.ndarray, " nx"]:
        """Return the observation with angles in place of sines and cosines; each is near its value one step before."""
        y = np.array(observation, dtype=np.float64)
        x = y[self._kept]
        for place, (s, c) in zip(self.angles, self._pairs, strict=True):
            angle = np.arctan2(y[s], y[c])
            before = 0.0 if self._x is None else self._x[place]
            x[place] = angle + 2 * np.pi * np.round((before - angle) / (2 * np.pi))
        return x

    def _put(self, x0: Float[np.ndarray, " nx"]) -> Any:
        """Put the environment into x0 and return the observation that all of its wrappers make of it."""
        core = self._core
        if self._start is not None:
            self._start(self.env, x0.copy())
        elif hasattr(core, "set_state") and hasattr(core, "model") and core.model.nq + core.model.nv == len(x0):
            core.set_state(x0[: core.model.nq], x0[core.model.nq :])
        elif np.shape(getattr(core, "state", ())) == x0.shape:
            core.state = x0.copy()
        else:
            raise DataError(
                f"{self._name} does not tell how to begin at x0; pass start=function(env, x0), or x0=None to begin "
                "where the environment does"
            )
        observe = getattr(core, "_get_obs", None)
        observation = observe() if observe is not None else np.array(core.state)
        layers: list[Any] = []
        layer: Any = self.env
        while layer is not core:
            layers.append(layer)
            layer = layer.env
        for wrapper in reversed(layers):
            if isinstance(wrapper, gymnasium.ObservationWrapper):
                observation = wrapper.observation(observation)
        return observation
