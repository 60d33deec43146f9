"""CondensedStep: the step of a plan by one matrix; where the plan meets a limit, the QP of the deviation from it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base.checks import HUGE
from koopmpc.base.values import Interval
from koopmpc.control.ask.bounds import clip_input
from koopmpc.control.ask.levels import HeldLevels
from koopmpc.control.move import Fallback, LatePlan, Move, PlanMemory, Status
from koopmpc.control.plan.condensed_program import (
    CondensedPlan,
    CondensedProgram,
    ConstantPlans,
    PlanBounds,
    StepBounds,
    is_inside,
)
from koopmpc.control.solvers import FINISHER, add_sparse, exact_turn, order_solvers
from koopmpc.control.solvers.ball import BallSolver
from koopmpc.control.solvers.base import StepSolver
from koopmpc.control.solvers.levels import LevelSearch, LevelSolver
from koopmpc.control.solvers.priorities import PrioritySolver
from koopmpc.control.step.observe import FirstInput, GivenInputs, InitialCondition, ReferenceShare
from koopmpc.estimate.observer import StateObserver

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

    def solve(
        self,
        t: Float[np.ndarray, " nt"],
        plan: CondensedPlan,
        bounds: PlanBounds,
        k: int,
        initial: InitialCondition,
        deadline: float | None,
    ) -> Corrected:
        """Move the plan t by the optimal deviation, and return how the QP ended; the plan stays where it failed.

        Parameters
        ----------
        bounds, k
            The limits, and the step.
        initial
            Where the plan starts.
        deadline
            The time by `perf_counter` at which the step must have ended; None for none.
        """
        u_prev = initial.u_prev
        limits, conflict = bounds.open_rates(k, u_prev)
        rows = None if limits is None else _scale_limits(limits, plan)
        (inputs, rates), hard_rates, box = bounds.first(k), bounds.hard_rates(k), bounds.moves(k)
        room = None if hard_rates is None else Interval(inputs.low - u_prev, inputs.high - u_prev)
        found, slack = self.qps.solve(t[: len(plan.offset)], room, deadline, rows)
        status = Status.FAILED if self.fails else found.status
        if status is not Status.OPTIMAL:
            self.qps.cool()
            return Corrected(status, found.iterations, found.solver)
        slack, U = max(slack, conflict), t[: len(plan.deviation)]
        U += plan.deviation.dot(found.v)
        if slack and self.levels is None and found.solver == FINISHER.name and found.y.dot(found.y) > _FAR:
            _meet_limits(U, found.y, plan, box, rows, u_prev, 0 if rates is None else len(U))
        np.maximum(U, box.low, out=U)
        np.minimum(U, box.high, out=U)
        if hard_rates is not None:
            first = U[: len(inputs.low)]
            first[:] = clip_input(first, inputs, hard_rates, u_prev)
        gap = 0.0 if self.levels is None else self.levels.place(U)
        status = Status.TIME_LIMIT if gap else Status.SOFTENED if slack else Status.OPTIMAL
        return Corrected(status, found.iterations, found.solver, slack, gap, is_solved=True)


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


LONG = 2**13  # entries of a preview's share of a plan from which on a bound on it saves time


class CondensedStep:
    """y, reference → Move of a `CondensedProgram`.

    Parameters
    ----------
    program, observer
        What a step needs, and what finds z and d.

    Attributes
    ----------
    initial, memory
        Where the plan starts, and the last plan.
    program, solver
        What a step needs, and the QP of the deviation.
    bounds, row
        The limits of the last step.
    """

    def __init__(self, program: CondensedProgram, observer: StateObserver) -> None:
        model, allowed = program.model, np.inf if program.time_limit is None else program.time_limit
        levels = None if program.input_levels is None else HeldLevels(program.input_levels)
        estimated = program.rule is not None
        self._nu, self.solver = model.nu, DeviationSolver(program, levels)
        self.initial = InitialCondition(
            model, observer, program.N, program.latency, with_rates=program.with_rates, estimated=estimated
        )
        self._take(program)
        self.memory = PlanMemory(model.nu, program.move_of, levels, program.latency, allowed)

    def update(self, program: CondensedProgram, model: object) -> None:
        """Go on with another program of the same sizes: the plan, the warm start and the last input are kept."""
        _ = self.memory.plan
        self._take(program)
        self.solver.take(program)
        self.initial.update(model)

    def _take(self, program: CondensedProgram) -> None:
        self.program, self._plans = program, program.plans or ConstantPlans(program)
        self._aim = ReferenceShare(program.targets, program.N, program.from_held.shape[1], program.latency)
        simple = program.plans is None and self.solver.levels is None and len(program.offset) == len(program.M)
        self._first = FirstInput(program, self._nu) if simple and program.from_reference.size >= LONG else None
        self._turn_to(program)

    def _turn_to(self, plan: CondensedPlan) -> None:
        """Go on with another plan."""
        rows, self._plan = self.program.given, plan
        self._given = None if rows is None else GivenInputs(plan.from_given, rows)

    def reset(self, x0: ArrayLike | None, u_prev: ArrayLike | None) -> None:
        """Forget all earlier steps, so that a run repeats to the bit."""
        self._k, self.row, self.bounds = 0, 0, self.program.step_bounds
        self.memory.reset(u_prev, self.bounds.first(0)[0])
        self.initial.reset(x0, self.memory.given)
        self.solver.qps.reset()

    def __call__(
        self,
        y: ArrayLike,
        reference: ArrayLike,
        applied: ArrayLike | None = None,
        w: ArrayLike | None = None,
        called: PlanBounds | None = None,
        *,
        start: float,
    ) -> Move:
        """Return the first input of the plan for measurement y.

        `called` are limits of this step alone; it began at `start` [s of `perf_counter`].
        """
        k, aim, initial = self._k, self._aim, self.initial
        aim.take(reference)
        initial.take(y, self.memory.given, applied, w)
        self.memory.take(applied)
        plan = self._plans.at(k)
        if plan is not self._plan:
            self.solver.take(plan)
            self._turn_to(plan)
        self.bounds, self.row = bounds, row = (self.program.step_bounds, k) if called is None else (called, 0)
        self._k, limits = k + 1, bounds.at(row)
        given = None if self._given is None else self._given.at(k + self.program.latency)
        alone = None if self._first is None else self._first.find(initial.known, aim, limits, given)
        if alone is not None:
            return self._return_free(*alone, start)
        t = plan.M.dot(initial.known)
        t += aim.at(plan, bounds, row, limits.reach)
        if given is not None:
            t[: len(given)] += given
        if limits.accepts(t, plan.ball, self.solver.levels):
            return self._return_free(t[: self._nu], t, start)
        return self._correct(t, plan, limits, applied, start)

    def _return_free(
        self, u: Float[np.ndarray, " nu"], plan: Float[np.ndarray, " nt"] | LatePlan, start: float
    ) -> Move:
        """Return the move of a plan that meets all limits, and is the optimum."""
        self.solver.qps.rest()
        self.memory.keep(plan, u)
        status, taken = self.memory.judge_time(Status.UNCONSTRAINED, start)
        return Move(u.copy(), status, Fallback.NONE, taken, 0, refused=self.initial.refused)

    def _correct(
        self,
        t: Float[np.ndarray, " nt"],
        plan: CondensedPlan,
        limits: StepBounds,
        applied: ArrayLike | None,
        start: float,
    ) -> Move:
        """Return the move of a step whose plan or target breaks a limit, or in which something is not finite."""
        n, bounds, row, memory = len(plan.offset), self.bounds, self.row, self.memory
        # entry by entry, as in C; a product shows in a fifth of that time that no entry can be so large
        if not (t.dot(t) < HUGE * HUGE or np.abs(t).max() < HUGE):
            self.solver.qps.cool()
            return self._fall_back(Corrected(Status.BAD_MEASUREMENT, 0, ""), None, applied, start)
        if n < len(t) and not is_inside(t[n:], limits.low[n:], limits.high[n:]):
            # the disturbance puts a target outside its limits: use the nearest one inside
            moved = self._aim.find_push(plan.disturbance @ self.initial.drive, bounds.targets(row))
            if moved is not None:
                t[:n] += plan.from_target.dot(moved)
            if limits.accepts(t[:n], plan.ball, self.solver.levels):
                return self._return_free(t[: self._nu], t, start)
        deadline = None if np.isinf(memory.allowed) else start + memory.allowed
        found = self.solver.solve(t, plan, bounds, row, self.initial, deadline)
        if not found.is_solved:
            return self._fall_back(found, t[: self._nu], applied, start)
        u = t[: self._nu]
        memory.keep(t, u)
        status, taken = memory.judge_time(found.status, start)
        return Move(
            u.copy(),
            status,
            Fallback.NONE,
            taken,
            found.iterations,
            found.slack,
            found.solver,
            refused=self.initial.refused,
            gap=found.gap,
        )

    def _fall_back(
        self, found: Corrected, free: Float[np.ndarray, " nu"] | None, applied: ArrayLike | None, start: float
    ) -> Move:
        """Return the move that replaces a failed step; `free` is the unconstrained optimum, if it is known."""
        move = self.memory.fall_back(
            found.status, start, applied, self.bounds.first(self.row), free, found.iterations, found.solver
        )
        move.refused = self.initial.refused
        return move
