"""plan_condensed: a ControlTask becomes a CondensedProgram, its horizon solved by Riccati and condensed."""

from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.errors import DataError
from koopmpc.control.cost import add_held
from koopmpc.control.horizon import Condensed, Horizon, Terminal, WeightRows, build_stages, condense, horizon_of
from koopmpc.control.limits import Interval
from koopmpc.control.plan.blocking import tie_moves
from koopmpc.control.plan.bounds import BoundRows, ConstantBounds, PlanShape, StepBounds, describe_bounds, find_reach
from koopmpc.control.plan.condensed_program import CondensedPlan, CondensedProgram
from koopmpc.control.plan.rows import PlanLimits, build_qp, limit_plan, measure_rows
from koopmpc.control.plan.task import ControlTask
from koopmpc.control.plan.weights import PlansInTime
from koopmpc.control.riccati import Law, Stage, recursion
from koopmpc.control.solvers import FINISHER
from koopmpc.control.solvers.ball import make_ball
from koopmpc.control.solvers.base import StepQP
from koopmpc.control.solvers.daqp import daqp_settings
from koopmpc.control.solvers.stages import QPStages
from koopmpc.control.stepped.priorities import spread_priorities
from koopmpc.control.target import ROUNDING, Targets, Units, targets_of
from koopmpc.control.terminal.sets import EndRows, read_end
from koopmpc.control.terminal_cost import terminal_of
from koopmpc.models.predictors import LinearPredictor


def plan_condensed(task: ControlTask) -> CondensedProgram:
    """Return the program of a task.

    Raises
    ------
    DefinitenessError
        A weight, or R + BᵀPB, is not positive definite.
    DataError, ShapeError
        Limits in time cross, or have too few rows; levels or a priority together with a terminal ellipsoid.
    """
    track, model, limits = task.track, task.predictor, task.track.limits
    targets = targets_of(model, track)
    plan, terminal = plan_matrices(task, targets)
    levels, blocks = limits.base.input_levels(model.nu), task.moves.lengths
    for what, given in (("levels", levels), ("a priority", limits.priority)):
        if given is not None and plan.ball is not None:
            raise DataError(f"the limits have {what} and a terminal ellipsoid; pass a polytope, or no terminal set")
    first = len(plan.deviation) * (1 if track.rates is None else 2)
    solved = limits.priority is not None and levels is None and not task.by_weights
    layout, shape = (first, task.N, len(plan.offset)), find_shape(task, targets, plan)
    program = CondensedProgram(
        **vars(plan),
        controller="KoopmanMPC",
        model=model,
        targets=targets,
        inputs=track.inputs,
        rates=track.rates,
        given=add_held(track.given, track.shift),
        reference=np.zeros((1, len(track.Q))),
        N=task.N,
        latency=task.latency,
        blocks=blocks,
        move_of=np.repeat(np.arange(len(blocks)), blocks),
        with_rates=track.with_rates,
        hard_rates=track.hard_rates,
        plans=None,
        step_bounds=BoundRows(shape, task.latency).read(limits, at_call=False)
        if limits.in_time
        else ConstantBounds(
            StepBounds(plan.low, plan.high, plan.unpushed if shape.aims_inside else HUGE),
            track.inputs,
            track.rates,
            track.hard_rates,
            Interval(*(np.tile(side, len(blocks)) for side in track.inputs)),
        ),
        bounds=describe_bounds(shape) if limits.in_time or limits.rows else None,
        input_levels=levels,
        priority=spread_priorities(limits, model.states, layout) if solved else None,
        rule=task.estimator,
        time_limit=task.time_limit,
        solver_name="auto" if task.auto else task.solver,
        solver_settings=task.settings,
        settings=daqp_settings(task.settings if task.solver == FINISHER.name else None),
    )
    if not track.weighed:
        return program
    alike = replace(task, coordinates="plain" if plan.coordinates == "plain" else "riccati")
    plans = PlansInTime(track, task.N, task.latency, program, partial(plan_weights, alike, targets, terminal))
    plans.check_free_inputs()
    return replace(program, plans=plans)


def plan_weights(task: ControlTask, targets: Targets, terminal: Terminal, rows: WeightRows) -> CondensedPlan:
    """Return the plan of weights in time; targets and the end of the horizon are those of Q and R."""
    return plan_matrices(task, targets, terminal, rows)[0]


def find_shape(task: ControlTask, targets: Targets, plan: CondensedPlan) -> PlanShape:
    """Return what the limits of a plan depend on."""
    track, held, planned = task.track, task.moves.held, len(plan.offset)
    wanted = track.limits.terminal
    end = None if wanted is None else read_end(wanted, task.predictor)
    last = slice(planned - (0 if end is None else len(end.F)), planned)
    return PlanShape(
        track=track,
        targets=targets,
        blocks=task.moves.lengths,
        held=held,
        tied=held.ravel() & ~np.isin(np.arange(held.size), plan.qp.source),
        end=end,
        end_box=Interval(plan.low[last], plan.high[last]),
        aims_inside=plan.aimed and not plan.is_driven,
        checked=plan.checked,
        states=task.predictor.states,
        inputs=task.predictor.inputs,
    )


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
    coordinates = "riccati" if moves.own else task.coordinates
    maps = condense(scaled_horizon, law, terminal, aims, units, coordinates, end)
    if moves.own:
        maps = tie_moves(maps, moves.held)
    if track.pull is not None:  # an end of one's own does not count the price
        counted = horizon.N + (track.cost.Q_N is None)
        pulled = np.concatenate([np.tile(track.pull, counted), np.zeros((horizon.N + 1 - counted) * len(track.pull))])
        maps = replace(maps, offset=maps.offset + maps.from_reference @ pulled)
    scaled = _scale_deviation(maps, track.inputs, len(moves.lengths))
    stages = None
    plain = not moves.own and end is None and len(horizon.blocks) == horizon.N
    if task.is_long and not track.weighed and plain and maps.coordinates == "riccati":
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
        softness = track.limits.end_softness(len(end.F), track.sizes.scale)
        ball = make_ball(softness, maps.deviation, maps.unit, len(low) - len(end.F))
        low[ball.rows], high[ball.rows] = -ball.inner, ball.inner
    last = horizon.rest_disturbance()
    disturbance = np.zeros((len(horizon.A), 0)) if last is None else last[:, :-1]
    driven, aimed = disturbance.shape[1] > 0, bool(maps.from_target.any())
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
    maps = _fold_targets(maps, targets) if aimed else maps
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
    reach = 0.5 * (inputs.high - inputs.low) / measure_rows(D[:n] * columns, stages)
    known = reach[np.isfinite(reach) & (reach > 0)]
    size = float(known.max()) if known.size else 1.0
    columns, share = size * columns, size**2
    hessian = maps.hessian * np.outer(columns, columns) / share
    return replace(maps, deviation=D * columns, hessian=hessian, unit=maps.unit * share)


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
