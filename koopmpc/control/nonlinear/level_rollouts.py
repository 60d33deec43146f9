"""All sequences of levels along a nonlinear model: an exact search where every input of a plan is on levels.

The model runs from the state of the step under all beginnings at once, move by move. Their costs are known as they are,
so that the best sequence is the best one of all, not a local optimum. Beginnings that cost more than a known sequence
are left.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Float, Int

from koopmpc.control.ask.levels import HeldLevels, LevelBox
from koopmpc.control.ask.limits import Interval
from koopmpc.control.nonlinear.problem import StagedProblem, StageTargets

MOST = 5000  # beginnings of the same length, at most; beyond them nonlinear programs are searched
_EQUAL = 1e-9  # a sequence is worse than the best one unless it is better by more than this share
_OUTSIDE = 1e-6  # share of a limit's size by which a hard limit may be missed


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
                best, most = sequences[0], float(costs[0]) * (1 - _EQUAL)
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
        reach = _OUTSIDE * p.input_sizes
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
