"""FirstInput: of a long preview the first input alone, where a bound shows that its plan meets all limits."""

import numpy as np
from jaxtyping import Float

from koopmpc.control.plan.condensed_program import CondensedPlan, StepBounds, is_inside
from koopmpc.control.step.observe import ReferenceShare


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
        sizes = np.abs(plan.from_reference).reshape(count, -1, nr).sum(axis=1)
        # column by column, for a product with few columns takes half the time then; halves, for sums of two extremes
        self._M, self._half_held, self._half_sizes = (
            np.asfortranarray(part) for part in (plan.M, plan.from_held / 2, sizes / 2)
        )
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
        signals = rows.T.copy()  # the extremes of rows of a few numbers take three times as long
        high, low = signals.max(axis=1), signals.min(axis=1)
        known = known.copy()
        middle = self._M.dot(known)
        middle += plan.offset
        if given is not None:
            middle += given
        u = middle[:nu] + self._first.dot(rows.reshape(-1))
        middle += self._half_held.dot(high + low)
        apart = self._half_sizes.dot(high - low)
        if not is_inside(middle, limits.low + apart, limits.high - apart):
            return None
        return u, FirstInputPlan(plan, known, rows, given, u)
