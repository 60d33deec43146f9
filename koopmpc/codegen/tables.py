"""A controller as data for C: the sizes, arrays and functions that its C reads; those of all, of an LQR, a KoopmanMPC.

What a BilinearMPC has beside them is in `staged`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, cast

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.control.limits import Interval
from koopmpc.control.linear.koopman_mpc import KoopmanMPC
from koopmpc.control.lqr import LQR
from koopmpc.control.nonlinear.bilinear_mpc import BilinearMPC
from koopmpc.control.solvers.daqp import DAQP, FEW
from koopmpc.control.target import ROUNDING, Targets
from koopmpc.data.delay import Delay
from koopmpc.errors import DataError
from koopmpc.estimate.disturbance import DisturbanceObserver
from koopmpc.estimate.kalman import KalmanFilter
from koopmpc.estimate.observer import Measured
from koopmpc.plants.graph import Graph
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor

CArrays = dict[str, np.ndarray]
Exportable = LQR | KoopmanMPC | BilinearMPC
Precision = Literal["double", "float"]

_ZERO_ROW = 1e-11  # squared length below which DAQP leaves a row as it is

# DAQP's tolerances in single precision: its own are below the rounding of a float.
_SINGLE = {
    "primal_tol": 1e-5, "dual_tol": 1e-6, "zero_tol": 1e-6, "pivot_tol": 1e-4,
    "progress_tol": 1e-7, "sing_tol": 1e-6, "refactor_tol": 1e-5,
}  # fmt: skip
_OTHERS = ("cycle_tol", "iter_limit", "eps_prox", "eta_prox", "rho_soft", "rel_subopt", "abs_subopt", "w_soft")
_C_SETTINGS = (*_SINGLE, "fval_bound", *_OTHERS)


class CFunction(NamedTuple):
    """A function of C: ``void name(const real *argument, …, real *result)``."""

    graph: Graph
    arguments: dict[str, int]
    result: str


@dataclass
class Tables:
    """A controller as data for C: `sizes` are integers, the tables arrays, `settings` those of the QP solver.

    `conditioning` is how many times the rounding of an input's span a rounding of the lifted state moves the plan.
    """

    model: LinearPredictor | BilinearPredictor | StepMap
    sizes: dict[str, int]
    functions: dict[str, CFunction]
    limits: CArrays = field(default_factory=dict)
    plan: CArrays = field(default_factory=dict)
    observer: CArrays = field(default_factory=dict)
    targets: CArrays = field(default_factory=dict)
    target_qps: list[tuple[int, int]] = field(default_factory=list)
    settings: dict[str, float] = field(default_factory=dict)
    reals: dict[str, float] = field(default_factory=dict)
    conditioning: float = 0.0
    notes: list[str] = field(default_factory=list)

    @property
    def is_lqr(self) -> bool:
        """Whether it is a feedback law."""
        return bool(self.sizes["IS_LQR"])

    @property
    def is_staged(self) -> bool:
        """Whether its plan is iterated on a nonlinear model, stage by stage."""
        return bool(self.sizes["IS_STAGED"])


def exportable(controller: object) -> Exportable:
    """Return a controller that can be written in C.

    Raises
    ------
    DataError
        It cannot; the message says which part of it is the reason, and what would do.
    """
    if not isinstance(controller, Exportable):
        name = type(controller).__name__
        why = {
            "NonlinearMPC": "it solves its problem with ipopt or CasADi's own methods, which are no C of ours",
            "Adaptive": "its model changes while it runs; export the controller inside it",
            "Guarded": "it holds two controllers; export each of them",
        }.get(name, "it is no controller that koopmpc can write in C")
        would = "a BilinearMPC of the same model" if name == "NonlinearMPC" else "a BilinearMPC, a LinearMPC or an LQR"
        raise DataError(f"a {name} cannot be exported: {why}; export a KoopmanMPC, {would}")
    if isinstance(controller, LQR):
        return controller
    if controller._time_limit is not None:
        bound = "" if isinstance(controller, BilinearMPC) else ', settings={"iter_limit": 100}'
        raise DataError(
            "the controller has a time_limit, and C has no clock; make it without one and bound the iterations: "
            + ("sqp_iterations=1" if not bound else f'solver="daqp"{bound}')
        )
    if controller.watch is not None:
        raise DataError(
            "the controller has a monitor, whose data are not written in C; export the controller without monitor=, "
            "and have a Python loop or a log ask the monitor"
        )
    observer = controller._initial.observer
    if type(observer) not in (Measured, DisturbanceObserver, KalmanFilter):
        raise DataError(
            f"the estimator {type(controller._estimator).__name__} cannot be written in C; "
            "use LiftedDisturbance or LiftedKalman"
        )
    return controller


def traced(function: ca.Function, what: str) -> Graph:
    """Return the graph of a function with one result.

    Raises
    ------
    DataError
        It holds what cannot be written in C; the message says what it is and what would do.
    """
    try:
        return Graph.trace(function)
    except DataError as error:
        raise DataError(f"{what} cannot be written in C: {error}") from error


def columns(matrix: np.ndarray) -> np.ndarray:
    """Return a matrix as one column after the other."""
    return np.ascontiguousarray(np.asarray(matrix).T).ravel()


def model_tables(
    model: LinearPredictor | BilinearPredictor | StepMap,
    sizes: dict[str, int],
    lift: Callable[[ca.SX], ca.SX],
    embedding: Delay | None,
    inputs: Interval,
) -> Tables:
    """Return what all controllers have: sizes, the lifting of the state and its past, the limits of the inputs.

    Raises
    ------
    DataError
        The lifting holds an operation that cannot be written in C, or the past that of other inputs.
    """
    nu = sizes["NU"]
    if embedding is not None and embedding.inputs and embedding.bound and len(embedding.bound[1]) != nu:
        raise DataError("the embedding holds other inputs than the predictor; fit both on the same data to export it")
    zeta = ca.SX.sym("zeta", sizes["NZETA"])
    graph = traced(ca.Function("lifting", [zeta], [ca.densify(lift(zeta))], {"cse": True}), "the lifting")
    kinds = {"IS_LQR": 0, "IS_STAGED": 0}
    steps, inputs_too = (0, 0) if embedding is None else (embedding.steps, int(embedding.inputs))
    past = {"DELAYS": steps, "DELAYED_INPUTS": inputs_too}
    tables = Tables(
        model,
        kinds | past | {"NW1": max(1, sizes["NW"])} | sizes,
        {"koopmpc_lift": CFunction(graph, {"zeta": sizes["NZETA"]}, "z")},
    )
    tables.limits = {"input_low": inputs.low, "input_high": inputs.high}
    return tables


def add_limits(tables: Tables, **limits: Interval | None) -> None:
    """Write both ends of further limits of the inputs, zeros where there is none."""
    none = np.zeros(tables.sizes["NU"])
    for name, limit in limits.items():
        low, high = (none, none) if limit is None else limit
        tables.limits |= {f"{name}_low": low, f"{name}_high": high}


def add_observer(tables: Tables, observer: object, predictor: LinearPredictor | None, latency: int) -> None:
    """Write the filter, and the linear model where it is advanced."""
    plan, sizes = tables.observer, tables.sizes
    if isinstance(observer, KalmanFilter):
        system, P, R = observer._system, observer._P, observer._R
        S = system.M @ P @ system.M.T + R
        unit = np.sqrt(S.diagonal())
        sizes |= {
            "ESTIMATOR": 2,
            "NY": observer.ny,
            "NS": len(system.F),
            "DELAY_Y": observer._delay,
            "PATIENCE": observer._patience,
            "KEPT": len(system.kept),
        }
        plan |= {
            "filter_F": columns(system.F),
            "filter_G": columns(system.G),
            "filter_f": system.f,
            "filter_M": system.M,
            "filter_h": system.h,
            "filter_S": S / np.outer(unit, unit),
            "filter_PM": columns(P @ system.M.T / unit),
            "filter_unit": unit,
            "filter_z": columns(system.to_z),
            "filter_one": system.one,
            "filter_d": columns(system.to_d),
            "kept": np.asarray(system.kept, dtype=np.intc),
        }
    elif isinstance(observer, DisturbanceObserver):
        sizes["ESTIMATOR"] = 1
        tables.reals["GAIN"] = observer.gain
    if predictor is not None and (isinstance(observer, DisturbanceObserver) or latency):
        plan["C"] = columns(predictor.C)
        plan |= {"A": columns(predictor.A), "B": columns(predictor.B), "E": columns(predictor.E)}


def amplified(tables: Tables, gain: Float[np.ndarray, "n nz"], size: Float[np.ndarray, " nz"]) -> float:
    """Return Σ |gain| size over an input's span, the worst of all inputs of the plan; `size` is that of z."""
    span = tables.limits["input_high"] - tables.limits["input_low"]
    reach = np.abs(gain) @ size
    known = np.where(np.isfinite(span) & (span > 0), span, reach[: len(span)] + 1e-300)
    return float((reach / np.tile(known, len(reach) // len(known))).max())


def daqp_defaults() -> dict[str, Any]:
    """Return the settings that DAQP has here where none are given."""
    from koopmpc.control.solvers.base import QP

    one = np.ones(1)
    return dict(DAQP(QP(np.eye(1), 0 * one, np.eye(1), -one, one))._model.settings)


def solver_settings(tables: Tables, known: dict[str, Any], *, single: bool) -> None:
    """Write DAQP's settings and the tolerances beside them."""
    if known["time_limit"] > 0:
        raise DataError(
            'a time_limit cannot be exported, C has no clock; bound the iterations: settings={"iter_limit": 100}'
        )
    settings = {name: float(value) for name, value in known.items() if name in _C_SETTINGS}
    if single:
        settings |= {name: max(settings[name], least) for name, least in _SINGLE.items()}
    tables.settings = settings
    tables.reals |= {
        "PRIMAL_TOL": settings["primal_tol"],
        "ZERO_TOL": settings["zero_tol"],
        "WIDER": 1e-5 if single else 1e-8,
        "ACCURACY": 5e-3 if single else 1e-6,
        "ROUNDING": 1e-6 if single else ROUNDING,
    }


def memory_shares(n: int, m: int, soft: int) -> tuple[int, int]:
    """Return how many numbers and integers a problem of n variables and m rows, some of them soft, takes."""
    rank = n + soft + 1
    return 6 * m + 2 * n + 5 * rank + rank * (rank + 1) // 2, m + rank + 3


def lqr_tables(controller: LQR, *, single: bool) -> Tables:
    """Return the tables of a feedback law."""
    predictor, targets = controller.predictor, controller._targets
    tables = _shared(predictor, targets, controller._inputs)
    given, rates = controller._given_rows, controller._rates
    tables.sizes |= {
        "IS_LQR": 1,
        "HORIZON": 0,
        "LATENCY": 0,
        "N": 1,
        "WITH_RATES": int(controller._K_rate.size > 0),
        "RATED": int(rates is not None),
        "GIVEN": 0 if given is None else len(given),
    }
    add_limits(tables, rate=rates)
    na = targets.Z.shape[1]
    tables.plan = {
        "E": columns(predictor.E),
        "gain": columns(-controller._K),
        "gain_rate": columns(-controller._K_rate),
        "feedforward": columns(controller._v),
        "given": np.zeros(0) if given is None else given,
        "target_input": targets.u0,
        "target_span": columns(targets.W if na else np.zeros((predictor.nu, 1))),
        "target_push": columns(targets.u_disturbance),
    }
    probe = cast("DAQP", targets._solver(len(targets.rows))) if na else None
    known = daqp_defaults() if probe is None else dict(probe._model.settings)
    solver_settings(tables, known, single=single)
    _memory(tables, 1, 0, 0)
    tables.conditioning = _amplified(tables, predictor, -controller._K)
    return tables


def koopman_tables(controller: KoopmanMPC, *, single: bool) -> Tables:
    """Return the tables of a KoopmanMPC; one that solves with OSQP has those of its twin with DAQP."""
    saved = controller.as_data()
    own = saved.options["solver"] == "daqp"
    twin = controller
    if not own:
        twin = KoopmanMPC(
            controller.predictor,
            saved.cost,
            saved.limits,
            saved.horizon,
            estimator=controller._estimator,
            latency=saved.latency,
            moves=saved.moves,
            solver="daqp",
        )
    predictor, plan = twin.predictor, twin._map
    tables = _shared(predictor, plan.targets, plan.track.inputs)
    if not own:
        tables.notes.append(
            "The controller solves with OSQP; this C solves with DAQP, to rounding: inputs differ by OSQP's tolerance."
        )
    track, maps, qp = plan.track, plan.maps, plan.qp
    nz, checked, aimed = predictor.nz, int(plan.checked.sum()), bool(plan.aimed and plan.targets.Z.shape[1])
    given = track.given
    tables.sizes |= {
        "N": twin._N,
        "LATENCY": twin._latency,
        "HORIZON": twin.horizon,
        "WITH_RATES": int(track.with_rates),
        "RATED": int(track.rates is not None),
        "HARD_RATED": int(track.hard_rates is not None),
        "KNOWN": plan.matrix.shape[1] - 1,
        "NT": len(plan.matrix),
        "MOVES": plan.moves,
        "PLANNED": plan.planned,
        "AIMED": int(aimed),
        "CHECKED": checked,
        "CHECKED_LIMITS": int(plan.disturbance.shape[1] > 0),
        "GIVEN": 0 if given is None else len(given),
        "CONSTANT": -1 if predictor.lifting.constant_index is None else predictor.lifting.constant_index,
        "ESTIMATOR": 0,
        "NS": nz,
    }
    add_limits(tables, rate=track.rates, hard_rate=track.hard_rates)
    tables.limits["move_of"] = np.asarray(twin._move_of, dtype=np.intc)
    solver = cast("DAQP", twin._qps._solvers[0])
    M, scaling = _normalised(solver._M)
    rate_input = np.full(len(qp.source), -1, dtype=np.intc)
    rate_input[qp.rate_rows] = qp.rate_inputs
    if not np.array_equal(solver._H, np.eye(plan.moves)):
        raise AssertionError("the Hessian of Riccati coordinates is the identity")
    tables.plan = {
        "map": columns(plan.matrix[:, :-1]),
        "low": plan.low,
        "high": plan.high,
        "offset": maps.offset,
        "from_reference": columns(maps.from_reference),
        "from_target": columns(maps.from_target) if aimed else np.zeros(0),
        "from_given": np.zeros(0) if given is None else columns(maps.from_given),
        "given": np.zeros(0) if given is None else given,
        "checked": plan.targets.rows[plan.checked] if checked else np.zeros(0),
        "disturbance": columns(plan.disturbance) if checked else np.zeros(0),
        "M": M,
        "scaling": scaling,
        "unit": solver._rows,
        "sense": solver._sense.astype(np.intc),
        "linear": np.where(solver._sense != 0, solver._linear, 0.0),
        "rho": np.where(solver._sense != 0, 1 / solver._curved, 0.0),
        "source": np.asarray(qp.source, dtype=np.intc),
        "scale": qp.scale,
        "qp_low": np.maximum(qp.low, -1e30),
        "qp_high": np.minimum(qp.high, 1e30),
        "allowance": qp.softness.allowance,
        "rate_input": rate_input,
        "shift": np.asarray(qp.shift_dual, dtype=np.intc),
        "deviation": columns(plan.deviation),
    }
    add_observer(tables, twin._initial.observer, predictor, twin._latency)
    solver_settings(tables, dict(solver._model.settings), single=single)
    _memory(tables, plan.moves, len(qp.source), int((solver._sense != 0).sum()))
    steep = bool(len(qp.source)) and solver._steep()
    tables.sizes |= {"QP_MIXED": int(solver._mixed), "STEEP": int(steep), "FEW": FEW}
    if steep:
        values, V = np.linalg.eigh(solver._metric())
        tables.plan |= {"lambda": np.maximum(values, 0.0), "V": V, "MV": solver._M @ V}
    tables.conditioning = _amplified(tables, predictor, plan.matrix[: plan.moves, :nz])
    return tables


def _shared(predictor: LinearPredictor, targets: Targets, inputs: Interval) -> Tables:
    """Return what an LQR and a KoopmanMPC have in common: sizes, the lifting, limits of the inputs, targets."""
    sizes = {
        "NX": predictor.nx,
        "NY": predictor.nx,
        "NZETA": len(predictor.lifting.bound_states),
        "NZ": predictor.nz,
        "LEARNED": predictor.nz,
        "NU": predictor.nu,
        "NR": targets.from_reference.shape[1],
        "NW": predictor.nw,
        "NA": max(1, targets.Z.shape[1]),
        "NL": max(1, len(targets.rows)),
    }
    tables = model_tables(predictor, sizes, predictor.lifting.symbolic, predictor.embedding, inputs)
    _add_targets(tables, targets)
    return tables


def _amplified(tables: Tables, predictor: LinearPredictor, gain: Float[np.ndarray, "n nz"]) -> float:
    """Return how many times a rounding of z, as large as the data were, moves the plan."""
    scale = predictor.scale
    size = np.ones(predictor.nz) if scale is None else np.asarray(np.linalg.norm(scale, axis=0))
    return amplified(tables, gain, size)


def _add_targets(tables: Tables, found: Targets) -> None:
    """Write the targets and the two problems that move one inside its limits.

    Where there are no coordinates C has one that means nothing.
    """
    na = found.Z.shape[1]

    def pad(rows: np.ndarray) -> np.ndarray:
        return rows if na else np.zeros((1, *rows.shape[1:]))

    def wide(matrix: np.ndarray) -> np.ndarray:
        return matrix if na else np.zeros((len(matrix), 1))

    tables.targets = {
        "target_offset": pad(found.offset),
        "target_reference": columns(pad(found.from_reference)),
        "target_disturbance": columns(pad(found.from_disturbance)),
        "target_rows": columns(wide(found.rows)),
        "target_rows_disturbance": columns(found.rows_disturbance),
        "target_low": found.low,
        "target_high": found.high,
        "target_size": found.size,
    }
    for which, count in enumerate((len(found.rows), found.hard)):
        if na:
            solver = cast("DAQP", found._solver(count))
            rinv = np.linalg.inv(np.linalg.cholesky(solver._H).T)
            M, unit = solver._M @ rinv, solver._rows
            rinv = solver._columns[:, None] * rinv
        else:
            M, unit, rinv = np.zeros((count, 1)), np.ones(count), np.eye(1)
        M, scaling = _normalised(M)
        mine = {
            "M": M,
            "scaling": scaling,
            "rinv": rinv[np.triu_indices(len(rinv))],
            "sense": np.zeros(count, dtype=np.intc),
            "unit": unit,
        }
        tables.targets |= {f"target_{name}_{which}": values for name, values in mine.items()}
        tables.target_qps.append((max(1, na), count))


def _normalised(rows: Float[np.ndarray, "m n"]) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, " m"]]:
    """Return rows of length 1, and by what they were multiplied, as DAQP does it."""
    squares = (rows**2).sum(axis=1)
    scaling = np.where(squares < _ZERO_ROW, 1.0, 1 / np.sqrt(np.where(squares > 0, squares, 1.0)))
    return rows * scaling[:, None], scaling


def _memory(tables: Tables, n: int, m: int, soft: int) -> None:
    """Set the sizes of the solver's memory: that of the plan's problem, and that of the targets'."""
    reals, ints = zip(*(memory_shares(n, m, 0) for n, m in tables.target_qps), strict=True)
    sizes = memory_shares(n, m, soft)
    tables.sizes |= {
        "QP_M": m,
        "QP_M1": max(1, m),
        "QP_SOFT": soft,
        "QP_REALS": sizes[0],
        "QP_INTS": sizes[1],
        "TARGET_REALS": max(reals),
        "TARGET_INTS": max(ints),
    }
