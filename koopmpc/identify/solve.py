"""Least squares min ‖T − P K‖ on a few rows that stand for all snapshots."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from koopmpc import checks
from koopmpc.errors import DataError

Ridge = float | Literal["gcv"]

_ROUNDING = 1e3 * np.finfo(float).eps  # share of a target's energy below which a residual is rounding of sums
_NOTHING = 1e-14
_LARGEST = 1e3  # times σ₁²: beyond it next to nothing is left of K
_POINTS = 300  # of the first grid, about ten a decade
_ZOOMS = 5  # each ten times finer than the one before


def ridge_of(given: object) -> Ridge:
    """Return a ridge that is 0 or above, or "gcv"; raise DataError for anything else."""
    if isinstance(given, str):
        if given != "gcv":
            raise DataError(f'ridge is {given!r}; pass a number, or "gcv"')
        return "gcv"
    ridge = float(checks.array(given, "ridge", ()))  # pyright: ignore[reportArgumentType]  # array refuses what is none
    if ridge < 0:
        raise DataError(f"ridge is {ridge:g}; it must be 0 or above")
    return ridge


def cross_validated(
    s: Float[np.ndarray, " k"],
    shares: Float[np.ndarray, "k nt"],
    outside: Float[np.ndarray, " nt"],
    samples: int,
    cut: float,
) -> float:
    """Return λ = argmin Σ_t M ‖t − H t‖² / ‖t‖² / (M − tr H)², H = P (PᵀP + λ I)⁻¹ Pᵀ, P = U diag(s) Vᵀ.

    Each target counts relative to its own size, so that units mean nothing. Where P holds all of them to
    rounding there is no noise, and λ is 0.

    Parameters
    ----------
    s
        Singular values of P on unit-norm columns.
    shares
        Uᵀ T.
    outside
        Energy of each target that P cannot reach.
    samples
        M.
    cut
        Singular values below cut · σ₁ are rounding.

    References
    ----------
    Golub, Heath & Wahba, "Generalized cross-validation as a method for choosing a good ridge parameter",
    Technometrics 21, 1979.
    """
    live = s > cut * s.max(initial=0.0)
    energy = np.sum(shares**2, axis=0) + outside
    lost = outside + np.sum(shares[~live] ** 2, axis=0)
    exact = samples > live.sum() and not (lost > _ROUNDING * energy).any()
    if exact or not live.any():
        return 0.0
    size = np.where(energy > 0, energy, 1.0)
    power = np.sum(shares**2 / size, axis=1)
    rest = float(np.sum(outside / size))
    squares = s**2

    def score(ridge: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        left = ridge[:, None] / (squares + ridge[:, None])  # I − H along each singular direction
        free = samples - len(s) + np.sum(left, axis=1)
        return samples * (left**2 @ power + rest) / free**2

    smallest = float(s[live].min())  # a ridge far below its square changes nothing
    low, high, points = np.log(_NOTHING * smallest**2), np.log(_LARGEST * float(s[0]) ** 2), _POINTS
    for _ in range(_ZOOMS):
        grid = np.linspace(low, high, points)
        best = int(np.argmin(score(np.exp(grid))))
        low, high, points = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, points - 1)]), 21
    return float(np.exp(0.5 * (low + high)))


_CLEAR = 1e-8  # ratio of squared singular values down to which a Gram matrix shows them to 8 digits


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows [P T] with the second moments of M snapshots.

    Attributes
    ----------
    P
        (m, n) regressors.
    T
        (m, nt) targets, as far as they lie in these rows.
    rest
        (nt,) the energy Σt² of each target outside these rows, where no P can reach.
    samples
        M.
    """

    P: Float[np.ndarray, "m n"]
    T: Float[np.ndarray, "m nt"]
    rest: Float[np.ndarray, " nt"]
    samples: int

    def residual(self, columns: Int[np.ndarray, " c"], K: Float[np.ndarray, "n c"]) -> Float[np.ndarray, " c"]:
        """Return the root-mean-square of T − P K for these columns of T."""
        error = self.P @ K
        np.subtract(self.T[:, columns], error, out=error)
        return np.sqrt((np.einsum("ij,ij->j", error, error) + self.rest[columns]) / self.samples)

    def leading(self, targets: int) -> "Rows":
        """Return these rows with the first targets only."""
        return Rows(self.P, self.T[:, :targets], self.rest[:targets], self.samples)


@dataclass(frozen=True, eq=False)
class Solution:
    """K (n, nt), how many singular directions of P it uses, and the ridge that it was found with."""

    K: Float[np.ndarray, "n nt"]
    rank: int
    ridge: float


def norms(P: Float[np.ndarray, "m n"]) -> Float[np.ndarray, " n"]:
    """Return the Euclidean norm of each column."""
    return np.sqrt(np.einsum("ij,ij->j", P, P))


def unit(P: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m n"]:
    """Return P with columns of norm 1; a column of zeros stays."""
    size = norms(P)
    return P / np.where(size > 0, size, 1.0)


def cutoff(rows: Rows) -> float:
    """Return eps · max(M, n): below it, relative to the largest, a singular value is rounding."""
    return float(np.finfo(float).eps * max(rows.samples, rows.P.shape[1]))


def solve(rows: Rows, *, ridge: Ridge = 0.0, scaled: bool = True) -> Solution:
    """Return K = argmin ‖T − P K‖² + ridge ‖S K‖², S = diag of the columns' norms.

    With ridge = 0 it is the minimum-norm solution of the truncated SVD, cut at eps · max(M, n) · σ₁; `scaled`
    takes norm and cut on columns of unit norm, where units of the data mean nothing. "gcv" chooses the ridge by
    generalised cross-validation.
    """
    return path(rows, (ridge,), scaled=scaled)[0]


def path(rows: Rows, ridges: Sequence[Ridge], *, scaled: bool = True) -> list[Solution]:
    """Return the solution for each ridge, of one decomposition."""
    size = norms(rows.P) if scaled else np.ones(rows.P.shape[1])
    size[size == 0] = 1.0
    U, s, Vt = np.linalg.svd(rows.P / size, full_matrices=False)
    cut = cutoff(rows)
    held = s > cut * s.max(initial=0.0)
    shares = U.T @ rows.T
    found: list[Solution] = []
    for each in ridges:
        ridge = each
        if ridge == "gcv":
            outside = np.sum((rows.T - U @ shares) ** 2, axis=0) + rows.rest
            ridge = cross_validated(s, shares, outside, rows.samples, cut)
        gain = s / (s**2 + ridge) if ridge > 0 else np.where(held, 1.0, 0.0) / np.where(held, s, 1.0)
        K = (Vt.T * gain) @ shares / size[:, None]
        found.append(Solution(K, int(held.sum()), ridge))
    return found


def scaled_rank(rows: Rows, P: Float[np.ndarray, "m n"]) -> tuple[int, float]:
    """Return rank and condition number of the columns P of `rows`, scaled to unit norm; inf if dependent."""
    if P.shape[1] == 0:
        return 0, 1.0
    columns = unit(P)
    squares = np.linalg.eigvalsh(columns.T @ columns)
    if squares[0] > _CLEAR * squares[-1]:
        return P.shape[1], float(np.sqrt(squares[-1] / squares[0]))
    s = np.linalg.svd(columns, compute_uv=False)
    rank = int(np.sum(s > cutoff(rows) * s[0]))
    return rank, float(s[0] / s[-1]) if rank == P.shape[1] else np.inf


def onto(basis: Float[np.ndarray, "m k"], columns: Float[np.ndarray, "m c"]) -> Float[np.ndarray, "m c"]:
    """Return the columns projected on the span of the basis."""
    U, s, _ = np.linalg.svd(unit(basis), full_matrices=False)
    U = U[:, s > np.finfo(float).eps * max(basis.shape) * s.max(initial=0.0)]
    return U @ (U.T @ columns)
