# pyright: basic
"""Whether any v satisfies low ≤ A v ≤ high, by linear programming: exact where a first-order method only creeps."""

from functools import cache

import numpy as np
from jaxtyping import Float

_FAR = 1e20  # limits beyond it are none
_INFEASIBLE = 2  # status of SciPy's linprog


def empty(A: Float[np.ndarray, "m n"], low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"]) -> bool:
    """Return whether the simplex method finds that no v satisfies low ≤ A v ≤ high; some 20 ms at 50 × 150.

    It is the HiGHS of SciPy: that of CasADi crashes in a process that has imported CVXPY.

    References
    ----------
    Huangfu & Hall, "Parallelizing the dual revised simplex method", Math. Program. Comput. 10, 2018 (HiGHS).
    """
    from scipy.optimize import linprog

    below, above = low > -_FAR, high < _FAR
    found = linprog(
        np.zeros(A.shape[1]),
        A_ub=np.vstack([A[above], -A[below]]),
        b_ub=np.concatenate([high[above], -low[below]]),
        bounds=(None, None),
        method="highs",
    )
    return found.status == _INFEASIBLE


@cache
def prepare() -> None:
    """Load what `empty` needs, 0.1 s once in a process, before a loop begins."""
    empty(np.ones((1, 1)), np.zeros(1), np.ones(1))
