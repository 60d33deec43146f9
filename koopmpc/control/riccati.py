"""Riccati: the infinite-horizon gains, and the finite-horizon recursion."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.linalg import block_diag
from scipy.linalg.lapack import dgesv, dpotrf, dpotrs

from koopmpc import checks
from koopmpc.errors import DataError, DefinitenessError


class Gain(NamedTuple):
    """The feedback u = −K x and the P of its value xᵀP x."""

    K: Float[np.ndarray, "nu nx"]
    P: Float[np.ndarray, "nx nx"]


class Stage(NamedTuple):
    """x⁺ = A x + B u + e f at the cost xᵀQx + 2xᵀMu + uᵀRu + 2xᵀq f + 2uᵀr f, f being known; None stands for zero."""

    A: Float[np.ndarray, "nx nx"]
    B: Float[np.ndarray, "nx nu"]
    Q: Float[np.ndarray, "nx nx"]
    M: Float[np.ndarray, "nx nu"] | None
    R: Float[np.ndarray, "nu nu"]
    e: Float[np.ndarray, "nx nf"] | None = None
    q: Float[np.ndarray, "nx nf"] | None = None
    r: Float[np.ndarray, "nu nf"] | None = None


class Law(NamedTuple):
    """u_k = −K_k x_k + v_k f for k = 0 … N−1, and S_k = R + BᵀP_{k+1}B = L_k L_kᵀ."""

    K: Float[np.ndarray, "N nu nx"]
    L: Float[np.ndarray, "N nu nu"]
    v: Float[np.ndarray, "N nu nf"]


def lqr(A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike) -> Gain:
    """Minimise ∫ xᵀQx + uᵀRu dt for ẋ = A x + B u: K = R⁻¹BᵀP, AᵀP + PA − PBR⁻¹BᵀP + Q = 0.

    Parameters
    ----------
    A, B
        (nx, nx), (nx, nu).
    Q, R
        Weights, Q ⪰ 0, R ≻ 0; a scalar or a vector is a diagonal.

    Raises
    ------
    DefinitenessError
        R is not positive definite, or Q is indefinite.
    DataError
        No stabilising solution: (A, B) is not stabilisable, or an imaginary mode is not seen by Q.
    """
    A, B, Q, R = _pair(A, B, Q, R, definite=True)
    try:
        P = scipy.linalg.solve_continuous_are(A, B, Q, R)
    except np.linalg.LinAlgError as error:
        raise DataError(_UNSTABILISABLE) from error
    K = np.linalg.solve(R, B.T @ P)
    _require(float(np.linalg.eigvals(A - B @ K).real.max()) < 0)
    return Gain(K, P)


def dlqr(A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike) -> Gain:
    """Minimise Σ xᵀQx + uᵀRu for x⁺ = A x + B u: K = (R + BᵀPB)⁻¹BᵀPA, P = Q + AᵀP(A − BK).

    Parameters and errors as in `lqr`. With a Constant observable there is no such solution; `LQR` iterates instead.
    """
    A, B, Q, R = _pair(A, B, Q, R, definite=True)
    try:
        P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    except np.linalg.LinAlgError as error:
        raise DataError(_UNSTABILISABLE) from error
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    _require(float(np.abs(np.linalg.eigvals(A - B @ K)).max()) < 1)
    return Gain(K, P)


def one_step(
    A: Float[np.ndarray, "nz nz"],
    B: Float[np.ndarray, "nz nu"],
    Q: Float[np.ndarray, "nz nz"],
    R: Float[np.ndarray, "nu nu"],
    R_delta: Float[np.ndarray, "nu nu"] | None,
) -> Stage:
    """Return one step with the cost ‖z‖²_Q + ‖u‖²_R, on [z; u_{k−1}] with ‖u − u_{k−1}‖²_{R_delta} where given."""
    nz, nu = B.shape
    if R_delta is None:
        return Stage(A, B, Q, None, R)
    M = np.vstack([np.zeros((nz, nu)), -R_delta])
    return Stage(block_diag(A, np.zeros((nu, nu))), np.vstack([B, np.eye(nu)]), block_diag(Q, R_delta), M, R + R_delta)


def recursion(stages: Sequence[Stage], P_N: Float[np.ndarray, "nx nx"], p_N: Float[np.ndarray, "nx nf"]) -> Law:
    """Return the law that minimises the cost of all stages and xᵀP_N x + 2xᵀp_N f at their end.

    K = S⁻¹(BᵀPA + Mᵀ), v = −S⁻¹g, g = Bᵀ(p + P e) + r; P ← Q + AᵀPA − KᵀSK, p ← q + Aᵀ(p + P e) − Kᵀg.

    Raises
    ------
    DefinitenessError
        R + BᵀPB is not positive definite at some stage.
    """
    nx, nu = stages[0].B.shape
    N = len(stages)
    K, L, v = np.empty((N, nu, nx)), np.empty((N, nu, nu)), np.empty((N, nu, p_N.shape[1]))
    P, p = P_N, p_N
    for k in range(N - 1, -1, -1):
        A, B, Q, M, R, e, q, r = stages[k]
        p = p if e is None else p + P @ e
        K[k], L[k], P = step(A, B, Q, R, P, M)
        g = B.T @ p if r is None else B.T @ p + r
        v[k] = -solved(L[k], g)
        p = A.T @ p - K[k].T @ g if q is None else q + A.T @ p - K[k].T @ g
    return Law(K, L, v)


def step(
    A: Float[np.ndarray, "nz nz"],
    B: Float[np.ndarray, "nz nu"],
    Q: Float[np.ndarray, "nz nz"],
    R: Float[np.ndarray, "nu nu"],
    P: Float[np.ndarray, "nz nz"],
    M: Float[np.ndarray, "nz nu"] | None,
) -> tuple[Float[np.ndarray, "nu nz"], Float[np.ndarray, "nu nu"], Float[np.ndarray, "nz nz"]]:
    """Return K, L and P of the stage before: P ← Q + AᵀPA − KᵀSK."""
    K, L = gain(A, B, R, P, M)
    P = Q + A.T @ (P @ (A - B @ K))
    if M is not None:
        P = P - M @ K
    return K, L, 0.5 * (P + P.T)


def gain(
    A: Float[np.ndarray, "nz nz"],
    B: Float[np.ndarray, "nz nu"],
    R: Float[np.ndarray, "nu nu"],
    P: Float[np.ndarray, "nz nz"],
    M: Float[np.ndarray, "nz nu"] | None,
) -> tuple[Float[np.ndarray, "nu nz"], Float[np.ndarray, "nu nu"]]:
    """Return K = S⁻¹(BᵀPA + Mᵀ) and the L of S = R + BᵀPB = L Lᵀ."""
    BP = B.T @ P
    S = R + BP @ B
    L, info = dpotrf(S, lower=1)
    if info:
        least = float(np.linalg.eigvalsh(0.5 * (S + S.T)).min())
        raise DefinitenessError(
            f"R + BᵀPB is not positive definite: its least eigenvalue is {least:.3g}; raise R, or weight a state"
            " that every input moves"
        )
    return solved(L, BP @ A if M is None else BP @ A + M.T), L


def solved(L: Float[np.ndarray, "nu nu"], right: Float[np.ndarray, "nu n"]) -> Float[np.ndarray, "nu n"]:
    """Return S⁻¹ right for S = L Lᵀ; LAPACK itself, for SciPy's own checks take ten times as long."""
    return np.ascontiguousarray(dpotrs(L, right, lower=1)[0])


_UNSTABILISABLE = (
    "the Riccati equation has no stabilising solution: (A, B) is not stabilisable, or Q does not see a mode on the"
    " stability boundary; check the pair, or use LQR and KoopmanMPC, which iterate the difference equation"
)


def _require(stable: bool) -> None:
    if not stable:
        raise DataError(_UNSTABILISABLE)


def _pair(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, *, definite: bool
) -> tuple[
    Float[np.ndarray, "nx nx"],
    Float[np.ndarray, "nx nu"],
    Float[np.ndarray, "nx nx"],
    Float[np.ndarray, "nu nu"],
]:
    A = checks.array(A, "A", (None, None))
    A = checks.array(A, "A", (len(A), len(A)))
    B = checks.array(B, "B", (len(A), None))
    return A, B, checks.weight(Q, "Q", len(A)), checks.weight(R, "R", B.shape[1], definite=definite)


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
    A Constant, or any other mode that u cannot move, only makes its own entries of P grow. Where P has grown by 1e12,
    such a mode is unstable and has taken over; the iteration then runs on the controllable part alone.
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
