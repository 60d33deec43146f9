"""Condense: the whole horizon as matrices of the lifted state and the reference; builds, and never solves.

In Riccati coordinates, u_k = −K_k z_k + v_k + √unit L_k⁻ᵀ w_k with S_k = R + BᵀP_{k+1}B = L_k L_kᵀ, the cost is
constant + unit · Σ ‖w_k‖²: w = 0 is the unconstrained optimum, and the Hessian is the identity even where the plant is
unstable and plain condensing (u as the variable) has lost all its digits.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from jaxtyping import Float

from koopmpc.control.riccati import Stages
from koopmpc.control.target import Targets


@dataclass(frozen=True)
class Stage:
    """What the horizon is made of: z⁺ = A z + B u, tracked outputs C z, limited outputs G z, the weights."""

    A: Float[np.ndarray, "nz nz"]
    B: Float[np.ndarray, "nz nu"]
    C: Float[np.ndarray, "nr nz"]
    G: Float[np.ndarray, "ng nz"]
    Q: Float[np.ndarray, "nr nr"]
    R: Float[np.ndarray, "nu nu"]
    P_N: Float[np.ndarray, "nz nz"]
    CQ_N: Float[np.ndarray, "nz nr"] | None = (
        None  # Cᵀ Q_N of a weight on x_N − r_N; None: P_N weighs z_N − z_r
    )


@dataclass(frozen=True)
class Condensed:
    """The plan and its limited outputs, v = [u_0 … u_{N−1}, G z_1 … G z_N], as v = F_z z₀ + F_r r + F_α α + f + D w.

    r holds the N + 1 reference rows one after the other, α the targets' coordinates of the same rows. Above the
    unconstrained optimum the cost is unit · ‖w‖², unit the mean diagonal of S_0: w has the size of u, and a cost
    in other units gives the same QP.
    """

    from_state: Float[np.ndarray, "n nz"]
    from_reference: Float[np.ndarray, "n nR"]
    from_target: Float[np.ndarray, "n nT"]
    offset: Float[np.ndarray, " n"]
    deviation: Float[np.ndarray, "n nw"]
    unit: float


def condense(stage: Stage, stages: Stages, targets: Targets) -> Condensed:
    """Return the maps of a horizon of N = len(stages.K) steps."""
    A, B, G = stage.A, stage.B, stage.G
    N, nu, nz = stages.K.shape
    nr, na, ng = stage.C.shape[0], targets.Z.shape[1], len(G)
    nR, nT = (N + 1) * nr, (N + 1) * na
    feedforward = _feedforward(stage, stages, targets)

    n = N * nu
    unit = float((stages.L[0] ** 2).sum()) / nu
    state = np.empty((n + N * ng, nz))
    driven = np.empty((n + N * ng, nR + nT + 1))
    deviation = np.zeros((n + N * ng, n))
    Z, D = np.eye(nz), np.zeros((nz, n))
    F = np.zeros((nz, nR + nT + 1))
    for k in range(N):
        rows, outputs = slice(k * nu, (k + 1) * nu), slice(n + k * ng, n + (k + 1) * ng)
        K = stages.K[k]
        state[rows], driven[rows], deviation[rows] = -K @ Z, feedforward[k] - K @ F, -K @ D
        one = np.sqrt(unit) * np.eye(nu)
        deviation[rows, rows] += scipy.linalg.solve_triangular(stages.L[k], one, lower=True, trans="T")
        Z, F, D = A @ Z + B @ state[rows], A @ F + B @ driven[rows], A @ D + B @ deviation[rows]
        state[outputs], driven[outputs], deviation[outputs] = G @ Z, G @ F, G @ D
    return Condensed(state, driven[:, :nR], driven[:, nR : nR + nT], driven[:, -1], deviation, unit)


def _feedforward(stage: Stage, stages: Stages, targets: Targets) -> Float[np.ndarray, "N nu nf"]:
    """Return v_k = −S_k⁻¹(Bᵀp_{k+1} − R u_r) as matrices on [r, α, 1].

    p_k = −CᵀQ r_k + (A − BK_k)ᵀp_{k+1} + K_kᵀR u_r, from p_N = −P_N z_r, or −CᵀQ_N r_N.
    """
    A, B, R = stage.A, stage.B, stage.R
    N, nu, nz = stages.K.shape
    nr, na = stage.C.shape[0], targets.Z.shape[1]
    nR = (N + 1) * nr
    nf = nR + (N + 1) * na + 1
    p = np.zeros((nz, nf))
    if stage.CQ_N is not None:
        p[:, N * nr : nR] = -stage.CQ_N
    else:
        p[:, nR + N * na : -1] = -stage.P_N @ targets.Z
        p[:, -1] = -stage.P_N @ targets.z0
    CQ = stage.C.T @ stage.Q
    result = np.empty((N, nu, nf))
    for k in range(N - 1, -1, -1):
        Ru = np.zeros((nu, nf))
        Ru[:, nR + k * na : nR + (k + 1) * na] = R @ targets.W
        Ru[:, -1] = R @ targets.u0
        K = stages.K[k]
        result[k] = -scipy.linalg.cho_solve((stages.L[k], True), B.T @ p - Ru)
        p = (A - B @ K).T @ p + K.T @ Ru
        p[:, k * nr : (k + 1) * nr] -= CQ
    return result
