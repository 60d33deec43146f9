"""LiftedKalman: a Kalman filter on [z; d], from some measured observables, which may be late or missing at times.

`KalmanFilter` predicts, corrects with what has come and predicts on through a delay; `LiftedKalman` finds its matrices.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import exp, log
from typing import Literal, cast

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Complex, Float, Int
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.checks import HUGE
from koopmpc.errors import DataError, ObservableError, ShapeError
from koopmpc.estimate.disturbance import GAIN
from koopmpc.estimate.gate import ReadingGate, gate_graph
from koopmpc.estimate.observer import EstimatorProgram, StateModel
from koopmpc.estimate.periodic import NO_CODE, find_harmonics
from koopmpc.lifting.base import Lifting, strip_unit
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.values import Value, Viewing

PROCESS = 1e-4  # default variance of the process noise, in the model's units
NOISE = 1e-4  # default variance of the measurement noise, in the model's units
DRIFTS = 10.0 ** np.arange(
    -8.0, 1.0
)  # candidate variances of d's random walk; the smallest one that settles in time is used
SLOWEST = -1 / log(1 - GAIN)  # steps that d takes to settle, at most: those of a mean of this gain
LEAST = 1e-8  # variance of the noise if a fit leaves no residual
NOT_TOGETHER = "feedthrough and measured disturbances do not go together; fit the model without W"
TOLERANCE = 1e-6  # singular values below this share of the largest, or of |λ|; |λ| as near to 1 does not die out


class Augmented:
    """s⁺ = F s + G [u; w] + f, y = M s + h for s = [z; d] without the Constant's coordinate.

    A controller on z⁺ = A z + B u + d gets z + H⁺C_d d for z and B_d d + (I − A) H⁺C_d d for d, both linear in s. In
    these shifted coordinates H z is y itself, the offset of y included.
    """

    def __init__(
        self,
        predictor: LinearPredictor,
        kept: Int[np.ndarray, " n"],
        H: Float[np.ndarray, "ny nz"],
        Bd: Float[np.ndarray, "nz nd"],
        Cd: Float[np.ndarray, "ny nd"],
        turns: Float[np.ndarray, " h"] | None = None,
    ) -> None:
        self.turn: Float[np.ndarray, "nd nd"] = np.eye(Cd.shape[1])
        self.steady = Cd.shape[1]
        if turns is not None:  # beside each constant d the cosine and the sine of each harmonic, [d; c_1; s_1; c_2; …]
            rotations = [np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]) for a in turns]
            shown = np.tile([1.0, 0.0], len(turns))
            self.turn = np.kron(scipy.linalg.block_diag(np.eye(1), *rotations), np.eye(Cd.shape[1]))
            Bd, Cd = (np.hstack([part, np.kron(shown, part)]) for part in (Bd, Cd))
        nz, nd, n = predictor.nz, Cd.shape[1], len(kept)
        self.predictor, self.kept = predictor, kept
        A, known = predictor.A[np.ix_(kept, kept)], np.delete(np.arange(nz), kept)
        self.F = np.block([[A, Bd[kept]], [np.zeros((nd, n)), self.turn]])
        driven = np.hstack([predictor.B, predictor.E])[kept]
        self.G = np.vstack([driven, np.zeros((nd, driven.shape[1]))])
        self.f = np.append(predictor.A[np.ix_(kept, known)].sum(axis=1), np.zeros(nd))
        self.M = np.hstack([H[:, kept], Cd])
        self.h = H[:, known].sum(axis=1)
        shift = np.linalg.pinv(H[:, kept]) @ Cd
        self.to_z = np.zeros((nz, n + nd))
        self.to_z[kept, np.arange(n)], self.to_z[kept, n:] = 1.0, shift
        self.one = np.zeros(nz)
        self.one[known] = 1.0
        self.to_d = np.zeros((nz, n + nd))
        self.to_d[kept, n:] = Bd[kept] + shift @ self.turn - A @ shift
        self.to_periodic = self.to_d[:, n + self.steady :].copy()  # and `to_d` gives the constant part alone
        self.to_d[:, n + self.steady :] = 0.0
        self.rows, self.held, self.rests = self.M, 0, False
        self.shows = np.array_equal(H, predictor.C)
        self.offset = H[:, known].sum(axis=1)

    def read_before(self) -> None:
        """Have y be what the model's next outputs are under the input of the step before, y = M (F s + G v) + h."""
        self.h, self.M = self.M @ self.f + self.h, self.M @ self.F

    def hold_input(self) -> None:
        """Append u_{k−1}, which acts on y after `read_before`, to s."""
        nu, nz = self.predictor.nu, len(self.one)
        D = self.rows @ self.G
        self.F = scipy.linalg.block_diag(self.F, np.zeros((nu, nu)))
        self.G = np.vstack([self.G, np.eye(nu)])
        self.f, self.M = np.append(self.f, np.zeros(nu)), np.hstack([self.M, D])
        self.rows = np.hstack([self.rows, np.zeros((len(D), nu))])
        self.to_z, self.to_d = (np.hstack([part, np.zeros((nz, nu))]) for part in (self.to_z, self.to_d))
        self.held, self.rests = nu, self.shows


FilterModel = tuple[Augmented, Float[np.ndarray, "n n"], Float[np.ndarray, "ny ny"]]
"""The data of a filter: the augmented system, the covariance P before a measurement, and R of the noise of y."""


@dataclass(frozen=True, eq=False)
class FilterProgram(EstimatorProgram):
    """s⁺ = F s + G [u; w] + f; s ← s + P Mᵀ(M P Mᵀ + R)⁻¹(y − M s − h); z = to_z s + one, d = to_d s.

    Attributes
    ----------
    F, G, f, M, h, to_z, one, to_d
        See `Augmented`.
    P, R
        Covariances of s before a measurement, and of the noise of y. Entries of y that are NaN are left out.
    kept
        The entries of z at a known start with which s begins; d begins at zero.
    delay, patience
        Steps that y is old; samples in sequence without any measurement that are bridged.
    held
        Entries at the end of s that are the input of the step before: nu with feedthrough, else 0.
    rests
        Where no start is given, s begins as if the plant had rested at the first y.
    shows
        y are the states of the model: an estimate that is lost begins again as if the plant had rested at y.
    """

    F: Float[np.ndarray, "ns ns"]
    G: Float[np.ndarray, "ns nuw"]
    f: Float[np.ndarray, " ns"]
    M: Float[np.ndarray, "ny ns"]
    h: Float[np.ndarray, " ny"]
    to_z: Float[np.ndarray, "nz ns"]
    one: Float[np.ndarray, " nz"]
    to_d: Float[np.ndarray, "nz ns"]
    P: Float[np.ndarray, "ns ns"]
    R: Float[np.ndarray, "ny ny"]
    kept: Int[np.ndarray, " kept"]
    delay: int
    patience: int
    held: int = 0
    rests: bool = False
    shows: bool = False


class KalmanFilter(Viewing):
    """The observer of a `LiftedKalman`: s ← s + K (y − M s − h), the gain K from the stationary covariance P.

    Entries of y that are NaN are left out of the correction; where all are NaN, s is only predicted. Where no entry is
    NaN and there is no delay, a step is one product, [s; z; d] = Ω [s; u; w; y; 1].
    """

    _VIEWS = ("z", "d", "_s", "_uw", "_y", "_s_new", "_expected")

    def __init__(
        self, model: Callable[[LinearPredictor], FilterModel], predictor: LinearPredictor, delay: int, patience: int
    ) -> None:
        self._model, self._delay, self._patience = model, delay, patience
        self._inputs: deque[Float[np.ndarray, " nuw"]] = deque()
        self._take(predictor)
        self.ny, nz = len(self._system.M), len(self._system.one)
        n, inputs = self._system.G.shape
        self._known, self._found = np.ones(n + inputs + self.ny + 1), np.zeros(n + 2 * nz + self.ny)
        self._gate, self._ahead = ReadingGate(self.ny, self._system.shows), np.zeros(n)
        self._see()
        self.reset()

    def _see(self) -> None:
        """Make the views of the arrays that the product reads and writes; see `Viewing`."""
        (n, inputs), nz = self._system.G.shape, len(self._system.one)
        self._s, self._uw, self._y, _ = np.split(self._known, [n, n + inputs, n + inputs + self.ny])
        self._s_new, self.z, self.d, self._expected = np.split(self._found, [n, n + nz, n + 2 * nz])

    def program(self) -> FilterProgram:
        """Return the data with which z and d are found."""
        parts = {name: getattr(self._system, name) for name in ("F", "G", "f", "M", "h", "to_z", "one", "to_d", "kept")}
        system = self._system
        return FilterProgram(
            **parts,
            P=self._P,
            R=self._R,
            delay=self._delay,
            patience=self._patience,
            held=system.held,
            rests=system.rests,
            shows=system.shows,
            gate=gate_graph(self.ny, system.shows),
        )

    @property
    def refused(self) -> bool:
        """Whether the last y was refused: the filter only predicted."""
        return self._gate.refused

    @property
    def stand_in_w(self) -> Float[np.ndarray, " nw"] | None:
        """The w to plan with, if the last one was wild."""
        return self._gate.stand_in

    def update(self, model: LinearPredictor) -> None:
        """Go on with another model, from the same state."""
        self._take(model)

    def _take(self, predictor: LinearPredictor) -> None:
        """Take over the matrices of a model."""
        self._system, self._P, self._R = self._model(predictor)
        self._rails = _find_rails(predictor, self._system)
        self._gains: dict[bytes, Float[np.ndarray, "n m"]] = {}
        system = self._system
        K = self._gain(np.ones(len(system.M), dtype=np.bool_))
        kept = np.eye(len(system.F)) - K @ system.M
        s = np.hstack([kept @ system.F, kept @ system.G, K, (kept @ system.f - K @ system.h)[:, None]])
        F, G, M = system.F, system.G, system.M
        y = np.hstack([M @ F, M @ G, np.zeros((len(M), len(M))), (M @ system.f + system.h)[:, None]])
        self._omega = np.vstack([s, system.to_z @ s, system.to_d @ s, y])
        self._omega[len(s) : len(s) + len(system.one), -1] += system.one

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Start at z = ψ(x0), and d = 0; by default at ψ(0), with feedthrough at rest where the first y is."""
        system = self._system
        start = checks.start(x0, system.predictor.nx)
        self._sought = start is None and system.rests
        self._rest_at(np.zeros(system.predictor.nx) if start is None else start, np.zeros(system.predictor.nu))
        self._start = self._s[: len(self._s) - system.held].copy()
        self._inputs.clear()
        self._started = False
        self._missed = 0
        self._gate.reset()

    def _rest_at(self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"]) -> None:
        """Have s be that of a plant that has rested in x under u; the input of the step before stays."""
        system = self._system
        predictor, free = system.predictor, len(self._s) - system.held
        point = x if predictor.embedding is None else predictor.embedding.repeat(x, u)
        self._s[:free] = 0.0
        self._s[: len(system.kept)] = predictor.lift(point)[system.kept]

    def observe(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Correct the state of `delay` steps ago with y, and predict it to the present with the inputs since then.

        False says that the estimate cannot be used: measurements have been missing for too long, or it has run away.
        """
        if self._started and not self._delay:
            self._uw[: len(u)] = u
            whole = y.dot(y) < HUGE**2  # False for NaN, which would make NaN of every prediction
            self._y[:] = y if whole else 0.0
            if len(w):
                self._gate.choose(y, w, self._predict)
                w = self._gate.w
            else:
                self._omega.dot(self._known, self._found)
            refused = self._gate.judge(y, self._clip(self._expected))
            silent = self._rails is not None and self._is_silent(y, self._expected).any()
            if whole and not (refused or silent or self._gate.lost) and self._found.dot(self._found) < HUGE**2:
                self._s[:] = self._s_new
                self._missed = 0
                return True
        return self._correct(y, u, w)

    def _predict(self, w: Float[np.ndarray, " nw"]) -> Float[np.ndarray, " ny"]:
        """Make the product of a step, and return the reading that it predicts."""
        self._uw[len(self._uw) - len(w) :] = w
        self._omega.dot(self._known, self._found)
        return self._expected

    def _predict_delayed(
        self, y: Float[np.ndarray, " ny"], v: Float[np.ndarray, " nuw"], nw: int
    ) -> Float[np.ndarray, " n"]:
        """Return the state after v = [u; w], without a wild w."""
        nu = len(v) - nw
        self._gate.choose(y, v[nu:], partial(self._predict_after, v[:nu]))
        return self._ahead

    def _predict_after(self, u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> Float[np.ndarray, " ny"]:
        """Store the state after u and w, and return what it shows."""
        self._ahead, system = self._next(self._s, np.concatenate([u, w])), self._system
        return system.M @ self._ahead + system.h

    def _correct(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Predict, and correct with the entries of y that have come, unless y is refused."""
        system = self._system
        if self._started:
            self._inputs.append(np.concatenate([u, w]))
        elif system.held:
            self._s[-system.held :] = u
            if self._sought and (np.abs(y) < HUGE).all():
                self._rest_at(y, u)
                self._start = self._s[: len(self._start)].copy()
        if len(self._inputs) > self._delay:
            v = self._inputs.popleft()
            self._s[:] = self._predict_delayed(y, v, len(w)) if self._delay and len(w) else self._next(self._s, v)
        came = np.abs(y) < HUGE  # False for NaN
        first = len(self._inputs) < self._delay  # y is older than the start
        if not first and (self._delay or not self._started):
            self._gate.judge(y, self._clip(system.M @ self._s + system.h))
        if self._gate.lost:
            if system.shows and came.all():
                self._rest_at(y, u)
            else:
                self._s[: len(self._start)] = self._start
        useful = came & ~self._is_silent(y, system.M @ self._s + system.h)
        if not first and useful.any() and not self._gate.refused:
            self._s += self._gain(useful) @ (y[useful] - system.M[useful] @ self._s - system.h[useful])
        self._missed = 0 if came.any() else self._missed + 1
        self._started = True
        s = self._s
        for v in self._inputs:
            s = self._next(s, v)
        np.add(system.to_z @ s, system.one, out=self.z)
        np.dot(system.to_d, s, out=self.d)
        return self._missed <= self._patience and bool(np.abs(s).max() < HUGE)

    def _is_silent(self, y: Float[np.ndarray, " ny"], expected: Float[np.ndarray, " ny"]) -> Bool[np.ndarray, " ny"]:
        """Return which readings are at a rail of their sensor with a prediction at it or beyond."""
        if self._rails is None:
            return np.zeros(len(y), dtype=np.bool_)
        low, high = self._rails
        return ((y <= low) & (expected <= low)) | ((y >= high) & (expected >= high))

    def _clip(self, expected: Float[np.ndarray, " ny"]) -> Float[np.ndarray, " ny"]:
        return expected if self._rails is None else np.clip(expected, *self._rails)

    def _next(self, s: Float[np.ndarray, " n"], v: Float[np.ndarray, " nuw"]) -> Float[np.ndarray, " n"]:
        system = self._system
        return system.F @ s + system.G @ v + system.f

    def _gain(self, came: Bool[np.ndarray, " ny"]) -> Float[np.ndarray, "n m"]:
        """Return the gain of those measurements that have come."""
        key = came.tobytes()
        if key not in self._gains:
            M, R = self._system.M[came], self._R[np.ix_(came, came)]
            PM = self._P @ M.T
            S = M @ PM + R
            size = np.sqrt(S.diagonal())[
                :, None
            ]  # scaled first: different units of the outputs do not count as ill-conditioning
            scaled = np.asarray(scipy.linalg.solve(S / size / size.T, PM.T / size, assume_a="pos"))
            self._gains[key] = (scaled / size).T
        return self._gains[key]


class PeriodicFilter(KalmanFilter):
    """The observer of a `LiftedKalman` with a period: each disturbance is a constant and harmonics that turn."""

    def forecast(self, steps: int) -> Float[np.ndarray, "steps nz"]:
        """Return the periodic part of d in the steps from now on; `d` is the constant part."""
        system = self._system
        first = len(system.kept) + system.steady
        turn, now = system.turn[system.steady :, system.steady :], self._s[first:].copy()
        rows = np.empty((steps, len(system.one)))
        for row in rows:
            row[:] = system.to_periodic @ now
            now = turn @ now
        return rows

    def program(self) -> FilterProgram:
        """Raise the DataError that says why no C code can be generated.

        Raises
        ------
        DataError
            Always.
        """
        raise DataError(NO_CODE)


def _find_rails(predictor: LinearPredictor, system: Augmented) -> Float[np.ndarray, "2 ny"] | None:
    """Return the rails of the outputs that are states of the model, or differ from one by a constant.

    None where no sensor saturates.
    """
    if predictor.embedding is None or predictor.embedding.rails is None:
        return None
    H = system.rows[:, : len(system.kept)]
    known = np.delete(predictor.C, system.kept, axis=1).sum(axis=1)
    rails = np.vstack([np.full(len(H), -np.inf), np.full(len(H), np.inf)])
    for i, row in enumerate(H):
        found = np.flatnonzero((row == predictor.C[:, system.kept]).all(axis=1))
        if len(found):
            rails[:, i] = predictor.embedding.rails[:, found[0]] + system.offset[i] - known[found[0]]
    return rails


Hidden = tuple[complex, Complex[np.ndarray, " n"]]
"""A mode that y does not show: λ, and its direction s, of length 1."""


def hidden(F: Float[np.ndarray, "n n"], M: Float[np.ndarray, "ny n"]) -> Hidden | None:
    """Return a mode with |λ| ≥ 1 for which [F − λ I; M] has less than full rank; None where (F, M) is detectable.

    For F = [A, B_d; 0, I] and M = [C, C_d], λ = 1 is the rank condition on [A − I, B_d; C, C_d]. Rows of M are
    scaled to length 1, so that units of y do not decide.

    References
    ----------
    Pannocchia & Rawlings, "Disturbance models for offset-free model-predictive control", AIChE Journal 49, 2003.
    """
    scaled = M / np.maximum(np.linalg.norm(M, axis=1, keepdims=True), 1e-300)
    for value in np.linalg.eigvals(F):
        if abs(value) < 1 - TOLERANCE:
            continue
        sigma, right = np.linalg.svd(np.vstack([F - value * np.eye(len(F)), scaled]))[1:]
        if sigma[-1] < TOLERANCE * max(sigma[0], abs(value)):
            return complex(value), np.conj(np.asarray(right[-1], complex))
    return None


@dataclass(frozen=True, eq=False)
class LiftedKalman(Value):
    """Stationary Kalman filter on s = [z; d]: z⁺ = A z + B u + E w + B_d d, d⁺ = d, y = H z + C_d d.

    z is never lifted afresh. There is one disturbance for each measurement, so that at rest the filter explains y
    exactly. The loop has no offset if all tracked outputs are measured, and if there are no more of them than inputs.
    The Constant is known, and not estimated. A state's reading at a rail of its sensor, which the model's `Delay` has,
    corrects nothing where the prediction lies at it or beyond. A y that is far from its prediction is refused, for at
    most six steps in sequence: the filter only predicts.

    Parameters
    ----------
    outputs
        The entries of y: names of observables, with or without unit, or a matrix H (ny, nz).
    disturbance
        "input": the first nu outputs are explained by disturbances of the inputs (B_d = B), each further one by
        an offset of its own. "output": every output has an offset of its own (C_d = I); not for a plant that
        integrates, or is unstable with an observable that drifts: those offsets cannot be told from its motion.
    process, drift, noise
        Covariances of a step of z (without the Constant), of a step of d, and of y; a scalar or a vector is a
        diagonal. Only their ratios matter. More `drift` learns disturbances faster, more `noise` trusts y less, and
        much `process` gives misfits to slow modes of z, which then return slowly. By default `process` and `noise`
        are standard deviations of 0.01, in units of the model: of the root mean squares of its lifted data, a
        disturbance of an input in that which moves z by as much in one step. An output that is a state of a fitted
        model has the noise of the fit's residuals. A model that was given has units of one. The default `drift` is the
        least, up to a standard deviation of 1, with which the error of d falls to exp(−4), 2 %, within the horizon, and
        within the 38 steps of a mean with gain 0.1: a faster filter would take more noise and more of what the
        model misses in a transient for disturbances.
    delay
        y is `delay` steps old; what followed is predicted from the inputs that acted since.
    period, harmonics
        Of disturbances that repeat themselves [s], as in `LiftedDisturbance`: each is a constant and harmonics.
    patience
        How many samples in a row without any measurement are bridged by prediction; after them the state is unknown.
    feedthrough
        The plant has y = h(x, u), and the model is one of log rows y_k = h(x_k, u_k), whose inputs were moved one row
        up (`input_lead` 1). A controller reads y before it chooses u_k, so the reading is h(x_k, u_{k−1}), which is
        H (A z + B u_{k−1}) + C_d d. A plan then weighs and limits h(x_k, u_k) first, and row k + 1 of a moving
        reference belongs to it. Where y are the states, a run whose x0 is not given begins at rest at its first
        reading. Not with `period`.

    Raises
    ------
    DataError
        A setting is out of range; when a controller is built, the disturbance is not detectable.
    ObservableError
        When a controller is built, the lifting lacks an output.

    References
    ----------
    Pannocchia & Rawlings, "Disturbance models for offset-free model-predictive control", AIChE Journal 49, 2003;
    Maeder, Borrelli & Morari, "Linear offset-free model predictive control", Automatica 45, 2009.
    """

    outputs: str | Sequence[str] | ArrayLike
    disturbance: Literal["input", "output"] = "input"
    process: ArrayLike | None = None
    drift: ArrayLike | None = None
    noise: ArrayLike | None = None
    delay: int = 0
    patience: int = 10
    period: float | None = None
    harmonics: int = 3
    feedthrough: bool = False

    def __post_init__(self) -> None:
        given = self.outputs
        if isinstance(given, str):
            object.__setattr__(self, "outputs", (given,))
        elif isinstance(given, Sequence) and given and all(isinstance(name, str) for name in given):
            object.__setattr__(self, "outputs", tuple(given))
        else:
            object.__setattr__(self, "outputs", checks.array(cast("ArrayLike", given), "outputs", (None, None)))
        if not checks.among(self.disturbance, ("input", "output")):
            raise DataError(f'disturbance is {self.disturbance!r}; pass "input" or "output"')
        for name in ("process", "drift", "noise"):
            if getattr(self, name) is None:
                continue
            stored = checks.array(getattr(self, name), name)
            checks.weight(stored, name, definite=True)
            object.__setattr__(self, name, stored)
        checks.count(self.delay, "delay", 0)
        checks.count(self.patience, "patience", 0)
        checks.count(self.harmonics, "harmonics")
        if self.period is not None:
            checks.positive(self.period, "period", "s")
        checks.kind(self.feedthrough, "feedthrough", (bool, np.bool_), "pass True or False")
        if self.feedthrough and self.period is not None:
            raise DataError("feedthrough and a period do not go together; leave one of them out")

    def start(self, model: LinearPredictor | StateModel, horizon: int) -> KalmanFilter:
        """Return the observer of one controller with plans of this many steps.

        Raises
        ------
        DataError
            The model is no linear predictor; or the disturbance, or the state, is not detectable from the outputs.
        ObservableError, ShapeError
            The lifting lacks an output; H has another width than z.
        """
        if not isinstance(model, LinearPredictor):
            raise DataError(
                "LiftedKalman filters the lifted state of a linear predictor, and this controller plans in the state "
                "itself; pass a LiftedDisturbance"
            )
        kind = KalmanFilter if self.period is None else PeriodicFilter
        return kind(partial(self._model, min(horizon / 4, SLOWEST)), model, self.delay, self.patience)

    def _model(self, settling: float, predictor: LinearPredictor) -> FilterModel:
        """Return the filter's matrices for a predictor, or say why there are none; `settling` in steps."""
        nz, nu = predictor.nz, predictor.nu
        if self.feedthrough and predictor.nw:
            raise DataError(NOT_TOGETHER)
        H = self._matrix(predictor)
        ny, constant = len(H), predictor.lifting.constant_index
        kept = np.array([i for i in range(nz) if i != constant], dtype=np.intp)
        if np.linalg.matrix_rank(H[:, kept]) < ny:
            raise DataError("outputs depend on each other (or on the Constant alone); name each one once")
        if self.disturbance == "output":
            Bd, Cd = np.zeros((nz, ny)), np.eye(ny)
        elif ny < nu:
            raise DataError(
                f"{ny} outputs cannot tell the disturbances of {nu} inputs apart; measure at least {nu}, or use "
                'disturbance="output"'
            )
        else:
            Bd, Cd = np.hstack([predictor.B, np.zeros((nz, ny - nu))]), np.eye(ny, ny)
            Cd[:nu] = 0.0
        model = Augmented(predictor, kept, H, Bd, Cd)
        if self.feedthrough:
            model.read_before()
        unit, y_unit = _sizes(predictor, kept, H, Cd)
        size, y_size = (unit, y_unit) if predictor.scale is not None else _balance(model.F, model.M, len(kept))
        F, M = model.F * size / size[:, None], model.M * size / y_size[:, None]
        lost = hidden(F, M)
        if lost is not None:
            raise DataError(self._words(predictor, model, lost))
        n, units = len(kept), np.outer(size, size)
        process = (
            PROCESS * np.diag(unit[:n] ** 2) if self.process is None else checks.weight(self.process, "process", n)
        )
        R = np.diag(_noise(predictor, H, y_unit)) if self.noise is None else checks.weight(self.noise, "noise", ny)
        process, R_scaled = process / units[:n, :n], R / np.outer(y_size, y_size)
        if self.drift is None:
            drift = np.diag(_settling(F, M, process, R_scaled, settling))
        else:
            drift = checks.weight(self.drift, "drift", ny) / units[n:, n:]
        if self.period is not None:
            turns = find_harmonics(self.period, predictor.dt, self.harmonics)
            model = Augmented(predictor, kept, H, Bd, Cd, turns)
            own = np.concatenate([size[:n], np.tile(size[n:], 1 + 2 * len(turns))])
            F, M, units = model.F * own / own[:, None], model.M * own / y_size[:, None], np.outer(own, own)
            lost = hidden(F, M)
            if lost is not None:
                raise DataError(
                    f"a disturbance of period {self.period:g} s cannot be told from a mode of the model at the same"
                    " frequency; measure more, or pass another period or fewer harmonics"
                )
            drift = np.kron(np.eye(1 + 2 * len(turns)), drift)
        P = _stationary(F, M, scipy.linalg.block_diag(process, drift), R_scaled) * units
        if self.feedthrough:
            model.hold_input()
            P = scipy.linalg.block_diag(P, np.zeros((nu, nu)))
        return model, P, R

    def _matrix(self, predictor: LinearPredictor) -> Float[np.ndarray, "ny nz"]:
        if isinstance(self.outputs, tuple):
            return np.eye(predictor.nz)[_places(predictor.lifting, cast("tuple[str, ...]", self.outputs))]
        H = cast("Float[np.ndarray, 'ny nz']", self.outputs)
        if H.shape[1] != predictor.nz or not len(H):
            raise ShapeError(f"outputs has shape {H.shape}, expected (ny, {predictor.nz}), one column an observable")
        return H

    def _words(self, predictor: LinearPredictor, model: Augmented, lost: Hidden) -> str:
        """Return the message on a mode that y does not show, and what to do."""
        ny, nu = len(model.M), predictor.nu
        names = predictor.lifting.names
        labels = [f"{names[int(i)]!r}" for i in model.kept]
        outputs = self.outputs if isinstance(self.outputs, tuple) else tuple(f"row {i}" for i in range(ny))
        first = 0 if self.disturbance == "output" else nu
        labels += [f"a disturbance of input {name!r}" for name in predictor.inputs[:first]]
        labels += [f"an offset of output {name!r}" for name in outputs[first:]]
        value, direction = lost
        size = np.abs(direction)
        largest = [int(i) for i in np.argsort(-size, kind="stable")[:4] if size[i] > 0.1 * size.max()]
        moved = ", ".join(labels[i] for i in largest)
        other = "input" if self.disturbance == "output" else "output"
        written = f"{value.real:.4g}" if value.imag == 0 else f"{value:.4g}"
        return (
            f"not detectable from {', '.join(str(name) for name in outputs)}: with λ = {written}, {moved} can move "
            f"without a trace in y; measure one of them, drop it from the lifting, or use disturbance={other!r}"
        )


def _sizes(
    predictor: LinearPredictor,
    kept: Int[np.ndarray, " n"],
    H: Float[np.ndarray, "ny nz"],
    Cd: Float[np.ndarray, "ny nd"],
) -> tuple[Float[np.ndarray, " nzd"], Float[np.ndarray, " ny"]]:
    """Return the units of [z; d] and of y: root mean squares of the data that a model was fitted to, or ones."""
    ny = len(H)
    if predictor.scale is None:
        return np.ones(len(kept) + ny), np.ones(ny)
    z = np.linalg.norm(predictor.scale, axis=0)[kept]
    y = np.linalg.norm(predictor.scale @ H.T, axis=0)
    d = y.copy()  # an offset has the unit of its output
    for i in np.flatnonzero(~Cd.any(axis=0)):
        moved = float(np.linalg.norm(predictor.B[kept, i] / z))
        d[i] = 1.0 / moved if moved > 0 else 1.0
    return np.concatenate([z, d]), y


def _balance(
    F: Float[np.ndarray, "n n"], M: Float[np.ndarray, "ny n"], nz: int
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " ny"]]:
    """Return units of [z; d] and of y in which a given model's rows and columns are alike, so that ranks are clear."""
    z = np.asarray(scipy.linalg.matrix_balance(F[:nz, :nz], permute=False, separate=True)[1][0])
    y = np.linalg.norm(M[:, :nz] * z, axis=1)
    pushed = np.linalg.norm(F[:nz, nz:] / z[:, None], axis=0)  # an offset of y pushes no z, and has the unit of y
    offset = np.where(np.abs(M[:, nz:]) > 0, y[:, None], 0.0).max(axis=0)
    d = np.where(pushed > 0, 1.0 / np.where(pushed > 0, pushed, 1.0), np.where(offset > 0, offset, 1.0))
    return np.concatenate([z, d]), y


def _noise(
    predictor: LinearPredictor, H: Float[np.ndarray, "ny nz"], size: Float[np.ndarray, " ny"]
) -> Float[np.ndarray, " ny"]:
    """Return the variances of y: the fit's residuals where an output is a state, else a share of its size."""
    variance = NOISE * size**2
    if predictor.report is not None and predictor.scale is not None:
        residual = predictor.report.residual
        for i, row in enumerate(H):
            found = np.flatnonzero((row == predictor.C).all(axis=1))
            if len(found):
                variance[i] = max(float(residual[found[0]]) ** 2, LEAST * size[i] ** 2)
    return variance


def _settling(
    F: Float[np.ndarray, "n n"],
    M: Float[np.ndarray, "ny n"],
    process: Float[np.ndarray, "nz nz"],
    R: Float[np.ndarray, "ny ny"],
    steps: float,
) -> Float[np.ndarray, " nd"]:
    """Return the least drift of each d with which its error falls to exp(−4) in four times so many steps.

    In the filters that are tried all of d has the same drift. Where none is enough, the drift is taken with which the
    error falls most.
    """
    nz, nd, whole = len(process), len(F) - len(process), int(np.ceil(4 * steps))
    left = np.empty((len(DRIFTS), nd))
    known, drifting = np.zeros_like(F), np.diag(np.repeat([0.0, 1.0], [nz, nd]))
    known[:nz, :nz] = process
    for row, drift in zip(left, DRIFTS, strict=True):
        P = _stationary(F, M, known + drift * drifting, R)
        PM = P @ M.T
        K = np.asarray(scipy.linalg.solve(M @ PM + R, PM.T, assume_a="pos")).T
        row[:] = np.abs(np.linalg.matrix_power(F - F @ K @ M, whole).diagonal()[nz:])
    enough = left <= exp(-whole / steps)
    return DRIFTS[np.where(enough.any(axis=0), enough.argmax(axis=0), left.argmin(axis=0))]


def _stationary(
    F: Float[np.ndarray, "n n"],
    M: Float[np.ndarray, "ny n"],
    Q: Float[np.ndarray, "n n"],
    R: Float[np.ndarray, "ny ny"],
) -> Float[np.ndarray, "n n"]:
    """Return P = F (P − P Mᵀ(M P Mᵀ + R)⁻¹ M P) Fᵀ + Q, the covariance before a measurement."""
    try:
        P = np.asarray(scipy.linalg.solve_discrete_are(F.T, M.T, Q, R))
    except ValueError as error:  # SciPy's own where the pencil is too far from triangular, and LinAlgError
        raise DataError(
            f"no stationary filter was found ({error}); the disturbance is hardly detectable: measure more, or drop "
            "observables"
        ) from error
    return 0.5 * (P + P.T)


def _places(lifting: Lifting, names: tuple[str, ...]) -> list[int]:
    """Return the indices of observables by name, with or without the unit.

    Raises
    ------
    ObservableError
        The lifting lacks one of them.
    """
    place = {strip_unit(name): i for i, name in enumerate(lifting.names)}
    place |= {name: i for i, name in enumerate(lifting.names)}
    for name in names:
        if name not in place:
            raise ObservableError(
                f"the lifting lacks {name!r}; add it to the lifting: it holds {', '.join(lifting.names)}"
            )
    return [place[name] for name in names]
