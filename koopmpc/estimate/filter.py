"""KalmanFilter: the observer of a `LiftedKalman`. It predicts, corrects with what has come, and predicts on."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.errors import DataError
from koopmpc.base.values import Viewing
from koopmpc.estimate.gate import Gated, ReadingGate, gate_graph
from koopmpc.estimate.observer import EstimatorProgram
from koopmpc.estimate.periodic import NO_CODE
from koopmpc.models.predictors import LinearPredictor


def find_kalman_gain(
    P: Float[np.ndarray, "n n"], M: Float[np.ndarray, "m n"], R: Float[np.ndarray, "m m"]
) -> Float[np.ndarray, "n m"]:
    """Return K = P Mᵀ(M P Mᵀ + R)⁻¹; the outputs are scaled first, so that their units do not decide its accuracy."""
    S = M @ P @ M.T + R
    size = np.sqrt(S.diagonal())
    return np.asarray(scipy.linalg.solve(S / np.outer(size, size), (M @ P) / size[:, None], assume_a="pos")).T / size


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
    """s⁺ = F s + G [u; w] + f; s ← s + P Mᵀ(M P Mᵀ + R)⁻¹(y − M s − h); z = to_z s + one, d = to_d s."""

    # see `Augmented`
    F: Float[np.ndarray, "ns ns"]
    G: Float[np.ndarray, "ns nuw"]
    f: Float[np.ndarray, " ns"]
    M: Float[np.ndarray, "ny ns"]
    h: Float[np.ndarray, " ny"]
    to_z: Float[np.ndarray, "nz ns"]
    one: Float[np.ndarray, " nz"]
    to_d: Float[np.ndarray, "nz ns"]
    # covariances of s before a measurement, and of the noise of y. Entries of y that are NaN are left out
    P: Float[np.ndarray, "ns ns"]
    R: Float[np.ndarray, "ny ny"]
    kept: Int[np.ndarray, " kept"]  # the entries of z at a known start with which s begins; d begins at zero
    # steps that y is old; samples in sequence without any measurement that are bridged
    delay: int
    patience: int
    held: int = 0  # entries at the end of s that are the input of the step before: nu with feedthrough, else 0
    rests: bool = False  # where no start is given, s begins as if the plant had rested at the first y
    # y are the states of the model: an estimate that is lost begins again as if the plant had rested at y
    shows: bool = False


class KalmanFilter(Gated, Viewing):
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
        if len(self._inputs) >= self._delay:  # else y is older than the start
            self._use(y, u, came)
        self._missed = 0 if came.any() else self._missed + 1
        self._started = True
        s = self._s
        for v in self._inputs:
            s = self._next(s, v)
        np.add(system.to_z @ s, system.one, out=self.z)
        np.dot(system.to_d, s, out=self.d)
        return self._missed <= self._patience and bool(np.abs(s).max() < HUGE)

    def _use(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], came: Bool[np.ndarray, " ny"]) -> None:
        """Correct the state with the entries of y that have come and tell something, unless y is refused."""
        system = self._system
        if self._delay or not self._started:
            self._gate.judge(y, self._clip(system.M @ self._s + system.h))
        if self._gate.lost:
            if system.shows and came.all():
                self._rest_at(y, u)
            else:
                self._s[: len(self._start)] = self._start
        useful = came & ~self._is_silent(y, system.M @ self._s + system.h)
        if useful.any() and not self._gate.refused:
            self._s += self._gain(useful) @ (y[useful] - system.M[useful] @ self._s - system.h[useful])

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
            self._gains[key] = find_kalman_gain(self._P, self._system.M[came], self._R[np.ix_(came, came)])
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
