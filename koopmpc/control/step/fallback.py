"""What answers a step that has no plan: the last plan, moved on; the input without limits, clipped; the last input."""

from time import perf_counter
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.values import Interval
from koopmpc.control.move import Fallback, Move, Status
from koopmpc.control.stepped.levels import HeldLevels


@runtime_checkable
class LatePlan(Protocol):
    """A plan of which a step has computed the first input alone."""

    def compute(self) -> Float[np.ndarray, " nv"]:
        """Return the whole plan."""
        ...


class PlanMemory:
    """The last good plan and the last input, and what they answer in a failed step.

    Parameters
    ----------
    nu, move_of
        Number of inputs, and the move that is the input of each step of a plan.
    levels, latency
        The levels of the inputs now, None where they have none; steps until an input acts.
    allowed
        Wall-clock time of a step [s]; inf for any.

    Attributes
    ----------
    given
        The last input returned.
    is_planned
        Whether the last step had a plan.
    """

    def __init__(
        self, nu: int, move_of: Int[np.ndarray, " N"], levels: HeldLevels | None, latency: int, allowed: float
    ) -> None:
        self._nu, self._move_of, self._levels, self._latency, self.allowed = nu, move_of, levels, latency, allowed

    def reset(self, u_prev: ArrayLike | None, box: Interval) -> None:
        """Forget the plan; u_prev is the input that acts, by default zero moved inside this box."""
        zero, levels = np.clip(np.zeros(self._nu), *box), self._levels
        self.given: Float[np.ndarray, " nu"] = zero if u_prev is None else checks.array(u_prev, "u_prev", (self._nu,))
        if levels is not None:
            if u_prev is None:
                levels.reset(zero)  # no dwell time of an earlier run counts
                self.given = levels.round(zero)
            levels.reset(self.given)
        self._plan: Float[np.ndarray, " nv"] | LatePlan | None = None
        self._age, self.is_planned = 0, False

    def take(self, applied: ArrayLike | None) -> None:
        """Count the step for which the input that acted, or that was returned last, held its levels."""
        if self._levels is not None:
            self._levels.take(self.given if self._latency else self.find_last(applied))

    @property
    def plan(self) -> Float[np.ndarray, " nv"] | None:
        """The last good plan, its moves first, one behind the other."""
        if self._plan is not None and not isinstance(self._plan, np.ndarray):
            self._plan = self._plan.compute()
        return self._plan

    def keep(self, plan: "Float[np.ndarray, ' nv'] | LatePlan", u: Float[np.ndarray, " nu"]) -> None:
        """Keep a good plan, by reference, whose first input is u."""
        self._plan, self._age, self.is_planned, self.given = plan, 0, True, u

    def judge_time(self, status: Status, start: float) -> tuple[Status, float]:
        """Return the status, which is TIME_LIMIT of a late step, and how long the step took."""
        taken = perf_counter() - start
        return (status if taken <= self.allowed else Status.TIME_LIMIT), taken

    def find_last(self, applied: ArrayLike | None) -> Float[np.ndarray, " nu"]:
        """Return the input that acted last, as far as `applied` is one; else the last one returned."""
        if applied is not None:
            got = np.asarray(applied, dtype=np.float64)
            if got.shape == (self._nu,) and (np.abs(got) < HUGE).all():
                return got
        return self.given

    def fall_back(
        self,
        status: Status,
        start: float,
        applied: ArrayLike | None,
        limits: tuple[Interval, Interval | None],
        free: Float[np.ndarray, " nu"] | None = None,
        iterations: int = 0,
        solver: str = "",
    ) -> Move:
        """Return the move that replaces a failed step, with the status that says why; TIME_LIMIT where it is late.

        Parameters
        ----------
        applied
            The input that acted last, if it is not the last input returned.
        limits
            The box of the next input, and that of its change.
        free
            The unconstrained optimum, if it is known.
        iterations, solver
            Of the solver that was asked.
        """
        before, plan = self.find_last(applied), self.plan
        self.is_planned = False
        if self._levels is not None and status is Status.TIME_LIMIT:  # no plan was found: hold the levels
            u, fallback = before, Fallback.HOLD
        elif plan is not None and self._age + 1 < len(self._move_of):
            self._age += 1
            first = self._nu * int(self._move_of[self._age])
            u, fallback = plan[first : first + self._nu], Fallback.SHIFTED_PLAN
        else:
            self._plan = None
            u, fallback = (before, Fallback.HOLD) if free is None else (free, Fallback.CLIPPED_LQR)
        box, rates = limits
        reach = None if rates is None else Interval(before + rates.low, before + rates.high)
        u = np.clip(u if reach is None else np.clip(u, *reach), *box)
        self.given = u if self._levels is None else self._levels.round(u, reach, box)
        status, taken = self.judge_time(status, start)
        return Move(self.given.copy(), status, fallback, taken, iterations, solver=solver)
