"""What BilinearMPC and NonlinearMPC share: a step from the measurement, over the targets of its stages, to a Move."""

import copy
import io
import pickle
from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Interval, Limits, clip_input, measure_violation
from koopmpc.control.ask.terminal import HasTerminalSet, TerminalSet, read_terminal_set
from koopmpc.control.base import MPCBase
from koopmpc.control.move import Fallback, Move, Plan, Status, alone
from koopmpc.control.nonlinear.kept_plan import JudgedPlan, PlanKeeper, choose_plan
from koopmpc.control.nonlinear.learned_map import ModelOrMap, learned_map
from koopmpc.control.nonlinear.plan_solver import GOOD, PlanSolver, PlanStart, StagePlan
from koopmpc.control.nonlinear.problem import staged_problem
from koopmpc.control.nonlinear.rows import MovingLimits, StageLimits
from koopmpc.control.plan.row_targets import RowTargets
from koopmpc.control.plan.task import Moves, find_move_blocks
from koopmpc.control.plan.tracking import data_ranges, state_tracking
from koopmpc.control.solvers.levels import LevelSearch
from koopmpc.control.solvers.priorities import weigh_priorities
from koopmpc.control.step.aim import StageAim
from koopmpc.control.watching import StepMonitor, find_monitor
from koopmpc.data.episodes import Episodes
from koopmpc.estimate.disturbance import DisturbanceObserver
from koopmpc.estimate.observer import Estimator, start_observer
from koopmpc.plants.step_map import StepMap

NO_DIGITS = 1e15  # at so many sizes no digit of a state is left: rounding is a fifth of a size


class _PartsApartPickler(pickle.Pickler):
    """Pickles an object without some parts of it."""

    def __init__(self, stream: io.BytesIO, parts: Sequence[object]) -> None:
        super().__init__(stream)
        self._parts = parts

    def persistent_id(self, obj: object) -> int | None:
        """Return the place of a part that stays out; None for anything else."""
        return next((place for place, part in enumerate(self._parts) if part is obj), None)


class _PartsApartUnpickler(pickle.Unpickler):
    """Restores an object with other parts in the places of those that stayed out."""

    def __init__(self, stream: io.BytesIO, parts: Sequence[object]) -> None:
        super().__init__(stream)
        self._parts = parts

    def persistent_load(self, pid: int) -> object:
        """Return the part of this place."""
        return self._parts[pid]


class StagedMPC(MPCBase):
    """An MPC on x⁺ = F(x, u) + E w + d, whose solver works stage by stage; parameters as in `BilinearMPC`."""

    _solver: PlanSolver
    _levels: LevelSearch | None
    _limits_now: StageLimits  # of the step
    _X: Float[np.ndarray, "N1 nx"]  # of the last plan
    _U: Float[np.ndarray, "N nu"]

    def __init__(
        self,
        model: ModelOrMap,
        cost: Cost,
        limits: Limits | None,
        horizon: int,
        moves: Moves,
        estimator: Estimator | None,
        latency: int,
        time_limit: float | None,
        monitor: StepMonitor | Episodes | None,
    ) -> None:
        self._warm = False
        self._map = given = learned_map(model)
        ranges = {} if isinstance(model, StepMap) else data_ranges(model)
        o = state_tracking(model.states, model.inputs, cost, limits, given.nx, ranges, in_time=True)
        if o.limits.priority is not None:
            o = replace(o, softness=weigh_priorities(o.softness, o.limits, model.states, checks.article(self)))
        self._outputs, self._steps = o, 0  # since reset: the row of limits and of weights in time
        blocks = find_move_blocks(moves, horizon, model.inputs)
        self._problem = staged_problem(given, o, blocks)
        self._moving_limits = MovingLimits(o, self._problem, model.states, model.inputs, latency)
        self._limits_now = self._moving_limits.at(0, None)
        super().__init__(
            model.dt,
            given,
            o,
            blocks,
            start_observer(estimator, given, checks.count(horizon, "horizon")),
            estimator,
            latency,
            time_limit,
            monitor=None if monitor is None else find_monitor(monitor, model),
        )
        self._levels = None if self._held is None else LevelSearch(self._held, self._blocks, self.nu)
        self._keeper = None if o.limits.terminal is None else self._make_keeper(o.limits.terminal)
        self._disturbed = estimator is not None or given.nw > 0
        rows = RowTargets(given, self.cost, o, 10 * self._N)
        self._aim = StageAim(rows, o, self._problem, latency, disturbed=self._disturbed)
        self._last_root = o.R_root  # of the weight of u_{N−1}
        self._scheduled_for, self._e = (
            np.zeros(given.nw),
            np.zeros((self._N, given.nx)),
        )  # e_k = E w_k + d_k of the step
        self._rest = np.zeros(given.nx)  # the last e_k without what is periodic in it, which holds at the target

    def _make_keeper(self, given: TerminalSet | HasTerminalSet) -> PlanKeeper | None:
        """Return what keeps the accepted plan; None where the set is soft or has no feedback, or moves are not free."""
        end, problem = read_terminal_set(given), self._problem
        if end.feedback is None or self._outputs.limits.terminal_slack is not None or self._levels is not None:
            return None
        return (
            PlanKeeper(problem, self._map, end) if problem.free.all() and not (problem.own or problem.timed) else None
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> "StagedMPC":
        """Return a copy with solvers of its own: CasADi's copies share one, and two threads in one end the process.

        An estimator of the user's own, and its observer, are copied by deepcopy: their classes may be local.
        """
        candidates = (part for part in (self._estimator, self.observer) if part is not None)
        parts = [part for part in candidates if not type(part).__module__.startswith("koopmpc.")]
        stream = io.BytesIO()
        _PartsApartPickler(stream, parts).dump(self)
        stream.seek(0)
        return _PartsApartUnpickler(stream, copy.deepcopy(parts, memo)).load()

    @property
    def model(self) -> ModelOrMap:
        """The model as it was given."""
        return self._map.model

    @property
    def step_map(self) -> StepMap:
        """The model as a map, x⁺ = F(x, u)."""
        return self.model if isinstance(self.model, StepMap) else self.model.step_map()

    @alone
    def reset(self, x0: ArrayLike | None = None, u_prev: ArrayLike | None = None) -> None:
        """Forget all earlier steps; rates count from `u_prev`, which is held if the first step fails."""
        self._steps = 0
        self._move_limits(None)
        super().reset(x0, u_prev)
        if self._levels is not None:
            self._levels.reset()
        if self._keeper is not None:
            self._keeper.keep(None)
        self._warm = False
        self._aim.restart()
        self._aim.targets.reset()
        self._scheduled_for = np.zeros(self._map.nw)
        self._e[:] = 0.0
        self._rest = np.zeros(self._map.nx)

    @alone
    def update(self, model: ModelOrMap) -> None:
        """Go on with new A, B, N, C and E of the same lifting: the plan and the last input are kept.

        Raises
        ------
        DataError
            The model is of another kind, has another lifting, dt, states, inputs or disturbances, or is a StepMap.
        """
        self._map = self._map.replace_model(model)
        self._aim.targets.update(self._map)
        self._initial.update(self._map)
        self._solver.update(self._map)
        if self._watch is not None:
            self._watch.update(self._map)
        self._aim.forget()

    def plan(self) -> Plan | None:
        """Return the plan of the last call; None where it had none."""
        return Plan(self._X[:, : self._map.ny].copy(), self._U.copy()) if self._planned else None

    @alone
    def __call__(
        self,
        y: ArrayLike,
        reference: ArrayLike,
        applied: ArrayLike | None = None,
        w: ArrayLike | None = None,
        limits: Limits | None = None,
    ) -> Move:
        """Return the first input of the plan for state y; arguments as for KoopmanMPC."""
        start = perf_counter()
        self._move_limits(limits)
        move = self._step(y, reference, applied, w, start)
        self._steps += 1  # a call that was refused counts as no step
        move.refused = self._initial.refused
        watch = self._watch
        return move if watch is None else self._judge_step(watch, move, applied, start)

    def read_limits(self, limits: Limits) -> Limits:
        """Return the limits of a call with arrays in place of names.

        Raises
        ------
        DataError
            They differ from the controller's own in more than bounds.
        """
        return self._moving_limits.read(limits)

    def check_limits(self, limits: Limits) -> None:
        """Raise where limits of a call cross, have no row in the stages, or too few rows."""
        self._moving_limits.check(limits)

    def _move_limits(self, limits: Limits | None) -> None:
        """Set the limits of this step: those of the call, or the controller's own."""
        present = self._moving_limits.at(self._steps, limits)
        if present is not self._limits_now:
            self._limits_now = present
            self._solver.limit(present.stages)

    def _present_limits(self) -> tuple[Interval, Interval | None]:
        return self._limits_now.first, self._rates

    def _step(
        self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None, w: ArrayLike | None, start: float
    ) -> Move:
        self._initial.take(y, self._memory.given, applied, w)
        self._memory.take(applied)
        begin = self._begin(checks.numbers(reference, "reference") + 0.0, start)  # -0.0 and 0.0 are the same row
        if begin is None:
            return self._lose(applied, Status.BAD_MEASUREMENT, 0, start)
        plan, kept = self._solver.solve(begin), False
        if self.solver_fails:
            plan = plan._replace(status=Status.FAILED)
        if self._keeper is not None:
            plan, kept = self._choose(self._keeper, plan, begin)
        if plan.status not in GOOD and not kept:
            return self._lose_plan(plan, begin, applied, start)
        return self._follow(plan, begin, start, kept=kept)

    def _begin(self, reference: Float[np.ndarray, "..."], start: float) -> PlanStart | None:
        """Return where the plan starts, its limits and its targets; None where y, w or the reference is not finite."""
        initial = self._initial
        x, u_prev = initial.z, initial.u_prev if initial.u_prev.size else self._memory.given
        if self._problem.timed:
            self._pass_weights()
        if not np.abs(x).max() < HUGE or (self._disturbed and not self._disturb()):
            return None
        targets = self._aim.at(reference, self._rest, self._last_root, start + self._allowed)
        if targets is None:
            return None
        s, first, conflict = self._problem.first_stage(x, u_prev, self._limits_now.first)
        box, rest = self._limits_now.inputs, self._aim.end.equilibrium.x
        until = start + self._allowed
        return PlanStart(s, u_prev, first, conflict, box, targets, rest, self._e, initial.W, self._warm, until)

    def _follow(self, plan: StagePlan, begin: PlanStart, start: float, *, kept: bool) -> Move:
        """Return the first input of a plan, and keep the plan."""
        self._warm = True
        self._X, self._U = self._problem.leave(plan.S, plan.V, begin.box)
        if self._levels is not None:
            self._levels.place_steps(self._U)
        slack, u, status = plan.slack, self._U[0], plan.status
        if self._hard_rates is not None:
            u[:] = clip_input(u, self._limits_now.first, self._hard_rates, begin.u_prev)
            if begin.conflict:
                slack = max(slack, measure_violation(u - begin.u_prev, self._hard_rates))
        self._keep(self._U.ravel())
        move = self._move(u.copy(), Status.SOFTENED if begin.conflict else status, plan.iterations, start, slack)
        if self._levels is not None and self._levels.gap:
            move.status, move.gap = Status.TIME_LIMIT, self._levels.gap
        if kept and status not in GOOD:
            move.fallback = Fallback.SHIFTED_PLAN
        return move

    def _lose_plan(self, plan: StagePlan, begin: PlanStart, applied: ArrayLike | None, start: float) -> Move:
        """Return the move of a step without a plan; the reading is to blame where the model runs away from it."""
        move = self._lose(applied, plan.status, plan.iterations, start, plan.free)
        if move.status is Status.FAILED and not self.solver_fails:
            if not self._initial.refused and isinstance(self._initial.observer, DisturbanceObserver):
                self._initial.observer.forget()
            if self._runs_away(begin.s[: self._map.nx], begin.u_prev, start):
                move.status = Status.BAD_MEASUREMENT
        return move

    def _choose(self, keeper: PlanKeeper, plan: StagePlan, begin: PlanStart) -> tuple[StagePlan, bool]:
        """Return the plan to follow: the one found, or the accepted one of the last step where that costs less.

        The last entry says whether it is the accepted one. Then an INFEASIBLE program has a plan, after all, and counts
        as not solved to its tolerance.
        """

        def judge(U: Float[np.ndarray, "n nu"] | None) -> JudgedPlan | None:
            x, u_prev = begin.s[: self._map.nx], begin.u_prev
            way = None if U is None else keeper.roll_out(self._map, x, U, u_prev, begin.box, begin.e, begin.W)
            if way is None:
                return None
            return keeper.judge(*self._problem.enter(*way, u_prev, begin.box), way[1], begin.first, begin.targets)

        status, ahead = plan.status, judge(keeper.ahead)
        found = judge(self._problem.leave(plan.S, plan.V, begin.box)[1]) if status in GOOD else None
        chosen = choose_plan(found, ahead)
        if chosen is None:
            keeper.skip()
            return plan, False
        keeper.keep(chosen.U)
        if chosen is ahead:
            self._solver.go_on_from(chosen.S, chosen.V)
            status = Status.MAX_ITERATIONS if status is Status.INFEASIBLE else status
        if status in GOOD:
            status = Status.SOFTENED if chosen.slack else Status.OPTIMAL if status is Status.SOFTENED else status
        return StagePlan(chosen.S, chosen.V, status, plan.iterations, chosen.slack), chosen is ahead

    def _runs_away(self, x: Float[np.ndarray, " nx"], u_prev: Float[np.ndarray, " nu"], start: float) -> bool:
        """Return whether a state grows beyond NO_DIGITS of its sizes within the horizon, from x with u = 0.

        Where the cost or the limits count changes of inputs, u is the last input. Then no plan can be found, because
        of x.
        """
        u, most = np.clip(u_prev * self._with_rates, *self._outputs.inputs), NO_DIGITS * self._problem.sizes[: len(x)]
        for w in self._initial.W:
            if (np.abs(x) >= most).any():
                return True
            if np.isnan(x).any() or perf_counter() > start + self._allowed:  # a model may have NaN near its data
                return False
            x = self._map.step(x, u, w)
        return bool((np.abs(x) >= most).any())

    def _pass_weights(self) -> None:
        """Pass the weights of the stages of this step."""
        first, o = self._steps + self._latency, self._outputs
        Q, R = self.cost.weight_rows(len(o.Q), self.nu, first, self._N + 1)
        if self._with_rates and self.cost.R_rows is not None:
            self._last_root = np.diag(np.sqrt(R[-2]))
        self._solver.weigh(*((np.hstack([Q[1:], R[:-1]]), R[:-1, :0]) if self._with_rates else (Q[1:], R[:-1])))

    def _disturb(self) -> bool:
        """Write down e_k = E w_k + d_k; return whether it is finite."""
        initial = self._initial
        e = initial.W @ self._map.E.T
        if initial.d.size:
            e = e + initial.d
        ahead = e + initial.periodic if initial.periodic.size else e
        if not np.abs(ahead).max() < HUGE:
            return False
        self._e[:], self._rest = ahead, e[-1].copy()
        if self._map.scheduled:
            if not np.abs(initial.W).max() < HUGE:
                return False
            if (initial.W[-1] != self._scheduled_for).any():  # the last row of the preview holds at the target
                self._scheduled_for = initial.W[-1].copy()
                self._aim.targets.schedule(initial.W[-1])
                self._aim.forget()
        return True

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
        if self._keeper is not None and status is Status.BAD_MEASUREMENT:
            self._keeper.skip()
        known = free is not None and bool((np.abs(free) < HUGE).all())
        return self._fail(free if known else None, applied, status, iterations, start)
