"""Receding: what every controller with a plan shares: its horizon, its deadline, and what a failed step returns."""

import copy
from time import perf_counter

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.fallback import PlanMemory
from koopmpc.control.limits import Limits
from koopmpc.control.move import Fallback, Move, Status
from koopmpc.control.origin import Origin
from koopmpc.errors import DataError
from koopmpc.estimate.observer import Observer
from koopmpc.lifting.buffered import HUGE


class Receding:
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
    _origin: Origin

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
            raise DataError(
                "the model has no inputs, so there is nothing to control; fit it on episodes with U"
            )
        self._N, self._latency = checks.count(horizon, "horizon"), checks.count(latency, "latency", 0)
        self._time_limit = time_limit
        self._allowed = np.inf if time_limit is None else checks.positive(time_limit, "time_limit", "s")
        self._planned = False

    def __copy__(self) -> "Receding":
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
    def observer(self) -> Observer:
        """The estimate now: its z, and its disturbance d."""
        return self._origin.observer

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
        u_prev = self._origin.u_prev
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
