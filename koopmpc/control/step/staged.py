"""StagedStep: the step of a plan over the stages of a nonlinear model: observe y, aim at the reference, plan, follow.

What finds the plan is a `PlanSolver`: real-time iteration, or a nonlinear program.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from time import perf_counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.values import Interval
from koopmpc.control.ask.bounds import clip_input, measure_violation
from koopmpc.control.ask.levels import HeldLevels
from koopmpc.control.move import Fallback, Move, PlanMemory, Status
from koopmpc.control.nonlinear.kept_plan import JudgedPlan, PlanKeeper, choose_plan, make_keeper
from koopmpc.control.nonlinear.stages import LearnedMap, StageTargets
from koopmpc.control.nonlinear.task import MovingLimits, StagedTask, StageLimits
from koopmpc.control.solvers.levels import LevelSearch
from koopmpc.control.step.aim import StageAim
from koopmpc.control.step.observe import InitialCondition
from koopmpc.estimate.disturbance import DisturbanceObserver
from koopmpc.estimate.observer import StateObserver

GOOD = (Status.UNCONSTRAINED, Status.OPTIMAL, Status.SOFTENED)
NO_DIGITS = 1e15  # at so many sizes no digit of a state is left: rounding is a fifth of a size


class PlanStart(NamedTuple):
    """Where the plan of a step starts, and what it is asked for.

    Attributes
    ----------
    s, u_prev
        s_0, and the input before the plan.
    first, conflict
        Limits of v_0, and whether rates were widened for those of u.
    box
        Limits of the inputs, (nu,) or a row a stage.
    targets, rest
        What the stages track, and the state at which the plan should end.
    e, W
        (N, nx) disturbances of x, and (N, nw) the measured ones.
    warm, deadline
        Whether the last step had a plan, and when to stop [s of `perf_counter`].
    """

    s: Float[np.ndarray, " ns"]
    u_prev: Float[np.ndarray, " nu"]
    first: Interval
    conflict: bool
    box: Interval
    targets: StageTargets
    rest: Float[np.ndarray, " nx"]
    e: Float[np.ndarray, "N nx"]
    W: Float[np.ndarray, "N nw"]
    warm: bool
    deadline: float


class StagePlan(NamedTuple):
    """The plan of a step in the s and v of its stages, how it was found, and the soft limit's violation.

    `free` is the first input of the program without limits, where it is known. A `kept` plan is that of the last step.
    """

    S: Float[np.ndarray, "N1 ns"]
    V: Float[np.ndarray, "N nu"]
    status: Status
    iterations: int
    slack: float = 0.0
    free: Float[np.ndarray, " nu"] | None = None
    kept: bool = False


class PlanSolver(ABC):
    """What finds the plan of a step, and keeps what the next step starts from."""

    @abstractmethod
    def solve(self, start: PlanStart) -> StagePlan:
        """Return the plan from a start."""

    @abstractmethod
    def go_on_from(self, S: Float[np.ndarray, "N1 ns"], V: Float[np.ndarray, "N nu"]) -> None:
        """Make this the plan from which the next step starts."""

    @abstractmethod
    def limit(self, stages: Interval) -> None:
        """Take over the limits (N, n) of [v_k; limited(s_{k+1})]."""

    @abstractmethod
    def weigh(self, Q: Float[np.ndarray, "N nr"], R: Float[np.ndarray, "N m"]) -> None:
        """Take over the diagonals that weigh the tracked outputs of s_1 … s_N, and v_0 … v_{N−1} without rates."""

    @abstractmethod
    def update(self, model: LearnedMap) -> None:
        """Go on with another θ."""


class StagedStep:
    """y, reference → Move of a `StagedTask`.

    Parameters
    ----------
    task, observer, make_solver
        What is asked, what finds x and d, and what makes the solver of plans, which gets the task and `levels`.

    Attributes
    ----------
    initial, memory
        Where the plan starts, and the last plan.
    bounds, now
        The limits of any step, and of the last one.
    aim, solver
        What the stages track, and what finds the plan.
    levels, keeper
        The search over levels of inputs, and what keeps the accepted plan; None without.
    task, fails
        What is asked; while `fails` is True, each plan of the solver is dropped.
    e
        (N, nx) disturbances of x along the last plan.
    X, U
        The last plan.
    """

    def __init__(
        self,
        task: StagedTask,
        observer: StateObserver,
        make_solver: Callable[[StagedTask, LevelSearch | None], PlanSolver],
    ) -> None:
        model, problem, o, N = task.map, task.problem, task.outputs, task.N
        levels = o.levels
        self._allowed = np.inf if task.time_limit is None else task.time_limit
        held = None if levels is None else HeldLevels(levels)
        self.initial = InitialCondition(
            model, observer, N, task.latency, with_rates=problem.with_rates, estimated=task.estimator is not None
        )
        self.memory = PlanMemory(model.nu, np.arange(N), held, task.latency, self._allowed)
        self.levels = None if held is None else LevelSearch(held, task.moves.lengths, model.nu)
        keeps = o.limits.terminal is not None and held is None
        self.keeper = make_keeper(problem, model, o.limits) if keeps else None
        self.bounds = MovingLimits(task)
        self.now = self.bounds.at(0)
        self.aim, self.solver = StageAim(task), make_solver(task, self.levels)
        self.fails, self.task = False, task
        self.e = np.zeros((N, model.nx))  # e_k = E w_k + d_k of the step

    def update(self, task: StagedTask) -> None:
        """Go on with another model of the same sizes: the plan and the last input are kept."""
        self.task = task
        self.aim.targets.update(task.map)
        self.initial.update(task.map)
        self.solver.update(task.map)
        self.aim.forget()

    def reset(self, x0: ArrayLike | None, u_prev: ArrayLike | None) -> None:
        """Forget all earlier steps, so that a run repeats to the bit."""
        self._k = 0
        self._limit(self.bounds.at(0))
        self.memory.reset(u_prev, self.now.first)
        self.initial.reset(x0, self.memory.given)
        if self.levels is not None:
            self.levels.reset()
        if self.keeper is not None:
            self.keeper.keep(None)
        self._warm = False
        self.aim.restart()
        self.aim.targets.reset()
        self._scheduled_for, self.e[:] = np.zeros(self.task.map.nw), 0.0
        self._rest = np.zeros(self.task.map.nx)  # the last e_k without its periodic part: it holds at the target

    def __call__(
        self,
        y: ArrayLike,
        reference: ArrayLike,
        applied: ArrayLike | None = None,
        w: ArrayLike | None = None,
        called: StageLimits | None = None,
        *,
        start: float,
    ) -> Move:
        """Return the first input of the plan for measurement y.

        `called` are limits of this step alone; it began at `start` [s of `perf_counter`].
        """
        self._limit(self.bounds.at(self._k) if called is None else called)
        self.initial.take(y, self.memory.given, applied, w)
        self.memory.take(applied)
        begin = self._begin(checks.numbers(reference, "reference") + 0.0, start)  # -0.0 and 0.0 are the same row
        plan = None if begin is None else self._plan(begin)
        if begin is None or plan is None:
            move = self._lose(applied, Status.BAD_MEASUREMENT, 0, start)
        elif plan.status in GOOD or plan.kept:
            move = self._follow(plan, begin, start)
        else:
            move = self._lose_plan(plan, begin, applied, start)
        self._k += 1  # a call that was refused counts as no step
        move.refused = self.initial.refused
        return move

    def _limit(self, present: StageLimits) -> None:
        """Set the limits of this step."""
        if present is not self.now:
            self.now = present
            self.solver.limit(present.stages)

    def _begin(self, reference: Float[np.ndarray, "..."], start: float) -> PlanStart | None:
        """Return where the plan starts, its limits and its targets; None where y, w or the reference is not finite."""
        initial, problem, until = self.initial, self.task.problem, start + self._allowed
        x, u_prev = initial.z, initial.u_prev if initial.u_prev.size else self.memory.given
        root = self._weigh() if problem.timed else self.task.outputs.R_root
        if not np.abs(x).max() < HUGE or (self.task.disturbed and not self._disturb()):
            return None
        targets = self.aim.at(reference, self._rest, root, until)
        if targets is None:
            return None
        s, first, conflict = problem.first_stage(x, u_prev, self.now.first)
        rest = self.aim.end.equilibrium.x
        return PlanStart(
            s, u_prev, first, conflict, self.now.inputs, targets, rest, self.e, initial.W, self._warm, until
        )

    def _weigh(self) -> Float[np.ndarray, "nu nu"]:
        """Pass the weights of the stages of this step; return S of the weight SᵀS of u_{N−1}."""
        task, o = self.task, self.task.outputs
        rated, nu = task.problem.with_rates, len(o.R)
        Q, R = o.cost.weight_rows(len(o.Q), nu, self._k + task.latency, task.N + 1)
        self.solver.weigh(*((np.hstack([Q[1:], R[:-1]]), R[:-1, :0]) if rated else (Q[1:], R[:-1])))
        return np.diag(np.sqrt(R[-2])) if rated and o.cost.R_rows is not None else o.R_root

    def _disturb(self) -> bool:
        """Write down e_k = E w_k + d_k; return whether it is finite."""
        initial, model = self.initial, self.task.map
        e = initial.W @ model.E.T
        if initial.d.size:
            e = e + initial.d
        ahead = e + initial.periodic if initial.periodic.size else e
        if not np.abs(ahead).max() < HUGE:
            return False
        self.e[:], self._rest = ahead, e[-1].copy()
        if model.scheduled:
            if not np.abs(initial.W).max() < HUGE:
                return False
            if (initial.W[-1] != self._scheduled_for).any():  # the last row of the preview holds at the target
                self._scheduled_for = initial.W[-1].copy()
                self.aim.targets.schedule(initial.W[-1])
                self.aim.forget()
        return True

    def _plan(self, begin: PlanStart) -> StagePlan:
        """Return the plan to follow: the one found, or the accepted one of the last step where that costs less."""
        plan = self.solver.solve(begin)
        if self.fails:
            plan = plan._replace(status=Status.FAILED)
        return plan if self.keeper is None else self._choose(self.keeper, plan, begin)

    def _choose(self, keeper: PlanKeeper, plan: StagePlan, begin: PlanStart) -> StagePlan:
        """Return the better of a plan and the accepted one, with which an INFEASIBLE program has a plan, after all."""
        model, problem = self.task.map, self.task.problem

        def judge(U: Float[np.ndarray, "n nu"] | None) -> JudgedPlan | None:
            x, u_prev = begin.s[: model.nx], begin.u_prev
            way = None if U is None else keeper.roll_out(model, x, U, u_prev, begin.box, begin.e, begin.W)
            if way is None:
                return None
            return keeper.judge(*problem.enter(*way, u_prev, begin.box), way[1], begin.first, begin.targets)

        status, ahead = plan.status, judge(keeper.ahead)
        found = judge(problem.leave(plan.S, plan.V, begin.box)[1]) if status in GOOD else None
        chosen = choose_plan(found, ahead)
        if chosen is None:
            keeper.skip()
            return plan
        keeper.keep(chosen.U)
        if chosen is ahead:
            self.solver.go_on_from(chosen.S, chosen.V)
            status = Status.MAX_ITERATIONS if status is Status.INFEASIBLE else status
        if status in GOOD:
            status = Status.SOFTENED if chosen.slack else Status.OPTIMAL if status is Status.SOFTENED else status
        return StagePlan(chosen.S, chosen.V, status, plan.iterations, chosen.slack, kept=chosen is ahead)

    def _follow(self, plan: StagePlan, begin: PlanStart, start: float) -> Move:
        """Return the first input of a plan, and keep the plan."""
        self._warm, memory, rates = True, self.memory, self.task.outputs.hard_rates
        self.X, self.U = self.task.problem.leave(plan.S, plan.V, begin.box)
        if self.levels is not None:
            self.levels.place_steps(self.U)
        slack, u, status = plan.slack, self.U[0], plan.status
        if rates is not None:
            u[:] = clip_input(u, self.now.first, rates, begin.u_prev)
            if begin.conflict:
                slack = max(slack, measure_violation(u - begin.u_prev, rates))
        flat = self.U.ravel()
        memory.keep(flat, flat[: len(u)])
        ended, taken = memory.judge_time(Status.SOFTENED if begin.conflict else status, start)
        fallback = Fallback.SHIFTED_PLAN if plan.kept and status not in GOOD else Fallback.NONE
        move = Move(u.copy(), ended, fallback, taken, plan.iterations, slack)
        if self.levels is not None and self.levels.gap:
            move.status, move.gap = Status.TIME_LIMIT, self.levels.gap
        return move

    def _lose_plan(self, plan: StagePlan, begin: PlanStart, applied: ArrayLike | None, start: float) -> Move:
        """Return the move of a step without a plan; the reading is to blame where the model runs away from it."""
        move = self._lose(applied, plan.status, plan.iterations, start, plan.free)
        if move.status is Status.FAILED and not self.fails:
            if not self.initial.refused and isinstance(self.initial.observer, DisturbanceObserver):
                self.initial.observer.forget()
            if self._runs_away(begin, start):
                move.status = Status.BAD_MEASUREMENT
        return move

    def _runs_away(self, begin: PlanStart, start: float) -> bool:
        """Return whether a state grows beyond NO_DIGITS of its sizes within the horizon, from x with u = 0.

        Where the cost or the limits count changes of inputs, u is the last input. Then no plan can be found, because
        of x.
        """
        model, problem = self.task.map, self.task.problem
        x, most = begin.s[: model.nx], NO_DIGITS * problem.sizes[: model.nx]
        u = np.clip(begin.u_prev * problem.with_rates, *self.task.outputs.inputs)
        for w in begin.W:
            if (np.abs(x) >= most).any():
                return True
            if np.isnan(x).any() or perf_counter() > start + self._allowed:  # a model may have NaN near its data
                return False
            x = model.step(x, u, w)
        return bool((np.abs(x) >= most).any())

    def _lose(
        self,
        applied: ArrayLike | None,
        status: Status,
        iterations: int,
        start: float,
        free: Float[np.ndarray, " nu"] | None = None,
    ) -> Move:
        """Return the move that replaces a failed step; the next step starts cold, unless this one ran out of time."""
        self._warm = status is Status.TIME_LIMIT
        if self.keeper is not None and status is Status.BAD_MEASUREMENT:
            self.keeper.skip()
        known = free is not None and bool((np.abs(free) < HUGE).all())
        limits = self.now.first, self.task.outputs.rates
        return self.memory.fall_back(status, start, applied, limits, free if known else None, iterations)
