"""All sequences of levels, move by move: an exact search where every input of a plan is on levels.

In rotated coordinates a plan costs ½ ‖s‖² and its soft limits, and its first j moves depend on s_1 … s_j alone. So all
sequences with the same beginning cost at least what this beginning does, and no quadratic program is solved. Many
beginnings go on at once, the cheapest ones first; those that cost more than the best sequence are left.

Geyer & Quevedo, "Multistep finite control set model predictive control for power electronics", IEEE Trans. Power
Electronics 29(12), 2014: the sphere decoder.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import solve_triangular

from koopmpc.control.limits import Interval
from koopmpc.control.move import Status
from koopmpc.control.solvers.base import StepQP
from koopmpc.control.stepped.levels import HeldLevels, InputLevels, LevelBox
from koopmpc.values import Value

WIDTH = 128  # beginnings that go on at once
EQUAL = 1e-9  # a sequence is worse than the best one unless it is better by more than this share
_ROUNDING = 1e-9  # a row depends on the levels alone if it has less than this share in other directions
_LATER = 1e-12  # a row depends on a move if its entry is more than this share of the row
_OUTSIDE = 1e-8  # a hard row is met up to this much, by 1 + the size of its limit


class SequenceFound(NamedTuple):
    """The best sequence, None without one: its levels, the point v, its cost, what no other one is below, and work."""

    levels: Int[np.ndarray, "moves leveled"] | None
    v: Float[np.ndarray, " n"]
    cost: float
    bound: float
    status: Status
    nodes: int


@dataclass(frozen=True, eq=False, kw_only=True)
class LevelsProgram(Value):
    """The search of a step: ½ ‖s‖² + Σ (linear ε + quadratic ε²) → min, where moves and rows are at + L s and T s.

    Attributes
    ----------
    levels
        The levels of the inputs.
    blocks
        (moves,) steps of each move.
    free, group
        (n,) the moves that are free, and for each move and input, one after the other, the free one that it repeats.
    steps
        (n,) for how many steps a free move is held.
    L, T
        (n, n) lower triangular, in levels; (m, n), in the unit of the rows.
    rows, first
        (m,) the rows of the step's program besides its moves; (n + 1,) where those begin that depend on a move last.
    linear, quadratic
        (m,) prices of the soft rows, inf for a hard one.
    """

    levels: InputLevels
    blocks: Int[np.ndarray, " moves"]
    free: Int[np.ndarray, " n"]
    group: Int[np.ndarray, " all_moves"]
    steps: Int[np.ndarray, " n"]
    L: Float[np.ndarray, "n n"]
    T: Float[np.ndarray, "m n"]
    rows: Int[np.ndarray, " m"]
    first: Int[np.ndarray, " n1"]
    linear: Float[np.ndarray, " m"]
    quadratic: Float[np.ndarray, " m"]


class _Begun(NamedTuple):
    """Beginnings of the same length: the rows not reached yet, costs, coordinates, levels, and the steps at the last.

    `at` holds where the next moves and rows are if all later coordinates are zero.
    """

    move: int
    at: Float[np.ndarray, "K rest"]
    cost: Float[np.ndarray, " K"]
    s: Float[np.ndarray, "K n"]
    taken: Int[np.ndarray, "K n"]
    level: Int[np.ndarray, "K leveled"]
    steps: Int[np.ndarray, "K leveled"]


class SequenceSearch:
    """½ vᵀP v + Σ (linear ε + quadratic ε²) → min over the levels of all moves of a plan.

    Parameters
    ----------
    qp
        The program of a step.
    rows
        The rows of the moves, in the order of time.
    factor
        What these rows are of an input.
    held
        The levels, and those of now.
    blocks
        Steps of each move.
    """

    def __init__(
        self,
        qp: StepQP,
        rows: Int[np.ndarray, "moves leveled"],
        factor: Float[np.ndarray, "moves leveled"],
        held: HeldLevels,
        blocks: Sequence[int],
    ) -> None:
        self._held, self._shape, self._blocks = held, rows.shape, blocks
        levels, n = held.levels, len(qp.q)
        self._has_dwell = bool(levels.dwell.max() > 1)
        self._counted = len(levels.which) if self._has_dwell else 0
        factor_of_v = np.linalg.cholesky(qp.P)
        A = solve_triangular(factor_of_v, qp.A.T, lower=True).T
        G = A[rows.ravel()] / (factor * levels.spacing).reshape(-1, 1)
        tied = np.zeros(self._shape, dtype=np.bool_)
        by_move = G.reshape(*self._shape, n)
        tied[1:] = (by_move[1:] == by_move[:-1]).all(axis=-1)
        free = np.flatnonzero(~tied.ravel())
        self._group = self._find_groups(tied)
        Q, R = np.linalg.qr(G[free].T)
        L, others = R.T, np.setdiff1d(np.arange(len(A)), rows.ravel())
        T = A[others] @ Q
        sizes = np.linalg.norm(A[others], axis=1)
        lost = np.linalg.norm(A[others] - T @ Q.T, axis=1)
        steep = np.abs(np.diag(L)) > _ROUNDING * np.linalg.norm(L, axis=1) if len(free) <= n else np.zeros(1)
        self.applies = bool(steep.all() and (lost <= _ROUNDING * sizes).all() and not qp.q.any())
        if not self.applies:
            return
        depends = np.abs(T) > _LATER * sizes[:, None]
        last = np.where(depends.any(axis=1), len(free) - 1 - depends[:, ::-1].argmax(axis=1), 0)
        order = np.argsort(last, kind="stable")
        self._others, self._last = others[order], last[order]
        self._free, self._count = free, np.bincount(last, minlength=len(free)).tolist()
        self._L, self._inverse = L, np.linalg.inv(L)
        self._from_s = solve_triangular(factor_of_v, Q, lower=True, trans="T")
        self._T = T[order]
        # the rows in the order in which a sequence meets them: each move, then those that depend on it last
        self._linear, self._quadratic = qp.softness.linear[self._others], qp.softness.quadratic[self._others]
        self._is_soft = np.isfinite(self._linear)
        self._linear = np.where(self._is_soft, self._linear, 0.0)
        every = np.vstack([L, self._T])
        place = np.argsort(np.concatenate([np.arange(len(free)), self._last + 0.5]), kind="stable")
        self._place = place
        starts = np.cumsum([0, *(1 + c for c in self._count)])
        self._columns = [np.ascontiguousarray(every[place[starts[j] + 1 :], j]) for j in range(len(free))]
        self._slope = np.diag(L).tolist()
        firsts = np.cumsum([0, *self._count]).tolist()
        self._slices = [slice(a, b) for a, b in itertools.pairwise(firsts)]
        self._hard_in = [bool((~self._is_soft[part]).any()) for part in self._slices]
        self._soft_in = [bool(self._is_soft[part].any()) for part in self._slices]
        leveled = self._shape[1]
        self._input = (free % leveled).tolist()
        lengths = np.repeat(np.asarray(blocks)[: self._shape[0]], leveled)
        self._length = np.bincount(self._group, weights=lengths).astype(np.intp).tolist()

    def describe(self) -> LevelsProgram:
        """Return the search as data."""
        return LevelsProgram(
            levels=self._held.levels,
            blocks=np.array(self._blocks),
            free=self._free,
            group=self._group,
            steps=np.array(self._length),
            L=self._L,
            T=self._T,
            rows=self._others,
            first=np.cumsum([0, *self._count]),
            linear=np.where(self._is_soft, self._linear, np.inf),
            quadratic=self._quadratic,
        )

    def _find_groups(self, tied: Bool[np.ndarray, "moves leveled"]) -> Int[np.ndarray, " all_moves"]:
        """Return the number of the free move that each move repeats."""
        number = np.cumsum(~tied.ravel()).reshape(tied.shape) - 1
        for k in range(1, len(tied)):
            number[k] = np.where(tied[k], number[k - 1], number[k])
        return number.ravel()

    def find(
        self,
        start: Float[np.ndarray, "moves leveled"],
        limits: Interval,
        root: LevelBox,
        guess: Int[np.ndarray, "moves leveled"] | None,
        deadline: float | None,
        most: int,
    ) -> SequenceFound:
        """Search inside `root`, from the levels of a `guess`, over `most` beginnings at most.

        Parameters
        ----------
        start
            Where the moves are between their levels at v = 0.
        limits
            Limits of the rows of the program, less what they are at v = 0.
        """
        free, held = self._free, self._held
        n = len(free)
        low, high = limits.low[self._others], limits.high[self._others]
        reach = np.where(self._is_soft, 0.0, _OUTSIDE * (1 + np.minimum(np.abs(low), np.abs(high))))
        limits = Interval(low - reach, high + reach)
        least, most_level = np.full(n, 0), held.levels.count[np.asarray(self._input)] - 1
        np.maximum.at(least, self._group, root.low.ravel())
        np.minimum.at(most_level, self._group, root.high.ravel())
        ranges = list(zip(least.tolist(), most_level.tolist(), strict=True))
        origin = start.ravel()[free]
        best, best_s, cost, nodes = None, np.zeros(n), np.inf, 0
        if guess is not None:
            index = np.clip(guess.ravel()[free], least, most_level)
            every = index[self._group].reshape(self._shape)
            if not self._has_dwell or held.tighten(LevelBox(every, every.copy()), self._blocks):
                s = self._inverse @ (index - origin)
                cost, nodes = 0.5 * float(s @ s) + self._price(self._T @ s, limits), 1
                if cost < np.inf:
                    best, best_s = index, s
        first = _Begun(
            0,
            np.concatenate([origin, np.zeros(len(self._others))])[self._place][None],
            np.zeros(1),
            np.zeros((1, n)),
            np.zeros((1, n), np.intp),
            held.index[None, : self._counted],
            held.steps[None, : self._counted],
        )
        stack, ended = [first], Status.INFEASIBLE
        while stack:
            begun = stack.pop()
            better = begun.cost < cost * (1 - EQUAL)
            if not better.all():
                if not better.any():
                    continue
                begun = _take(begun, np.flatnonzero(better))
            if nodes >= most or (deadline is not None and perf_counter() >= deadline):
                stack.append(begun)
                ended = Status.TIME_LIMIT if nodes < most else Status.MAX_ITERATIONS
                break
            begun = self._go_on(begun, ranges[begun.move], limits, cost * (1 - EQUAL))
            K = len(begun.cost)
            if not K:
                continue
            nodes += K
            if begun.move == n:
                k = int(begun.cost.argmin())
                best, best_s, cost = begun.taken[k], begun.s[k], float(begun.cost[k])
                continue
            if K > WIDTH:
                parts = np.argpartition(begun.cost, WIDTH)
                stack.append(_take(begun, parts[WIDTH:]))
                begun = _take(begun, parts[:WIDTH])
            stack.append(begun)
        bound = min([cost, *(float(begun.cost.min()) for begun in stack)])
        found = None if best is None else best[self._group].reshape(self._shape)
        return SequenceFound(
            found, self._from_s @ best_s, cost, bound, ended if best is None else Status.OPTIMAL, nodes
        )

    def _go_on(self, begun: _Begun, levels: tuple[int, int], limits: Interval, most: float) -> _Begun:
        """Return the beginnings with one more move on each allowed level, as far as they cost less than `most`."""
        j, i = begun.move, self._input[begun.move]
        values = np.arange(levels[0], levels[1] + 1)
        s = (values - begun.at[:, :1]) / self._slope[j]
        cost = begun.cost[:, None] + 0.5 * s * s
        good = cost < most
        if self._has_dwell:
            level, dwell = begun.level[:, i], self._held.levels.dwell[i]
            least: Int[np.ndarray, " K"] = dwell[(level != 0).astype(np.intp)]
            good &= (begun.steps[:, i] >= least)[:, None] | (values == level[:, None])
        k, which = np.nonzero(good)
        s, cost, rows = s[k, which], cost[k, which], self._slices[j]
        at = begun.at[k, 1:]
        at += np.multiply.outer(s, self._columns[j])
        m = self._count[j]
        if m:
            value, at = at[:, :m], at[:, m:]
            past = np.maximum(np.maximum(value - limits.high[rows], limits.low[rows] - value), 0.0)
            if self._soft_in[j]:
                cost = cost + past @ self._linear[rows] + (past * past) @ self._quadratic[rows]
            good = cost < most
            if self._hard_in[j]:
                good &= ~(past[:, ~self._is_soft[rows]] > 0).any(axis=1)
            if not good.all():
                kept = np.flatnonzero(good)
                k, which, s, cost, at = k[kept], which[kept], s[kept], cost[kept], at[kept]
        every, index = begun.s[k], begun.taken[k]
        every[:, j], index[:, j] = s, values[which]
        level, steps = begun.level[k], begun.steps[k]
        if self._has_dwell:
            changed = index[:, j] != level[:, i]
            level[:, i] = index[:, j]
            steps[:, i] = np.where(changed, 0, steps[:, i]) + self._length[j]
        return _Begun(j + 1, at, cost, every, index, level, steps)

    def _price(self, value: Float[np.ndarray, " m"], limits: Interval) -> float:
        """Return what the rows of a sequence cost; inf where a hard one is outside."""
        past = np.maximum(np.maximum(value - limits.high, limits.low - value), 0.0)
        if (past[~self._is_soft] > 0).any():
            return np.inf
        return float(self._linear @ past + self._quadratic @ (past * past))


def _take(begun: _Begun, which: Int[np.ndarray, " k"]) -> _Begun:
    """Return some of these beginnings."""
    return _Begun(begun.move, *(part[which] for part in begun[1:]))
