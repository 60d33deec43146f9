"""plan_condensed: a ControlTask becomes a CondensedProgram, its horizon solved by Riccati and condensed."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.errors import DataError
from koopmpc.control.ask.limits import Interval, Softness, preview_margin
from koopmpc.control.horizon import Condensed, Horizon, Terminal, WeightRows, build_stages, condense, horizon_of
from koopmpc.control.plan.condensed_program import (
    CondensedPlan,
    CondensedProgram,
    ConstantBounds,
    PlanBounds,
    StepBounds,
    find_reach,
)
from koopmpc.control.plan.in_time import BoundRows, PlansInTime, describe_bounds
from koopmpc.control.plan.task import ControlTask, tie_moves
from koopmpc.control.plan.tracking import EndRows, LiftedTracking, read_end, soften_end
from koopmpc.control.program import no_export, reference_table, refuse_time_limit
from koopmpc.control.riccati import Law, Stage, recursion
from koopmpc.control.solvers import FINISHER, order
from koopmpc.control.solvers.ball import make_ball
from koopmpc.control.solvers.base import StepQP
from koopmpc.control.solvers.daqp import daqp_settings
from koopmpc.control.solvers.priorities import spread_priorities
from koopmpc.control.solvers.stages import QPStages
from koopmpc.control.target import ROUNDING, Targets, Units, targets_of
from koopmpc.control.terminal_cost import terminal_of


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
        softness = soften_end(track.limits, ends, track.sizes.scale)
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
    searched = np.zeros(nu, dtype=np.bool_)  # a search over levels needs limits of held inputs, too
    levels = track.levels if held.any() else None
    if levels is not None:
        searched[levels.which] = True
    free = np.flatnonzero(np.concatenate([(held & ~searched).ravel(), held.ravel()][: 1 + (track.rates is not None)]))
    low[free], high[free], kept[free] = -np.inf, np.inf, False
    return PlanLimits(low, high, Softness(linear, quadratic, allowance), size, place, kept)


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


def plan_condensed(task: ControlTask) -> CondensedProgram:
    """Return the program of a task."""
    track, model, limits = task.track, task.predictor, task.track.limits
    targets = targets_of(model, track)
    plan, terminal = plan_matrices(task, targets)
    levels, blocks = track.levels, task.moves.lengths
    for what, given in (("levels", levels), ("a priority", limits.priority)):
        if given is not None and plan.ball is not None:
            raise DataError(f"the limits have {what} and a terminal ellipsoid; pass a polytope, or no terminal set")
    first = len(plan.deviation) * (1 if track.rates is None else 2)
    solved = limits.priority is not None and levels is None and not task.by_weights
    program = CondensedProgram(
        **vars(plan),
        controller="KoopmanMPC",
        model=model,
        targets=targets,
        inputs=track.inputs,
        rates=track.rates,
        given=_add_held(track.given, track.shift),
        reference=np.zeros((1, len(track.Q))),
        N=task.N,
        latency=task.latency,
        blocks=blocks,
        move_of=np.repeat(np.arange(len(blocks)), blocks),
        with_rates=track.with_rates,
        hard_rates=track.hard_rates,
        plans=None,
        step_bounds=_bound_steps(task, targets, plan),
        bounds=describe_bounds(task, targets, plan) if limits.in_time or limits.rows else None,
        input_levels=levels,
        priority=spread_priorities(limits, model.states, (first, task.N, len(plan.offset))) if solved else None,
        rule=task.estimator,
        time_limit=task.time_limit,
        solver_name="auto" if task.auto else task.solver,
        solver_settings=task.settings,
        settings=daqp_settings(task.settings if task.solver == FINISHER.name else None),
    )
    if not track.weighed:
        return program
    alike = replace(task, coordinates="plain" if plan.coordinates == "plain" else "riccati")
    plans = PlansInTime(track, task.N, task.latency, program, partial(_plan_again, alike, targets, terminal))
    plans.check_free_inputs()
    return replace(program, plans=plans)


def _plan_again(task: ControlTask, targets: Targets, terminal: Terminal, rows: WeightRows) -> CondensedPlan:
    """Return the plan of a horizon with other weights and the same end."""
    return plan_matrices(task, targets, terminal, rows)[0]


def _add_held(
    first: Float[np.ndarray, "K nu"] | None, second: Float[np.ndarray, "M nu"] | None
) -> Float[np.ndarray, "T nu"] | None:
    """Return the sum of two tables whose last rows are held; None where neither is there."""
    if first is None or second is None:
        return second if first is None else first
    steps = np.arange(max(len(first), len(second)))
    return first[np.minimum(steps, len(first) - 1)] + second[np.minimum(steps, len(second) - 1)]


def _bound_steps(task: ControlTask, targets: Targets, plan: CondensedPlan) -> PlanBounds:
    """Return the limits of each step."""
    track = task.track
    if track.limits.in_time:
        return BoundRows(task, targets, plan).read(track.limits, at_call=False)
    step = StepBounds(plan.low, plan.high, HUGE if plan.disturbance.size or not plan.aimed else plan.unpushed)
    moves = Interval(*(np.tile(side, len(task.moves.lengths)) for side in track.inputs))
    return ConstantBounds(step, track.inputs, track.rates, track.hard_rates, moves)


@checks.explain_overflow()
def plan_matrices(
    task: ControlTask, targets: Targets, terminal: Terminal | None = None, rows: WeightRows | None = None
) -> tuple[CondensedPlan, Terminal]:
    """Return the plan of a horizon and what its end costs; `rows` are weights in time, `terminal` a known end."""
    predictor, track, moves = task.predictor, task.track, task.moves
    units, disturbed = Units.of(predictor, track), task.estimator is not None
    aims, cost = units.targets(targets), units.cost(track.cost)
    horizon = horizon_of(predictor, track, moves.lengths, disturbed=disturbed, periodic=task.periodic, rows=rows)
    scaled_horizon = horizon.in_units(units)
    parts = build_stages(scaled_horizon, aims)
    terminal = terminal or terminal_of(predictor, cost, scaled_horizon, aims, units.inverse)
    law = recursion(parts, terminal.P, terminal.p)
    wanted = track.limits.terminal
    end = None if wanted is None else read_end(wanted, predictor)
    tied = bool(moves.held.any())
    coordinates = "riccati" if tied else task.coordinates
    maps = condense(scaled_horizon, law, terminal, aims, units, coordinates, end)
    if tied:
        maps = tie_moves(maps, moves.held)
    if track.pull is not None:  # a user's own end leaves the price out
        counted = horizon.N + (track.cost.Q_N is None)
        pulled = np.concatenate([np.tile(track.pull, counted), np.zeros((horizon.N + 1 - counted) * len(track.pull))])
        maps = replace(maps, offset=maps.offset + maps.from_reference @ pulled)
    scaled = _scale_deviation(maps, track.inputs, len(moves.lengths))
    stages = None
    plain = not (tied or track.weighed) and end is None and len(horizon.blocks) == horizon.N
    if (task.solver == order.SPARSE or task.N >= order.LONG) and plain and maps.coordinates == "riccati":
        columns = np.diagonal(scaled.deviation) / np.diagonal(maps.deviation)
        stages = _keep_stages(scaled_horizon, parts[0], law, terminal.P, units, columns, units.scale / scaled.unit)
    limits = limit_plan(track, horizon, scaled.deviation, end, moves.held)
    qp = build_qp(scaled, limits, 0 if track.rates is None else predictor.nu, stages)
    return _assemble(task, targets, horizon, scaled, limits, qp, end), terminal


def _assemble(
    task: ControlTask,
    targets: Targets,
    horizon: Horizon,
    maps: Condensed,
    limits: PlanLimits,
    qp: StepQP,
    end: EndRows | None,
) -> CondensedPlan:
    """Return the plan of condensed maps: its matrix, its limits, and those of its targets."""
    track, low, high, ball = task.track, limits.low.copy(), limits.high.copy(), None
    if end is not None and end.ball:
        softness = soften_end(track.limits, len(end.F), track.sizes.scale)
        ball = make_ball(softness, maps.deviation, maps.unit, len(low) - len(end.F))
        low[ball.rows], high[ball.rows] = -ball.inner, ball.inner
    last = horizon.rest_disturbance()
    disturbance = np.zeros((len(horizon.A), 0)) if last is None else last[:, :-1]
    driven, aimed = disturbance.shape[1] > 0, bool(maps.from_target.any())
    maps = _fold_targets(maps, targets) if aimed else maps
    limited = np.concatenate([track.movable.inputs, np.ones(len(track.outputs.low), np.bool_)])
    checked, from_state, from_drive = np.zeros(len(targets.low), np.bool_), maps.from_state, np.zeros((len(low), 0))
    rounding = ROUNDING * targets.size[limited]
    target_low, target_high = targets.low[limited] - rounding, targets.high[limited] + rounding
    unpushed = HUGE
    if driven:
        from_drive = maps.from_drive
    if aimed:
        shift = targets.rows[limited] @ targets.offset
        size = np.abs(targets.rows[limited] @ targets.from_reference).sum(axis=1)
        room = (np.clip(side, -HUGE, HUGE) - shift for side in (target_low, target_high))
        unpushed = -1.0 if driven else float(find_reach(size, *(side[None] for side in room))[0])
    if aimed and driven:
        checked, free = limited, np.full(len(target_low), np.inf)
        from_disturbance = targets.from_disturbance @ disturbance
        per_step = maps.from_target.reshape(len(low), horizon.N + 1, -1).sum(axis=1)
        moved = (targets.rows @ from_disturbance + targets.rows_disturbance @ disturbance)[limited]
        from_drive = np.vstack([from_drive + per_step @ from_disturbance, moved, moved])
        from_state = np.vstack([from_state, np.zeros((2 * len(moved), horizon.size))])
        low, high = np.concatenate([low, target_low, -free]), np.concatenate([high, free, target_high])
    return CondensedPlan(
        M=np.ascontiguousarray(np.hstack([from_state, from_drive])),
        low=np.maximum(low, -HUGE),  # inf meets no limit
        high=np.minimum(high, HUGE),
        offset=maps.offset,
        from_reference=maps.from_reference,
        from_held=maps.from_reference.reshape(len(maps.offset), horizon.N + 1, -1).sum(axis=1),
        from_target=maps.from_target,
        from_given=maps.from_given,
        aimed=aimed,
        unpushed=unpushed,
        checked=checked,
        disturbance=disturbance,
        qp=qp,
        deviation=maps.deviation[: len(maps.hessian)],
        coordinates=maps.coordinates,
        ball=ball,
    )


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
    """Return the maps of F_α (α − ᾱ) in place of F_α α, ᾱ(r) as if there were no limits: zero where none moves it."""
    rows, steps = len(maps.from_target), maps.from_reference.shape[1] // targets.from_reference.shape[1]
    each = maps.from_target.reshape(rows, steps, len(targets.offset))
    from_reference = maps.from_reference + (each @ targets.from_reference).reshape(rows, -1)
    return replace(maps, from_reference=from_reference, offset=maps.offset + each.sum(axis=1) @ targets.offset)


def _scale_deviation(maps: Condensed, inputs: Interval, stages: int) -> Condensed:
    """Return the same maps for a w of which 1 moves the input with the most room, of its span, to its limit."""
    D, n = maps.deviation, len(maps.hessian)
    curvature = np.diag(maps.hessian).reshape(stages, -1).mean(axis=0)
    columns = np.tile(1 / np.sqrt(curvature), stages)
    reach = 0.5 * (inputs.high - inputs.low) / measure_rows(D[:n] * columns, stages)
    known = reach[np.isfinite(reach) & (reach > 0)]
    size = float(known.max()) if known.size else 1.0
    columns, share = size * columns, size**2
    hessian = maps.hessian * np.outer(columns, columns) / share
    return replace(maps, deviation=D * columns, hessian=hessian, unit=maps.unit * share)


_OTHER_SOLVER = (
    "The controller solves with OSQP; this C solves with DAQP, to rounding: inputs differ by OSQP's tolerance."
)
_BY_WEIGHTS = (
    "The controller solves a QP for each priority of its limits; this C solves one, in which a limit weighs 1,000 "
    "times as much as one of the priority below."
)


def publish_condensed(
    controller: object, task: ControlTask, program: CondensedProgram, reference: ArrayLike | None
) -> CondensedProgram:
    """Return the program from which C code is generated; DataError where there is no code for a part of it.

    C has one plan, solved by the finisher, in Riccati coordinates; weights stand for priorities.
    """
    for refused, why, instead in (
        (
            program.input_levels is not None and program.levels is None,
            "only some of its inputs or steps are on levels, and this search has no C code",
            "one whose inputs are all on levels in all steps",
        ),
        (
            program.plans is not None,
            "its weights move in time, and its C holds one plan",
            "one without Cost(Q_rows=…, R_rows=…)",
        ),
        (
            program.ball is not None,
            "Clarabel solves its QP with a terminal ellipsoid",
            "one with a polytope, or without a terminal set",
        ),
    ):
        if refused:
            raise no_export(controller, why, instead)
    rows, notes = reference_table(reference, program.nr), ()
    refuse_time_limit(task.time_limit, 'solver="daqp", settings={"iter_limit": 100}')
    if program.priority is not None:
        notes = (_BY_WEIGHTS,)
    elif task.solver == "osqp":
        notes = (_OTHER_SOLVER,)
    if notes or task.solver != FINISHER.name:
        program = plan_condensed(task.for_c(FINISHER.name))
    program = replace(program, controller=type(controller).__name__, reference=rows, notes=notes)
    _ = program.estimator, program.lifting  # these may be code that cannot be written in C
    return program
