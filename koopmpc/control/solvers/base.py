"""The small interface of a QP solver: set up once, update limits, solve; every outcome has a Status."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
import scipy.sparse
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.move import Status
from koopmpc.errors import DataError, ShapeError

INFINITY = 1e30  # what OSQP and DAQP take for no limit
_BELOW_ROUNDING = 1e26  # ‖by‖² up to which 1e30 less an entry of it is 1e30


@dataclass(frozen=True)
class QP:
    """½ vᵀP v + qᵀv → min, low ≤ A v ≤ high; P ⪰ 0 dense, ±inf where there is no limit."""

    P: Float[np.ndarray, "n n"]
    q: Float[np.ndarray, " n"]
    A: Float[np.ndarray, "m n"]
    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]

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
    """Minimiser v, multipliers y of low ≤ A v ≤ high (positive at the upper end), and how the solve ended."""

    v: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " m"]
    status: Status
    iterations: int


@runtime_checkable
class QPSolver(Protocol):
    """A QP whose limits move from solve to solve, and P, q and A now and then. Copies go on from the last limits."""

    goes_on: bool
    """Whether a solve starts from where the last one ended, whatever its (v, y)."""

    def shift(self, by: Float[np.ndarray, " m"]) -> None:
        """Set the limits to those of the QP less `by`."""
        ...

    def set_bounds(self, low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"]) -> None:
        """Set new limits."""
        ...

    def update(self, qp: QP) -> None:
        """Go on with another QP of the same size."""
        ...

    def reset(self) -> None:
        """Forget what earlier solves left behind."""
        ...

    def solve(
        self, v: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"], time_limit: float | None = None
    ) -> QPSolution:
        """Solve from the warm start (v, y), within `time_limit` seconds: none by default, TIME_LIMIT if it is over."""
        ...


Setup: TypeAlias = Callable[[QP, Mapping[str, Any] | None], QPSolver]


class Bounds:
    """The limits of a QP of m rows, checked and cut to ±INFINITY, in arrays of their own."""

    def __init__(self, qp: QP) -> None:
        m = len(qp.low)
        self._qp = qp
        self._own = np.stack([np.maximum(qp.low, -INFINITY), np.minimum(qp.high, INFINITY)])
        self._ends = np.full(m, -INFINITY), np.full(m, INFINITY)
        self._now, self._spare = np.empty((2, m)), np.empty((2, m))
        self.low, self.high = self._now
        self._in_order = bytearray(m)  # a search in bytes is five times as fast as all()
        self._in_order_array = np.frombuffer(self._in_order, bool)
        self.set(qp.low, qp.high)

    def shift(self, by: Float[np.ndarray, " m"]) -> None:
        """Take the limits of the QP less `by`; the old ones stay where that is refused.

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
            self.set(self._qp.low - by, self._qp.high - by)

    def set(self, low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"]) -> None:
        """Take new limits, ±inf where there is none; the old ones stay where they are refused.

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
        np.maximum(low, self._ends[0], out=new_low)
        np.minimum(high, self._ends[1], out=new_high)
        np.less_equal(new_low, new_high, out=self._in_order_array)
        if 0 in self._in_order:
            raise DataError("the limits of the QP cross, hold NaN, or are beyond 1e30")
        self._now, self._spare = self._spare, self._now
        self.low, self.high = self._now


def check_start(qp: QP, v: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."]) -> None:
    """Raise where a warm start does not fit the QP."""
    if v.shape != qp.q.shape or y.shape != qp.low.shape:
        raise ShapeError(f"the warm start has shapes {v.shape} and {y.shape}, the QP is {qp.q.shape}, {qp.low.shape}")
