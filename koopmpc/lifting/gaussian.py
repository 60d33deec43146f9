"""Gaussian bells."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.radial import (
    center_names,
    checked_centers,
    squared_distances,
    symbolic_squared_distances,
)


@dataclass(frozen=True, eq=False, init=False)
class Gaussian(Lifting):
    """ψ(x) = exp(−‖x − c‖² / (2 width²)) for each centre c.

    Parameters
    ----------
    centers
        (nc, nx), one centre a row.
    width
        Standard deviation of the bell, in the unit of the states; scale states that differ much.
    """

    centers: Float[np.ndarray, "nc nx"]
    width: float

    def __init__(self, centers: ArrayLike, width: float, *, bound: tuple[str, ...] | None = None) -> None:
        object.__setattr__(self, "centers", checked_centers(centers))
        object.__setattr__(self, "width", checks.positive(width, "width"))
        object.__setattr__(self, "bound", bound)

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"gaussian(0.5, -1; 0.3)"``, which hold the centre and the width."""
        return center_names("gaussian", self.centers, states, f"; {self.width!r}")

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the bells."""
        return ca.vertcat(*(ca.exp(self._rate * r2) for r2 in symbolic_squared_distances(x, self.centers)))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        squared_distances(x, self.centers, Z)
        np.multiply(Z, self._rate, out=Z)
        np.exp(Z, out=Z)

    @property
    def _rate(self) -> float:
        return -0.5 / self.width**2
