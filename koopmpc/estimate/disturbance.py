"""LiftedDisturbance: the disturbance of every lifted coordinate, learned from misfits as far as they are constant."""

from dataclasses import dataclass
from math import exp

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Value, Viewing
from koopmpc.estimate.gate import BRIDGED, ROUNDING, gate_graph
from koopmpc.estimate.observer import EstimatorProgram, Measured, StateModel
from koopmpc.estimate.periodic import PeriodicObserver, find_harmonics
from koopmpc.models.predictors import LinearPredictor
from koopmpc.plants.routines import bind_interpreter

EXACT = 0.99  # where a misfit hardly changes to this degree, the last one is nearer than any mean
GAIN = 0.1  # the least gain that a horizon gives: d forgets within twenty steps, however long the plan
REACH = 0.4  # d is the last misfit if misfits hardly change over this share of the horizon (docs/why)


@dataclass(frozen=True, eq=False)
class LiftedDisturbance(Value):
    """z = ψ(x) afresh each step; d follows the misfits e = ψ(x⁺) − A ψ(x) − B u − E w as far as they are constant.

    At rest d is exactly what the model lacks at that state and input, in every lifted coordinate. So the plant's
    equilibrium is one of the controller's model, z = A z + B u + d. With disturbances of fewer coordinates an offset
    remains, because z is lifted afresh from x. The Constant has no disturbance. In a controller on x⁺ = F(x, u) + d
    the states have the disturbances.

    A plan holds d over its horizon, but what a model lacks in a transient is not what it lacks where the plan ends.
    Therefore d ← d + c (m − d), m the mean of the last misfits and c the share of them that was constant, as the states
    show it: c = 1 − Σ vᵢ/sᵢ² / Σ max((C m)ᵢ², (C d)ᵢ²)/sᵢ², at least 0. v is the variance of C e about C m, without
    half the mean square of its successive differences, which is noise. s is the largest step or misfit that a state has
    shown so far, and at least 1e-9 of its size. Where the misfits vary by more than their mean nothing is learned; at
    rest v = 0 and d = m = e.

    Exact measurements need no mean. If the gain is not given, and c' = 1 − L² D / max(Σ (C e)ᵢ²/sᵢ², Σ (C d)ᵢ²/sᵢ²) is
    above c or above 0.99, the last misfit takes the place of the mean: d ← d + c' (e − d). D is the running mean of
    Σ (C e − C e⁻)ᵢ²/sᵢ², the squared change of a misfit in a step, and L is 0.4 N. Noise and transients that turn
    within L steps leave c' at zero.

    A reading at a rail of its sensor, as the model's `Delay` has them, teaches nothing if the prediction is beyond it.
    A reading far from its prediction is refused: A z + B u + E w + d stands in for at most six steps, and nothing is
    learned. Once readings are used again, all means start again.

    Parameters
    ----------
    gain
        Weight of the newest misfit in all these means, m ← m + gain (e − m), in (0, 1]: 1 makes d the last misfit.
        By default 1 − exp(−4/N), so that misfits are remembered over a quarter of the horizon, and at least 0.1; and
        1 where misfits hardly change.

    period
        Of a disturbance that repeats itself, a shaft or the day [s]. Then d_k is a constant and harmonics of this
        period, found in the misfits by recursive least squares over the last three periods, and plans know how d goes
        on. `km.estimate.find_period` finds a period in logs.
    harmonics
        How many harmonics of the period, at most; those faster than two samples are left out.

    Raises
    ------
    DataError
        The gain is outside (0, 1], or given with a period; a period is not above zero; when a controller is built, it
        is shorter than two samples.

    References
    ----------
    von Neumann, "Distribution of the ratio of the mean square successive difference to the variance", Ann. Math.
    Stat. 12, 1941.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> pd = km.Feedback([[40, 15]], km.Noise(-20, 20), u_min=-25, u_max=25)
    >>> data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), pd, episodes=60, steps=60)
    >>> model = km.edmd(data, km.State() + km.Fourier(1, states="theta"))
    >>> cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-25, u_max=25)
    >>> mpc = km.KoopmanMPC(model, cost, limits, horizon=40, estimator=km.LiftedDisturbance())
    >>> heavy = km.discretize(type(km.load_problem("pendulum").dynamics)(m=1.2), dt=0.05)
    >>> run = km.simulate(heavy, mpc, x0=[0, 0], reference=[0.5, 0], steps=300)
    >>> bool(abs(run.X[-1, 0] - 0.5) < 1e-6)  # though the bob is a fifth heavier
    True
    """

    gain: float | None = None
    period: float | None = None
    harmonics: int = 3

    def __post_init__(self) -> None:
        checks.count(self.harmonics, "harmonics")
        if self.period is not None:
            checks.positive(self.period, "period", "s")
            if self.gain is not None:
                raise DataError(
                    "gain and period are both given; harmonics are learned over three periods: leave out gain"
                )
        if self.gain is not None and checks.positive(self.gain, "gain") > 1:
            raise DataError(f"gain is {self.gain:g}; it must be in (0, 1], and 1 is deadbeat")

    def start(self, model: LinearPredictor | StateModel, horizon: int) -> "DisturbanceObserver | PeriodicObserver":
        """Return the observer of one controller with plans of this many steps.

        Raises
        ------
        DataError
            The period is shorter than two samples.
        """
        if self.period is not None:
            return PeriodicObserver(model, find_harmonics(self.period, model.dt, self.harmonics))
        if self.gain is not None:
            return DisturbanceObserver(model, self.gain, 0.0)
        return DisturbanceObserver(model, max(1 - exp(-4 / horizon), GAIN), max(REACH * horizon, 1.0))


@dataclass(frozen=True, eq=False)
class DisturbanceProgram(EstimatorProgram):
    """z = ψ(ζ), and d by the rule of `LiftedDisturbance`."""

    gain: float  # weight of the newest misfit
    reach: float  # steps over which a misfit must hardly change to be taken as it is; 0 where a mean is always taken
    known: Bool[np.ndarray, " nz"]  # (nz,) the entries of z that have no disturbance
    C: Float[np.ndarray, "ny nz"]  # (ny, nz) z → states


class DisturbanceObserver(Viewing, Measured):
    """The observer of a `LiftedDisturbance`; a missed sample leaves d as it is.

    The Constant and the past of a state have no disturbances. A step is one product,
    A z + B u + E w, and one call of the CasADi function `_rule`: an observer has half of the time of a step.
    """

    _remembers = True
    _VIEWS = ("z", "d", "_seen", "_x", "_driven", "_u", "_w", "_after", "_flags", "_evaluate", "_buffer")

    def __init__(self, model: LinearPredictor | StateModel, gain: float, reach: float) -> None:
        super().__init__(model)
        self.gain, self.reach = gain, reach
        own = self._model
        saturates = own.embedding is not None and own.embedding.rails is not None
        self._rails = own.embedding if saturates else None
        self._sizes = own.nz, own.nu, own.nw
        lift = None if self.lift is None else self.lift.function
        self._rule = _rule(self._sizes, self.ny, self._known, (gain, reach), lift)
        self._memory, self._C = np.zeros(self._rule.numel_in(2)), np.zeros(self.ny * own.nz)
        self._predicted, self._still = np.zeros(own.nz), np.zeros(own.nz)
        self._stood_in = False  # whether a prediction stood in for a part of the last reading
        self._take(model)
        self._see()

    def _see(self) -> None:
        """Make the views of the memory, and the call of the rule on these arrays; see `Viewing`."""
        nz, nu, nw = self._sizes
        self.z, self._u, self._w, _, self.d = np.split(self._memory, np.cumsum([nz, nu, nw, nz, nz]))[:5]
        self._driven, self._seen = self._memory[: nz + nu + nw], self._memory[-1:]
        self._x, self._after = np.zeros(self._rule.numel_in(0)), np.zeros(len(self._memory))
        self._flags = np.zeros(2)
        arguments = self._x, self._predicted, self._memory, self._C, self._flags
        self._evaluate, self._buffer = bind_interpreter(self._rule, arguments, (self._after,))

    def _take(self, model: LinearPredictor | StateModel) -> None:
        """Take over the matrices of a model."""
        linear = isinstance(model, LinearPredictor)
        self._ABE = np.hstack([model.A, model.B, model.E]) if linear else None
        C = model.C if linear else np.eye(self.ny, len(self.d))
        self._C[:] = C.ravel("F")
        self._to_y = C

    def reset(self, x0: ArrayLike | None = None) -> None:
        """Forget the last state, all misfits, d and the past; x0 will come as the first measurement."""
        super().reset(x0)
        self._memory[:] = 0.0
        self._stood_in = False

    def forget(self) -> None:
        """Forget d and all misfits, but not the last state: a step that found no plan asks for it."""
        self._memory[sum(self._sizes) : -1] = 0.0

    def program(self) -> DisturbanceProgram:
        """Return the data with which z and d are found."""
        return DisturbanceProgram(
            self.gain, self.reach, self._known, self._to_y.copy(), gate=gate_graph(self.ny, leaps=True)
        )

    def update(self, model: LinearPredictor | StateModel) -> None:
        """Go on with another model; d takes as long to follow as it took to come."""
        super().update(model)
        self._take(model)

    def observe(self, y: Float[np.ndarray, " ny"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"]) -> bool:
        """Take y, and learn from the misfit of the step that led here, if y was neither refused now nor just before."""
        gate, expected, beyond = self._gate, self._nothing, False
        assert gate is not None, "it remembers readings"
        if self._seen[0]:
            self._u[:] = u
            expected = gate.choose(y, w, self._predict) if len(w) else self._predict(w)
            if self._rails is not None:
                beyond = bool(self._rails.is_beyond(y, expected).any())
                expected = self._rails.clip(expected)
        stands_in = gate.judge(y, expected)
        if gate.lost:
            self._memory[:] = 0.0
            if self._history is not None:
                self._history.reset()
        if stands_in:
            y = expected
        self._x[:] = y if self._history is None else self._history.take(y, u)
        learns = not (stands_in or self._stood_in or gate.opened or beyond)
        self._flags[0], self._flags[1] = learns, gate.opened
        self._stood_in = stands_in
        self._evaluate()
        foreseen = bool(self._seen[0]) and self._bridged < BRIDGED
        self._memory[:] = self._after
        if self._seen[0]:
            self._bridged = 0
            return True
        if foreseen:  # the next reading is judged all the same
            self.z[:] = self._predicted + self.d
            self._seen[0], self._stood_in = 1.0, True
            self._bridged += 1
        return False

    def _predict(self, w: Float[np.ndarray, " nw"]) -> Float[np.ndarray, " ny"]:
        """Store A z + B u + E w, and return the reading that it and d predict."""
        if self._ABE is None:
            self._predicted[:] = self._model.advance(self.z, self._u, w, self._still)
        else:
            self._w[:] = w
            self._ABE.dot(self._driven, self._predicted)
        return self._to_y.dot(self._predicted + self.d)


@raise_swallowed()
def _rule(
    sizes: tuple[int, int, int],
    nx: int,
    known: Bool[np.ndarray, " nz"],
    speed: tuple[float, float],
    lift: ca.Function | None,
) -> ca.Function:
    """Return (x, A z + B u + E w, memory, C, flags) → memory after x has come; z = ψ(x), or x itself without a `lift`.

    The memory is [z; u; w; m; d; C e; the mean of (C e)² less half the square of its change; s²; D; the number of
    misfits so far, up to 2; the weight of the next misfit, if it is above the gain; whether z is known]. The flags say
    whether this misfit is learned, and whether all means start again with the next one. `speed` is the gain and L.
    """
    nz, nu, nw = sizes
    x, C = ca.SX.sym("x", nz if lift is None else lift.numel_in(0)), ca.SX.sym("C", nx, nz)
    predicted, memory = ca.SX.sym("predicted", nz), ca.SX.sym("memory", 3 * nz + nu + nw + 3 * nx + 4)
    flags = ca.SX.sym("flags", 2)
    ends, (gain, reach) = np.cumsum([0, nz, nu + nw, nz, nz, nx, nx, nx, 1, 1, 1, 1]).tolist(), speed
    last, driven, m, d, f, rough, squares, change, learned, newest, seen = ca.vertsplit(memory, ends)
    z = x if lift is None else ca.SX(lift(x))
    good = ca.dot(z, z) < HUGE**2  # False for NaN
    e = ca.DM(np.where(known, 0.0, 1.0)) * (z - predicted)
    learns = ca.logic_and(ca.logic_and(good, seen), ca.logic_and(flags[0], ca.dot(e, e) < HUGE**2))
    weight = ca.fmax(gain, newest)
    f_new, moved = C @ e, C @ (z - last)
    shown = ca.fmax(ca.fmax(moved**2, f_new**2), (ROUNDING * (C @ z)) ** 2)
    squares_new = ca.fmax(squares, shown)
    weights = ca.if_else(squares_new > 0, 1 / squares_new, 0)
    m_new = m + weight * (e - m)
    rough_new = rough + weight * (f_new**2 - 0.5 * (learned > 0) * (f_new - f) ** 2 - rough)
    mean = (C @ m_new) ** 2
    varied = ca.dot(ca.fmax(rough_new - mean, 0), weights)
    most = ca.dot(ca.fmax(mean, (C @ d) ** 2), weights)
    share = ca.if_else(varied < most, 1 - varied / most, 0)
    changed = ca.dot((f_new - f) ** 2, weights)
    change_new = ca.if_else(learned > 1, change + weight * (changed - change), ca.if_else(learned > 0, changed, change))
    turned = reach**2 * change_new
    largest = ca.dot(ca.fmax(f_new**2, (C @ d) ** 2), weights)
    exact = ca.if_else(ca.logic_and(learned > 0, turned < largest), 1 - turned / largest, 0) if reach else 0
    d_new = d + ca.if_else(ca.logic_or(share < exact, exact > EXACT), exact * (e - d), share * (m_new - d))
    starts = ca.logic_and(flags[1], good)
    before = ca.vertcat(m, d, f, rough, squares, change, ca.if_else(starts, 0, learned), ca.if_else(starts, 1, newest))
    count = ca.fmin(learned + 1, 2)
    after = ca.vertcat(m_new, d_new, f_new, rough_new, squares_new, change_new, count, newest / (1 + newest))
    result = ca.vertcat(z, driven, ca.if_else(learns, after, before), good)
    return ca.Function("rule", [x, predicted, memory, C, flags], [ca.densify(result)], {"cse": True})
