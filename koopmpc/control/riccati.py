"""Riccati: the recursion over a finite horizon, and the difference equation until its gain rests."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Float
from scipy.linalg import block_diag, solve_triangular
from scipy.linalg.lapack import dgesv, dpotrf, dpotrs

from koopmpc.base.checks import root
from koopmpc.base.errors import DataError, DefinitenessError

DIGITS = 1e-9  # use the root of P if a step may lose more than this share of P
LOST = 1e-6  # use the root of P if P is indefinite by more than this share of its size
SETTLED = 1e-9  # the gain of the difference equation has settled when it moves by less, relative to its size
RESTS = 50  # steps for which it must have settled, at most
LARGEST = 1e12  # growth of P over Q at which an unstable uncontrollable mode has taken over
MANY = 100  # coordinates from which on a recursion of gains alone keeps what a step adds to P
LEAPT = 100.0  # growth of the closed loop over the first steps up to which doubling keeps its digits


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


def one_step(
    A: Float[np.ndarray, "nz nz"],
    B: Float[np.ndarray, "nz nu"],
    Q: Float[np.ndarray, "nz nz"],
    R: Float[np.ndarray, "nu nu"],
    R_delta: Float[np.ndarray, "nu nu"] | None = None,
) -> Stage:
    """Return one step with the cost ‖z‖²_Q + ‖u‖²_R, on [z; u_{k−1}] with ‖u − u_{k−1}‖²_{R_delta} where given."""
    nz, nu = B.shape
    if R_delta is None:
        return Stage(A, B, Q, None, R)
    M = np.vstack([np.zeros((nz, nu)), -R_delta])
    return Stage(block_diag(A, np.zeros((nu, nu))), np.vstack([B, np.eye(nu)]), block_diag(Q, R_delta), M, R + R_delta)


class Law(NamedTuple):
    """u_k = −K_k x_k + v_k f for k = 0 … N−1, and S_k = R + BᵀP_{k+1}B = L_k L_kᵀ.

    From x_0 on it costs x_0ᵀP x_0 + 2x_0ᵀp f + what f alone decides.
    """

    K: Float[np.ndarray, "N nu nx"]
    L: Float[np.ndarray, "N nu nu"]
    v: Float[np.ndarray, "N nu nf"]
    P: Float[np.ndarray, "nx nx"]
    p: Float[np.ndarray, "nx nf"]


def recursion(stages: Sequence[Stage], P_N: Float[np.ndarray, "nx nx"], p_N: Float[np.ndarray, "nx nf"]) -> Law:
    """Return the law that minimises the cost of all stages and xᵀP_N x + 2xᵀp_N f at their end.

    K = S⁻¹(BᵀPA + Mᵀ), v = −S⁻¹g, g = Bᵀ(p + P e) + r; P ← Q + AᵀPA − KᵀSK, p ← q + Aᵀ(p + P e) − Kᵀg.

    A step loses eps ‖A‖² of the digits of P, in balanced units. If this is more than 1e-9, as with models whose
    observables are almost dependent, or if P has lost its definiteness, the same recursion goes backwards on a root F
    of P = FᵀF (`step_root`): it loses eps ‖A‖ and takes ten times as long.
    """
    if np.finfo(float).eps * max(map(_growth, {id(stage.A): stage.A for stage in stages}.values())) ** 2 < DIGITS:
        try:
            law = sweep_backwards(stages, P_N, p_N, rooted=False)
        except DefinitenessError:
            return sweep_backwards(stages, P_N, p_N, rooted=True)
        if _semidefinite(law.P):
            return law
    return sweep_backwards(stages, P_N, p_N, rooted=True)


def _growth(A: Float[np.ndarray, "nx nx"]) -> float:
    """Return ‖A‖ in units that make its rows and columns alike."""
    return float(np.linalg.norm(np.asarray(scipy.linalg.matrix_balance(A, permute=False)[0])))


@np.errstate(over="ignore", invalid="ignore")
def sweep_backwards(
    stages: Sequence[Stage], P_N: Float[np.ndarray, "nx nx"], p_N: Float[np.ndarray, "nx nf"], *, rooted: bool
) -> Law:
    """Return the law by one sweep backwards, on P or on its root."""
    nx, nu = stages[0].B.shape
    N = len(stages)
    K, L, v = np.empty((N, nu, nx)), np.empty((N, nu, nu)), np.empty((N, nu, p_N.shape[1]))
    P, p = root(P_N) if rooted else P_N, p_N
    costs = {i: root(_joint(stage)) for i, stage in {id(stage): stage for stage in stages}.items()} if rooted else {}
    for k in range(N - 1, -1, -1):
        A, B, _, _, _, e, q, r = stages[k]
        if e is not None:
            p = p + (P.T @ (P @ e) if rooted else P @ e)
        if rooted:
            try:
                K[k], L[k], P = step_root(stages[k], P, costs[id(stages[k])])
            except OverflowError:
                raise DataError(
                    f"the model's forecast overflows within {N - k} steps; fit it again, or take a shorter horizon"
                ) from None
        else:
            K[k], L[k], P = step(stages[k], P)
        g = B.T @ p if r is None else B.T @ p + r
        v[k] = -solve_factored(L[k], g)
        p = A.T @ p - K[k].T @ g if q is None else q + A.T @ p - K[k].T @ g
    return Law(K, L, v, P.T @ P if rooted else P, p)


def _semidefinite(P: Float[np.ndarray, "nx nx"]) -> bool:
    """Return whether P ⪰ 0 up to rounding, on a diagonal of ones, so that units mean nothing."""
    if not np.isfinite(P).all() or (P.diagonal() < 0).any():
        return False
    size = np.sqrt(np.where(P.diagonal() > 0, P.diagonal(), 1.0))
    return bool(np.linalg.eigvalsh(P / np.outer(size, size)).min(initial=0.0) > -LOST)


def step_root(
    stage: Stage, F: Float[np.ndarray, "m nx"], cost: Float[np.ndarray, "n n"]
) -> tuple[Float[np.ndarray, "nu nx"], Float[np.ndarray, "nu nu"], Float[np.ndarray, "k nx"]]:
    """Return K, L and F of the stage before, P = FᵀF ⪰ 0 by construction; `cost` is a root of the stage's weight.

    With a root [W_u W_x] of the stage cost, the triangular factor of [W_u W_x; F B  F A] is [Lᵀ LᵀK; 0 F] of the stage
    before. It is the same to rounding whatever the units of x and u are.

    References
    ----------
    Kailath, Sayed & Hassibi, "Linear Estimation", 2000, chapter 12: array algorithms.
    """
    nx, nu = stage.B.shape
    rows = np.vstack([cost, np.hstack([F @ stage.B, F @ stage.A])])
    size = np.sqrt(np.einsum("ij,ij->j", rows, rows))
    if not np.isfinite(size).all():
        raise OverflowError
    size[size == 0] = 1.0
    T = np.asarray(np.linalg.qr(rows / size, mode="r"), dtype=np.float64)
    if (np.abs(T.diagonal()[:nu]) <= nx * np.finfo(float).eps).any():
        raise DefinitenessError(
            "R + BᵀPB is not positive definite: some change of the inputs costs nothing; raise R, or weight a state"
            " that every input moves"
        )
    T = np.asarray(np.where(T.diagonal() < 0, -1.0, 1.0)[:, None] * T * size, dtype=np.float64)
    upper: np.ndarray = T[:nu, :nu]
    right: np.ndarray = T[:nu, nu:]
    return np.asarray(solve_triangular(upper, right)), upper.T, T[nu:, nu:]


def _joint(stage: Stage) -> Float[np.ndarray, "n n"]:
    """Return the weight of [u; x] in a stage."""
    M = np.zeros(stage.B.shape) if stage.M is None else stage.M
    return np.block([[stage.R, M.T], [M, stage.Q]])


def step(
    stage: Stage, P: Float[np.ndarray, "nz nz"]
) -> tuple[Float[np.ndarray, "nu nz"], Float[np.ndarray, "nu nu"], Float[np.ndarray, "nz nz"]]:
    """Return K, L and P of the stage before: P ← Q + AᵀPA − KᵀSK."""
    A, B, Q, M = stage.A, stage.B, stage.Q, stage.M
    K, L = find_gain(stage, P)
    P = Q + A.T @ (P @ (A - B @ K))
    if M is not None:
        P = P - M @ K
    return K, L, 0.5 * (P + P.T)


def find_gain(
    stage: Stage, P: Float[np.ndarray, "nz nz"]
) -> tuple[Float[np.ndarray, "nu nz"], Float[np.ndarray, "nu nu"]]:
    """Return K = S⁻¹(BᵀPA + Mᵀ) and the L of S = R + BᵀPB = L Lᵀ."""
    A, B, M = stage.A, stage.B, stage.M
    BP = B.T @ P
    S = stage.R + BP @ B
    L, info = dpotrf(S, lower=1)
    if info:
        least = float(np.linalg.eigvalsh(0.5 * (S + S.T)).min())
        if float(np.linalg.eigvalsh(stage.R).min()) > 0:
            raise DefinitenessError(
                f"R + BᵀPB is not positive definite though R is: the cost-to-go of this model grew to "
                f"{np.abs(P).max():.2g}, and rounding hides R; fit the model with a ridge or fewer observables, or"
                " bring the states to one size"
            )
        raise DefinitenessError(
            f"R + BᵀPB is not positive definite: its least eigenvalue is {least:.3g}; raise R, or weight a state"
            " that every input moves"
        )
    return solve_factored(L, BP @ A if M is None else BP @ A + M.T), L


class RecursionStep(NamedTuple):
    """The gain K of a step, L of S = L Lᵀ, and the largest entry of the P that the step makes."""

    K: Float[np.ndarray, "nu nx"]
    L: Float[np.ndarray, "nu nu"]
    largest: float


@dataclass
class Recursion:
    """The gains of `recurse`, each computed when it is first asked for."""

    steps: Iterator[RecursionStep]
    found: list[RecursionStep] = field(default_factory=list[RecursionStep])

    def find_step(self, n: int) -> RecursionStep | None:
        """Return the n-th step backwards, from 1 on; None where P has lost its digits before it."""
        while len(self.found) < n:
            try:
                self.found.append(next(self.steps))
            except (StopIteration, DefinitenessError, np.linalg.LinAlgError):
                return None
        return self.found[n - 1]


def recurse(stage: Stage, P: Float[np.ndarray, "nx nx"]) -> Iterator[RecursionStep]:
    """Yield the gains K of P ← Q + AᵀPA − KᵀSK from this P.

    From `MANY` coordinates on a step keeps only what it adds, P⁺ − P = Y Yᵀ, where Y has as few columns as outputs are
    weighed: S⁺ = S + BᵀYYᵀB, S⁺K⁺ = S K + BᵀYYᵀA, Y⁺ = (A − BK)ᵀY C with CCᵀ = I − YᵀB S⁺⁻¹ BᵀY. A step takes
    the time of products with Y in place of products with P. The last P must cost less than one step more does, as it
    does where its weight is that of a stage; S cannot lose its definiteness, so the steps end where rounding hides the
    first S.

    Morf, Sidhu & Kailath, "Some new algorithms for recursive estimation in constant, linear, discrete-time systems",
    IEEE Trans. Autom. Control 19, 1974.
    """
    K, L, P_next = step(stage, P)
    yield RecursionStep(K, L, float(np.abs(P_next).max()))
    Y, P = _factor_few(P_next - P) if len(P) >= MANY else None, P_next
    while Y is None:
        K, L, P = step(stage, P)
        yield RecursionStep(K, L, float(np.abs(P).max()))
    A, B, S, one = stage.A, stage.B, L @ L.T, np.eye(Y.shape[1])
    diagonal, least = P.diagonal(), float(np.linalg.eigvalsh(S)[0])
    while True:
        G, AY = B.T @ Y, A.T @ Y
        S_next = S + G @ G.T
        if not np.finfo(float).eps * np.abs(S_next).max() < least:
            return
        L = np.linalg.cholesky(S_next)
        K_next = solve_factored(L, S @ K + G @ AY.T)
        Y = (AY - K.T @ G) @ np.linalg.cholesky(one - G.T @ solve_factored(L, G))
        K, S, diagonal = K_next, S_next, diagonal + (Y**2).sum(axis=1)
        yield RecursionStep(K, L, float(diagonal.max()))


def _factor_few(D: Float[np.ndarray, "nx nx"]) -> Float[np.ndarray, "nx n"] | None:
    """Return Y of D = Y Yᵀ; None where D is indefinite, or has a rank above a quarter of its size."""
    if not np.isfinite(D).all():
        return None
    values, vectors = np.linalg.eigh(D)
    rounding = np.finfo(float).eps * len(D) * values[-1]
    kept = values > rounding
    if values[0] < -rounding or 4 * kept.sum() > len(D):
        return None
    return vectors[:, kept] * np.sqrt(values[kept])


def solve_factored(L: Float[np.ndarray, "nu nu"], right: Float[np.ndarray, "nu n"]) -> Float[np.ndarray, "nu n"]:
    """Return S⁻¹ right for S = L Lᵀ; LAPACK itself, for SciPy's own checks take ten times as long."""
    return np.ascontiguousarray(dpotrs(L, right, lower=1)[0])


def stationary(stage: Stage, most: int) -> Gain:
    """Iterate P ← Q + AᵀPA − KᵀSK from P = Q until K rests, at most `most` steps, all of them `stage`.

    K rests when it moves by less than 1e-9 of its size, for as many steps as z has entries (50 are enough): a
    weight may take that long to reach an input. The steps before that are taken by doubling, as far as it is safe.
    A Constant, or any other mode that u cannot move, only makes its own entries of P grow. Where P has grown by 1e12,
    such a mode is unstable and has taken over; the iteration then runs on the controllable part alone.
    """
    try:
        start, taken = leap(stage, most)
        found, bounded = iterate(stage, start, most - taken)
        if bounded:
            return found
    except DefinitenessError:  # R + BᵀQB is not positive definite, or P has lost its digits
        pass
    found, bounded = iterate(stage, stage.Q, most)
    if not bounded:
        V = controllable(stage.A, stage.B)
        found, _ = iterate(stage._replace(A=stage.A @ V @ V.T), stage.Q, most)
    return found


def leap(stage: Stage, most: int) -> tuple[Float[np.ndarray, "nz nz"], int]:
    """Return P after n steps of the difference equation, by doubling, and n, a power of two below `most`.

    P = Q + H after n steps. Doubling replaces H, G, Φ of n steps by those of 2n steps:

        H + ΦᵀH(I + GH)⁻¹Φ,   G + Φ(I + GH)⁻¹GΦᵀ,   Φ(I + GH)⁻¹Φ.

    The first step has H = P_1 − Q, G = BS⁻¹Bᵀ, Φ = A − BK. R itself may be singular. Doubling ends when K rests, or
    before Φ, the closed loop of n steps, is so large that rounding would show.

    Chu, Fan, Lin & Wang, "Structure-preserving algorithms for periodic discrete-time algebraic Riccati equations",
    Int. J. Control 77, 2004.
    """
    A, B, Q = stage.A, stage.B, stage.Q
    K, L, P = step(stage, Q)
    H, G, Phi, taken = P - Q, B @ solve_factored(L, B.T), A - B @ K, 1
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
        K_last, K = K, find_gain(stage, Q + H)[0]
        if abs(K - K_last).max() <= SETTLED * abs(K).max():
            break
    return Q + H, taken


def iterate(stage: Stage, P: Float[np.ndarray, "nz nz"], most: int) -> tuple[Gain, bool]:
    """Return the last gain of the iteration from P, and whether P stayed below `LARGEST`."""
    n, nu = stage.B.shape
    K = np.zeros((nu, n))
    scale = max(float(np.abs(weight).max(initial=0.0)) for weight in (stage.Q, stage.R))
    rested = 0
    for _ in range(most):
        K_next, _, P_next = step(stage, P)
        if not P_next.max() <= LARGEST * scale:  # P ⪰ 0: its largest entry is on its diagonal; False for NaN
            return Gain(K, P), False
        moved = abs(K_next - K).max()
        P, K = P_next, K_next
        rested = rested + 1 if moved <= SETTLED * abs(K).max() else 0
        if rested >= min(n, RESTS):
            break
    return Gain(K, P), True


def controllable(A: Float[np.ndarray, "nz nz"], B: Float[np.ndarray, "nz nu"]) -> Float[np.ndarray, "nz nc"]:
    """Return an orthonormal basis of the controllable subspace, the span of [B, AB, A²B, …]."""
    n, found = len(A), 0
    V, least, kept = np.empty((n, n)), SETTLED * float(np.linalg.norm(B, 2)), SETTLED * float(np.linalg.norm(A, 2))
    new = B
    while new.shape[1] and found < n:
        for _ in range(2):  # twice is enough for orthogonality to rounding
            new = new - V[:, :found] @ (V[:, :found].T @ new)
        left, sigma, _ = np.linalg.svd(new, full_matrices=False)
        left = left[:, sigma > least][:, : n - found]
        V[:, found : found + left.shape[1]] = left
        found += left.shape[1]
        new, least = A @ left, kept
    return np.ascontiguousarray(V[:, :found])
