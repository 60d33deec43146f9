"""The Riccati difference equation until its gain rests: the terminal weight of a horizon.

The weight of any pair (A, B), with modes that no input moves too, where the algebraic equation has no solution.
"""

import numpy as np
from jaxtyping import Float
from scipy.linalg.lapack import dgesv

from koopmpc.control.riccati import Gain, gain, solved, step
from koopmpc.errors import DefinitenessError

SETTLED = 1e-9  # the gain of the difference equation has settled when it moves by less, relative to its size
RESTS = 50  # steps for which it must have settled, at most
LARGEST = 1e12  # growth of P over Q at which an unstable uncontrollable mode has taken over
LEAPT = 100.0  # growth of the closed loop over the first steps up to which doubling keeps its digits


def stationary(
    A: Float[np.ndarray, "nz nz"],
    B: Float[np.ndarray, "nz nu"],
    Q: Float[np.ndarray, "nz nz"],
    R: Float[np.ndarray, "nu nu"],
    most: int,
    M: Float[np.ndarray, "nz nu"] | None = None,
) -> Gain:
    """Iterate P ← Q + AᵀPA − KᵀSK from P = Q until K rests, at most `most` steps; the stage cost may hold 2xᵀMu.

    K rests when it moves by less than 1e-9 of its size, for as many steps as z has entries (50 are enough): a
    weight may take that long to reach an input. The steps before that are taken by doubling, as far as it is safe.
    Never refused: a Constant, or any other mode that u cannot move, only makes its own entries of P grow, which
    z − z_r does not see. Where P has grown by 1e12, an unstable mode that u cannot move has taken over; the iteration
    then runs on the controllable part alone.
    """
    try:
        start, taken = _leap(A, B, Q, R, M, most)
        found, bounded = _iterate(A, B, Q, R, M, start, most - taken)
        if bounded:
            return found
    except DefinitenessError:  # R + BᵀQB is not positive definite, or P has lost its digits
        pass
    found, bounded = _iterate(A, B, Q, R, M, Q, most)
    if not bounded:
        V = _controllable(A, B)
        found, _ = _iterate(A @ V @ V.T, B, Q, R, M, Q, most)
    return found


def _iterate(
    A: Float[np.ndarray, "nz nz"],
    B: Float[np.ndarray, "nz nu"],
    Q: Float[np.ndarray, "nz nz"],
    R: Float[np.ndarray, "nu nu"],
    M: Float[np.ndarray, "nz nu"] | None,
    P: Float[np.ndarray, "nz nz"],
    most: int,
) -> tuple[Gain, bool]:
    """Return the last gain of the iteration from P, and whether P stayed below `LARGEST`."""
    K = np.zeros((B.shape[1], A.shape[0]))
    scale = max(float(np.abs(Q).max(initial=0.0)), float(np.abs(R).max(initial=0.0)))
    rested = 0
    for _ in range(most):
        K_next, _, P_next = step(A, B, Q, R, P, M)
        if not P_next.max() <= LARGEST * scale:  # P ⪰ 0: its largest entry is on its diagonal; False for NaN
            return Gain(K, P), False
        moved = abs(K_next - K).max()
        P, K = P_next, K_next
        rested = rested + 1 if moved <= SETTLED * abs(K).max() else 0
        if rested >= min(len(A), RESTS):
            break
    return Gain(K, P), True


def _leap(
    A: Float[np.ndarray, "nz nz"],
    B: Float[np.ndarray, "nz nu"],
    Q: Float[np.ndarray, "nz nz"],
    R: Float[np.ndarray, "nu nu"],
    M: Float[np.ndarray, "nz nu"] | None,
    most: int,
) -> tuple[Float[np.ndarray, "nz nz"], int]:
    """Return P after so many steps of the difference equation, a power of two below `most`, by doubling.

    P = Q + H after n steps, and after 2n with

        H + ΦᵀH(I + GH)⁻¹Φ,   G + Φ(I + GH)⁻¹GΦᵀ,   Φ(I + GH)⁻¹Φ,

    from H = P_1 − Q, G = BS⁻¹Bᵀ, Φ = A − BK of the first step: R itself may be singular. It ends where K rests, or
    before Φ, the closed loop of n steps, is so large that rounding would show.

    Chu, Fan, Lin & Wang, "Structure-preserving algorithms for periodic discrete-time algebraic Riccati equations",
    Int. J. Control 77, 2004.
    """
    K, L, P = step(A, B, Q, R, Q, M)
    H, G, Phi, taken = P - Q, B @ solved(L, B.T), A - B @ K, 1
    nz, one = len(A), np.eye(len(A))
    large = LEAPT * max(1.0, float(abs(Phi).max()))
    while 2 * taken < most:
        _, _, both, info = dgesv(one + G @ H, np.hstack([Phi, G]))
        new = Phi.T @ (H @ both[:, :nz])
        new = 0.5 * (new + new.T)
        G_new = Phi @ both[:, nz:] @ Phi.T
        Phi = Phi @ both[:, :nz]
        if info or not abs(Phi).max() <= large:
            break
        H, G, taken = H + new, G + 0.5 * (G_new + G_new.T), 2 * taken
        K_last, K = K, gain(A, B, R, Q + H, M)[0]
        if abs(K - K_last).max() <= SETTLED * abs(K).max():
            break
    return Q + H, taken


def _controllable(A: Float[np.ndarray, "nz nz"], B: Float[np.ndarray, "nz nu"]) -> Float[np.ndarray, "nz nc"]:
    """Return an orthonormal basis of the controllable subspace, the span of [B, AB, A²B, …]."""
    V = np.empty((len(A), 0))
    new, least = B, SETTLED * float(np.linalg.norm(B, 2))
    while new.shape[1] and V.shape[1] < len(A):
        for _ in range(2):  # twice is enough for orthogonality to rounding
            new = new - V @ (V.T @ new)
        left, sigma, _ = np.linalg.svd(new, full_matrices=False)
        left = left[:, sigma > least]
        V = np.hstack([V, left])
        new, least = A @ left, SETTLED * float(np.linalg.norm(A, 2))
    return V
