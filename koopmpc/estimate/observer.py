"""What a controller asks of an estimator: the lifted state z and the disturbance d of z⁺ = A z + B u + d."""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.data.delay import Delay
from koopmpc.errors import ObservableError
from koopmpc.lifting.base import Lifting, short
from koopmpc.lifting.state import Constant
from koopmpc.predict.predictors import LinearPredictor


@runtime_checkable
class StateObserver(Protocol):
    """The estimate of one run: z and d hold until the next `observe`."""

    @property
    def ny(self) -> int:
        """Number of measurements in y."""
        ...

    @property
    def z(self) -> Float[np.ndarray, " nz"]:
        """The lifted state now."""
        ...

    @property
    def d(self) -> Float[np.ndarray, " nz"]:
        """The disturbance of z⁺ = A z + B u + d, held constant over the horizon."""
        ...

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Forget everything; the run starts at x0, where it is known."""
        ...

    def update(self, predictor: Any) -> None:
        """Go on with another model, of the kind and the lifting that it was started with."""
        ...

    def observe(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Take y; u and w acted since the last call. Return whether z and d can be used."""
        ...


@runtime_checkable
class Estimator(Protocol):
    """A rule of estimation: `LiftedDisturbance`, `LiftedKalman`, or a user's own."""

    def start(self, predictor: LinearPredictor) -> StateObserver:
        """Return the observer of one controller."""
        ...


def constant_index(predictor: LinearPredictor) -> int | None:
    """Return where the lifting holds the Constant, which is known; None where it does not."""
    name = Constant().bind(predictor.states).names[0]
    names = predictor.lifting.names
    return names.index(name) if name in names else None


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


def history_of(embedding: Delay | None) -> History | None:
    """Return the history that an observer keeps; None without an embedding."""
    return None if embedding is None else History(embedding)
