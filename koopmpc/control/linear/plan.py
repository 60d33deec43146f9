"""The plan of a horizon: the unconstrained one as a matrix, its limits, and the QP where it meets one."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc import checks
from koopmpc.checks import HUGE
from koopmpc.control.cost import LiftedTracking, add_held
from koopmpc.control.horizon import (
    Condensed,
    Coordinates,
    Horizon,
    Terminal,
    WeightRows,
    build_stages,
    condense,
    horizon_of,
)
from koopmpc.control.limits import Interval, Softness, preview_margin
from koopmpc.control.linear.blocking import tie_moves
from koopmpc.control.linear.layout import WindowLayout
from koopmpc.control.linear.moving import GivenShares, MovingMap, PlanParts
from koopmpc.control.riccati import Law, Stage, recursion
from koopmpc.control.solvers.ball import Ball, make_ball
from koopmpc.control.solvers.base import StepQP
from koopmpc.control.solvers.stages import QPStages
from koopmpc.control.stepped.blocks import MoveBlocks
from koopmpc.control.target import ROUNDING, Targets, Units, targets_of
from koopmpc.control.terminal.inclusion import EndReach
from koopmpc.control.terminal.sets import EndRows, read_end
from koopmpc.control.terminal_cost import terminal_of
from koopmpc.predict.predictors import LinearPredictor
from koopmpc.values import Viewing

_LONG = 2**13  # entries of a preview's share of a plan from which on a bound on it saves time


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


class PlanKind(NamedTuple):
    """Whether a plan knows a constant disturbance, a periodic one, and its QP before condensing, a stage a step."""

    disturbed: bool
    periodic: bool
    staged: bool


class PlanMap(Viewing):
    """t = M [z; u_{−1}; g; 1]: the unconstrained plan, which is the optimum where low ≤ t ≤ high.

    t = [v; lowest and highest target], v the plan as in `Condensed`. u_{−1} is there where the change of inputs is
    weighed or limited, g = [w_0 … w_{N−1}; d] where disturbances are known. The last column of M is rewritten for
    each reference. Where there is a g, it is that of targets that no limit moves, for g moves them, too: the last rows
    of t are the lowest and highest values of the limits `checked`, and show whether a target has to be moved inside.

    Parameters
    ----------
    track, targets
        What is tracked and limited, and the equilibria.
    horizon, maps
        The horizon and what `condense` made of it.

    Attributes
    ----------
    blocks
        Lengths of the blocks of steps in which an input is held.
    held, tied
        Which inputs keep their value from move to move; which of these moves have no limits of their own.
    moves, planned
        Entries of the inputs, which come first, and of v.
    box, inside
        Limits of the inputs of all moves, and values of the last rows of t that meet their limits.
    limits, low, high
        The limits of t where none move in time, lower ones first, and those of this step.
    limited_targets, row_size
        Which limited values of a target have limits, or may get some in time; the size of each row of the QP.
    deviation
        How a solution w of the QP moves the inputs.
    disturbance
        (nz, ng) what g adds to z⁺ at the end of the horizon.
    aimed, aims_inside
        Whether a target enters the plan, and whether the last column of M is that of targets inside the limits.
    qp
        The QP of w.
    end, ends
        The rows of a terminal set, and how many there are: the last entries of v.
    ball
        The entries of v that a terminal ellipsoid limits; their limits here are those of a box inside it.
    given, offset
        The share of rows of a given u_target, moved by a price, None where there are none; what a plan begins with.
    moving, single
        The maps of a reference that moves: of a preview, and of one row that is held over the horizon.
    is_long
        Whether a preview is so long that its first input is worth a bound; see `FirstInput`.
    met
        A byte for each limit, met or not; `met_low` and `met_high` are views of the lower and of the upper ones.
    """

    _VIEWS = ("met", "met_low", "met_high", "low", "high")
    layout: WindowLayout | None = None  # where rows of limits stand in a table, once there are some
    reach: EndReach | None = None  # the extremes on the terminal set, once there are rows of limits
    terminal: Terminal  # what the end of the horizon costs, in its units

    def __init__(
        self,
        track: LiftedTracking,
        targets: Targets,
        horizon: Horizon,
        maps: Condensed,
        end: EndRows | None,
        held: Bool[np.ndarray, "moves nu"],
        buffer: Float[np.ndarray, " n"],
        stages: QPStages | None = None,
    ) -> None:
        self.track, self.targets = track, targets
        self.moves, self.blocks = len(maps.hessian), horizon.blocks
        self.deviation = maps.deviation[: self.moves]
        limits = _plan_limits(track, horizon, maps.deviation, end)
        if held.any():
            _drop_held(limits, held, track)
        self.qp = _step_qp(maps, limits, 0 if track.rates is None else len(track.inputs.low), stages)
        low, high, nv = limits.low, limits.high, len(limits.low)
        self.ball: Ball | None = None
        self.end, self.ends = end, 0 if end is None else len(end.F)
        if end is not None and end.ball:
            softness = track.limits.end_softness(len(end.F), track.sizes.scale)
            self.ball = make_ball(softness, maps.deviation, maps.unit, nv - len(end.F))
            low[self.ball.rows], high[self.ball.rows] = -self.ball.inner, self.ball.inner
        last, first = horizon.rest_disturbance(), np.zeros((nv, 0))
        self.disturbance = np.zeros((len(horizon.A), 0)) if last is None else last[:, :-1]
        driven = self.disturbance.shape[1] > 0
        self.limited_targets = np.concatenate([track.movable.inputs, np.ones(len(track.outputs.low), np.bool_)])
        self.row_size = limits.size[self.qp.source]
        self.checked = np.zeros(len(targets.low), dtype=np.bool_)
        self.aimed = bool(maps.from_target.any())
        self.maps = _fold_targets(maps, targets) if self.aimed else maps
        if driven:
            first = maps.from_drive
        if driven and self.aimed:
            self.checked = checked = self.limited_targets
            from_disturbance = targets.from_disturbance @ self.disturbance
            every = maps.from_target.reshape(nv, horizon.N + 1, -1).sum(axis=1)
            moved = (targets.rows @ from_disturbance + targets.rows_disturbance @ self.disturbance)[checked]
            first = np.vstack([first + every @ from_disturbance, moved, moved])
            free = np.full(len(moved), np.inf)
            t_low, t_high = targets.low[checked], targets.high[checked]
            reach = ROUNDING * targets.size[checked]
            low = np.concatenate([low, t_low - reach, -free])
            high = np.concatenate([high, free, t_high + reach])
        self.planned, self.aims_inside = nv, self.aimed and not driven
        self.limits = np.concatenate([np.maximum(low, -HUGE), np.minimum(high, HUGE)])  # inf meets no limit
        self.low, self.high = self.limits[: len(low)], self.limits[len(low) :]
        self.box = Interval(*(np.tile(end, len(horizon.blocks)) for end in track.inputs))
        self.held, self.tied = held, held.ravel() & ~limits.kept[: self.moves]
        self.inside = np.clip(0.0, self.low[nv:], self.high[nv:])
        from_state = np.zeros((len(low), horizon.size))
        from_state[:nv] = maps.from_state
        self.matrix = np.ascontiguousarray(np.column_stack([from_state, first, np.zeros(len(low))]))
        asked = add_held(track.given, track.shift)
        self.given, self.offset = None, self.maps.offset
        if asked is not None:
            given = GivenShares(self.maps.from_given, np.vstack([asked, np.tile(asked[-1], (horizon.N, 1))]))
            if given.last:
                self.given = given
            else:
                self.offset = self.offset + given.at(0)
        self._see()
        fixed, count = self.matrix[:, :-1], int(self.limited_targets.sum())
        parts = PlanParts(
            fixed=fixed[:nv],
            offset=self.offset,
            from_reference=self.maps.from_reference,
            box=Interval(self.low[:nv], self.high[:nv]),
            targets=targets if self.aimed else None,
            limited=self.limited_targets,
            buffer=buffer,
            drive=fixed[nv : nv + count] if len(fixed) > nv else np.zeros((count, fixed.shape[1])),
            driven=driven,
        )
        nr = len(track.tracked)
        self.moving, self.single = MovingMap.of(parts, nr)
        tabled = self.given is None or self.given.table is not None
        few = self.planned < len(self.low) or self.maps.from_reference.size < _LONG
        self.is_long = self.moving is not None and tabled and not few
        self.row_shape, self.rows_shape = (nr,), (horizon.N + 1, nr)

    def restore_limits(self) -> None:
        """Set the limits that hold where none move in time."""
        for part in (self, self.moving, self.single):
            if part is not None:
                half = len(part.limits) // 2
                part.low, part.high = part.limits[:half], part.limits[half:]

    def _see(self) -> None:
        """Make the bytes and their views; see `Viewing`."""
        rows = len(self.limits) // 2
        self.low, self.high = self.limits[:rows], self.limits[rows:]
        self.met = bytearray(2 * rows)
        met = np.frombuffer(self.met, dtype=np.bool_)
        self.met_low, self.met_high = met[:rows], met[rows:]


@checks.explain_overflow()
def plan_map(
    predictor: LinearPredictor,
    track: LiftedTracking,
    moves: MoveBlocks,
    coordinates: Coordinates,
    buffer: Float[np.ndarray, " n"],
    kind: PlanKind,
    rows: WeightRows | None = None,
    like: PlanMap | None = None,
) -> PlanMap:
    """Return the plan of a predictor: its horizon, solved by the Riccati recursion, condensed, and limited.

    `rows` are weights in time; then the plan may have the targets and the end of another one, `like`, which differs by
    them alone.
    """
    targets, units = targets_of(predictor, track) if like is None else like.targets, Units.of(predictor, track)
    aims, cost = units.targets(targets), units.cost(track.cost)
    horizon = horizon_of(predictor, track, moves.lengths, disturbed=kind.disturbed, periodic=kind.periodic, rows=rows)
    own = horizon.in_units(units)
    parts = build_stages(own, aims)
    end = terminal_of(predictor, cost, own, aims, units.inverse) if like is None else like.terminal
    law = recursion(parts, end.P, end.p)
    wanted = track.limits.terminal
    last = None if wanted is None else read_end(wanted, predictor)
    maps = condense(own, law, end, aims, units, "riccati" if moves.own else coordinates, last)
    if moves.own:
        maps = tie_moves(maps, moves.held)
    if track.pull is not None:  # an end of one's own does not count the price
        counted = horizon.N + (track.cost.Q_N is None)
        pulled = np.concatenate([np.tile(track.pull, counted), np.zeros((horizon.N + 1 - counted) * len(track.pull))])
        maps = replace(maps, offset=maps.offset + maps.from_reference @ pulled)
    scaled = _scale_deviation(maps, track.inputs, len(moves.lengths))
    stages = None
    plain = not moves.own and last is None and len(horizon.blocks) == horizon.N
    if kind.staged and plain and maps.coordinates == "riccati":
        columns = np.diagonal(scaled.deviation) / np.diagonal(maps.deviation)
        stages = _keep_stages(own, parts[0], law, end.P, units, columns, units.scale / scaled.unit)
    plan = PlanMap(track, targets, horizon, scaled, last, moves.held, buffer, stages)
    plan.terminal = end
    return plan


def _keep_stages(
    h: Horizon,
    stage: Stage,
    law: Law,
    P: Float[np.ndarray, "nx nx"],
    units: Units,
    columns: Float[np.ndarray, " n"],
    share: float,
) -> QPStages:
    """Return the QP of a horizon without blocks, in these units; `share` is the share of its cost in that of the QP."""
    nz, nu = h.B.shape
    M = np.zeros((h.size, nu)) if stage.M is None else stage.M
    size = np.sqrt(float((law.L[0] ** 2).sum()) / nu)
    inputs, none = np.diag(units.inputs), np.zeros((nu, h.size))
    rows = [np.hstack([inputs, none, 0.0 * inputs])]
    if h.bounded:
        rows.append(np.hstack([inputs, none, -inputs]))
    beside = np.zeros((len(h.G), nu))
    rows.append(np.hstack([beside, units.limited[:, None] * h.G, np.zeros((len(h.G), h.size - nz)), beside]))
    return QPStages(
        A=stage.A,
        B=stage.B,
        W=share * np.block([[stage.Q, M], [M.T, stage.R]]),
        P=share * P,
        rows=np.vstack(rows),
        groups=(nu, nu * h.bounded, len(h.G)),
        factors=law.L.transpose(0, 2, 1) / (size * columns.reshape(h.N, nu, 1)),
        K=law.K,
    )


def _fold_targets(maps: Condensed, targets: Targets) -> Condensed:
    """Return the maps of F_α (α − ᾱ) in place of F_α α, ᾱ(r) the coordinates as if there were no limits.

    Where no limit moves a target, the last term is zero, and F_r r + f is the whole share of the reference.
    """
    rows, steps = len(maps.from_target), maps.from_reference.shape[1] // targets.from_reference.shape[1]
    each = maps.from_target.reshape(rows, steps, len(targets.offset))
    from_reference = maps.from_reference + (each @ targets.from_reference).reshape(rows, -1)
    return replace(maps, from_reference=from_reference, offset=maps.offset + each.sum(axis=1) @ targets.offset)


def _scale_deviation(maps: Condensed, inputs: Interval, stages: int) -> Condensed:
    """Return the same maps for a w of which 1 moves the input with the most room, of its span, to its limit."""
    D, n = maps.deviation, len(maps.hessian)
    curvature = np.diag(maps.hessian).reshape(stages, -1).mean(axis=0)
    columns = np.tile(1 / np.sqrt(curvature), stages)
    reach = 0.5 * (inputs.high - inputs.low) / _row_sizes(D[:n] * columns, stages)
    known = reach[np.isfinite(reach) & (reach > 0)]
    size = float(known.max()) if known.size else 1.0
    columns, share = size * columns, size**2
    hessian = maps.hessian * np.outer(columns, columns) / share
    return replace(maps, deviation=D * columns, hessian=hessian, unit=maps.unit * share)


def _row_sizes(rows: Float[np.ndarray, "m nw"], stages: int) -> Float[np.ndarray, " n"]:
    """Return the norm of the rows of a stage, root mean square of all stages; 1 for rows that nothing moves."""
    squares = (rows**2).sum(axis=1).reshape(stages, -1).mean(axis=0)
    return np.sqrt(np.where(squares > 0, squares, 1.0))


def planned_states(
    predictor: LinearPredictor,
    move_of: Int[np.ndarray, " N"],
    *,
    with_rates: bool,
    disturbed: bool,
    periodic: bool = False,
) -> Float[np.ndarray, "N1nx nvk"]:
    """Return the matrix that takes [moves; z; u_{−1}; w_0 … w_{N−1}; d; 1] to C z_0 … C z_N, one below the other.

    z_{k+1} = A z_k + B u_k + E w_k + d; u_{−1} is there `with_rates`, d where it is estimated. Move move_of[k] is u_k.
    """
    A, B, E, C, N = predictor.A, predictor.B, predictor.E, predictor.C, len(move_of)
    if periodic:  # [w_k; p_k] in place of w_k
        E = np.hstack([E, np.eye(len(A))])
    nx, nz, nu, nw = len(C), len(A), B.shape[1], E.shape[1]
    from_z = np.empty((N + 1, nx, nz))  # C Aᵏ
    from_z[0] = C
    for k in range(N):
        from_z[k + 1] = from_z[k] @ A
    from_u, from_w = np.zeros((N + 1, nx, int(move_of[-1]) + 1, nu)), np.zeros((N + 1, nx, N, nw))
    through_B, through_E = from_z @ B, from_z @ E
    for j in range(N):  # what acts at step j moves all states after it
        from_u[j + 1 :, :, move_of[j]] += through_B[: N - j]
        from_w[j + 1 :, :, j] = through_E[: N - j]
    parts = [from_u, from_z, np.zeros((N + 1, nx, nu * with_rates)), from_w]
    if disturbed:
        parts.append(np.concatenate([np.zeros((1, nx, nz)), np.cumsum(from_z[:-1], axis=0)]))
    parts.append(np.zeros((N + 1, nx, 1)))
    return np.concatenate([part.reshape((N + 1) * nx, -1) for part in parts], axis=1)


def _plan_limits(
    track: LiftedTracking, horizon: Horizon, D: Float[np.ndarray, "nv nw"], end: EndRows | None
) -> PlanLimits:
    """Return the limits of a plan whose entries move by D w."""
    moves, N, nu = len(horizon.blocks), horizon.N, horizon.B.shape[1]
    starts = np.cumsum([0, *horizon.blocks[:-1]])
    held = np.append(np.repeat(np.arange(moves), horizon.blocks), moves)[starts + 1]
    none, can_move = np.zeros(nu), track.movable
    groups = [(track.inputs, Softness(np.full(nu, np.inf), none, none), held, can_move.inputs)]
    if track.rates is not None:
        groups.append((track.rates, track.rate_softness, held, can_move.rates))
    every = np.ones(len(track.outputs.low), np.bool_)
    groups.append((track.outputs, track.softness, np.arange(1, N + 1), every))
    ends = 0 if end is None else len(end.F)
    if end is not None:  # the set stays where it is from step to step; cuts take the place of a ball's limits
        high = np.full(ends, np.inf if end.ball else 1.0)
        softness = track.limits.end_softness(ends, track.sizes.scale)
        groups.append((Interval(np.full(ends, -np.inf), high), softness, np.zeros(1, dtype=np.intp), np.isfinite(high)))
    parts: list[list[np.ndarray]] = []
    first = 0
    for bounds, softness, following, kept in groups:
        stages, width = len(following), len(bounds.low)
        size = _row_sizes(D[first : first + stages * width], stages)
        place = first + width * following[:, None] + np.arange(width)
        place[following >= stages] = len(D)
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
    return PlanLimits(low, high, Softness(linear, quadratic, allowance), size, place, kept)


def _drop_held(limits: PlanLimits, held: Bool[np.ndarray, "moves nu"], track: LiftedTracking) -> None:
    """Remove the limits of inputs that keep their value, and of their changes; the search over levels needs its own."""
    nu = held.shape[1]
    levels = track.limits.base.input_levels(nu)
    searched = np.zeros(nu, dtype=np.bool_)
    if levels is not None:
        searched[levels.which] = True
    rows = np.flatnonzero((held & ~searched).ravel())
    if track.rates is not None:
        rows = np.append(rows, held.size + np.flatnonzero(held.ravel()))
    limits.low[rows], limits.high[rows], limits.kept[rows] = -np.inf, np.inf, False


def _step_qp(maps: Condensed, limits: PlanLimits, changes: int, stages: QPStages | None) -> StepQP:
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
        low=limits.low[source] / size,
        high=limits.high[source] / size,
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
