# pyright: basic, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
"""OSQP behind our interface: the one file that imports it, checks what it accepts, and maps every status.

OSQP 1.1 takes short, strided and NaN vectors and crossed limits without raising, and returns finite nonsense for
an infeasible problem. Nothing of that passes here. Updates and solves go to its extension object, which spares
the 15 µs that its Python wrapper spends on copies of the problem.

Stellato et al., "OSQP: an operator splitting solver for quadratic programs", Math. Prog. Comp. 12, 2020.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import osqp
from jaxtyping import Float

from koopmpc.control.move import Status
from koopmpc.control.solvers.base import QP, QPSolution
from koopmpc.errors import DataError, ShapeError

# sigma: on plans of an unstable plant that saturate for many steps, half the iterations of OSQP's own 1e-6.
DEFAULTS: Mapping[str, Any] = {
    "eps_abs": 1e-5,
    "eps_rel": 1e-5,
    "sigma": 1e-4,
    "max_iter": 4000,
    "check_termination": 5,
}
_INFINITY = 1e30

_codes = osqp.SolverStatus
_STATUS = {
    int(_codes.OSQP_SOLVED): Status.OPTIMAL,
    int(_codes.OSQP_SOLVED_INACCURATE): Status.MAX_ITERATIONS,
    int(_codes.OSQP_MAX_ITER_REACHED): Status.MAX_ITERATIONS,
    int(_codes.OSQP_TIME_LIMIT_REACHED): Status.TIME_LIMIT,
    int(_codes.OSQP_PRIMAL_INFEASIBLE): Status.INFEASIBLE,
    int(_codes.OSQP_PRIMAL_INFEASIBLE_INACCURATE): Status.INFEASIBLE,
}


class OSQP:
    """A QP set up once in OSQP; limits move, solves start warm.

    Parameters
    ----------
    qp
        The problem.
    settings
        OSQP's own settings, for example ``{"eps_abs": 1e-9, "eps_rel": 1e-9}``; they override `DEFAULTS`.

    Raises
    ------
    DataError
        OSQP refuses the problem or a setting.
    """

    def __init__(self, qp: QP, settings: Mapping[str, Any] | None = None) -> None:
        P, A = qp.sparse()
        self._m, self._n = A.shape
        self._problem = osqp.OSQP()
        options = {"verbose": False, **DEFAULTS, **(settings or {})}
        try:
            self._problem.setup(P, qp.q, A, _finite(qp.low), _finite(qp.high), **options)
        except (osqp.OSQPException, TypeError, ValueError, AttributeError) as error:
            raise DataError(
                f"OSQP refuses the problem or its settings {dict(settings or {})}: {error}"
            ) from error
        self._solver = self._problem._solver
        self._rho = self._solver.get_settings().rho
        self._low, self._high = np.empty(self._m), np.empty(self._m)

    def reset(self) -> None:
        """Forget the step size ρ that earlier solves adapted: the same problem then has the same iterates."""
        self._solver.update_rho(self._rho)

    def update(self, low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"]) -> None:
        """Set new limits; ±inf where there is none.

        Raises
        ------
        ShapeError
            They have the wrong length.
        DataError
            They hold NaN or cross.
        """
        if low.shape != (self._m,) or high.shape != (self._m,):
            raise ShapeError(
                f"the limits have shapes {low.shape} and {high.shape}, the QP has {self._m} rows"
            )
        np.maximum(low, -_INFINITY, out=self._low)
        np.minimum(high, _INFINITY, out=self._high)
        if not (self._low <= self._high).all():
            raise DataError("the limits of the QP cross, hold NaN, or are beyond 1e30")
        self._solver.update_data_vec(q=None, l=self._low, u=self._high)

    def solve(self, v: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"]) -> QPSolution:
        """Solve from the warm start (v, y)."""
        if v.shape != (self._n,) or y.shape != (self._m,):
            raise ShapeError(
                f"the warm start has shapes {v.shape} and {y.shape}, the QP is ({self._n},), ({self._m},)"
            )
        self._solver.warm_start(np.ascontiguousarray(v), np.ascontiguousarray(y))
        self._solver.solve()
        info, solution = self._solver.info, self._solver.solution
        status = _STATUS.get(int(info.status_val), Status.FAILED)
        return QPSolution(np.array(solution.x), np.array(solution.y), status, int(info.iter))


def _finite(limit: Float[np.ndarray, " m"]) -> Float[np.ndarray, " m"]:
    return np.clip(limit, -_INFINITY, _INFINITY)
