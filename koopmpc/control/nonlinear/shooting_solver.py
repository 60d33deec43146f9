"""The plan of a NonlinearMPC: a nonlinear program from the last solution, or from several guesses."""

import itertools
import math
from collections.abc import Sequence
from time import perf_counter
from typing import NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Float, Int

from koopmpc.base.values import Interval
from koopmpc.control.ask.levels import HeldLevels, LevelBox
from koopmpc.control.move import Status
from koopmpc.control.nonlinear.shooting import NLP, NLPSolution, Shooting
from koopmpc.control.nonlinear.shooting import Start as Begin
from koopmpc.control.nonlinear.stages import LearnedMap, StagedProblem, StageTargets
from koopmpc.control.nonlinear.task import StagedTask
from koopmpc.control.solvers.levels import LevelSearch, Relaxed
from koopmpc.control.step.staged import PlanSolver, PlanStart, StagePlan

Guess = tuple[Float[np.ndarray, "N1 nx"], Float[np.ndarray, "N nu"]]  # states and inputs
MOST = 5000  # partial sequences of one length that are kept; where there are more, nonlinear programs are searched


class ShootingSolver(PlanSolver):
    """Multiple shooting from the last solution, moved on by a step; from several guesses where there is none.

    Parameters
    ----------
    task
        What is asked.
    nlp
        The solver, its settings, and the guesses of a first step.
    levels
        The search over levels, where inputs have some.
    """

    def __init__(self, task: StagedTask, nlp: NLP, levels: LevelSearch | None) -> None:
        self._problem, self._inputs, self._nlp, self._timed = task.problem, task.outputs.inputs, nlp, task.time_limit
        self._levels, self._blocks = levels, task.moves.lengths
        self.update(task.map)

    def update(self, model: LearnedMap) -> None:
        """Build the nonlinear program, and the search over sequences where all inputs are on levels in all steps."""
        self._map, p, levels = model, self._problem, self._levels
        self._shooting = Shooting(p, model.theta, self._nlp, timed=self._timed is not None)
        self._rollouts: LevelRollouts | None = None
        self._stage_limits = p.stage_limits  # of this step
        if levels is not None and levels.index.shape == (len(self._blocks), model.nu) and not p.own:
            self._rollouts = LevelRollouts(p, model.theta, levels.held, self._blocks)

    def limit(self, stages: Interval) -> None:
        """Take over the limits (N, n) of [v_k; limited(s_{k+1})]."""
        self._stage_limits = stages
        (low, high), nu = stages, self._map.nu
        self._shooting.set_limits(Interval(low[:, :nu], high[:, :nu]), Interval(low[:, nu:], high[:, nu:]))

    def weigh(self, Q: Float[np.ndarray, "N nr"], R: Float[np.ndarray, "N m"]) -> None:
        """Take over the diagonals that weigh the tracked outputs of s_1 … s_N, and v_0 … v_{N−1} without rates."""
        self._shooting.weights = Q, R

    def go_on_from(self, S: Float[np.ndarray, "N1 ns"], V: Float[np.ndarray, "N nu"]) -> None:
        """Make this the plan from which the next step starts."""
        self._next = self._shooting.at(np.vstack([S[2:], S[-1:]]), np.vstack([V[1:], V[-1:]]))

    def solve(self, start: PlanStart) -> StagePlan:
        """Return the plan from a start: from the last solution, or the best from several guesses."""
        s, deadline = start.s, start.deadline
        begins = [self._next] if start.warm else self._guess(start)
        solved: list[NLPSolution] = []
        for begin in begins:
            solved.append(self._shoot(start, begin, start.first))
            if perf_counter() > deadline:
                break
        good = [found for found in solved if found.status is Status.OPTIMAL]
        if not good and perf_counter() < deadline:  # once more from the roll-out of zero inputs, which has no gaps
            U = np.tile(np.clip(np.zeros_like(start.u_prev), *self._inputs), (len(start.e), 1))
            solved += [
                self._shoot(start, begin, start.first) for begin in self._list_begins(self._roll_out(start, U), start)
            ]
            good = [found for found in solved if found.status is Status.OPTIMAL]
        iterations = sum(found.iterations for found in solved)
        found = min(good, key=lambda each: each.cost) if good else solved[0]
        if good and self._levels is not None and not self._rests_on_levels(found, start):
            found, more = self._search_levels(found, start)
            iterations += more
            good = good if found.status is Status.OPTIMAL else []
        self._next = found.start
        slack = float(found.slacks[found.slacks > self._shooting.allowance].max(initial=0.0))
        status = Status.SOFTENED if good and slack else found.status
        return StagePlan(np.vstack([s, found.X]), found.U, status, iterations, slack)

    def _shoot(self, start: PlanStart, begin: Begin, first: Interval) -> NLPSolution:
        W = start.W if self._problem.scheduled else start.W[:, :0]
        return self._shooting.solve(start.s, start.targets, start.e, begin, first, start.deadline, W)

    def _rests_on_levels(self, found: NLPSolution, start: PlanStart) -> bool:
        """Return whether a plan that was found without levels is on them."""
        U = self._problem.leave(np.vstack([start.s, found.X]), found.U, start.box)[1]
        return self._levels is not None and self._levels.accepts(U[self._problem.free].ravel())

    def _search_levels(self, relaxed: NLPSolution, start: PlanStart) -> tuple[NLPSolution, int]:
        """Return the best plan on levels, and all iterations.

        Where all inputs are on levels and sequences are few, it is the best of all. Otherwise branch and bound over
        nonlinear programs finds it; a node is a local optimum, so that a plan is the best one as far as these are.
        """
        search, shooting, (N, nu), deadline = self._levels, self._shooting, relaxed.U.shape, start.deadline
        assert search is not None, "only asked where inputs have levels"
        levels, starts = search.held.levels, np.flatnonzero(self._problem.free)
        low, high = (np.broadcast_to(end, (N, nu)) for end in start.box)
        inside = levels.inside(
            Interval(np.maximum.reduceat(low, starts, axis=0), np.minimum.reduceat(high, starts, axis=0))
        )
        count = len(search.index)
        root = LevelBox(inside.low[:count].copy(), inside.high[:count].copy())
        if (root.low > root.high).any():
            return relaxed._replace(status=Status.INFEASIBLE), 0
        blocks = self._blocks[:count]
        steps, rated = sum(blocks), self._problem.with_rates

        def relax(box: LevelBox, answer: NLPSolution, left: float | None) -> Relaxed:
            least, most = low.copy(), high.copy()
            for end, index in ((least, box.low), (most, box.high)):
                end[:steps, levels.which] = levels.values(np.repeat(index, blocks, axis=0))
            shooting.set_moves(least, most)
            here = start.first if rated else Interval(least[0], most[0])
            found = self._shoot(start, answer.start_here, here)
            late = left is not None and perf_counter() > deadline
            status = Status.TIME_LIMIT if late and found.status is not Status.OPTIMAL else found.status
            _, U = self._problem.leave(np.vstack([start.s, found.X]), found.U, start.box)
            return Relaxed(status, found.cost, levels.indices(U[starts[:count]]), found.iterations, found)

        end, found = None if np.isinf(deadline) else deadline, None
        if self._rollouts is not None:
            stages = StageData(start.targets, start.e, start.W, shooting.weights, self._stage_limits, start.first)
            best = self._rollouts.find(start.s, stages, root, search.guess())
            if best is not None:
                found = search.find(relax, LevelBox(best, best.copy()), relaxed, end, relaxed.cost)
        if found is None or (found.answer is None and found.status is not Status.TIME_LIMIT):
            found = search.find(relax, root, relaxed, end, relaxed.cost)
        unlimited = np.full((N, nu), np.inf)
        shooting.set_moves(*((-unlimited, unlimited) if rated else (low, high)))
        if found.answer is None:
            return relaxed._replace(status=found.status), found.iterations
        return found.answer, found.iterations

    def _guess(self, start: PlanStart, hold: int = 5, wide: float = 1.0) -> list[Begin]:
        """Return the guesses of a first step: rest at x_0, then where random inputs lead.

        They are held for `hold` steps; without limits they are up to `wide` from rest.
        """
        N, nu, x = len(start.e), len(start.u_prev), start.s[: self._map.nx]
        rest = np.clip(np.zeros(nu), *self._inputs)
        guesses: list[Guess] = [(np.tile(x, (N + 1, 1)), np.tile(rest, (N, 1)))]
        rng = np.random.default_rng(0)
        low, high = np.maximum(self._inputs.low, rest - wide), np.minimum(self._inputs.high, rest + wide)
        for _ in range(self._nlp.starts - 1):
            U = np.repeat(rng.uniform(low, high, (-(-N // hold), nu)), hold, axis=0)[:N]
            guesses += self._roll_out(start, U)
        return self._list_begins(guesses, start)

    def _roll_out(self, start: PlanStart, U: Float[np.ndarray, "N nu"]) -> list[Guess]:
        """Return the states to which U leads, and U; nothing where they overflow, or a step has no solution."""
        X = self._map.roll_out(start.s[: self._map.nx], U, start.e, start.W)
        return [] if X is None else [(X, U)]

    def _list_begins(self, guesses: list[Guess], start: PlanStart) -> list[Begin]:
        stages = [self._problem.enter(X, U, start.u_prev, start.box) for X, U in guesses]
        return [self._shooting.at(S[1:], V) for S, V in stages]


class StageData(NamedTuple):
    """The stages of a step: targets, e, w, diagonals of weights in time, limits of [v; limited] and of v_0."""

    targets: StageTargets
    e: Float[np.ndarray, "N n"]
    W: Float[np.ndarray, "N nw"]
    weights: tuple[Float[np.ndarray, "N nr"], Float[np.ndarray, "N m"]]
    limits: Interval
    first: Interval


class LevelRollouts:
    """The cost of sequences of levels on the model of a NonlinearMPC.

    Parameters
    ----------
    problem, theta
        The stages, and the θ of their F.
    held
        The levels, and those of now.
    blocks
        Steps of each move.
    """

    def __init__(
        self, problem: StagedProblem, theta: Float[np.ndarray, " nt"], held: HeldLevels, blocks: Sequence[int]
    ) -> None:
        self._problem, self._held, self._blocks = problem, held, blocks
        self._theta = theta[: len(theta) - problem.scheduled]
        self._moved = problem.moved

    def find(
        self, s: Float[np.ndarray, " ns"], stages: StageData, root: LevelBox, guess: Int[np.ndarray, "moves nu"] | None
    ) -> Int[np.ndarray, "moves nu"] | None:
        """Return the best sequence inside `root`, searched from a guess; None where there are too many, or none."""
        most, best = np.inf, None
        if guess is not None:
            near = np.clip(guess, root.low, root.high)
            costs, sequences = self._run(s, stages, LevelBox(near, near), most)
            if len(costs) == 1:
                best, most = sequences[0], float(costs[0]) * (1 - 1e-9)  # a gain of rounding does not count
        costs, sequences = self._run(s, stages, root, most if self._problem.stage is None else np.inf)
        if len(costs) and sequences.shape[1] < len(self._blocks):
            return None
        return best if not len(costs) or costs.min() >= most else sequences[int(costs.argmin())]

    def _run(
        self, s: Float[np.ndarray, " ns"], stages: StageData, box: LevelBox, most: float
    ) -> tuple[Float[np.ndarray, " K"], Int[np.ndarray, "K moves nu"]]:
        """Return costs and levels of all sequences that cost less than `most`; shorter ones if there are too many."""
        p, held, nu, k = self._problem, self._held, len(self._problem.R), 0
        S, cost = s[None], np.zeros(1)
        taken, level, steps = np.zeros((1, 0, nu), np.intp), held.index[None], held.steps[None]
        for move, length in enumerate(self._blocks):
            ranges = [range(low, high + 1) for low, high in zip(box.low[move], box.high[move], strict=True)]
            if len(S) * math.prod(map(len, ranges)) > MOST:
                break
            each = np.array(list(itertools.product(*ranges)), np.intp)
            bound = steps < held.levels.least(level)
            at, which = np.nonzero(~(bound[:, None] & (each[None] != level[:, None])).any(axis=-1))
            S, cost, chosen = S[at], cost[at], each[which]
            steps = np.where(chosen != level[at], 0, steps[at]) + length
            taken, level = np.concatenate([taken[at], chosen[:, None]], axis=1), chosen
            U = held.levels.values(chosen)
            for i in range(length):
                if not len(S):
                    return cost, np.zeros((0, len(self._blocks), nu), np.intp)
                V = U if not p.with_rates else U - S[:, self._moved : self._moved + nu] if i == 0 else np.zeros_like(U)
                S, paid = self._advance(S, V, k, stages)
                cost, k = cost + paid, k + 1
                good = np.flatnonzero(cost < most)
                S, cost, taken, level, steps, U = (part[good] for part in (S, cost, taken, level, steps, U))
        return cost, taken

    def _advance(
        self, S: Float[np.ndarray, "K ns"], V: Float[np.ndarray, "K nu"], k: int, stages: StageData
    ) -> tuple[Float[np.ndarray, "K ns"], Float[np.ndarray, " K"]]:
        """Return s_{k+1} and what stage k costs; inf where a hard limit is missed, or a number is not finite."""
        p, t, (Q, R) = self._problem, stages.targets, stages.weights
        nu, N = V.shape[1], len(p.free)
        theta = np.concatenate([self._theta, stages.W[k]]) if p.scheduled else self._theta
        after = _evaluate(p.F, S, V, theta)
        after[:, : self._moved] += stages.e[k][: self._moved]
        moved, tracked = V - t.U[k], _evaluate(p.tracked, after)
        cost = (moved**2) @ R[k] if R.shape[1] else np.einsum("ki,ij,kj->k", moved, p.R, moved)
        if k + 1 < N:
            missed = tracked - t.R[k]
            cost += (missed**2) @ Q[k] if Q.shape[1] else np.einsum("ki,ij,kj->k", missed, p.Q, missed)
        else:
            cost += ((tracked @ t.M.T + after @ t.L.T - t.m) ** 2).sum(axis=1)
        if p.stage is not None:
            cost += _evaluate(p.stage, S, V)[:, 0]
        low, high = (end[k] for end in stages.limits)
        first = stages.first if k == 0 else Interval(low[:nu], high[:nu])
        reach = 1e-6 * p.input_sizes  # as limits of inputs are met
        broken = ((first.low - reach > V) | (first.high + reach < V)).any(axis=1)
        if len(p.box.low):
            values, (linear, quadratic, allowance) = _evaluate(p.limited, after), p.softness
            past = np.maximum(np.maximum(values - high[nu:], low[nu:] - values), 0.0)
            if p.ends and k + 1 < N:
                past[:, -p.ends :] = 0.0
            soft = np.isfinite(linear)
            cost += past[:, soft] @ linear[soft] + past[:, soft] ** 2 @ quadratic[soft]
            broken |= (past[:, ~soft] > allowance[~soft]).any(axis=1)
        return after, np.where(broken | ~np.isfinite(cost), np.inf, cost)


def _evaluate(function: ca.Function, *arguments: Float[np.ndarray, "..."]) -> Float[np.ndarray, "K n"]:
    """Return a function's results for rows of arguments; one without rows is that of all."""
    rows = len(arguments[0])
    columns = [np.tile(each, (rows, 1)).T if each.ndim == 1 else each.T for each in arguments]
    found = function(*[ca.DM(each) for each in columns])
    return np.array(found.full().T, dtype=np.float64).reshape(rows, -1)
