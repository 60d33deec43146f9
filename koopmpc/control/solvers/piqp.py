# pyright: basic
"""PIQP behind our interface, as CasADi ships it: an interior-point method on the stages of a QP, which stay sparse.

Its time grows with the number of stages, and hardly with that of active rows. A solve starts from nothing, and does
not stop at a time limit.

Schwan, Jiang, Kuhn & Jones, "PIQP: a proximal interior-point quadratic programming solver", CDC 2023.
"""

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.limits import Interval
from koopmpc.control.move import Status
from koopmpc.control.solvers.base import QP, QPSolution, QPSolver, StepQP
from koopmpc.errors import DataError
from koopmpc.interrupts import call_uninterrupted

DEFAULTS: Mapping[str, Any] = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 60}
_NO_LIMIT = 1e20  # bounds at least this large count as infinite
_PUSHES = 1e-7  # multipliers below this share of the largest are those of rows that do not push


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
        PIQP refuses a setting, or it is no positive number.
    """

    name = "piqp"
    exact = False

    @staticmethod
    def setting_names() -> frozenset[str]:
        """Return the names of PIQP's settings that are passed on."""
        names = ("eps_abs", "eps_rel", "max_iter", "rho_init", "delta_init", "tau", "reg_lower_limit")
        return frozenset(names)

    def _setup(self) -> None:
        qp = self._qp
        if isinstance(qp, StepQP) and (stages := qp.stages) is not None:
            P, rows, model = stages.cost(), stages.limits(qp.source, qp.scale), stages.dynamics()
            gradient = np.zeros(P.shape[0])
        else:
            stages, P, rows, model = None, qp.P, scipy.sparse.csc_matrix(qp.A), np.zeros((0, len(qp.q)))
            gradient = qp.q
        self._stages, self._count = stages, model.shape[0]
        self._split(rows.tocsr())
        rows = rows.tocsr()[self._others]
        A = ca.DM(scipy.sparse.vstack([scipy.sparse.csc_matrix(model), rows]).tocsc())
        H = ca.DM(scipy.sparse.csc_matrix(P))
        shape = {"h": H.sparsity(), "a": A.sparsity()}
        options = {"piqp": {**DEFAULTS, **self._settings}, "error_on_fail": False}
        unknown = set(self._settings) - self.setting_names()
        if unknown:
            raise DataError(f"PIQP has no setting {min(unknown)!r}; it has {', '.join(sorted(self.setting_names()))}")
        for name, value in self._settings.items():
            checks.positive(value, f"PIQP's setting {name}")
        try:
            self._solver = ca.conic("piqp", "piqp", shape, options)
        except (RuntimeError, NotImplementedError) as error:
            raise DataError(f"PIQP refuses the problem or its settings {self._settings}: {error}") from error
        (m, n), inf = A.shape, np.inf
        self._rows, self._bounds = np.zeros((2, m)), np.array([[-inf], [inf]]) * np.ones(n)
        self._found = {"x": np.zeros(n), "lam_a": np.zeros(m), "lam_x": np.zeros(n)}
        self._given = {
            "h": np.array(H.nonzeros()),
            "g": np.array(gradient, dtype=np.float64),
            "a": np.array(A.nonzeros()),
            **dict(zip(("lba", "uba", "lbx", "ubx"), (*self._rows, *self._bounds), strict=True)),
        }
        buffer: Any = self._solver.buffer()
        self._buffer, self._run = buffer
        for name, array in self._given.items():
            self._buffer.set_arg(self._solver.index_in(name), array.data)
        for name, array in self._found.items():
            self._buffer.set_res(self._solver.index_out(name), array.data)

    def _split(self, rows: scipy.sparse.csr_matrix) -> None:
        """Find the rows that limit one variable: bounds take less time than rows."""
        single = np.flatnonzero(np.diff(rows.indptr) == 1)
        places, first = np.unique(rows.indices[rows.indptr[single]], return_index=True)
        self._single, self._places = single[first], places
        self._factor = rows.data[rows.indptr[self._single]]
        self._others = np.setdiff1d(np.arange(rows.shape[0]), self._single)

    def __reduce__(self) -> tuple[type["PIQP"], tuple[QP, dict[str, Any]], Interval]:
        return type(self), (self._qp, self._settings), Interval(self.low, self.high)

    def __setstate__(self, limits: Interval) -> None:
        """Take over the limits that the original had."""
        self.set_bounds(*limits)

    def update(self, qp: QP) -> None:
        """Go on with another QP of the same size."""
        self.__init__(qp, self._settings)

    def _forget(self) -> None:
        """Do nothing: a solve starts from nothing."""

    def _solve(self, v: Float[np.ndarray, " n"], y: Float[np.ndarray, " m"], time_limit: float | None) -> QPSolution:
        low, high = (
            np.where(self.low > -_NO_LIMIT, self.low, -np.inf),
            np.where(self.high < _NO_LIMIT, self.high, np.inf),
        )
        single, others, count = self._single, self._others, self._count
        ends = low[single] / self._factor, high[single] / self._factor
        self._bounds[:, self._places] = np.minimum(*ends), np.maximum(*ends)
        self._rows[0, count:], self._rows[1, count:] = low[others], high[others]
        call_uninterrupted(self._run)
        x, push = self._found["x"].copy(), np.zeros(len(y))
        push[single] = self._found["lam_x"][self._places] / self._factor
        push[others] = self._found["lam_a"][count:]
        if not (self._buffer.stats()["success"] and np.isfinite(x).all() and np.isfinite(push).all()):
            return QPSolution(v.copy(), np.zeros_like(y), Status.FAILED, 0, self.name)
        push = np.where(np.abs(push) > _PUSHES * np.abs(push).max(initial=0.0), push, 0.0)
        if self._stages is not None:
            x = self._stages.condense(x)
        return QPSolution(x, push, Status.OPTIMAL, 1, self.name)  # CasADi tells no number of iterations
