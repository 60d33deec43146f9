"""What BilinearMPC and NonlinearMPC share: a step from the measurement, over the targets of its stages, to a Move."""

from abc import abstractmethod
from dataclasses import replace
from time import perf_counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.checks import HUGE
from koopmpc.control.base import MPCBase
from koopmpc.control.cost import Cost, data_ranges, state_tracking
from koopmpc.control.in_time.preview import check_bounds_alone
from koopmpc.control.limits import Interval, Limits, clip_input, measure_violation
from koopmpc.control.move import Fallback, Move, Plan, Status, alone
from koopmpc.control.nonlinear.problem import ModelOrMap, StageTargets, learned_map, staged_problem
from koopmpc.control.nonlinear.rows import StageLimits, check_rows, find_stage_limits
from koopmpc.control.plan.row_targets import RowTargets
from koopmpc.control.step.aim import StageAim
from koopmpc.control.stepped.blocks import Moves
from koopmpc.control.stepped.priorities import weigh_priorities
from koopmpc.control.stepped.search import LevelSearch
from koopmpc.control.terminal.kept_plan import JudgedPlan, PlanKeeper, choose_plan
from koopmpc.control.terminal.sets import HasTerminalSet, TerminalSet, read_terminal_set
from koopmpc.control.watching import StepMonitor, find_monitor
from koopmpc.data.episodes import Episodes
from koopmpc.estimate.disturbance import DisturbanceObserver
from koopmpc.estimate.observer import Estimator, start_observer
from koopmpc.plants.step_map import StepMap

GOOD = (Status.UNCONSTRAINED, Status.OPTIMAL, Status.SOFTENED)
NO_DIGITS = 1e15  # at so many sizes no digit of a state is left: rounding is a fifth of a size


class StagePlan(NamedTuple):
    """The plan of a step in the s and v of its stages, how it was found, and the soft limit's violation.

    `free` is the first input of the program without limits, where it is known.
    """

    S: Float[np.ndarray, "N1 ns"]
    V: Float[np.ndarray, "N nu"]
    status: Status
    iterations: int
    slack: float = 0.0
    free: Float[np.ndarray, " nu"] | None = None


class StagedMPC(MPCBase):
    """An MPC on x⁺ = F(x, u) + E w + d, whose solver works stage by stage; parameters as in `BilinearMPC`."""

    _e: Float[np.ndarray, "N nx"]  # e_k = E w_k + d_k of the step
    _rest: Float[np.ndarray, " nx"]  # the last e_k without what is periodic in it, which holds at the target
    _targets: StageTargets  # of the step
    _box: Interval  # limits of the inputs of the step, one for all stages or a row each
    _at_call: Limits
    _called_with: Limits | None
    _levels: LevelSearch | None
    _last_root: Float[np.ndarray, "nu nu"]  # root of the weight of u_{N−1}
    _steps: int  # since reset: the row of limits and of weights in time
    _timed: bool  # whether the controller's own limits move in time
    _warm: bool  # whether the next step starts from the plan of the last one

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
        self._outputs, self._box, self._steps, self._called_with = o, o.inputs, 0, None
        self._timed = o.limits.in_time
        super().__init__(
            model.dt,
            given,
            o,
            moves,
            horizon,
            model.inputs,
            start_observer(estimator, given, checks.count(horizon, "horizon")),
            estimator,
            latency,
            time_limit,
            stagewise=True,
            monitor=None if monitor is None else find_monitor(monitor, model),
        )
        self._problem = staged_problem(given, o, self._moves)
        self._levels = None if self._held is None else LevelSearch(self._held, self._blocks, self.nu)
        self._keeper = None if o.limits.terminal is None else self._make_keeper(o.limits.terminal)
        self._disturbed = estimator is not None or given.nw > 0
        rows = RowTargets(given, self.cost, o, 10 * self._N)
        self._aim = StageAim(rows, o, self._problem, latency, disturbed=self._disturbed)
        self._last_root = o.R_root
        self._scheduled_for, self._rest = np.zeros(given.nw), np.zeros(given.nx)
        if self._timed:
            check_rows(self.limits, o, self._problem, model.inputs, None)

    def _make_keeper(self, given: TerminalSet | HasTerminalSet) -> PlanKeeper | None:
        """Return what keeps the accepted plan; None where the set is soft or has no feedback, or moves are not free."""
        end, problem = read_terminal_set(given), self._problem
        if end.feedback is None or self._outputs.limits.terminal_slack is not None or self._levels is not None:
            return None
        return (
            PlanKeeper(problem, self._map, end) if problem.free.all() and not (problem.own or problem.timed) else None
        )

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
        self._steps, inputs = 0, self._outputs.inputs
        if self._timed:
            low, high = self.limits.input_rows(self.nu, self._latency, 1)
            self._box = Interval(np.maximum(low, inputs.low), np.minimum(high, inputs.high))
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
        if limits is not None or self._timed or self._box is not self._outputs.inputs:
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
        model = self._map.model
        return check_bounds_alone(limits, self.limits, tuple(model.states), tuple(model.inputs))

    def check_limits(self, limits: Limits) -> None:
        """Raise where limits of a call cross, have no row in the stages, or too few rows."""
        check_rows(limits, self._outputs, self._problem, self.model.inputs, self._N + self._latency)

    def _move_limits(self, limits: Limits | None) -> None:
        """Set the limits of this step: those of the call, or the controller's own."""
        outputs, problem, own, first = self._outputs, self._problem, self.limits, self._steps
        if limits is not None:
            if limits is not self._called_with:
                own = self.read_limits(limits)
                self.check_limits(own)
                self._called_with, self._at_call = limits, own
            own, first = self._at_call, 0
        elif not self._timed:
            self._box = outputs.inputs
            self._limit(None)
            return
        found = find_stage_limits(own, outputs, problem, first + self._latency, problem.stage_limits)
        self._box = found.inputs
        self._limit(found)

    @abstractmethod
    def _limit(self, limits: StageLimits | None) -> None:
        """Take over the limits of a step; None for those of the constructor."""

    def _first_box(self) -> Interval:
        """Return the limits of the first input."""
        return self._box if self._box.low.ndim == 1 else Interval(self._box.low[0], self._box.high[0])

    def _present_limits(self) -> tuple[Interval, Interval | None]:
        return self._first_box(), self._rates

    def _step(
        self, y: ArrayLike, reference: ArrayLike, applied: ArrayLike | None, w: ArrayLike | None, start: float
    ) -> Move:
        initial = self._initial
        initial.take(y, self._given, applied, w)
        self._count_held(applied)
        x, u_prev = initial.z, initial.u_prev if initial.u_prev.size else self._given
        s, first, conflict = self._first_stage(x, u_prev)
        target = checks.numbers(reference, "reference") + 0.0  # -0.0 and 0.0 are the same row
        if self._problem.timed:
            self._pass_weights()
        known = np.abs(x).max() < HUGE and (not self._disturbed or self._disturb())
        targets = self._aim.at(target, self._rest, self._last_root, start + self._allowed) if known else None
        if targets is None:
            return self._lose(applied, Status.BAD_MEASUREMENT, 0, start)
        self._targets = targets
        found = self._solve(s, u_prev, first, start + self._allowed)
        status, kept = Status.FAILED if self.solver_fails else found.status, False
        if self._keeper is not None:
            found, status, kept = self._choose(self._keeper, found._replace(status=status), s, u_prev, first)
        if status not in GOOD and not kept:
            move = self._lose(applied, status, found.iterations, start, found.free)
            if move.status is Status.FAILED and not self.solver_fails:
                if not initial.refused and isinstance(initial.observer, DisturbanceObserver):
                    initial.observer.forget()
                if self._runs_away(x, u_prev, start):
                    move.status = Status.BAD_MEASUREMENT
            return move
        self._warm = True
        self._X, self._U = self._trajectory(found.S, found.V)
        if self._levels is not None:
            self._levels.place_steps(self._U)
        slack, u = found.slack, self._U[0]
        if self._hard_rates is not None:
            u[:] = clip_input(u, self._first_box(), self._hard_rates, u_prev)
            if conflict:
                slack = max(slack, measure_violation(u - u_prev, self._hard_rates))
        self._keep(self._U.ravel())
        move = self._move(u.copy(), Status.SOFTENED if conflict else status, found.iterations, start, slack)
        if self._levels is not None and self._levels.gap:
            move.status, move.gap = Status.TIME_LIMIT, self._levels.gap
        if kept and status not in GOOD:
            move.fallback = Fallback.SHIFTED_PLAN
        return move

    def _choose(
        self,
        keeper: PlanKeeper,
        found: StagePlan,
        s: Float[np.ndarray, " ns"],
        u_prev: Float[np.ndarray, " nu"],
        first: Interval,
    ) -> tuple[StagePlan, Status, bool]:
        """Return the plan to follow: the one found, or the accepted one of the last step where that costs less.

        The last entry says whether it is the accepted one. Then an INFEASIBLE program has a plan, after all, and counts
        as not solved to its tolerance.
        """

        def judge(U: Float[np.ndarray, "n nu"] | None) -> JudgedPlan | None:
            way = None if U is None else keeper.roll_out(self._map, s[: self._map.nx], U, u_prev, self._box, self._e, W)
            return None if way is None else keeper.judge(*self._stages(*way, u_prev), way[1], first, self._targets)

        W, status = self._initial.W, found.status
        kept = judge(keeper.ahead)
        chosen = choose_plan(judge(self._trajectory(found.S, found.V)[1]) if status in GOOD else None, kept)
        if chosen is None:
            keeper.skip()
            return found, status, False
        keeper.keep(chosen.U)
        if chosen is kept:
            self._go_on_from(chosen.S, chosen.V)
            status = Status.MAX_ITERATIONS if status is Status.INFEASIBLE else status
        if status in GOOD:
            status = Status.SOFTENED if chosen.slack else Status.OPTIMAL if status is Status.SOFTENED else status
        return StagePlan(chosen.S, chosen.V, status, found.iterations, chosen.slack), status, chosen is kept

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

    @abstractmethod
    def _go_on_from(self, S: Float[np.ndarray, "N1 ns"], V: Float[np.ndarray, "N nu"]) -> None:
        """Make this the plan from which the next step starts."""

    @abstractmethod
    def _solve(
        self,
        s: Float[np.ndarray, " ns"],
        u_prev: Float[np.ndarray, " nu"],
        first: Interval,
        deadline: float,
    ) -> StagePlan:
        """Return the plan from s on, with v_0 inside `first`."""

    def _pass_weights(self) -> None:
        """Pass the weights of the stages of this step."""
        first, o = self._steps + self._latency, self._outputs
        Q, R = self.cost.weight_rows(len(o.Q), self.nu, first, self._N + 1)
        if self._with_rates and self.cost.R_rows is not None:
            self._last_root = np.diag(np.sqrt(R[-2]))
        self._weigh(*((np.hstack([Q[1:], R[:-1]]), R[:-1, :0]) if self._with_rates else (Q[1:], R[:-1])))

    @abstractmethod
    def _weigh(self, Q: Float[np.ndarray, "N nr"], R: Float[np.ndarray, "N m"]) -> None:
        """Take over the diagonals that weigh the tracked outputs of s_1 … s_N, and v_0 … v_{N−1} without rates."""

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
            self._schedule(initial.W)
            if (initial.W[-1] != self._scheduled_for).any():  # the last row of the preview holds at the target
                self._scheduled_for = initial.W[-1].copy()
                self._aim.targets.schedule(initial.W[-1])
                self._aim.forget()
        return True

    @abstractmethod
    def _schedule(self, W: Float[np.ndarray, "N nw"]) -> None:
        """Take over the measured disturbances that multiply the state, a row a stage."""

    def _first_stage(
        self, x: Float[np.ndarray, " nx"], u_prev: Float[np.ndarray, " nu"]
    ) -> tuple[Float[np.ndarray, " ns"], Interval, bool]:
        """Return s_0, the limits of v_0, and whether rates were widened: where they exclude those of u, these win."""
        low, high = self._problem.inputs
        inputs = self._first_box()
        if not self._with_rates:
            return x, inputs, False
        widened = Interval(np.minimum(low, inputs.high - u_prev), np.maximum(high, inputs.low - u_prev))
        reach = 1e-9 * (np.abs(u_prev) + self._problem.input_sizes)
        conflict = bool((widened.low < low - reach).any() or (widened.high > high + reach).any())
        return np.concatenate([x, u_prev, np.zeros(len(self._problem.soft_rates))]), widened, conflict

    def _stages(
        self,
        X: Float[np.ndarray, "N1 nx"],
        U: Float[np.ndarray, "N nu"],
        u_prev: Float[np.ndarray, " nu"],
    ) -> tuple[Float[np.ndarray, "N1 ns"], Float[np.ndarray, "N nu"]]:
        """Return a plan of states and inputs in s and v, its inputs inside their limits and held in each block."""
        low, high = self._box
        U = np.minimum(np.maximum(U, low), high)
        if not self._with_rates:
            return X, U
        before = np.vstack([u_prev, U[self._problem.held_from, np.arange(self.nu)]])
        V = np.diff(before, axis=0)
        late = np.vstack([np.zeros(self.nu), V])[:, self._problem.soft_rates]
        return np.hstack([X, before, late]), V

    def _trajectory(
        self, S: Float[np.ndarray, "N1 ns"], V: Float[np.ndarray, "N nu"]
    ) -> tuple[Float[np.ndarray, "N1 nx"], Float[np.ndarray, "N nu"]]:
        """Return the states and the inputs of a plan, the inputs inside their limits."""
        nx, (low, high) = self._map.nx, self._box
        if self._with_rates:
            V = S[0, nx : nx + self.nu] + np.cumsum(V * self._problem.free[:, None], axis=0)
        return S[:, :nx], np.minimum(np.maximum(V, low), high)

    def _rests_on_levels(self, S: Float[np.ndarray, "N1 ns"], V: Float[np.ndarray, "N nu"]) -> bool:
        """Return whether a plan that was found without levels is on them."""
        assert self._levels is not None, "only asked where inputs have levels"
        return self._levels.accepts(self._trajectory(S, V)[1][self._problem.free].ravel())

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
