"""Sines and cosines: harmonics of angles, and random features of the Gaussian kernel."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import checksum, freeze
from koopmpc.lifting.base import Lifting, StateChoice, find_states, freeze_choice, strip_unit


@dataclass(frozen=True, eq=False)
class Fourier(Lifting):
    """ψ(x) = sin k xᵢ and cos k xᵢ for k = 1 … `harmonics` and each chosen state i, and nothing else.

    Parameters
    ----------
    harmonics
        Highest multiple k.
    states
        The chosen states, by index or by name, with or without the unit; all of them by default.

    Raises
    ------
    DataError
        harmonics is below 1. When the lifting is bound: there is no such state.

    Examples
    --------
    >>> import koopmpc as km
    >>> circle = km.Fourier(1, states="theta")
    >>> (circle + circle * km.State("omega")).bind(("theta", "omega")).names
    ('sin(theta)', 'cos(theta)', 'omega*sin(theta)', 'omega*cos(theta)')
    """

    harmonics: int
    states: StateChoice | None = None

    def __post_init__(self) -> None:
        freeze(self, harmonics=checks.count(self.harmonics, "harmonics"), states=freeze_choice(self.states))

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"sin(theta)"`` and ``"cos(2 theta)"``."""
        return tuple(
            f"{function}({'' if k == 1 else f'{k} '}{strip_unit(states[i])})"
            for i in find_states(self.states, states, "Fourier")
            for k in range(1, self.harmonics + 1)
            for function in ("sin", "cos")
        )

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the harmonics, state by state."""
        angles = [k * x[i] for i in self._state_indices for k in range(1, self.harmonics + 1)]
        return ca.vertcat(*(function(angle) for angle in angles for function in (ca.sin, ca.cos)))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        j = 0
        for i in self._state_indices:
            for k in range(1, self.harmonics + 1):
                angle = k * x[i]
                Z[:, j] = np.sin(angle)
                Z[:, j + 1] = np.cos(angle)
                j += 2

    @cached_property
    def _state_indices(self) -> list[int]:
        return find_states(self.states, self.bound_states, "Fourier")


_SEEDS = 2**32  # a Generator draws the seed below this number


@dataclass(frozen=True, eq=False, init=False)
class RandomFourier(Lifting):
    """ψⱼ(x) = √(2/count) cos(ωⱼ·x + bⱼ), ωⱼ ~ N(0, I / width²), bⱼ ~ U[0, 2π), j = 1 … count.

    ψ(x)·ψ(y) is exp(−‖x − y‖² / (2 width²)) up to an error of order 1/√count: a Gaussian at every point, for
    the price of `count` cosines. Bound copies hold the drawn numbers, so a file does not depend on the generator.

    Parameters
    ----------
    count
        Number of features.
    width
        Standard deviation of the kernel, in the unit of the states; standardize states that differ much.
    rng
        A seed, or a Generator that draws the seed.

    Raises
    ------
    DataError
        count is below 1, or width is not above zero.

    References
    ----------
    Rahimi & Recht, "Random features for large-scale kernel machines", NIPS 2007.
    """

    tunable: ClassVar[Mapping[str, str]] = {"frequencies": "real", "phases": "real"}
    count: int
    width: float
    rng: int
    frequencies: Float[np.ndarray, "count nx"] | None
    phases: Float[np.ndarray, " count"] | None

    def __init__(
        self,
        count: int,
        width: float,
        rng: np.random.Generator | int = 0,
        *,
        frequencies: ArrayLike | None = None,
        phases: ArrayLike | None = None,
        bound: tuple[str, ...] | None = None,
    ) -> None:
        """Check the arguments; `bind` passes the `frequencies` and `phases` that it has drawn."""
        n = checks.count(count, "count")
        source = checks.generator(rng)
        seed = int(source.integers(_SEEDS)) if isinstance(rng, np.random.Generator) else int(rng)
        omegas = None if frequencies is None else checks.array(frequencies, "frequencies", (n, None))
        shifts = None if phases is None else checks.array(phases, "phases", (n,))
        if (omegas is None) != (shifts is None):
            raise DataError("frequencies and phases belong together; pass both or none")
        if omegas is not None and bound is not None and omegas.shape[1] != len(bound):
            raise ShapeError(f"frequencies has {omegas.shape[1]} columns and there are {len(bound)} states")
        freeze(
            self,
            count=n,
            width=checks.positive(width, "width"),
            rng=seed,
            frequencies=omegas,
            phases=shifts,
            bound=bound,
        )

    def bind(self, states: Sequence[str]) -> "RandomFourier":
        """Return the copy with frequencies and phases; the same seed draws the same numbers."""
        frequencies, phases = self.frequencies, self.phases
        if frequencies is None or frequencies.shape[1] != len(states):
            frequencies, phases = self._draw_features(len(states))
        drawn = replace(self, frequencies=frequencies, phases=phases, bound=tuple(states))
        _ = drawn.names
        return drawn

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"randomfourier(3 of 100; 0.5; seed 0)"``; tuned numbers add a checksum to the name."""
        tag = ""
        if self.frequencies is not None and self.phases is not None:
            omegas, shifts = self._draw_features(self.frequencies.shape[1])
            if not (np.array_equal(omegas, self.frequencies) and np.array_equal(shifts, self.phases)):
                tag = f"; {checksum(self.frequencies.tobytes(), self.phases.tobytes()):08x}"
        every = range(self.count)
        return tuple(f"randomfourier({j} of {self.count}; {self.width!r}; seed {self.rng}{tag})" for j in every)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return √(2/count) cos(ωⱼ·x + bⱼ) for each j."""
        frequencies, phases = self._features
        return self._amplitude * ca.cos(ca.SX(frequencies) @ x + ca.SX(phases))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        frequencies, phases = self._features
        Z[:] = phases
        for values, coordinates in zip(x, frequencies.T, strict=True):  # one order of sums for any number of rows
            Z += values[:, None] * coordinates
        np.cos(Z, out=Z)
        Z *= self._amplitude

    def _draw_features(self, nx: int) -> tuple[Float[np.ndarray, "count nx"], Float[np.ndarray, " count"]]:
        """Return the frequencies and phases that the seed draws on `nx` states."""
        source = checks.generator(self.rng)
        phases = source.uniform(0.0, 2 * np.pi, self.count)
        return source.standard_normal((self.count, nx)) / self.width, phases

    @property
    def _amplitude(self) -> float:
        return float(np.sqrt(2.0 / self.count))

    @property
    def _features(self) -> tuple[Any, Any]:
        """The frequencies (count, nx) and phases (count,): numbers, or symbols while they are tuned."""
        if self.frequencies is None or self.phases is None:
            raise DataError("RandomFourier has not drawn its frequencies yet; call .bind(states) or pass it to edmd")
        return self.frequencies, self.phases
