"""LiftedDisturbance: the disturbance of every lifted coordinate, learned from misfits as far as they are constant."""

from dataclasses import dataclass
from math import exp

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.checks import HUGE
from koopmpc.errors import DataError
from koopmpc.estimate.observer import Measured, StateModel
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.values import Value

GAIN = 0.1  # the least gain that a horizon gives: d forgets within twenty steps, however long the plan


@dataclass(frozen=True, eq=False)
class LiftedDisturbance(Value):
    """z = ψ(x) afresh each step; d follows the misfits e = ψ(x⁺) − A ψ(x) − B u − E w as far as they are constant.

    At rest d is exactly what the model lacks at that state and input, in every lifted coordinate, so the equilibria
    z = A z + B u + d of the controller hold the plant's own. A disturbance of fewer coordinates leaves an offset
    when z is lifted afresh from x. The Constant is known: its d is zero. In a controller on x⁺ = F(x, u) + d the
    states have the disturbances.

    A plan holds d over its horizon, but what a model lacks in a transient is not what it lacks where the plan ends.
    Therefore d ← d + c (m − d), m the mean of the last misfits and c the share of them that was constant, as the
    states show it: c = 1 − Σ vᵢ/sᵢ² / Σ max((C m)ᵢ², (C d)ᵢ²)/sᵢ², at least 0. v is the variance of C e about C m,
    without half the mean square of its successive differences, which is noise, and s the largest step or misfit that a
    state has shown so far. Where the misfits vary by more than their mean nothing is learned; at rest v = 0 and
    d = m = e.

    Parameters
    ----------
    gain
        Weight of the newest misfit in all these means, m ← m + gain (e − m), in (0, 1]: 1 makes d the last misfit.
        By default 1 − exp(−4/N), so that misfits are remembered over a quarter of the horizon, and at least 0.1.

    Raises
    ------
    DataError
        The gain is outside (0, 1].

    References
    ----------
    von Neumann, "Distribution of the ratio of the mean square successive difference to the variance", Ann. Math.
    Stat. 12, 1941.
    """

    gain: float | None = None

    def __post_init__(self) -> None:
        if self.gain is not None and checks.positive(self.gain, "gain") > 1:
            raise DataError(f"gain is {self.gain:g}; it must be in (0, 1], and 1 is deadbeat")

    def start(self, model: LinearPredictor | StateModel, horizon: int) -> "Filtered":
        """Return the observer of one controller with plans of this many steps."""
        return Filtered(model, max(1 - exp(-4 / horizon), GAIN) if self.gain is None else self.gain)


class Filtered(Measured):
    """The observer of a `LiftedDisturbance`; a missed sample leaves d as it is.

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
        self._gain = gain
        self._C = self._state_rows(model)
        nz, nx = len(self.d), len(self._C)
        self._still = np.zeros(nz)
        # of the newest misfit e and f = C e, and the means of all: [e; f; f² less half the square of its change]
        self._newest, self._means = np.zeros(nz + 2 * nx), np.zeros(nz + 2 * nx)
        self._lifted, self._states, self._squares = slice(nz), slice(nz, nz + nx), slice(nz + nx, None)
        self._known = self._known_places(model)
        self._forget()

    def _state_rows(self, model: LinearPredictor | StateModel) -> Float[np.ndarray, "nx nz"]:
        """Return the matrix that reads the states from z."""
        return model.C if isinstance(model, LinearPredictor) else np.eye(self.ny, len(self.d))

    def _known_places(self, model: LinearPredictor | StateModel) -> slice:
        """Return where z is known beforehand."""
        if not isinstance(model, LinearPredictor):
            return slice(self.ny, None)
        known = model.lifting.constant_index
        return slice(0, 0) if known is None else slice(known, known + 1)

    def _forget(self) -> None:
        self._means[:] = 0.0
        self._learned = False
        self._sizes, self._weights = np.zeros(len(self._C)), np.zeros(len(self._C))
        self._last: Float[np.ndarray, " nz"] | None = None

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Forget the last state, all misfits, d and the past; x0 will come as the first measurement."""
        super().reset(x0)
        self._forget()

    def update(self, model: LinearPredictor | StateModel) -> None:
        """Go on with another model; d takes as long to follow as it took to come."""
        super().update(model)
        self._C = self._state_rows(model)

    def observe(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Take y, and learn from the misfit of the step that led here."""
        super().observe(y, u, w)
        z, last = self.z, self._last
        if not z.dot(z) < HUGE * HUGE:  # False for NaN
            self._last = None
            return False
        if last is not None:
            self._learn(z - self._model.advance(last, u, w, self._still), z - last)
        self._last = z.copy()
        return True

    def _learn(self, misfit: Float[np.ndarray, " nz"], moved: Float[np.ndarray, " nz"]) -> None:
        """Move d towards the mean of the misfits, by the share of them that was constant."""
        misfit[self._known] = 0.0
        if not misfit.dot(misfit) < HUGE * HUGE:
            return
        C, newest, means = self._C, self._newest, self._means
        states, step = C.dot(misfit), C.dot(moved)
        squares = states * states
        self._measure(np.maximum(step * step, squares))
        if self._learned:
            change = states - newest[self._states]
            newest[self._squares] = squares - 0.5 * change * change
        else:
            newest[self._squares] = squares
            self._learned = True
        newest[self._lifted], newest[self._states] = misfit, states
        means += self._gain * (newest - means)
        mean, believed = means[self._states], C.dot(self.d)
        mean = mean * mean
        varied = float(np.maximum(means[self._squares] - mean, 0.0).dot(self._weights))
        most = float(np.maximum(mean, believed * believed).dot(self._weights))
        if varied < most:
            self.d += (1.0 - varied / most) * (means[self._lifted] - self.d)

    def _measure(self, squares: Float[np.ndarray, " nx"]) -> None:
        """Weigh each state by one over the square of the largest step or misfit that it has shown."""
        if (squares > self._sizes).any():
            self._sizes = np.maximum(self._sizes, squares)
            np.divide(1.0, self._sizes, out=self._weights, where=self._sizes > 0)
