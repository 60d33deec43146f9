"""ReferenceShare: what the rows of a reference add to a plan by one matrix; GivenInputs: what given inputs do."""

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike
from scipy.linalg.blas import idamax

from koopmpc.base import checks
from koopmpc.base.checks import HUGE, numbers
from koopmpc.base.values import Interval
from koopmpc.control.plan.bounds import PlanBounds
from koopmpc.control.plan.condensed_program import CondensedPlan
from koopmpc.control.target import Targets

_TABLE = 2**20  # entries of a table of GivenInputs: 8 MB


class ReferenceShare:
    """m(r) of a plan t = M known + m(r) for rows r_k … r_{k+N} of a reference; see `CondensedPlan`.

    It is kept while reference, plan and limits stay.

    Parameters
    ----------
    targets
        The equilibria that rows aim at.
    N, nr, latency
        Steps of a plan, entries of a row, and the row that belongs to the plan's start.

    Attributes
    ----------
    rows, peak
        The rows of the last call, one where it is held; the largest |r|, −inf where it is beyond 1e30.
    """

    def __init__(self, targets: Targets, N: int, nr: int, latency: int) -> None:
        self._targets, self._N, self._nr, self._latency = targets, N, nr, latency
        self.reset()

    def reset(self) -> None:
        """Forget the reference."""
        self._key: bytes | None = None
        self._plan: CondensedPlan | None = None
        self._pushed_at: tuple[PlanBounds, int] | None = None

    def take(self, reference: ArrayLike) -> bool:
        """Take the rows of a reference; return whether they are other ones than those of the last call."""
        given = numbers(reference, "reference")
        key = given.tobytes()
        if key == self._key:
            return False
        self._key = None  # one that is refused leaves no rows of the last one
        if given.shape == (self._nr,):
            self.rows = np.frombuffer(key).reshape(1, -1)
        elif self._latency or given.shape != (self._N + 1, self._nr):
            self.rows = checks.reference_rows(given, self._N, self._nr, self._latency)
        else:
            self.rows = np.frombuffer(key).reshape(given.shape)
        flat = self.rows.reshape(-1)
        peak = abs(flat.item(idamax(flat)))  # idamax passes over NaN, which gives a plan of NaN: it meets no limit
        self.peak = peak if peak < HUGE else -np.inf
        self._key, self._plan = key, None
        return True

    def at(self, plan: CondensedPlan, bounds: PlanBounds, k: int, reach: float) -> Float[np.ndarray, " nt"]:
        """Return m(r) under the limits of step k, which move no target for |r| ≤ reach."""
        if plan is not self._plan:
            self._share, self._plan, self._pushed_at = self._add_rows(plan), plan, None
        if self.peak <= reach:
            return self._share
        if self._pushed_at is None or self._pushed_at[0] is not bounds or self._pushed_at[1] != bounds.place(k):
            self._pushed, self._pushed_at = self._push(plan, bounds.targets(k)), (bounds, bounds.place(k))
        return self._pushed

    def _add_rows(self, plan: CondensedPlan) -> Float[np.ndarray, " nt"]:
        """Return m(r) as if no limit moved a target; NaN where a row is not finite."""
        rows = self.rows
        if self.peak < 0:
            return np.full(len(plan.M), np.nan)
        matrix = plan.from_held if len(rows) == 1 else plan.from_reference
        share = matrix.dot(rows.reshape(-1))
        share += plan.offset
        if len(share) == len(plan.M):
            return share
        values = (self._targets.nearest(rows) @ self._targets.rows.T)[:, plan.checked]
        return np.concatenate([share, values.min(axis=0), values.max(axis=0)])

    def _push(self, plan: CondensedPlan, box: Interval | None) -> Float[np.ndarray, " nt"]:
        """Return m(r) with targets moved inside their limits."""
        moved = self.find_push(None, box)
        return self._share if moved is None else self._share + plan.from_target.dot(moved)

    def find_push(self, e: Float[np.ndarray, " nz"] | None, box: Interval | None) -> Float[np.ndarray, " n"] | None:
        """Return by how much limits move the coordinates of all targets under a disturbance e; None by nothing."""
        rows = np.repeat(self.rows, self._N + 1, axis=0) if len(self.rows) == 1 else self.rows
        nearest = self._targets.nearest(rows, e)
        moved = self._targets.coordinates(rows, e, box)
        return None if np.array_equal(moved, nearest) else (moved - nearest).reshape(-1)


class GivenInputs:
    """What the rows of a given u_target add to a plan, F (u_k, …, u_{k+N}), in step after step.

    Parameters
    ----------
    from_given
        F.
    rows
        The rows of u_target; the last one is held.
    tabled
        Whether steps to come will read the same F.
    """

    def __init__(
        self, from_given: Float[np.ndarray, "nv Nnu"], rows: Float[np.ndarray, "T nu"], *, tabled: bool = True
    ) -> None:
        self._N, self._last, self._from_given = from_given.shape[1] // rows.shape[1], len(rows) - 1, from_given
        self._rows = np.vstack([rows, np.tile(rows[-1], (self._N - 1, 1))])
        self._table: Float[np.ndarray, "T nv"] | None = None
        if tabled and len(rows) * len(from_given) <= _TABLE:
            windows = sliding_window_view(self._rows, self._N, axis=0).transpose(0, 2, 1)
            self._table = windows.reshape(len(rows), -1) @ from_given.T

    def at(self, k: int) -> Float[np.ndarray, " nv"]:
        """Return the share of the preview that begins with row k."""
        k = min(k, self._last)
        if self._table is not None:
            return self._table[k]
        return self._from_given @ self._rows[k : k + self._N].reshape(-1)
