"""The rows of a plan: their limits, how soft they are, in which size, and the QP of the deviation within them."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc.control.cost import LiftedTracking
from koopmpc.control.horizon import Condensed, Horizon
from koopmpc.control.limits import Interval, Softness, preview_margin
from koopmpc.control.solvers.base import StepQP
from koopmpc.control.solvers.stages import QPStages
from koopmpc.control.terminal.sets import EndRows


class PlanLimits(NamedTuple):
    """The limits of every entry of a plan [moves; their changes, where they have limits; outputs], stage by stage.

    `size` is the norm of the entry's row of D, root mean square of all stages. `next` is the entry that takes the place
    of this one when the plan moves on by one step: the same output one step later, or the move that holds then. Where
    the plan has ended by then, it is the number of entries. `kept` are those that have a limit, or may get one in time.
    """

    low: Float[np.ndarray, " nv"]
    high: Float[np.ndarray, " nv"]
    softness: Softness
    size: Float[np.ndarray, " nv"]
    next: Int[np.ndarray, " nv"]
    kept: Bool[np.ndarray, " nv"]


def measure_rows(rows: Float[np.ndarray, "m nw"], stages: int) -> Float[np.ndarray, " n"]:
    """Return the norm of the rows of a stage, root mean square of all stages; 1 for rows that nothing moves."""
    squares = (rows**2).sum(axis=1).reshape(stages, -1).mean(axis=0)
    return np.sqrt(np.where(squares > 0, squares, 1.0))


def limit_plan(
    track: LiftedTracking,
    horizon: Horizon,
    D: Float[np.ndarray, "nv nw"],
    end: EndRows | None,
    held: Bool[np.ndarray, "moves nu"],
) -> PlanLimits:
    """Return the limits of a plan whose entries move by D w; moves that are `held` need none of their own."""
    moves, N, nu = len(horizon.blocks), horizon.N, horizon.B.shape[1]
    starts = np.cumsum([0, *horizon.blocks[:-1]])
    following = np.append(np.repeat(np.arange(moves), horizon.blocks), moves)[starts + 1]
    none, can_move = np.zeros(nu), track.movable
    groups = [(track.inputs, Softness(np.full(nu, np.inf), none, none), following, can_move.inputs)]
    if track.rates is not None:
        groups.append((track.rates, track.rate_softness, following, can_move.rates))
    every = np.ones(len(track.outputs.low), np.bool_)
    groups.append((track.outputs, track.softness, np.arange(1, N + 1), every))
    ends = 0 if end is None else len(end.F)
    if end is not None:  # the set stays where it is from step to step; cuts take the place of a ball's limits
        high = np.full(ends, np.inf if end.ball else 1.0)
        softness = track.limits.end_softness(ends, track.sizes.scale)
        groups.append((Interval(np.full(ends, -np.inf), high), softness, np.zeros(1, dtype=np.intp), np.isfinite(high)))
    parts: list[list[np.ndarray]] = []
    first = 0
    for bounds, softness, after, kept in groups:
        stages, width = len(after), len(bounds.low)
        size = measure_rows(D[first : first + stages * width], stages)
        place = first + width * after[:, None] + np.arange(width)
        place[after >= stages] = len(D)
        parts.append([*(np.tile(each, stages) for each in (*bounds, *softness, size, kept)), place.ravel()])
        first += stages * width
    low, high, linear, quadratic, allowance, size, kept, place = (
        np.concatenate(part) for part in zip(*parts, strict=True)
    )
    if track.margin.any():
        margin = preview_margin(track.margin, N).ravel()
        last = len(low) - ends
        low[last - len(margin) : last] += margin
        high[last - len(margin) : last] -= margin
    free = _list_held(held, track)
    low[free], high[free], kept[free] = -np.inf, np.inf, False
    return PlanLimits(low, high, Softness(linear, quadratic, allowance), size, place, kept)


def _list_held(held: Bool[np.ndarray, "moves nu"], track: LiftedTracking) -> Int[np.ndarray, " n"]:
    """Return the entries of inputs that keep their value, except those that a search over levels needs, and rates."""
    searched = np.zeros(held.shape[1], dtype=np.bool_)
    levels = track.limits.base.input_levels(held.shape[1]) if held.any() else None
    if levels is not None:
        searched[levels.which] = True
    rows = np.flatnonzero((held & ~searched).ravel())
    return rows if track.rates is None else np.append(rows, held.size + np.flatnonzero(held.ravel()))


def build_qp(maps: Condensed, limits: PlanLimits, changes: int, stages: QPStages | None) -> StepQP:
    """Return the QP of a condensed horizon under these limits, so many of each move's changes having some.

    Every row is measured by the norm of its row of D, so that the price of its violation is, too.
    """
    D, unit, n = maps.deviation, maps.unit, len(maps.hessian)
    source = np.flatnonzero(limits.kept)
    size, (linear, quadratic, allowance) = limits.size[source], limits.softness
    row = np.full(len(D) + 1, len(source))
    row[source] = np.arange(len(source))
    first = np.arange(n, n + changes)
    hard = first[limits.kept[first] & np.isinf(linear[first])]
    return StepQP(
        P=maps.hessian,
        q=np.zeros(n),
        A=D[source] * (1 / size)[:, None],
        low=limits.low[source] * (1 / size),
        high=limits.high[source] * (1 / size),
        softness=Softness(
            linear[source] * size / (2 * unit), quadratic[source] * size**2 / (2 * unit), allowance[source]
        ),
        source=source,
        scale=1 / size,
        shift_primal=np.minimum(limits.next[:n], n),
        shift_dual=row[limits.next[source]],
        rate_rows=row[hard],
        rate_inputs=hard - n,
        stages=stages,
    )
