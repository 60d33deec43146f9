"""Riccati: the gains of `lqr` and `dlqr`, and the recursion over a finite horizon."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float
from numpy.typing import ArrayLike
from scipy.linalg.lapack import dpotrf, dpotrs

from koopmpc import checks
from koopmpc.errors import DataError, DefinitenessError

DIGITS, LOST = 1e-9, 1e-6  # what a step may lose of P; by how much of its size P may be indefinite


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
    """u_k = −K_k x_k + v_k f for k = 0 … N−1, and S_k = R + BᵀP_{k+1}B = L_k L_kᵀ.

    From x_0 on it costs x_0ᵀP x_0 + 2x_0ᵀp f + what f alone decides.
    """

    K: Float[np.ndarray, "N nu nx"]
    L: Float[np.ndarray, "N nu nu"]
    v: Float[np.ndarray, "N nu nf"]
    P: Float[np.ndarray, "nx nx"]
    p: Float[np.ndarray, "nx nf"]


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


def recursion(stages: Sequence[Stage], P_N: Float[np.ndarray, "nx nx"], p_N: Float[np.ndarray, "nx nf"]) -> Law:
    """Return the law that minimises the cost of all stages and xᵀP_N x + 2xᵀp_N f at their end.

    K = S⁻¹(BᵀPA + Mᵀ), v = −S⁻¹g, g = Bᵀ(p + P e) + r; P ← Q + AᵀPA − KᵀSK, p ← q + Aᵀ(p + P e) − Kᵀg.

    A step loses eps ‖A‖² of the digits of P, in balanced units. Where this is more than 1e-9, as with models whose
    observables are almost dependent, or where P has lost its definiteness, the same law is found by `rooted`, which
    loses eps ‖A‖ and takes ten times as long.

    Raises
    ------
    DefinitenessError
        R + BᵀPB is not positive definite at some stage, in exact arithmetic.
    """
    if np.finfo(float).eps * max(map(_growth, {id(stage.A): stage.A for stage in stages}.values())) ** 2 < DIGITS:
        try:
            law = _plain(stages, P_N, p_N)
        except DefinitenessError:
            return rooted(stages, P_N, p_N)
        if _semidefinite(law.P):
            return law
    return rooted(stages, P_N, p_N)


def _growth(A: Float[np.ndarray, "nx nx"]) -> float:
    """Return ‖A‖ in units that make its rows and columns alike."""
    return float(np.linalg.norm(np.asarray(scipy.linalg.matrix_balance(A, permute=False)[0])))


def _plain(stages: Sequence[Stage], P_N: Float[np.ndarray, "nx nx"], p_N: Float[np.ndarray, "nx nf"]) -> Law:
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
    return Law(K, L, v, P, p)


def _semidefinite(P: Float[np.ndarray, "nx nx"]) -> bool:
    """Return whether P ⪰ 0 up to rounding, on a diagonal of ones, so that units mean nothing."""
    if not np.isfinite(P).all() or (P.diagonal() < 0).any():
        return False
    size = np.sqrt(np.where(P.diagonal() > 0, P.diagonal(), 1.0))
    return bool(np.linalg.eigvalsh(P / np.outer(size, size)).min(initial=0.0) > -LOST)


def rooted(stages: Sequence[Stage], P_N: Float[np.ndarray, "nx nx"], p_N: Float[np.ndarray, "nx nf"]) -> Law:
    """Return the law of `recursion` by orthogonal transformations of a root F of P = FᵀF, which is ⪰ 0 by construction.

    With a root [W_u W_x] of the stage cost, the triangular factor of [W_u W_x; F B  F A] is [Lᵀ LᵀK; 0 F] of the stage
    before. It is the same to rounding whatever the units of x and u are.

    Raises
    ------
    DefinitenessError
        R + BᵀPB is not positive definite at some stage.

    References
    ----------
    Kailath, Sayed & Hassibi, "Linear Estimation", 2000, chapter 12: array algorithms.
    """
    nx, nu = stages[0].B.shape
    N = len(stages)
    K, L, v = np.empty((N, nu, nx)), np.empty((N, nu, nu)), np.empty((N, nu, p_N.shape[1]))
    F, p = _root(P_N), p_N
    costs = {id(stage): _root(_joint(stage)) for stage in stages}
    for k in range(N - 1, -1, -1):
        A, B, _, _, _, e, q, r = stages[k]
        rows = np.vstack([costs[id(stages[k])], np.hstack([F @ B, F @ A])])
        size = np.sqrt(np.einsum("ij,ij->j", rows, rows))
        size[size == 0] = 1.0
        T = np.asarray(np.linalg.qr(rows / size, mode="r"))
        if (np.abs(T.diagonal()[:nu]) <= nx * np.finfo(float).eps).any():
            raise DefinitenessError(
                "R + BᵀPB is not positive definite: some change of the inputs costs nothing; raise R, or weight a state"
                " that every input moves"
            )
        T = np.where(T.diagonal() < 0, -1.0, 1.0)[:, None] * T * size
        upper = T[:nu, :nu]
        K[k], L[k] = scipy.linalg.solve_triangular(upper, T[:nu, nu:]), upper.T
        p = p if e is None else p + F.T @ (F @ e)
        g = B.T @ p if r is None else B.T @ p + r
        v[k] = -solved(np.asfortranarray(L[k]), g)
        p = (A - B @ K[k]).T @ p if r is None else (A - B @ K[k]).T @ p - K[k].T @ r
        p = p if q is None else p + q
        F = T[nu:, nu:]
    return Law(K, L, v, F.T @ F, p)


def _joint(stage: Stage) -> Float[np.ndarray, "n n"]:
    """Return the weight of [u; x] in a stage."""
    M = np.zeros(stage.B.shape) if stage.M is None else stage.M
    return np.block([[stage.R, M.T], [M, stage.Q]])


def _root(P: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return F with FᵀF = P ⪰ 0, by the eigenvalues of P on a diagonal of ones; those below 0 are rounding."""
    size = np.sqrt(np.maximum(P.diagonal(), 0.0))
    live = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(P / np.outer(live, live))
    return np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * size


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
