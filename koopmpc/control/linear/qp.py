"""The QP of one step: deviations w from the unconstrained plan, within limits that move with it."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from koopmpc.control.cost import LiftedTracking
from koopmpc.control.limits import Interval, Softness
from koopmpc.control.linear.condense import Condensed, row_sizes
from koopmpc.control.linear.horizon import Horizon
from koopmpc.control.solvers.qp import StepQP


class Group(NamedTuple):
    """Rows of a plan that have the same limits in each of len(next) stages, and the stage that follows each stage.

    `next` is len(next) past the end: a plan ends unconstrained.
    """

    bounds: Interval
    softness: Softness
    next: Int[np.ndarray, " n"]


class _Rows(NamedTuple):
    """Rows of the QP from one kind of limit, see `StepQP`, and the row of the next stage of each."""

    source: Int[np.ndarray, " p"]
    scale: Float[np.ndarray, " p"]
    low: Float[np.ndarray, " p"]
    high: Float[np.ndarray, " p"]
    linear: Float[np.ndarray, " p"]
    quadratic: Float[np.ndarray, " p"]
    allowance: Float[np.ndarray, " p"]
    next: Int[np.ndarray, " p"]


def groups(tracking: LiftedTracking, horizon: Horizon) -> list[Group]:
    """Return the limits of a plan [moves; their changes, where they have limits; outputs], stage by stage.

    The next stages are a step on: of outputs the next, of moves the one that then holds.
    """
    moves, N, nu = len(horizon.blocks), horizon.N, horizon.B.shape[1]
    starts = np.cumsum([0, *horizon.blocks[:-1]])
    held = np.append(np.repeat(np.arange(moves), horizon.blocks), moves)[starts + 1]
    hard = Softness(np.full(nu, np.inf), np.zeros(nu), np.zeros(nu))
    result = [Group(tracking.inputs, hard, held)]
    if tracking.rates is not None:
        result.append(Group(tracking.rates, tracking.rate_softness, held))
    return [*result, Group(tracking.outputs, tracking.softness, np.arange(1, N + 1))]


def step_qp(maps: Condensed, limits: Sequence[Group]) -> StepQP:
    """Return the QP of a condensed horizon under these limits.

    Every row is measured by the norm of its row of D, so that the price of its violation is, too.
    """
    D, unit = maps.deviation, maps.unit
    parts: list[_Rows] = []
    rate_rows = rate_inputs = np.zeros(0, dtype=np.intp)
    first = 0
    for i, (group, size) in enumerate(zip(limits, _sizes(D, limits), strict=True)):
        picked = np.flatnonzero(np.isfinite(group.bounds.low) | np.isfinite(group.bounds.high))
        if i == 1 and len(limits) == 3:  # the changes of the inputs
            hard = np.flatnonzero(np.isinf(group.softness.linear[picked]))
            rate_rows, rate_inputs = sum(len(part.source) for part in parts) + hard, picked[hard]
        parts.append(_rows(group, size, picked, first, unit))
        first += len(size) * len(group.next)
    columns: list[Any] = [np.concatenate([part[i] for part in parts]) for i in range(len(_Rows._fields))]
    rows = _Rows(*columns)
    return StepQP(
        P=maps.hessian,
        q=np.zeros(len(maps.hessian)),
        A=D[rows.source] * rows.scale[:, None],
        low=rows.low,
        high=rows.high,
        softness=Softness(rows.linear, rows.quadratic, rows.allowance),
        source=rows.source,
        scale=rows.scale,
        shift_primal=_joined([_next(limits[0].next, len(limits[0].bounds.low))]),
        shift_dual=_joined([part.next for part in parts]),
        rate_rows=rate_rows,
        rate_inputs=rate_inputs,
    )


def _sizes(deviation: Float[np.ndarray, "nv nw"], limits: Sequence[Group]) -> list[Float[np.ndarray, " n"]]:
    """Return the size of each group's rows."""
    counts = [len(group.bounds.low) * len(group.next) for group in limits]
    parts = np.split(deviation, np.cumsum(counts)[:-1])
    return [row_sizes(part, len(group.next)) for part, group in zip(parts, limits, strict=True)]


def _rows(
    group: Group, size: Float[np.ndarray, " width"], picked: Int[np.ndarray, " r"], first: int, unit: float
) -> _Rows:
    """Return the limited rows `picked` of all stages of a group that begins at the entry `first` of a plan."""
    N, size_of = len(group.next), size[picked]
    (low, high), (linear, quadratic, allowance) = group.bounds, group.softness
    return _Rows(
        source=(first + len(size) * np.arange(N)[:, None] + picked).ravel(),
        scale=np.tile(1 / size_of, N),
        low=np.tile(low[picked] / size_of, N),
        high=np.tile(high[picked] / size_of, N),
        linear=np.tile(linear[picked] * size_of / (2 * unit), N),
        quadratic=np.tile(quadratic[picked] * size_of**2 / (2 * unit), N),
        allowance=np.tile(allowance[picked], N),
        next=_next(group.next, len(picked)),
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
