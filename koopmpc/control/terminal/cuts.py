"""A terminal ellipsoid: the step's QP on its active rows, or tangent cuts until the plan ends in the ellipsoid."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import cholesky, solve_triangular

from koopmpc.control.limits import SOFTENED, Interval, Softness
from koopmpc.control.move import Status
from koopmpc.control.solvers import FINISHER
from koopmpc.control.solvers.base import QP, QPSolution, SolverTurn, StepQP, StepSolver, move_limits
from koopmpc.control.solvers.daqp import DAQP
from koopmpc.control.terminal.faces import FaceQP, Faces, Price

MET = 1e-8  # the ellipsoid is met if the norm exceeds 1 by at most this much
_MET_SQUARE = (1 + MET) ** 2
NEAR = 1e-6  # from here on the half spaces move inwards by what the solver's tolerance leaves
MOST = 40  # cuts of a step; beyond that the step ends with MAX_ITERATIONS
_ALONE = 20  # passes in which one soft cut follows the plan, before others join it
_TRIES = 6  # sets of active rows that are tried before the next cut


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


class StepLimits(NamedTuple):
    """The limits of a step, None for those of the QP, by how much the plan moves them, what is left for A w.

    `conflict` is how far a hard rate had to give way.
    """

    moved: Float[np.ndarray, " m"]
    limits: Interval | None
    left: Interval
    conflict: float


class BallSolver(StepSolver):
    """The QP of a step whose plan also has to end in a ball; see `StepSolver`.

    The active rows of the last step, shifted, are tried first, else those of the QP's solution where that leaves the
    ball. On these rows the problem is a scalar equation; see `Face`. Its answer is the optimum where it keeps all
    other rows and all multipliers have the right sign. Where no set of rows gives it, half spaces aᵀy ≤ 1 join the
    QP, each tangent to the ball, until ‖y‖ ≤ 1 + 1e-8 or the active rows give the optimum.
    """

    def __init__(self, qp: StepQP, turns: Sequence[SolverTurn], ball: Ball) -> None:
        super().__init__(qp, turns)
        self._set_ball(ball)

    def _set_ball(self, ball: Ball) -> None:
        """Make this the ball; the QP with room for cuts is set up when it is needed."""
        self.ball, qp = ball, self.qp
        root = cholesky(qp.P, lower=True)
        back = solve_triangular(root, np.eye(len(root)), lower=True).T  # w = back q with ‖q‖² = wᵀP w
        price = Price(ball.linear, ball.quadratic)
        self._faces = Faces(FaceQP(qp.A @ back, ball.D @ back, back, qp.softness, price))
        self._size = float(np.sqrt((ball.D**2).sum(axis=1).max(initial=0.0))) or 1.0  # of a row aᵀD
        self._cutter: DAQP | None = None
        self._multiplier = 0.0

    def _set_up_cutter(self) -> DAQP:
        """Return the QP with room for cuts, all of them free."""
        qp, ball, n, s = self.qp, self.ball, MOST, self._size
        if self._cutter is None:
            soft = Softness(
                np.concatenate([qp.softness.linear, np.full(n, ball.linear * s)]),
                np.concatenate([qp.softness.quadratic, np.full(n, ball.quadratic * s**2)]),
                np.concatenate([qp.softness.allowance, np.full(n, SOFTENED)]),
            )
            A, free = np.vstack([qp.A, np.zeros((n, qp.A.shape[1]))]), np.full(n, np.inf)
            low, high = np.concatenate([qp.low, -free]), np.concatenate([qp.high, free])
            self._cutter = FINISHER(QP(qp.P, qp.q, A, low, high, soft))
        return self._cutter

    def change(self, qp: StepQP, ball: Ball) -> None:
        """Go on with new matrices of the same size; the warm start is kept."""
        self.update(qp)
        self._set_ball(ball)

    def cool(self) -> None:
        """Forget the last answer."""
        super().cool()
        self._multiplier = 0.0

    def rest(self) -> None:
        """Forget the last answer; see `StepSolver`."""
        super().rest()
        self._multiplier = 0.0

    def reset(self) -> None:
        """Forget all earlier solves, so that a run repeats to the bit."""
        super().reset()
        self._cutter = None

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
        y_0, known = plan[self.ball.rows], None
        if self._multiplier > 0 and self._last is not None:
            known = self._find_limits(plan, room, bounds)
            face, _ = self._try_faces(np.append(self._last.y, 0.0)[self.qp.shift_dual], y_0, known.left)
            if face is not None:
                return self._accept(face, y_0, known)
        found, gave_way = super().solve(plan, room, deadline, bounds)
        self._multiplier, y = 0.0, y_0 + self.ball.D.dot(found.v)
        if found.status is not Status.OPTIMAL or y.dot(y) <= _MET_SQUARE:
            return found, gave_way
        known = known or self._find_limits(plan, room, bounds)
        face, touch = self._try_faces(found.y, y_0, known.left)
        if face is None:
            face = self._cut(found, y if touch is None else touch, y_0, known.left, deadline)
        else:
            face.iterations += found.iterations
        if face.status is Status.OPTIMAL:
            return self._accept(face, y_0, known)
        self.cool()
        return face, known.conflict

    def _find_limits(
        self, plan: Float[np.ndarray, " nv"], room: Interval | None, bounds: Interval | None
    ) -> StepLimits:
        """Return what limits w in this step; see `StepSolver.solve`."""
        moved, limits, conflict = self._limit(plan, room, bounds)
        left = move_limits(limits or Interval(self.qp.low, self.qp.high), moved)
        return StepLimits(moved, limits, left, conflict)

    def _accept(self, found: QPSolution, y_0: Float[np.ndarray, " p"], known: StepLimits) -> tuple[QPSolution, float]:
        """Keep an answer, and return it with how far a soft limit or the ball gave way."""
        self._last, past = found, 0.0
        if self.ball.linear < np.inf:
            past = float(np.linalg.norm(y_0 + self.ball.D @ found.v)) - 1
        slack = past if past > SOFTENED else 0.0
        gave_way = self._gave_way(found, known.moved, known.limits) if self._soft else 0.0
        return found, max(known.conflict, slack, gave_way)

    def _try_faces(
        self,
        rows: Float[np.ndarray, " m"],
        y_0: Float[np.ndarray, " p"],
        left: Interval,
    ) -> tuple[QPSolution | None, Float[np.ndarray, " p"] | None]:
        """Return the optimum if one of a few sets of active rows has it, and where the first set meets the ball.

        The first set is that to which the multipliers `rows` push.
        """
        sides, touch, tried, hard = self._faces.find_sides(rows), None, set[bytes](), self.ball.linear == np.inf
        for i in range(_TRIES):
            found = self._faces.solve(sides, y_0, left, self._multiplier)
            if found is None:
                break
            if touch is None:
                touch = found.y
            if hard and found.y.dot(found.y) > _MET_SQUARE:  # these rows leave no way into the ball
                break
            if found.sides is None:
                end = y_0 + self.ball.D.dot(found.w)
                if hard and end.dot(end) > _MET_SQUARE:
                    break
                self._multiplier = found.multiplier
                return QPSolution(found.w, found.rows, Status.OPTIMAL, i + 1, FINISHER.name), found.y
            tried.add(sides.tobytes())
            sides = found.sides
            if sides.tobytes() in tried:
                break
        return None, touch

    def _cut(
        self,
        found: QPSolution,
        y: Float[np.ndarray, " p"],
        y_0: Float[np.ndarray, " p"],
        left: Interval,
        deadline: float | None,
    ) -> QPSolution:
        """Add one cut after the other, the first at y/‖y‖, until the plan ends in the ball.

        Of a soft ball several cuts would each take their price, so that one follows the plan; only where it finds no
        rest others join it.
        """
        ball, m, solver, soft = self.ball, len(self.qp.A), self._set_up_cutter(), self.ball.linear < np.inf
        cuts, pushes, tighter, iterations = np.zeros((MOST, len(ball.D))), np.zeros(MOST), 0.0, found.iterations
        ends, free, v, rows = np.full(MOST, np.inf), np.full(MOST, np.inf), found.v, found.y
        for step in range(MOST):
            limit = None if deadline is None else deadline - perf_counter()
            if limit is not None and limit <= 0:
                return replace(found, status=Status.TIME_LIMIT, iterations=iterations)
            i = max(step - _ALONE, 0) if soft else step
            cuts[i] = y / np.linalg.norm(y)
            solver.exchange_row(m + i, cuts[i] @ ball.D / self._size)
            ends[: i + 1] = (1 - tighter - cuts[: i + 1] @ y_0) / self._size
            solver.set_bounds(np.concatenate([left.low, -free]), np.concatenate([left.high, ends]))
            whole = solver.solve(v, np.concatenate([rows, pushes]), limit)
            iterations += whole.iterations
            v, rows, pushes = whole.v, whole.y[:m], whole.y[m:].copy()
            found = QPSolution(v, rows, whole.status, iterations, whole.solver)
            if whole.status is not Status.OPTIMAL:
                return found
            y = y_0 + ball.D @ v
            past = float(np.linalg.norm(y)) - 1
            given = float((cuts[: i + 1] @ y).max()) - 1  # what soft cuts gave way
            if past <= MET or (soft and given >= past - MET):
                self._multiplier = float(pushes.sum()) / self._size
                return found
            face, touch = self._try_faces(rows, y_0, left)
            if face is not None:
                face.iterations += iterations
                return face
            if past < NEAR and not soft:  # the solver meets a row to its own tolerance, which is that of w
                tighter += past
            elif touch is not None and touch @ y > (1 + MET) * np.linalg.norm(touch):
                y = touch
        return replace(found, status=Status.MAX_ITERATIONS)
