"""The QP of one step: deviations w from the unconstrained plan, slacks ε of soft rows, limits that move with z."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from koopmpc import checks
from koopmpc.control.limits import Interval, Softness, allowance
from koopmpc.control.move import Status
from koopmpc.control.solvers.base import QP, QPSolution
from koopmpc.control.solvers.choose import SOFT_SETTINGS
from koopmpc.control.solvers.choose import solver as named


class Units(NamedTuple):
    """w = columns · w′, of every stage, and H′ = columns H columns / curvature."""

    columns: Float[np.ndarray, " nw"]
    curvature: float


def units(
    hessian: Float[np.ndarray, "nw nw"], moved: Float[np.ndarray, "nw nw"], inputs: Interval, stages: int
) -> Units:
    """Return the units of w; `moved` tells how w moves the inputs of each stage, `inputs` their limits."""
    curvature = np.diag(hessian).reshape(stages, -1).mean(axis=0)
    columns = np.tile(1 / np.sqrt(curvature), stages)
    room = 0.5 * (inputs.high - inputs.low)
    reach = room / row_sizes(moved * columns, stages)
    known = reach[np.isfinite(reach) & (reach > 0)]
    size = float(known.max()) if known.size else 1.0
    return Units(size * columns, size**2)


def row_sizes(rows: Float[np.ndarray, "m nw"], stages: int) -> Float[np.ndarray, " n"]:
    """Return the norm of the rows of a stage, root mean square of all stages; 1 for rows that nothing moves."""
    squares = (rows**2).sum(axis=1).reshape(stages, -1).mean(axis=0)
    return np.sqrt(np.where(squares > 0, squares, 1.0))


class Group(NamedTuple):
    """Rows of v that have the same limits in each of len(next) stages, and the stage that follows each stage.

    `next` is len(next) past the end: a plan ends unconstrained.
    """

    box: Interval
    softness: Softness
    next: Int[np.ndarray, " n"]


class FirstRates(NamedTuple):
    """Rows of the QP that limit the first change of the inputs, hard, and the inputs that they limit."""

    rows: Int[np.ndarray, " r"]
    inputs: Int[np.ndarray, " r"]


@dataclass(frozen=True)
class Program:
    """½ wᵀH w + Σ (linear ε + quadratic ε²)/(2 unit) → min over [w; ε], low ≤ v + D w ≤ high.

    It is the cost unit · wᵀH w + Σ (linear ε + quadratic ε²), divided by 2 unit.

    Soft rows are relaxed by their ε ≥ 0. The first rows of the QP limit the entries `source` of v times `scale`:
    their bounds are `low` and `high` less that product; the rest are ε ≥ 0. Every row is measured by the norm of
    its row of D. `shift_primal` and `shift_dual` tell where the next stage's entry stands; one past the end stands
    for zero. A slack above its `allowance` is reported, `slack_unit` times as large: in the unit of its limit.
    Where soft rows are held hard, their multipliers must be at most `most` for the solution to be that of the soft
    QP.
    """

    qp: QP
    source: Int[np.ndarray, " m1"]
    scale: Float[np.ndarray, " m1"]
    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]
    shift_primal: Int[np.ndarray, " n"]
    shift_dual: Int[np.ndarray, " m"]
    allowance: Float[np.ndarray, " ns"]
    slack_unit: Float[np.ndarray, " ns"]
    most: Float[np.ndarray, " m"]
    rates: FirstRates


class _Block(NamedTuple):
    """Rows of the QP from one kind of limit: entries of v, bounds, the place after each, the sign and index of ε.

    `linear` is the slack weight of each row, inf where it is hard.
    """

    source: Int[np.ndarray, " p"]
    low: Float[np.ndarray, " p"]
    high: Float[np.ndarray, " p"]
    next: Int[np.ndarray, " p"]
    sign: float
    slack: Int[np.ndarray, " p"]
    linear: Float[np.ndarray, " p"]


def program(
    deviation: Float[np.ndarray, "nv nw"],
    hessian: Float[np.ndarray, "nw nw"],
    moves: Group,
    rates: Group | None,
    outputs: Group,
    unit: float,
    *,
    soft_rows: bool,
) -> Program:
    """Return the QP for v = [moves; their changes, unless None; outputs], its deviation map D and H.

    Without `soft_rows` every row is hard.
    """
    nw = deviation.shape[1]
    groups = [moves, outputs] if rates is None else [moves, rates, outputs]
    blocks: list[_Block] = []
    shifts = [_next(moves.next, len(moves.box.low))]
    weights: list[tuple[Float[np.ndarray, " _"], ...]] = []
    first, slacks, sizes = 0, 0, np.ones(len(deviation))
    first_rates = FirstRates(np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp))
    for group in groups:
        given, weight, following = group
        width, N = len(given.low), len(following)
        size = row_sizes(deviation[first : first + width * N], N)
        sizes[first : first + width * N] = np.tile(size, N)
        box = Interval(given.low / size, given.high / size)
        softness = Softness(weight.linear * size, weight.quadratic * size**2)
        limited = np.isfinite(box.low) | np.isfinite(box.high)
        gives = np.isfinite(softness.linear) & soft_rows
        soft, hard = np.flatnonzero(limited & gives), np.flatnonzero(limited & ~gives)
        slack_of = np.full(width, -1)
        slack_of[soft] = np.arange(len(soft))
        for picked, sign in (
            (hard, 0.0),
            (soft[np.isfinite(box.high[soft])], -1.0),
            (soft[np.isfinite(box.low[soft])], 1.0),
        ):
            count = len(picked)
            stage = np.arange(N)[:, None]
            if group is rates and sign == 0.0:
                truly = np.flatnonzero(np.isinf(softness.linear[picked]))
                first_rates = FirstRates(sum(len(b.source) for b in blocks) + truly, picked[truly])
            blocks.append(
                _Block(
                    (first + width * stage + picked).ravel(),
                    np.tile(box.low[picked] if sign >= 0 else np.full(count, -np.inf), N),
                    np.tile(box.high[picked] if sign <= 0 else np.full(count, np.inf), N),
                    _next(following, count),
                    sign,
                    (slacks + len(soft) * stage + slack_of[picked]).ravel(),
                    np.tile(softness.linear[picked], N),
                )
            )
        shifts.append(_next(following, len(soft)))
        of_stage = softness.linear, softness.quadratic, allowance(given) / size, size
        weights.append(tuple(np.tile(weight[soft], N) for weight in of_stage))
        first, slacks = first + width * N, slacks + len(soft) * N
    source = np.concatenate([block.source for block in blocks])
    A = np.zeros((len(source) + slacks, nw + slacks))
    scale = 1 / sizes[source]
    A[: len(source), :nw] = deviation[source] * scale[:, None]
    row = 0
    for block in blocks:
        if block.sign:
            A[row + np.arange(len(block.source)), nw + block.slack] = block.sign
        row += len(block.source)
    A[row:, nw:] = np.eye(slacks)
    linear, quadratic, allowed, slack_unit = (np.concatenate(parts) for parts in zip(*weights, strict=True))
    P, q = np.zeros((nw + slacks, nw + slacks)), np.zeros(nw + slacks)
    P[:nw, :nw] = hessian
    P[nw:, nw:] = np.diag(quadratic / unit)
    q[nw:] = linear / (2 * unit)
    low = np.concatenate([*(block.low for block in blocks), np.zeros(slacks)])
    high = np.concatenate([*(block.high for block in blocks), np.full(slacks, np.inf)])
    return Program(
        QP(P, q, A, low, high),
        source,
        scale,
        low,
        high,
        _joined(shifts),
        _joined([*(block.next for block in blocks), *shifts[1:]]),
        allowed,
        slack_unit,
        np.concatenate([*(block.linear / (2 * unit) for block in blocks), np.full(slacks, np.inf)]),
        first_rates,
    )


def _next(following: Int[np.ndarray, " N"], count: int) -> Int[np.ndarray, " p"]:
    """Return the place of the next stage's entry for `count` entries a stage, −1 past the end."""
    place = count * following[:, None] + np.arange(count)
    place[following >= len(following)] = -1
    return place.ravel()


def _joined(shifts: Sequence[Int[np.ndarray, " _"]]) -> Int[np.ndarray, " m"]:
    """Return the places of all parts, one after the other; past the end stands for zero."""
    sizes = [len(shift) for shift in shifts]
    starts, total = np.cumsum([0, *sizes[:-1]]), sum(sizes)
    parts = [np.where(part < 0, total, part + start) for part, start in zip(shifts, starts, strict=True)]
    return np.concatenate(parts)


# What a solve is given less from now on after it was late, and more after it was not [s]: one of ten will be late.
_LONGER, _SHORTER = 18e-6, 2e-6
_AFTER = 5e-5  # what a step does after its solve [s]


class Constrained:
    """The QPs of a step, which share the plan that they start from and differ in their rows.

    Parameters
    ----------
    hard, soft
        All rows hard; and soft where the limits say so, None where none is.
    solver
        Name of the solver of both.
    settings
        The solver's own settings, for both.
    """

    def __init__(self, hard: Program, soft: Program | None, solver: str, settings: Mapping[str, Any] | None) -> None:
        named(solver)
        if settings is not None:
            checks.kind(settings, "settings", Mapping, 'pass the solver\'s own by name, for example {"max_iter": 100}')
        self._hard = Solve(hard, solver, settings or {})
        self._soft = None if soft is None else Solve(soft, solver, {**SOFT_SETTINGS[solver], **(settings or {})})

    def update(self, hard: Program, soft: Program | None) -> None:
        """Go on with new matrices of the same size; the warm starts are kept."""
        self._hard.update(hard)
        if self._soft is not None and soft is not None:
            self._soft.update(soft)

    def cool(self) -> None:
        """Forget the warm starts."""
        self._hard.warm = False
        if self._soft is not None:
            self._soft.warm = False

    def reset(self) -> None:
        """Forget all earlier solves, so that a run repeats to the bit."""
        self.cool()
        for solve in (self._hard, self._soft):
            if solve is not None:
                solve.reset()

    def solve(
        self, v: Float[np.ndarray, " nv"], room: Interval | None, deadline: float | None
    ) -> tuple[QPSolution, float]:
        """Return the least deviation from the plan v, w of D w, and how far a soft limit gave way, 0 where none did.

        Parameters
        ----------
        room
            How far each input is from its limits, lower and upper, where a hard rate limits it: where the two
            exclude each other the input limit wins.
        deadline
            The time by `perf_counter` at which the answer is due.
        """
        found, conflict = self._hard.solve(v, room, deadline)
        if self._soft is None or found.status is Status.TIME_LIMIT:
            return found, conflict
        iterations = found.iterations
        if found.status is Status.OPTIMAL and (np.abs(found.y) <= self._hard.program.most).all():
            self._soft.warm = False
            return found, conflict
        found, conflict = self._soft.solve(v, room, deadline)
        nw = self._hard.size
        program, slacks = self._soft.program, found.v[nw:]
        given = slacks > program.allowance
        gave_way = max(conflict, float((slacks * program.slack_unit)[given].max(initial=0.0)))
        found.v, found.iterations = found.v[:nw], iterations + found.iterations
        return found, gave_way


class Solve:
    """One QP, its solver, and the last solution, which the next solve starts from moved on by one step.

    A solver looks at the clock only now and then: it gets the time until the deadline less what earlier solves took
    too long, and half of it at least.
    """

    def __init__(self, program: Program, solver: str, settings: Mapping[str, Any]) -> None:
        self.program, self.warm = program, False
        self._solver = named(solver)(program.qp, settings)
        self.size = n = len(program.qp.q)
        m = len(program.low)
        self._primal, self._dual = np.zeros(n + 1), np.zeros(m + 1)  # one more, always zero, for the shift
        self._cold = np.zeros(n), np.zeros(m)
        self._moved = np.zeros(m)  # rows of slacks stay
        self._tail = 0.0  # by how much solves outlast the time they are given [s]

    def update(self, program: Program) -> None:
        """Go on with new matrices of the same size."""
        self.program = program
        self._solver.update(program.qp)

    def reset(self) -> None:
        """Forget what earlier solves left behind in the solver."""
        self._solver.reset()

    def solve(
        self, v: Float[np.ndarray, " nv"], room: Interval | None, deadline: float | None
    ) -> tuple[QPSolution, float]:
        """Return the solution, and how far the input limits are out of the hard rates' reach."""
        program, solver, conflict = self.program, self._solver, 0.0
        moved = self._moved
        np.multiply(v[program.source], program.scale, out=moved[: len(program.source)])
        if room is None:
            solver.shift(moved)
        else:
            low, high = program.low.copy(), program.high.copy()
            rows, which = program.rates
            scale = program.scale[rows]
            lowest = np.minimum(low[rows], room.high[which] * scale)
            highest = np.maximum(high[rows], room.low[which] * scale)
            below, above = lowest < low[rows], highest > high[rows]  # never where there is no limit
            past = np.where(below, low[rows], 0.0) - np.where(below, lowest, 0.0)
            past += np.where(above, highest, 0.0) - np.where(above, high[rows], 0.0)
            conflict = float((past / scale)[past > 1e-9].max(initial=0.0))
            low[rows], high[rows] = lowest, highest
            solver.set_bounds(low - moved, high - moved)
        start = self._cold
        if self.warm and not solver.goes_on:
            start = self._primal[program.shift_primal], self._dual[program.shift_dual]
        if deadline is None:
            found = solver.solve(*start)
        else:
            left = deadline - perf_counter()
            found = solver.solve(*start, time_limit=left - min(self._tail, left / 2))
            if found.status is Status.TIME_LIMIT:
                late = perf_counter() > deadline - _AFTER
                self._tail = max(self._tail + (_LONGER if late else -_SHORTER), 0.0)
        self.warm = found.status is Status.OPTIMAL
        if self.warm and not solver.goes_on:
            self._primal[:-1], self._dual[:-1] = found.v, found.y
        return found, conflict
