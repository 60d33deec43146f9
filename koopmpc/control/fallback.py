"""What replaces the answer of a failed step: the last plan moved on, the clipped optimum, the last input."""

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.limits import Box
from koopmpc.control.move import Fallback
from koopmpc.lifting.buffered import HUGE


def admitted(
    u: Float[np.ndarray, " nu"], inputs: Box, rates: Box | None, last: Float[np.ndarray, " nu"]
) -> Float[np.ndarray, " nu"]:
    """Return the input inside its limits, and as far as they allow within a change inside `rates` from the last."""
    if rates is not None:
        u = np.clip(u, last + rates.low, last + rates.high)
    return np.clip(u, *inputs)


def hard(rates: Box | None, linear: Float[np.ndarray, " nu"]) -> Box | None:
    """Return the rate limits that are hard, whose `linear` slack weight is inf, ±inf in place of the others."""
    if rates is None or not np.isinf(linear).any():
        return None
    ends = zip(rates, (-np.inf, np.inf), strict=True)
    return Box(*(np.where(np.isinf(linear), end, free) for end, free in ends))


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
        inputs: Box,
        N: int,
        rates: Box | None = None,
        move_of: Int[np.ndarray, " N"] | None = None,
    ) -> None:
        self._inputs, self._N, self._nu = inputs, N, len(inputs.low)
        self._rates = rates
        self._move_of = np.arange(N) if move_of is None else move_of
        self._plan: Float[np.ndarray, " nv"] | None = None
        self._age = 0
        self._given: Float[np.ndarray, " nu"] | None = (
            None  # the last input, where it is not the plan's first
        )
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
