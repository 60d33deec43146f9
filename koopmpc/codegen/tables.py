"""What a controller is made of, as the sizes, the arrays and the functions that its C reads."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.codegen.text import Graph, traced
from koopmpc.control.limits import Interval
from koopmpc.control.linear.koopman_mpc import KoopmanMPC
from koopmpc.control.lqr import LQR
from koopmpc.control.nonlinear.bilinear_mpc import BilinearMPC
from koopmpc.data.delay import Delay
from koopmpc.errors import DataError
from koopmpc.estimate.disturbance import DisturbanceObserver
from koopmpc.estimate.kalman import KalmanFilter
from koopmpc.estimate.observer import Measured
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor

CArrays = dict[str, np.ndarray]
Exportable = LQR | KoopmanMPC | BilinearMPC


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


def refusal(controller: object) -> DataError | None:
    """Return why a controller cannot be written in C, which part of it is the reason, and what would do; else None."""
    if not isinstance(controller, Exportable):
        name = type(controller).__name__
        why = {
            "NonlinearMPC": "it solves its problem with ipopt or CasADi's own methods, which are no C of ours",
            "Adaptive": "its model changes while it runs; export the controller inside it",
            "Guarded": "it holds two controllers; export each of them",
        }.get(name, "it is no controller that koopmpc can write in C")
        would = "a BilinearMPC of the same model" if name == "NonlinearMPC" else "a BilinearMPC, a LinearMPC or an LQR"
        return DataError(f"a {name} cannot be exported: {why}; export a KoopmanMPC, {would}")
    if isinstance(controller, LQR):
        return None
    if controller._time_limit is not None:
        bound = "" if isinstance(controller, BilinearMPC) else ', settings={"iter_limit": 100}'
        return DataError(
            "the controller has a time_limit, and C has no clock; make it without one and bound the iterations: "
            + ("sqp_iterations=1" if not bound else f'solver="daqp"{bound}')
        )
    if controller.watch is not None:
        return DataError(
            "the controller has a monitor, whose data are not written in C; export the controller without monitor=, "
            "and have a Python loop or a log ask the monitor"
        )
    observer = controller._initial.observer
    if type(observer) not in (Measured, DisturbanceObserver, KalmanFilter):
        return DataError(
            f"the estimator {type(controller._estimator).__name__} cannot be written in C; "
            "use LiftedDisturbance or LiftedKalman"
        )
    return None


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
