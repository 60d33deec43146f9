# pyright: basic, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
"""OSQP behind our interface: the one file that imports it, checks what it accepts, and maps every status.

OSQP 1.1 accepts short, strided and NaN vectors and crossed limits, and returns finite nonsense for an infeasible
problem. If a solve runs out of iterations after one that succeeded, and no limit moved in between, OSQP still says
"solved". This file checks for all of these. Some of its certificates of infeasibility are rounding: a step asks DAQP
before it believes one. Updates and solves go to the extension object of OSQP: its Python wrapper would spend 15 µs on
copies of the problem.

Stellato et al., "OSQP: an operator splitting solver for quadratic programs", Math. Prog. Comp. 12, 2020.
"""

import signal
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, ClassVar

import numpy as np
import scipy.sparse
from jaxtyping import Float

from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import call_uninterrupted
from koopmpc.control.ask.limits import Interval
from koopmpc.control.move import Status
from koopmpc.control.solvers.base import QP, QPSolution, QPSolver

# sigma: plans of an unstable plant that saturate for many steps take half the iterations that OSQP's 1e-6 needs.
# eps_prim_inf: with OSQP's 1e-4, 5 % of feasible degenerate problems are called infeasible, and 18 % of badly scaled
# ones; with 1e-7 none of the first and 0.6 % of the second.
# eps_dual_inf: with OSQP's 1e-4, some badly scaled problems are called unbounded.
DEFAULTS: Mapping[str, Any] = {
    "eps_abs": 1e-5,
    "eps_rel": 1e-5,
    "sigma": 1e-4,
    "max_iter": 4000,
    "check_termination": 5,
    "eps_prim_inf": 1e-7,
    "eps_dual_inf": 1e-6,
}

_NO_LIMIT = 1e9  # seconds; OSQP's own default is above it


@cache
def _statuses() -> dict[int, Status]:
    """Return what OSQP's codes mean; any other is FAILED."""
    import osqp  # takes 30 ms, so it is imported when the first QP is set up

    codes = osqp.SolverStatus
    return {
        int(codes.OSQP_SOLVED): Status.OPTIMAL,
        int(codes.OSQP_SOLVED_INACCURATE): Status.MAX_ITERATIONS,
        int(codes.OSQP_MAX_ITER_REACHED): Status.MAX_ITERATIONS,
        int(codes.OSQP_TIME_LIMIT_REACHED): Status.TIME_LIMIT,
        int(codes.OSQP_PRIMAL_INFEASIBLE): Status.INFEASIBLE,
        int(codes.OSQP_PRIMAL_INFEASIBLE_INACCURATE): Status.INFEASIBLE,
    }


class Pattern:
    """Where a matrix in compressed columns has entries."""

    def __init__(self, matrix: scipy.sparse.csc_matrix) -> None:
        self._shape = matrix.shape
        columns = np.repeat(np.arange(matrix.shape[1]), np.diff(matrix.indptr))
        self._places = matrix.indices.astype(np.intp) * matrix.shape[1] + columns

    def entries(self, matrix: Float[np.ndarray, "m n"]) -> Float[np.ndarray, " k"] | None:
        """Return the entries of another matrix in the same order; None where its zeros stand elsewhere."""
        if matrix.shape != self._shape:
            return None
        entries = matrix.ravel()[self._places]
        return entries if entries.all() and np.count_nonzero(matrix) == len(entries) else None


class OSQP(QPSolver):
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

    name = "osqp"
    exact = False
    # On random closed loops, a solve that has not converged in so many iterations rarely converges soon.
    impatient: ClassVar[Mapping[str, Any]] = {"max_iter": 100}
    coordinates = "auto"

    @staticmethod
    def setting_names() -> frozenset[str]:
        """Return the names of OSQP's settings."""
        from osqp import ext_builtin

        return frozenset(name for name in dir(ext_builtin.OSQPSettings) if not name.startswith("_"))

    def _setup(self) -> None:
        import osqp

        qp = self._qp
        P, A = scipy.sparse.csc_matrix(np.triu(qp.P)), scipy.sparse.csc_matrix(qp.A)
        self._patterns = Pattern(P), Pattern(A)
        self._problem, self._status = osqp.OSQP(), _statuses()
        options = {"verbose": False, **DEFAULTS, **self._settings}
        try:
            self._problem.setup(P, qp.q, A, self.low, self.high, **options)
        except (osqp.OSQPException, TypeError, ValueError, AttributeError) as error:
            raise DataError(f"OSQP refuses the problem or its settings {self._settings}: {error}") from error
        self._solver = self._problem._solver
        self._rho = self._solver.get_settings().rho
        self._time_limit = self._solver.get_settings().time_limit
        self._most = self._solver.get_settings().max_iter
        self._first = True

    def __reduce__(self) -> tuple[type["OSQP"], tuple[QP, dict[str, Any]], tuple[Interval, float]]:
        limits = Interval(self.low, self.high)
        rho = self._rho if self._stale else self._solver.get_settings().rho
        return type(self), (self._qp, self._settings), (limits, rho)

    def __setstate__(self, state: tuple[Interval, float]) -> None:
        """Take over the limits, and the step size ρ that the original had adapted: a copy has the same iterates."""
        limits, rho = state
        self.set_bounds(*limits)
        self._solver.update_rho(rho)

    def update(self, qp: QP) -> None:
        """Go on with another QP of the same size; if its zeros are in other places, the solver is set up again.

        Raises
        ------
        DataError
            OSQP refuses the problem.
        """
        P, A = (pattern.entries(matrix) for pattern, matrix in zip(self._patterns, (np.triu(qp.P), qp.A), strict=True))
        if P is None or A is None:
            super().update(qp)
            return
        self._hold(qp)
        if self._solver.update_data_mat(P_x=P, P_i=None, A_x=A, A_i=None):
            raise DataError("OSQP refuses the new matrices; pass a convex QP, P ⪰ 0")
        self._solver.update_data_vec(q=qp.q, l=self.low, u=self.high)  # last: new matrices would scale q once more

    def _forget(self) -> None:
        """Forget the step size ρ that earlier solves adapted: the same problem then has the same iterates."""
        self._solver.update_rho(self._rho)

    def _solve(self, v: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"], time_limit: float | None) -> QPSolution:
        """Return what OSQP says from this start; new data also make it forget its last status."""
        self._solver.update_data_vec(q=None, l=self.low, u=self.high)
        self._allow(self._time_limit if time_limit is None else time_limit)
        self._solver.warm_start(np.ascontiguousarray(v), np.ascontiguousarray(y))
        _solve_uninterrupted(self._solver.solve)
        info, solution = self._solver.info, self._solver.solution
        status = self._status.get(int(info.status_val), Status.FAILED)
        if status is Status.MAX_ITERATIONS and info.iter < self._most:  # nearly solved when its time was over
            status = Status.TIME_LIMIT
        return QPSolution(np.array(solution.x), np.array(solution.y), status, int(info.iter), self.name)

    def _allow(self, seconds: float) -> None:
        """Set the time limit of the next solve: OSQP counts the setup, or the last updates, as a part of it."""
        options, info = self._solver.get_settings(), self._solver.info
        if seconds < _NO_LIMIT:
            seconds += info.setup_time if self._first else info.update_time
        self._first = False
        if seconds != options.time_limit:
            options.time_limit = seconds
            self._solver.update_settings(options)


@cache
def _load_interrupt_flag() -> Callable[[], int]:
    """Return OSQP's own function that says whether a SIGINT came during the last solve."""
    from ctypes import CDLL

    from osqp import ext_builtin

    return getattr(CDLL(ext_builtin.__file__), "osqp_is_interrupted", lambda: 0)  # Windows exports no such name


def _solve_uninterrupted(solve: Callable[[], object]) -> None:
    """Solve while SIGINT waits.

    OSQP takes the signal for itself. In a program with threads another thread may still receive it; OSQP then ends
    with a status that says so, or forgets it in its last iteration. It is therefore sent once more.
    """
    call_uninterrupted(solve)
    if _load_interrupt_flag()():
        signal.raise_signal(signal.SIGINT)
