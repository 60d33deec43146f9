"""ExtendedKalman: a Kalman filter on a nonlinear model, with delays or a hidden state, from measured outputs."""

from copy import copy
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.errors import DataError
from koopmpc.base.values import Value
from koopmpc.estimate.disturbance import GAIN
from koopmpc.estimate.filter import find_kalman_gain
from koopmpc.estimate.gate import Gated, ReadingGate
from koopmpc.estimate.kalman import NOT_TOGETHER
from koopmpc.estimate.observer import StateModel
from koopmpc.models.hidden_state import HiddenState
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.plants.step_map import StepMap

PROCESS = 1e-4  # default variance of the process noise, as a share of that of the outputs
LEAST = 1e-8  # variance of the noise of y, as a share of that of the outputs, where a fit leaves no residual
PATIENCE = 10  # samples in sequence without any reading that are bridged by prediction


@dataclass(frozen=True, eq=False)
class ExtendedKalman(Value):
    """Extended Kalman filter on s = [x; d]: x⁺ = F(x, u) + E w + Γ (d + noise), d⁺ = d + noise, y = h(x) + noise.

    It serves the controllers that plan in the state's own coordinates: BilinearMPC and NonlinearMPC. Of a predictor F
    is the re-lifted map. With delays x is ζ, so readings of the past are filtered too; with a hidden state x is
    [y; z], and z is corrected by what y shows. Each step linearises F at the estimate exactly, and the h of a StepMap
    by differences. d is an additive disturbance of the outputs, one for each, so that a controller leaves no offset.

    Entries of y that are NaN are left out. A reading at a rail of its sensor with a prediction at it or beyond is left
    out too: it tells nothing more. A reading far from its prediction is refused, for at most six steps in sequence.

    Of a StepMap y is its own output h(x), which may be less than the state; then d is zero, and an offset may remain.

    There is no C code for it.

    Parameters
    ----------
    process, drift, noise
        Variances of what enters an output in a step, of a step of d, and of y; a scalar, or one for each output. By
        default `noise` is that of the fit's residuals, and `process` a standard deviation of 1 % of the outputs' size;
        a model that was given has sizes of one. With the default `drift` an error of d dies out within the horizon, and
        within the 38 steps of a mean with gain 0.1.
    feedthrough
        The plant has y = h(x, u), and the model is one of log rows with inputs moved one row up: see `LiftedKalman`. A
        reading is then the model's next output under the input of the step before.

    Raises
    ------
    DataError
        A variance is below zero; feedthrough of a StepMap, whose own output says what y is, or with measured
        disturbances; when a controller is built, its model is linear and lifted once, as in KoopmanMPC.

    References
    ----------
    Anderson & Moore, "Optimal Filtering", 1979, section 8.2.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=60, steps=30)
    >>> model = km.bilinear_edmd(data, km.State() + km.Fourier(2, states="theta"), difference=True)
    >>> cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-25, u_max=25)
    >>> mpc = km.BilinearMPC(model, cost, limits, horizon=20, estimator=km.ExtendedKalman())
    >>> mpc([0.1, 0.0], [0, 0]).status.name
    'UNCONSTRAINED'
    """

    process: ArrayLike | None = None
    drift: ArrayLike | None = None
    noise: ArrayLike | None = None
    feedthrough: bool = False

    def __post_init__(self) -> None:
        checks.kind(self.feedthrough, "feedthrough", (bool, np.bool_), "pass True or False")
        for name in ("process", "drift", "noise"):
            if getattr(self, name) is not None:
                variance = checks.array(getattr(self, name), name)
                if variance.ndim > 1 or (variance < 0).any():
                    raise DataError(f"{name} must be a variance, or one for each output, of zero or above")
                object.__setattr__(self, name, variance)

    def start(self, model: LinearPredictor | StateModel, horizon: int) -> "ExtendedObserver":
        """Return the observer of one controller with plans of this many steps.

        Raises
        ------
        DataError
            The model is linear and lifted once; or it is of a kind that cannot be linearised.
        """
        if isinstance(model, LinearPredictor):
            raise DataError(
                "this controller's model is linear in z, for which LiftedKalman(outputs=model.C) is the Kalman filter; "
                "pass that, or use a BilinearMPC"
            )
        return ExtendedObserver(self, model, max(GAIN, min(4.0 / horizon, 1.0)))


class ExtendedObserver(Gated):
    """The observer of an `ExtendedKalman`."""

    _gate: ReadingGate

    def __init__(self, rule: ExtendedKalman, model: StateModel, gain: float) -> None:
        self._rule, self._settle = rule, gain
        self._take(model)
        self._gate = ReadingGate(self.ny, leaps=True)
        self.z: Float[np.ndarray, " nz"] = np.zeros(model.nz)
        self.d: Float[np.ndarray, " nz"] = np.zeros(model.nz)
        self.reset()

    def _take(self, model: StateModel) -> None:
        """Take over the map of a model, and what its noise is by default."""
        given: object = getattr(model, "model", None)
        self._model, n = model, model.nz
        self._embedding = model.embedding
        if isinstance(given, StepMap):
            if self._rule.feedthrough:
                raise DataError(
                    "feedthrough is a matter of fitted models; give the StepMap an output h(x, u), and leave it out"
                )
            self._map, self.ny, self._disturbed = given, given.ny, given.measures_all
            size, residual = np.ones(self.ny), np.zeros(self.ny)
            self._enters = np.eye(n)
        elif isinstance(given, LinearPredictor | BilinearPredictor):
            if self._rule.feedthrough and given.nw:
                raise DataError(NOT_TOGETHER)
            self._map, self.ny, self._disturbed = _open_map(given), given.nx, True
            size = np.ones(self.ny) if given.scale is None else np.linalg.norm(given.scale @ given.C.T, axis=0)
            residual = np.zeros(self.ny) if given.report is None else given.report.residual
            self._enters = np.eye(n, self.ny)
            if isinstance(given.embedding, HiddenState):  # noise enters z, and shows in y
                self._enters = np.vstack([given.embedding.C, np.eye(given.embedding.order)])
        else:
            raise DataError(
                "ExtendedKalman needs the equations of the controller's model; pass a predictor or a StepMap to a "
                "BilinearMPC or a NonlinearMPC"
            )
        size = np.where(size > 0, size, 1.0)
        count = self._enters.shape[1]
        noise = np.where(residual > 0, np.maximum(residual**2, LEAST * size**2), PROCESS * size**2)
        self._R = np.diag(self._fill(self._rule.noise, noise))
        usual = PROCESS * size**2 if count == self.ny else np.full(count, PROCESS)
        process = usual if self._rule.process is None else np.resize(np.asarray(self._rule.process), count)
        self._Q = self._enters @ np.diag(process) @ self._enters.T
        drift = self._settle**2 * (np.diag(self._R) + self._Q.diagonal()[: self.ny])
        self._drift = np.diag(self._fill(self._rule.drift, drift)) if self._disturbed else np.zeros((self.ny, self.ny))
        self._size = size

    def _fill(self, given: ArrayLike | None, usual: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
        if given is None:
            return usual
        return np.broadcast_to(checks.array(given, "a variance"), usual.shape).astype(np.float64)

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Forget everything; the run starts at x0, where it is known, or at the first reading."""
        self._begun, self._missed, n = False, 0, self._model.nz
        self._start = None if x0 is None else checks.array(x0, "x0")
        self.z[:], self.d[:] = 0.0, 0.0
        self._P = np.zeros((n + self.ny, n + self.ny))
        self._gate.reset()

    def update(self, model: StateModel) -> None:
        """Go on with another model, from the same estimate."""
        self._take(model)

    def observe(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Predict with the inputs that acted, and correct with the entries of y that have come and tell something.

        False says that the estimate cannot be used: readings have been missing for too long, or it has run away.
        """
        if not self._begun:
            return bool(np.isfinite(y).all()) and self._begin(y, u, np.ones(self.ny, dtype=np.bool_))
        n, ny = self._model.nz, self.ny
        F = np.eye(n + ny)
        if len(w):
            self._gate.choose(y, w, lambda w: self._predict_reading(self._model.advance(self.z, u, w, self.d), u, w)[1])
            w = self._gate.w
        F[:n, :n] = self._slope(self.z, u, w)
        F[:ny, n:] = np.eye(ny) if self._disturbed else 0.0
        z = np.array(self._model.advance(self.z, u, w, self.d), dtype=np.float64)
        Q = scipy.linalg.block_diag(self._Q, self._drift)
        P = F @ self._P @ F.T + Q
        H, predicted = self._predict_reading(z, u, w)
        came = np.abs(y) < HUGE  # False for NaN
        useful = came if self._embedding is None else came & ~self._embedding.is_beyond(y, predicted)
        shown = np.where(useful | ~came, y, predicted)
        refused = self._gate.judge(shown, predicted)
        if self._gate.lost:
            self.d[:] = 0.0
            return self._begin(y, u, useful)
        s = np.concatenate([z, self.d[:ny]])
        if useful.any() and not refused:
            s, P = self._correct(s, P, H[useful], self._R[np.ix_(useful, useful)], (y - predicted)[useful])
        self._P = 0.5 * (P + P.T)
        self._missed = 0 if came.any() else self._missed + 1
        self.z[:] = s[:n]
        self.d[:ny] = s[n:] if self._disturbed else 0.0
        return self._missed <= PATIENCE and bool(np.abs(s).max() < HUGE)

    def _begin(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], useful: Bool[np.ndarray, " ny"]) -> bool:
        """Start at x0, or from these entries of y; of a lost estimate the others are 0, or x0's if this is z."""
        n, embedding, entries, spread = self._model.nz, self._embedding, np.flatnonzero(useful), np.ones(self._model.nz)
        if embedding is not None:
            self.z[:] = embedding.repeat(np.where(useful, y, 0.0), u)
            spread = embedding.spread(self._size, np.zeros(self._model.nu))
        else:
            known = self._start is not None and len(self._start) == n
            self.z[:] = self._start if known else 0.0
            if self._begun or not known:
                self.z[entries] = y[entries]
        self._P = scipy.linalg.block_diag(np.diag(0.1 * spread**2), self._drift)
        self._P[np.ix_(entries, entries)] = self._R[np.ix_(entries, entries)]
        self._begun = True
        return True

    def _correct(
        self,
        s: Float[np.ndarray, " ns"],
        P: Float[np.ndarray, "ns ns"],
        H: Float[np.ndarray, "m ns"],
        R: Float[np.ndarray, "m m"],
        gap: Float[np.ndarray, " m"],
    ) -> tuple[Float[np.ndarray, " ns"], Float[np.ndarray, "ns ns"]]:
        """Return s and P after a reading, in Joseph's form."""
        K = find_kalman_gain(P, H, R)
        kept = np.eye(len(s)) - K @ H
        return s + K @ gap, kept @ P @ kept.T + K @ R @ K.T

    def _slope(
        self, z: Float[np.ndarray, " nz"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]
    ) -> Float[np.ndarray, "nz nz"]:
        """Return ∂F/∂x."""
        slope = getattr(self._model, "slope", None) if getattr(self._model, "scheduled", 0) else None
        return self._map.linearize(z, u).A if slope is None else slope(z, u, w)

    def _predict_reading(
        self, z: Float[np.ndarray, " nz"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]
    ) -> tuple[Float[np.ndarray, "ny ns"], Float[np.ndarray, " ny"]]:
        """Return ∂y/∂[z; d] and y; with feedthrough those of the next output under u, which has acted last."""
        ny = self.ny
        if not self._rule.feedthrough:
            return np.hstack([self._output_slope(z), np.zeros((ny, ny))]), self._output(z)
        slope = np.hstack([self._slope(z, u, w)[:ny], np.eye(ny)])
        return slope, np.array(self._model.advance(z, u, w, self.d), dtype=np.float64)[:ny]

    def _output(self, z: Float[np.ndarray, " nz"]) -> Float[np.ndarray, " ny"]:
        return self._map.measure(z)[: self.ny] if self._embedding is None else z[: self.ny]

    def _output_slope(self, z: Float[np.ndarray, " nz"]) -> Float[np.ndarray, "ny nz"]:
        """Return ∂h/∂x, by differences where the state does not hold the output."""
        n, ny = len(z), self.ny
        if self._disturbed:
            return np.eye(ny, n)
        step = 1e-6 * np.maximum(np.abs(z), 1.0)
        rows: list[Bool[np.ndarray, " ny"] | Float[np.ndarray, " ny"]] = []
        for i in range(n):
            up, down = z.copy(), z.copy()
            up[i], down[i] = z[i] + step[i], z[i] - step[i]
            rows.append((self._map.measure(up) - self._map.measure(down)) / (2 * step[i]))
        return np.array(rows).T


def _open_map(model: LinearPredictor | BilinearPredictor) -> StepMap:
    """Return the re-lifted map of a model whose sensors have no limits."""
    if model.embedding is None or model.embedding.rails is None:
        return model.step_map()
    other = copy(model)
    object.__setattr__(other, "embedding", model.embedding.without_rails())
    return other.step_map()
