"""Monitor: the region of a model's data and its errors there, to ask at each step whether the loop is inside both."""

from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.control.step.observe import InitialCondition
from koopmpc.control.watching import StepMonitor, register_monitor
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.estimate.observer import StateModel
from koopmpc.lifting.base import Lifting, buffer_lifting
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.validate.scoring import embed_episodes, forecast_errors


@dataclass(frozen=True, eq=False)
class Monitor(StepMonitor):
    """‖L [ψ(x); u]‖² ≤ 1 where the data were, and ‖W (x⁺ − x̂⁺)‖² ≤ 1 where the model predicts as it did there.

    ‖L v‖² is the leverage vᵀ (VᵀV)⁻¹ v of v = [ψ(x); u] over the rows V of the data, divided by its `level` quantile
    among them; ‖W e‖² is the squared one-step error in units of its covariance, divided by the conformal quantile of
    the same level. On new data like these a step is outside of either with a probability of about 1 − level. Make one
    by `Monitor.of`.

    Attributes
    ----------
    leverage
        (nz + nu, nz + nu) L.
    band
        (nx, nx) W.
    level
        Share of the data that is inside.
    lifting
        ψ, bound.
    """

    leverage: Float[np.ndarray, "n n"]
    band: Float[np.ndarray, "nx nx"]
    level: float
    lifting: Lifting

    @classmethod
    def of(cls, model: LinearPredictor | BilinearPredictor, data: Episodes, *, level: float = 0.99) -> "Monitor":
        """Return the monitor of a model and its data.

        Parameters
        ----------
        model
            The predictor of the controller.
        data
            The episodes that it was fitted to. Where the fit is close, pass held-out episodes: on its own data the
            errors are too small.
        level
            Share of these data that counts as known, in each of the two checks.

        Raises
        ------
        DataError
            The data are of another plant, or have fewer than 1 / (1 − level) rows; the level is not inside (0, 1).
        """
        level = checks.positive(level, "level")
        if level >= 1:
            raise DataError(f"level is {level:g}; it must lie between 0 and 1, 0.99 calls 1 % of the data unknown")
        points = embed_episodes(model, episodes_of(data), 1)
        V = np.concatenate([np.hstack([model.lifting(e.X[:-1]), e.U[:, : model.nu]]) for e in points])
        starts = [np.arange(len(e)) for e in points]
        E = np.concatenate([gap[0] for gap, _ in forecast_errors(model, points, starts, 1)])
        X = np.concatenate([e.X[:, : model.nx] for e in points])
        rank = int(np.ceil((len(V) + 1) * level - 1e-9))
        if rank > len(V):
            raise DataError(
                f"the data have {len(V)} rows, at least {int(np.ceil(level / (1 - level) - 1e-9))} are needed for a "
                f"level of {level:g}; pass more data, or a lower level"
            )
        # share of a state's size that a prediction may always be off
        return cls(_bounds(V, 0.0, V, rank), _bounds(E, 1e-9, X, rank), level, model.lifting)

    def watch(self, model: LinearPredictor | StateModel, latency: int) -> "Watch":
        """Return the watch of one closed loop, whose inputs act `latency` steps late."""
        return Watch(self, model, latency)


def _bounds(
    rows: Float[np.ndarray, "M n"], share: float, of: Float[np.ndarray, "K n"], rank: int
) -> Float[np.ndarray, "n n"]:
    """Return G with ‖G v‖² = 1 for the rank-th smallest of the rows, and ≤ 1 for this share of a column of `of`."""
    floor = share * np.sqrt((of**2).mean(axis=0))
    norm = np.sqrt((rows**2).mean(axis=0) + floor**2)
    norm = np.where(norm > 0, norm, 1.0)
    scaled = rows / norm
    values, Q = np.linalg.eigh(scaled.T @ scaled / len(rows) + np.diag((floor / norm) ** 2))
    # share of the widest direction of the data below which a direction counts as this wide
    G = (Q / np.sqrt(np.maximum(values, 1e-9 * values.max()))).T / norm  # mean ‖G v‖² = n
    bound = max(np.sort(((rows @ G.T) ** 2).sum(axis=1))[rank - 1], ((G * floor) ** 2).sum(axis=0).max())
    return G / np.sqrt(bound) if bound > 0 else G


def make_monitor(given: object, model: object) -> Monitor:
    """Return the monitor that a controller's argument ``monitor=`` stands for; of Episodes it is made."""
    if not isinstance(model, LinearPredictor | BilinearPredictor):
        raise DataError("a monitor compares with data, and this controller's model is not learned; leave out monitor=")
    monitor = Monitor.of(model, given) if isinstance(given, Episodes) else given
    checks.kind(monitor, "monitor", Monitor, "make one by km.supervise.Monitor.of(model, data), or pass the data")
    monitor = cast("Monitor", monitor)
    if monitor.lifting != model.lifting or len(monitor.leverage) != model.nz + model.nu:
        raise DataError("the monitor is of another lifting than the controller's model; make one of this model")
    return monitor


register_monitor(make_monitor)


class Watch:
    """The monitor in one closed loop: whether the last step was `inside` the data, and whether the prediction `fits`.

    The state is compared with its prediction from the step before, with the input that the plant got, the measured
    disturbances and the estimated one.
    The prediction is that of the plan's start, `latency` steps ahead, until which no input acts.
    """

    def __init__(self, monitor: Monitor, model: LinearPredictor | StateModel, latency: int) -> None:
        self.monitor, self._latency = monitor, latency
        self._nz = monitor.lifting.nz
        self._psi = None if isinstance(model, LinearPredictor) else buffer_lifting(monitor.lifting)
        self.update(model)
        self.reset()

    def update(self, model: LinearPredictor | StateModel) -> None:
        """Compare with the predictions of another model from now on; region and band stay."""
        self._model = model
        if isinstance(model, LinearPredictor):
            self._output = self.monitor.band @ model.C  # W C
            self._ahead = self._output @ np.hstack([model.A, model.B])
            self._pushed = self._output @ model.E

    def reset(self) -> None:
        """Forget the step before: the first step of a run has no prediction to be compared with."""
        self.inside = self.fits = True
        self._before: _StepBefore | None = None

    def look(self, start: InitialCondition, u: Float[np.ndarray, " nu"], applied: ArrayLike | None) -> bool:
        """Return whether the step that starts here, with input u, is known."""
        nz, psi, before = self._nz, self._psi, self._before
        point = np.empty(nz + len(u))
        point[nz:] = u
        if psi is None:
            point[:nz] = start.z
        else:
            psi.arguments[0][:] = start.z
            psi.evaluate()
            point[:nz] = psi.results[0]
        reach = self.monitor.leverage.dot(point)
        self.inside = bool(reach.dot(reach) <= 1.0)
        self.fits = True
        if before is not None:
            if applied is not None and not self._latency:
                before.point[nz:] = applied
            error = self._find_error(before, start.z)
            self.fits = bool(error.dot(error) <= 1.0)
        w = start.W[0].copy() if start.W.size else _NOTHING
        self._before = _StepBefore(point, point if psi is None else start.z.copy(), w, start.d.copy())
        return self.inside and self.fits

    def _find_error(self, before: "_StepBefore", z: Float[np.ndarray, " n"]) -> Float[np.ndarray, " nx"]:
        """Return W (x̂ − x), where x̂ is the prediction from the step before."""
        model, (point, start, w, d) = self._model, before
        if isinstance(model, LinearPredictor):
            error = self._ahead.dot(point)
            error -= self._output.dot(z)
            if d.size:
                error += self._output.dot(d)
            return error + self._pushed.dot(w) if w.size else error
        W = self.monitor.band
        drift = d if d.size else np.zeros(len(z))
        return W.dot((model.advance(start, point[self._nz :], w, drift) - z)[: len(W)])


class _StepBefore(NamedTuple):
    """[ψ(x); u] of a step, where its prediction starts, its measured and its estimated disturbance."""

    point: Float[np.ndarray, " n"]
    start: Float[np.ndarray, " m"]
    w: Float[np.ndarray, " nw"]
    d: Float[np.ndarray, " nd"]


_NOTHING = np.zeros(0)
