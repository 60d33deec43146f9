"""The program of the stages in condensed form, for an active-set method that ends where interior points do not.

With δx = δx_free + x̃ and δu_k = δu_free,k − K_k x̃_k + L_k⁻ᵀ w_k, S_k = R + BᵀP_{k+1}B = L_k L_kᵀ, the cost is that of
the program without limits and ½ ‖w‖², so that the Hessian is the identity also where the plant is unstable.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from koopmpc.control.limits import Interval, Softness
from koopmpc.control.move import Status
from koopmpc.control.solvers.daqp import DAQP
from koopmpc.control.solvers.qp import QP


class Stages(NamedTuple):
    """What the program consists of: x̃_{k+1} = A_k x̃_k + B_k ũ_k from x̃_0 = 0, weights, and G of the limited outputs.

    CasADi writes matrices by columns, so that A[k], B[k] and G[k] are the transposed ones.
    """

    A: Float[np.ndarray, "N nx nx"]
    B: Float[np.ndarray, "N nu nx"]
    Q: Float[np.ndarray, "N nx nx"]
    R: Float[np.ndarray, "nu nu"]
    G: Float[np.ndarray, "N nx ng"]
    free: Bool[np.ndarray, " N"]


class Deviation(NamedTuple):
    """What is added to the solution without limits, δX and δU; multipliers of the rows, and how DAQP ended."""

    X: Float[np.ndarray, "N nx"]
    U: Float[np.ndarray, "N nu"]
    multipliers: Float[np.ndarray, " m"]
    status: Status
    iterations: int


def least_deviation(
    stages: Stages,
    room: Interval,
    softness: Softness,
    multipliers: Float[np.ndarray, " m"] | None,
    seconds: float,
) -> Deviation | None:
    """Return the least deviation within `room`, the limits of [ũ_k; G_k x̃_{k+1}] of each stage (N, nu + ng).

    A row costs linear ε + quadratic ε² where it gives way by ε. DAQP starts from the rows that
    these multipliers push to, and has so many seconds. Returns None where the recursion has no digits left.
    """
    A, B, Q, R, G, free = stages
    N, nu, nx = len(B), B.shape[1], B.shape[2]
    K, spread = np.zeros((N, nu, nx)), np.zeros((N, nu, nu))
    P = np.zeros((nx, nx))
    for k in reversed(range(N)):
        whole, to = P + Q[k], A[k].T
        PA = whole @ to
        P = to.T @ PA
        if free[k]:
            BP = B[k] @ whole
            S = R + BP @ B[k].T
            try:
                L = np.asarray(np.linalg.cholesky(0.5 * (S + S.T)), dtype=np.float64)
            except np.linalg.LinAlgError:
                return None
            spread[k] = np.linalg.inv(L).T
            K[k] = spread[k] @ (spread[k].T @ (B[k] @ PA))
            P -= (B[k] @ PA).T @ K[k]
        P = 0.5 * (P + P.T)
    at = np.cumsum(free) - free
    n = nu * np.count_nonzero(free)
    X, U = np.zeros((N + 1, nx, n)), np.zeros((N, nu, n))
    for k in range(N):
        if free[k]:
            U[k] = -K[k] @ X[k]
            U[k][:, nu * at[k] : nu * at[k] + nu] += spread[k]
        X[k + 1] = A[k].T @ X[k] + B[k].T @ U[k]
    rows = np.concatenate([U, G.transpose(0, 2, 1) @ X[1:]], axis=1)
    low, high = room
    kept = np.isfinite(low) | np.isfinite(high)
    kept[~free, :nu] = False
    if not np.isfinite(rows).all():
        return None
    linear, quadratic, allowance = (np.tile(part, (N, 1))[kept] for part in softness)
    none = np.zeros((n,))
    qp = QP(np.eye(n), none, rows[kept], low[kept], high[kept], Softness(linear, quadratic, allowance))
    y = np.zeros(len(linear)) if multipliers is None else multipliers
    found = DAQP(qp).solve(none, y, seconds if np.isfinite(seconds) else None)
    status = found.status
    if status is Status.FAILED and _contradictory(qp):
        status = Status.INFEASIBLE
    return Deviation(X[1:] @ found.v, U @ found.v, found.y, status, found.iterations)


def _contradictory(qp: QP) -> bool:
    """Return whether the hard rows have no point in common, by a linear program: DAQP may go in circles there.

    The least t with low − t ≤ A v ≤ high + t, rows of unit length, is then above what rounding makes of zero.
    """
    from scipy.optimize import linprog

    norms = np.linalg.norm(qp.A, axis=1)
    hard = np.isinf(qp.softness.linear) if qp.softness is not None else np.ones_like(norms, dtype=np.bool_)
    rows, sizes = qp.A[hard], np.maximum(norms[hard], 1e-300)
    ends = np.concatenate([qp.high[hard] / sizes, -qp.low[hard] / sizes])
    kept = np.isfinite(ends)
    sides = np.vstack([rows / sizes[:, None], -rows / sizes[:, None]])[kept]
    wanted = np.append(np.zeros(rows.shape[1]), 1.0)
    free: list[tuple[float | None, float | None]] = [(None, None)] * rows.shape[1]
    found = linprog(wanted, np.hstack([sides, -np.ones((len(sides), 1))]), ends[kept], bounds=[*free, (0.0, None)])
    return bool(found.fun is not None and found.fun > 1e-7 * (1 + np.abs(ends[kept]).max(initial=0.0)))
