"""InitialCondition: where a plan starts, from what is measured and through the inputs that are still to act."""

from collections import deque
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError, ShapeError
from koopmpc.estimate.measured import Model
from koopmpc.estimate.observer import StateObserver
from koopmpc.lifting.buffered import HUGE
from koopmpc.predict.predictors import LinearPredictor

_VIEWS = ("z", "u_prev", "drive", "W", "d")


class LiftedModel(NamedTuple):
    """z⁺ = A z + B u + E w + d of a predictor."""

    predictor: LinearPredictor

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


class Sizes(NamedTuple):
    """Entries of z, u and w, and steps N of the plan."""

    nz: int
    nu: int
    nw: int
    N: int


class InitialCondition:
    """known = [z; u_{−1}; w_0 … w_{N−1}; d; 1] of the step at which an input computed now acts, L steps from now.

    z is predicted over these L steps, z ← A z + B u + E w + d with the inputs that are still to act. u_{−1} is there
    where the change of inputs counts, d where it is estimated. The parts are views: `z`, `u_prev`, `W`, `d`, and
    `drive`, which is W and d.

    Parameters
    ----------
    model
        What predicts.
    observer
        Gives z and d of the step of y.
    sizes
        Of z, u, w and the plan.
    latency
        L ≥ 0.
    with_rates
        Whether u_{−1} is needed.
    estimated
        Whether the observer finds d.
    remembers
        Whether the observer keeps past inputs. Where neither holds, and without latency, it learns no u and no w.
    """

    def __init__(
        self,
        model: Model,
        observer: StateObserver,
        sizes: Sizes,
        latency: int,
        *,
        with_rates: bool,
        estimated: bool,
        remembers: bool = False,
    ) -> None:
        self._model, self.observer, self._sizes, self._latency = model, observer, sizes, latency
        self._with_rates, self._estimated = with_rates, estimated
        self._signals = with_rates or sizes.nw > 0
        self._plain = not (estimated or latency or remembers)
        self._shape = (observer.ny,)
        nz, nu, nw, N = sizes
        self.known = np.zeros(nz + nu * with_rates + N * nw + nz * estimated + 1)
        self.known[-1] = 1.0
        self._ahead = np.zeros((latency + 1, nw))
        self._sent: deque[Float[np.ndarray, " nu"]] = deque(maxlen=latency + 1)
        self._see()
        self.reset(None, np.zeros(nu))

    def _see(self) -> None:
        """Make the views; a copy makes its own."""
        nz, nu, nw, N = self._sizes
        first = nz + nu * self._with_rates
        self.z = self.known[:nz]
        self.u_prev = self.known[nz:first]
        self.drive = self.known[first:-1]
        self.W, self.d = self.drive[: N * nw].reshape(N, nw), self.drive[N * nw :]

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in _VIEWS}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._see()

    def reset(self, x0: ArrayLike | None, last: Float[np.ndarray, " nu"]) -> None:
        """Start at x0, where it is known, with the input `last` acting until the first one arrives."""
        self.observer.reset(x0)
        self.drive[:] = 0.0
        self._sent.extend([last.copy()] * (self._latency + 1))
        self._w = np.zeros(self._sizes.nw)

    def update(self, model: Model) -> None:
        """Go on with another model of the same sizes; the observer is told by itself."""
        self._model = model

    def take(
        self, y: ArrayLike, last: Float[np.ndarray, " nu"], applied: ArrayLike | None, w: ArrayLike | None
    ) -> None:
        """Take y_k and write down where the plan starts; z is NaN where y cannot be used.

        Parameters
        ----------
        last
            The input that was computed last.
        applied
            What acted since the last call; by default the input that was computed L + 1 calls ago.
        w
            Measured disturbances (nw,), or rows w_k … w_{k+L+N−1}, the last repeated; zero by default.
        """
        if self._signals or w is not None:
            self._note(last, applied, w)
        measured = numbers(y, "y")
        observer = self.observer
        if measured.shape != self._shape:
            raise ShapeError(
                f"y has shape {measured.shape}, expected {self._shape}, one value a {_measured(self._estimated)}"
            )
        if self._plain:
            if applied is not None and numbers(applied, "applied").shape != last.shape:
                raise ShapeError(f"applied has shape {np.shape(applied)}, expected {last.shape}")
            observer.observe(measured, last, self._w)
            self.z[:] = observer.z
            return
        self._sent.append(last.copy())
        acted = self._sent[0]
        if applied is not None:
            got = numbers(applied, "applied")
            if got.shape != acted.shape:
                raise ShapeError(f"applied has shape {got.shape}, expected {acted.shape}")
            acted = got if (np.abs(got) < HUGE).all() else acted
        good = observer.observe(measured, acted, self._w)
        now = self._ahead[0]
        self._w = np.where(np.abs(now) < HUGE, now, self._w)  # not known: as it was
        z, d = observer.z if good else np.full_like(observer.z, np.nan), observer.d
        for i in range(self._latency):
            z = self._model.advance(z, self._sent[i + 1], self._ahead[i], d)
        self.z[:] = z
        if self._estimated:
            self.d[:] = d

    def _note(self, last: Float[np.ndarray, " nu"], applied: ArrayLike | None, w: ArrayLike | None) -> None:
        """Write down the last input and the preview of disturbances."""
        if self._with_rates:
            before = last  # what acted before the plan's first input
            if applied is not None and not self._latency:
                before = numbers(applied, "applied")
            if before.shape != self.u_prev.shape:
                raise ShapeError(f"applied has shape {before.shape}, expected {self.u_prev.shape}")
            self.u_prev[:] = before
        if w is None:
            self.W[:] = self._ahead[:] = 0.0
            return
        rows, nw = numbers(w, "w"), self._sizes.nw
        if nw == 0:
            raise DataError("w was passed, but the predictor has no E; fit it on episodes that hold W")
        steps = self._sizes.N + self._latency
        if rows.shape != (nw,) and (rows.ndim != 2 or rows.shape[1] != nw or len(rows) == 0):
            raise ShapeError(f"w has shape {rows.shape}, expected ({nw},), or rows of {nw} for steps k … k+{steps - 1}")
        if rows.ndim == 2 and len(rows) != steps:
            rows = rows[np.minimum(np.arange(steps), len(rows) - 1)]
        self._ahead[:] = rows if rows.ndim == 1 else rows[: self._latency + 1]
        self.W[:] = rows if rows.ndim == 1 else rows[self._latency :]


def numbers(value: ArrayLike | None, name: str) -> Float[np.ndarray, "..."]:
    """Return `value` as float64, itself where it is one already, for this is the control path.

    Raises
    ------
    DataError
        It is no array of numbers.
    """
    try:
        if value is not None:
            return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        pass
    return checks.array(value, name, finite=False)  # pyright: ignore[reportArgumentType]


def _measured(estimated: bool) -> str:
    return "measurement of the estimator" if estimated else "state"
