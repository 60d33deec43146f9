"""Sequences of levels, move by move: the nodes of a search in which every input of a plan is on levels.

In rotated coordinates a plan costs ½ ‖s‖² and its soft limits, and its first j moves depend on s_1 … s_j alone. So all
sequences with the same beginning cost at least what this beginning does, and no quadratic program is solved. A node
holds many beginnings of the same length.

Geyer & Quevedo, "Multistep finite control set model predictive control for power electronics", IEEE Trans. Power
Electronics 29(12), 2014: the sphere decoder.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import solve_triangular

from koopmpc.base.values import Value
from koopmpc.control.ask.levels import HeldLevels, InputLevels, LevelBox
from koopmpc.control.ask.limits import Interval
from koopmpc.control.move import Status
from koopmpc.control.solvers.base import StepQP

WIDTH = 128  # beginnings that go on at once
EQUAL = 1e-9  # a plan is worse than the best one unless it costs less by more than this share
_ROUNDING = 1e-9  # a row depends on the levels alone if it has less than this share in other directions
_LATER = 1e-12  # a row depends on a move if its entry is more than this share of the row
_OUTSIDE = 1e-8  # a hard row is met up to this much, by 1 + the size of its limit


class LevelNode(NamedTuple):
    """A part of a search: no plan in it costs less than `bound`."""

    bound: float
    part: Any


class LevelPlan(NamedTuple):
    """A plan on levels: its cost, the levels of its moves, and what the caller makes of it; without an answer none."""

    cost: float = np.inf
    levels: Int[np.ndarray, "moves leveled"] | None = None
    answer: Any = None


class Grown(NamedTuple):
    """What became of a node: its programs and their iterations, the nodes below it, the next one last, or a plan."""

    status: Status
    programs: int = 0
    iterations: int = 0
    nodes: Sequence[LevelNode] = ()
    plan: LevelPlan | None = None


Grow = Callable[[LevelNode, float, float | None], Grown]
"""(node, cost of the best plan, seconds left) → what became of the node."""


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


def plan_sequences(
    qp: StepQP,
    rows: Int[np.ndarray, "moves leveled"],
    factor: Float[np.ndarray, "moves leveled"],
    levels: InputLevels,
    blocks: Sequence[int],
) -> tuple[LevelsProgram, Float[np.ndarray, "n free"]] | None:
    """Return the search as data, and s → v; None where the moves on levels do not determine a plan.

    Parameters
    ----------
    qp
        The program of a step.
    rows
        The rows of the moves, in the order of time.
    factor
        What these rows are of an input.
    blocks
        Steps of each move.
    """
    (moves, leveled), n = rows.shape, len(qp.q)
    root = np.linalg.cholesky(qp.P)
    A = solve_triangular(root, qp.A.T, lower=True).T
    G = A[rows.ravel()] / (factor * levels.spacing).reshape(-1, 1)
    tied = np.zeros((moves, leveled), dtype=np.bool_)
    by_move = G.reshape(moves, leveled, n)
    tied[1:] = (by_move[1:] == by_move[:-1]).all(axis=-1)
    free, group = np.flatnonzero(~tied.ravel()), np.cumsum(~tied.ravel()).reshape(tied.shape) - 1
    for k in range(1, moves):
        group[k] = np.where(tied[k], group[k - 1], group[k])
    Q, R = np.linalg.qr(G[free].T)
    L, others = R.T, np.setdiff1d(np.arange(len(A)), rows.ravel())
    T, sizes = A[others] @ Q, np.linalg.norm(A[others], axis=1)
    lost = np.linalg.norm(A[others] - T @ Q.T, axis=1)
    determined = len(free) <= n and (np.abs(np.diag(L)) > _ROUNDING * np.linalg.norm(L, axis=1)).all()
    if not determined or (lost > _ROUNDING * sizes).any() or qp.q.any():
        return None
    depends = np.abs(T) > _LATER * sizes[:, None]
    last = np.where(depends.any(axis=1), len(free) - 1 - depends[:, ::-1].argmax(axis=1), 0)
    order = np.argsort(last, kind="stable")
    lengths = np.repeat(np.asarray(blocks)[:moves], leveled)
    program = LevelsProgram(
        levels=levels,
        blocks=np.array(blocks),
        free=free,
        group=group.ravel(),
        steps=np.bincount(group.ravel(), weights=lengths).astype(np.intp),
        L=L,
        T=T[order],
        rows=others[order],
        first=np.cumsum([0, *np.bincount(last, minlength=len(free))]),
        linear=qp.softness.linear[others[order]],
        quadratic=qp.softness.quadratic[others[order]],
    )
    return program, solve_triangular(root, Q, lower=True, trans="T")


class Sequences:
    """The sequences of levels of a plan: ½ ‖s‖² + Σ (linear ε + quadratic ε²), move by move.

    Parameters
    ----------
    program
        The data.
    from_s
        s → v.
    held
        The levels of now.
    """

    def __init__(self, program: LevelsProgram, from_s: Float[np.ndarray, "n free"], held: HeldLevels) -> None:
        self.program, self._from_s, self._held = program, from_s, held
        n, leveled = len(program.free), len(program.levels.which)
        self._shape, self._input = (len(program.group) // leveled, leveled), program.free % leveled
        self._has_dwell = bool(program.levels.dwell.max() > 1)
        self._counted = leveled if self._has_dwell else 0
        self._inverse, self._slope = np.linalg.inv(program.L), np.diag(program.L)
        self._is_soft = np.isfinite(program.linear)
        self._linear = np.where(self._is_soft, program.linear, 0.0)
        # the rows in the order in which a sequence meets them: each move, then those that depend on it last
        last = np.repeat(np.arange(n), np.diff(program.first))
        self._place = np.argsort(np.concatenate([np.arange(n), last + 0.5]), kind="stable")
        every, starts = np.vstack([program.L, program.T])[self._place], np.arange(n) + program.first[:-1]
        self._columns = [np.ascontiguousarray(every[start + 1 :, j]) for j, start in enumerate(starts)]

    def begin(
        self,
        start: Float[np.ndarray, "moves leveled"],
        limits: Interval,
        root: LevelBox,
        guess: Int[np.ndarray, "moves leveled"] | None,
    ) -> tuple[LevelNode, LevelPlan, Grow]:
        """Return the first node inside `root`, the plan on the levels of a guess, and what nodes become.

        Parameters
        ----------
        start
            Where the moves are between their levels at v = 0.
        limits
            Limits of the rows of the program, less what they are at v = 0.
        """
        program, held, n = self.program, self._held, len(self.program.free)
        low, high = limits.low[program.rows], limits.high[program.rows]
        reach = np.where(self._is_soft, 0.0, _OUTSIDE * (1 + np.minimum(np.abs(low), np.abs(high))))
        limits = Interval(low - reach, high + reach)
        box = LevelBox(np.full(n, 0), program.levels.count[self._input] - 1)
        np.maximum.at(box.low, program.group, root.low.ravel())
        np.minimum.at(box.high, program.group, root.high.ravel())
        origin, best = start.ravel()[program.free], LevelPlan()
        if guess is not None:
            index = np.clip(guess.ravel()[program.free], *box)
            every = index[program.group].reshape(self._shape)
            if not self._has_dwell or held.tighten(LevelBox(every, every.copy()), program.blocks.tolist()):
                s = self._inverse @ (index - origin)
                cost = 0.5 * float(s @ s) + self._price(program.T @ s, limits)
                best = LevelPlan(cost, every, self._from_s @ s) if cost < np.inf else LevelPlan()
        first = _Begun(
            0,
            np.concatenate([origin, np.zeros(len(program.rows))])[self._place][None],
            np.zeros(1),
            np.zeros((1, n)),
            np.zeros((1, n), np.intp),
            held.index[None, : self._counted],
            held.steps[None, : self._counted],
        )

        def grow(node: LevelNode, most: float, left: float | None) -> Grown:
            begun: _Begun = node.part
            better = begun.cost < most
            begun = begun if better.all() else _take(begun, np.flatnonzero(better))
            begun = self._go_on(begun, (int(box.low[begun.move]), int(box.high[begun.move])), limits, most)
            K = len(begun.cost)
            if not K:
                return Grown(Status.OPTIMAL)
            if begun.move == n:
                k = int(begun.cost.argmin())
                index = begun.taken[k][program.group].reshape(self._shape)
                plan = LevelPlan(float(begun.cost[k]), index, self._from_s @ begun.s[k])
                return Grown(Status.OPTIMAL, K, K, plan=plan)
            parts = [begun]
            if K > WIDTH:
                order = np.argpartition(begun.cost, WIDTH)
                parts = [_take(begun, order[WIDTH:]), _take(begun, order[:WIDTH])]
            return Grown(Status.OPTIMAL, K, K, [LevelNode(float(part.cost.min()), part) for part in parts])

        return LevelNode(0.0, first), best, grow

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
        s, cost, rows = s[k, which], cost[k, which], slice(self.program.first[j], self.program.first[j + 1])
        at = begun.at[k, 1:]
        at += np.multiply.outer(s, self._columns[j])
        m, soft = rows.stop - rows.start, self._is_soft[rows]
        if m:
            value, at = at[:, :m], at[:, m:]
            past = np.maximum(np.maximum(value - limits.high[rows], limits.low[rows] - value), 0.0)
            if soft.any():
                cost = cost + past @ self._linear[rows] + (past * past) @ self.program.quadratic[rows]
            good = cost < most
            if not soft.all():
                good &= ~(past[:, ~soft] > 0).any(axis=1)
            if not good.all():
                kept = np.flatnonzero(good)
                k, which, s, cost, at = k[kept], which[kept], s[kept], cost[kept], at[kept]
        every, index = begun.s[k], begun.taken[k]
        every[:, j], index[:, j] = s, values[which]
        level, steps = begun.level[k], begun.steps[k]
        if self._has_dwell:
            changed = index[:, j] != level[:, i]
            level[:, i] = index[:, j]
            steps[:, i] = np.where(changed, 0, steps[:, i]) + self.program.steps[j]
        return _Begun(j + 1, at, cost, every, index, level, steps)

    def _price(self, value: Float[np.ndarray, " m"], limits: Interval) -> float:
        """Return what the rows of a sequence cost; inf where a hard one is outside."""
        past = np.maximum(np.maximum(value - limits.high, limits.low - value), 0.0)
        if (past[~self._is_soft] > 0).any():
            return np.inf
        return float(self._linear @ past + self.program.quadratic @ (past * past))


def _take(begun: _Begun, which: Int[np.ndarray, " k"]) -> _Begun:
    """Return some of these beginnings."""
    return _Begun(begun.move, *(part[which] for part in begun[1:]))
