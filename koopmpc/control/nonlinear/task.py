"""What is asked of BilinearMPC and NonlinearMPC, checked; and its limits in time: rows of u, x and y for each step."""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import block_diag

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Interval, Value
from koopmpc.control.ask.bounds import SOFTENED, Softness, preview_margin, refuse_crossed_rows
from koopmpc.control.ask.cost import Cost, trace_stage
from koopmpc.control.ask.limits import Limits
from koopmpc.control.ask.preview import check_bounds_alone, require_preview
from koopmpc.control.ask.terminal import HasTerminalSet, TerminalSet, read_terminal_set, terminal_function
from koopmpc.control.nonlinear.stages import LearnedMap, ModelOrMap, StagedProblem, learned_map, point_sizes
from koopmpc.control.plan.task import MoveBlocks, Moves, find_move_blocks
from koopmpc.control.plan.tracking import StateTracking, data_ranges, soften_end, state_tracking
from koopmpc.control.solvers.priorities import weigh_priorities
from koopmpc.estimate.observer import Estimator
from koopmpc.plants.step_map import StepMap


@dataclass(frozen=True, kw_only=True)
class StagedTask:
    """What is asked of a controller that plans over the stages of a nonlinear model.

    Attributes
    ----------
    map, outputs, problem
        The model, what is tracked and limited, and the stages of the plan.
    moves, latency
        The blocks of held inputs, and steps until an input acts.
    estimator, time_limit
        The rule that finds d, and the wall-clock time of a step [s]; None without.
    disturbed
        Whether disturbances, measured or estimated, move the target.
    N
        Steps of the plan.
    """

    map: LearnedMap
    outputs: StateTracking
    problem: StagedProblem
    moves: MoveBlocks
    latency: int
    estimator: Estimator | None
    time_limit: float | None
    disturbed: bool = field(init=False)
    N: int = field(init=False)

    def __post_init__(self) -> None:
        """Count the steps, and what disturbs."""
        object.__setattr__(self, "disturbed", self.estimator is not None or self.map.nw > 0)
        object.__setattr__(self, "N", sum(self.moves.lengths))


def read_staged_task(
    model: ModelOrMap,
    cost: Cost,
    limits: Limits | None,
    horizon: int,
    moves: Moves,
    latency: int,
    estimator: Estimator | None,
    time_limit: float | None,
    who: str,
) -> StagedTask:
    """Return the task of a controller, checked; `who` names it where weights replace priorities."""
    given, ranges = learned_map(model), {} if isinstance(model, StepMap) else data_ranges(model)
    o = state_tracking(model.states, model.inputs, cost, limits, given.nx, ranges, in_time=True)
    if o.limits.priority is not None:
        o = replace(o, softness=weigh_priorities(o.softness, o.limits, model.states, who))
    blocks = find_move_blocks(moves, horizon, model.inputs)
    return StagedTask(
        map=given,
        outputs=o,
        problem=staged_problem(given, o, blocks),
        moves=blocks,
        latency=checks.count(latency, "latency", 0),
        estimator=estimator,
        time_limit=None if time_limit is None else checks.positive(time_limit, "time_limit", "s"),
    )


@raise_swallowed()
def staged_problem(model: LearnedMap, outputs: StateTracking, moves: MoveBlocks) -> StagedProblem:
    """Return the problem of a horizon that is cut into blocks of held inputs."""
    blocks = moves.lengths
    o, N, F = outputs, sum(blocks), model.F
    starts = np.cumsum([0, *blocks[:-1]])
    free = np.zeros(N, dtype=np.bool_)
    free[starts] = True
    nx, nu = F.size1_in(0), F.size1_in(1)
    plain = StagedProblem(
        F=F,
        tracked=o.tracked,
        limited=o.limited,
        Q=o.Q,
        R=o.R,
        inputs=o.inputs,
        box=o.outputs,
        softness=o.softness,
        free=free,
        held_from=np.repeat(starts[moves.origins()], blocks, axis=0),
        own=moves.own,
        with_rates=False,
        soft_rates=np.zeros(0, dtype=np.intp),
        nx=nx,
        sizes=point_sizes(model, o),
        input_sizes=o.sizes.inputs,
        margin=preview_margin(o.margin, N),
        scale=o.sizes.scale,
        scheduled=model.scheduled,
        stage=_stage_function(o.cost, model, nx, with_rates=False),
        timed=o.cost.weighs_in_time,
    )
    wanted = o.limits.terminal
    plain = plain._replace(affine=wanted is None and _is_affine(plain))
    if not o.with_rates and len(blocks) == N and not moves.own:
        return plain if wanted is None else _add_end(plain, wanted, model, o)
    rates, soft, moves_alone = _split_rates(o, nu)
    ns = nx + nu + len(soft)
    sym, v, theta = ca.MX.sym("s", ns), ca.MX.sym("v", nu), ca.MX.sym("theta", F.size1_in(2))
    u = sym[nx : nx + nu] + v
    after = ca.Function("F", [sym, v, theta], [ca.vertcat(F(sym[:nx], u, theta), u, v[soft.tolist(), 0])])
    s = ca.SX.sym("s", ns)
    x, last = s[:nx], s[nx : nx + nu]
    hard = np.full(nu, np.inf), np.zeros(nu), SOFTENED * plain.input_sizes
    rated = plain._replace(
        F=after.expand("F") if F.is_a("SXFunction") else after,
        tracked=ca.Function("tracked", [s], [ca.vertcat(o.tracked(x), last)]),
        limited=ca.Function("limited", [s], [ca.vertcat(last, s[nx + nu :], o.limited(x))]),
        Q=block_diag(o.Q, o.R),
        R=np.zeros((nu, nu)) if o.R_delta is None else o.R_delta,
        inputs=moves_alone,
        box=Interval(*(np.concatenate([o.inputs[i], rates[i][soft], o.outputs[i]]) for i in (0, 1))),
        softness=Softness(*(np.concatenate([hard[i], o.rate_softness[i][soft], o.softness[i]]) for i in (0, 1, 2))),
        with_rates=True,
        soft_rates=soft,
        nx=ns,
        sizes=np.concatenate([plain.sizes, plain.input_sizes, plain.input_sizes[soft]]),
        stage=_stage_function(o.cost, model, ns, with_rates=True),
    )
    return rated if wanted is None else _add_end(rated, wanted, model, o)


def _split_rates(o: StateTracking, nu: int) -> tuple[Interval, Int[np.ndarray, " nsoft"], Interval]:
    """Return the limits of changes, which of them are soft, and those of v, which are hard."""
    rates = Interval(np.full(nu, -np.inf), np.full(nu, np.inf)) if o.rates is None else o.rates
    given = np.isfinite(rates.low) | np.isfinite(rates.high)
    soft = np.flatnonzero(given & np.isfinite(o.rate_softness.linear))
    low, high = rates.low.copy(), rates.high.copy()
    low[soft], high[soft] = -np.inf, np.inf
    return rates, soft, Interval(low, high)


def _is_affine(problem: StagedProblem) -> bool:
    """Return whether the map and the outputs of a problem without rates are affine; those with rates are so alike."""
    if problem.stage is not None or not problem.F.is_a("SXFunction"):
        return False
    both = ca.SX.sym("sv", problem.nx + problem.F.size1_in(1))
    s, v, theta = both[: problem.nx], both[problem.nx :], ca.SX.sym("theta", problem.F.size1_in(2))
    values = ca.vertcat(problem.F(s, v, theta), problem.tracked(s), problem.limited(s))
    return not any(ca.which_depends(values, both, 2, True))


def _stage_function(cost: Cost, model: LearnedMap, ns: int, *, with_rates: bool) -> ca.Function | None:
    """Return (s, v) → ℓ(x, u), x the state of the plant; None where the cost has no stage of its own."""
    if cost.stage is None:
        return None
    s, v = ca.SX.sym("s", ns), ca.SX.sym("v", model.nu)
    u = s[model.nx : model.nx + model.nu] + v if with_rates else v
    value = trace_stage(cost.stage, model.ny, model.nu).symbolic(s[: model.ny], u)
    return ca.Function("stage", [s, v], [ca.densify(value)])


def _add_end(
    problem: StagedProblem, given: TerminalSet | HasTerminalSet, model: LearnedMap, o: StateTracking
) -> StagedProblem:
    """Return the problem with the values of a terminal set behind its limited outputs.

    Raises
    ------
    DataError
        The set holds the last input, which the stages do not.
    """
    wanted, nu, ny, nx = read_terminal_set(given), model.nu, model.ny, model.nx
    if wanted.with_input and not problem.with_rates:
        raise DataError(
            "the terminal set holds the last input, and this controller has no limits of rates and no R_delta; make the"
            " set with the cost and the limits of the controller"
        )
    s = ca.SX.sym("s", problem.nx)
    u = s[nx : nx + nu] if problem.with_rates else ca.SX(nu, 1)
    end = terminal_function(wanted, tuple(model.model.states), nu)(s[:ny], u)
    count = int(end.size1())
    box, soft = problem.box, soften_end(o.limits, count, problem.scale)
    return problem._replace(
        limited=ca.Function("limited", [s], [ca.vertcat(problem.limited(s), end)]),
        box=Interval(np.append(box.low, np.full(count, -np.inf)), np.append(box.high, np.ones(count))),
        softness=Softness(*(np.concatenate(pair) for pair in zip(problem.softness, soft, strict=True))),
        margin=np.hstack([problem.margin, np.zeros((len(problem.margin), count))]),
        ends=count,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class StageBounds(Value):
    """How rows of limits in time become the limits of the stages, in the C code.

    Attributes
    ----------
    outputs
        Which of the states and observables have a limit.
    margin
        (N, outputs) by how much each stage moves the limits of these inwards.
    far_inputs, far_outputs
        How far beyond the widest limit a row without one is.
    """

    outputs: Bool[np.ndarray, " n"]
    margin: Float[np.ndarray, "N outputs"]
    far_inputs: Float[np.ndarray, " nu"]
    far_outputs: Float[np.ndarray, " outputs"]


class StageLimits(NamedTuple):
    """Limits of a plan: of its inputs, (nu,) or a row a stage, and (N, n) of [v_k; g(s_{k+1})]."""

    inputs: Interval
    stages: Interval

    @property
    def first(self) -> Interval:
        """Limits of the first input."""
        low, high = self.inputs
        return self.inputs if low.ndim == 1 else Interval(low[0], high[0])


class MovingLimits:
    """Step → StageLimits: the same object while none of them moves.

    Raises
    ------
    DataError, ShapeError
        See `check_rows`.
    """

    def __init__(self, task: StagedTask) -> None:
        self._own, self._task, self._called_with = task.outputs.limits, task, None
        self._fixed, self._timed = StageLimits(task.outputs.inputs, task.problem.stage_limits), self._own.in_time
        if self._timed:
            check_rows(self._own, task, None)

    def at(self, step: int) -> StageLimits:
        """Return the controller's own limits in a step."""
        return self._find(self._own, step) if self._timed else self._fixed

    def at_call(self, limits: Limits) -> StageLimits:
        """Return the limits of a call."""
        if limits is not self._called_with:
            self._at_call = self.read(limits)
            self.check(self._at_call)
            self._called_with = limits
        return self._find(self._at_call, 0)

    def read(self, limits: Limits) -> Limits:
        """Return the limits of a call with arrays in place of names; DataError where more than bounds differ."""
        model = self._task.map.model
        return check_bounds_alone(limits, self._own, model.states, model.inputs)

    def check(self, limits: Limits) -> None:
        """Raise where limits of a call cross, have no row in the stages, or too few rows."""
        check_rows(limits, self._task, self._task.N + self._task.latency)

    def _find(self, limits: Limits, step: int) -> StageLimits:
        task = self._task
        return find_stage_limits(limits, task.outputs, task.problem, step + task.latency, self._fixed.stages)


def check_rows(limits: Limits, task: StagedTask, preview: int | None) -> None:
    """Raise where limits in time ask for what the stages do not have; a call reads `preview` steps.

    Raises
    ------
    DataError
        The rates have rows, moves are blocked, there is a terminal set; limits cross, or have no level between; a bound
        is set that is infinite in the constructor's limits.
    ShapeError
        A bound has too few rows.
    """
    outputs, problem, inputs = task.outputs, task.problem, task.map.model.inputs
    counts = limits.count_rows()
    rates = next((end for end in counts if end.startswith("du")), None)
    if rates is not None:
        raise DataError(
            f"{rates} has rows, which this controller does not know; give it one value, or take a KoopmanMPC"
        )
    if problem.own or not problem.free.all():
        raise DataError("limits in time were passed with moves that are held; leave moves out, or take a KoopmanMPC")
    if problem.ends:
        raise DataError("limits in time were passed with a terminal set, which holds for its own limits; leave one out")
    if preview is not None:
        require_preview(limits, preview)
    count = max(counts.values(), default=1)
    nu, n = len(outputs.inputs.low), len(outputs.movable.outputs)
    nx = len(outputs.sizes.states)
    base, box = outputs.limits.base, limits.input_rows(nu, 0, count)
    levels = base.input_levels(nu)
    if levels is not None:
        levels.refuse_missing(box, inputs)
    for what, rows, widest in (
        ("input", box, base.inputs(nu)),
        ("state and output", limits.output_rows(nx, n - nx, 0, count), base.ends(nx, n - nx)),
    ):
        refuse_crossed_rows(*rows, what, inputs if what == "input" else ())
        for end, own, name in zip(rows, widest, ("lower", "upper"), strict=True):
            missing = np.argwhere(np.isfinite(end) & ~np.isfinite(own))
            if len(missing):
                k, i = (int(v) for v in missing[0])
                raise DataError(
                    f"the {what} of index {i} gets a {name} limit at step {k}, and the controller has none; "
                    "give it a finite one"
                )


def find_stage_limits(
    limits: Limits, outputs: StateTracking, problem: StagedProblem, first: int, base: Interval
) -> StageLimits:
    """Return the limits of a plan whose first input acts in step `first`; `base` are the stages' own (N, n)."""
    N, nu, how = len(problem.free), len(outputs.inputs.low), describe_stage_bounds(outputs, problem)
    nx, kept = len(outputs.sizes.states), how.outputs
    inputs = limits.input_rows(nu, first, N)
    every = limits.output_rows(nx, len(kept) - nx, first + 1, N)
    low, high = base.low.copy(), base.high.copy()
    column = nu * problem.with_rates
    low[:, column : column + nu] = _reach(inputs.low, low[:, column : column + nu], -how.far_inputs)
    high[:, column : column + nu] = _reach(inputs.high, high[:, column : column + nu], how.far_inputs)
    count = int(kept.sum())
    if count:
        low[:, -count:] = _reach(every.low[:, kept] + how.margin, low[:, -count:], -how.far_outputs)
        high[:, -count:] = _reach(every.high[:, kept] - how.margin, high[:, -count:], how.far_outputs)
    own = Interval(
        np.where(np.isfinite(inputs.low), inputs.low, outputs.inputs.low),
        np.where(np.isfinite(inputs.high), inputs.high, outputs.inputs.high),
    )
    return StageLimits(own, Interval(low, high))


def describe_stage_bounds(outputs: StateTracking, problem: StagedProblem, far: float = 1e3) -> StageBounds:
    """Return how rows of limits become those of the stages; without a limit, `far` sizes beyond the widest."""
    kept, N = outputs.movable.outputs, len(problem.free)
    count = int(kept.sum())
    return StageBounds(
        outputs=kept,
        margin=problem.margin if problem.margin.shape[1] == count else np.zeros((N, count)),
        far_inputs=far * outputs.sizes.inputs,
        far_outputs=far * outputs.sizes.rows[kept],
    )


def _reach(
    rows: Float[np.ndarray, "N n"], base: Float[np.ndarray, "N n"], far: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "N n"]:
    """Return the rows, `far` beyond the base where they have no limit."""
    return np.where(np.isfinite(rows), rows, base + far)
