"""Observers of a controller on x⁺ = F(x, u) + d: x is measured, and d is zero or filtered from what F misses."""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike


@runtime_checkable
class Map(Protocol):
    """What an observer asks of a model."""

    def advance(
        self,
        z: Float[np.ndarray, " nz"],
        u: Float[np.ndarray, " nu"],
        w: Float[np.ndarray, " nw"],
        d: Float[np.ndarray, " nz"],
    ) -> Float[np.ndarray, " nz"]:
        """Return x⁺ = F(x, u) + E w + d."""
        ...


class MeasuredState:
    """The observer of a controller without an estimator: z is y, d zero."""

    def __init__(self, nx: int) -> None:
        self.ny = nx
        self.z: Float[np.ndarray, " nx"] = np.zeros(nx)
        self.d: Float[np.ndarray, " nx"] = np.zeros(nx)

    def reset(self, x0: ArrayLike | None = None) -> None:
        """There is nothing to forget."""

    def adopt(self, predictor: Any) -> None:
        """Y is the state of any model."""

    def update(
        self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]
    ) -> bool:
        """Take y as it is; a bad one shows in the plan."""
        self.z = y
        return True


class FilteredState:
    """z = y, d ← d + gain (y − F(x, u) − E w − d); a missed sample leaves d as it is."""

    def __init__(self, gain: float, model: Map, nx: int) -> None:
        self._gain, self._model = gain, model
        self.ny = nx
        self.z: Float[np.ndarray, " nx"] = np.zeros(nx)
        self.d: Float[np.ndarray, " nx"] = np.zeros(nx)
        self._measured = False

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Forget the last state and d; x0 will come as the first measurement."""
        self.d[:] = 0.0
        self._measured = False

    def adopt(self, predictor: Any) -> None:
        """Go on with another model; d takes as long to follow as it took to come."""
        self._model = predictor

    def update(
        self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]
    ) -> bool:
        """Take y, and move d towards the misfit of the step that led here."""
        if not np.isfinite(y).all():
            self._measured = False
            return False
        if self._measured:
            misfit = y - self._model.advance(self.z, u, w, self.d)
            if np.isfinite(misfit).all():
                self.d += self._gain * misfit
        self.z[:] = y
        self._measured = True
        return True
