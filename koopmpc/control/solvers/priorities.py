"""Priorities of soft limits: which gives way first, decided by one QP for each priority instead of by weights."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from time import perf_counter
from typing import Any, cast

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.control.ask.limits import Interval, Limits, Softness
from koopmpc.control.move import Status
from koopmpc.control.solvers.base import QPSolution, QPSolver, SolverTurn, StepQP, StepSolver

WEIGHT = 1e3  # where weights stand for priorities, a limit costs this many times one of the priority below
MOST = 3  # priorities that weights tell apart: more would exhaust double precision
_ROUNDING = 1e-3  # limits that are decided become wider by this share of the slack that is reported: room to solve in


def find_priorities(
    given: Any, states: Sequence[str], outputs: Sequence[str], linear: Float[np.ndarray, " n"]
) -> Int[np.ndarray, " n"]:
    """Return the priority of each limit of [x; of(x)], 0 where none is given.

    Parameters
    ----------
    linear
        Price of each limit, inf where it is hard, and 0 where there is none.
    """
    names = [*states, *outputs]
    if isinstance(given, Mapping):
        row = checks.order_by_name(cast("Mapping[str, float]", given), "priority", names, 0.0)
    else:
        row = checks.array(given, "priority")
        if row.shape != (len(names),):
            raise ShapeError(
                f"priority has shape {row.shape}, expected ({len(names)},): one number for each of {', '.join(names)}"
            )
    if (row != np.rint(row)).any():
        raise DataError(f"priority is {row.tolist()}; pass whole numbers, larger ones for limits that are kept longer")
    nothing = np.flatnonzero((row != 0) & (linear == 0))
    if nothing.size:
        raise DataError(
            f"{names[nothing[0]]} has priority {row[nothing[0]]:g} and no limit; limit it, declare that a step may with"
            " Limits(rows=…), or leave its priority out"
        )
    hard = np.flatnonzero((row != 0) & np.isinf(linear))
    if hard.size:
        raise DataError(
            f"the limit of {names[hard[0]]} is hard and has priority {row[hard[0]]:g}; a hard limit never gives way:"
            " give it a slack, or no priority"
        )
    return row.astype(np.intp)


def find_row_priorities(limits: Limits, states: Sequence[str]) -> Int[np.ndarray, " n"]:
    """Return the priority of each row of [x; of(x)] that has a limit, or may get one."""
    outputs = () if limits.of is None else limits.of.bind(tuple(states)).names
    rows = limits.base.find_rows(len(states), len(outputs))
    linear = np.zeros(len(states) + len(outputs))
    linear[rows.kept] = rows.softness.linear + rows.softness.quadratic  # a limit may be weighed by its square alone
    return find_priorities(limits.priority, states, outputs, linear)[rows.kept]


def spread_priorities(limits: Limits, states: Sequence[str], layout: tuple[int, int, int]) -> Int[np.ndarray, " nv"]:
    """Return the priority of each entry of a plan; `layout` is its first output, its steps and its length."""
    first, steps, length = layout
    priority = np.zeros(length, dtype=np.intp)
    own = find_row_priorities(limits, states)
    priority[first : first + steps * len(own)] = np.tile(own, steps)
    return priority


def weigh_priorities(softness: Softness, limits: Limits, states: Sequence[str], who: str) -> Softness:
    """Return what soft limits cost where weights stand for their priorities: `WEIGHT` times as much each."""
    own = find_row_priorities(limits, states)
    soft = np.isfinite(softness.linear)
    known = np.unique(own[soft])
    if len(known) > MOST:
        raise DataError(
            f"the limits have {len(known)} priorities, {', '.join(map(str, known))}, and {who} can tell {MOST} apart;"
            " give some the same one, or take a KoopmanMPC or a LinearMPC without levels"
        )
    factor = np.where(soft, WEIGHT ** np.searchsorted(known, own).astype(np.float64), 1.0)
    return softness._replace(linear=softness.linear * factor, quadratic=softness.quadratic * factor)


class PrioritySolver(StepSolver):
    """The QP of a step in which limits of low priority give way before those of a higher one, however little it costs.

    Where a limit above the lowest priority gives way, a QP is solved for each priority, the highest first. In it the
    limits below are left out, and those above are hard and as wide as they had to become.

    Parameters
    ----------
    qp, turns
        As for `StepSolver`; the first solver is exact.
    priority
        Of each entry of a plan; limits of inputs and rates have 0.
    """

    def __init__(self, qp: StepQP, turns: Sequence[SolverTurn], priority: Int[np.ndarray, " nv"]) -> None:
        self._of_entry = priority
        super().__init__(qp, turns)

    def _hold(self, qp: StepQP) -> None:
        super()._hold(qp)
        self._strict: dict[int, QPSolver] = {}
        self._givable = np.isfinite(qp.softness.linear)
        self._of_row = self._of_entry[qp.source]
        self._steps = np.unique(self._of_row[self._givable])[::-1]

    def _exceed(
        self, v: Float[np.ndarray, " n"], moved: Float[np.ndarray, " m"], limits: Interval
    ) -> Float[np.ndarray, " m"]:
        """Return by how much each soft row is beyond these limits, in the scale of the rows."""
        value = self.qp.A @ v + moved
        return np.where(self._givable, np.maximum(np.maximum(value - limits.high, limits.low - value), 0.0), 0.0)

    def _ask_all(
        self, moved: Float[np.ndarray, " m"], limits: Interval | None, deadline: float | None
    ) -> tuple[QPSolution, bool]:
        """Solve with all limits, and priority by priority where that lets a limit above the lowest give way."""
        found, answers = super()._ask_all(moved, limits, deadline)
        if not answers or found.status is not Status.OPTIMAL or len(self._steps) < 2:
            return found, answers
        own, qp = Interval(self.qp.low, self.qp.high) if limits is None else limits, self.qp
        reach = qp.softness.allowance * qp.scale
        past = self._exceed(found.v, moved, own)
        if not ((past > reach) & (self._of_row > self._steps[-1])).any():
            return found, answers
        wider, best, iterations = np.zeros(len(past)), found, found.iterations
        for step in self._steps:
            out = self._givable & (self._of_row < step)
            low, high = np.where(out, -np.inf, own.low - wider), np.where(out, np.inf, own.high + wider)
            left = None if deadline is None else deadline - perf_counter()
            if left is not None and left <= 0:
                break
            solver = self._solver_of(int(step))
            solver.set_bounds(low - moved, high - moved)
            best = solver.solve(*self._cold, left)
            iterations += best.iterations
            if best.status is not Status.OPTIMAL:
                break
            mine = self._givable & (self._of_row == step)
            wider[mine] = self._exceed(best.v, moved, own)[mine] + _ROUNDING * reach[mine]
        else:
            found = best  # else there was no time: the plan that weighs all limits at once stands
        found.iterations = iterations
        return found, True

    def _solver_of(self, step: int) -> QPSolver:
        """Return the solver in which the limits above this priority are hard."""
        if step not in self._strict:
            softness = self.qp.softness
            hard = self._givable & (self._of_row > step)
            linear, quadratic = np.where(hard, np.inf, softness.linear), np.where(hard, 0.0, softness.quadratic)
            qp = replace(self.qp, softness=softness._replace(linear=linear, quadratic=quadratic))
            self._strict[step] = self._turns[0].solver(qp, self._turns[0].settings)
        return self._strict[step]

    def reset(self) -> None:
        """Forget all earlier solves, so that a run repeats to the bit."""
        super().reset()
        self._strict.clear()

    def _gave_way(self, found: QPSolution, moved: Float[np.ndarray, " m"], limits: Interval | None) -> float:
        """Return the largest violation of a soft row above its allowance, in the unit of its limit."""
        own = Interval(self.qp.low, self.qp.high) if limits is None else limits
        past = self._exceed(found.v, moved, own) / self.qp.scale
        return float(past[past > self.qp.softness.allowance].max(initial=0.0))
