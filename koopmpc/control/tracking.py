"""What a controller tracks and limits, with its weights: matrices of a lifted model, or functions of a state."""

from dataclasses import dataclass
from typing import Generic, TypeAlias, TypeVar

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.control.cost import Cost
from koopmpc.control.limits import Interval, Limits, SizedLimits, Softness
from koopmpc.errors import DataError
from koopmpc.lifting.base import Lifting, rows
from koopmpc.lifting.state import State
from koopmpc.predict.predictors import LinearPredictor

Read = TypeVar("Read", np.ndarray, ca.Function)


@dataclass(frozen=True)
class Tracking(Generic[Read]):
    """The weights and limits of a problem, on what `tracked` and `limited` read from the model's state.

    Both are matrices (nr, nz) and (ng, nz) on a lifted state, or functions of x. Rows without a limit are left out.
    `softness` says what it costs to leave `outputs`, row by row; a linear weight of inf makes a row hard. R_delta and
    `rates` are None where the change of the inputs is free, and `with_rates` says whether it counts. `hard_rates` are
    those of `SizedLimits`.
    """

    tracked: Read
    limited: Read
    Q: Float[np.ndarray, "nr nr"]
    R: Float[np.ndarray, "nu nu"]
    R_delta: Float[np.ndarray, "nu nu"] | None
    inputs: Interval
    rates: Interval | None
    hard_rates: Interval | None
    rate_softness: Softness
    outputs: Interval
    softness: Softness
    with_rates: bool


LiftedTracking: TypeAlias = Tracking[np.ndarray]
StateTracking: TypeAlias = Tracking[ca.Function]


def lifted_tracking(predictor: LinearPredictor, cost: Cost, limits: Limits) -> LiftedTracking:
    """Return what `cost` tracks and `limits` bound, as matrices on the lifted coordinates of `predictor`.

    Raises
    ------
    ObservableError
        The cost or a limit is on an observable that the lifting lacks.
    ShapeError
        A weight or a limit has another size than what it weighs or limits.
    """
    C, G, nx = observed(predictor, cost.of), predictor.C, predictor.nx
    if limits.of is not None:
        G = np.vstack([G, observed(predictor, limits.of)])
    given = limits.sized(nx, len(G) - nx, predictor.nu)
    return _tracking(C, np.ascontiguousarray(G[given.rows.kept]), cost, len(C), given)


def state_tracking(
    states: tuple[str, ...], nu: int, cost: Cost, limits: Limits, size: int | None = None
) -> StateTracking:
    """Return what `cost` tracks and `limits` bound, as functions of these states.

    The functions take `size` values, the states first; by default the states alone.
    """
    nx = len(states)
    point = ca.SX.sym("x", nx if size is None else size)
    x, of = point[:nx], cost.of.bind(states)
    bound = None if limits.of is None else limits.of.bind(states)
    values = x if bound is None else ca.vertcat(x, bound.symbolic(x))
    given = limits.sized(nx, 0 if bound is None else bound.nz, nu)
    kept = np.flatnonzero(given.rows.kept).tolist()
    tracked = ca.Function("tracked", [point], [ca.densify(of.symbolic(x))])
    limited = ca.Function("limited", [point], [ca.densify(values[kept, 0])])
    return _tracking(tracked, limited, cost, of.nz, given)


def _tracking(tracked: Read, limited: Read, cost: Cost, nr: int, given: SizedLimits) -> Tracking[Read]:
    """Return the record of these maps with the limits, and the weights of `nr` tracked outputs."""
    nu = len(given.inputs.low)
    (Q, R), R_delta = cost.matrices(nr, nu), cost.rate(nu)
    return Tracking(
        tracked,
        limited,
        Q,
        R,
        R_delta,
        given.inputs,
        given.rates,
        given.hard_rates,
        given.rate_softness,
        given.rows.box,
        given.rows.softness,
        with_rates=R_delta is not None or given.rates is not None,
    )


def observed(predictor: LinearPredictor, of: Lifting) -> Float[np.ndarray, "nr nz"]:
    """Return the matrix that reads the observables `of` from z: the predictor's own C for states."""
    wanted = of.bind(predictor.states)
    if isinstance(wanted, State):
        return predictor.C[wanted.chosen]
    return np.eye(predictor.nz)[rows(predictor.lifting, wanted)]


def checked(cost: object, limits: object) -> tuple[Cost, Limits]:
    """Return the cost and the limits, no limits for None.

    Raises
    ------
    DataError
        One is something else, perhaps the other.
    """
    if not isinstance(cost, Cost):
        raise DataError(f"cost is a {type(cost).__name__}; pass a Cost, and the Limits after it")
    if limits is None:
        return cost, Limits()
    if not isinstance(limits, Limits):
        raise DataError(f"limits is a {type(limits).__name__}; pass Limits, or None for none")
    return cost, limits
