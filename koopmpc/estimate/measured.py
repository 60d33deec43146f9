"""Measured: z = ψ(y), and d is what it is set to."""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.estimate.history import history_of
from koopmpc.lifting.buffered import buffered
from koopmpc.predict.linear import LinearPredictor


class Measured:
    """The observer of a controller without an estimator: y is the state, d zero or set by hand."""

    def __init__(self, predictor: LinearPredictor) -> None:
        self._lift = buffered(predictor.lifting)
        self._history = history_of(predictor.embedding)
        self.ny = predictor.nx
        self.z: Float[np.ndarray, " nz"] = np.zeros(predictor.nz)
        self.d: Float[np.ndarray, " nz"] = np.zeros(predictor.nz)

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Forget d, and the past."""
        self.d[:] = 0.0
        if self._history is not None:
            self._history.reset()

    def adopt(self, predictor: LinearPredictor) -> None:
        """The lifting stays."""

    def update(
        self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]
    ) -> bool:
        """Lift y; a bad one makes all of z NaN, which shows in every plan."""
        (x,), (lifted,), lift, _ = self._lift.slot()
        x[:] = y if self._history is None else self._history.take(y, u)
        lift()
        self.z = lifted
        return True
