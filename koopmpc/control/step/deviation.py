"""DeviationSolver: the QP of the deviation from a plan that breaks a limit, and the plan that it leads to."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.base.checks import HUGE
from koopmpc.base.values import Interval
from koopmpc.control.bounds.boxes import clip_input
from koopmpc.control.move import Status
from koopmpc.control.plan.bounds import PlanBounds
from koopmpc.control.plan.condensed_program import CondensedPlan, CondensedProgram
from koopmpc.control.solvers import FINISHER, add_sparse, exact_turn, order_solvers
from koopmpc.control.solvers.ball import Ball, BallSolver
from koopmpc.control.solvers.base import StepSolver
from koopmpc.control.stepped.levels import HeldLevels
from koopmpc.control.stepped.priorities import PrioritySolver
from koopmpc.control.stepped.search import LevelSearch, LevelSolver

_FAR = 1e12  # length² of multipliers above which rounding shows in an input, 1 moving it to its limit


class Corrected(NamedTuple):
    """What the QP of a step ended with; `slack` and `gap` as in `Move`."""

    status: Status
    iterations: int
    solver: str
    slack: float = 0.0
    gap: float = 0.0
    is_solved: bool = False


class DeviationSolver:
    """½ wᵀH w → min with the limits of a plan t: its moves become t + deviation w.

    Soft rows, priorities, levels of inputs and a terminal ellipsoid are each a `StepSolver`.

    Parameters
    ----------
    program
        The controller's program.
    held
        The levels of the inputs now; None without levels.

    Attributes
    ----------
    qps
        The QP.
    levels
        The search over levels; None without.
    chosen
        Name of the solver that is asked first.
    fails
        While it is True, each answer of a solver is dropped.
    """

    fails = False

    def __init__(self, program: CondensedProgram, held: HeldLevels | None) -> None:
        turns = order_solvers(program.solver_name, program.solver_settings)
        self.levels = None if held is None else LevelSearch(held, program.blocks, program.model.nu)
        self.chosen = turns[0].solver.name  # who is asked first
        if self.levels is not None:
            self.qps: StepSolver = LevelSolver(program.qp, exact_turn(turns), self.levels)
        elif program.priority is not None:
            self.qps = PrioritySolver(program.qp, [exact_turn(turns), *turns[1:]], program.priority)
        elif program.ball is not None:
            self.qps = BallSolver(program.qp, turns, program.ball)
        else:
            if program.solver_name == "auto" and not program.solver_settings:
                turns = add_sparse(turns, program.qp)
            self.qps = StepSolver(program.qp, turns)

    def take(self, plan: CondensedPlan) -> None:
        """Go on with the QP of another plan of the same sizes; the warm start is kept."""
        if isinstance(self.qps, BallSolver) and plan.ball is not None:
            self.qps.change(plan.qp, plan.ball)
        else:
            self.qps.update(plan.qp)

    def accepts(
        self,
        t: Float[np.ndarray, " nt"],
        low: Float[np.ndarray, " nt"],
        high: Float[np.ndarray, " nt"],
        ball: Ball | None,
    ) -> bool:
        """Return whether a plan meets all limits, levels and a terminal ellipsoid included."""
        if not is_inside(t, low, high):
            if ball is None or not ball.contains(t):
                return False
            others = slice(0, ball.rows.start), slice(ball.rows.stop, None)
            if not all(is_inside(t[part], low[part], high[part]) for part in others):
                return False
        return self.levels is None or self.levels.accepts(t)

    def solve(
        self,
        t: Float[np.ndarray, " nt"],
        plan: CondensedPlan,
        bounds: PlanBounds,
        k: int,
        u_prev: Float[np.ndarray, " nu"],
        deadline: float | None,
    ) -> Corrected:
        """Move the plan t by the optimal deviation, and return how the QP ended; the plan stays where it failed.

        Parameters
        ----------
        bounds, k
            The limits, and the step.
        u_prev
            The input before the plan's first one; empty where it does not count.
        deadline
            The time by `perf_counter` at which the step must have ended; None for none.
        """
        limits, conflict = bounds.open_rates(k, u_prev)
        rows = None if limits is None else _scale_limits(limits, plan)
        inputs, hard_rates = bounds.first(k)[0], bounds.hard_rates(k)
        room = None if hard_rates is None else Interval(inputs.low - u_prev, inputs.high - u_prev)
        found, slack = self.qps.solve(t[: len(plan.offset)], room, deadline, rows)
        status = Status.FAILED if self.fails else found.status
        if status is not Status.OPTIMAL:
            self.qps.cool()
            return Corrected(status, found.iterations, found.solver)
        slack, U, box = max(slack, conflict), t[: len(plan.deviation)], bounds.moves(k)
        U += plan.deviation.dot(found.v)
        if slack and self.levels is None and found.solver == FINISHER.name and found.y.dot(found.y) > _FAR:
            rates = len(U) if bounds.first(k)[1] is not None else 0
            _meet_limits(U, found.y, plan, box, rows, u_prev, rates)
        np.maximum(U, box.low, out=U)
        np.minimum(U, box.high, out=U)
        if hard_rates is not None:
            first = U[: len(inputs.low)]
            first[:] = clip_input(first, inputs, hard_rates, u_prev)
        gap = 0.0 if self.levels is None else self.levels.place(U)
        status = Status.TIME_LIMIT if gap else Status.SOFTENED if slack else Status.OPTIMAL
        return Corrected(status, found.iterations, found.solver, slack, gap, is_solved=True)


def is_inside(v: Float[np.ndarray, " n"], low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"]) -> bool:
    """Return whether low ≤ v ≤ high in all entries; NaN is not. A search in bytes is five times as fast as all()."""
    return 0 not in (v >= low).tobytes() and 0 not in (v <= high).tobytes()


def _scale_limits(limits: Interval, plan: CondensedPlan) -> Interval:
    """Return limits of a plan as those of the rows of its QP."""
    source, scale = plan.qp.source, plan.qp.scale
    low, high = limits.low[source], limits.high[source]
    return Interval(np.where(low > -HUGE, low * scale, -np.inf), np.where(high < HUGE, high * scale, np.inf))


def _meet_limits(
    U: Float[np.ndarray, " moves"],
    y: Float[np.ndarray, " m"],
    plan: CondensedPlan,
    box: Interval,
    rows: Interval | None,
    u_prev: Float[np.ndarray, " nu"],
    rates: int,
) -> None:
    """Put the moves that hard limits and rates determine where these say; y are the multipliers of the QP's rows.

    Soft rows that are missed by far push by 1e12 and more. Rounding of their sum is 1e-4 of an input's range, where
    its limit is known to the last digit. `box` has the limits of the moves, `rows` those of the QP, None for its
    own; `rates` is how many changes have limits.
    """
    qp, moves, nu = plan.qp, len(U), len(u_prev)
    count = moves + rates
    low, high = (qp.low, qp.high) if rows is None else rows
    known, changes = set[int](), dict[int, float]()
    for i in np.flatnonzero(y[: np.searchsorted(qp.source, count)]).tolist():
        at = int(qp.source[i])
        if at < moves:
            U[at] = (box.high if y[i] > 0 else box.low)[at]
            known.add(at)
        elif np.isinf(qp.softness.linear[i]):
            changes[at - moves] = float((high if y[i] > 0 else low)[i] / qp.scale[i])
    for j, change in changes.items():
        if j not in known and (j < nu or j - nu in known):
            U[j] = (u_prev[j] if j < nu else U[j - nu]) + change
            known.add(j)
    for j, change in reversed(changes.items()):
        if j in known and j >= nu and j - nu not in known:
            U[j - nu] = U[j] - change
            known.add(j - nu)
