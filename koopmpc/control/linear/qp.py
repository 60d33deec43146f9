"""The QP of one step: deviations w from the unconstrained plan, slacks ε of soft rows, limits that move with it."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import block_diag

from koopmpc.control.cost import LiftedTracking
from koopmpc.control.limits import Interval, Softness, allowance
from koopmpc.control.linear.condense import Condensed, row_sizes
from koopmpc.control.linear.horizon import Horizon
from koopmpc.control.solvers.base import StepQP


class Group(NamedTuple):
    """Rows of a plan that have the same limits in each of len(next) stages, and the stage that follows each stage.

    `next` is len(next) past the end: a plan ends unconstrained.
    """

    bounds: Interval
    softness: Softness
    next: Int[np.ndarray, " n"]


class _Block(NamedTuple):
    """Rows of the QP from one kind of limit: entries of the plan, limits, the row after each, its ε and the ε's sign.

    `linear` is the slack weight of each row, inf where it is hard. `rates` are the rows and the inputs of the first
    changes that are limited hard.
    """

    source: Int[np.ndarray, " p"]
    low: Float[np.ndarray, " p"]
    high: Float[np.ndarray, " p"]
    next: Int[np.ndarray, " p"]
    sign: float
    slack: Int[np.ndarray, " p"]
    linear: Float[np.ndarray, " p"]


def groups(tracking: LiftedTracking, horizon: Horizon) -> list[Group]:
    """Return the limits of a plan [moves; their changes, where they have limits; outputs], stage by stage.

    The next stages are a step on: of outputs the next, of moves the one that then holds.
    """
    moves, N, nu = len(horizon.blocks), horizon.N, horizon.B.shape[1]
    starts = np.cumsum([0, *horizon.blocks[:-1]])
    held = np.append(np.repeat(np.arange(moves), horizon.blocks), moves)[starts + 1]
    hard = Softness(np.full(nu, np.inf), np.zeros(nu))
    result = [Group(tracking.inputs, hard, held)]
    if tracking.rates is not None:
        result.append(Group(tracking.rates, tracking.rate_softness, held))
    return [*result, Group(tracking.outputs, tracking.softness, np.arange(1, N + 1))]


def step_qp(maps: Condensed, limits: Sequence[Group], *, soft_rows: bool) -> StepQP:
    """Return the QP of a condensed horizon under these limits; without `soft_rows` every row is hard.

    Every row is measured by the norm of its row of D.
    """
    D, unit = maps.deviation, maps.unit
    nw = D.shape[1]
    sizes = _sizes(D, limits)
    blocks: list[_Block] = []
    shifts = [_next(limits[0].next, len(limits[0].bounds.low))]
    weights: list[tuple[Float[np.ndarray, " _"], ...]] = []
    rate_rows = rate_inputs = np.zeros(0, dtype=np.intp)
    first, slacks = 0, 0
    for i, (group, size) in enumerate(zip(limits, sizes, strict=True)):
        width, N = len(size), len(group.next)
        bounds = Interval(group.bounds.low / size, group.bounds.high / size)
        softness = Softness(group.softness.linear * size, group.softness.quadratic * size**2)
        limited = np.isfinite(bounds.low) | np.isfinite(bounds.high)
        gives = np.isfinite(softness.linear) & soft_rows
        soft, hard = np.flatnonzero(limited & gives), np.flatnonzero(limited & ~gives)
        if i == 1 and len(limits) == 3:  # the changes of the inputs
            truly = np.flatnonzero(np.isinf(softness.linear[hard]))
            rate_rows, rate_inputs = sum(len(b.source) for b in blocks) + truly, hard[truly]
        blocks += _blocks(group.next, bounds, softness.linear, hard, soft, first, slacks)
        shifts.append(_next(group.next, len(soft)))
        of_stage = softness.linear, softness.quadratic, allowance(group.bounds) / size, size
        weights.append(tuple(np.tile(weight[soft], N) for weight in of_stage))
        first, slacks = first + width * N, slacks + len(soft) * N
    source = np.concatenate([block.source for block in blocks])
    scale = 1 / np.concatenate([np.tile(size, len(g.next)) for g, size in zip(limits, sizes, strict=True)])[source]
    relaxed = np.zeros((len(source), slacks))
    row = 0
    for block in blocks:
        if block.sign:
            relaxed[row + np.arange(len(block.source)), block.slack] = block.sign
        row += len(block.source)
    linear, quadratic, allowed, slack_unit = (np.concatenate(parts) for parts in zip(*weights, strict=True))
    free = np.full(slacks, np.inf)
    return StepQP(
        P=block_diag(maps.hessian, np.diag(quadratic / unit)),
        q=np.concatenate([np.zeros(nw), linear / (2 * unit)]),
        A=np.block([[D[source] * scale[:, None], relaxed], [np.zeros((slacks, nw)), np.eye(slacks)]]),
        low=np.concatenate([*(block.low for block in blocks), np.zeros(slacks)]),
        high=np.concatenate([*(block.high for block in blocks), free]),
        source=source,
        scale=scale,
        shift_primal=_joined(shifts),
        shift_dual=_joined([*(block.next for block in blocks), *shifts[1:]]),
        allowance=allowed,
        slack_unit=slack_unit,
        most=np.concatenate([*(block.linear / (2 * unit) for block in blocks), free]),
        rate_rows=rate_rows,
        rate_inputs=rate_inputs,
    )


def _sizes(deviation: Float[np.ndarray, "nv nw"], limits: Sequence[Group]) -> list[Float[np.ndarray, " n"]]:
    """Return the size of each group's rows."""
    counts = [len(group.bounds.low) * len(group.next) for group in limits]
    parts = np.split(deviation, np.cumsum(counts)[:-1])
    return [row_sizes(part, len(group.next)) for part, group in zip(parts, limits, strict=True)]


def _blocks(
    following: Int[np.ndarray, " N"],
    bounds: Interval,
    linear: Float[np.ndarray, " width"],
    hard: Int[np.ndarray, " h"],
    soft: Int[np.ndarray, " s"],
    first: int,
    slacks: int,
) -> Iterator[_Block]:
    """Yield the hard rows of a group, its soft upper ends, and its soft lower ends.

    The group begins at the entry `first` of a plan, and its slacks after `slacks` others.
    """
    N, width = len(following), len(bounds.low)
    stage = np.arange(N)[:, None]
    slack_of = np.full(width, -1)
    slack_of[soft] = np.arange(len(soft))
    ends = (hard, 0.0), (soft[np.isfinite(bounds.high[soft])], -1.0), (soft[np.isfinite(bounds.low[soft])], 1.0)
    for picked, sign in ends:
        none = np.full(len(picked), np.inf)
        yield _Block(
            (first + width * stage + picked).ravel(),
            np.tile(bounds.low[picked] if sign >= 0 else -none, N),
            np.tile(bounds.high[picked] if sign <= 0 else none, N),
            _next(following, len(picked)),
            sign,
            (slacks + len(soft) * stage + slack_of[picked]).ravel(),
            np.tile(linear[picked], N),
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
