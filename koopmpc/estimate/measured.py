"""Measured: z = ψ(y), and d is what it is set to."""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.data.delay import Delay
from koopmpc.estimate.observer import history_of
from koopmpc.lifting.buffered import buffered
from koopmpc.predict.predictors import LinearPredictor


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

    def update(self, predictor: LinearPredictor) -> None:
        """The lifting stays."""

    def observe(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Lift y; a bad one makes all of z NaN, which shows in every plan."""
        (x,), (lifted,), lift, _ = self._lift.slot()
        x[:] = y if self._history is None else self._history.take(y, u)
        lift()
        self.z = lifted
        return True


@runtime_checkable
class Model(Protocol):
    """What moves a state, or a lifted one."""

    def advance(
        self,
        z: Float[np.ndarray, " nz"],
        u: Float[np.ndarray, " nu"],
        w: Float[np.ndarray, " nw"],
        d: Float[np.ndarray, " nz"],
    ) -> Float[np.ndarray, " nz"]:
        """Return z⁺ = F(z, u) + E w + d."""
        ...


@runtime_checkable
class Map(Model, Protocol):
    """What an observer asks of a model: nx entries of x, of which the first ny are the plant's states."""

    @property
    def nx(self) -> int:
        """Number of entries of x."""
        ...

    @property
    def ny(self) -> int:
        """Number of the plant's states."""
        ...

    @property
    def embedding(self) -> Delay | None:
        """What makes x of the plant's state and its past."""
        ...


class MeasuredState:
    """The observer of a controller without an estimator: z is y, or its ζ, d zero."""

    def __init__(self, model: Map) -> None:
        self.ny = model.ny
        self._history = history_of(model.embedding)
        self.z: Float[np.ndarray, " nx"] = np.zeros(model.nx)
        self.d: Float[np.ndarray, " nx"] = np.zeros(model.nx)

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Forget the past."""
        if self._history is not None:
            self._history.reset()

    def update(self, predictor: Any) -> None:
        """Y is the state of any model."""

    def observe(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Take y as it is; a bad one shows in the plan."""
        self.z = y if self._history is None else self._history.take(y, u)
        return True


class FilteredState:
    """z = y, or its ζ; d ← d + gain (y − F(x, u) − E w − d); a missed sample leaves d as it is."""

    def __init__(self, gain: float, model: Map) -> None:
        self._gain, self._model = gain, model
        self.ny = model.ny
        self._history = history_of(model.embedding)
        self.z: Float[np.ndarray, " nx"] = np.zeros(model.nx)
        self.d: Float[np.ndarray, " nx"] = np.zeros(model.nx)
        self._measured = False

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Forget the last state and d; x0 will come as the first measurement."""
        self.d[:] = 0.0
        self._measured = False
        if self._history is not None:
            self._history.reset()

    def update(self, predictor: Any) -> None:
        """Go on with another model; d takes as long to follow as it took to come."""
        self._model = predictor

    def observe(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Take y, and move d towards the misfit of the step that led here."""
        x = y if self._history is None else self._history.take(y, u)
        if not np.isfinite(x).all():
            self._measured = False
            return False
        if self._measured:
            misfit = y - self._model.advance(self.z, u, w, self.d)[: self.ny]
            if np.isfinite(misfit).all():
                self.d[: self.ny] += self._gain * misfit
        self.z[:] = x
        self._measured = True
        return True
