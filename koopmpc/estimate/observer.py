"""What a controller asks about its present: the lifted state z and the disturbance d of z⁺ = A z + B u + d."""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.data.delay import Delay
from koopmpc.errors import ObservableError
from koopmpc.lifting.base import Lifting, short
from koopmpc.predict.predictors import LinearPredictor


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


@dataclass(frozen=True)
class LiftedModel:
    """z⁺ = A z + B u + E w + d of a linear predictor, z = ψ(ζ)."""

    predictor: LinearPredictor

    @property
    def ny(self) -> int:
        """Number of the plant's states."""
        return self.predictor.nx

    @property
    def nz(self) -> int:
        """Number of observables."""
        return self.predictor.nz

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.predictor.nu

    @property
    def nw(self) -> int:
        """Number of measured disturbances."""
        return self.predictor.nw

    @property
    def lifting(self) -> Lifting:
        """The ψ of z = ψ(ζ)."""
        return self.predictor.lifting

    @property
    def embedding(self) -> Delay | None:
        """What makes ζ of the plant's state and its past."""
        return self.predictor.embedding

    def advance(
        self,
        z: Float[np.ndarray, " nz"],
        u: Float[np.ndarray, " nu"],
        w: Float[np.ndarray, " nw"],
        d: Float[np.ndarray, " nz"],
    ) -> Float[np.ndarray, " nz"]:
        """Return z⁺."""
        model = self.predictor
        return model.A @ z + model.B @ u + model.E @ w + d


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

    def start(self, model: Any) -> StateObserver:
        """Return the observer of one controller.

        Parameters
        ----------
        model
            The LinearPredictor of a KoopmanMPC; of the other controllers, which plan in the state's own coordinates,
            their `StateModel`.
        """
        ...


def constant_index(predictor: LinearPredictor) -> int | None:
    """Return where the lifting holds the Constant, which is known; None where it does not."""
    return predictor.lifting.constant_index


def places(lifting: Lifting, names: tuple[str, ...]) -> list[int]:
    """Return the indices of observables by name, with or without the unit.

    Raises
    ------
    ObservableError
        The lifting lacks one of them.
    """
    place = {short(name): i for i, name in enumerate(lifting.names)}
    place |= {name: i for i, name in enumerate(lifting.names)}
    for name in names:
        if name not in place:
            raise ObservableError(
                f"the lifting lacks {name!r}; add it to the lifting: it holds {', '.join(lifting.names)}"
            )
    return [place[name] for name in names]


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
