"""What an observer is: z and d of z⁺ = A z + B u + d now. `Measured` is the observer where the state is measured."""

from dataclasses import dataclass, field
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.values import Value
from koopmpc.data.delay import Delay
from koopmpc.estimate.gate import BRIDGED, Gated, ReadingGate, gate_graph
from koopmpc.lifting.base import Lifting, buffer_lifting
from koopmpc.models.predictors import LinearPredictor
from koopmpc.plants.graph import Graph


@runtime_checkable
class StateModel(Protocol):
    """The model z⁺ = F(z, u) + E w + d of a controller: a lifted linear one, or a map whose z is the state itself."""

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        ...

    @property
    def ny(self) -> int:
        """Number of the plant's states; y has as many entries where all of them are measured."""
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
        self._predictor, self.dt = predictor, predictor.dt
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


@dataclass(frozen=True, eq=False)
class EstimatorProgram(Value):
    """The data with which an observer finds z and d of y. As it stands: z = ψ(ζ), ζ of the measured y, and d = 0.

    The other kinds are `DisturbanceProgram` and `FilterProgram`.
    """

    # which readings are refused, see `koopmpc.estimate.gate`; None where an observer remembers no reading
    gate: Graph | None = field(default=None, kw_only=True)


class History:
    """ζ_k = [x_k, u_{k−1}, x_{k−1}, …] of a run.

    The first measurement also fills the past before it. A missed measurement makes x_k NaN in its own ζ_k; in later ζ
    the last measured state takes its place.
    """

    def __init__(self, embedding: Delay) -> None:
        self._embedding = embedding
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._zeta: Float[np.ndarray, " nzeta"] | None = None

    def take(self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " nzeta"]:
        """Return ζ after the step that led to x under u."""
        known, embedding = bool(np.isfinite(x).all()), self._embedding
        if self._zeta is None:
            zeta = embedding.repeat(x, u)
            self._zeta = zeta if known else None
            return zeta
        zeta = embedding.shift(self._zeta, u, x)
        self._zeta = zeta if known else embedding.bridge(self._zeta, u)
        return zeta


class Measured(Gated):
    """The observer without an estimator: z = ψ(ζ) of the measured y, or ζ itself; d is zero, or what it is set to.

    ζ is y, or under an embedding y with its past. Then a reading far from its prediction does not enter the past: the
    prediction stands in, see `ReadingGate`.
    """

    _remembers = False  # whether a reading acts on later estimates though the model has no delays

    def __init__(self, model: LinearPredictor | StateModel) -> None:
        self._to_y = model.C if isinstance(model, LinearPredictor) else None
        self._model = model = state_model(model)
        self._history = None if model.embedding is None else History(model.embedding)
        self.ny = model.ny
        self._gate = ReadingGate(model.ny, leaps=True) if self._remembers or model.embedding is not None else None
        self._nothing, self._known_z = np.full(model.ny, np.nan), False
        self._nothing_z = np.full(model.nz, np.nan)
        self._foreseen = self._nothing_z  # z of the last prediction
        self._expected = self._nothing_z  # z that the last reading was compared with; a gate may have chosen its w
        self._acted = np.zeros(model.nu)
        self._from = np.zeros(model.nz)  # z from which the next prediction starts
        self._bridged = 0  # readings missed in a row, for each of which a prediction stood in
        self.z: Float[np.ndarray, " nz"] = np.zeros(model.nz)
        self.d: Float[np.ndarray, " nz"] = np.zeros(model.nz)
        self.lift = None if model.lifting is None else buffer_lifting(model.lifting)
        entries = np.arange(model.nz)  # the Constant has no disturbance, nor the past of a state that is not lifted
        self._known = entries >= model.ny if model.lifting is None else entries == model.lifting.constant_index

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Forget d and the past; x0 will come as the first measurement."""
        checks.start(x0, self.ny)
        self.d[:] = 0.0
        if self._gate is not None:
            self._gate.reset()
        self._known_z, self._bridged = False, 0
        if self._history is not None:
            self._history.reset()

    def program(self) -> EstimatorProgram:
        """Return the data with which z and d are found."""
        return EstimatorProgram(gate=None if self._gate is None else gate_graph(self.ny, leaps=True))

    def update(self, model: LinearPredictor | StateModel) -> None:
        """Go on with another model; d takes as long to follow as it took to come."""
        self._to_y = model.C if isinstance(model, LinearPredictor) else None
        self._model = state_model(model)

    def observe(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Take y, or what was expected of it; where it is lifted, a bad entry makes all of z NaN."""
        expected = self._nothing_z
        if self._gate is not None:
            if self._known_z:
                self._acted = u
                if len(w):
                    self._gate.choose(y, w, self._predict)
                else:
                    self._predict(w)
                expected = self._foreseen
            y = self._check_reading(self._gate, y, expected)
        if self._history is not None:
            y = self._history.take(y, u)
        if self.lift is None:
            self.z = y
        else:
            self.lift.arguments[0][:] = y
            self.lift.evaluate()
            self.z = self.lift.results[0]
        self._expected = expected
        if self._gate is not None:
            self._follow(expected)
        return True

    def _follow(self, expected: Float[np.ndarray, " nz"]) -> None:
        """Have the next prediction start from z, or for some missed readings from its prediction."""
        known = bool(np.isfinite(self.z).all())
        bridges = not known and self._known_z and self._bridged < BRIDGED
        self._from[:] = expected if bridges else self.z
        self._bridged = self._bridged + 1 if bridges else 0
        self._known_z = known or bridges

    def _predict(self, w: Float[np.ndarray, " nw"]) -> Float[np.ndarray, " ny"]:
        """Store the z that the last input and w predict, and return what it shows."""
        self._foreseen = self._model.advance(self._from, self._acted, w, self.d)
        return self._show(self._foreseen)

    def _show(self, z: Float[np.ndarray, " nz"]) -> Float[np.ndarray, " ny"]:
        return z[: self.ny] if self._to_y is None else self._to_y.dot(z)

    def _check_reading(
        self, gate: ReadingGate, y: Float[np.ndarray, " ny"], z: Float[np.ndarray, " nz"]
    ) -> Float[np.ndarray, " ny"]:
        """Return y, or what this z shows where y is refused."""
        predicted = self._show(z)
        if self._model.embedding is not None:
            predicted = self._model.embedding.clip(predicted)
        refused = gate.judge(y, predicted)
        if gate.lost and self._history is not None:
            self._history.reset()
            self._known_z = False
        return predicted if refused else y


def start_observer(estimator: Estimator | None, model: LinearPredictor | StateModel, horizon: int) -> StateObserver:
    """Return the observer of one controller with plans of this many steps; without an estimator y is the state."""
    if estimator is None:
        return Measured(model)
    can_start = isinstance(cast(object, estimator), Estimator) and callable(estimator.start)  # a range has a start, too
    if isinstance(estimator, type) or not can_start:
        raise DataError(f"estimator is {estimator!r}; pass an object, for example km.LiftedDisturbance()")
    return estimator.start(model, horizon)


def estimator_program(observer: StateObserver, estimator: Estimator | None) -> EstimatorProgram:
    """Return the data of an observer."""
    if "program" not in vars(type(observer)):
        raise DataError(
            f"the estimator {type(estimator).__name__} cannot be written in C; use LiftedDisturbance or LiftedKalman"
        )
    return cast("Measured", observer).program()
