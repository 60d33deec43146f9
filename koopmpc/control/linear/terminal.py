"""Terminal: what the state at the end of a horizon costs, by the tail of the tracking problem or by a given Q_N."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.linear.horizon import Horizon, input_target
from koopmpc.control.tail import tail_of, tail_stage
from koopmpc.control.target import Targets
from koopmpc.errors import ShapeError
from koopmpc.lifting.state import State
from koopmpc.predict.predictors import LinearPredictor


class Terminal(NamedTuple):
    """V = ξ_NᵀP ξ_N + 2 ξ_Nᵀ(p f + p_r r_N + p_α α_N + p_u u_N) + const, ξ_N = z_N or [z_N; u_{N−1}].

    f are the horizon's signals, r_N the last reference row, α_N the coordinates of its target and u_N its input target
    where that is given as numbers.
    """

    P: Float[np.ndarray, "nx nx"]
    p: Float[np.ndarray, "nx nf"]
    reference: Float[np.ndarray, "nx nr"]
    target: Float[np.ndarray, "nx na"]
    given: Float[np.ndarray, "nx nu"]


def terminal_of(predictor: LinearPredictor, cost: Cost, horizon: Horizon, targets: Targets) -> Terminal:
    """Return the terminal cost that `cost` asks for.

    The default tail of a model with a fit report or a scale is as long as the horizon. Its small errors grow in many
    tail steps to eigenvalues beyond 1 that rule the plan.

    Raises
    ------
    ShapeError
        Q_N has another size than z or the state, or weighs a state of which there is no reference.
    """
    if cost.Q_N is not None:
        return _given(predictor, cost, horizon, targets)
    h, signals = horizon, horizon.signals
    D = np.hstack([h.E, np.eye(len(h.A), signals.nd)])
    steps = cost.tail
    if steps is None and not (predictor.report is None and predictor.scale is None):
        steps = h.N
    tail = tail_of(tail_stage(h.A, h.B, D, h.C, h.Q, h.R, h.R_delta), steps)
    n, nr = len(tail.P), len(h.C)
    P, p_g = np.zeros((h.size, h.size)), np.zeros((h.size, tail.p.shape[1]))
    P[:n, :n], p_g[:n] = tail.P, tail.p  # u_{N−1} may be there for its limits alone
    of_e, of_r, of_u = np.split(p_g, [D.shape[1], D.shape[1] + nr], axis=1)
    p = of_u @ input_target(h, targets)
    p[:, signals.w(h.N - 1)] += of_e[:, : signals.nw]
    p[:, signals.d] += of_e[:, signals.nw :]
    return Terminal(P, p, of_r, of_u @ targets.W, of_u)


def _given(predictor: LinearPredictor, cost: Cost, h: Horizon, targets: Targets) -> Terminal:
    """Return ‖x_N − r_N‖² or ‖z_N − z_r‖² in the weight Q_N."""
    Q_N = np.asarray(cost.Q_N)
    (nz, nu), nx = h.B.shape, predictor.nx
    own = len(Q_N) if Q_N.ndim else nx
    on_state = own == nx and isinstance(cost.of, State) and cost.of.whole
    if own == nx != nz and not on_state:
        raise ShapeError(f"Q_N ({nx}, {nx}) weighs x_N − r_N, but the reference is not of the state; pass ({nz}, {nz})")
    if own not in (nx, nz):
        raise ShapeError(f"Q_N has shape {Q_N.shape}, expected ({nx}, {nx}) on the state or ({nz}, {nz}) on z")
    weight = checks.weight(Q_N, "Q_N", own)
    P, p = np.zeros((h.size, h.size)), np.zeros((h.size, h.signals.size))
    reference, target = np.zeros((h.size, len(h.C))), np.zeros((h.size, targets.Z.shape[1]))
    given = np.zeros((h.size, nu))
    if on_state:
        P[:nz, :nz] = h.C.T @ weight @ h.C
        reference[:nz] = -h.C.T @ weight
        return Terminal(P, p, reference, target, given)
    z_r = np.zeros((nz, h.signals.size))
    z_r[:, -1] = targets.z0
    moved = h.disturbance(h.N - 1)
    if moved is not None:
        z_r += targets.z_disturbance @ moved
    P[:nz, :nz], p[:nz], target[:nz] = weight, -weight @ z_r, -weight @ targets.Z
    return Terminal(P, p, reference, target, given)
