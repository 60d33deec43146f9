"""A BilinearMPC's tables: its map and derivatives as functions, weights and limits of stages, targets of references."""

from threading import Lock

import casadi as ca
import numpy as np
from jaxtyping import Float
from scipy.linalg import solve

from koopmpc import checks
from koopmpc.codegen.tables import (
    CFunction,
    Tables,
    add_limits,
    add_observer,
    amplified,
    columns,
    daqp_defaults,
    memory_shares,
    model_tables,
    solver_settings,
    traced,
)
from koopmpc.control.nonlinear.bilinear_mpc import SETTLED, BilinearMPC
from koopmpc.control.nonlinear.equilibrium import RANK
from koopmpc.control.nonlinear.equilibrium import SETTLED as HELD
from koopmpc.control.nonlinear.iteration import DIGITS, ENOUGH, MOST, PRECISE, STUCK
from koopmpc.control.nonlinear.stagewise import sides, weights
from koopmpc.errors import DataError
from koopmpc.plants.step_map import StepMap

# Tolerances as in Python, and in single precision, whose rounding is 5e8 times as coarse.
_TOLERANCES = {
    "PRECISE": (PRECISE, 1e-6),
    "ENOUGH": (ENOUGH, 1e-4),
    "DIGITS": (DIGITS, 1e-6),
    "STUCK": (STUCK, 1e-6),
    "SETTLED": (SETTLED, 1e-4),
    "REACH": (1e-9, 1e-5),
    "RANK": (RANK, 1e-6),
    "HELD": (HELD, 1e-4),
    "TURN": (1e-15, 1e-7),
    "SMALL": (1e-7, 1e-4),
}
_ROWS = 100_000  # reference rows whose targets a controller in machine code keeps


def bilinear_tables(
    controller: BilinearMPC, references: Float[np.ndarray, "rows nr"] | None, *, single: bool
) -> Tables:
    """Return the tables; targets are found for the `references` that the C will be given.

    Raises
    ------
    DataError
        The model's map cannot be written in C.
    """
    problem, outputs, given = controller._problem, controller._outputs, controller._map
    N, nx, nu, nr, ny = controller._N, given.nx, controller.nu, len(outputs.Q), given.ny
    cost, rows, equilibria = controller.cost, outputs.given, controller._terminal.equilibria
    side, ng, box = sides(problem), len(problem.box.low), len(outputs.outputs.low)
    observer = controller._initial.observer
    disturbed = controller._disturbed
    sizes = {
        "IS_STAGED": 1,
        "NX": ny,
        "NY": ny,
        "NZETA": nx,
        "NZ": nx,
        "NS": nx,
        "LEARNED": ny,
        "CONSTANT": -1,
        "NU": nu,
        "NR": nr,
        "NW": given.nw,
        "N": N,
        "LATENCY": controller._latency,
        "HORIZON": controller.horizon,
        "MOVES": N * nu,
        "WITH_RATES": int(problem.with_rates),
        "RATED": int(outputs.rates is not None),
        "HARD_RATED": int(outputs.hard_rates is not None),
        "KNOWN": len(controller._initial.known) - 1,
        "GIVEN": 0 if rows is None else len(rows),
        "ESTIMATOR": 0,
        "POINT": problem.nx,
        "TRACKED": len(problem.Q),
        "LIMITED": ng,
        "LIMITED1": max(1, ng),
        "BOX": box,
        "SIDES": len(side.row),
        "SOFT": side.soft,
        "PAIRS": max(1, N * len(side.row)),
        "EASED": max(1, N * side.soft),
        "SOFT_RATES": len(problem.soft_rates),
        "INTERIOR": MOST,
        "DISTURBED": int(disturbed),
        "PUSHES": N * nx if disturbed else 1,
        "GIVEN_MAP": int(isinstance(given.model, StepMap)),
        "ITERATIONS": controller._sqp_iterations,
        "HOLDS": int(isinstance(cost.u_target, str) and cost.u_target == "equilibrium"),
        "GIVEN_END": int(cost.Q_N is not None),
        "STAGE_END": 0 if cost.Q_N is not None else 2 if cost.tail == 0 else 1,
    }
    goal = nx + nu * (outputs.R_delta is not None and cost.Q_N is None) + nr
    sizes |= {"GOAL": goal, "END": goal + nu * problem.with_rates}
    tables = model_tables(given.model, sizes, lambda zeta: zeta, given.embedding, outputs.inputs)
    _add_functions(tables, controller)
    add_limits(tables, rate=outputs.rates, hard_rate=outputs.hard_rates, change=problem.inputs)
    tables.limits["move_of"] = np.arange(N, dtype=np.intc)
    low, high = (
        np.tile(np.concatenate([problem.inputs[i], problem.box[i]]), (N if problem.margin.any() else 1, 1))
        for i in (0, 1)
    )
    if problem.margin.any():
        low[:, low.shape[1] - problem.margin.shape[1] :] += problem.margin
        high[:, high.shape[1] - problem.margin.shape[1] :] -= problem.margin
    tables.sizes["BOX_ROWS"] = len(low)
    soft = np.isfinite(problem.softness.linear)
    eased = side.row[len(side.row) - side.soft :] - nu
    held = ~problem.free
    R = weights(problem)
    tables.plan = {
        "Q": problem.Q,
        "R": problem.R,
        "R_held": R[:, nu * int(held.argmax()) :][:, :nu] if held.any() else problem.R,
        "Q_root": outputs.Q_root,
        "R_root": outputs.R_root,
        "free": problem.free.astype(np.intc),
        "held_from": problem.held_from.astype(np.intc),
        "soft_rates": problem.soft_rates.astype(np.intc),
        "low": low,
        "high": high,
        "side_row": side.row.astype(np.intc),
        "side_scale": side.sign / side.span,
        "side_span": side.span,
        "soft_linear": side.linear,
        "soft_quadratic": side.quadratic,
        "allowance": problem.softness.allowance[eased],
        "cost_linear": np.where(soft, problem.softness.linear, 0.0),
        "cost_quadratic": np.where(soft, problem.softness.quadratic, 0.0),
        "sizes": problem.sizes,
        "input_sizes": problem.input_sizes,
        "given": np.zeros(0) if rows is None else rows,
    }
    if disturbed:
        tables.plan |= {
            "rest_weight": equilibria._weight,
            "rest_size": equilibria.size,
            "rest_limit": equilibria._limit_size,
            "rest_low": equilibria._low,
            "rest_high": equilibria._high,
        }
    solver_settings(tables, daqp_defaults(), single=single)
    tables.reals |= {name: values[single] for name, values in _TOLERANCES.items()}
    _add_finish(tables, controller, low, high)
    add_observer(tables, observer, None, 0)
    tables.observer |= {"C": columns(np.eye(ny, nx)), "E": columns(given.E)}
    table = np.zeros((0, 1)) if references is None else _target_rows(controller, references)
    tables.targets = {"table": table}
    tables.sizes |= {"TARGETS": len(table), "TARGET": _target_size(controller)}
    tables.notes.append(
        "The equilibrium of a reference, and what the end of the horizon costs there, are found when the C is written: "
        "`koopmpc_table.h` holds them for the reference rows that `export` was given. A step whose reference holds "
        "another row is KOOPMPC_BAD_MEASUREMENT; export with all rows, or pass a table by `koopmpc_use_targets`."
    )
    if references is not None and len(references):
        tables.conditioning = _conditioning(controller, tables, references[0])
    return tables


def _add_finish(
    tables: Tables, controller: BilinearMPC, low: Float[np.ndarray, "b nq"], high: Float[np.ndarray, "b nq"]
) -> None:
    """Write which rows DAQP gets where interior points end early, their prices, and the sizes of its memory."""
    problem, N, nu, softness = controller._problem, controller._N, controller.nu, controller._iteration._softness
    kept = np.tile((np.isfinite(low) | np.isfinite(high))[:1], (N, 1))
    kept[~problem.free, :nu] = False
    place = np.flatnonzero(kept)
    soft = np.isfinite(softness.linear)
    sense = 8 * soft[place % kept.shape[1]]
    n = nu * int(problem.free.sum())
    reals, ints = memory_shares(n, len(place), int((sense > 0).sum()))
    tables.sizes |= {
        "FINISH_ROWS": len(place),
        "FINISH_WIDTH": n,
        "FINISH_SOFT": int((sense > 0).sum()),
        "FINISH_REALS": reals,
        "FINISH_INTS": ints,
    }
    tables.plan |= {
        "finish_row": place.astype(np.intc),
        "finish_at": (np.cumsum(problem.free) - problem.free).astype(np.intc),
        "finish_sense": sense.astype(np.intc),
        "finish_linear": np.where(soft, softness.linear, 0.0),
        "finish_quadratic": softness.quadratic,
    }


def _target_rows(controller: BilinearMPC, rows: Float[np.ndarray, "rows nr"]) -> Float[np.ndarray, "found size"]:
    """Return the table of targets of these reference rows, each one once; see `koopmpc_stages.h` for its columns."""
    found: list[Float[np.ndarray, " size"]] = []
    for row in dict.fromkeys(map(bytes, np.ascontiguousarray(rows))):
        r = np.frombuffer(row)
        target = controller._terminal(r)
        known = row not in controller._terminal._missed
        x, u, active = target.equilibrium
        n = controller._map.nx + len(r) + len(u) * (target.V.shape[0] > controller._map.nx + len(r))
        parts = (r, x, u, active, target.u, target.slope, target.M[:n], target.L[:n], target.V[:n], target.m[:n])
        found.append(np.concatenate([*(np.ravel(part) for part in parts), [float(known)]]))
    return np.array(found)


class TargetTable:
    """The targets of the reference rows that a BilinearMPC in machine code meets, found in Python; copies share it."""

    def __init__(self, controller: BilinearMPC) -> None:
        self._controller, self._lock = controller, Lock()
        self._known: set[bytes] = set()
        self._table = np.zeros((0, 1))

    def of(self, reference: Float[np.ndarray, "..."]) -> Float[np.ndarray, "rows size"]:
        """Return the table with the rows of this reference in it."""
        with self._lock:
            rows = np.atleast_2d(reference)
            rows = rows[np.abs(rows).max(axis=1, initial=0.0) < checks.HUGE]
            if len(self._known) + len(rows) > _ROWS:
                self._known, self._table = set(), np.zeros((0, 1))
            new = [row for row in rows if row.tobytes() not in self._known]
            if new:
                found = _target_rows(self._controller, np.array(new))
                self._table = np.vstack([self._table, found]) if len(self._table) else found
                self._known |= {row.tobytes() for row in new}
            return self._table


def _target_size(controller: BilinearMPC) -> int:
    o, nx, nu = controller._outputs, controller._map.nx, controller.nu
    nr, box = len(o.Q), len(o.outputs.low)
    goal = nx + nr + nu * (o.R_delta is not None and controller.cost.Q_N is None)
    return nr + nx + nu + (nu + box) + nu + nu * nx + goal * (nr + nx + nu + 1) + 1


def _add_functions(tables: Tables, controller: BilinearMPC) -> None:
    """Write the map, its derivatives, and the tracked and limited outputs with theirs."""
    problem, outputs, given = controller._problem, controller._outputs, controller._map
    nx, nu, ns = given.nx, controller.nu, problem.nx
    s, v, x, u = (ca.SX.sym(name, n) for name, n in (("s", ns), ("v", nu), ("x", nx), ("u", nu)))
    theta = ca.DM(given.theta)
    if not given.F.is_a("SXFunction"):
        raise DataError(
            "the model's map holds an implicit integrator or a callback, which cannot be written in C; "
            "discretize with RK4 or Euler, or fit a bilinear model to its data"
        )
    F, F_s = ca.SX(given.F(x, u, theta)), ca.SX(problem.F(s, v, theta))
    rows = [ca.vec(ca.densify(ca.jacobian(F_s, each)).T) for each in (s, v)]
    written = {
        "koopmpc_map": ({"x": x, "u": u}, [F], "next"),
        "koopmpc_stage_map": ({"s": s, "v": v}, [F_s], "next"),
        "koopmpc_slopes": ({"s": s, "v": v}, [*rows, F_s], "out"),
    }
    for name, function in (("koopmpc_tracked", problem.tracked), ("koopmpc_limited", problem.limited)):
        value = ca.SX(function(s)) if tables.sizes["LIMITED"] or name == "koopmpc_tracked" else ca.SX(1, 1)
        written[name] = ({"s": s}, [value, ca.vec(ca.densify(ca.jacobian(value, s)).T)], "out")
    r, of = ca.SX.sym("r", len(problem.Q)), ca.SX(problem.tracked(s))
    J = ca.jacobian(of, s)
    weighed = J.T @ ca.sparsify(ca.DM(problem.Q))
    written["koopmpc_stage"] = (
        {"s": s, "r": r},
        [ca.vec(ca.densify(weighed @ J)), ca.densify(weighed @ (of - r))],
        "out",
    )
    if controller._disturbed:
        of, g = ca.SX(outputs.tracked(x)), ca.SX(outputs.limited(x))
        found: list[ca.SX] = [F, *(ca.vec(ca.densify(ca.jacobian(F, each)).T) for each in (x, u))]
        for value in (of, g):
            found += [value, ca.vec(ca.densify(ca.jacobian(value, x)).T)]
        written["koopmpc_local"] = ({"x": x, "u": u}, found, "out")
    for name, (arguments, results, result) in written.items():
        whole = ca.densify(ca.vertcat(*results))
        function = ca.Function(name, list(arguments.values()), [whole], {"cse": True})
        graph = traced(function, "the model, or what the cost tracks,")
        tables.functions[name] = CFunction(graph, {key: each.numel() for key, each in arguments.items()}, result)


def _conditioning(controller: BilinearMPC, tables: Tables, row: Float[np.ndarray, " nr"]) -> float:
    """Return how many times a rounding of x, by its size, moves the first inputs, as a share of their span."""
    equilibria, o = controller._terminal.equilibria, controller._outputs
    rest = controller._terminal(row).equilibrium
    at = equilibria.linearise(rest.x, rest.u)
    Q = at.J.T @ o.Q @ at.J
    P, K = Q, np.zeros((controller.nu, len(rest.x)))
    for _ in range(controller._N):
        K = solve(o.R + at.B.T @ P @ at.B + 1e-12 * np.eye(len(o.R)), at.B.T @ P @ at.A)
        P = Q + at.A.T @ P @ (at.A - at.B @ K)
    return amplified(tables, K, equilibria.size[: len(rest.x)])
