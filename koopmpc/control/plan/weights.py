"""PlansInTime: the plans of a cost whose weights move in time, one for each preview of weights that differs."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from koopmpc.base.errors import DefinitenessError
from koopmpc.control.horizon import WeightRows
from koopmpc.control.plan.condensed_program import CondensedPlan
from koopmpc.control.plan.tracking import LiftedTracking

_KEPT = 64  # plans that are kept; with weights of a day in hours all are found again after the first day


class PlansInTime:
    """Finds the plan of each step: made when its weights are met first, kept for steps with the same ones.

    A plan depends on the weights of all of its steps, through the Riccati recursion. What the set points and the end
    of the horizon are does not: these follow Q and R.

    Parameters
    ----------
    track, N, latency
        The cost with weights in time; steps of a plan; steps until its first input acts.
    base
        The plan of Q and R, for previews that hold nothing else.
    make
        Makes the plan of other weights.
    """

    def __init__(
        self,
        track: LiftedTracking,
        N: int,
        latency: int,
        base: CondensedPlan,
        make: Callable[[WeightRows], CondensedPlan],
    ) -> None:
        self._track, self._N, self._latency, self._make = track, N, latency, make
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
            ahead = slice(k, k + self._N)
            key = self._key(Q[ahead], R[ahead])
            if R[ahead].min() <= 0 and key not in tried:
                tried.add(key)
                try:
                    self._find(k)
                except DefinitenessError as error:
                    raise DefinitenessError(
                        f"in the plan that begins at row {k} of Q_rows and R_rows {error}"
                    ) from None

    def at(self, k: int) -> CondensedPlan:
        """Return the plan of step k."""
        return self._find(k + self._latency)

    def _find(self, row: int) -> CondensedPlan:
        """Return the plan whose first input acts at this row of the weights."""
        track = self._track
        Q, R = track.cost.weight_rows(len(track.Q), len(track.R), row, self._N)
        key = self._key(Q, R)
        plan = self._plans.pop(key, None)
        if plan is None:
            plan = self._make(WeightRows(Q, R))
            while len(self._plans) >= _KEPT:
                oldest = next(key for key in self._plans if key != self._base)
                del self._plans[oldest]
        self._plans[key] = plan
        return plan
