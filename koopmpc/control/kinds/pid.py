"""PID: one loop an input, with anti-windup, a filtered derivative and set-point weights; tuned by SIMC.

Åström & Hägglund, "Advanced PID Control", 2006, chapters 3 and 6. Skogestad, "Simple analytic rules for model reduction
and PID controller tuning", J. Process Control 13, 2003 (SIMC).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.errors import DataError, ShapeError, refuse_moved
from koopmpc.control.ask.checks import FEEDBACK_FIELDS
from koopmpc.control.ask.cost import Cost, check_cost_and_limits
from koopmpc.control.ask.limits import Limits, require_known
from koopmpc.control.kinds import BenchEntry, ControllerKind, register_controller
from koopmpc.control.move import Move, alone
from koopmpc.control.plan.tracking import lifted_tracking
from koopmpc.control.program import Restored, SavedController
from koopmpc.control.step.feedback import FeedbackLaw
from koopmpc.models.predictors import LinearPredictor

_CIRCLE = 1e-9  # distance from the unit circle up to which a pole is on it


class StepResponse(NamedTuple):
    """First order with delay, K e^{−θs} / (τ s + 1): gain K, τ [s] and θ [s]."""

    gain: float
    time_constant: float
    delay: float


@dataclass(frozen=True, kw_only=True)
class PIDOptions:
    """What few PIDs change.

    Attributes
    ----------
    b, c
        Weights of the set point in the proportional part and in the derivative.
    filter_time
        (nu,) T_f [s]; by default a tenth of kd / kp.
    references
        For each input, the index of its set point in r; by default 0, 1, …
    """

    b: float = 1.0
    c: float = 0.0
    filter_time: ArrayLike | None = None
    references: Sequence[int] | None = None


class PID(FeedbackLaw):
    """u = bias + kp (b r − y) + I + D for each input, of one measured output each, clipped to the limits.

    I⁺ = I + ki dt (r − y) + (dt / T_t) (u_applied − u_free) where u_free is the input before it was clipped, so that I
    does not wind up; T_t = kp / ki. D follows kd d(c r − y)/dt through a first-order filter of time constant T_f.

    One thread at a time may call it.

    Parameters
    ----------
    kp, ki, kd
        (nu,) or scalars: gains of the error, of its integral [1/s], and of its derivative [s]. Each input has one loop.
    dt
        Sampling time [s].
    outputs
        For each input, the index of its measurement in y; by default 0, 1, …
    limits
        Limits of the inputs and of their changes; others are not seen.
    bias
        (nu,) u where nothing is wrong.
    options
        Weights of the set point, the filter's time, and which set point is whose.

    Raises
    ------
    DataError, ShapeError
        Gains of one loop with different signs, or sizes that do not fit.

    Examples
    --------
    >>> import koopmpc as km
    >>> pid = km.control.PID(kp=2.0, ki=1.0, dt=0.1, limits=km.Limits(u_min=-1, u_max=1))
    >>> pid([0.8], [1.0]).u.round(3)
    array([0.4])
    """

    def __init__(
        self,
        kp: ArrayLike,
        ki: ArrayLike = 0.0,
        kd: ArrayLike = 0.0,
        *,
        dt: float,
        outputs: Sequence[int] | None = None,
        limits: Limits | None = None,
        bias: ArrayLike = 0.0,
        options: PIDOptions | None = None,
        **moved: object,
    ) -> None:
        refuse_moved(moved, PIDOptions, "km.control.PIDOptions")
        known = PIDOptions() if options is None else options
        checks.kind(known, "options", PIDOptions, "pass km.control.PIDOptions(b=…)")
        gains = [np.atleast_1d(checks.array(value, name)) for value, name in ((kp, "kp"), (ki, "ki"), (kd, "kd"))]
        for given, name in ((outputs, "outputs"), (known.references, "references")):
            if given is not None:
                checks.kind(given, name, (tuple, list, range, np.ndarray), "pass one index a loop")
        if limits is not None:
            checks.kind(limits, "limits", Limits, "pass km.Limits(u_min=…, u_max=…)")
            require_known(limits, "a PID", FEEDBACK_FIELDS)
        nu = max(len(outputs) if outputs is not None else 1, *(g.size for g in gains))
        self.kp, self.ki, self.kd = (
            checks.vector(value, name, nu) for value, name in ((kp, "kp"), (ki, "ki"), (kd, "kd"))
        )
        for i in range(nu):
            signs = {float(np.sign(g[i])) for g in (self.kp, self.ki, self.kd)} - {0.0}
            if len(signs) > 1:
                values = f"kp = {self.kp[i]:g}, ki = {self.ki[i]:g}, kd = {self.kd[i]:g}"
                raise DataError(f"loop {i} has {values}; the gains of one loop have one sign")
        self.outputs = _indices(outputs, "outputs", nu)
        self.references = _indices(known.references, "references", nu)
        self.limits = limits or Limits()
        widest = self.limits.base
        super().__init__(checks.positive(dt, "dt", "s"), 0, widest.inputs(nu), widest.rates(nu))
        self.follow_rows(limits)
        with np.errstate(divide="ignore", invalid="ignore"):
            tenth = np.where(self.kp != 0, 0.1 * self.kd / np.where(self.kp != 0, self.kp, 1.0), self.dt)
            share = self.dt * self.ki / np.where(self.kp != 0, self.kp, 1.0)
        self._filter = tenth if known.filter_time is None else checks.vector(known.filter_time, "filter_time", nu)
        if (self._filter < 0).any():
            raise DataError(f"filter_time is {self._filter}; pass times of 0 s or more")
        # P or PD alone has no integral that could wind up; an integral alone follows at once
        self._back = np.where(self.ki == 0, 0.0, np.where(self.kp != 0, np.minimum(share, 1.0), 1.0))
        self.b, self.c = (float(checks.array(value, name, ())) for value, name in ((known.b, "b"), (known.c, "c")))
        self.bias = checks.vector(bias, "bias", nu)
        self._forget()

    @classmethod
    def tune(
        cls,
        model: LinearPredictor,
        cost: Cost,
        limits: Limits | None = None,
        *,
        bias: ArrayLike = 0.0,
    ) -> "PID":
        """Return a PI controller tuned by SIMC with τ_c = θ, from the step responses of a linear model.

        Each tracked output with a weight is paired with an input by the relative gains of the responses' ends. A
        response is read as first order with delay by its times of 28 and 63 %. θ has half a step more, for the hold.
        Then kp = τ / (2 K θ), T_i = min(τ, 8 θ).

        Parameters
        ----------
        model
            z⁺ = A z + B u, linearised where the plant is to be held; `LinearPredictor.local` makes it.
        cost
            Whose Q says what is to be controlled. Each tracked output is a state.
        limits
            For the controller.
        bias
            (nu,) the input that holds the plant there.

        Raises
        ------
        DataError
            SIMC has no rule: unequal numbers, tracked outputs that are not states, an unstable or integrating model,
            a response that overshoots or does not move.
        """
        cost, known = check_cost_and_limits(cost, limits, model.states, model.inputs)
        track = lifted_tracking(model, cost, known.base)
        weighed = np.flatnonzero(np.diag(track.Q) > 0)
        if len(weighed) != model.nu:
            raise DataError(
                f"the cost weighs {len(weighed)} outputs, the plant has {model.nu} inputs; a PID needs one output an "
                "input: pass a Cost of= these outputs"
            )
        tracked = track.tracked[weighed]
        measured = [_find_state(row, model.C) for row in tracked]
        responses = [[_read_response(model, row, j) for j in range(model.nu)] for row in tracked]
        gains = np.array([[found.gain for found in row] for row in responses])
        place = _pair(gains)
        loops = [responses[place[j]][j] for j in range(model.nu)]
        delay = np.array([found.delay for found in loops])
        slow = np.array([found.time_constant for found in loops])
        kp = slow / (2 * np.array([found.gain for found in loops]) * delay)
        return cls(
            kp,
            kp / np.minimum(slow, 8 * delay),
            dt=model.dt,
            outputs=[measured[i] for i in place],
            limits=known,
            bias=bias,
            options=PIDOptions(references=[int(weighed[i]) for i in place]),
        )

    def as_data(self) -> SavedController:
        """Return what the controller was made of."""
        options = {name: getattr(self, name) for name in ("kp", "ki", "kd", "dt", "b", "c", "bias")}
        options["filter_time"] = self._filter
        options |= {"outputs": self.outputs.tolist(), "references": self.references.tolist()}
        return SavedController("PID", None, limits=self.limits, options=options)

    @classmethod
    def from_data(cls: type[Restored], saved: SavedController) -> Restored:
        """Return the controller that is made of these data."""
        build: Any = cls
        shape = {name: saved.options[name] for name in PIDOptions.__dataclass_fields__}
        others = {name: value for name, value in saved.options.items() if name not in shape}
        return build(limits=saved.limits, options=PIDOptions(**shape), **others)

    def _forget(self) -> None:
        self._integral, self._derivative = np.zeros(self.nu), np.zeros(self.nu)
        self._pushed: Float[np.ndarray, " nu"] | None = None  # c r − y of the last step
        self._free: Float[np.ndarray, " nu"] | None = None  # the last input before it was clipped

    @alone
    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget the integral and the derivative; rates count from u_prev, zero inside the limits by default."""
        super().reset(None, u_prev)
        self._forget()

    @alone
    def take_over(self, y: ArrayLike, reference: ArrayLike, u: ArrayLike) -> None:
        """Set the integral so that a call with this y and reference returns u: a switch without a bump.

        A loop with ki = 0 keeps its law.
        """
        u = checks.array(u, "u", (self.nu,))
        r, measured = self._select(y, reference)
        self._forget()
        self._last = u
        free = u - self.bias - self.kp * (self.b * r - measured)
        if np.isfinite(free).all():
            self._integral = np.where(self.ki == 0, 0.0, free)

    def _select(self, y: ArrayLike, reference: ArrayLike) -> tuple[Float[np.ndarray, " nu"], Float[np.ndarray, " nu"]]:
        """Return the set point and the measurement of each loop."""
        measured, rows = checks.numbers(y, "y"), checks.numbers(reference, "reference")
        row = rows[0] if rows.ndim == 2 else rows
        for values, chosen, name in ((measured, self.outputs, "y"), (row, self.references, "reference")):
            if values.ndim != 1 or len(values) <= chosen.max():
                raise ShapeError(f"{name} has shape {values.shape}; the PID reads its entry {chosen.max()}")
        return row[self.references], measured[self.outputs]

    @alone
    def __call__(
        self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None = None, w: ArrayLike | None = None
    ) -> Move:
        """Return the input for measurement y and a reference row, or rows of which the first counts."""
        del w
        start = perf_counter()
        r, measured = self._select(y, reference)
        self.take_applied(applied)
        if self._free is not None:
            self._integral = self._integral + self._back * (self._last - self._free)
            self._free = None
        error, pushed = r - measured, self.c * r - measured
        if not (np.abs(np.concatenate([error, pushed])) < HUGE).all():
            self._pushed = None
            return self.limit_input(None, start)
        before = pushed if self._pushed is None else self._pushed
        self._derivative = (self._filter * self._derivative + self.kd * (pushed - before)) / (self._filter + self.dt)
        self._pushed = pushed
        free = self.bias + self.kp * (self.b * r - measured) + self._integral + self._derivative
        move = self.limit_input(free, start)
        self._integral = self._integral + self.ki * self.dt * error
        self._free = free
        return move


def _indices(given: Sequence[int] | None, name: str, nu: int) -> Int[np.ndarray, " nu"]:
    chosen = list(range(nu)) if given is None else [checks.count(i, f"an index of {name}", 0) for i in given]
    if len(chosen) != nu:
        raise ShapeError(f"{name} has {len(chosen)} entries, the PID {nu} loops; pass one index a loop")
    return np.array(chosen)


def _find_state(row: Float[np.ndarray, " nz"], C: Float[np.ndarray, "nx nz"]) -> int:
    """Return the index of the state that a tracked output is."""
    for i, state in enumerate(C):
        if np.allclose(row, state, rtol=1e-9, atol=1e-12):
            return i
    raise DataError("the cost tracks an output other than a state; a PID reads measured states: pass of=km.State(…)")


def _read_response(
    model: LinearPredictor,
    row: Float[np.ndarray, " nz"],
    j: int,
    longest: int = 20_000,
    settled: float = 1e-3,
    overshoot: float = 0.05,
) -> StepResponse:
    """Return the response of an output to a step of input j as first order with delay; the hold adds half a step.

    It has at most `longest` steps. Its end may still move by the share `settled` of its range, and it may pass its end
    by the share `overshoot`.
    """
    poles = np.linalg.eigvals(model.A)
    largest = np.sort(np.abs(poles))[::-1]
    constant = bool(np.isclose(poles, 1.0, atol=_CIRCLE).any()) and _holds_constant(model.A)
    if largest[int(constant)] >= 1 - _CIRCLE:
        raise DataError(
            f"the model is not stable where it is linearised, largest pole {largest[int(constant)]:.4g}; SIMC has no "
            "rule for it: choose the gains by hand, or use an LQR"
        )
    slowest = -1 / np.log(max(float(largest[int(constant)]), 0.1))
    steps = min(longest, int(np.ceil(10 * slowest)) + 10)
    z, values = np.zeros(model.nz), np.empty(steps + 1)
    for k in range(steps + 1):
        values[k] = row @ z
        z = model.A @ z + model.B[:, j]
    gain, span = float(values[-1]), float(np.abs(values).max())
    if not span > 0 or abs(gain) < 1e-9 * span:
        raise DataError(f"input {j} does not move the output for good; a PID cannot hold it with this input")
    if abs(values[-1] - values[-2]) > settled * span:
        raise DataError("the step response of the model does not settle; SIMC has no rule for it")
    shares = values / gain
    if shares.max() > 1 + overshoot:
        raise DataError(f"the step response overshoots by {100 * (shares.max() - 1):.3g} %; SIMC has no rule for it")
    early, late = (_reach(shares, level) * model.dt for level in (0.283, 0.632))
    slow = max(1.5 * (late - early), model.dt / 2)
    return StepResponse(gain, slow, max(late - slow, 0.0) + model.dt / 2)


def _holds_constant(A: Float[np.ndarray, "nz nz"]) -> bool:
    """Return whether an observable is a constant: its row is that of the identity."""
    return bool((np.abs(A - np.eye(len(A))).max(axis=1) <= _CIRCLE).any())


def _reach(shares: Float[np.ndarray, " T"], level: float) -> float:
    """Return the step, between two of them, at which the shares reach a level for the first time."""
    k = int(np.argmax(shares >= level))
    return k - float((shares[k] - level) / (shares[k] - shares[k - 1])) if k else 0.0


def _pair(gains: Float[np.ndarray, "n n"]) -> list[int]:
    """Return the output of each input: the largest relative gains, Λ = K ∘ (K⁻¹)ᵀ, each output once."""
    from scipy.optimize import linear_sum_assignment

    if np.linalg.matrix_rank(gains) < len(gains):
        raise DataError("the inputs cannot hold these outputs one by one: the matrix of gains is singular")
    relative = gains * np.linalg.inv(gains).T
    outputs, inputs = linear_sum_assignment(-relative)
    place = [0] * len(gains)
    for i, j in zip(outputs.tolist(), inputs.tolist(), strict=True):
        place[j] = i
    return place


def _build_pid(parts: Any, limits: Limits) -> PID:
    problem = parts.problem
    return PID.tune(parts.local_model, problem.cost, limits, bias=problem.equilibrium[1])


register_controller(
    ControllerKind(
        PID,
        bench=(
            BenchEntry(
                "pid",
                "PI loops tuned by SIMC from your equations' step responses, where inputs and outputs pair.",
                "equations",
                _build_pid,
                on_request=True,  # SIMC has no rule for plants that are unstable where they are held
            ),
        ),
    )
)
