"""The filter of a `LiftedKalman` at work: predict, correct with what has come, predict through a delay."""

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.checks import HUGE
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.values import Viewing


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
    ) -> None:
        nz, nd, n = predictor.nz, Cd.shape[1], len(kept)
        self.predictor, self.kept = predictor, kept
        A, known = predictor.A[np.ix_(kept, kept)], np.delete(np.arange(nz), kept)
        self.F = np.block([[A, Bd[kept]], [np.zeros((nd, n)), np.eye(nd)]])
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
        self.to_d[kept, n:] = Bd[kept] + shift - A @ shift


class FilterModel(NamedTuple):
    """The data of a filter: the augmented system, the covariance P before a measurement, and R of the noise of y."""

    system: Augmented
    P: Float[np.ndarray, "n n"]
    R: Float[np.ndarray, "ny ny"]


class KalmanFilter(Viewing):
    """The observer of a `LiftedKalman`: s ← s + K (y − M s − h), the gain K from the stationary covariance P.

    Entries of y that are NaN are left out of the correction; where all are NaN, s is only predicted. Where no entry is
    NaN and there is no delay, a step is one product, [s; z; d] = Ω [s; u; w; y; 1].
    """

    _VIEWS = ("z", "d", "_s", "_uw", "_y", "_s_new")

    def __init__(
        self, model: Callable[[LinearPredictor], FilterModel], predictor: LinearPredictor, delay: int, patience: int
    ) -> None:
        self._model, self._delay, self._patience = model, delay, patience
        self._inputs: deque[Float[np.ndarray, " nuw"]] = deque()
        self._take(predictor)
        self.ny, nz = len(self._system.M), len(self._system.one)
        n, inputs = self._system.G.shape
        self._parts = n, inputs, nz
        self._known, self._found = np.ones(n + inputs + self.ny + 1), np.zeros(n + 2 * nz)
        self._see()
        self.reset()

    def _see(self) -> None:
        """Make the views of the arrays that the product reads and writes; see `Viewing`."""
        n, inputs, nz = self._parts
        self._s, self._uw, self._y, _ = np.split(self._known, [n, n + inputs, n + inputs + self.ny])
        self._s_new, self.z, self.d = np.split(self._found, [n, n + nz])

    def update(self, predictor: LinearPredictor) -> None:
        """Go on with another model, from the same state."""
        self._take(predictor)

    def _take(self, predictor: LinearPredictor) -> None:
        """Take over the matrices of a model."""
        self._system, self._P, self._R = self._model(predictor)
        self._gains: dict[bytes, Float[np.ndarray, "n m"]] = {}
        system = self._system
        K = self._gain(np.ones(len(system.M), dtype=np.bool_))
        kept = np.eye(len(system.F)) - K @ system.M
        s = np.hstack([kept @ system.F, kept @ system.G, K, (kept @ system.f - K @ system.h)[:, None]])
        self._omega = np.vstack([s, system.to_z @ s, system.to_d @ s])
        self._omega[len(s) : len(s) + len(system.one), -1] += system.one

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Start at z = ψ(x0), by default ψ(0), and d = 0."""
        system = self._system
        start = checks.start(x0, system.predictor.nx)
        start = np.zeros(system.predictor.nx) if start is None else start
        self._s[:] = 0.0
        self._s[: len(system.kept)] = system.predictor.lift(system.predictor.held(start))[system.kept]
        self._inputs.clear()
        self._started = False
        self._missed = 0

    def observe(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Correct the state of `delay` steps ago with y, and predict it to the present with the inputs since then.

        False says that the estimate cannot be used: measurements have been missing for too long, or it has run away.
        """
        if self._started and not self._delay:
            self._uw[: len(u)] = u
            if len(w):
                self._uw[len(u) :] = w
            self._y[:] = y
            self._omega.dot(self._known, self._found)
            if self._found.dot(self._found) < HUGE**2:  # False for NaN: some of y is missing
                self._s[:] = self._s_new
                self._missed = 0
                return True
        return self._corrected(y, u, w)

    def _corrected(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Predict, and correct with the entries of y that have come."""
        system = self._system
        if self._started:
            self._inputs.append(np.concatenate([u, w]))
        if len(self._inputs) > self._delay:
            self._s[:] = self._next(self._s, self._inputs.popleft())
        came = np.abs(y) < HUGE  # False for NaN
        first = len(self._inputs) < self._delay  # y is older than the start
        if not first and came.any():
            self._s += self._gain(came) @ (y[came] - system.M[came] @ self._s - system.h[came])
        self._missed = 0 if came.any() else self._missed + 1
        self._started = True
        s = self._s
        for v in self._inputs:
            s = self._next(s, v)
        np.add(system.to_z @ s, system.one, out=self.z)
        np.dot(system.to_d, s, out=self.d)
        return self._missed <= self._patience and bool(np.abs(s).max() < HUGE)

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
            size = np.sqrt(S.diagonal())[:, None]  # scaled, for different units of the outputs are no ill-conditioning
            scaled = np.asarray(scipy.linalg.solve(S / size / size.T, PM.T / size, assume_a="pos"))
            self._gains[key] = (scaled / size).T
        return self._gains[key]
