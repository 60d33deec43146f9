"""MPCBase: what every controller with a plan shares: its horizon, its deadline, and what a failed step returns."""

import copy
from time import perf_counter

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.initial_condition import InitialCondition
from koopmpc.control.limits import Interval, Limits
from koopmpc.control.move import Fallback, Move, Status
from koopmpc.errors import DataError
from koopmpc.estimate.observer import StateObserver
from koopmpc.lifting.buffered import HUGE


def admitted(
    u: Float[np.ndarray, " nu"], inputs: Interval, rates: Interval | None, last: Float[np.ndarray, " nu"]
) -> Float[np.ndarray, " nu"]:
    """Return the input inside its limits, and as far as they allow within a change inside `rates` from the last."""
    if rates is not None:
        u = np.clip(u, last + rates.low, last + rates.high)
    return np.clip(u, *inputs)


def hard(rates: Interval | None, linear: Float[np.ndarray, " nu"]) -> Interval | None:
    """Return the rate limits that are hard, whose `linear` slack weight is inf, ±inf in place of the others."""
    if rates is None or not np.isinf(linear).any():
        return None
    ends = zip(rates, (-np.inf, np.inf), strict=True)
    return Interval(*(np.where(np.isinf(linear), end, free) for end, free in ends))


class PlanMemory:
    """Remembers the last good plan and the last input; whatever it returns is inside the limits of the inputs.

    Parameters
    ----------
    inputs
        The input limits.
    N
        Steps of a plan.
    rates
        Limits of the change of the input; the input limits win.
    move_of
        (N,) which of the plan's moves each step takes; by default each has its own.
    """

    def __init__(
        self,
        inputs: Interval,
        N: int,
        rates: Interval | None = None,
        move_of: Int[np.ndarray, " N"] | None = None,
    ) -> None:
        self._inputs, self._N, self._nu = inputs, N, len(inputs.low)
        self._rates = rates
        self._move_of = np.arange(N) if move_of is None else move_of
        self._plan: Float[np.ndarray, " nv"] | None = None
        self._age = 0
        self._given: Float[np.ndarray, " nu"] | None = None  # the last input, where it is not the plan's first
        self.reset()

    def reset(self, u_prev: ArrayLike | None = None) -> None:
        """Forget the plan; the last input is `u_prev`, or zero moved inside the limits."""
        self._plan, self._age = None, 0
        if u_prev is None:
            self._given = np.clip(np.zeros(self._nu), *self._inputs)
        else:
            self._given = checks.array(u_prev, "u_prev", (self._nu,))

    def keep(self, plan: Float[np.ndarray, " nv"]) -> None:
        """Keep a good plan (by reference, for speed): its first entries are the moves."""
        self._plan, self._age, self._given = plan, 0, None

    def last(self) -> Float[np.ndarray, " nu"]:
        """Return the last input that was returned; not to be written to."""
        if self._given is not None or self._plan is None:
            return self._given if self._given is not None else np.zeros(self._nu)
        return self._plan[: self._nu]

    def before(self, applied: ArrayLike | None) -> Float[np.ndarray, " nu"]:
        """Return what the plant got last: `applied` where it is usable, else the last input returned."""
        if applied is not None:
            got = np.asarray(applied, dtype=np.float64)
            if got.shape == (self._nu,) and (np.abs(got) < HUGE).all():
                return got
        return self.last()

    def instead(
        self, free: Float[np.ndarray, " nu"] | None, applied: ArrayLike | None
    ) -> tuple[Float[np.ndarray, " nu"], Fallback]:
        """Return the input of a failed step and where it comes from.

        Parameters
        ----------
        free
            The unconstrained optimum, where it is known.
        applied
            What the plant really got last, where it is not the last input returned.
        """
        before = self.before(applied)
        if self._plan is not None and self._age + 1 < self._N:
            self._age += 1
            first = self._nu * int(self._move_of[self._age])
            u, how = self._plan[first : first + self._nu], Fallback.SHIFTED_PLAN
        else:
            self._plan = None
            u, how = (before, Fallback.HOLD) if free is None else (free, Fallback.CLIPPED_LQR)
        self._given = admitted(u, self._inputs, self._rates, before)
        return self._given.copy(), how


class MPCBase:
    """A controller whose plan has N steps, of an input that acts `latency` steps after it was computed.

    Parameters
    ----------
    dt, nu
        Sampling time [s], number of inputs.
    cost, limits
        What to minimise, within what; None for no limits.
    horizon, latency
        Steps of the plan, and until its first input acts.
    time_limit
        Wall-clock time a step may take [s]; None for any.
    """

    solver_fails = False  # set by fault injection alone, see control.move.Fallible
    _memory: PlanMemory
    _initial: InitialCondition

    def __init__(
        self,
        dt: float,
        nu: int,
        cost: Cost,
        limits: Limits | None,
        horizon: int,
        latency: int,
        time_limit: float | None,
    ) -> None:
        self.cost, self.limits = checked(cost, limits)
        self._dt, self._nu = dt, nu
        if nu == 0:
            raise DataError("the model has no inputs, so there is nothing to control; fit it on episodes with U")
        self._N, self._latency = checks.count(horizon, "horizon"), checks.count(latency, "latency", 0)
        self._time_limit = time_limit
        self._allowed = np.inf if time_limit is None else checks.positive(time_limit, "time_limit", "s")
        self._planned = False

    def __copy__(self) -> "MPCBase":
        """Return a copy that shares nothing with this one that moves in a step."""
        return copy.deepcopy(self)

    @property
    def dt(self) -> float:
        """Sampling time [s]."""
        return self._dt

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self._nu

    @property
    def horizon(self) -> int:
        """Steps of preview: N of the plan, after those of the latency."""
        return self._N + self._latency

    @property
    def observer(self) -> StateObserver:
        """The estimate now: its z, and its disturbance d."""
        return self._initial.observer

    def _move(
        self,
        u: Float[np.ndarray, " nu"],
        status: Status,
        iterations: int,
        start: float,
        slack: float = 0.0,
    ) -> Move:
        """Return a good step; a late one says so."""
        taken = perf_counter() - start
        in_time = status if taken <= self._allowed else Status.TIME_LIMIT
        return Move(u, in_time, Fallback.NONE, taken, iterations, slack)

    def _fail(
        self,
        free: Float[np.ndarray, " nu"] | None,
        applied: ArrayLike | None,
        status: Status,
        iterations: int,
        start: float,
    ) -> Move:
        """Return what stands in for a failed step, with the status that says why: a late one says that it is late."""
        self._planned = False
        u, fallback = self._memory.instead(free, applied)
        taken = perf_counter() - start
        return Move(u, status if taken <= self._allowed else Status.TIME_LIMIT, fallback, taken, iterations)

    def _known_input(self) -> Float[np.ndarray, " nu"]:
        """Return the input that rates count from: what was applied, where it can be used."""
        u_prev = self._initial.u_prev
        if not u_prev.size:
            return self._memory.last()
        if not (np.abs(u_prev) < HUGE).all():
            u_prev[:] = self._memory.last()
        return u_prev

    def _previewed(self, reference: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the reference from the step on at which the plan starts."""
        if self._latency and reference.ndim == 2 and len(reference):
            return reference[min(self._latency, len(reference) - 1) :]
        return reference


def checked(cost: object, limits: object) -> tuple[Cost, Limits]:
    """Return the cost and the limits, no limits for None.

    Raises
    ------
    DataError
        One is something else, perhaps the other.
    """
    if not isinstance(cost, Cost):
        raise DataError(f"cost is a {type(cost).__name__}; pass a Cost, and the Limits after it")
    if limits is None:
        return cost, Limits()
    if not isinstance(limits, Limits):
        raise DataError(f"limits is a {type(limits).__name__}; pass Limits, or None for none")
    return cost, limits
