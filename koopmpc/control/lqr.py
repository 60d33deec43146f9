"""LQR: u = u_r − K (ψ(x) − z_r), clipped to the input limits."""

from time import perf_counter

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.lifted import reference_rows, tracking
from koopmpc.control.limits import Limits
from koopmpc.control.move import Fallback, Move, Status
from koopmpc.control.riccati import stationary
from koopmpc.lifting.buffered import HUGE, buffered
from koopmpc.predict.linear import LinearPredictor

ITERATIONS = 10_000


class LQR:
    """u = u_r − K (ψ(x) − z_r) on a lifted predictor, or on a linearisation as `LinearPredictor.local` makes it.

    K is the limit of the Riccati difference equation for the cost's Q and R; (z_r, u_r) is the equilibrium that
    holds the reference. The input is clipped to the limits (status SATURATED); other limits are not seen.

    Parameters
    ----------
    predictor
        z⁺ = A z + B u.
    cost
        Q and R; a terminal weight has no meaning here.
    limits
        Input limits.

    Raises
    ------
    ObservableError
        The cost is on an observable that the lifting lacks.
    DefinitenessError
        R + BᵀPB is not positive definite.
    """

    def __init__(self, predictor: LinearPredictor, cost: Cost, limits: Limits | None = None) -> None:
        self.predictor, self.cost, self.limits = predictor, cost, limits
        track = tracking(predictor, cost, Limits() if limits is None else limits)
        Q = track.C.T @ track.Q @ track.C
        self.gain = stationary(predictor.A, predictor.B, Q, track.R, ITERATIONS)
        self._targets, self._inputs, self._nr = track.targets, track.inputs, len(track.C)
        self._lift = buffered(predictor.lifting)
        self._reference_key: bytes | None = None
        self._feedforward = np.zeros(self.nu)
        self._last = np.zeros(self.nu)
        self.reset()

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        return self.predictor.dt

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.predictor.nu

    @property
    def horizon(self) -> int:
        """No preview."""
        return 0

    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Set the input that is held if the first measurement is bad; by default zero inside the limits."""
        held = np.zeros(self.nu) if u_prev is None else checks.array(u_prev, "u_prev", (self.nu,))
        self._last = np.clip(held, *self._inputs)

    def __call__(self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None = None) -> Move:
        """Return u for state y and a reference row (nr,), or rows of which the first counts."""
        start = perf_counter()
        x = checks.array(y, "y", (self.predictor.nx,), finite=False)
        target = np.asarray(reference, dtype=np.float64)
        key = target.tobytes()
        if key != self._reference_key:
            self._aim(target)
            self._reference_key = key
        if applied is not None:
            got = checks.array(applied, "applied", (self.nu,), finite=False)
            if np.isfinite(got).all():
                self._last = np.clip(got, *self._inputs)
        free = self._feedforward - self.gain.K @ self._lift(x)[0]
        if not (np.abs(free) < HUGE).all():
            return Move(self._last.copy(), Status.BAD_MEASUREMENT, Fallback.HOLD, perf_counter() - start, 0)
        u = np.clip(free, *self._inputs)
        status = Status.UNCONSTRAINED if (u == free).all() else Status.SATURATED
        self._last = u
        return Move(u.copy(), status, Fallback.NONE, perf_counter() - start, 0)

    def _aim(self, reference: Float[np.ndarray, "..."]) -> None:
        """Set the feedforward u_r + K z_r."""
        row = reference_rows(reference, 0, self._nr)
        if not np.isfinite(row).all():
            self._feedforward = np.full(self.nu, np.nan)
            return
        alpha = self._targets.coordinates(row)[0]
        z_r = self._targets.z0 + self._targets.Z @ alpha
        u_r = self._targets.u0 + self._targets.W @ alpha
        self._feedforward = u_r + self.gain.K @ z_r
