"""The QP of one step: deviations w from the unconstrained plan, slacks ε of soft rows, limits that move with z."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from koopmpc.control.limits import Box, Softness, allowance
from koopmpc.control.solvers.base import QP
from koopmpc.control.units import row_sizes


class Group(NamedTuple):
    """Rows of v that have the same limits in each of len(next) stages, and the stage that follows each stage.

    `next` is len(next) past the end: a plan ends unconstrained.
    """

    box: Box
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
        box = Box(given.low / size, given.high / size)
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
