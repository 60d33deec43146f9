"""Inputs that excite a plant: noise, PRBS, sums of sines, a chirp, and feedback with noise."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import Value, freeze

Policy = Callable[[int, Float[np.ndarray, " ny"]], Float[np.ndarray, " nu"]]


class Excitation(Value, ABC):
    """A frozen description of inputs, with `nu` of them."""

    @property
    @abstractmethod
    def nu(self) -> int:
        """Number of inputs."""

    @abstractmethod
    def start(self, steps: int, dt: float, rng: np.random.Generator) -> Policy:
        """Return the policy u_k = policy(k, y) of one episode of `steps` steps of dt [s]."""

    def choose_episode(self, number: int) -> "Excitation":
        """Return the excitation of the episode with this number; most excitations are the same for all."""
        del number
        return self


class OpenLoop(Excitation):
    """An excitation that does not look at y."""

    @abstractmethod
    def sequence(self, steps: int, dt: float, rng: np.random.Generator) -> Float[np.ndarray, "steps nu"]:
        """Return all inputs of one episode, (steps, nu)."""

    def start(self, steps: int, dt: float, rng: np.random.Generator) -> Policy:
        """Return the policy that reads out the sequence."""
        U = self.sequence(steps, dt, rng)
        return lambda k, _: U[k]


@dataclass(frozen=True, eq=False, init=False)
class Levels(OpenLoop):
    """Inputs between `low` and `high`, (nu,) each, that change every `hold` steps."""

    low: Float[np.ndarray, " nu"]
    high: Float[np.ndarray, " nu"]
    hold: int

    def __init__(self, low: ArrayLike, high: ArrayLike, hold: int = 1) -> None:
        lows, highs = _inputs(low, "low"), _inputs(high, "high")
        nu = max(len(lows), len(highs))
        lows = checks.vector(lows[0] if len(lows) == 1 else lows, "low", nu)
        highs = checks.vector(highs[0] if len(highs) == 1 else highs, "high", nu)
        checks.refuse_crossed(lows, highs, "excitation")
        freeze(self, low=lows, high=highs, hold=checks.count(hold, "hold"))

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.low)


class Noise(Levels):
    """u uniform between `low` and `high`, drawn again every `hold` steps.

    Parameters
    ----------
    low, high
        Scalars or (nu,), in the units of the inputs.
    hold
        Steps between two draws.

    Raises
    ------
    ShapeError, DataError
        The two have other lengths, an end of `low` is above that of `high`, or hold is below 1.

    Examples
    --------
    >>> import koopmpc as km
    >>> push = km.Noise(-5, 5, hold=3)  # a new value every third step
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> km.collect(plant, [[0.0, 0.0]], push, episodes=1, steps=6)[0].U.ravel().round(1)
    array([ 4.4,  4.4,  4.4, -1.8, -1.8, -1.8])
    """

    def sequence(self, steps: int, dt: float, rng: np.random.Generator) -> Float[np.ndarray, "steps nu"]:
        """Return the draws, each held."""
        draws = rng.uniform(self.low, self.high, (-(-steps // self.hold), self.nu))
        return np.repeat(draws, self.hold, axis=0)[:steps]


ORDERS = range(3, 17)


@lru_cache
def maximal_length(order: int) -> Bool[np.ndarray, " period"]:
    """Return one period of a maximal-length sequence, 2^order − 1 bits, read-only.

    Its ones exceed its zeros by one and its periodic autocorrelation is −1 off zero (levels ±1): the spectrum
    is flat except for the mean.
    """
    from scipy.signal import max_len_seq  # imported here, for scipy.signal takes a quarter of a second

    sequence = max_len_seq(order)[0].astype(bool)
    sequence.flags.writeable = False
    return sequence


@dataclass(frozen=True, eq=False, init=False)
class PRBS(Levels):
    """u switches between `low` and `high` as a maximal-length shift register does, with a flat spectrum.

    Parameters
    ----------
    low, high
        The two levels, scalars or (nu,).
    hold
        Steps between two bits.
    order
        Length of the register; it repeats after 2^order − 1 bits. Each episode starts at a random bit, and
        the inputs run nu-th parts of the period apart, so that they are hardly correlated.

    Raises
    ------
    ShapeError, DataError
        As for `Noise`; order lies outside 3 … 16.
    """

    order: int

    def __init__(self, low: ArrayLike, high: ArrayLike, hold: int = 1, order: int = 10) -> None:
        super().__init__(low, high, hold)
        if checks.count(order, "order") not in ORDERS:
            raise DataError(f"order is {order}; choose {ORDERS[0]} … {ORDERS[-1]}")
        freeze(self, order=order)

    def sequence(self, steps: int, dt: float, rng: np.random.Generator) -> Float[np.ndarray, "steps nu"]:
        """Return the two levels from a random bit on."""
        bits = maximal_length(self.order)
        lag = np.arange(self.nu) * (len(bits) // self.nu)
        place = (np.arange(steps) // self.hold)[:, None] + lag + rng.integers(len(bits))
        return np.where(bits[place % len(bits)], self.high, self.low)


@dataclass(frozen=True, eq=False, init=False)
class Multisine(OpenLoop):
    """u = offset + Σ_j a sin(2π j t / period + φ_j) with random φ_j, scaled to the peak `amplitude`.

    Parameters
    ----------
    amplitude
        Largest |u − offset| in the period, scalar or (nu,).
    period
        [s], a whole number of samples.
    harmonics
        The multiples j: a number n for 1 … n, or the list of them; below half the samples of a period.
    offset
        Mean, scalar or (nu,).

    Raises
    ------
    ShapeError, DataError
        A number is not above zero, the lengths differ, or, when it excites a plant, the period is no multiple of dt or
        a harmonic is not below the Nyquist frequency.
    """

    amplitude: Float[np.ndarray, " nu"]
    period: float
    harmonics: tuple[int, ...]
    offset: Float[np.ndarray, " nu"]

    def __init__(
        self, amplitude: ArrayLike, period: float, harmonics: int | Sequence[int], offset: ArrayLike = 0.0
    ) -> None:
        checks.kind(
            harmonics, "harmonics", (int, tuple, list, range, np.ndarray), "pass their number, or a list of them"
        )
        chosen = range(1, checks.count(harmonics, "harmonics") + 1) if isinstance(harmonics, int) else harmonics
        size = _inputs(amplitude, "amplitude")
        freeze(
            self,
            amplitude=size,
            period=checks.positive(period, "period", "s"),
            harmonics=tuple(checks.count(j, "harmonic") for j in chosen),
            offset=checks.vector(offset, "offset", len(size)),
        )

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.amplitude)

    def sequence(self, steps: int, dt: float, rng: np.random.Generator) -> Float[np.ndarray, "steps nu"]:
        """Return repeated periods with the phases of this episode."""
        samples = round(self.period / dt)
        if samples < 1 or abs(samples * dt - self.period) > 1e-9 * self.period:
            raise DataError(f"period is {self.period:g} s, no multiple of dt {dt:g} s; choose {max(samples, 1) * dt:g}")
        if 2 * max(self.harmonics) >= samples:
            raise DataError(
                f"harmonic {max(self.harmonics)} of {samples} samples a period is not below the Nyquist "
                "frequency; lengthen the period or drop it"
            )
        angle = 2 * np.pi / samples * np.outer(np.arange(samples), self.harmonics)
        phases = rng.uniform(0, 2 * np.pi, (self.nu, 1, len(self.harmonics)))
        one = np.sin(angle + phases).sum(axis=2).T
        one = self.offset + self.amplitude * (one / np.abs(one).max(axis=0))
        return one[np.arange(steps) % samples]


@dataclass(frozen=True, eq=False, init=False)
class Chirp(OpenLoop):
    """u = offset + amplitude sin 2π (f0 t + (f1 − f0) t² / (2 duration)): from f0 to f1 [Hz], then again.

    Parameters
    ----------
    amplitude, offset
        Scalars or (nu,).
    f0, f1
        First and last frequency [Hz], below half the sample rate.
    duration
        Length of the sweep [s].

    Raises
    ------
    ShapeError, DataError
        A number is not above zero, the lengths differ, or, when it excites a plant, a frequency is not below half the
        sample rate.
    """

    amplitude: Float[np.ndarray, " nu"]
    f0: float
    f1: float
    duration: float
    offset: Float[np.ndarray, " nu"]

    def __init__(self, amplitude: ArrayLike, f0: float, f1: float, duration: float, offset: ArrayLike = 0.0) -> None:
        size = _inputs(amplitude, "amplitude")
        freeze(
            self,
            amplitude=size,
            f0=checks.positive(f0, "f0", "Hz"),
            f1=checks.positive(f1, "f1", "Hz"),
            duration=checks.positive(duration, "duration", "s"),
            offset=checks.vector(offset, "offset", len(size)),
        )

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.amplitude)

    def sequence(self, steps: int, dt: float, rng: np.random.Generator) -> Float[np.ndarray, "steps nu"]:
        """Return the sweep; nothing in it is random."""
        if 2 * dt * max(self.f0, self.f1) >= 1:
            raise DataError(
                f"a chirp up to {max(self.f0, self.f1):g} Hz needs dt below "
                f"{0.5 / max(self.f0, self.f1):g} s, dt is {dt:g} s; lower the frequency"
            )
        t = dt * (np.arange(steps) % max(round(self.duration / dt), 1))
        wave = np.sin(2 * np.pi * (self.f0 * t + (self.f1 - self.f0) * t**2 / (2 * self.duration)))
        return self.offset + self.amplitude * wave[:, None]


@dataclass(frozen=True, eq=False, init=False)
class Feedback(Excitation):
    """u = u_ref − K (y − x_ref) + noise, clipped to [u_min, u_max]: excites an unstable plant and holds it.

    Parameters
    ----------
    K
        Gain (nu, ny).
    noise
        Any excitation of nu inputs, or None.
    x_ref, u_ref
        The point to hold the plant at, scalars or (ny,) and (nu,); zero by default.
    u_min, u_max
        Limits on u, scalars or (nu,).

    Raises
    ------
    ShapeError, DataError
        K is no matrix, the other arguments or the plant's y do not fit it, or the limits cross.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> pd = km.Feedback([[40, 15]], km.Noise(-5, 5), u_min=-25, u_max=25)  # it would fall over
    >>> data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), pd, episodes=5, steps=60)
    >>> bool(max(abs(episode.X[-1, 0]) for episode in data) < 1)
    True
    """

    K: Float[np.ndarray, "nu ny"]
    noise: Excitation | None
    x_ref: Float[np.ndarray, " ny"]
    u_ref: Float[np.ndarray, " nu"]
    u_min: Float[np.ndarray, " nu"]
    u_max: Float[np.ndarray, " nu"]

    def __init__(
        self,
        K: ArrayLike,
        noise: Excitation | None = None,
        x_ref: ArrayLike = 0.0,
        u_ref: ArrayLike = 0.0,
        u_min: ArrayLike = -np.inf,
        u_max: ArrayLike = np.inf,
    ) -> None:
        if hasattr(K, "K"):
            raise DataError(f"K is {checks.article(K)}; pass its matrix, gain.K")
        gain = checks.array(K, "K", (None, None))
        if noise is not None:
            checks.members(noise, "noise", ("nu", "start"), "pass an excitation, such as Noise(-1, 1), or None")
        if noise is not None and noise.nu != len(gain):
            raise ShapeError(f"noise has {noise.nu} inputs and K {len(gain)} rows; pass one level for each input")
        freeze(
            self,
            K=gain,
            noise=noise,
            x_ref=checks.vector(x_ref, "x_ref", gain.shape[1]),
            u_ref=checks.vector(u_ref, "u_ref", len(gain)),
            u_min=checks.vector(u_min, "u_min", len(gain), infinite=True),
            u_max=checks.vector(u_max, "u_max", len(gain), infinite=True),
        )
        checks.refuse_crossed(self.u_min, self.u_max, "u")

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return len(self.K)

    def start(self, steps: int, dt: float, rng: np.random.Generator) -> Policy:
        """Return the policy, with the noise of this episode."""
        noise = None if self.noise is None else self.noise.start(steps, dt, rng)

        def policy(k: int, y: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " nu"]:
            if y.shape != self.x_ref.shape:
                raise ShapeError(
                    f"K has {self.K.shape[1]} columns, the plant measures {len(y)}; "
                    f"pass K of shape ({self.nu}, {len(y)})"
                )
            u = self.u_ref - self.K @ (y - self.x_ref)
            return np.clip(u if noise is None else u + noise(k, y), self.u_min, self.u_max)

        return policy


def _inputs(value: ArrayLike, name: str) -> Float[np.ndarray, " nu"]:
    """Return a scalar or a vector as one entry for each input."""
    levels = np.atleast_1d(checks.array(value, name))
    return levels if levels.ndim == 1 else checks.array(levels, name, (None,))
