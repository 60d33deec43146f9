"""The QP of a step, and the solvers that are asked for it, one after the other, each started from the last answer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from koopmpc.control.limits import Interval, Softness
from koopmpc.control.move import Status
from koopmpc.control.solvers.base import QP, QPSolution, QPSolver

_AFTER = 5e-5  # what a step still has to do after its solve [s]


@dataclass(frozen=True, kw_only=True)
class StepQP(QP):
    """½ wᵀH w + Σ (linear ε + quadratic ε²) → min over w, low ≤ s (p + D w) ≤ high for a plan p.

    It is the cost unit · wᵀH w, and the price of slacks, divided by 2 unit. The rows limit the entries `source` of the
    plan times `scale`: their limits move by that product. `shift_primal` and `shift_dual` tell where the next stage's
    entry stands; one past the end stands for zero. A violation above its `allowance`, in the unit of its limit, is
    reported. `rate_rows` limit the first change of the inputs `rate_inputs`, hard.
    """

    softness: Softness = field(kw_only=True)
    source: Int[np.ndarray, " m"]
    scale: Float[np.ndarray, " m"]
    shift_primal: Int[np.ndarray, " n"]
    shift_dual: Int[np.ndarray, " m"]
    allowance: Float[np.ndarray, " m"]
    rate_rows: Int[np.ndarray, " r"]
    rate_inputs: Int[np.ndarray, " r"]


class Choice(NamedTuple):
    """A solver and its own settings; a `late` one is set up when it is first needed."""

    solver: type[QPSolver]
    settings: Mapping[str, Any]
    late: bool = False


class StepSolver:
    """The QP of a step, by the first of some solvers that has an answer, started from the last one moved on by a step.

    After a step that another than the first had to finish, that one is asked first, until a plan is free of limits:
    where a first-order method has met its bound it will in the next step, too, and an active-set method then needs few
    iterations.

    Parameters
    ----------
    qp
        The QP; its limits move with the plan.
    choices
        The solvers in the order in which they are asked.
    """

    def __init__(self, qp: StepQP, choices: Sequence[Choice]) -> None:
        self._choices = choices
        self._solvers = [None if choice.late else choice.solver(qp, choice.settings) for choice in choices]
        self._turn = 0
        self._last: QPSolution | None = None
        self._hold(qp)

    def _hold(self, qp: StepQP) -> None:
        """Make this the QP; its rows are often those of the plan, one after the other."""
        self.qp = qp
        m, n = qp.A.shape
        first = int(qp.source[0]) if m else 0
        self._rows = slice(first, first + m) if qp.source.tolist() == list(range(first, first + m)) else qp.source
        self._soft = bool(np.isfinite(qp.softness.linear).any())
        self._moved, self._cold = np.zeros(m), (np.zeros(n), np.zeros(m))

    def update(self, qp: StepQP) -> None:
        """Go on with new matrices of the same size; the warm start is kept."""
        for solver in self._solvers:
            if solver is not None:
                solver.update(qp)
        self._hold(qp)

    def cool(self) -> None:
        """Forget the last answer."""
        self._last = None

    def rest(self) -> None:
        """Forget the last answer, and who had to find it: the plan is free of limits."""
        self._last, self._turn = None, 0

    def reset(self) -> None:
        """Forget all earlier solves, so that a run repeats to the bit."""
        self.rest()
        for solver in self._solvers:
            if solver is not None:
                solver.reset()

    def solve(
        self, plan: Float[np.ndarray, " nv"], room: Interval | None, deadline: float | None
    ) -> tuple[QPSolution, float]:
        """Return the least deviation w from the plan, and how far a soft limit gave way, 0 where none did.

        Parameters
        ----------
        room
            How far each input is from its limits, lower and upper, where a hard rate limits it: where the two
            exclude each other the input limit wins.
        deadline
            The time by `perf_counter` at which the step must have ended; None for none.
        """
        qp, moved, limits, conflict = self.qp, self._moved, None, 0.0
        np.multiply(plan[self._rows], qp.scale, out=moved)
        if room is not None:
            limits, conflict = self._widened(room)
        found, answers = self._ask(self._turn, moved, limits, deadline)
        if not answers:
            found = self._others(found, moved, limits, deadline)
        if found.status is not Status.OPTIMAL:
            self._last = None
            return found, conflict
        self._last = found
        return found, max(conflict, self._gave_way(found, moved, limits)) if self._soft else conflict

    def _ask(
        self, i: int, moved: Float[np.ndarray, " m"], limits: Interval | None, deadline: float | None
    ) -> tuple[QPSolution, bool]:
        """Return what solver i finds, and whether it is the answer; one that is not exact has half of the time."""
        solver = self._solvers[i]
        if solver is None:
            solver = self._solvers[i] = self._choices[i].solver(self.qp, self._choices[i].settings)
        if limits is None:
            solver.shift(moved)
        else:
            solver.set_bounds(limits.low - moved, limits.high - moved)
        start, last = self._cold, self._last
        if last is not None:
            start = np.append(last.v, 0.0)[self.qp.shift_primal], np.append(last.y, 0.0)[self.qp.shift_dual]
        left = None
        if deadline is not None:
            left = deadline - perf_counter()
            left = left / 2 if i == 0 and not solver.exact else left
            left -= min(_AFTER, left / 2)
        found = solver.solve(*start, left)
        if solver.exact:
            return found, found.status is Status.OPTIMAL or found.status is Status.INFEASIBLE
        solved = found.status is Status.OPTIMAL
        return found, solved and (not self._soft or bool(np.all(np.abs(found.y) <= self.qp.softness.linear)))

    def _others(
        self, found: QPSolution, moved: Float[np.ndarray, " m"], limits: Interval | None, deadline: float | None
    ) -> QPSolution:
        """Return the answer of the first other solver that has one, else what the last one says."""
        iterations, asked = found.iterations, self._turn
        for i in range(len(self._solvers)):
            if i == asked:
                continue
            if deadline is not None and perf_counter() >= deadline:
                found.status = Status.TIME_LIMIT
                break
            found, answers = self._ask(i, moved, limits, deadline)
            iterations += found.iterations
            if answers:
                self._turn = i
                break
            if found.status is Status.OPTIMAL:  # with rows that are held although they had to give way
                found.status = Status.FAILED
        found.iterations = iterations
        return found

    def _gave_way(self, found: QPSolution, moved: Float[np.ndarray, " m"], limits: Interval | None) -> float:
        """Return the largest violation of a soft row above its allowance, in the unit of its limit."""
        qp = self.qp
        pushed = np.abs(found.y) >= (1 - 1e-9) * qp.softness.linear
        if not pushed.any():
            return 0.0
        low, high = (qp.low, qp.high) if limits is None else limits
        rows = np.flatnonzero(pushed)
        value = qp.A[rows] @ found.v + moved[rows]
        past = np.maximum(value - high[rows], low[rows] - value) / qp.scale[rows]
        return float(past[past > qp.allowance[rows]].max(initial=0.0))

    def _widened(self, room: Interval) -> tuple[Interval, float]:
        """Return the limits with the first rates as wide as the input limits need, and by how much, in their unit."""
        qp = self.qp
        low, high = qp.low.copy(), qp.high.copy()
        rows, which = qp.rate_rows, qp.rate_inputs
        scale = qp.scale[rows]
        lowest = np.minimum(low[rows], room.high[which] * scale)
        highest = np.maximum(high[rows], room.low[which] * scale)
        below, above = lowest < low[rows], highest > high[rows]  # never where there is no limit
        past = np.where(below, low[rows], 0.0) - np.where(below, lowest, 0.0)
        past += np.where(above, highest, 0.0) - np.where(above, high[rows], 0.0)
        low[rows], high[rows] = lowest, highest
        return Interval(low, high), float((past / scale)[past > 1e-9].max(initial=0.0))
