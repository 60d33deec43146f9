"""OSQP and DAQP with every answer checked: stationarity, feasibility and the signs of the multipliers of each QP."""

from typing import ClassVar

import numpy as np

import koopmpc as km
from koopmpc.control.solvers.base import QP
from koopmpc.control.solvers.daqp import DAQP
from koopmpc.control.solvers.osqp import DEFAULTS, OSQP


class CheckedOSQP(OSQP):
    """Raises where an answer that is called optimal does not meet the KKT conditions to its own tolerance."""

    checked: ClassVar[int] = 0

    def __init__(self, qp, settings=None):
        super().__init__(qp, settings)
        self.qp = qp
        options = {**DEFAULTS, **(settings or {})}
        self.eps = options["eps_abs"], options["eps_rel"]

    def update(self, qp):
        super().update(qp)
        self.qp = qp

    def solve(self, v, y, time_limit=None):
        solution = super().solve(v, y, time_limit)
        if solution.status is km.Status.OPTIMAL:
            now = QP(self.qp.P, self.qp.q, self.qp.A, self.low, self.high)
            meets_kkt(now, solution, *self.eps)
            CheckedOSQP.checked += 1
        return solution


def meets_kkt(qp, solution, eps_abs, eps_rel):
    """Assert P v + q + Aᵀy = 0, low ≤ A v ≤ high, y ≥ 0 only at high and ≤ 0 only at low, as OSQP measures them."""
    v, y = solution.v, solution.y
    Av, Pv, Ay = qp.A @ v, qp.P @ v, qp.A.T @ y
    size = lambda *parts: max(float(np.abs(part).max(initial=0.0)) for part in parts)  # noqa: E731
    near = np.clip(Av, qp.low, qp.high)
    primal = 1.01 * (eps_abs + eps_rel * size(Av, near))
    assert size(Av - near) <= primal
    assert size(Pv + qp.q + Ay) <= 1.01 * (eps_abs + eps_rel * size(Pv, Ay, qp.q))
    pushed = np.abs(y) > 10 * (eps_abs + eps_rel * size(y))
    end = np.where(y > 0, qp.high, qp.low)
    assert (np.abs(Av - end)[pushed] <= 3 * primal + 1e-9).all()


class CheckedDAQP(DAQP):
    """The same of DAQP where all rows are hard; its answers are exact to about 1e-8 of the size of their parts."""

    checked: ClassVar[int] = 0

    def solve(self, v, y, time_limit=None):
        solution = super().solve(v, y, time_limit)
        qp = self._qp
        hard = qp.softness is None or np.isinf(qp.softness.linear).all()
        if hard and solution.status is km.Status.OPTIMAL:
            share = 2e-6 if self._is_steep else 1e-6  # the last proximal step may miss 1e-6, and the QP in it 1e-6 more
            meets_kkt(QP(qp.P, qp.q, qp.A, self.low, self.high), solution, 1e-7, share)
            CheckedDAQP.checked += 1
        return solution
