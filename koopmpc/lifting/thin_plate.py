"""Thin-plate splines."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.lifting.base import Lifting
from koopmpc.lifting.radial import (
    center_names,
    checked_centers,
    squared_distances,
    symbolic_squared_distances,
)

_TINY = 1e-100  # keeps ln, its first and its second derivative finite at the centre; no other value feels it


@dataclass(frozen=True, eq=False, init=False)
class ThinPlate(Lifting):
    """ψ(x) = r² ln r with r = ‖x − c‖ for each centre c; 0 at the centre.

    Parameters
    ----------
    centers
        (nc, nx), one centre a row.
    """

    centers: Float[np.ndarray, "nc nx"]

    def __init__(self, centers: ArrayLike, *, bound: tuple[str, ...] | None = None) -> None:
        object.__setattr__(self, "centers", checked_centers(centers))
        object.__setattr__(self, "bound", bound)

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"thinplate(0.5, -1)"``, which hold the centre."""
        return center_names("thinplate", self.centers, states)

    def formula(self, x: ca.SX) -> ca.SX:
        """Return ½ r² ln r²."""
        return ca.vertcat(
            *(0.5 * r2 * ca.log(r2 + _TINY) for r2 in symbolic_squared_distances(x, self.centers))
        )

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        squared_distances(x, self.centers, Z)
        logarithm = np.log(Z + _TINY)
        np.multiply(Z, 0.5, out=Z)
        np.multiply(Z, logarithm, out=Z)
