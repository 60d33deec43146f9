"""WeighedPlans: the plans of a cost whose weights move in time, one for each preview of weights that differs."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.control.cost import LiftedTracking
from koopmpc.control.horizon import WeightRows
from koopmpc.control.linear.plan import PlanMap
from koopmpc.control.linear.windows import LimitWindows
from koopmpc.errors import DefinitenessError

_KEPT = 64  # plans that are kept; with weights of a day in hours all are found again after the first day


class WeighedPlan(NamedTuple):
    """A plan, and the windows of the controller's own limits in time on it; None where they do not move."""

    plan: PlanMap
    windows: LimitWindows | None


class WeighedPlans:
    """Finds the plan of each step: made when its weights are met first, kept for steps with the same ones.

    A plan depends on the weights of all of its steps, through the Riccati recursion. What the set points and the end
    of the horizon are does not: these follow Q and R.

    Parameters
    ----------
    track, N
        The cost with weights in time; steps of a plan.
    base
        The plan of Q and R, for previews that hold nothing else.
    make
        Makes the plan of other weights.
    """

    def __init__(
        self, track: LiftedTracking, N: int, base: WeighedPlan, make: Callable[[WeightRows], WeighedPlan]
    ) -> None:
        self._track, self._N, self._make = track, N, make
        Q, R = (np.tile(weight.diagonal(), (N, 1)) for weight in (track.Q, track.R))
        self._base = self._key(Q, R)
        self._plans = {self._base: base}

    @staticmethod
    def _key(Q: Float[np.ndarray, "N nr"], R: Float[np.ndarray, "N nu"]) -> bytes:
        return Q[1:].tobytes() + R.tobytes()  # the weight of the present state changes no plan

    def check_free_inputs(self) -> None:
        """Raise where a plan of some later step cannot be made: only rows of R that hold a zero may do that.

        Raises
        ------
        DefinitenessError
            In the plan of a step some change of the inputs costs nothing.
        """
        cost = self._track.cost
        steps = max(len(np.asarray(rows)) for rows in (cost.Q_rows, cost.R_rows) if rows is not None)
        Q, R = cost.weight_rows(len(self._track.Q), len(self._track.R), 0, steps + self._N)
        tried = set[bytes]()
        for k in range(steps):
            own = slice(k, k + self._N)
            key = self._key(Q[own], R[own])
            if R[own].min() <= 0 and key not in tried:
                tried.add(key)
                try:
                    self.find(k)
                except DefinitenessError as error:
                    raise DefinitenessError(
                        f"in the plan that begins at row {k} of Q_rows and R_rows {error}"
                    ) from None

    def find(self, step: int) -> WeighedPlan:
        """Return the plan whose first input acts in this step."""
        track = self._track
        Q, R = track.cost.weight_rows(len(track.Q), len(track.R), step, self._N)
        key = self._key(Q, R)
        found = self._plans.pop(key, None)
        if found is None:
            found = self._make(WeightRows(Q, R))
            while len(self._plans) >= _KEPT:
                oldest = next(known for known in self._plans if known != self._base)
                del self._plans[oldest]
        self._plans[key] = found
        return found
