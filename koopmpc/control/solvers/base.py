"""The small interface of a QP solver: set up once, update vectors, solve; every outcome has a Status."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import scipy.sparse
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.move import Status
from koopmpc.errors import ShapeError


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
    """A QP whose P, q and A stay and whose limits move."""

    def update(self, low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"]) -> None:
        """Set new limits."""
        ...

    def reset(self) -> None:
        """Forget what earlier solves left behind."""
        ...

    def solve(self, v: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"]) -> QPSolution:
        """Solve from the warm start (v, y)."""
        ...
