"""FirstInput: of a long preview the first input alone, where a bound shows that its plan meets all limits."""

import numpy as np
from jaxtyping import Float

from koopmpc.control.plan.bounds import StepBounds
from koopmpc.control.plan.condensed_program import CondensedPlan
from koopmpc.control.step.share import ReferenceShare


class FirstInputPlan:
    """A plan whose first input alone was computed."""

    def __init__(
        self,
        plan: CondensedPlan,
        known: Float[np.ndarray, " known"],
        rows: Float[np.ndarray, "N1 nr"],
        given: Float[np.ndarray, " nv"] | None,
        u: Float[np.ndarray, " nu"],
    ) -> None:
        self._parts = plan, known, rows, given, u

    def compute(self) -> Float[np.ndarray, " nv"]:
        """Return the whole plan."""
        plan, known, rows, given, u = self._parts
        t = plan.M.dot(known) + plan.offset + plan.from_reference.dot(rows.reshape(-1))
        t += 0.0 if given is None else given
        t[: len(u)] = u
        return t


class FirstInput:
    """The first input of t = M known + f + F r for rows r of a preview, where all of t meets its limits.

    For the middle c of the rows, t = M known + f + F c + F (r − c). Entry i of the last part is at most
    Σ_j S_ij max|r_j − c_j|, S_ij the sum of |F| over the steps. Where the limits leave so much room, all of them are
    met. Then F is multiplied for the first input alone, and the plan is computed when it is asked for.

    Parameters
    ----------
    plan, nu
        The plan, and the number of inputs.
    """

    def __init__(self, plan: CondensedPlan, nu: int) -> None:
        self._plan, self._nu = plan, nu
        count, nr = plan.from_held.shape
        self._sizes = np.abs(plan.from_reference).reshape(count, -1, nr).sum(axis=1)
        self._first = np.ascontiguousarray(plan.from_reference[:nu])

    def find(
        self,
        known: Float[np.ndarray, " known"],
        aim: ReferenceShare,
        limits: StepBounds,
        given: Float[np.ndarray, " nv"] | None,
    ) -> tuple[Float[np.ndarray, " nu"], FirstInputPlan] | None:
        """Return the first input and the plan to be; None where the bound fails, or a target may have to be moved."""
        rows, plan, nu = aim.rows, self._plan, self._nu
        if len(rows) == 1 or not 0 <= aim.peak <= limits.reach:
            return None
        high, low = rows.max(axis=0), rows.min(axis=0)
        known = known.copy()
        middle = plan.M.dot(known)
        middle += plan.offset
        if given is not None:
            middle += given
        u = middle[:nu] + self._first.dot(rows.reshape(-1))
        middle += plan.from_held.dot((high + low) / 2)
        apart = self._sizes.dot((high - low) / 2)
        if not ((middle - apart >= limits.low).all() and (middle + apart <= limits.high).all()):  # NaN is not
            return None
        return u, FirstInputPlan(plan, known, rows, given, u)
