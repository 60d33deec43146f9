# pyright: basic, reportArgumentType=false
"""PIQP behind our interface: the one file that imports it. An interior-point method on the stages of a QP.

The stages stay sparse, so that its time grows with their number, and hardly with that of active rows. A solve starts
from nothing, and does not stop at a time limit.

Schwan, Jiang, Kuhn & Jones, "PIQP: a proximal interior-point quadratic programming solver", CDC 2023.
"""

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np
import scipy.sparse
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import call_uninterrupted
from koopmpc.control.ask.limits import Interval
from koopmpc.control.move import Status
from koopmpc.control.solvers.base import INFINITY, QP, QPSolution, QPSolver, StepQP

DEFAULTS: Mapping[str, Any] = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 60}
_PUSHES = 1e-7  # multipliers below this share of the largest are those of rows that do not push


def has_piqp() -> bool:
    """Return whether PIQP is installed: it comes with an extra."""
    return find_spec("piqp") is not None


class PIQP(QPSolver):
    """A QP with stages, set up once in PIQP; limits move.

    Parameters
    ----------
    qp
        The problem; one without stages is solved as it is.
    settings
        PIQP's own settings, for example ``{"eps_abs": 1e-6}``; they override `DEFAULTS`.

    Raises
    ------
    DataError
        PIQP is not installed, or refuses a setting: one that is no positive number.
    """

    name = "piqp"
    exact = False
    _STATUS: ClassVar[Mapping[str, Status]] = {
        "PIQP_SOLVED": Status.OPTIMAL,
        "PIQP_MAX_ITER_REACHED": Status.MAX_ITERATIONS,
        "PIQP_PRIMAL_INFEASIBLE": Status.INFEASIBLE,
    }

    @staticmethod
    def setting_names() -> frozenset[str]:
        """Return the names of PIQP's settings that are passed on."""
        return frozenset(("eps_abs", "eps_rel", "max_iter", "rho_init", "delta_init", "tau", "reg_lower_limit"))

    def _setup(self) -> None:
        if not has_piqp():
            raise DataError(
                'solver is "piqp", which is not installed; run pip install "koopmpc[piqp]", or take solver="auto"'
            )
        import piqp

        unknown = set(self._settings) - self.setting_names()
        if unknown:
            raise DataError(f"PIQP has no setting {min(unknown)!r}; it has {', '.join(sorted(self.setting_names()))}")
        qp = self._qp
        self._stages = qp.stages if isinstance(qp, StepQP) else None
        if isinstance(qp, StepQP) and qp.stages is not None:
            P, rows = qp.stages.cost(), qp.stages.limits(qp.source, qp.scale).tocsr()
            dynamics, cost = qp.stages.dynamics(), np.zeros(P.shape[0])
        else:
            P, rows, dynamics, cost = scipy.sparse.csc_matrix(qp.P), scipy.sparse.csr_matrix(qp.A), None, qp.q
        self._split(rows)
        self._solver = piqp.SparseSolver()
        options = self._solver.settings
        if self._stages is not None:
            options.kkt_solver = piqp.KKTSolver.sparse_multistage
        for name, value in {**DEFAULTS, **self._settings}.items():
            checks.positive(value, f"PIQP's setting {name}")
            setattr(options, name, int(value) if name == "max_iter" else float(value))
        equal = {} if dynamics is None else {"A": dynamics, "b": np.zeros(dynamics.shape[0])}
        G = rows[self._others].tocsc()
        call_uninterrupted(lambda: self._solver.setup(P, cost, **equal, G=G, **self._bounds(len(cost))))

    def _split(self, rows: scipy.sparse.csr_matrix) -> None:
        """Find the rows that limit one variable: bounds take less time than rows."""
        single = np.flatnonzero(np.diff(rows.indptr) == 1)
        places, first = np.unique(rows.indices[rows.indptr[single]], return_index=True)
        self._single, self._places = single[first], places
        self._factor = rows.data[rows.indptr[self._single]]
        self._others = np.setdiff1d(np.arange(rows.shape[0]), self._single)

    def _bounds(self, n: int) -> dict[str, Float[np.ndarray, " k"]]:
        """Return the present limits as bounds of the n variables and of the other rows."""
        ends = self.low[self._single] / self._factor, self.high[self._single] / self._factor
        box = np.array([[-INFINITY], [INFINITY]]) * np.ones(n)
        box[:, self._places] = np.minimum(*ends), np.maximum(*ends)
        return {"h_l": self.low[self._others], "h_u": self.high[self._others], "x_l": box[0], "x_u": box[1]}

    def __reduce__(self) -> tuple[type["PIQP"], tuple[QP, dict[str, Any]], Interval]:
        return type(self), (self._qp, self._settings), Interval(self.low, self.high)

    def __setstate__(self, limits: Interval) -> None:
        """Take over the limits that the original had."""
        self.set_bounds(*limits)

    def _forget(self) -> None:
        """Do nothing: a solve starts from nothing."""

    def _solve(self, v: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"], time_limit: float | None) -> QPSolution:
        solver = self._solver
        bounds = self._bounds(len(solver.result.x))
        call_uninterrupted(lambda: (solver.update(**bounds), solver.solve()))
        result = solver.result
        x, iterations, push = np.array(result.x), int(result.info.iter), np.zeros(len(y))
        push[self._single] = (result.z_bu - result.z_bl)[self._places] / self._factor
        push[self._others] = result.z_u - result.z_l
        status = self._STATUS.get(result.info.status.name, Status.FAILED)
        if status is not Status.OPTIMAL or not (np.isfinite(x).all() and np.isfinite(push).all()):
            failed = Status.FAILED if status is Status.OPTIMAL else status
            return QPSolution(v.copy(), np.zeros_like(y), failed, iterations, self.name)
        push = np.where(np.abs(push) > _PUSHES * np.abs(push).max(initial=0.0), push, 0.0)
        x = x if self._stages is None else self._stages.condense(x)
        return QPSolution(x, push, status, iterations, self.name)
