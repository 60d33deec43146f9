"""LQR, u = −K ψ(x) + feedforward inside limits; the gains `lqr` and `dlqr`."""

from time import perf_counter

import numpy as np
import scipy.linalg
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.control.ask.checks import FEEDBACK_FIELDS
from koopmpc.control.ask.cost import Cost, check_cost_and_limits
from koopmpc.control.ask.limits import Limits, require_known
from koopmpc.control.horizon import horizon_of
from koopmpc.control.kinds import BenchEntry, ControllerKind, register_controller
from koopmpc.control.move import Move, alone
from koopmpc.control.plan.tracking import lifted_tracking
from koopmpc.control.program import SavedController, no_export, reference_table
from koopmpc.control.riccati import Gain
from koopmpc.control.step.feedback import FeedbackLaw, FeedbackProgram
from koopmpc.control.target import Units, targets_of
from koopmpc.control.terminal_cost import tail_of, tail_stage
from koopmpc.estimate.observer import Measured
from koopmpc.models.predictors import LinearPredictor


class LQR(FeedbackLaw):
    """u = −K ψ(x) + v_r r + v_u u_r + v_w w on a lifted predictor, or on a linearisation of `LinearPredictor.local`.

    It minimises Σ ‖of(x_k) − r‖²_Q + ‖u_k − u_r‖²_R over an endless horizon, the reference r, its input target u_r and
    the disturbance w held: the gain K and the feedforward are where the Riccati difference equation rests. It does not
    look ahead: of several reference rows, or rows of w, the first counts and the others change nothing. Where r is
    an equilibrium and u_r holds it, u = u_r − K (ψ(x) − z_r). With R_delta it acts on [ψ(x); u_{k−1}]. The input is
    clipped to the limits of its change, soft or hard, and to its own (status SATURATED), in time to those of its step;
    other limits are not seen.

    One thread at a time may call it: a second one gets a ThreadError, and needs a copy of its own.

    Parameters
    ----------
    predictor
        z⁺ = A z + B u (+ E w).
    cost
        Q, R, R_delta and u_target; Q_N and tail have no meaning here.
    limits
        Input and rate limits.

    Raises
    ------
    ObservableError
        The cost is on an observable that the lifting lacks.
    DefinitenessError
        R + BᵀPB is not positive definite.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-25, u_max=25)
    >>> model = km.LinearPredictor.local(plant, [0, 0], [0])
    >>> km.LQR(model, cost, limits)([0.1, 0.0], [0.0, 0.0]).status.name
    'UNCONSTRAINED'
    """

    @checks.explain_overflow()
    def __init__(self, predictor: LinearPredictor, cost: Cost, limits: Limits | None = None) -> None:
        advice = "fit one with edmd, or linearise with LinearPredictor.local; from_state_space takes matrices"
        checks.kind(predictor, "predictor", LinearPredictor, advice)
        cost, known = check_cost_and_limits(cost, limits, predictor.states, predictor.inputs)
        track = lifted_tracking(predictor, cost, known.base)
        require_known(known, "an LQR", FEEDBACK_FIELDS)
        self.predictor, self.cost, self.limits = predictor, track.cost, None if limits is None else known
        units, C = Units.of(predictor, track), track.tracked
        h = horizon_of(predictor, track, (1,), disturbed=False).in_units(units)
        rest = tail_of(tail_stage(h.A, h.B, h.E, h.C, h.Q, h.R, h.R_delta), None)
        self.gain = Gain(units.gain(rest.K), units.value(rest.P))
        told = np.concatenate([np.ones(predictor.nw), units.tracked, units.inputs])
        self._v = units.inputs[:, None] * rest.v / told  # the feedforward of [w; r; u_r]
        self._K, self._K_rate = np.split(self.gain.K, [predictor.nz], axis=1)  # the second is of u_{k−1}
        self._targets, self._nr = targets_of(predictor, track), len(C)
        self._given_rows = track.given
        self._observer = Measured(predictor)
        self._w = self._no_w = np.zeros(predictor.nw)  # the measured disturbance that has acted since the last call
        self._reference_key: tuple[bytes, int] | None = None
        self._feedforward = np.zeros(predictor.nu)
        self._row = 0  # of a given u_target, for the next call
        super().__init__(predictor.dt, predictor.nx, track.inputs, track.rates)
        self.follow_rows(self.limits, predictor.inputs)

    def as_data(self) -> SavedController:
        """Return what the controller was made of."""
        return SavedController("LQR", self.predictor, self.cost, self.limits)

    def build_program(self, reference: ArrayLike | None) -> FeedbackProgram:
        """Return the data of a step."""
        if self._rows is not None:
            raise no_export(self, "its limits have rows in time, and its C keeps one set", "one with limits.at(step)")
        program = FeedbackProgram(
            controller=type(self).__name__,
            model=self.predictor,
            targets=self._targets,
            inputs=self.inputs,
            rates=self.rates,
            given=self._given_rows,
            reference=reference_table(reference, self._nr),
            K=self._K,
            K_rate=self._K_rate,
            feedforward=self._v,
            estimator=self._observer.program(),
        )
        _ = program.lifting  # it may be code that cannot be written in C
        return program

    @alone
    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Set the last input, zero inside the limits by default; rows of a given u_target start at the first."""
        self._observer.reset()
        self._w = self._no_w
        self._row = 0
        super().reset(x0, u_prev)

    @alone
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
        target = checks.numbers(reference, "reference")
        told = None if w is None else self._disturbance(checks.numbers(w, "w"))
        key = target.tobytes() + (b"" if told is None else told.tobytes()), self._row
        if key != self._reference_key:
            self._aim(target, told)
            self._reference_key = key
        self.take_applied(applied)
        self._observer.observe(x, self._last, self._w)
        held = self._observer.stand_in_w if len(self._w) else None
        if held is not None:
            self._aim(target, held)
            self._reference_key = None
        if self._given_rows is not None and self._row + 1 < len(self._given_rows):
            self._row += 1
        self._w = self._no_w if told is None else np.where(np.isfinite(told), told, self._w)
        free = self._feedforward - self._K @ self._observer.z
        if self._K_rate.size:
            free -= self._K_rate @ self._last
        move = self.limit_input(free if (np.abs(free) < HUGE).all() else None, start)
        move.refused = self._observer.refused
        return move

    def _disturbance(self, w: Float[np.ndarray, "..."]) -> Float[np.ndarray, " nw"]:
        """Return w of this step, NaN where it cannot be."""
        row = w[0] if w.ndim == 2 and len(w) else w
        if row.shape != (self.predictor.nw,):
            raise ShapeError(
                f"w has shape {w.shape}, the predictor has {self.predictor.nw} disturbances; pass one value each"
            )
        return np.where(np.abs(row) < HUGE, row, np.nan)

    def _aim(self, reference: Float[np.ndarray, "..."], w: Float[np.ndarray, " nw"] | None) -> None:
        """Set the feedforward of a reference and a disturbance, NaN where one of them is NaN."""
        row = checks.reference_rows(reference, 0, self._nr)
        found = self._targets
        if self._given_rows is not None:
            u_r = self._given_rows[self._row]
        else:
            e = None if w is None else self.predictor.E @ w
            u_r = found.u0 + found.W @ found.coordinates(row, e)[0]
            if e is not None:
                u_r = u_r + found.u_disturbance @ e
        w = np.zeros(self.predictor.nw) if w is None else w
        self._feedforward = self._v @ np.concatenate([w, row[0], u_r])


def lqr(A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike) -> Gain:
    """Minimise ∫ xᵀQx + uᵀRu dt for ẋ = A x + B u: K = R⁻¹BᵀP, AᵀP + PA − PBR⁻¹BᵀP + Q = 0.

    Parameters
    ----------
    A, B
        (nx, nx), (nx, nu).
    Q, R
        Weights, Q ⪰ 0, R ≻ 0; a scalar or a vector is a diagonal.

    Raises
    ------
    DefinitenessError
        R is not positive definite, or Q is indefinite.
    DataError
        No stabilising solution: (A, B) is not stabilisable, or an imaginary mode is not seen by Q.
    """
    A, B, Q, R = _pair(A, B, Q, R)
    try:
        P = scipy.linalg.solve_continuous_are(A, B, Q, R)
    except ValueError as error:  # SciPy's own where the pencil is too far from triangular, and LinAlgError
        raise DataError(_UNSTABILISABLE) from error
    K = np.linalg.solve(R, B.T @ P)
    _require(float(np.linalg.eigvals(A - B @ K).real.max()) < 0)
    return Gain(K, P)


def dlqr(A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike) -> Gain:
    """Minimise Σ xᵀQx + uᵀRu for x⁺ = A x + B u: K = (R + BᵀPB)⁻¹BᵀPA, P = Q + AᵀP(A − BK).

    Parameters and errors as in `lqr`. With a Constant observable there is no such solution; `LQR` iterates instead.

    Examples
    --------
    >>> import koopmpc as km
    >>> gain = km.dlqr([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], Q=[1, 0.1], R=0.01)
    >>> gain.K.round(2)  # u = −K x
    array([[7.6 , 4.98]])
    """
    A, B, Q, R = _pair(A, B, Q, R)
    try:
        P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    except ValueError as error:  # SciPy's own where the pencil is too far from triangular, and LinAlgError
        raise DataError(_UNSTABILISABLE) from error
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    _require(float(np.abs(np.linalg.eigvals(A - B @ K)).max()) < 1)
    return Gain(K, P)


_UNSTABILISABLE = (
    "the Riccati equation has no stabilising solution: (A, B) is not stabilisable, or Q does not see a mode on the"
    " stability boundary; check the pair, or use LQR and KoopmanMPC, which iterate the difference equation"
)


def _require(stable: bool) -> None:
    if not stable:
        raise DataError(_UNSTABILISABLE)


def _pair(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike
) -> tuple[
    Float[np.ndarray, "nx nx"],
    Float[np.ndarray, "nx nu"],
    Float[np.ndarray, "nx nx"],
    Float[np.ndarray, "nu nu"],
]:
    A = checks.bounded(A, "A", (None, None))
    A = checks.array(A, "A", (len(A), len(A)))
    B = checks.bounded(B, "B", (len(A), None))
    return A, B, checks.weight(Q, "Q", len(A)), checks.weight(R, "R", B.shape[1], definite=True)


register_controller(
    ControllerKind(
        LQR,
        bench=(
            BenchEntry(
                "lqr",
                "Linear feedback on your equations, linearised at the equilibrium, cut to the input limits.",
                "equations",
                lambda parts, limits: LQR(parts.local_model, parts.problem.cost, limits),
            ),
            BenchEntry(
                "koopman-lqr",
                "Linear feedback on the linear lifted model that was learned from data, cut to the input limits.",
                "linear",
                lambda parts, limits: LQR(parts.model, parts.problem.cost, limits),
            ),
        ),
    )
)
