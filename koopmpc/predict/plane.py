"""A plane through the state space, and the eigenfunctions φ_j(x) = ξ_jᴴ ψ(x) on it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.episodes import Episodes
from koopmpc.errors import DataError
from koopmpc.lifting.base import index
from koopmpc.predict.linear import LinearPredictor
from koopmpc.values import Value

Axes = tuple[int | str, int | str]
Over = Episodes | Sequence[tuple[float, float]]
_ROWS = 4096  # states that are lifted at once


@dataclass(frozen=True, eq=False)
class Plane(Value):
    """A grid over two states, all others held.

    Attributes
    ----------
    axes
        Indices of the two states.
    names
        Their names with units.
    across, up
        Grid lines of the first state and of the second.
    at
        (nx,) the state that the plane goes through.
    """

    axes: tuple[int, int]
    names: tuple[str, str]
    across: Float[np.ndarray, " nc"]
    up: Float[np.ndarray, " nr"]
    at: Float[np.ndarray, " nx"]

    @property
    def points(self) -> Float[np.ndarray, "M nx"]:
        """States of the grid, one a row: `up` is the slow index."""
        X = np.tile(self.at, (len(self.up) * len(self.across), 1))
        X[:, self.axes[0]] = np.tile(self.across, len(self.up))
        X[:, self.axes[1]] = np.repeat(self.up, len(self.across))
        return X


def plane_through(
    states: Sequence[str], axes: Axes, over: Over, at: ArrayLike | None = None, points: int = 121
) -> Plane:
    """Return the plane over the two states `axes`.

    Parameters
    ----------
    states
        Names of all.
    axes
        The two, by index or name.
    over
        Two ranges (low, high), or episodes: then what they cover.
    at
        (nx,) what the other states are held at; by default the median of the episodes, else 0.
    points
        Grid lines along each axis.

    Raises
    ------
    DataError
        There is no such state, both are one, or a range is empty.
    """
    first, second = (index(state, states, "the plane") for state in axes)
    if first == second:
        raise DataError(f"the plane is asked for {states[first]} twice; name two states")
    if isinstance(over, Episodes):
        X = np.concatenate([episode.X for episode in over])
        ranges = np.column_stack([X.min(axis=0), X.max(axis=0)])[[first, second]]
        held = np.median(X, axis=0)
    else:
        ranges, held = checks.array(cast(ArrayLike, over), "over", (2, 2)), np.zeros(len(states))
    for name, (low, high) in zip((states[first], states[second]), ranges, strict=True):
        if not low < high:
            raise DataError(f"the range of {name} is {low:g} to {high:g}; pass (low, high) with low < high")
    lines = checks.count(points, "points", least=2)
    return Plane(
        (first, second),
        (states[first], states[second]),
        np.linspace(float(ranges[0, 0]), float(ranges[0, 1]), lines),
        np.linspace(float(ranges[1, 0]), float(ranges[1, 1]), lines),
        held if at is None else checks.array(at, "at", (len(states),)),
    )


def eigenfunctions_on(
    predictor: LinearPredictor, which: int | Sequence[int], plane: Plane
) -> Complex[np.ndarray, "k nr nc"]:
    """Return φ_j on the grid for each j of `which`, scaled so that the largest |φ_j| on it is 1.

    An eigenfunction is defined up to a factor: the phase of a complex one starts anywhere.

    Raises
    ------
    DataError
        There is no such eigenvalue, φ_j is 0 on all of the plane, or A is defective.
    """
    chosen = [which] if isinstance(which, int | np.integer) else list(which)
    for j in chosen:
        if not 0 <= j < predictor.nz:
            raise DataError(f"there is no eigenfunction {j}; the predictor has 0 … {predictor.nz - 1}")
    if not chosen:
        raise DataError("which names no eigenfunction; pass an index, or several")
    left, X = predictor.left_eigenvectors[chosen].T, plane.points
    parts = [predictor.lift(X[i : i + _ROWS]) @ left for i in range(0, len(X), _ROWS)]
    phi = np.concatenate(parts).T.reshape(len(chosen), len(plane.up), len(plane.across))
    largest = np.abs(phi).max(axis=(1, 2))
    if (largest == 0).any():
        j = chosen[int(np.argmin(largest))]
        raise DataError(f"eigenfunction {j} is 0 on all of the plane; hold the other states elsewhere (at=…)")
    return phi / largest[:, None, None]
