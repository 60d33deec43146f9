"""Branch and bound over the levels of inputs: one search, whatever its nodes are.

A node is the program of the step with narrower limits of the moves on levels, solved from its parent's solution; or
beginnings of sequences, see `Sequences`. Dwell times narrow the levels of later moves before a program is solved. The
search goes deep first, and starts at the levels of the last plan, so that it has a plan early.

Land & Doig, "An automatic method of solving discrete programming problems", Econometrica 28, 1960.
"""

from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from koopmpc.control.ask.levels import NEAR, HeldLevels, LevelBox, leveled_moves
from koopmpc.control.ask.limits import Interval
from koopmpc.control.move import Status
from koopmpc.control.solvers.base import QPSolution, SolverTurn, StepQP, StepSolver
from koopmpc.control.solvers.sequences import (
    EQUAL,
    Grow,
    Grown,
    LevelNode,
    LevelPlan,
    LevelsProgram,
    Sequences,
    plan_sequences,
)

NODES = 200_000  # nodes of one search, at most
_NAME = "sequences"  # of the solver, where no quadratic program is solved


class Relaxed(NamedTuple):
    """The program of a node without levels: how it ended, its cost, and where its moves are between their levels.

    `answer` is what the caller makes of the best node; the nodes below it start there.
    """

    status: Status
    cost: float
    at: Float[np.ndarray, "moves leveled"]
    iterations: int
    answer: Any


class LevelsFound(NamedTuple):
    """What a search ended with: the best answer, None without one, why it has none, and all iterations."""

    answer: Any
    status: Status
    iterations: int


class LevelSearch:
    """The search over the levels of the moves of a plan, whatever program its nodes are.

    Parameters
    ----------
    held
        The levels now, and how long each input has held its own.
    blocks
        Steps of each move.
    nu
        Inputs of the plant.

    Attributes
    ----------
    index
        The levels of the last plan, move by move.
    gap
        (J − bound) / J of the last plan, both counted from the least cost that is known to be possible; 0 where it is
        the best.
    nodes
        Programs of the last search.
    """

    def __init__(self, held: HeldLevels, blocks: Sequence[int], nu: int) -> None:
        self.held, self.blocks, self.nu = held, blocks, nu
        self.index = np.zeros((leveled_moves(held.levels, blocks), len(held.levels.which)), np.intp)
        self._known, self.gap, self.nodes = False, 0.0, 0
        self.repeats = False  # whether the next search is of the same step as the last one

    def reset(self) -> None:
        """Forget the levels of the last plan."""
        self._known, self.gap, self.repeats = False, 0.0, False

    def accepts(self, t: Float[np.ndarray, " nt"]) -> bool:
        """Return whether a plan without levels is on them; its moves are then put on them to the bit."""
        moves = len(self.blocks) * self.nu
        U = t[:moves].reshape(-1, self.nu)
        at = self.held.levels.indices(U[: len(self.index)])
        nearest = np.rint(at).astype(np.intp)
        if (np.abs(at - nearest) > NEAR).any() or not self.held.tighten(
            LevelBox(nearest.copy(), nearest.copy()), self.blocks
        ):
            return False
        self.index, self._known, self.gap = nearest, True, 0.0
        self.place(U)
        return True

    def place(self, U: Float[np.ndarray, "..."]) -> float:
        """Put the moves of a plan on the levels found, to the bit; return the gap."""
        rows = U.reshape(-1, self.nu)
        rows[: len(self.index), self.held.levels.which] = self.held.levels.values(self.index)
        return self.gap

    def place_steps(self, U: Float[np.ndarray, "N nu"]) -> None:
        """Put the inputs of all steps on the levels found, to the bit."""
        blocks = self.blocks[: len(self.index)]
        values = self.held.levels.values(np.repeat(self.index, blocks, axis=0))
        U[: len(values), self.held.levels.which] = values

    def open_box(self) -> LevelBox:
        """Return the box of all levels."""
        shape = self.index.shape
        return LevelBox(np.zeros(shape, np.intp), np.broadcast_to(self.held.levels.count - 1, shape).copy())

    def find(
        self,
        relax: Callable[[LevelBox, Any, float | None], Relaxed],
        root: LevelBox,
        start: Any,
        deadline: float | None,
        least: float = 0.0,
    ) -> LevelsFound:
        """Search inside `root`; `relax` solves a node from an answer in so many seconds, `start` is the first answer.

        No node costs less than `least`, from which the gap counts.
        """

        def grow(node: LevelNode, most: float, left: float | None) -> Grown:
            box, answer = node.part
            if not self.held.tighten(box, self.blocks):
                return Grown(Status.INFEASIBLE)
            found = relax(box, answer, left)
            if found.status is not Status.OPTIMAL or found.cost >= most:
                return Grown(found.status, 1, found.iterations)
            nearest = np.clip(np.rint(found.at), box.low, box.high).astype(np.intp)
            place = self._choose(found.at, nearest, box)
            if place is None:
                plan = LevelPlan(found.cost, nearest, found.answer)
                return Grown(Status.OPTIMAL, 1, found.iterations, plan=plan)
            return Grown(Status.OPTIMAL, 1, found.iterations, self._branch(box, place, found))

        stack, guess = [LevelNode(least, (root, start))], self.guess()
        if guess is not None and (root.low != root.high).any():
            last = np.clip(guess, root.low, root.high)
            stack.append(LevelNode(least, (LevelBox(last.copy(), last.copy()), start)))
        return self._search(stack, grow, LevelPlan(), deadline, least)

    def find_sequence(
        self,
        sequences: Sequences,
        start: Float[np.ndarray, "moves leveled"],
        limits: Interval,
        root: LevelBox,
        deadline: float | None,
    ) -> LevelsFound:
        """Search the sequences of levels inside `root`; the answer is the point v of the best one."""
        node, best, grow = sequences.begin(start, limits, root, self.guess())
        return self._search([node], grow, best, deadline, 0.0)

    def _search(
        self, stack: list[LevelNode], grow: Grow, best: LevelPlan, deadline: float | None, least: float
    ) -> LevelsFound:
        """Branch and bound: take the last node, leave it if it cannot beat the best plan, else put those below it."""
        self.nodes, self.gap = int(best.answer is not None), 0.0
        iterations, unproven, ended = self.nodes, np.inf, Status.INFEASIBLE
        while stack:
            node = stack.pop()
            most = _less(best.cost)
            if node.bound >= most:
                continue
            left = None if deadline is None else deadline - perf_counter()
            if (left is not None and left <= 0) or self.nodes >= NODES:
                stack.append(node)
                ended = Status.TIME_LIMIT if self.nodes < NODES else Status.MAX_ITERATIONS
                break
            grown = grow(node, most, left)
            self.nodes += grown.programs
            iterations += grown.iterations
            if grown.status is Status.TIME_LIMIT:
                stack.append(node)
                ended = Status.TIME_LIMIT
                break
            if grown.status not in (Status.OPTIMAL, Status.INFEASIBLE):
                unproven, ended = min(unproven, node.bound), Status.FAILED
            best = grown.plan or best
            stack += grown.nodes
        self._known = best.levels is not None
        if best.levels is None:
            return LevelsFound(None, ended, iterations)
        self.index = best.levels
        bound = min([unproven, *(node.bound for node in stack)])
        if bound < _less(best.cost):
            missed = (best.cost - max(bound, least)) / max(best.cost - least, 1e-300)
            self.gap = float(min(max(missed, 0.0), 1.0))
        return LevelsFound(best.answer, Status.OPTIMAL, iterations)

    def guess(self) -> Int[np.ndarray, "moves leveled"] | None:
        """Return the levels of the last plan, moved on by a step; None where there is none."""
        if not self._known:
            return None
        return self.index if self.repeats else np.vstack([self.index[1:], self.index[-1:]])

    def find_places(self) -> Int[np.ndarray, "moves leveled"]:
        """Return where the moves on levels stand in a plan, move by move."""
        return np.arange(len(self.index))[:, None] * self.nu + self.held.levels.which

    def _choose(
        self, at: Float[np.ndarray, "moves leveled"], nearest: Int[np.ndarray, "moves leveled"], box: LevelBox
    ) -> tuple[int, int] | None:
        """Return the move and the input to branch on: the first between two levels, or with an open dwell time."""
        between = np.abs(at - nearest) > NEAR
        if between.any():
            k, i = divmod(int(between.argmax()), between.shape[1])
            return k, i
        if self.held.tighten(LevelBox(nearest.copy(), nearest.copy()), self.blocks):
            return None
        open_moves = np.argwhere((box.low != box.high) & (self.held.levels.dwell.max(axis=1) > 1))
        k, i = open_moves[0]
        return int(k), int(i)

    def _branch(self, box: LevelBox, place: tuple[int, int], found: Relaxed) -> list[LevelNode]:
        """Return the nodes of the levels below and above, the nearer one last, so that it is next."""
        low, high, value = int(box.low[place]), int(box.high[place]), float(found.at[place])
        middle = int(np.rint(value))
        if abs(value - middle) <= NEAR:
            ends = [(low, middle - 1), (middle + 1, high), (middle, middle)]
        else:
            below, above = (low, int(np.floor(value))), (int(np.ceil(value)), high)
            ends = [below, above] if middle == above[0] else [above, below]
        nodes: list[LevelNode] = []
        for first, last in ends:
            if low <= first <= last <= high:
                child = LevelBox(box.low.copy(), box.high.copy())
                child.low[place], child.high[place] = first, last
                nodes.append(LevelNode(found.cost, (child, found.answer)))
        return nodes


def _less(cost: float) -> float:
    """Return what a plan has to cost less than to count as cheaper."""
    return cost - EQUAL * abs(cost) if cost < np.inf else np.inf


class LevelSolver(StepSolver):
    """The QP of a step whose moves are on levels: `solve` returns the best plan that the `search` finds."""

    def __init__(self, qp: StepQP, turn: SolverTurn, search: LevelSearch) -> None:
        self.search = search
        super().__init__(qp, [turn])

    def _hold(self, qp: StepQP) -> None:
        super()._hold(qp)
        search = self.search
        row = np.full(int(qp.source.max(initial=0)) + 1, -1)
        row[qp.source] = np.arange(len(qp.source))
        self._rows_of = row[search.find_places()]
        self._flat = self._rows_of.ravel()
        self._of_levels, self._factor = qp.A[self._flat], qp.scale[self._flat]
        self._is_least_distance = bool((np.eye(len(qp.q)) == qp.P).all()) and not qp.q.any()
        self._soft_rows = np.flatnonzero(np.isfinite(qp.softness.linear))
        held, factor = search.held, self._factor.reshape(search.index.shape)
        planned = plan_sequences(qp, self._rows_of, factor, held.levels, search.blocks)
        self._sequences = None if planned is None else Sequences(*planned, held)

    def describe(self) -> LevelsProgram | None:
        """Return the search over sequences as data; None unless all inputs are on levels in all steps."""
        search = self.search
        every = search.index.shape == (len(search.blocks), search.nu)
        return None if self._sequences is None or not every else self._sequences.program

    def reset(self) -> None:
        """Forget all earlier solves, so that a run repeats to the bit."""
        super().reset()
        self.search.reset()

    def _ask_all(
        self, moved: Float[np.ndarray, " m"], limits: Interval | None, deadline: float | None
    ) -> tuple[QPSolution, bool]:
        """Search; the answer is the best plan found."""
        search, cold = self.search, self._cold
        own = limits or Interval(self.qp.low, self.qp.high)
        low, high = own.low - moved, own.high - moved
        levels, shape = search.held.levels, search.index.shape
        at_start, root = moved[self._flat].reshape(shape), search.open_box()
        factor = self._factor.reshape(shape)
        if limits is not None:  # the limits of the inputs may move in time
            root = levels.between(own.low[self._rows_of] / factor, own.high[self._rows_of] / factor)
            if (root.low > root.high).any():
                return QPSolution(cold[0].copy(), cold[1].copy(), Status.INFEASIBLE, 0, self.first.name), True

        at = (at_start / factor - levels.first) / levels.spacing
        if self._sequences is not None:
            found = search.find_sequence(self._sequences, at, Interval(low, high), root, deadline)
            v = cold[0] if found.answer is None else found.answer
            return QPSolution(v.copy(), self._push(v, low, high), found.status, found.iterations, _NAME), True

        def relax(box: LevelBox, answer: tuple[np.ndarray, np.ndarray], left: float | None) -> Relaxed:
            least, most = low.copy(), high.copy()
            least[self._rows_of] = factor * levels.values(box.low) - at_start
            most[self._rows_of] = factor * levels.values(box.high) - at_start
            self.first.set_bounds(least, np.maximum(least, most))
            found = self.first.solve(*answer, left)
            u = (self._of_levels @ found.v + at_start.ravel()) / self._factor
            at = (u.reshape(shape) - levels.first) / levels.spacing
            return Relaxed(found.status, self._cost(found.v, low, high), at, found.iterations, (found.v, found.y))

        found = search.find(relax, root, cold, deadline)
        v, y = cold if found.answer is None else found.answer
        return QPSolution(v.copy(), y.copy(), found.status, found.iterations, self.first.name), True

    def _push(
        self, v: Float[np.ndarray, " n"], low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"]
    ) -> Float[np.ndarray, " m"]:
        """Return multipliers of the soft limits that give way at v, zero for all others."""
        y, rows = np.zeros(len(low)), self._soft_rows
        value = self.qp.A[rows] @ v
        y[rows] = ((value > high[rows]).astype(float) - (value < low[rows])) * self.qp.softness.linear[rows]
        return y

    def _cost(self, v: Float[np.ndarray, " n"], low: Float[np.ndarray, " m"], high: Float[np.ndarray, " m"]) -> float:
        """Return the cost of a solution above that of the plan without limits, soft limits that give way included."""
        qp, rows = self.qp, self._soft_rows
        cost = 0.5 * float(v @ v) if self._is_least_distance else 0.5 * float(v @ qp.P @ v) + float(qp.q @ v)
        if len(rows):
            value = qp.A[rows] @ v
            slack = np.maximum(np.maximum(value - high[rows], low[rows] - value), 0.0)
            cost += float(qp.softness.linear[rows] @ slack + qp.softness.quadratic[rows] @ slack**2)
        return cost
