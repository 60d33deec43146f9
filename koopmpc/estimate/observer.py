"""What a controller asks about its present: z and d of z⁺ = A z + B u + d, where the state itself is measured.

The observers here take the state as it was measured: without a disturbance, or with one filtered from the misfits.
"""

from dataclasses import dataclass
from math import exp
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.delay import Delay
from koopmpc.errors import DataError
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.buffered import HUGE, buffered
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.values import Value


@runtime_checkable
class StateModel(Protocol):
    """z⁺ = F(z, u) + E w + d of a controller: a lifted linear model, or a map whose z is the state itself."""

    @property
    def ny(self) -> int:
        """Number of the plant's states, which y holds where all is measured."""
        ...

    @property
    def nz(self) -> int:
        """Number of entries of z."""
        ...

    @property
    def nu(self) -> int:
        """Number of inputs."""
        ...

    @property
    def nw(self) -> int:
        """Number of measured disturbances."""
        ...

    @property
    def lifting(self) -> Lifting | None:
        """The ψ of z = ψ(ζ); None where z is ζ."""
        ...

    @property
    def embedding(self) -> Delay | None:
        """What makes ζ of the plant's state and its past; None where ζ is that state."""
        ...

    def advance(
        self,
        z: Float[np.ndarray, " nz"],
        u: Float[np.ndarray, " nu"],
        w: Float[np.ndarray, " nw"],
        d: Float[np.ndarray, " nz"],
    ) -> Float[np.ndarray, " nz"]:
        """Return z⁺."""
        ...


class LiftedModel:
    """z⁺ = A z + B u + E w + d of a linear predictor, z = ψ(ζ): a `StateModel`."""

    def __init__(self, predictor: LinearPredictor) -> None:
        self._predictor = predictor
        self.ny, self.nz, self.nu, self.nw = predictor.nx, predictor.nz, predictor.nu, predictor.nw
        self.lifting, self.embedding = predictor.lifting, predictor.embedding

    def advance(
        self,
        z: Float[np.ndarray, " nz"],
        u: Float[np.ndarray, " nu"],
        w: Float[np.ndarray, " nw"],
        d: Float[np.ndarray, " nz"],
    ) -> Float[np.ndarray, " nz"]:
        """Return z⁺."""
        model = self._predictor
        z_next = model.A.dot(z)
        z_next += model.B.dot(u)
        if self.nw:
            z_next += model.E.dot(w)
        z_next += d
        return z_next


def state_model(model: LinearPredictor | StateModel) -> StateModel:
    """Return the model itself, or that of a linear predictor."""
    return LiftedModel(model) if isinstance(model, LinearPredictor) else model


@runtime_checkable
class StateObserver(Protocol):
    """The estimate of one run: z and d hold until the next `observe`."""

    @property
    def ny(self) -> int:
        """Number of measurements in y."""
        ...

    @property
    def z(self) -> Float[np.ndarray, " nz"]:
        """The state of the model now, lifted where the model is."""
        ...

    @property
    def d(self) -> Float[np.ndarray, " nz"]:
        """The disturbance of z⁺ = F(z, u) + E w + d, held constant over the horizon."""
        ...

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Forget everything; the run starts at x0, where it is known."""
        ...

    def update(self, model: Any) -> None:
        """Go on with another model, of the kind and the lifting that the observer was started with."""
        ...

    def observe(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Take y; u and w acted since the last call. Return whether z and d can be used."""
        ...


@runtime_checkable
class Estimator(Protocol):
    """A rule of estimation: `LiftedDisturbance`, `LiftedKalman`, or a user's own."""

    def start(self, model: Any, horizon: int) -> StateObserver:
        """Return the observer of one controller.

        Parameters
        ----------
        model
            The LinearPredictor of a KoopmanMPC; of the other controllers, which plan in the state's own coordinates,
            their `StateModel`.
        horizon
            Steps of the controller's plan.
        """
        ...


class History:
    """ζ_k = [x_k, u_{k−1}, x_{k−1}, …] of a run.

    The first measurement stands in for what was before it. A missed one makes the x_k of its own ζ_k NaN; in those that
    follow, the last state that was measured stands in.

    Parameters
    ----------
    embedding
        Bound.
    """

    def __init__(self, embedding: Delay) -> None:
        self._embedding, self._nx = embedding, len(embedding.states)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._zeta: Float[np.ndarray, " nzeta"] | None = None

    def take(self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nzeta"]:
        """Return ζ after the step that led to x under u."""
        known, embedding = bool(np.isfinite(x).all()), self._embedding
        if self._zeta is None:
            zeta = embedding.held(x, u)
            self._zeta = zeta if known else None
            return zeta
        zeta = embedding.shifted(self._zeta, u, x)
        self._zeta = zeta if known else embedding.shifted(self._zeta, u, self._zeta[: self._nx])
        return zeta


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
        self._lift.arguments[0][:] = y
        self._lift.evaluate()
        self.z = self._lift.results[0]
        return True


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
