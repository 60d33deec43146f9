"""LiftedDisturbance: the whole state is measured, and every lifted coordinate has a disturbance."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError
from koopmpc.estimate.measured import FilteredState, Map
from koopmpc.estimate.observer import constant_index, history_of
from koopmpc.lifting.buffered import buffered
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.values import Value


@dataclass(frozen=True, eq=False)
class LiftedDisturbance(Value):
    """z = ψ(x) afresh each step; d ← d + gain (ψ(x⁺) − A ψ(x) − B u − E w − d).

    At rest d is exactly what the model lacks at that state and input, in every lifted coordinate, so the equilibria
    z = A z + B u + d of the controller hold the plant's own. A disturbance of fewer coordinates leaves an offset
    when z is lifted afresh from x. The Constant is known: its d is zero. Of a controller on x⁺ = F(x, u) + d it is
    the states that have the disturbances.

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

    def start(self, predictor: LinearPredictor) -> "Relifted":
        """Return the observer of one controller."""
        return Relifted(self, predictor)

    def watch(self, model: Map) -> FilteredState:
        """Return the observer of one controller on x⁺ = F(x, u) + d, whose states have the disturbances."""
        return FilteredState(self.gain, model)


class Relifted:
    """The observer of a `LiftedDisturbance`; a missed sample leaves d as it is."""

    def __init__(self, rule: LiftedDisturbance, predictor: LinearPredictor) -> None:
        self._gain, self._predictor = rule.gain, predictor
        self._constant = constant_index(predictor)
        self._lift = buffered(predictor.lifting)
        self._history = history_of(predictor.embedding)
        self.ny = predictor.nx
        self.z: Float[np.ndarray, " nz"] = np.zeros(predictor.nz)
        self.d: Float[np.ndarray, " nz"] = np.zeros(predictor.nz)
        self._measured = False

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Forget the last state and d; x0 will come as the first measurement."""
        self.d[:] = 0.0
        self._measured = False
        if self._history is not None:
            self._history.reset()

    def update(self, predictor: LinearPredictor) -> None:
        """Go on with another model; d takes as long to follow as it took to come."""
        self._predictor = predictor

    def observe(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Lift y, and move d towards the misfit of the step that led here."""
        (x,), (lifted,), lift, _ = self._lift.slot()
        x[:] = y if self._history is None else self._history.take(y, u)
        lift()
        if not np.isfinite(lifted).all():
            self._measured = False
            return False
        if self._measured:
            model = self._predictor
            misfit = lifted - (model.A @ self.z + model.B @ u)
            if w.size:
                misfit -= model.E @ w
            misfit -= self.d
            if self._constant is not None:
                misfit[self._constant] = 0.0
            self.d += self._gain * misfit
        self.z[:] = lifted
        self._measured = True
        return True
