"""A terminal ellipsoid by tangent cuts: a plan that leaves it is cut off by a half space that holds all of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import cholesky, solve_triangular

from koopmpc.control.limits import SOFTENED, Interval, Softness
from koopmpc.control.move import Status
from koopmpc.control.solvers import FINISHER
from koopmpc.control.solvers.base import QP, QPSolution, SolverTurn, StepQP, StepSolver
from koopmpc.control.solvers.daqp import DAQP

MET = 1e-8  # the ellipsoid is met if the norm exceeds 1 by at most this much
NEAR = 1e-6  # from here on the half spaces move inwards by what the solver's tolerance leaves
MOST = 40  # cuts of a step; beyond that the step ends with MAX_ITERATIONS
_BOUNDED = 1e-9  # a singular value below this share of the largest moves nothing
_NEWTON = 60  # steps of the secular equation, at most


@dataclass(frozen=True)
class Ball:
    """y = y_0 + D w has to stay in the unit ball; y_0 are the entries `rows` of a plan.

    `linear` and `quadratic` are the prices of leaving it, as a QP of w counts; linear = inf is a hard ball. A plan
    whose entries are all below `inner` is in it.
    """

    rows: slice
    D: Float[np.ndarray, "p nw"]
    linear: float
    quadratic: float
    inner: float


def make_ball(softness: Softness, D: Float[np.ndarray, "nv nw"], unit: float, first: int) -> Ball:
    """Return the ball of the last entries of a plan that moves by D w, from entry `first` on."""
    rows = slice(first, len(D))
    linear, quadratic = float(softness.linear[0]), float(softness.quadratic[0])
    return Ball(rows, D[rows], linear / (2 * unit), quadratic / (2 * unit), 1 / np.sqrt(len(D) - first))


class BallSolver(StepSolver):
    """The QP of a step whose plan also has to end in a ball; see `StepSolver`.

    Where the solution of the QP leaves the ball, half spaces aᵀy ≤ 1 join it until ‖y‖ ≤ 1 + 1e-8. Each is tangent to
    the ball at the point where it would meet the solution with the same active rows, or else at y/‖y‖. Those that are
    active at the end are the first ones of the next step.
    """

    def __init__(self, qp: StepQP, turns: Sequence[SolverTurn], ball: Ball) -> None:
        super().__init__(qp, turns)
        self._set_ball(ball)

    def _set_ball(self, ball: Ball) -> None:
        """Set up the QP with room for cuts."""
        self.ball, qp, n = ball, self.qp, MOST
        self._size = float(np.sqrt((ball.D**2).sum(axis=1).max(initial=0.0))) or 1.0  # of a row aᵀD
        free = np.full(n, np.inf)
        s = self._size
        soft = Softness(
            np.concatenate([qp.softness.linear, np.full(n, ball.linear * s)]),
            np.concatenate([qp.softness.quadratic, np.full(n, ball.quadratic * s**2)]),
            np.concatenate([qp.softness.allowance, np.full(n, SOFTENED)]),
        )
        whole = QP(
            qp.P,
            qp.q,
            np.vstack([qp.A, np.zeros((n, qp.A.shape[1]))]),
            np.concatenate([qp.low, -free]),
            np.concatenate([qp.high, free]),
            soft,
        )
        self._cutter: DAQP = FINISHER(whole)
        self._root = cholesky(qp.P, lower=True)
        self._forget_cuts()

    def _forget_cuts(self) -> None:
        self._cuts = np.zeros((MOST, len(self.ball.D)))
        self._used = np.zeros(MOST, dtype=np.bool_)
        self._pushes: Float[np.ndarray, " n"] = np.zeros(MOST)

    def change(self, qp: StepQP, ball: Ball) -> None:
        """Go on with new matrices of the same size; the warm start is kept, and no cut."""
        self.update(qp)
        self._set_ball(ball)

    def rest(self) -> None:
        """Forget the last answer and its cuts."""
        super().rest()
        self._used[:] = False
        self._pushes = np.zeros(MOST)

    def reset(self) -> None:
        """Forget all earlier solves, so that a run repeats to the bit."""
        super().reset()
        self._cutter.reset()

    def contains(self, plan: Float[np.ndarray, " nv"]) -> bool:
        """Return whether a plan ends in the ball."""
        y = plan[self.ball.rows]
        return bool(y.dot(y) <= 1.0)

    def solve(
        self,
        plan: Float[np.ndarray, " nv"],
        room: Interval | None,
        deadline: float | None,
        bounds: Interval | None = None,
    ) -> tuple[QPSolution, float]:
        """Return the least deviation w from the plan that ends in the ball; see `StepSolver.solve`."""
        if self._used.any():
            found, gave_way = QPSolution(np.zeros(len(self.qp.q)), np.zeros(len(self.qp.A)), Status.OPTIMAL, 0, ""), 0.0
        else:
            found, gave_way = super().solve(plan, room, deadline, bounds)
            if found.status is not Status.OPTIMAL:
                return found, gave_way
            y = plan[self.ball.rows] + self.ball.D @ found.v
            if np.linalg.norm(y) <= 1 + MET:
                return found, gave_way
            self._add_cut(y, found)
        return self._cut(plan, room, deadline, found, bounds)

    def _cut(
        self,
        plan: Float[np.ndarray, " nv"],
        room: Interval | None,
        deadline: float | None,
        found: QPSolution,
        bounds: Interval | None,
    ) -> tuple[QPSolution, float]:
        """Solve with the cuts, and add one after the other, until the plan ends in the ball."""
        qp, ball, solver, m = self.qp, self.ball, self._cutter, len(self.qp.A)
        moved, limits, conflict = np.multiply(plan[self._rows], qp.scale), bounds, 0.0
        if room is not None:
            limits, conflict = self._widen_rates(room, bounds or Interval(qp.low, qp.high))
        low, high = (qp.low, qp.high) if limits is None else limits
        y_0, iterations, last = plan[ball.rows], found.iterations, self._last
        v, rows, tighter = found.v, found.y, 0.0
        if self._used.any() and last is not None:
            v, rows = np.append(last.v, 0.0)[qp.shift_primal], np.append(last.y, 0.0)[qp.shift_dual]
        for _ in range(MOST):
            left = None if deadline is None else deadline - perf_counter()
            if left is not None and left <= 0:
                found = replace(found, status=Status.TIME_LIMIT, iterations=iterations)
                break
            ends = np.where(self._used, (1 - tighter - self._cuts @ y_0) / self._size, np.inf)
            solver.set_bounds(
                np.concatenate([low - moved, np.full(MOST, -np.inf)]), np.concatenate([high - moved, ends])
            )
            whole = solver.solve(v, np.concatenate([rows, self._pushes]), left)
            iterations += whole.iterations
            v, rows, self._pushes = whole.v, whole.y[:m], whole.y[m:].copy()
            found = QPSolution(v, rows, whole.status, iterations, whole.solver)
            if whole.status is not Status.OPTIMAL:
                break
            y = y_0 + ball.D @ v
            past = float(np.linalg.norm(y)) - 1
            given = float((self._cuts[self._used] @ y).max(initial=-np.inf)) - 1  # what soft cuts gave way
            if past <= MET or (np.isfinite(ball.linear) and given >= past - MET):
                self._last = found
                self._used &= self._pushes > 0
                slack = past if past > SOFTENED else 0.0
                return found, max(conflict, slack, self._gave_way(found, moved, limits))
            if past < NEAR:  # the solver meets a row to its own tolerance, which is that of w
                tighter += past
            if not self._add_cut(y, found):
                break
        if found.status is Status.OPTIMAL:
            found = replace(found, status=Status.MAX_ITERATIONS)
        self._last = None
        self._forget_cuts()
        return found, conflict

    def _add_cut(self, y: Float[np.ndarray, " p"], found: QPSolution) -> bool:
        """Add the half space that cuts y off; return False where there is no room for another one."""
        free = np.flatnonzero(~self._used)
        if not len(free):
            free = np.flatnonzero(self._pushes <= 0)
            if not len(free):
                return False
        normal = self._touch(y, found)
        if normal is None or normal @ y <= 1 + MET:
            normal = y / np.linalg.norm(y)
        i = int(free[0])
        self._cuts[i], self._used[i], self._pushes[i] = normal, True, 0.0
        self._cutter.exchange_row(len(self.qp.A) + i, normal @ self.ball.D / self._size)
        return True

    def _touch(self, y: Float[np.ndarray, " p"], found: QPSolution) -> Float[np.ndarray, " p"] | None:
        """Return the point of the ball where the QP has its solution if its active rows stay as they are, or None.

        On the active rows w = w_p + Z q, and y = b + M q. In the left singular vectors of M the solution is
        ŷ_i = b̂_i / (1 + λ s_i²), where λ solves ‖y‖ = 1.
        """
        active: Bool[np.ndarray, " m"] = found.y != 0
        back = solve_triangular(self._root, np.eye(len(self._root)), lower=True).T  # w = back q with ‖q‖² = wᵀP w
        D, q = self.ball.D @ back, self._root.T @ found.v
        if active.any():
            rows = (self.qp.A[active] @ back).T
            basis, R = np.linalg.qr(rows)
            if len(R) < rows.shape[1] or np.abs(np.diag(R)).min() < _BOUNDED * np.abs(R).max():
                return None
            fixed = basis @ (basis.T @ q)
            M = D - (D @ basis) @ basis.T
        else:
            fixed, M = np.zeros_like(q), D
        b = y + D @ (fixed - q)  # where w is as near to the plan as the active rows let it be
        left, s, _ = np.linalg.svd(M, full_matrices=True)
        squares = np.zeros(len(b))
        squares[: len(s)] = np.where(s > _BOUNDED * max(float(s[0]), 1e-300), s**2, 0.0)
        parts = left.T @ b
        if np.linalg.norm(parts[squares == 0]) >= 1:
            return None
        lam = 0.0
        for _ in range(_NEWTON):  # 1/‖y‖ is nearly linear in λ: Newton's method from the left never oversteps
            shrunk = parts / (1 + lam * squares)
            size = float(np.linalg.norm(shrunk))
            if size <= 1 + 1e-14:
                break
            slope = float((shrunk**2 * squares / (1 + lam * squares)).sum()) / size**3
            lam += (1 - 1 / size) / slope
        point = left @ (parts / (1 + lam * squares))
        return point / np.linalg.norm(point)
