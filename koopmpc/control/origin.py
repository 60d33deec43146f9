"""Origin: where a plan starts, from what is measured and through the inputs that are still to act."""

from collections import deque

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.errors import ShapeError
from koopmpc.estimate.measured import Measured
from koopmpc.estimate.observer import Estimator, Observer
from koopmpc.lifting.buffered import HUGE
from koopmpc.predict.linear import LinearPredictor


class Origin:
    """z_{k+L} and d, for an input computed at k that acts L steps later: z ← A z + B u + E w + d, L times.

    Parameters
    ----------
    predictor
        The model.
    estimator
        Gives z_k and d; None lifts y.
    latency
        L ≥ 0.
    """

    def __init__(self, predictor: LinearPredictor, estimator: Estimator | None, latency: int) -> None:
        self._predictor, self._latency = predictor, latency
        self.observer: Observer = Measured(predictor) if estimator is None else estimator.start(predictor)
        self.z = self.observer.z
        self._plain = estimator is None and not latency
        self._sent: deque[Float[np.ndarray, " nu"]] = deque(maxlen=latency + 1)
        self.reset(None, np.zeros(predictor.nu))

    @property
    def d(self) -> Float[np.ndarray, " nz"]:
        """The disturbance of every lifted coordinate."""
        return self.observer.d

    def reset(self, x0: ArrayLike | None, last: Float[np.ndarray, " nu"]) -> None:
        """Start at x0, where it is known, with the input `last` acting until the first one arrives."""
        self.observer.reset(x0)
        self._sent.extend([last.copy()] * (self._latency + 1))
        self._w = np.zeros(self._predictor.nw)

    def adopt(self, predictor: LinearPredictor) -> None:
        """Go on with another model."""
        self._predictor = predictor
        self.observer.adopt(predictor)

    def take(
        self,
        y: Float[np.ndarray, "..."],
        last: Float[np.ndarray, " nu"],
        applied: ArrayLike | None,
        W: Float[np.ndarray, "L nw"],
    ) -> None:
        """Take y_k; z is NaN where it cannot be used.

        Parameters
        ----------
        last
            The input that was computed last.
        applied
            What acted since the last call; by default the input that was computed L + 1 calls ago.
        W
            w_k … w_{k+L}: what is measured of the disturbances.
        """
        observer = self.observer
        if y.shape != (observer.ny,):
            what = "a state" if isinstance(observer, Measured) else "a measurement of the estimator"
            raise ShapeError(f"y has shape {y.shape}, expected ({observer.ny},), one value {what}")
        if self._plain:
            observer.update(y, last, self._w)
            self.z = observer.z
            return
        self._sent.append(last.copy())
        acted = self._sent[0]
        if applied is not None:
            got = np.asarray(applied, dtype=np.float64)
            if got.shape != acted.shape:
                raise ShapeError(f"applied has shape {got.shape}, expected {acted.shape}")
            acted = got if (np.abs(got) < HUGE).all() else acted
        good = observer.update(y, acted, self._w)
        self._w = np.where(np.abs(W[0]) < HUGE, W[0], self._w)  # not known: as it was
        z, model = observer.z if good else np.full_like(observer.z, np.nan), self._predictor
        for i in range(self._latency):
            z = model.A @ z + model.B @ self._sent[i + 1] + model.E @ W[i] + observer.d
        self.z = z
