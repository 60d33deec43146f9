"""Faults: what breaks between plant and controller; frozen, composable, the same again for the same seed."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.limits import Interval
from koopmpc.errors import DataError
from koopmpc.loop.injection import Fault, Injection, Wiring


@dataclass(frozen=True, kw_only=True)
class _Windowed(Fault):
    """A fault of the steps begin ≤ k < end; without an end, of all from `begin` on."""

    begin: int = 0
    end: int | None = None

    def __post_init__(self) -> None:
        checks.count(self.begin, "begin", 0)
        if self.end is not None:
            checks.count(self.end, "end", self.begin + 1)

    def _at(self, k: int) -> bool:
        return self.begin <= k and (self.end is None or k < self.end)


@dataclass(frozen=True)
class NaNSensor(_Windowed):
    """y_k is NaN in `channels` (all by default), at each step of the window with `probability`."""

    channels: Sequence[int] | None = None
    probability: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _freeze(self)
        _share(self.probability, "probability")

    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return the sensor of one run."""
        return _NaNSensor(self, _picked(self.channels, wiring.ny), rng)


@dataclass(frozen=True)
class FrozenSensor(_Windowed):
    """`channels` of y_k (all by default) stay at what they showed at step `begin`, until `end`."""

    channels: Sequence[int] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _freeze(self)

    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return the sensor of one run."""
        return _FrozenSensor(self, _picked(self.channels, wiring.ny))


@dataclass(frozen=True)
class DroppedSamples(_Windowed):
    """A whole measurement is lost with `probability`; the controller gets the last one that arrived, unmarked.

    That is what a driver with a buffer does; y_0 always arrives. A driver that marks the loss is a NaNSensor.
    """

    probability: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _share(self.probability, "probability")

    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return the line of one run."""
        return _DroppedSamples(self, rng)


@dataclass(frozen=True)
class SensorDelay(Fault):
    """The controller gets y_{k−steps}; until that exists, y_0."""

    steps: int

    def __post_init__(self) -> None:
        checks.count(self.steps, "steps", 0)

    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return the line of one run."""
        return _SensorDelay(self.steps)


@dataclass(frozen=True)
class ActuatorLoss(_Windowed):
    """The actuator lost `fraction` of its range: u_k is clipped to c + (1 − fraction) [u_min − c, u_max − c].

    c is the input nearest to zero inside the limits: ±40 N becomes ±20 N, a valve of 0 … 1 becomes 0 … 0.5. The
    limits are those of the run; an input without one keeps its range. The controller is not told beforehand: it
    sees what was applied.
    """

    fraction: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _share(self.fraction, "fraction")

    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return the actuator of one run."""
        low, high = wiring.inputs
        if not (np.isfinite(low) | np.isfinite(high)).any():
            raise DataError(
                "ActuatorLoss takes a share of the input range, and there is none; pass limits= with u_min, u_max"
            )
        rest = np.clip(np.zeros(len(low)), low, high)
        kept = 1.0 - self.fraction

        def lost(limit: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nu"]:
            limited = np.isfinite(limit)
            return np.where(limited, rest + kept * (np.where(limited, limit, rest) - rest), limit)

        return _ActuatorLoss(self, Interval(lost(low), lost(high)))


@dataclass(frozen=True)
class ActuatorDelay(Fault):
    """The plant gets u_{k−steps}; until that exists, the input nearest to zero inside the limits."""

    steps: int

    def __post_init__(self) -> None:
        checks.count(self.steps, "steps", 0)

    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return the line of one run."""
        return _ActuatorDelay(self.steps, np.clip(np.zeros(len(wiring.inputs.low)), *wiring.inputs))


@dataclass(frozen=True)
class SolverFailure(_Windowed):
    """The solver's answer is lost with `probability`; the controller's own fallback takes over.

    The solver runs, and its answer is thrown away as FAILED: all that follows is the controller's real path. It
    has no effect on a step that asks no solver, nor on a controller without one, such as LQR.
    """

    probability: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _share(self.probability, "probability")

    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return the solver's luck in one run."""
        return _SolverFailure(self, rng)


class _NaNSensor(Injection):
    def __init__(self, fault: NaNSensor, channels: list[int], rng: np.random.Generator) -> None:
        self._fault, self._channels, self._rng = fault, channels, rng

    def measured(self, k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
        if self._rng.random() < self._fault.probability and self._fault._at(k):
            y = y.copy()
            y[self._channels] = np.nan
        return y


class _FrozenSensor(Injection):
    def __init__(self, fault: FrozenSensor, channels: list[int]) -> None:
        self._fault, self._channels = fault, channels
        self._frozen: Float[np.ndarray, " n"] | None = None

    def measured(self, k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
        if not self._fault._at(k):
            return y
        y = y.copy()
        if self._frozen is None:
            self._frozen = y[self._channels]
        y[self._channels] = self._frozen
        return y


class _DroppedSamples(Injection):
    def __init__(self, fault: DroppedSamples, rng: np.random.Generator) -> None:
        self._fault, self._rng = fault, rng
        self._last: Float[np.ndarray, " ny"] | None = None

    def measured(self, k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
        lost = self._rng.random() < self._fault.probability and self._fault._at(k)
        if self._last is None or not lost:
            self._last = y.copy()
        return self._last.copy()


class _SensorDelay(Injection):
    def __init__(self, steps: int) -> None:
        self._line: deque[Float[np.ndarray, " ny"]] = deque(maxlen=steps + 1)

    def measured(self, k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
        self._line.append(y.copy())
        return self._line[0].copy()


class _ActuatorLoss(Injection):
    def __init__(self, fault: ActuatorLoss, box: Interval) -> None:
        self._fault, self._box = fault, box

    def applied(self, k: int, u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nu"]:
        return np.clip(u, *self._box) if self._fault._at(k) else u


class _ActuatorDelay(Injection):
    def __init__(self, steps: int, rest: Float[np.ndarray, " nu"]) -> None:
        self._line: deque[Float[np.ndarray, " nu"]] = deque([rest] * steps, maxlen=steps + 1)

    def applied(self, k: int, u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nu"]:
        self._line.append(u.copy())
        return self._line[0].copy()


class _SolverFailure(Injection):
    def __init__(self, fault: SolverFailure, rng: np.random.Generator) -> None:
        self._fault, self._rng = fault, rng

    def solver_fails(self, k: int) -> bool:
        return self._rng.random() < self._fault.probability and self._fault._at(k)


def _share(value: float, name: str) -> None:
    if not 0.0 <= float(checks.array(value, name, ())) <= 1.0:
        raise DataError(f"{name} is {value:g}; it must be between 0 and 1")


def _freeze(fault: NaNSensor | FrozenSensor) -> None:
    """Make the channels a tuple, so that the fault stays what it is."""
    if fault.channels is not None:
        object.__setattr__(fault, "channels", tuple(checks.count(i, "channels", 0) for i in fault.channels))


def _picked(channels: Sequence[int] | None, ny: int) -> list[int]:
    picked = list(range(ny)) if channels is None else list(channels)
    outside = [i for i in picked if not 0 <= i < ny]
    if outside:
        raise DataError(f"channels holds {outside[0]}; pass indices of measurements, 0 to {ny - 1}")
    return picked
