"""What a controller is made of, as the sizes and the arrays that its C reads."""

from dataclasses import dataclass, field
from typing import Any, cast

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.codegen.text import Graph, traced
from koopmpc.control.limits import Interval
from koopmpc.control.linear.koopman_mpc import KoopmanMPC
from koopmpc.control.lqr import LQR
from koopmpc.control.solvers.daqp import DAQP, FEW
from koopmpc.control.target import ROUNDING, Targets
from koopmpc.errors import DataError
from koopmpc.estimate.disturbance import Filtered
from koopmpc.estimate.filtered import Kalman
from koopmpc.estimate.observer import Measured
from koopmpc.predict.predictors import LinearPredictor

CArrays = dict[str, np.ndarray]
_ZERO_ROW = 1e-11  # squared length below which DAQP leaves a row as it is
_ADVICE = "export a KoopmanMPC, a LinearMPC or an LQR"

# DAQP's tolerances in single precision: its own are below the rounding of a float.
_SINGLE = {
    "primal_tol": 1e-5,
    "dual_tol": 1e-6,
    "zero_tol": 1e-6,
    "pivot_tol": 1e-4,
    "progress_tol": 1e-7,
    "sing_tol": 1e-6,
    "refactor_tol": 1e-5,
}


@dataclass
class Tables:
    """A controller as data for C: `sizes` are integers, the tables arrays, `settings` those of the QP solver.

    `conditioning` is how many times the rounding of an input's span a rounding of the lifted state moves the plan.
    """

    predictor: LinearPredictor
    sizes: dict[str, int]
    limits: CArrays = field(default_factory=dict)
    plan: CArrays = field(default_factory=dict)
    targets: CArrays = field(default_factory=dict)
    target_qps: list[tuple[int, int]] = field(default_factory=list)
    settings: dict[str, float] = field(default_factory=dict)
    reals: dict[str, float] = field(default_factory=dict)
    lifting: Graph | None = None
    conditioning: float = 0.0
    notes: list[str] = field(default_factory=list)

    @property
    def is_lqr(self) -> bool:
        """Whether it is a feedback law."""
        return bool(self.sizes["IS_LQR"])


def tables_of(controller: object, *, single: bool) -> Tables:
    """Return the tables of a controller.

    Raises
    ------
    DataError
        It cannot be written in C; the message says which part of it, and what would do.
    """
    if isinstance(controller, LQR):
        return _lqr(controller, single=single)
    if isinstance(controller, KoopmanMPC):
        return _koopman(controller, single=single)
    name = type(controller).__name__
    why = {
        "NonlinearMPC": "it solves its problem with ipopt or CasADi's own methods, which are no C of ours",
        "BilinearMPC": "its plan is iterated on a nonlinear model, which is not written in C yet",
        "Adaptive": "its model changes while it runs; export the controller inside it",
        "Guarded": "it holds two controllers; export each of them",
    }.get(name, "it is no controller that koopmpc can write in C")
    raise DataError(f"a {name} cannot be exported: {why}; {_ADVICE}")


def _columns(matrix: np.ndarray) -> np.ndarray:
    """Return a matrix as one column after the other."""
    return np.ascontiguousarray(np.asarray(matrix).T).ravel()


def _shared(predictor: LinearPredictor, targets: Targets, inputs: Interval, *, lqr: bool) -> Tables:
    """Return the part that all controllers have: sizes, the lifting, limits of the inputs, targets."""
    embedding = predictor.embedding
    states = predictor.lifting.bound_states
    zeta = ca.SX.sym("zeta", len(states))
    lift = ca.Function("lifting", [zeta], [ca.densify(predictor.lifting.symbolic(zeta))], {"cse": True})
    sizes = {
        "IS_LQR": int(lqr),
        "NX": predictor.nx,
        "NY": predictor.nx,
        "NZETA": len(states),
        "NZ": predictor.nz,
        "NU": predictor.nu,
        "NR": targets.from_reference.shape[1],
        "NW": predictor.nw,
        "NW1": max(1, predictor.nw),
        "DELAYS": 0 if embedding is None else embedding.steps,
        "DELAYED_INPUTS": 0 if embedding is None else int(embedding.inputs),
        "NA": max(1, targets.Z.shape[1]),
        "NL": max(1, len(targets.rows)),
    }
    if embedding is not None and embedding.inputs and embedding.bound and len(embedding.bound[1]) != predictor.nu:
        raise DataError("the embedding holds other inputs than the predictor; fit both on the same data to export it")
    tables = Tables(predictor, sizes, lifting=traced(lift, "the lifting"))
    tables.limits = {"input_low": inputs.low, "input_high": inputs.high}
    _add_targets(tables, targets)
    return tables


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
        "target_reference": _columns(pad(found.from_reference)),
        "target_disturbance": _columns(pad(found.from_disturbance)),
        "target_rows": _columns(wide(found.rows)),
        "target_rows_disturbance": _columns(found.rows_disturbance),
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


def _solver_settings(tables: Tables, known: dict[str, Any], *, single: bool) -> None:
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


_REALS = ("primal_tol", "dual_tol", "zero_tol", "pivot_tol", "progress_tol", "sing_tol", "refactor_tol", "fval_bound")
_OTHERS = ("cycle_tol", "iter_limit", "eps_prox", "eta_prox", "rho_soft", "rel_subopt", "abs_subopt", "w_soft")
_C_SETTINGS = (*_REALS, *_OTHERS)


def _memory(tables: Tables, n: int, m: int, soft: int) -> None:
    """Set the sizes of the solver's memory: that of the plan's problem, and that of the targets'."""
    reals, ints = zip(*(_shares(n, m, 0) for n, m in tables.target_qps), strict=True)
    sizes = _shares(n, m, soft)
    tables.sizes |= {
        "QP_M": m,
        "QP_M1": max(1, m),
        "QP_SOFT": soft,
        "QP_REALS": sizes[0],
        "QP_INTS": sizes[1],
        "TARGET_REALS": max(reals),
        "TARGET_INTS": max(ints),
    }


def _shares(n: int, m: int, soft: int) -> tuple[int, int]:
    """Return how many numbers and integers a problem of n variables and m rows, some of them soft, takes."""
    rank = n + soft + 1
    return 6 * m + 2 * n + 5 * rank + rank * (rank + 1) // 2, m + rank + 3


def _lqr(controller: LQR, *, single: bool) -> Tables:
    predictor, targets = controller.predictor, controller._targets
    tables = _shared(predictor, targets, controller._inputs, lqr=True)
    given, rates = controller._given_rows, controller._rates
    nothing = np.zeros(predictor.nu)
    tables.sizes |= {
        "HORIZON": 0,
        "LATENCY": 0,
        "N": 1,
        "WITH_RATES": int(controller._K_rate.size > 0),
        "RATED": int(rates is not None),
        "GIVEN": 0 if given is None else len(given),
    }
    low, high = (nothing, nothing) if rates is None else rates
    tables.limits |= {"rate_low": low, "rate_high": high}
    na = targets.Z.shape[1]
    tables.plan = {
        "E": _columns(predictor.E),
        "gain": _columns(-controller._K),
        "gain_rate": _columns(-controller._K_rate),
        "feedforward": _columns(controller._v),
        "given": np.zeros(0) if given is None else given,
        "target_input": targets.u0,
        "target_span": _columns(targets.W if na else np.zeros((predictor.nu, 1))),
        "target_push": _columns(targets.u_disturbance),
    }
    probe = cast("DAQP", targets._solver(len(targets.rows))) if na else None
    known = _defaults() if probe is None else dict(probe._model.settings)
    _solver_settings(tables, known, single=single)
    _memory(tables, 1, 0, 0)
    tables.conditioning = _amplified(tables, -controller._K)
    return tables


def _defaults() -> dict[str, Any]:
    """Return the settings that DAQP has here where none are given."""
    from koopmpc.control.solvers.qp import QP

    one = np.ones(1)
    return dict(DAQP(QP(np.eye(1), 0 * one, np.eye(1), -one, one))._model.settings)


def _koopman(controller: KoopmanMPC, *, single: bool) -> Tables:
    if controller._time_limit is not None:
        raise DataError(
            "the controller has a time_limit, and C has no clock; make it without one and bound the iterations: "
            'solver="daqp", settings={"iter_limit": 100}'
        )
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
    tables = _shared(predictor, plan.targets, plan.track.inputs, lqr=False)
    if not own:
        tables.notes.append(
            "The controller solves with OSQP; this C solves with DAQP, to rounding: inputs differ by OSQP's tolerance."
        )
    if saved.monitor is not None:
        tables.notes.append("The monitor is not exported: no step says whether it is known.")
    track, maps, qp = plan.track, plan.maps, plan.qp
    N, nu, nz, na = twin._N, predictor.nu, predictor.nz, max(1, plan.targets.Z.shape[1])
    observer = twin._initial.observer
    driven = plan.disturbance.shape[1] > 0
    checked = int(plan.checked.sum())
    given = track.given
    tables.sizes |= {
        "N": N,
        "LATENCY": twin._latency,
        "HORIZON": twin.horizon,
        "WITH_RATES": int(track.with_rates),
        "RATED": int(track.rates is not None),
        "HARD_RATED": int(track.hard_rates is not None),
        "KNOWN": plan.matrix.shape[1] - 1,
        "NT": len(plan.matrix),
        "MOVES": plan.moves,
        "PLANNED": plan.planned,
        "AIMED": int(plan.aimed),
        "CHECKED": checked,
        "CHECKED_LIMITS": int(driven),
        "GIVEN": 0 if given is None else len(given),
        "CONSTANT": -1 if predictor.lifting.constant_index is None else predictor.lifting.constant_index,
        "ESTIMATOR": 0,
        "NS": nz,
    }
    none = np.zeros(nu)
    for name, box in (("rate", track.rates), ("hard_rate", track.hard_rates)):
        low, high = (none, none) if box is None else box
        tables.limits |= {f"{name}_low": low, f"{name}_high": high}
    solver = cast("DAQP", twin._qps._solvers[0])
    M, scaling = _normalised(solver._M)
    rate_input = np.full(len(qp.source), -1, dtype=np.intc)
    rate_input[qp.rate_rows] = qp.rate_inputs
    shift = np.asarray(qp.shift_dual, dtype=np.intc)
    if not np.array_equal(solver._H, np.eye(plan.moves)):
        raise AssertionError("the Hessian of Riccati coordinates is the identity")
    tables.plan = {
        "map": _columns(plan.matrix[:, :-1]),
        "low": plan.low,
        "high": plan.high,
        "move_of": np.asarray(twin._move_of, dtype=np.intc),
        "offset": maps.offset,
        "from_reference": _columns(maps.from_reference),
        "from_target": _columns(maps.from_target) if plan.aimed and plan.targets.Z.shape[1] else np.zeros(0),
        "from_given": np.zeros(0) if given is None else _columns(maps.from_given),
        "given": np.zeros(0) if given is None else given,
        "checked": plan.targets.rows[plan.checked] if checked else np.zeros(0),
        "disturbance": _columns(plan.disturbance) if checked else np.zeros(0),
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
        "shift": shift,
        "deviation": _columns(plan.deviation),
    }
    if tables.sizes["AIMED"] and not plan.targets.Z.shape[1]:
        tables.sizes["AIMED"] = 0
    _add_estimator(tables, observer, twin._latency)
    _solver_settings(tables, dict(solver._model.settings), single=single)
    _memory(tables, plan.moves, len(qp.source), int((solver._sense != 0).sum()))
    steep = bool(len(qp.source)) and solver._steep()
    tables.sizes |= {"QP_MIXED": int(solver._mixed), "STEEP": int(steep), "FEW": FEW}
    if steep:
        values, V = np.linalg.eigh(solver._metric())
        tables.plan |= {"lambda": np.maximum(values, 0.0), "V": V, "MV": solver._M @ V}
    assert na == tables.sizes["NA"]
    tables.conditioning = _amplified(tables, plan.matrix[: plan.moves, :nz])
    return tables


def _add_estimator(tables: Tables, observer: object, latency: int) -> None:
    """Write the model, where it is advanced, and the filter."""
    predictor, plan, sizes = tables.predictor, tables.plan, tables.sizes
    if isinstance(observer, Kalman):
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
            "filter_F": _columns(system.F),
            "filter_G": _columns(system.G),
            "filter_f": system.f,
            "filter_M": system.M,
            "filter_h": system.h,
            "filter_S": S / np.outer(unit, unit),
            "filter_PM": _columns(P @ system.M.T / unit),
            "filter_unit": unit,
            "filter_z": _columns(system.to_z),
            "filter_one": system.one,
            "filter_d": _columns(system.to_d),
            "kept": np.asarray(system.kept, dtype=np.intc),
        }
    elif isinstance(observer, Filtered):
        sizes["ESTIMATOR"] = 1
        tables.reals["GAIN"] = observer.gain
        plan["C"] = _columns(predictor.C)
    elif type(observer) is not Measured:
        raise DataError(
            f"the estimator's {type(observer).__name__} cannot be written in C; use LiftedDisturbance or LiftedKalman"
        )
    if isinstance(observer, Filtered) or latency:
        plan |= {"A": _columns(predictor.A), "B": _columns(predictor.B), "E": _columns(predictor.E)}


def _amplified(tables: Tables, gain: Float[np.ndarray, "n nz"]) -> float:
    """Return Σ |gain| |z| over an input's span, the worst of all inputs of the plan, z as large as the data were."""
    scale, limits = tables.predictor.scale, tables.limits
    size = np.ones(gain.shape[1]) if scale is None else np.linalg.norm(scale, axis=0)
    span = limits["input_high"] - limits["input_low"]
    reach = np.abs(gain) @ size
    known = np.where(np.isfinite(span) & (span > 0), span, reach[: len(span)] + 1e-300)
    return float((reach / np.tile(known, len(reach) // len(known))).max())
