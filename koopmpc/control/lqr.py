"""LQR: u = u_r − K (ψ(x) − z_r), clipped to the limits of the inputs and of their rates."""

from time import perf_counter

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits, admitted
from koopmpc.control.move import Fallback, Move, Status
from koopmpc.control.riccati import one_step, stationary
from koopmpc.control.target import reference_rows, targets_of
from koopmpc.control.tracking import lifted_tracking
from koopmpc.errors import ShapeError
from koopmpc.estimate.observer import Measured
from koopmpc.lifting.buffered import HUGE
from koopmpc.predict.predictors import LinearPredictor

ITERATIONS = 10_000
_NOTHING = np.zeros(0)  # no measured disturbance moves an estimate here


class LQR:
    """u = u_r − K (ψ(x) − z_r) on a lifted predictor, or on a linearisation as `LinearPredictor.local` makes it.

    K is the limit of the Riccati difference equation for the cost's Q and R; (z_r, u_r) is the equilibrium that
    holds the reference. With R_delta it acts on [ψ(x) − z_r; u_{k−1} − u_r]. The input is clipped to the limits of
    its change, soft or hard, and to its own (status SATURATED); other limits are not seen.

    Parameters
    ----------
    predictor
        z⁺ = A z + B u (+ E w).
    cost
        Q, R and R_delta; a terminal weight has no meaning here.
    limits
        Input and rate limits.

    Raises
    ------
    ObservableError
        The cost is on an observable that the lifting lacks.
    DefinitenessError
        R + BᵀPB is not positive definite.
    """

    def __init__(self, predictor: LinearPredictor, cost: Cost, limits: Limits | None = None) -> None:
        advice = "fit one with edmd, or linearise with LinearPredictor.local"
        checks.kind(predictor, "predictor", LinearPredictor, advice)
        self.predictor, self.cost, self.limits = predictor, cost, limits
        track = lifted_tracking(predictor, cost, Limits() if limits is None else limits)
        C = track.tracked
        step = one_step(predictor.A, predictor.B, C.T @ track.Q @ C, track.R, track.R_delta)
        self.gain = stationary(step.A, step.B, step.Q, step.R, ITERATIONS, step.M)
        self._K, self._K_rate = np.split(self.gain.K, [predictor.nz], axis=1)  # the second is of u_{k−1} − u_r
        self._targets, self._inputs, self._nr = targets_of(predictor, cost, track), track.inputs, len(C)
        self._rates = track.rates
        self._observer = Measured(predictor)
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
        """Set the last input, from which rates count, and which is held if the first measurement is bad.

        By default it is zero inside the limits.
        """
        self._observer.reset()
        zero = np.clip(np.zeros(self.nu), *self._inputs)
        self._last = zero if u_prev is None else checks.array(u_prev, "u_prev", (self.nu,))

    def __call__(
        self,
        y: ArrayLike,
        reference: ArrayLike,
        applied: ArrayLike | None = None,
        w: ArrayLike | None = None,
    ) -> Move:
        """Return u for state y and a reference row (nr,), or rows of which the first counts.

        `w` are measured disturbances (nw,), or rows of which the first counts: the target is the one that they push.
        """
        start = perf_counter()
        x = checks.array(y, "y", (self.predictor.nx,), finite=False)
        target = np.asarray(reference, dtype=np.float64)
        e = None if w is None else self._disturbance(np.asarray(w, dtype=np.float64))
        key = target.tobytes() if e is None else target.tobytes() + e.tobytes()
        if key != self._reference_key:
            self._aim(target, e)
            self._reference_key = key
        if applied is not None:
            got = checks.array(applied, "applied", (self.nu,), finite=False)
            if (np.abs(got) < HUGE).all():
                self._last = got
        self._observer.observe(x, self._last, _NOTHING)
        free = self._feedforward - self._K @ self._observer.z
        if self._K_rate.size:
            free -= self._K_rate @ self._last
        if not (np.abs(free) < HUGE).all():
            self._last = admitted(self._last, self._inputs, self._rates, self._last)
            return Move(self._last.copy(), Status.BAD_MEASUREMENT, Fallback.HOLD, perf_counter() - start, 0)
        u = admitted(free, self._inputs, self._rates, self._last)
        status = Status.UNCONSTRAINED if (u == free).all() else Status.SATURATED
        self._last = u
        return Move(u.copy(), status, Fallback.NONE, perf_counter() - start, 0)

    def _disturbance(self, w: Float[np.ndarray, "..."]) -> Float[np.ndarray, " nz"]:
        """Return E w, NaN where w cannot be."""
        row = w[0] if w.ndim == 2 and len(w) else w
        if row.shape != (self.predictor.nw,):
            raise ShapeError(
                f"w has shape {w.shape}, the predictor has {self.predictor.nw} disturbances; pass one value each"
            )
        return self.predictor.E @ np.where(np.abs(row) < HUGE, row, np.nan)

    def _aim(self, reference: Float[np.ndarray, "..."], e: Float[np.ndarray, " nz"] | None) -> None:
        """Set the feedforward u_r + K z_r."""
        row = reference_rows(reference, 0, self._nr)
        if not np.isfinite(row).all() or (e is not None and not np.isfinite(e).all()):
            self._feedforward = np.full(self.nu, np.nan)
            return
        found = self._targets
        alpha = found.coordinates(row, e)[0]
        z_r, u_r = found.z0 + found.Z @ alpha, found.u0 + found.W @ alpha
        if e is not None:
            z_r, u_r = z_r + found.z_disturbance @ e, u_r + found.u_disturbance @ e
        self._feedforward = u_r + self._K @ z_r
        if self._K_rate.size:
            self._feedforward += self._K_rate @ u_r
