"""What replaces the answer of a failed step: the last plan moved on, the clipped optimum, the last input."""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.limits import Box
from koopmpc.control.move import Fallback


class PlanMemory:
    """Remembers the last good plan and the last input; whatever it returns is inside the input limits."""

    def __init__(self, inputs: Box, N: int) -> None:
        self._inputs, self._N, self._nu = inputs, N, len(inputs.low)
        self._plan: Float[np.ndarray, " nv"] | None = None
        self._age = 0
        self._last: Float[np.ndarray, " nu"] = np.clip(np.zeros(self._nu), *inputs)

    def reset(self, u_prev: ArrayLike | None = None) -> None:
        """Forget the plan; the last input is `u_prev`, or zero, moved inside the limits."""
        last = np.zeros(self._nu) if u_prev is None else checks.array(u_prev, "u_prev", (self._nu,))
        self._plan, self._age = None, 0
        self._last = np.clip(last, *self._inputs)

    def keep(self, plan: Float[np.ndarray, " nv"]) -> None:
        """Keep a good plan (by reference, for speed): its first N nu entries are the inputs."""
        self._plan, self._age = plan, 0

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
        if self._plan is not None:
            plan = self._plan[: self._N * self._nu].reshape(self._N, self._nu)
            self._last = plan[self._age].copy()
            if self._age + 1 < self._N:
                self._age += 1
                return plan[self._age].copy(), Fallback.SHIFTED_PLAN
            self._plan = None
        if free is not None:
            self._last = np.clip(free, *self._inputs)
            return self._last.copy(), Fallback.CLIPPED_LQR
        if applied is not None:
            got = np.asarray(applied, dtype=np.float64)
            if got.shape == self._last.shape and np.isfinite(got).all():
                self._last = np.clip(got, *self._inputs)
        return self._last.copy(), Fallback.HOLD
