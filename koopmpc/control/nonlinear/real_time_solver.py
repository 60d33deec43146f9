"""The plan of a BilinearMPC: linearisations of the last plan, or of the cheapest of several starts."""

from collections.abc import Iterator
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from jaxtyping import Float

from koopmpc.base.values import Interval
from koopmpc.control.ask.bounds import SOFTENED
from koopmpc.control.move import Status
from koopmpc.control.nonlinear.condensed_stages import StageLevels
from koopmpc.control.nonlinear.iteration import NEAR, RealTimeIteration
from koopmpc.control.nonlinear.stages import LearnedMap
from koopmpc.control.nonlinear.task import StagedTask
from koopmpc.control.solvers.levels import LevelSearch
from koopmpc.control.step.staged import GOOD, PlanSolver, PlanStart, StagePlan
from koopmpc.plants.step_map import StepMap

SETTLED = 1e-6  # a plan is a solution when no input and no state moves by more than this share of its size


@dataclass(frozen=True)
class _Effort:
    """How long plans are improved, and when one is good.

    Attributes
    ----------
    each, first
        Linearisations from each start of a first step, and further ones of the best of these plans, at most.
    spent
        After so much effort of the solver no further start, and no further linearisation from one, begins.
    endings
        Further linearisations, at most, of a plan that breaks a hard limit or misses its terminal set.
    nearly
        `SETTLED` of a plan that is compared with others.
    followed
        A plan follows the model whose defects are below this share of the range of their state.
    far
        Begin a new plan if y is more than this many state sizes from the expected state.
    met
        A plan ends in its terminal set if the value of the set is at most this much above 1.
    passes, on_model
        Linearisations with levels, at most; fewer if the plan misses each state of the model by less than this share of
        its size.
    """

    each: int = 12
    first: int = 10
    spent: int = 300
    endings: int = 20
    nearly: float = 1e-2
    followed: float = 0.02
    far: float = 3.0
    met: float = 1e-8
    passes: int = 4
    on_model: float = 1e-6


EFFORT = _Effort()


class RealTimeSolver(PlanSolver):
    """Real-time iteration from the last plan, moved on by a step; from several starts where that has lost the plant.

    Parameters
    ----------
    iteration, task
        One linearisation and its quadratic program, and what is asked.
    sqp_iterations
        Linearisations a step.
    levels
        The search over levels, where inputs have some.
    """

    def __init__(
        self, iteration: RealTimeIteration, task: StagedTask, sqp_iterations: int, levels: LevelSearch | None
    ) -> None:
        self.iteration, self._problem, self._sqp_iterations = iteration, task.problem, sqp_iterations
        self._inputs = task.outputs.inputs
        self._iterations = self._spent = 0  # of the solver in this step, and their effort
        self._on_levels = None if levels is None else StageLevels(levels, rated=task.problem.with_rates)
        self.update(task.map)

    def update(self, model: LearnedMap) -> None:
        """Go on with another θ."""
        self._map = model
        self.iteration.set_theta(model.theta)

    def limit(self, stages: Interval) -> None:
        """Take over the limits (N, n) of [v_k; limited(s_{k+1})]."""
        self.iteration.low[:], self.iteration.high[:] = stages

    def weigh(self, Q: Float[np.ndarray, "N nr"], R: Float[np.ndarray, "N m"]) -> None:
        """Take over the diagonals that weigh the tracked outputs of s_1 … s_N, and v_0 … v_{N−1} without rates."""
        self.iteration.set_weights(Q, R)

    def go_on_from(self, S: Float[np.ndarray, "N1 ns"], V: Float[np.ndarray, "N nu"]) -> None:
        """Make this the plan from which the next step starts."""
        self.iteration.X[:], self.iteration.U[:] = S, V

    def solve(self, start: PlanStart) -> StagePlan:
        """Return the plan from a start: by linearisations of the last plan, or of several starts."""
        iteration, nx = self.iteration, self._map.nx
        self._iterations = self._spent = 0
        iteration.multipliers, iteration.e[:, :nx] = None, start.e
        if self._map.scheduled:
            iteration.W[:] = start.W
        if self._problem.with_rates:
            nu = len(start.u_prev)
            iteration.low[0, :nu], iteration.high[0, :nu] = start.first
        status = Status.FAILED
        jump = np.abs(start.s[:nx] - iteration.X[1, :nx]) / self._problem.sizes[:nx]  # from the state that was expected
        if start.warm and jump.max() <= EFFORT.far:
            self._shift(start)
            status = self._improve(start, self._sqp_iterations)
            if iteration.limits_outputs:
                status = self._meet_limits(status, start)
        if status not in GOOD and status is not Status.TIME_LIMIT:  # there is no plan, or it has lost the plant
            status = self._begin_anew(start)
            if iteration.limits_outputs:
                status = self._meet_limits(status, start)
        if self._problem.ends and status in GOOD:
            status = self._meet_end(status, start)
        if self._on_levels is not None and status in GOOD and not self._rests_on_levels(start.box):
            status = self._put_on_levels(self._on_levels, start)
        free = iteration.without_limits + (start.u_prev if self._problem.with_rates else 0.0)
        return StagePlan(iteration.X, iteration.U, status, self._iterations, iteration.slack, free)

    def _rests_on_levels(self, box: Interval) -> bool:
        """Return whether the plan is on levels although it was found without them."""
        U = self._problem.leave(self.iteration.X, self.iteration.U, box)[1]
        return self._on_levels is not None and self._on_levels.search.accepts(U[self._problem.free].ravel())

    def _put_on_levels(self, levels: StageLevels, start: PlanStart) -> Status:
        """Put the plan on levels; return how that ended.

        Each pass linearises at the plan of the last one, and they end where the levels stay.
        """
        iteration, search, kept, broken = self.iteration, levels.search, None, 0.0
        for _ in range(EFFORT.passes):
            found = iteration.step(start.s, start.targets, start.deadline, levels)
            self._iterations += found.iterations
            if found.status is not Status.OPTIMAL:
                search.repeats = False
                if kept is None:
                    return found.status
                search.index, search.gap = kept
                break
            same = kept is not None and bool((kept[0] == search.index).all())
            kept = search.index, search.gap
            iteration.X[0] = start.s
            iteration.X[1:] += found.X
            iteration.U += found.U
            broken = iteration.note_slack(found)
            if same or iteration.find_defect() < EFFORT.on_model:
                break
            search.repeats = True
        search.repeats = False
        return Status.SOFTENED if broken else Status.OPTIMAL

    def _meet_limits(self, status: Status, start: PlanStart) -> Status:
        """Linearise on until the plan keeps its hard limits; return how it ended."""
        iteration = self.iteration
        for _ in range(EFFORT.endings):
            if status not in GOOD or iteration.excess() <= 1 or perf_counter() > start.deadline:
                return status
            status = self._improve(start, 1)
        return status if status not in GOOD or iteration.excess() <= 1 else Status.MAX_ITERATIONS

    def _meet_end(self, status: Status, start: PlanStart) -> Status:
        """Linearise on until the plan ends in its terminal set; return how it ended."""
        iteration, before = self.iteration, np.inf
        hard = bool(np.isinf(self._problem.softness.linear[-1]))
        for _ in range(EFFORT.endings):
            excess = iteration.end_excess()
            if excess <= EFFORT.met or (not hard and excess >= 0.9 * before) or perf_counter() > start.deadline:
                break
            before = excess
            status = self._improve(start, 1)
            if status not in GOOD:
                return status
        excess = iteration.end_excess()
        if hard and excess > EFFORT.met:
            return Status.TIME_LIMIT if perf_counter() > start.deadline else Status.INFEASIBLE
        if excess > SOFTENED:
            iteration.slack = max(iteration.slack, excess)
            return Status.SOFTENED
        return status

    def _begin_anew(self, start: PlanStart) -> Status:
        """Take the cheapest of the plans to which several starts lead; return how it ended.

        Plans that follow the model come before those that do not yet. After an effort of `spent` no further
        linearisation begins, and no further start. None does either where the problem is affine and a plan was found:
        all starts lead to that one.
        """
        iteration, best, done, until = self.iteration, (3, 0.0), False, self._spent + EFFORT.spent
        status, kept = Status.FAILED, (iteration.X.copy(), iteration.U.copy(), 0.0)
        for X, U in self._starts(start):
            ended = self._improve(start, EFFORT.each, EFFORT.nearly, (X, U), until)
            rank = (2, 0.0)
            if ended in GOOD:
                gap = iteration.gap
                broken = SOFTENED * iteration.excess() if iteration.limits_outputs else 0.0
                followed = gap < EFFORT.followed and broken <= EFFORT.followed
                rank = (0, iteration.cost()) if followed else (1, max(gap, broken))
            if rank < best:
                best, status, kept = rank, ended, (iteration.X.copy(), iteration.U.copy(), iteration.slack)
            done = self._spent >= until or (self._problem.affine and best[0] == 0)
            if done or perf_counter() > start.deadline:
                break
        iteration.X[:], iteration.U[:], iteration.slack = kept
        if status not in GOOD or done or perf_counter() > start.deadline:
            return status
        polished = self._improve(start, max(EFFORT.first, self._sqp_iterations), until=until)
        if polished in GOOD:
            return polished
        iteration.X[:], iteration.U[:], iteration.slack = kept
        return status

    def _starts(self, start: PlanStart) -> Iterator[tuple[Float[np.ndarray, "N1 nx"], Float[np.ndarray, "N nu"]]]:
        """Yield states and inputs to start from: rest at x, the line from x to the equilibrium, the motion from x.

        No input acts in them, or the last one where its changes count. The motion is that of given equations only: a
        learned model may invent one that leaves its data, and a plan there that looks cheaper than any real one.
        """
        N, x = len(start.e), start.s[: self._map.nx]
        u = np.clip(start.u_prev if self._problem.with_rates else np.zeros_like(start.u_prev), *self._inputs)
        U, rest = np.tile(u, (N, 1)), np.tile(x, (N + 1, 1))
        yield rest, U
        yield rest + np.linspace(0.0, 1.0, N + 1)[:, None] * (start.rest - x), U
        if not isinstance(self._map.model, StepMap):
            return
        motion = self._map.roll_out(x, U, start.e, start.W)
        if motion is not None:
            yield motion, U

    def _improve(
        self,
        start: PlanStart,
        most: int,
        settled: float = SETTLED,
        begin: tuple[Float[np.ndarray, "N1 nx"], Float[np.ndarray, "N nu"]] | None = None,
        until: float = np.inf,
    ) -> Status:
        """Return how the last of at most this many iterations ended.

        The first one begins at the states and inputs `begin`, by default at the plan. They end early where no more than
        a share `settled` of the plan moves, where F is nowhere near its linearisation, and at the deadline; then the
        plan found so far is used, and the step is late.
        """
        status, iteration, until = Status.FAILED, self.iteration, min(self._spent + EFFORT.spent, until)
        if begin is not None:
            self._enter(*begin, start)
        for k in range(most):
            if k and (self._spent >= until or perf_counter() > start.deadline):
                break
            found = iteration.step(start.s, start.targets, start.deadline)
            self._iterations += found.iterations
            self._spent += found.effort
            if found.status not in GOOD:
                return status if k and found.status is Status.TIME_LIMIT else found.status
            iteration.take(start.s, found)
            if iteration.length == 0.0:
                return found.status if iteration.gap < NEAR else Status.FAILED
            self._enter(*self._problem.leave(iteration.X, iteration.U, start.box), start)
            status = Status.SOFTENED if iteration.slack else found.status
            whole = self._problem.affine and iteration.length == 1.0  # then the plan solves the problem itself
            if k + 1 < most and (whole or iteration.rests(found, settled)):
                break
        return status

    def _enter(self, X: Float[np.ndarray, "N1 nx"], U: Float[np.ndarray, "N nu"], start: PlanStart) -> None:
        """Make these states and inputs the plan."""
        self.iteration.X[:], self.iteration.U[:] = self._problem.enter(X, U, start.u_prev, start.box)

    def _shift(self, start: PlanStart) -> None:
        """Make the plan of the last step the start of this one; its last stage is one step of the model."""
        X, U = self._problem.leave(self.iteration.X, self.iteration.U, start.box)
        X = X.copy()
        X[:-1], U[:-1] = X[1:], U[1:]
        X[-1] = self._map.step(X[-2], U[-1], start.W[-1]) + start.e[-1]
        self._enter(X, U, start)
