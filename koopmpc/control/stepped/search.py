"""Branch and bound over the levels of inputs: the QP of a step, with some of its moves on levels.

Each node is the QP of the step with narrower limits of these moves, solved by the same solver from its parent's active
rows. Dwell times narrow the levels of later moves before a node is solved. The search goes deep first,
and starts at the levels of the last plan, so that it has a plan early.

Land & Doig, "An automatic method of solving discrete programming problems", Econometrica 28, 1960.
"""

from collections.abc import Sequence
from time import perf_counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from koopmpc.control.limits import Interval
from koopmpc.control.move import Status
from koopmpc.control.solvers.base import QPSolution, SolverTurn, StepQP, StepSolver
from koopmpc.control.stepped.levels import NEAR, HeldLevels, LevelBox, leveled_moves

_EQUAL = 1e-9  # a node is worse than the best plan unless it is better by more than this share
NODES = 200_000  # nodes of one search, at most


class _Node(NamedTuple):
    bound: float
    box: LevelBox
    v: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " m"]


class LevelSolver(StepSolver):
    """The QP of a step whose moves are on levels: `solve` returns the best plan found, and `gap` what it may miss.

    Attributes
    ----------
    held
        The levels now, and how long each input has held its own.
    index
        The levels of the last plan, move by move.
    gap
        (J − bound) / J of the last plan, J its cost above that of the plan without limits; 0 where it is the best.
    nodes
        QPs of the last search.
    """

    def __init__(self, qp: StepQP, turn: SolverTurn, held: HeldLevels, blocks: Sequence[int], nu: int) -> None:
        self.held, self._blocks, self._nu = held, blocks, nu
        self.index = np.zeros((leveled_moves(held.levels, blocks), len(held.levels.which)), np.intp)
        self._known, self.gap, self.nodes = False, 0.0, 0
        super().__init__(qp, [turn])

    def _hold(self, qp: StepQP) -> None:
        super()._hold(qp)
        row = np.full(int(qp.source.max(initial=0)) + 1, -1)
        row[qp.source] = np.arange(len(qp.source))
        places = np.arange(len(self.index))[:, None] * self._nu + self.held.levels.which
        self._rows_of = row[places]
        self._flat = self._rows_of.ravel()
        self._of_levels, self._factor = qp.A[self._flat], qp.scale[self._flat]
        self._soft_rows = np.flatnonzero(np.isfinite(qp.softness.linear))

    def reset(self) -> None:
        """Forget all earlier solves, so that a run repeats to the bit."""
        super().reset()
        self._known, self.gap = False, 0.0

    def accepts(self, t: Float[np.ndarray, " nt"]) -> bool:
        """Return whether a plan without limits is on the levels; its moves are then put on them to the bit."""
        moves = len(self._blocks) * self._nu
        U = t[:moves].reshape(-1, self._nu)
        at = self.held.levels.indices(U[: len(self.index)])
        nearest = np.rint(at).astype(np.intp)
        if (np.abs(at - nearest) > NEAR).any() or not self.held.tighten(
            LevelBox(nearest.copy(), nearest.copy()), self._blocks
        ):
            return False
        self.index, self._known, self.gap = nearest, True, 0.0
        self.place(U)
        return True

    def place(self, U: Float[np.ndarray, "..."]) -> float:
        """Put the moves of a plan on the levels found, to the bit; return the gap."""
        rows = U.reshape(-1, self._nu)
        rows[: len(self.index), self.held.levels.which] = self.held.levels.values(self.index)
        return self.gap

    def _ask_all(
        self, moved: Float[np.ndarray, " m"], limits: Interval | None, deadline: float | None
    ) -> tuple[QPSolution, bool]:
        """Search; the answer is the best plan found."""
        own = limits or Interval(self.qp.low, self.qp.high)
        low, high = own.low - moved, own.high - moved
        levels, shape = self.held.levels, self.index.shape
        self._moved_levels = moved[self._flat].reshape(shape)
        root = LevelBox(np.zeros(shape, np.intp), np.broadcast_to(levels.count - 1, shape).copy())
        if limits is not None:  # the limits of the inputs may move in time
            factor = self._factor.reshape(shape)
            root = levels.between(own.low[self._rows_of] / factor, own.high[self._rows_of] / factor)
            if (root.low > root.high).any():
                return QPSolution(
                    self._cold[0].copy(), self._cold[1].copy(), Status.INFEASIBLE, 0, self.first.name
                ), True
        self.nodes, self.gap = 0, 0.0
        best, cost, iterations, unproven = None, np.inf, 0, np.inf
        stack = [_Node(0.0, root, *self._cold)]
        if self._known:
            shifted = np.clip(np.vstack([self.index[1:], self.index[-1:]]), root.low, root.high)
            stack.append(_Node(0.0, LevelBox(shifted.copy(), shifted.copy()), *self._cold))
        ended = Status.INFEASIBLE
        while stack:
            node = stack.pop()
            if node.bound >= cost - _EQUAL * abs(cost):
                continue
            if not self.held.tighten(node.box, self._blocks):
                continue
            left = None if deadline is None else deadline - perf_counter()
            if (left is not None and left <= 0) or self.nodes >= NODES:
                stack.append(node)
                ended = Status.TIME_LIMIT if self.nodes < NODES else Status.MAX_ITERATIONS
                break
            found = self._relax(node, low, high, left)
            self.nodes += 1
            iterations += found.iterations
            if found.status is Status.TIME_LIMIT:
                stack.append(node)
                ended = Status.TIME_LIMIT
                break
            if found.status is not Status.OPTIMAL:
                if found.status is not Status.INFEASIBLE:
                    unproven, ended = min(unproven, node.bound), Status.FAILED
                continue
            bound = self._cost(found.v, low, high)
            if bound >= cost - _EQUAL * abs(cost):
                continue
            at = self._read_levels(found.v)
            nearest = np.clip(np.rint(at), node.box.low, node.box.high).astype(np.intp)
            place = self._choose(at, nearest, node.box)
            if place is None:
                best, cost, self.index = found, bound, nearest
                continue
            self._branch(stack, node.box, place, at, bound, found)
        worst = min([unproven, *(node.bound for node in stack)])
        self._known = best is not None
        if best is None:
            cold = self._cold
            return QPSolution(cold[0].copy(), cold[1].copy(), ended, iterations, self.first.name), True
        best.iterations = iterations
        if worst < cost - _EQUAL * abs(cost):
            self.gap = float(min(max((cost - max(worst, 0.0)) / max(cost, 1e-300), 0.0), 1.0))
        return best, True

    def _relax(
        self, node: _Node, low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"], left: float | None
    ) -> QPSolution:
        """Return the solution of the QP of a node, levels between the ends of its box being allowed."""
        levels, low, high = self.held.levels, low.copy(), high.copy()
        factor = self._factor.reshape(self.index.shape)
        low[self._rows_of] = factor * levels.values(node.box.low) - self._moved_levels
        high[self._rows_of] = factor * levels.values(node.box.high) - self._moved_levels
        self.first.set_bounds(low, np.maximum(low, high))
        return self.first.solve(node.v, node.y, left)

    def _read_levels(self, v: Float[np.ndarray, " n"]) -> Float[np.ndarray, "moves leveled"]:
        """Return where the moves of a plan are between their levels."""
        levels = self.held.levels
        u = (self._of_levels @ v + self._moved_levels.ravel()) / self._factor
        return (u.reshape(self.index.shape) - levels.first) / levels.spacing

    def _cost(self, v: Float[np.ndarray, " n"], low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"]) -> float:
        """Return the cost of a solution above that of the plan without limits, soft limits that give way included."""
        qp, rows = self.qp, self._soft_rows
        cost = 0.5 * float(v @ qp.P @ v) + float(qp.q @ v)
        if len(rows):
            value = qp.A[rows] @ v
            slack = np.maximum(np.maximum(value - high[rows], low[rows] - value), 0.0)
            cost += float(qp.softness.linear[rows] @ slack + qp.softness.quadratic[rows] @ slack**2)
        return cost

    def _choose(
        self, at: Float[np.ndarray, "moves leveled"], nearest: Int[np.ndarray, "moves leveled"], box: LevelBox
    ) -> tuple[int, int] | None:
        """Return the move and the input to branch on: the first between two levels, or with an open dwell time."""
        between = np.argwhere(np.abs(at - nearest) > NEAR)
        if len(between):
            k, i = between[0]
            return int(k), int(i)
        if self.held.tighten(LevelBox(nearest.copy(), nearest.copy()), self._blocks):
            return None
        open_moves = np.argwhere((box.low != box.high) & (self.held.levels.dwell.max(axis=1) > 1))
        k, i = open_moves[0]
        return int(k), int(i)

    def _branch(
        self,
        stack: list[_Node],
        box: LevelBox,
        place: tuple[int, int],
        at: Float[np.ndarray, "moves leveled"],
        bound: float,
        found: QPSolution,
    ) -> None:
        """Put the nodes of the levels below and above on the stack, the nearer one last, so that it is next."""
        low, high, value = int(box.low[place]), int(box.high[place]), float(at[place])
        middle = int(np.rint(value))
        if abs(value - middle) <= NEAR:
            ends = [(low, middle - 1), (middle + 1, high), (middle, middle)]
        else:
            below, above = (low, int(np.floor(value))), (int(np.ceil(value)), high)
            ends = [below, above] if middle == above[0] else [above, below]
        for first, last in ends:
            if low <= first <= last <= high:
                child = LevelBox(box.low.copy(), box.high.copy())
                child.low[place], child.high[place] = first, last
                stack.append(_Node(bound, child, found.v, found.y))
