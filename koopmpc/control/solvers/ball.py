# pyright: basic, reportAttributeAccessIssue=false
"""A terminal ellipsoid: the QP of a step with one second-order cone, solved by Clarabel. The one file that imports it.

Goulart & Chen, "Clarabel: an interior-point solver for conic programs", arXiv:2405.12762, 2024.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np
import scipy.sparse
from jaxtyping import Float

from koopmpc.control.ask.limits import SOFTENED, Interval, Softness
from koopmpc.control.move import Status
from koopmpc.control.solvers.base import QPSolution, SolverTurn, StepQP, StepSolver, move_limits

_MET_SQUARE = (1 + 1e-8) ** 2  # a plan ends in the ball if ‖y‖² is at most this
_TOLERANCES = (1e-11, 1e-9, 1e-7)  # of Clarabel, relative: the next one is asked where it stops short of one
_PRICED = 1e-5  # a soft row gives way if its multiplier is nearer to its price than this share


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

    def contains(self, plan: Float[np.ndarray, " nv"]) -> bool:
        """Return whether a plan ends in the ball."""
        y = plan[self.rows]
        return bool(y.dot(y) <= 1.0)


def make_ball(softness: Softness, D: Float[np.ndarray, "nv nw"], unit: float, first: int) -> Ball:
    """Return the ball of the last entries of a plan that moves by D w, from entry `first` on."""
    rows = slice(first, len(D))
    linear, quadratic = float(softness.linear[0]), float(softness.quadratic[0])
    return Ball(rows, D[rows], linear / (2 * unit), quadratic / (2 * unit), 1 / np.sqrt(len(D) - first))


class BallSolver(StepSolver):
    """The QP of a step whose plan also has to end in a ball: Clarabel solves it where the QP's solution leaves that."""

    def __init__(self, qp: StepQP, turns: Sequence[SolverTurn], ball: Ball) -> None:
        super().__init__(qp, turns)
        self._set_ball(ball)

    def _set_ball(self, ball: Ball) -> None:
        """Write the cone program of x = [w; slacks of soft rows; slack of a soft ball] without its bounds.

        Its rows are A w − slacks ≤ high, −A w − slacks ≤ −low, slacks ≥ 0, and the cone ‖y_0 + D w‖ ≤ 1 + slack.
        """
        self.ball, qp, soft = ball, self.qp, ball.linear < np.inf
        linear, quadratic = qp.softness.linear, qp.softness.quadratic
        rows = np.flatnonzero(np.isfinite(linear))
        m, (p, n), k = len(linear), ball.D.shape, len(rows) + soft
        give = np.zeros((m, k))
        give[rows, np.arange(len(rows))] = -1.0
        bend, slack = np.zeros((1 + p, k)), np.hstack([np.zeros((k, n)), -np.eye(k)])
        if soft:
            bend[0, -1] = -1.0
        cone = np.hstack([np.vstack([np.zeros(n), -ball.D]), bend])
        self._cone_rows = np.vstack([np.hstack([qp.A, give]), np.hstack([-qp.A, give]), slack, cone])
        prices = np.append(quadratic[rows], ball.quadratic if soft else [])
        self._cost = scipy.sparse.block_diag([np.triu(qp.P), np.diag(2 * prices)], format="csc")
        self._gradient = np.concatenate([qp.q, linear[rows], [ball.linear] if soft else []])

    def change(self, qp: StepQP, ball: Ball) -> None:
        """Go on with new matrices of the same size; the warm start is kept."""
        self.update(qp)
        self._set_ball(ball)

    def solve(
        self,
        plan: Float[np.ndarray, " nv"],
        room: Interval | None,
        deadline: float | None,
        bounds: Interval | None = None,
    ) -> tuple[QPSolution, float]:
        """Return the least deviation w from the plan that ends in the ball; see `StepSolver.solve`."""
        qp, ball = self.qp, self.ball
        found, gave_way = super().solve(plan, room, deadline, bounds)
        y_0 = plan[ball.rows]
        y = y_0 + ball.D @ found.v
        if found.status is not Status.OPTIMAL or y.dot(y) <= _MET_SQUARE:
            return found, gave_way
        moved, limits, conflict = self._limit(plan, room, bounds)
        left = move_limits(limits or Interval(qp.low, qp.high), moved)
        iterations = found.iterations
        found = self._solve_cone(y_0, left, deadline)
        found.iterations += iterations
        if found.status is not Status.OPTIMAL:
            self.cool()
            return found, conflict
        self._last = found
        past = float(np.linalg.norm(y_0 + ball.D @ found.v)) - 1
        slack = past if ball.linear < np.inf and past > SOFTENED else 0.0
        return found, max(conflict, slack, self._gave_way(found, moved, limits) if self._soft else 0.0)

    def _solve_cone(self, y_0: Float[np.ndarray, " p"], left: Interval, deadline: float | None) -> QPSolution:
        """Solve the cone program within the limits of A w that are left."""
        import clarabel  # takes 10 ms

        m, n = self.qp.A.shape
        k = self._cone_rows.shape[1] - n
        ends = np.concatenate([left.high, -left.low, np.zeros(k), [1.0], y_0])
        kept = np.flatnonzero(ends < 1e20)  # Clarabel takes a larger number for no limit
        b, rows = ends[kept], scipy.sparse.csc_matrix(self._cone_rows[kept])
        cones = [clarabel.NonnegativeConeT(len(kept) - len(y_0) - 1), clarabel.SecondOrderConeT(len(y_0) + 1)]
        options, iterations = clarabel.DefaultSettings(), 0
        options.verbose = False
        for tolerance in _TOLERANCES:
            if deadline is not None:
                options.time_limit = deadline - perf_counter()
                if options.time_limit <= 0:
                    return QPSolution(np.zeros(n), np.zeros(m), Status.TIME_LIMIT, iterations, "clarabel")
            options.tol_gap_abs = options.tol_gap_rel = options.tol_feas = tolerance
            answer = clarabel.DefaultSolver(self._cost, self._gradient, rows, b, cones, options).solve()
            iterations += int(answer.iterations)
            status = _read_status(str(answer.status))
            if status is not Status.FAILED:
                break
        push, soft = np.zeros(len(ends)), self.qp.softness.linear
        push[kept] = answer.z
        y = push[:m] - push[m : 2 * m]
        y[np.abs(y) < 1e-9 * np.abs(y).max(initial=0.0)] = 0.0
        priced = np.abs(y) >= (1 - _PRICED) * soft
        y[priced] = np.sign(y[priced]) * np.maximum(np.abs(y[priced]), soft[priced])
        return QPSolution(np.array(answer.x[:n]), y, status, iterations, "clarabel")


def _read_status(name: str) -> Status:
    """Return what Clarabel's status means."""
    known = {
        "Solved": Status.OPTIMAL,
        "PrimalInfeasible": Status.INFEASIBLE,
        "MaxTime": Status.TIME_LIMIT,
        "MaxIterations": Status.MAX_ITERATIONS,
    }
    return known.get(name, Status.FAILED)
