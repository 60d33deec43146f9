"""Observers that take the state as it was measured: without a disturbance, or with one filtered from the misfits."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError
from koopmpc.estimate.observer import History, StateModel, constant_index, state_model
from koopmpc.lifting.buffered import buffered
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.values import Value


@dataclass(frozen=True, eq=False)
class LiftedDisturbance(Value):
    """z = ψ(x) afresh each step; d ← d + gain (ψ(x⁺) − A ψ(x) − B u − E w − d).

    At rest d is exactly what the model lacks at that state and input, in every lifted coordinate, so the equilibria
    z = A z + B u + d of the controller hold the plant's own. A disturbance of fewer coordinates leaves an offset
    when z is lifted afresh from x. The Constant is known: its d is zero. In a controller on x⁺ = F(x, u) + d the
    states have the disturbances.

    Parameters
    ----------
    gain
        Share of the newest misfit, in (0, 1]: 1 is deadbeat, and as noisy as two measurements; less filters. Far
        from rest the misfit of a learned model is no constant, and a large gain makes the plan believe it is.

    Raises
    ------
    DataError
        The gain is outside (0, 1].
    """

    gain: float = 0.1

    def __post_init__(self) -> None:
        if checks.positive(self.gain, "gain") > 1:
            raise DataError(f"gain is {self.gain:g}; it must be in (0, 1], and 1 is deadbeat")

    def start(self, model: LinearPredictor | StateModel) -> "Filtered":
        """Return the observer of one controller."""
        return Filtered(model, self.gain)


class Measured:
    """The observer without an estimator: z = ψ(ζ) of the measured y, or ζ itself; d is zero, or what it is set to.

    ζ is y, or under an embedding y with its past.

    Parameters
    ----------
    model
        The predictor, or a model whose z is the state.
    """

    def __init__(self, model: LinearPredictor | StateModel) -> None:
        self._model = model = state_model(model)
        self._lift = None if model.lifting is None else buffered(model.lifting)
        self._history = None if model.embedding is None else History(model.embedding)
        self.ny = model.ny
        self.z: Float[np.ndarray, " nz"] = np.zeros(model.nz)
        self.d: Float[np.ndarray, " nz"] = np.zeros(model.nz)

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Forget d and the past; x0 will come as the first measurement."""
        self.d[:] = 0.0
        if self._history is not None:
            self._history.reset()

    def update(self, model: LinearPredictor | StateModel) -> None:
        """Go on with another model; d takes as long to follow as it took to come."""
        self._model = state_model(model)

    def observe(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Take y as it is; where it is lifted, a bad entry makes all of z NaN, which shows in every plan."""
        if self._history is not None:
            y = self._history.take(y, u)
        if self._lift is None:
            self.z = y
            return True
        (place,), (lifted,), evaluate, _ = self._lift.slot()
        place[:] = y
        evaluate()
        self.z = lifted
        return True


class Filtered(Measured):
    """The observer of a `LiftedDisturbance`: d ← d + gain (z⁺ − F(z, u) − E w − d); a missed sample leaves d as it is.

    The disturbances of what is known are zero: of the Constant, and of a state's past.

    Parameters
    ----------
    model
        The predictor, or a model whose z is the state.
    gain
        In (0, 1].
    """

    def __init__(self, model: LinearPredictor | StateModel, gain: float) -> None:
        super().__init__(model)
        self._gain = np.full(len(self.d), gain)
        if isinstance(model, LinearPredictor):
            known = constant_index(model)
            if known is not None:
                self._gain[known] = 0.0
        else:
            self._gain[self.ny :] = 0.0
        self._last: Float[np.ndarray, " nz"] | None = None

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Forget the last state, d and the past; x0 will come as the first measurement."""
        super().reset(x0)
        self._last = None

    def observe(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Take y, and move d towards the misfit of the step that led here."""
        super().observe(y, u, w)
        if not np.isfinite(self.z).all():
            self._last = None
            return False
        if self._last is not None:
            misfit = self.z - self._model.advance(self._last, u, w, self.d)
            if np.isfinite(misfit).all():
                self.d += self._gain * misfit
        self._last = self.z.copy()
        return True
