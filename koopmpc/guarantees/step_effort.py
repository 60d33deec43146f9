"""The most solver iterations of a step: proved by `bound_iterations`, or observed by `observe_iterations`."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.values import Value
from koopmpc.control.kinds.koopman_mpc import KoopmanMPC
from koopmpc.control.plan.condensed_program import CondensedProgram
from koopmpc.control.target import ROUNDING
from koopmpc.guarantees.active_sets import ParametricQP, list_ways
from koopmpc.guarantees.certify import Corners
from koopmpc.models.predictors import LinearPredictor
from koopmpc.validate.binomial import bound_failure_rate

_NO_LIMIT = 1e20  # there is no limit from here on


@dataclass(frozen=True, eq=False)
class IterationBound(Value):
    """The largest number of solver iterations of a step that starts cold, over all steps of a box.

    Attributes
    ----------
    most
        Largest number of iterations, in exact arithmetic.
    ways
        Number of ways of the solver through the box.
    x, reference, u_prev
        A step that takes `most`; x is the lifted state where the box is one of lifted states.
    attained
        Whether the controller took `most` iterations there.
    every_step
        Whether all steps of the controller start cold; else the bound is one of steps after `reset`.
    """

    most: int
    ways: int
    x: Float[np.ndarray, " nx"]
    reference: Float[np.ndarray, " nr"]
    u_prev: Float[np.ndarray, " nu"]
    attained: bool
    every_step: bool

    def __str__(self) -> str:
        """Return the bound, and of which steps it is."""
        which = "step" if self.every_step else "step that starts cold"
        seen = ", and one takes as many" if self.attained else ""
        end = "; all steps start cold" if self.every_step else ""
        return f"proved: no {which} in the box takes more than {self.most} iterations{seen} ({self.ways} ways){end}"


def bound_iterations(
    controller: KoopmanMPC,
    states: Corners,
    references: Corners,
    *,
    last_inputs: Corners | None = None,
    most_ways: int = 5000,
) -> IterationBound:
    """Return the largest number of DAQP's iterations of any cold step from boxes of states and references.

    All ways of the solver through the box are followed: each compares multipliers and violations that are affine in
    state, reference and last input. Parts of the box thinner than 1e-7 of it are left out, where rounding decides. A
    controller with ``settings={"cold_start": True}``, and its C, starts every step cold: then the bound is one of all
    its steps.

    Parameters
    ----------
    controller
        With DAQP, without an estimator, delays and latency.
    states
        (low, high) of the measured state; of z where the lifting is not affine.
    references
        (low, high) of a reference that is held over the horizon.
    last_inputs
        (low, high) of the last input where rates count; by default its limits.
    most_ways
        Give up beyond.

    Raises
    ------
    DataError
        The controller has a part that is not in the analysis; a target leaves its limits; some steps have no plan.
    CertificateError
        Too many ways, or limits so near to dependent, or so soft, that iterates are not affine.

    References
    ----------
    Arnström & Axehill, IEEE Trans. Automat. Contr. 67(6), 2022.

    Examples
    --------
    >>> import koopmpc as km
    >>> import scipy.signal
    >>> system = scipy.signal.dlti([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], [[1.0, 0.0]], [[0.0]], dt=0.1)
    >>> model = km.LinearPredictor.from_state_space(system)
    >>> mpc = km.KoopmanMPC(model, km.Cost(Q=1, R=0.1), km.Limits(u_min=-1, u_max=1), horizon=4)
    >>> bound = km.guarantees.bound_iterations(mpc, (-1, 1), (0, 0))
    >>> bound.most, bound.attained
    (5, True)
    """
    checks.kind(controller, "controller", KoopmanMPC, "a KoopmanMPC or a LinearMPC")
    program = _require_plain(controller)
    model = controller.predictor
    Z, z0 = _lift_affine(model)
    x_low, x_high = _read_box(states, "states", Z.shape[1])
    r_low, r_high = _read_box(references, "references", program.targets.from_reference.shape[1])
    nu = model.nu if program.with_rates else 0
    u_low, u_high = _read_box(last_inputs or (program.inputs.low, program.inputs.high), "last_inputs", model.nu)
    low, high = np.concatenate([x_low, u_low[:nu], r_low]), np.concatenate([x_high, u_high[:nu], r_high])
    if not np.isfinite(low).all() or not np.isfinite(high).all():
        raise DataError("the box is not finite; pass last_inputs=(low, high), since the inputs have no limits")
    _check_targets(program, r_low, r_high)
    n, nr = len(program.offset), len(r_low)
    held = program.from_reference.reshape(n, -1, nr).sum(axis=1)
    M = program.M[:n]
    offset = program.offset + M[:, : model.nz] @ z0
    plan = np.hstack([M[:, : model.nz] @ Z, M[:, model.nz :], held])  # of [x; u_prev; r]
    middle, half = (low + high) / 2, (high - low) / 2
    moving = np.flatnonzero(half > 0)
    scaled = np.hstack([plan[:, moving] * half[moving], (plan @ middle + offset)[:, None]])
    ways = list_ways(_build_problem(program, scaled), most_ways, np.random.default_rng(0))
    if any(way.infeasible for way in ways):
        raise DataError("some steps of the box have no plan; take a smaller box, or soft limits")
    worst = max(ways, key=lambda way: way.iterations)
    most = worst.iterations if worst.iterations > 1 else 0  # where no limit acts no QP is solved
    point = middle.copy()
    point[moving] += half[moving] * worst.theta
    nx = len(x_low)
    x, u_prev, r = point[:nx], point[nx : nx + nu], point[nx + nu :]
    attained = False
    if len(x) == model.nx:
        controller.reset(u_prev=u_prev if nu else None)
        attained = controller(x, r).iterations == most
        controller.reset()
    cold = bool(program.solver.settings["cold_start"])
    return IterationBound(most, len(ways), x, r, u_prev, attained, cold)


def _require_plain(controller: KoopmanMPC) -> CondensedProgram:
    """Return the controller's program; raise where it has a part that the analysis does not know."""
    model, program = controller.predictor, controller.build_program(None)
    moving = model.nz + model.nu * program.with_rates
    if program.M.shape[1] > moving or program.latency or model.embedding is not None:
        raise DataError(
            "the bound is for controllers without an estimator, delays, measured disturbances and latency; use "
            "km.guarantees.observe_iterations"
        )
    if program.levels is not None:
        raise DataError("the bound is of quadratic programs; with inputs on levels a step searches sequences")
    if controller.solver != "daqp" or not np.array_equal(program.solver.H, np.eye(len(program.solver.H))):
        raise DataError('the bound is for solver="daqp"; pass it to the controller')
    if program.given is not None:
        raise DataError("the cost has a given u_target; use km.guarantees.observe_iterations")
    return program


def _check_targets(program: CondensedProgram, low: Float[np.ndarray, " nr"], high: Float[np.ndarray, " nr"]) -> None:
    """Raise where a reference of the box has its target outside the limits."""
    corners = np.array(np.meshgrid(*np.stack([low, high], axis=1))).reshape(len(low), -1).T
    targets = program.targets
    values = targets.nearest(corners) @ targets.rows.T
    slack = ROUNDING * (np.abs(values) + targets.size)
    if program.aimed and ((values < targets.low - slack) | (values > targets.high + slack)).any():
        raise DataError("a reference of the box has its target outside the limits; take a smaller box of references")


def _lift_affine(model: LinearPredictor) -> tuple[Float[np.ndarray, "nz n"], Float[np.ndarray, " nz"]]:
    """Return Z, z0 of z = Z x + z0; the identity where the lifting is not affine."""
    x = ca.SX.sym("x", model.nx)
    z = model.lifting.symbolic(x)
    J = ca.jacobian(z, x)
    if ca.depends_on(J, x):
        return np.eye(model.nz), np.zeros(model.nz)
    lift = ca.Function("lift", [x], [J, z])
    Z, z0 = lift(np.zeros(model.nx))
    return np.array(ca.densify(Z)), np.array(ca.densify(z0)).ravel()


def _build_problem(program: CondensedProgram, plan: Float[np.ndarray, "n p1"]) -> ParametricQP:
    """Return the QP in DAQP's units, of a plan that is affine in [θ; 1]."""
    qp, solver = program.qp, program.solver
    lengths = np.linalg.norm(solver.M, axis=1)
    norms = np.where(lengths > 3.2e-6, lengths, 1.0)  # DAQP leaves shorter rows as they are
    factor = (solver.rows / norms)[:, None]
    moved = qp.scale[:, None] * plan[qp.source]
    one = np.eye(plan.shape[1])[-1]
    ends = [np.where(np.abs(end) < _NO_LIMIT, end, 0.0)[:, None] * one - moved for end in (qp.low, qp.high)]
    return ParametricQP(
        A=solver.M / norms[:, None],
        low=factor * ends[0],
        high=factor * ends[1],
        limited=np.concatenate([qp.high < _NO_LIMIT, qp.low > -_NO_LIMIT]),
        linear=np.where(solver.soft, solver.linear * norms, np.inf),
        rho=np.where(solver.soft, 1 / solver.curvature, 0.0) / norms**2,
    )


def _read_box(corners: Corners, name: str, size: int) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    try:
        first, last = corners
    except (TypeError, ValueError) as error:  # of what cannot be iterated, and of other than two parts
        raise DataError(f"{name} is {checks.article(corners)}; pass (low, high)") from error
    low, high = (np.asarray(checks.vector(end, name, size), dtype=float) for end in (first, last))
    if (low > high).any():
        raise DataError(f"{name} is {low.tolist()} … {high.tolist()}; pass (low, high) with low ≤ high")
    return low, high


@dataclass(frozen=True)
class ObservedIterations(Value):
    """The largest number of solver iterations that was seen; no bound that is proved.

    Attributes
    ----------
    most
        Largest number of iterations of a step.
    samples
        Number of independent steps.
    confidence
        Of `exceeded`.
    exceeded
        With this confidence, a further step drawn alike takes more than `most` iterations at most so probably.
    """

    most: int
    samples: int
    confidence: float
    exceeded: float

    def __str__(self) -> str:
        """Return the figure, and what it is."""
        return (
            f"at most {self.most} iterations in {self.samples} random cold steps; with {100 * self.confidence:g} % "
            f"confidence at most {100 * self.exceeded:.2g} % of such steps take more. This is observed, not proved"
        )


def observe_iterations(
    controller: KoopmanMPC,
    states: Corners,
    references: Corners,
    *,
    samples: int = 2000,
    confidence: float = 0.95,
    rng: np.random.Generator | int = 0,
) -> ObservedIterations:
    """Return the most iterations of cold steps from states and references drawn uniformly from boxes.

    Of n independent steps none takes more than the largest of them, so that a further one does so with a probability of
    at most 1 − β^(1/n), with confidence 1 − β. Every step starts without the one before it; steps of a loop start warm.

    Parameters
    ----------
    controller
        Its state and its last input are forgotten.
    states, references
        (low, high) of the measured state and of the reference, numbers or vectors.
    samples
        n.
    confidence
        1 − β, above 0 and below 1.
    rng
        Draws the steps.

    Raises
    ------
    DataError
        A box is upside down, or the confidence is not inside (0, 1).

    References
    ----------
    Clopper & Pearson, Biometrika 26, 1934. `bound_iterations` proves a bound for small problems.

    Examples
    --------
    >>> import koopmpc as km
    >>> import scipy.signal
    >>> system = scipy.signal.dlti([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], [[1.0, 0.0]], [[0.0]], dt=0.1)
    >>> model = km.LinearPredictor.from_state_space(system)
    >>> mpc = km.KoopmanMPC(model, km.Cost(Q=1, R=0.1), km.Limits(u_min=-1, u_max=1), horizon=10)
    >>> seen = km.guarantees.observe_iterations(mpc, (-1, 1), (-1, 1), samples=59)
    >>> seen.samples, round(seen.exceeded, 2)
    (59, 0.05)
    """
    checks.kind(controller, "controller", KoopmanMPC, "a KoopmanMPC or a LinearMPC")
    count, draw = checks.count(samples, "samples"), checks.generator(rng)
    boxes = (
        _read_box(states, "states", controller.predictor.nx),
        _read_box(references, "references", controller.cost.of.bind(controller.predictor.states).nz),
    )
    exceeded = bound_failure_rate(0, count, confidence=confidence)
    most = 0
    for _ in range(count):
        controller.reset()
        x, r = (draw.uniform(low, high) for low, high in boxes)
        most = max(most, controller(x, r).iterations)
    controller.reset()
    return ObservedIterations(most, count, confidence, exceeded)
