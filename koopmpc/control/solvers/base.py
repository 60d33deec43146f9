"""One QP in, one solution out: the record of a QP, and what all solvers share."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import scipy.sparse
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.limits import Softness
from koopmpc.control.move import Status
from koopmpc.errors import DataError, ShapeError

INFINITY = 1e30  # what OSQP and DAQP take for no limit
_BELOW_ROUNDING = 1e26  # ‖by‖² up to which 1e30 less an entry of it is 1e30


@dataclass(frozen=True)
class QP:
    """½ vᵀP v + qᵀv → min, low ≤ A v ≤ high; P ⪰ 0 dense, ±inf where there is no limit.

    Where there is a `softness`, a row whose linear price is finite may be broken by ε ≥ 0 at linear ε + quadratic ε².
    A solver that is not `exact` keeps such rows, too; its answer is that of the QP where no multiplier is above the
    linear price.
    """

    P: Float[np.ndarray, "n n"]
    q: Float[np.ndarray, " n"]
    A: Float[np.ndarray, "m n"]
    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]
    softness: Softness | None = None

    def __post_init__(self) -> None:
        for name in ("P", "q", "A"):
            checks.array(getattr(self, name), f"the QP's {name}")
        for name in ("low", "high"):
            checks.array(getattr(self, name), f"the QP's {name}", infinite=True)
        m, n = self.A.shape
        if self.P.shape != (n, n) or self.q.shape != (n,) or not self.low.shape == self.high.shape == (m,):
            raise ShapeError(
                f"the QP has A {self.A.shape}, P {self.P.shape}, q {self.q.shape}, low {self.low.shape} and"
                f" high {self.high.shape}; pass A (m, n), P (n, n), q (n,), low and high (m,)"
            )
        checks.crossed(self.low, self.high, "the QP's")

    def sparse(self) -> tuple[scipy.sparse.csc_matrix, scipy.sparse.csc_matrix]:
        """Return the upper triangle of P, and A, in compressed columns."""
        return scipy.sparse.csc_matrix(np.triu(self.P)), scipy.sparse.csc_matrix(self.A)


@dataclass(slots=True)
class QPSolution:
    """Minimiser v, multipliers y of low ≤ A v ≤ high (positive at the upper end), how the solve ended, and in whom."""

    v: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " m"]
    status: Status
    iterations: int
    solver: str


class QPSolver(ABC):
    """A QP set up once in a solver with its own `settings`: limits move from solve to solve, P, q and A now and then.

    Copies go on from the last limits. Limits are checked here, for solvers take what is short, strided or NaN.
    """

    name: ClassVar[str]
    exact: ClassVar[bool]
    """Whether it knows soft rows, and its INFEASIBLE is certain."""

    def __init__(self, qp: QP, settings: Mapping[str, Any] | None = None) -> None:
        self._settings = dict(settings or {})
        self._hold(qp)

    def _hold(self, qp: QP) -> None:
        """Make this the problem, its limits in arrays of their own, cut to ±INFINITY."""
        m = len(qp.low)
        self._qp = qp
        self._own = np.stack([np.maximum(qp.low, -INFINITY), np.minimum(qp.high, INFINITY)])
        self._now, self._spare = self._own.copy(), np.empty((2, m))
        self.low, self.high = self._now
        self._in_order = bytearray(m)  # a search in bytes is five times as fast as all()
        self._in_order_array = np.frombuffer(self._in_order, bool)

    def shift(self, by: Float[np.ndarray, " m"]) -> None:
        """Set the limits to those of the QP less `by`; the old ones stay where that is refused.

        Raises
        ------
        ShapeError
            `by` has the wrong length.
        DataError
            It holds NaN, or moves a limit beyond 1e30.
        """
        if by.shape != self.low.shape:
            raise ShapeError(f"the limits move by shape {by.shape}, the QP has {len(self.low)} rows")
        if by.dot(by) < _BELOW_ROUNDING:
            np.subtract(self._own, by, out=self._now)
        else:
            self.set_bounds(self._qp.low - by, self._qp.high - by)

    def set_bounds(self, low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"]) -> None:
        """Set new limits, ±inf where there is none; the old ones stay where they are refused.

        Raises
        ------
        ShapeError
            They have the wrong length.
        DataError
            They hold NaN or cross.
        """
        if low.shape != self.low.shape or high.shape != self.low.shape:
            raise ShapeError(f"the limits have shapes {low.shape} and {high.shape}, the QP has {len(self.low)} rows")
        new_low, new_high = self._spare
        np.maximum(low, -INFINITY, out=new_low)
        np.minimum(high, INFINITY, out=new_high)
        np.less_equal(new_low, new_high, out=self._in_order_array)
        if 0 in self._in_order:
            raise DataError("the limits of the QP cross, hold NaN, or are beyond 1e30")
        self._now, self._spare = self._spare, self._now
        self.low, self.high = self._now

    @abstractmethod
    def update(self, qp: QP) -> None:
        """Go on with another QP of the same size."""

    @abstractmethod
    def reset(self) -> None:
        """Forget what earlier solves left behind."""

    def solve(
        self, v: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"], time_limit: float | None = None
    ) -> QPSolution:
        """Solve from the warm start (v, y), within `time_limit` seconds: none by default, TIME_LIMIT if it is over."""
        if v.shape != self._qp.q.shape or y.shape != self.low.shape:
            shapes = f"{self._qp.q.shape}, {self.low.shape}"
            raise ShapeError(f"the warm start has shapes {v.shape} and {y.shape}, the QP is {shapes}")
        if time_limit is not None and not time_limit > 0:
            return QPSolution(v.copy(), y.copy(), Status.TIME_LIMIT, 0, self.name)
        return self._solve(v, y, time_limit)

    @abstractmethod
    def _solve(self, v: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"], time_limit: float | None) -> QPSolution:
        """Solve within the limits `low` and `high`."""
