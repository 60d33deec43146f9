"""The Program of a BilinearMPC: its map with derivatives as graphs, weights and limits of stages, targets of rows."""

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import solve

from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.control.ask.limits import Interval, Softness
from koopmpc.control.nonlinear.equilibrium import RestProgram
from koopmpc.control.nonlinear.stages import LearnedMap, ModelOrMap, StagedProblem
from koopmpc.control.nonlinear.stagewise import Sides
from koopmpc.control.nonlinear.task import StageBounds
from koopmpc.control.plan.row_targets import RowTargets, TailProgram
from koopmpc.control.plan.tracking import StateTracking
from koopmpc.control.program import StepProgram, trace_graph
from koopmpc.estimate.observer import EstimatorProgram
from koopmpc.plants.graph import Graph


@dataclass(frozen=True, eq=False, kw_only=True)
class StagedProgram(StepProgram):
    """One linearisation a step of s⁺ = F(s, v) over N stages, and the quadratic program of their deviations.

    s and v are those of `StagedProblem`: x and u, or [x; u_{k−1}; v_{k−1}] and the change of u where changes are
    weighed or limited, or moves are blocked.

    Attributes
    ----------
    functions
        Name → graph. Those of the model take w too where it multiplies x or u. "map" (x, u) → F; "stage_map" (s, v) →
        s⁺; "slopes" (s, v) → ∂s⁺/∂s, ∂s⁺/∂v by rows, s⁺; "tracked" and "limited" s → value, Jacobian by rows; "stage"
        (s, r) → JᵀQJ, JᵀQ(of − r); "local" (x, u) → F, ∂F/∂x, ∂F/∂u, of, ∂of/∂x, g, ∂g/∂x.
    N, latency, iterations
        Steps of the plan, steps until its first input acts, linearisations a step.
    nx, ny, ns
        Entries of x, of the plant's state, and of s.
    E
        (nx, nw) gain of the measured disturbances.
    scheduled
        Whether they multiply x or u too.
    with_rates, weighs_changes, soft_rates
        Whether v is the change of u; whether the cost weighs it; the inputs whose changes have soft limits.
    free, held_from
        Whether a stage has an input of its own, and the stage whose input each stage takes.
    hard_rates
        Hard limits of the changes of inputs, ±inf where one has none; None without.
    Q, R, R_held
        Weights of the tracked outputs, of v, and of v in a stage without an input.
    Q_root, R_root
        S with SᵀS = Q and R of the cost.
    v_limits, box, stage_limits, softness
        Limits of v and of the limited outputs, those of both in each stage with margins taken off, and what it costs to
        break them.
    sides
        The finite ends of all limits, for interior points.
    stage_sizes, input_sizes
        Sizes of s and v.
    holds
        Whether the input target is that of the equilibrium.
    end
        Terminal cost: "given" by Q_N, "tail" for the cost of a tail, "stage" for Q itself.
    affine
        Whether the problem is affine in s and v, so that one linearisation solves it.
    beyond
        Rows for which a reference that moves goes on behind the plan; 0 where it rests.
    table
        (rows, size) the target of each reference row: [r, x_r, u_r, active limits of (u_r, g), reference input,
        ∂u/∂e, M, L, V, m, whether an equilibrium was found].
    disturbed
        Whether disturbances, measured or estimated, move the target.
    rest, tail
        How the target of another row or of a disturbance is found, and what the end of the horizon costs there.
    estimator
        How x and d follow from y.
    bounds
        How limits in time move those of the stages; None where none do.
    """

    model: ModelOrMap
    lifting: Graph
    sizes: Float[np.ndarray, " nz"]
    gain: Float[np.ndarray, "moves nz"]
    functions: Mapping[str, Graph]
    N: int
    latency: int
    iterations: int
    nx: int
    ny: int
    ns: int
    E: Float[np.ndarray, "nx nw"]
    scheduled: bool
    with_rates: bool
    weighs_changes: bool
    soft_rates: Int[np.ndarray, " soft"]
    free: Bool[np.ndarray, " N"]
    held_from: Int[np.ndarray, " N"]
    hard_rates: Interval | None
    Q: Float[np.ndarray, "nq nq"]
    R: Float[np.ndarray, "nu nu"]
    R_held: Float[np.ndarray, "nu nu"]
    Q_root: Float[np.ndarray, "root nr"]
    R_root: Float[np.ndarray, "nu nu"]
    v_limits: Interval
    box: Interval
    stage_limits: Interval
    softness: Softness
    sides: Sides
    stage_sizes: Float[np.ndarray, " ns"]
    input_sizes: Float[np.ndarray, " nu"]
    holds: bool
    end: str
    affine: bool
    beyond: int
    table: Float[np.ndarray, "found size"]
    disturbed: bool
    rest: RestProgram
    tail: TailProgram
    estimator: EstimatorProgram
    bounds: StageBounds | None = None


def find_targets(
    targets: RowTargets, nx: int, reference: Float[np.ndarray, "rows nr"]
) -> Float[np.ndarray, "found size"]:
    """Return the `table` of a StagedProgram for these reference rows, each row once."""
    table: list[Float[np.ndarray, " size"]] = []
    for key in dict.fromkeys(map(bytes, np.ascontiguousarray(reference))):
        row = np.frombuffer(key)
        target = targets.find_still(row)
        (x, u, active), (M, L, V, m) = target.equilibrium, targets.weigh_end(target)
        n = nx + len(row) + len(u) * (V.shape[0] > nx + len(row))
        parts = (row, x, u, active, target.u, target.slope, M[:n], L[:n], V[:n], m[:n], float(target.is_found))
        table.append(np.concatenate([np.ravel(part) for part in parts]))
    return np.array(table)


@raise_swallowed()
def trace_functions(problem: StagedProblem, outputs: StateTracking, model: LearnedMap) -> dict[str, Graph]:
    """Return the functions of a StagedProgram.

    Raises
    ------
    DataError
        The model's map, or what the cost tracks, cannot be written in C.
    """
    nx, nu, ns = model.nx, model.nu, problem.nx
    s, v, x, u = (ca.SX.sym(name, n) for name, n in (("s", ns), ("v", nu), ("x", nx), ("u", nu)))
    w = ca.SX.sym("w", model.scheduled)
    theta = ca.vertcat(ca.SX(ca.DM(model.theta[: len(model.theta) - model.scheduled])), w)
    measured = [w] if model.scheduled else []
    if not model.F.is_a("SXFunction"):
        raise DataError(
            "the model's map holds an implicit integrator or a callback, which cannot be written in C; "
            "discretize with RK4 or Euler, or fit a bilinear model to its data"
        )
    F, F_s = ca.SX(model.F(x, u, theta)), ca.SX(problem.F(s, v, theta))

    def slope(value: ca.SX, by: ca.SX) -> ca.SX:
        return ca.vec(ca.densify(ca.jacobian(value, by)).T)

    r, tracked = ca.SX.sym("r", len(problem.Q)), ca.SX(problem.tracked(s))
    limited = ca.SX(problem.limited(s)) if len(problem.box.low) else ca.SX(1, 1)
    J = ca.jacobian(tracked, s)
    weighed = J.T @ ca.sparsify(ca.DM(problem.Q))
    of, g = ca.SX(outputs.tracked(x)), ca.SX(outputs.limited(x))
    functions = {
        "map": ([x, u, *measured], [F]),
        "stage_map": ([s, v, *measured], [F_s]),
        "slopes": ([s, v, *measured], [slope(F_s, s), slope(F_s, v), F_s]),
        "tracked": ([s], [tracked, slope(tracked, s)]),
        "limited": ([s], [limited, slope(limited, s)]),
        "stage": ([s, r], [ca.vec(ca.densify(weighed @ J)), ca.densify(weighed @ (tracked - r))]),
        "local": ([x, u, *measured], [F, slope(F, x), slope(F, u), of, slope(of, x), g, slope(g, x)]),
    }
    found: dict[str, Graph] = {}
    for name, (arguments, results) in functions.items():
        function = ca.Function(f"koopmpc_{name}", arguments, [ca.densify(ca.vertcat(*results))], {"cse": True})
        found[name] = trace_graph(function, "the model, or what the cost tracks,")
    return found


def first_gain(
    targets: RowTargets, outputs: StateTracking, N: int, row: Float[np.ndarray, " nr"]
) -> Float[np.ndarray, "nu nx"]:
    """Return the gain of the LQR with N steps on the linearisation at the target of a row."""
    equilibria, rest = targets.equilibria, targets.find_still(row).equilibrium
    at = equilibria.linearise(rest.x, rest.u)
    Q, R = at.J.T @ outputs.Q @ at.J, outputs.R
    P, K = Q, np.zeros((len(R), len(rest.x)))
    for _ in range(N):
        K = solve(R + at.B.T @ P @ at.B + 1e-12 * np.eye(len(R)), at.B.T @ P @ at.A)
        P = Q + at.A.T @ P @ (at.A - at.B @ K)
    return K
