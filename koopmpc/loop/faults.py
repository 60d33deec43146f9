"""Faults: what breaks between plant and controller; frozen, composable, and equal for equal seeds."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.control.ask.limits import Interval

__all__ = [
    "ActuatorDelay",
    "ActuatorLoss",
    "DroppedSamples",
    "Fault",
    "FrozenSensor",
    "Injection",
    "Injections",
    "NaNSensor",
    "SensorDelay",
    "SolverFailure",
    "Wiring",
]


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__


class Wiring(NamedTuple):
    """The facts of the loop that a fault may use: the number of measurements, and the input limits."""

    ny: int
    inputs: Interval


class Injection:
    """The effect of one fault in one run: functions of the step k in place of these methods, which change nothing.

    Each is called once a step, for k = 0, 1, 2, … in order. Pass functions, or override the methods in a subclass.
    """

    def __init__(
        self,
        *,
        measured: Callable[[int, Float[np.ndarray, " ny"]], Float[np.ndarray, " ny"]] | None = None,
        applied: Callable[[int, Float[np.ndarray, " nu"]], Float[np.ndarray, " nu"]] | None = None,
        solver_fails: Callable[[int], bool] | None = None,
    ) -> None:
        given = {"measured": measured, "applied": applied, "solver_fails": solver_fails}
        self.__dict__.update({name: function for name, function in given.items() if function is not None})

    def measured(self, k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
        """Return the measurement that the controller gets in place of y_k; y itself is not written to."""
        return y

    def applied(self, k: int, u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nu"]:
        """Return the input that the plant gets in place of the controller's u_k; u itself is not written to."""
        return u

    def solver_fails(self, k: int) -> bool:
        """Return True where the controller's solver loses its answer at step k."""
        return False


class Fault(ABC):
    """A fault in a loop; subclass as a frozen dataclass. A fault holds no state and serves any number of runs."""

    @abstractmethod
    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return this fault's part in one run, at its beginning.

        Raises
        ------
        DataError
            The fault does not fit the loop.
        """


class Injections(Injection):
    """All faults of one run; a signal passes through them in order.

    Each fault gets a generator of its own, spawned from `rng`, which is not advanced.
    """

    def __init__(self, faults: Sequence[Fault], wiring: Wiring, rng: np.random.Generator) -> None:
        if isinstance(cast(object, faults), Fault):
            raise DataError(f"faults is {faults}; pass a list of faults, for example faults=[{faults}]")
        checks.kind(faults, "faults", (tuple, list), "pass a list of faults")
        for fault in faults:
            if not isinstance(cast(object, fault), Fault):
                raise DataError(f"faults holds {fault!r}; pass objects, for example faults=[km.faults.NaNSensor()]")
        checks.kind(rng, "rng", np.random.Generator, "pass numpy.random.default_rng(seed)")
        self._parts = [fault.start(wiring, own) for fault, own in zip(faults, rng.spawn(len(faults)), strict=True)]

    def measured(self, k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
        """Return y_k after all faults."""
        for part in self._parts:
            y = part.measured(k, y)
        return y

    def applied(self, k: int, u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nu"]:
        """Return u_k after all faults, and raise where they made it infinite, NaN, or of another shape."""
        got = u
        for part in self._parts:
            got = part.applied(k, got)
        if np.shape(got) != np.shape(u) or not np.isfinite(got).all():
            raise DataError(f"the faults made u = {got} of u = {u} at step {k}; they must keep it finite")
        return got

    def solver_fails(self, k: int) -> bool:
        """Return True where any fault makes the solver fail; all are asked, so that each draws its own numbers."""
        failing = [part.solver_fails(k) for part in self._parts]
        return any(failing)


@dataclass(frozen=True, kw_only=True)
class _Windowed(Fault):
    """A fault of the steps begin ≤ k < end; without an end, of all from `begin` on."""

    begin: int = 0
    end: int | None = None

    def __post_init__(self) -> None:
        checks.count(self.begin, "begin", 0)
        if self.end is not None:
            checks.count(self.end, "end", self.begin + 1)
        for name in ("probability", "fraction"):
            share = getattr(self, name, 0.0)
            if not 0.0 <= (share := float(checks.array(share, name, ()))) <= 1.0:
                raise DataError(f"{name} is {share:g}; it must be between 0 and 1")
        channels: Sequence[int] | None = getattr(self, "channels", None)
        if channels is not None:
            checks.kind(channels, "channels", (tuple, list, range, np.ndarray), "pass a list of indices")
            # kept as a tuple, so that nobody changes the fault afterwards
            object.__setattr__(self, "channels", tuple(checks.count(i, "channels", 0) for i in channels))

    def _at(self, k: int) -> bool:
        return self.begin <= k and (self.end is None or k < self.end)


@dataclass(frozen=True)
class NaNSensor(_Windowed):
    """y_k is NaN in `channels` (all by default), at each step of the window with `probability`."""

    channels: Sequence[int] | None = None
    probability: float = 1.0

    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return the sensor of one run."""
        channels = _check_channels(self.channels, wiring.ny)

        def drop(k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
            if rng.random() < self.probability and self._at(k):
                y = y.copy()
                y[channels] = np.nan
            return y

        return Injection(measured=drop)


@dataclass(frozen=True)
class FrozenSensor(_Windowed):
    """`channels` of y_k (all by default) stay at what they showed at step `begin`, until `end`."""

    channels: Sequence[int] | None = None

    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return the sensor of one run."""
        channels = _check_channels(self.channels, wiring.ny)
        frozen: list[Float[np.ndarray, " n"]] = []  # one entry, once the window has begun

        def freeze(k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
            if self._at(k):
                frozen[:] = frozen or [y[channels]]
                y = y.copy()
                y[channels] = frozen[0]
            return y

        return Injection(measured=freeze)


@dataclass(frozen=True)
class DroppedSamples(_Windowed):
    """A whole measurement is lost with `probability`; the controller gets the last one that arrived, unmarked.

    That is what a driver with a buffer does; y_0 always arrives. A driver that marks the loss is a NaNSensor.
    """

    probability: float

    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return the connection of one run, which holds the last measurement that arrived."""
        arrived: list[Float[np.ndarray, " ny"]] = []  # the last measurement that arrived

        def deliver(k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
            lost = rng.random() < self.probability and self._at(k)
            if not (arrived and lost):
                arrived[:] = [y.copy()]
            return arrived[0].copy()

        return Injection(measured=deliver)


@dataclass(frozen=True)
class _Delaying(Fault):
    """A signal comes `steps` late."""

    steps: int

    def __post_init__(self) -> None:
        checks.count(self.steps, "steps", 0)

    def _line(
        self, before: list[Float[np.ndarray, " n"]]
    ) -> Callable[[int, Float[np.ndarray, " n"]], Float[np.ndarray, " n"]]:
        """Return a delay line that holds signals `before`; until one is `steps` old it gives the oldest that it has."""
        line: deque[Float[np.ndarray, " n"]] = deque(before, maxlen=self.steps + 1)

        def late(k: int, signal: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
            line.append(signal.copy())
            return line[0].copy()

        return late


@dataclass(frozen=True)
class SensorDelay(_Delaying):
    """The controller gets y_{k−steps}; until that exists, y_0."""

    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return the delay line of one run."""
        return Injection(measured=self._line([]))


@dataclass(frozen=True)
class ActuatorLoss(_Windowed):
    """The actuator lost `fraction` of its range: u_k is clipped to c + (1 − fraction) [u_min − c, u_max − c].

    c is the input nearest to zero inside the limits: ±40 N becomes ±20 N, a valve of 0 … 1 becomes 0 … 0.5. The
    limits are those of the run; an input without one keeps its range. The controller is not told beforehand: it
    sees what was applied.
    """

    fraction: float

    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return the actuator of one run."""
        low, high = wiring.inputs
        if not (np.isfinite(low) | np.isfinite(high)).any():
            raise DataError(
                "ActuatorLoss takes a share of the input range, and there is none; pass limits= with u_min, u_max"
            )
        rest = np.clip(np.zeros(len(low)), low, high)
        kept = 1.0 - self.fraction

        def narrow(limit: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nu"]:
            limited = np.isfinite(limit)
            return np.where(limited, rest + kept * (np.where(limited, limit, rest) - rest), limit)

        left = narrow(low), narrow(high)
        return Injection(applied=lambda k, u: np.clip(u, *left) if self._at(k) else u)


@dataclass(frozen=True)
class ActuatorDelay(_Delaying):
    """The plant gets u_{k−steps}; until that exists, the input nearest to zero inside the limits."""

    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return the delay line of one run."""
        rest = np.clip(np.zeros(len(wiring.inputs.low)), *wiring.inputs)
        return Injection(applied=self._line([rest] * self.steps))


@dataclass(frozen=True)
class SolverFailure(_Windowed):
    """The solver's answer is lost with `probability`; the controller's own fallback takes over.

    The solver runs, and its answer is thrown away as FAILED: all that follows is the controller's real path. It
    has no effect on a step that asks no solver, nor on a controller without one, such as LQR.
    """

    probability: float

    def start(self, wiring: Wiring, rng: np.random.Generator) -> Injection:
        """Return for each step of one run whether the solver's answer is lost."""
        return Injection(solver_fails=lambda k: rng.random() < self.probability and self._at(k))


def _check_channels(channels: Sequence[int] | None, ny: int) -> list[int]:
    """Return the channels of a fault as indices of the ny measurements."""
    picked = list(range(ny)) if channels is None else list(channels)
    outside = [i for i in picked if not 0 <= i < ny]
    if outside:
        raise DataError(f"channels holds {outside[0]}; pass indices of measurements, 0 to {ny - 1}")
    return picked
