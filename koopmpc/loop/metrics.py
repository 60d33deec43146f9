"""metrics: the closed-loop figures of a Run, from the Run alone: cost, tracking, violation, settling, times."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from koopmpc.base import checks
from koopmpc.base.errors import ShapeError
from koopmpc.base.text import format_duration
from koopmpc.base.values import Value
from koopmpc.control.ask.checks import FEEDBACK_FIELDS
from koopmpc.control.ask.cost import Cost, evaluate_stage
from koopmpc.control.ask.levels import NEAR
from koopmpc.control.ask.limits import SOFTENED, Interval, Limits, require_known
from koopmpc.control.plan.tracking import Sizes
from koopmpc.loop.run import SECONDS, Run, bind_outputs

SETTLED = 0.02  # the band of the settling time, as a share of the first error


@dataclass(frozen=True, eq=False)
class Metrics(Value):
    """Closed-loop figures of a Run.

    Attributes
    ----------
    cost
        J = Σ_{k=1}^{T} ‖of(x_k) − r_k‖²_Q + Σ_{k=0}^{T−1} ‖u_k − u_reference_k‖²_R, and with R_delta also
        Σ_{k=1}^{T−1} ‖u_k − u_{k−1}‖²_{R_delta}, with a price Σ_{k=0}^{T−1} p_kᵀu_k, with a stage of one's own
        Σ_{k=0}^{T−1} ℓ(x_k, u_k). It is not multiplied by dt. It is NaN where the run has no Cost, or where its plant
        hides the state.
    tracking_rmse
        (nr,) root-mean-square of each tracked output's error of(x_k) − r_k over k = 1 … T, in its unit.
    final_error
        (nr,) each tracked output's error at T, in its unit.
    violation
        Largest violation of any state, output or rate limit, in the unit of that limit.
    violation_share
        Largest violation of any state, output or rate limit as a share of the limit's range; see `violation_shares`.
    input_violation
        Largest violation of any input limit, in its unit; every controller of this library keeps it at zero. Where an
        input is on levels, the distance from the nearest one counts.
    effort
        Σ_{k=0}^{T−1} ‖u_k‖² dt.
    settling_time
        Time after which ‖of(x_k) − r_k‖_Q stays within 2 % of its first value [s]; inf where it never does, NaN
        where such a run started on its reference.
    solve_time_p50, solve_time_p99, solve_time_max
        Median, 99 % quantile and maximum of the wall-clock time of a step [s].
    late
        Number of steps whose solve_time exceeded dt.
    status
        Number of steps that ended with each status, by its name. As intended: UNCONSTRAINED (no limit was active),
        OPTIMAL (a QP or NLP was solved), SOFTENED (solved, and a soft limit gave way), SATURATED (a feedback law was
        clipped). Otherwise: MAX_ITERATIONS, INFEASIBLE, FAILED (the solver gave no answer), BAD_MEASUREMENT (NaN or
        inf in y or the reference, or the model overflows from y), and TIME_LIMIT (the step took longer than allowed,
        whether or not its answer was used).
    fallback
        Number of steps whose input each fallback gave, by its name: NONE (the controller's own answer),
        SHIFTED_PLAN (the last plan, moved on by one step), CLIPPED_LQR (the unconstrained optimum, clipped), HOLD
        (the last input again), OTHER_CONTROLLER (that which stands by).
    unknown
        Number of steps that the controller's monitor did not know; None where it has none.
    solver
        Number of steps that each QP solver made, by its name: "osqp", or "daqp" where it was asked first or took over.
    early_changes
        Number of changes of inputs on levels that came before their dwell time; None without levels.
    """

    cost: float
    tracking_rmse: Float[np.ndarray, " nr"]
    final_error: Float[np.ndarray, " nr"]
    violation: float
    input_violation: float
    effort: float
    settling_time: float
    solve_time_p50: float
    solve_time_p99: float
    solve_time_max: float
    late: int
    status: Mapping[str, int]
    fallback: Mapping[str, int]
    unknown: int | None = None
    violation_share: float = 0.0
    solver: Mapping[str, int] = field(default_factory=dict[str, int])
    early_changes: int | None = None

    def __str__(self) -> str:
        """Return a line a figure."""
        return "\n".join(f"{name:<25} {value}" for name, value in self.figures().items())

    def figures(self, tracked: Sequence[str] | None = None, unit: str = "s") -> dict[str, str]:
        """Return each figure in words by its name; those of a tracked output in a line of its own, if named.

        `unit` is that of the plant's time.
        """
        settles = f"{self.settling_time:.3g} {unit}" if np.isfinite(self.settling_time) else "does not settle"
        settles = "starts on its reference" if np.isnan(self.settling_time) else settles
        times = (self.solve_time_p50, self.solve_time_p99, self.solve_time_max)
        missed = np.isnan(self.final_error).any() or np.isnan(self.tracking_rmse).any()
        cost = "unknown, a state was not measured" if missed else "none was given"
        return {
            "cost": cost if np.isnan(self.cost) else f"{self.cost:.6g}",
            **_by_output("tracking rmse", self.tracking_rmse, tracked),
            **_by_output("final error", self.final_error, tracked),
            "violation": f"{self.violation:.3g}"
            + (f" ({self.violation_share:.3g} of the range)" if self.violation else ""),
            "input violation": f"{self.input_violation:.3g}",
            **({} if self.early_changes is None else {"changes before dwell": str(self.early_changes)}),
            "effort": f"{self.effort:.6g}",
            "settling time": settles,
            "solve time p50, p99, max": ", ".join(format_duration(t) for t in times),
            "steps later than dt": str(self.late),
            "status": _counts(self.status),
            "fallback": _counts(self.fallback),
            **({"solver": _counts(self.solver)} if self.solver else {}),
            **({} if self.unknown is None else {"unknown steps": str(self.unknown)}),
        }


@np.errstate(invalid="ignore", over="ignore")  # a state that diverged, a sensor that showed inf: the cost says so
def metrics(run: Run) -> Metrics:
    """Return the closed-loop figures of `run`, above all J = Σ ‖of(x_k) − r_k‖²_Q + Σ ‖u_k − u_reference_k‖²_R.

    The errors of states that the run names as angles are wrapped to (−π, π]. Where the plant hides its state and
    measures all of it, the measurements take the state's place. Without a Cost the error is x_k − r_k, and Q = I
    judges the settling time.

    Parameters
    ----------
    run
        A closed loop of T steps, from `simulate` or `load_run`. Its own cost, limits and u_reference judge it.

    Returns
    -------
    metrics
        The figures; `Metrics` has the equation and the unit of each.

    Raises
    ------
    DataError
        `run` is not a Run.
    ShapeError
        The reference has another number of columns than the outputs that the cost tracks, or than the states where
        there is no cost; a weight or a limit has another size than what it is for.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-25, u_max=25)
    >>> mpc = km.LinearMPC(plant, [0, 0], [0], cost, limits, horizon=40)
    >>> run = km.simulate(plant, mpc, x0=[0.5, 0], reference=[0, 0], steps=100, cost=cost, limits=limits)
    >>> km.metrics(run).violation, km.metrics(run).settling_time < 5
    (0.0, True)
    """
    checks.kind(run, "run", Run, "simulate returns one")
    error = tracking_error(run)
    stage, moved, changed = cost_terms(run, error)
    p50, p99 = np.quantile(run.solve_time, [0.5, 0.99])
    levels = None if run.limits is None else run.limits.base.input_levels(run.U.shape[1])
    return Metrics(
        cost=float("nan") if run.cost is None else _sum_up(stage, moved, changed),
        tracking_rmse=np.sqrt(np.mean(error[1:] ** 2, axis=0)),
        final_error=error[-1].copy(),
        violation=float(beyond(run).max()),
        violation_share=float(violation_shares(run).max()),
        input_violation=0.0 if run.limits is None else _input_violation(run.U, run.limits),
        effort=float((run.U**2).sum() * run.dt),
        settling_time=_settling_time(weigh_error(run, error), run.dt),
        solve_time_p50=float(p50),
        solve_time_p99=float(p99),
        solve_time_max=float(run.solve_time.max()),
        late=int(find_late(run).sum()),
        status=dict(Counter(s.name for s in run.status)),
        fallback=dict(Counter(f.name for f in run.fallback)),
        unknown=int((run.known == 0).sum()) if (run.known >= 0).any() else None,
        solver=dict(Counter(name for name in run.solver if name)),
        early_changes=None if levels is None else levels.count_broken(run.U)[1],
    )


@np.errstate(invalid="ignore", over="ignore")
def total_cost(run: Run) -> float:
    """Return the cost that `metrics` gives, to the bit, where nothing else is asked for: a sixth of its time."""
    return float("nan") if run.cost is None else _sum_up(*cost_terms(run, tracking_error(run)))


def _sum_up(
    stage: Float[np.ndarray, " T1"], moved: Float[np.ndarray, " T"], changed: Float[np.ndarray, " T0"]
) -> float:
    return float(stage[1:].sum() + moved.sum() + changed.sum())


def find_late(run: Run) -> Bool[np.ndarray, " T"]:
    """Return which steps took longer than dt, whose unit the metadata may name."""
    return run.solve_time > run.dt * SECONDS.get(run.metadata.get("time unit", "s"), 1.0)


@np.errstate(invalid="ignore", over="ignore")
def running_cost(run: Run) -> Float[np.ndarray, " T1"]:
    """Return the cost so far at every state, from 0 to the cost that `metrics` gives; NaN where there is no Cost."""
    if run.cost is None:
        return np.full(len(run.X), np.nan)
    stage, moved, changed = cost_terms(run, tracking_error(run))
    steps = stage[1:] + moved
    steps[1:] += changed
    return np.concatenate([[0.0], np.cumsum(steps)])


def cost_terms(
    run: Run, error: Float[np.ndarray, "T1 nr"]
) -> tuple[Float[np.ndarray, " T1"], Float[np.ndarray, " T"], Float[np.ndarray, " T0"]]:
    """Return ‖error_k‖²_Q + qᵀy_k, ‖u_k − u_reference_k‖²_R + pᵀu_k + ℓ(x_k, u_k), ‖u_k − u_{k−1}‖²_{R_delta}.

    By default Q = I and R = 0.
    """
    nr, nu = error.shape[1], run.U.shape[1]
    Q, R = (np.eye(nr), np.zeros((nu, nu))) if run.cost is None else run.cost.matrices(nr, nu)
    R_delta = None if run.cost is None else run.cost.rate(nu)
    weighed = ((error, Q), (run.U - run.u_reference, R), (np.diff(run.U, axis=0), R_delta))
    stage, moved, changed = (
        np.zeros(len(rows)) if W is None else np.einsum("ki,ij,kj->k", rows, W, rows) for rows, W in weighed
    )
    if run.cost is not None and run.cost.price is not None:
        moved = moved + np.einsum("ki,ki->k", run.cost.price_rows(nu, 0, len(run.U)), run.U)
    if run.cost is not None and run.cost.output_price is not None:
        stage = stage + run.cost.of.bind(tuple(run.states))(_states(run)) @ np.asarray(run.cost.output_price)
    if run.cost is not None and run.cost.weighs_in_time:
        weights = run.cost.weight_rows(nr, nu, 0, len(error))
        stage, moved = (
            np.einsum("ki,ki->k", rows**2, diagonal[: len(rows)])
            for rows, diagonal in zip((error, run.U - run.u_reference), weights, strict=True)
        )
    if run.cost is not None and run.cost.stage is not None:
        moved = moved + evaluate_stage(run.cost.stage, _states(run)[:-1], run.U)
    return stage, moved, changed


def tracking_error(run: Run) -> Float[np.ndarray, "T1 nr"]:
    """Return of(x_k) − r_k, the angles among tracked states wrapped to (−π, π]."""
    X = _states(run)
    tracked = None if run.cost is None else bind_outputs(run.cost.of, run.states)
    outputs = X if tracked is None else tracked(X)
    if outputs.shape != run.reference.shape:
        aims, of = run.reference.shape[1], "…)"
        if set(run.outputs) <= set(run.states) and aims <= len(run.outputs):
            of = f"km.State({[name.partition(' [')[0] for name in run.outputs[:aims]]}))"
        raise ShapeError(
            f"the reference has shape {run.reference.shape}, and what it is compared with {outputs.shape}; pass "
            f"simulate a cost that says what of the state the reference is for: cost=km.Cost(Q=…, R=…, of={of}"
        )
    error = outputs - run.reference
    names = run.states if tracked is None else tracked.names
    for i in run.angles:
        if run.states[i] in names:
            j = names.index(run.states[i])
            error[:, j] = np.pi - np.mod(np.pi - error[:, j], 2 * np.pi)
    return error


def weigh_error(run: Run, error: Float[np.ndarray, "T1 nr"]) -> Float[np.ndarray, " T1"]:
    """Return ‖error_k‖_Q without prices and weights in time; Q = I where there is no Cost."""
    Q = np.eye(error.shape[1]) if run.cost is None else run.cost.matrices(error.shape[1], run.U.shape[1])[0]
    return np.sqrt(np.einsum("ki,ij,kj->k", error, Q, error))


def _states(run: Run) -> Float[np.ndarray, "T1 nx"]:
    """Return the true states, or the measured ones of a plant that hides them and measures them all."""
    if np.isnan(run.X).all() and run.outputs == run.states:
        return run.Y
    return run.X


def violation_shares(run: Run, ranges: Float[np.ndarray, " n"] | None = None) -> Float[np.ndarray, " T1"]:
    """Return by which share of its range each x_k, with u_{k−1} − u_{k−2}, is beyond the limit that it breaks most.

    x_0 is given, so its row is 0. The range of a limit is the width between its two finite ends. Where there is one
    end alone, it is that of the data, or twice the size by which the default slack counts.

    Parameters
    ----------
    run
        The closed loop; its own limits and cost judge it.
    ranges
        (nx + ny,) range of each state and limited output, where that of the data is known; by default from `Sizes`.
    """
    shares = np.zeros(len(run.X))
    if run.limits is None:
        return shares
    nu, (states, rates) = run.U.shape[1], _broken(run, run.limits)
    if states.any() or rates.any():
        if ranges is None:
            cost = run.cost or Cost(1, 1)
            tracked = cost.of.bind(run.states)
            ranges = 2 * Sizes.of(tracked, *cost.matrices(tracked.nz, nu), run.limits.base, run.states, None).rows
        rate_ranges = 2 * run.limits.base.rate_softness(nu).allowance / SOFTENED
        shares[1:] = (states / ranges).max(axis=1, initial=0.0)
        shares[2:] = np.maximum(shares[2:], (rates / rate_ranges).max(axis=1, initial=0.0))
    return shares


def beyond(run: Run) -> Float[np.ndarray, " T1"]:
    """Return by how much each x_k, with u_{k−1} − u_{k−2}, is beyond the state, output or rate limit it breaks most.

    x_0 is given, so its row is 0. In the unit of that limit.
    """
    most = np.zeros(len(run.X))
    if run.limits is not None:
        states, rates = _broken(run, run.limits)
        most[1:] = states.max(axis=1, initial=0.0)
        most[2:] = np.maximum(most[2:], rates.max(axis=1, initial=0.0))
    return most


def _broken(run: Run, limits: Limits) -> tuple[Float[np.ndarray, "T n"], Float[np.ndarray, "T0 nu"]]:
    """Return by how much x_1 … x_T and their limited outputs are beyond their limits, and each change of the input."""
    require_known(limits, "metrics", FEEDBACK_FIELDS | {"levels", "dwell", "level_steps"})
    values, changed = _stack(limits, _states(run)[1:], run.states), np.diff(run.U, axis=0)
    nx, (T0, nu) = len(run.states), changed.shape
    box, rates = limits.output_rows(nx, values.shape[1] - nx, 1, len(values)), limits.rate_rows(nu, 1, T0)
    return _excess(values, *box), _excess(changed, *rates)


def _stack(limits: Limits, X: Float[np.ndarray, "M nx"], states: Sequence[str]) -> Float[np.ndarray, "M n"]:
    return np.hstack([X, X[:, :0] if limits.of is None else limits.of.bind(states)(X)])


def stack_limited(
    limits: Limits, X: Float[np.ndarray, "M nx"], states: Sequence[str]
) -> tuple[Float[np.ndarray, "M n"], Interval]:
    """Return the rows [x; of(x)] of all that limits can be of, and the box of these."""
    values = _stack(limits, X, states)
    return values, limits.ends(X.shape[1], values.shape[1] - X.shape[1])


def _input_violation(U: Float[np.ndarray, "T nu"], limits: Limits) -> float:
    """Return by how much the input farthest outside its limits is outside them, or from its nearest level."""
    nu = U.shape[1]
    beyond = float(_excess(U, *limits.input_rows(nu, 0, len(U))).max(initial=0.0))
    levels = limits.base.input_levels(nu)
    if levels is None:
        return beyond
    away = np.abs(levels.indices(U) - levels.nearest(U))
    return max(beyond, float((levels.spacing * np.where(away > NEAR, away, 0.0)).max(initial=0.0)))


def _excess(
    values: Float[np.ndarray, "T n"], low: Float[np.ndarray, "T n"], high: Float[np.ndarray, "T n"]
) -> Float[np.ndarray, "T n"]:
    """Return by how much each value is beyond the limits of its row; without a limit, not even inf or NaN is beyond."""
    beyond = np.zeros(values.shape)
    for end, sign in ((low, -1.0), (high, 1.0)):
        known = np.isfinite(end)
        beyond[known] = np.maximum(beyond[known], sign * (values[known] - end[known]))
    return beyond


def _by_output(name: str, values: Float[np.ndarray, " nr"], tracked: Sequence[str] | None) -> dict[str, str]:
    if tracked is None:
        return {name: "[" + ", ".join(f"{value:.4g}" for value in values) + "]"}
    return {f"{name}, {output}": f"{value:.4g}" for output, value in zip(tracked, values, strict=True)}


def _counts(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def _settling_time(size: Float[np.ndarray, " T1"], dt: float) -> float:
    """Return the time after which `size` stays below 2 % of its first value; NaN where that is 0 and it never does."""
    outside = np.flatnonzero(~(size <= SETTLED * size[0]))
    if not outside.size:
        return 0.0
    if outside[-1] == len(size) - 1:
        return float("nan" if size[0] == 0 else "inf")
    return float((outside[-1] + 1) * dt)
