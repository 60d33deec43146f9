"""What LQR and KoopmanMPC share: a predictor's matrices under a cost and limits, and targets."""

from dataclasses import dataclass
from typing import NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Interval, Limits, Softness
from koopmpc.control.target import Targets, targets
from koopmpc.errors import ShapeError
from koopmpc.estimate.observer import constant_index
from koopmpc.lifting.base import Lifting, rows
from koopmpc.lifting.buffered import HUGE
from koopmpc.lifting.state import State
from koopmpc.predict.predictors import LinearPredictor


@dataclass(frozen=True)
class Tracking:
    """A predictor under a cost and limits: tracked outputs C z, limited outputs G z, weights and targets.

    R_delta and `rates` are None where the change of the inputs is free.
    """

    C: Float[np.ndarray, "nr nz"]
    G: Float[np.ndarray, "ng nz"]
    Q: Float[np.ndarray, "nr nr"]
    R: Float[np.ndarray, "nu nu"]
    R_delta: Float[np.ndarray, "nu nu"] | None
    inputs: Interval
    rates: Interval | None
    rate_softness: Softness
    outputs: Interval
    softness: Softness
    targets: Targets


def tracking(predictor: LinearPredictor, cost: Cost, limits: Limits) -> Tracking:
    """Return the matrices of `cost` and `limits` on the lifted coordinates of `predictor`.

    Raises
    ------
    ObservableError
        The cost or a limit is on an observable that the lifting lacks.
    ShapeError
        A weight or a limit has another size than what it weighs or limits.
    """
    C, nu = observed(predictor, cost.of), predictor.nu
    Q, R = cost.matrices(len(C), nu)
    G = predictor.C
    if limits.of is not None:
        G = np.vstack([G, observed(predictor, limits.of)])
    kept, outputs, softness = limits.rows(predictor.nx, len(G) - predictor.nx)
    G = np.ascontiguousarray(G[kept])
    inputs = limits.inputs(nu)
    hold = cost.u_target == "equilibrium"
    constant = constant_index(predictor)
    found = targets(predictor.A, predictor.B, C, Q, inputs, G, outputs, constant, hold=hold)
    return Tracking(
        C,
        G,
        Q,
        R,
        cost.rate(nu),
        inputs,
        limits.rates(nu),
        limits.rate_softness(nu),
        outputs,
        softness,
        found,
    )


def observed(predictor: LinearPredictor, of: Lifting) -> Float[np.ndarray, "nr nz"]:
    """Return the matrix that reads the observables `of` from z: the predictor's own C for states."""
    wanted = of.bind(predictor.states)
    if isinstance(wanted, State):
        return predictor.C[wanted.chosen]
    return np.eye(predictor.nz)[rows(predictor.lifting, wanted)]


def reference_rows(reference: Float[np.ndarray, "..."], N: int, nr: int) -> Float[np.ndarray, "N1 nr"]:
    """Return N + 1 rows of a reference (nr,) that is held or (M, nr) whose last row is repeated.

    What is beyond 1e30 comes back as NaN: it is no reference, and its square overflows.
    """
    R = checks.array(reference, "reference", finite=False)
    if R.shape[-1:] != (nr,) or R.ndim > 2 or len(R) == 0:
        raise ShapeError(f"reference has shape {R.shape}, expected ({nr},), or rows of {nr} for steps k … k+{N}")
    R = np.where(np.abs(R) < HUGE, R, np.nan).reshape(-1, nr)
    return np.ascontiguousarray(R[np.minimum(np.arange(N + 1), len(R) - 1)])


class Outputs(NamedTuple):
    """Functions of x with their weights and limits: tracked of(x) (nr, Q), limited g(x) (ng, box), and the inputs'.

    softness says what it costs to leave the box, row by row; a linear weight of inf makes a row hard. R_delta and
    `rates` are None where the change of the inputs is free.
    """

    tracked: ca.Function
    limited: ca.Function
    Q: Float[np.ndarray, "nr nr"]
    R: Float[np.ndarray, "nu nu"]
    inputs: Interval
    box: Interval
    softness: Softness
    R_delta: Float[np.ndarray, "nu nu"] | None
    rates: Interval | None
    rate_softness: Softness

    @property
    def with_rates(self) -> bool:
        """Whether the change of the inputs counts."""
        return self.R_delta is not None or self.rates is not None


def outputs(states: tuple[str, ...], nu: int, cost: Cost, limits: Limits, size: int | None = None) -> Outputs:
    """Return what `cost` tracks and `limits` bound, of these states and of `nu` inputs; rows without limit go.

    The functions take `size` values, the states first; by default the states alone.
    """
    nx = len(states)
    point = ca.SX.sym("x", nx if size is None else size)
    x = point[:nx]
    of = cost.of.bind(states)
    Q, R = cost.matrices(of.nz, nu)
    bound = None if limits.of is None else limits.of.bind(states)
    values = x if bound is None else ca.vertcat(x, bound.symbolic(x))
    rows = limits.rows(nx, 0 if bound is None else bound.nz)
    kept = np.flatnonzero(rows.kept).tolist()
    return Outputs(
        ca.Function("tracked", [point], [ca.densify(of.symbolic(x))]),
        ca.Function("limited", [point], [ca.densify(values[kept, 0])]),
        Q,
        R,
        limits.inputs(nu),
        rows.box,
        rows.softness,
        cost.rate(nu),
        limits.rates(nu),
        limits.rate_softness(nu),
    )
