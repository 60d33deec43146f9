"""What a controller tracks and limits, with its weights: matrices of a lifted model, or functions of a state."""

from dataclasses import dataclass
from typing import Generic, TypeAlias, TypeVar

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.control.cost import Cost
from koopmpc.control.limits import Interval, LimitRows, Limits, Softness
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
    `rates` are None where the change of the inputs is free.
    """

    tracked: Read
    limited: Read
    Q: Float[np.ndarray, "nr nr"]
    R: Float[np.ndarray, "nu nu"]
    R_delta: Float[np.ndarray, "nu nu"] | None
    inputs: Interval
    rates: Interval | None
    rate_softness: Softness
    outputs: Interval
    softness: Softness

    @property
    def with_rates(self) -> bool:
        """Whether the change of the inputs counts."""
        return self.R_delta is not None or self.rates is not None

    @property
    def hard_rates(self) -> Interval | None:
        """The rate limits that are hard, with ±inf in place of the others; None where none is."""
        hard = np.isinf(self.rate_softness.linear)
        if self.rates is None or not hard.any():
            return None
        return Interval(np.where(hard, self.rates.low, -np.inf), np.where(hard, self.rates.high, np.inf))


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
    given = limits.rows(nx, len(G) - nx)
    return _tracking(C, np.ascontiguousarray(G[given.kept]), cost, limits, given, len(C), predictor.nu)


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
    given = limits.rows(nx, 0 if bound is None else bound.nz)
    kept = np.flatnonzero(given.kept).tolist()
    tracked = ca.Function("tracked", [point], [ca.densify(of.symbolic(x))])
    limited = ca.Function("limited", [point], [ca.densify(values[kept, 0])])
    return _tracking(tracked, limited, cost, limits, given, of.nz, nu)


def _tracking(
    tracked: Read, limited: Read, cost: Cost, limits: Limits, given: LimitRows, nr: int, nu: int
) -> Tracking[Read]:
    """Return the record of these maps with the weights and limits in the sizes that they have here."""
    Q, R = cost.matrices(nr, nu)
    return Tracking(
        tracked,
        limited,
        Q,
        R,
        cost.rate(nu),
        limits.inputs(nu),
        limits.rates(nu),
        limits.rate_softness(nu),
        given.box,
        given.softness,
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
