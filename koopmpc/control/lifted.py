"""What LQR and KoopmanMPC share: a predictor's matrices under a cost and limits, and targets."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Box, Limits, Softness
from koopmpc.control.target import Targets, targets
from koopmpc.errors import ShapeError
from koopmpc.estimate.observer import constant_index
from koopmpc.lifting.base import Lifting, rows
from koopmpc.lifting.buffered import HUGE
from koopmpc.lifting.state import State
from koopmpc.predict.linear import LinearPredictor


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
    inputs: Box
    rates: Box | None
    rate_softness: Softness
    outputs: Box
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
        raise ShapeError(
            f"reference has shape {R.shape}, expected ({nr},), or rows of {nr} for steps k … k+{N}"
        )
    R = np.where(np.abs(R) < HUGE, R, np.nan).reshape(-1, nr)
    return np.ascontiguousarray(R[np.minimum(np.arange(N + 1), len(R) - 1)])
