"""CondensedStep: the step of a plan by one matrix; a QP where the plan meets a limit."""

from time import perf_counter

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base.checks import HUGE
from koopmpc.control.move import Fallback, Move, Status
from koopmpc.control.plan.bounds import PlanBounds, StepBounds
from koopmpc.control.plan.condensed_program import CondensedPlan, CondensedProgram, ConstantPlans
from koopmpc.control.step.deviation import Corrected, DeviationSolver, is_inside
from koopmpc.control.step.fallback import LatePlan, PlanMemory
from koopmpc.control.step.first_input import FirstInput
from koopmpc.control.step.observe import InitialCondition
from koopmpc.control.step.share import GivenInputs, ReferenceShare
from koopmpc.control.stepped.levels import HeldLevels
from koopmpc.estimate.observer import StateObserver

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
    solver
        The QP of the deviation.
    bounds, row
        The limits of the last step.
    """

    def __init__(self, program: CondensedProgram, observer: StateObserver) -> None:
        model, allowed = program.model, np.inf if program.time_limit is None else program.time_limit
        levels = None if program.input_levels is None else HeldLevels(program.input_levels)
        estimated = program.rule is not None
        self.initial = InitialCondition(
            model, observer, program.N, program.latency, with_rates=program.with_rates, estimated=estimated
        )
        self.memory = PlanMemory(model.nu, program.move_of, levels, program.latency, allowed)
        self.solver = DeviationSolver(program, levels)
        self._nu = model.nu
        self._take(program)

    def update(self, program: CondensedProgram, model: object) -> None:
        """Go on with another program of the same sizes: the plan, the warm start and the last input are kept."""
        _ = self.memory.plan
        self._take(program)
        self.solver.take(program)
        self.initial.update(model)

    def _take(self, program: CondensedProgram) -> None:
        self.program, self._plans = program, program.plans or ConstantPlans(program)
        self._aim = ReferenceShare(program.targets, program.N, program.nr, program.latency)
        simple = program.plans is None and self.solver.levels is None and len(program.offset) == len(program.M)
        self._first = FirstInput(program, self._nu) if simple and program.from_reference.size >= LONG else None
        self._turn_to(program)

    def _turn_to(self, plan: CondensedPlan) -> None:
        """Go on with another plan."""
        rows, self._plan = self.program.given, plan
        self._given = None if rows is None else GivenInputs(plan.from_given, rows, tabled=self.program.plans is None)

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
    ) -> Move:
        """Return the first input of the plan for measurement y; `called` are limits of this step alone."""
        start, k, aim, initial = perf_counter(), self._k, self._aim, self.initial
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
        if self.solver.accepts(t, limits.low, limits.high, plan.ball):
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
            if self.solver.accepts(t[:n], limits.low[:n], limits.high[:n], plan.ball):
                return self._return_free(t[: self._nu], t, start)
        deadline = None if np.isinf(memory.allowed) else start + memory.allowed
        found = self.solver.solve(t, plan, bounds, row, self.initial.u_prev, deadline)
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
