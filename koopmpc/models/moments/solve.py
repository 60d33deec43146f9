"""Least squares min ‖T − P K‖ on a few rows with the moments of all snapshots, and the choice of the ridge."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base import checks
from koopmpc.base.errors import DataError

Ridge = float | Literal["gcv"]

_STILL = 1e-7  # set deviations from the mean to 0 below this share of the column's norm: they may be rounding errors
_CLEAR = 1e-8  # use the Gram matrix if its smallest eigenvalue is above this share of the largest, else an SVD
ILL_CONDITIONED = 1e10  # warn if the condition number on unit-norm columns is above this
_LIGHT = 1e-3  # factor on the norm of `light` columns: the ridge on their coefficients is a million times smaller
_ROUNDING = 1e3 * np.finfo(float).eps  # a residual below this share of a target's energy is a rounding error
_NOTHING = 1e-14  # lower end of the ridges tried, as a share of the smallest σ²: a smaller ridge changes nothing
_LARGEST = 1e3  # upper end of the ridges tried, as a share of σ₁²: a larger ridge makes K almost 0
_POINTS = 300  # points of the first grid of ridges, about ten a decade
_ZOOMS = 5  # grids of ridges in all; each is ten times finer than the one before


def check_ridge(value: object) -> Ridge:
    """Return a ridge that is 0 or above, or "gcv"; raise DataError for anything else."""
    if isinstance(value, str):
        if value != "gcv":
            raise DataError(f'ridge is {value!r}; pass a number, or "gcv"')
        return "gcv"
    ridge = float(checks.array(value, "ridge", ()))  # pyright: ignore[reportArgumentType]  # it checks the type
    if ridge < 0:
        raise DataError(f"ridge is {ridge:g}; it must be 0 or above")
    return ridge


@dataclass(frozen=True, eq=False)
class RegressionRows:
    """Rows [P T] with the second moments of M snapshots."""

    P: Float[np.ndarray, "m n"]  # (m, n) regressors
    T: Float[np.ndarray, "m nt"]  # (m, nt) targets
    # (nt,) energy Σt² of the part of each target that is not in these rows; no K can fit it
    rest: Float[np.ndarray, " nt"]
    samples: int  # the number M of snapshots
    constant: int | None = None  # the column of P that is 1 in every snapshot, or None

    def residual(self, columns: Int[np.ndarray, " c"], K: Float[np.ndarray, "n c"]) -> Float[np.ndarray, " c"]:
        """Return the root-mean-square of T − P K for these columns of T."""
        error = self.P @ K
        np.subtract(self.T[:, columns], error, out=error)
        return np.sqrt((np.einsum("ij,ij->j", error, error) + self.rest[columns]) / self.samples)

    def keep_targets(self, targets: int) -> "RegressionRows":
        """Return these rows with the first targets only."""
        return replace(self, T=self.T[:, :targets], rest=self.rest[:targets])

    def keep_regressors(self, columns: Int[np.ndarray, " c"]) -> "RegressionRows":
        """Return these rows with some columns of P only."""
        place = np.flatnonzero(columns == (-1 if self.constant is None else self.constant))
        return replace(self, P=self.P[:, columns], constant=int(place[0]) if place.size else None)

    def subtract_means(self) -> "RegressionRows":
        """Return the rows of the deviations from the mean: P and T less their projections on the constant column.

        Columns that do not vary become zero. Without a constant column the same rows are returned.
        """
        if self.constant is None:
            return self
        unit = self.P[:, self.constant] / np.linalg.norm(self.P[:, self.constant])
        P, T = (full - np.outer(unit, unit @ full) for full in (self.P, self.T))
        P[:, column_norms(P) <= _STILL * column_norms(self.P)] = 0.0
        still = np.sum(T**2, axis=0) + self.rest <= _STILL**2 * (np.sum(self.T**2, axis=0) + self.rest)
        T[:, still] = P[:, self.constant] = 0.0
        return replace(self, P=P, T=T, rest=np.where(still, 0.0, self.rest), constant=None)


@dataclass(frozen=True, eq=False)
class Solution:
    """K (n, nt), the number of singular directions of P that it uses, and its ridge."""

    K: Float[np.ndarray, "n nt"]
    rank: int
    ridge: float


def column_norms(P: Float[np.ndarray, "m n"]) -> Float[np.ndarray, " n"]:
    """Return the Euclidean norm of each column."""
    return np.sqrt(np.einsum("ij,ij->j", P, P))


def scale_to_unit_norm(P: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "m n"]:
    """Return P with columns of norm 1; a column of zeros stays as it is."""
    size = column_norms(P)
    return P / np.where(size > 0, size, 1.0)


def rounding_cutoff(rows: RegressionRows) -> float:
    """Return eps · max(M, n): a singular value below this share of the largest one is a rounding error."""
    return float(np.finfo(float).eps * max(rows.samples, rows.P.shape[1]))


def solve(rows: RegressionRows, *, ridge: Ridge = 0.0, scaled: bool = True, light: Sequence[int] = ()) -> Solution:
    """Return K = argmin ‖T − P K‖² + ridge ‖S K‖², S = diag(‖pⱼ − p̄ⱼ‖), p̄ⱼ the mean of column j, S = 0 for a constant.

    The ridge acts on deviations from the mean, and the coefficients of the constant column are intercepts without a
    ridge. So neither the units nor the origin of the data change its effect. Without a constant column p̄ = 0.

    With ridge = 0, K is the minimum-norm solution of the truncated SVD, cut at eps · max(M, n) · σ₁; with `scaled`,
    norm and cut refer to columns of unit norm, so that the units of the data do not matter. "gcv" chooses the ridge by
    generalised cross-validation. On the columns `light` the ridge is a million times smaller.
    """
    return solve_path(rows, (ridge,), scaled=scaled, light=light if ridge else ())[0]


def solve_path(
    rows: RegressionRows, ridges: Sequence[Ridge], *, scaled: bool = True, light: Sequence[int] = ()
) -> list[Solution]:
    """Return the solution for each ridge; all ridges above 0 share one decomposition."""
    plain, shrunk = (
        cache(partial(_Factors, rows, scaled)),
        cache(partial(_Factors, rows.subtract_means(), scaled, light)),
    )
    solutions: list[Solution] = []
    for rule in ridges:
        ridge = shrunk().choose_ridge(free=rows.constant is not None) if rule == "gcv" else rule
        factors = shrunk() if ridge > 0 else plain()
        K, rank = factors.least_squares(ridge), factors.rank
        if ridge > 0 and rows.constant is not None:
            ones, rank = rows.P[:, rows.constant], rank + 1
            K[rows.constant] = ones @ (rows.T - rows.P @ K) / (ones @ ones)  # the intercept, from the other rows of K
        solutions.append(Solution(K, rank, ridge))
    return solutions


class _Factors:
    """The decomposition P = U diag(s) Vᵀ diag(size) of these rows, and the shares Uᵀ T of the targets."""

    def __init__(self, rows: RegressionRows, scaled: bool, light: Sequence[int] = ()) -> None:
        self._rows, self._cut = rows, rounding_cutoff(rows)
        size = column_norms(rows.P) if scaled else np.ones(rows.P.shape[1])
        self._size = np.where(size > 0, size, 1.0)
        self._size[list(light)] *= _LIGHT
        self._U, self._s, self._Vt = np.linalg.svd(rows.P / self._size, full_matrices=False)
        self._shares = self._U.T @ rows.T
        self._resolved = self._s > self._cut * self._s.max(initial=0.0)

    @property
    def rank(self) -> int:
        """Number of singular values above rounding."""
        return int(self._resolved.sum())

    def least_squares(self, ridge: float) -> Float[np.ndarray, "n nt"]:
        """Return K for this ridge on unit-norm columns; a ridge of 0 means the truncated decomposition."""
        s, resolved = self._s, self._resolved
        gain = s / (s**2 + ridge) if ridge > 0 else np.where(resolved, 1.0, 0.0) / np.where(resolved, s, 1.0)
        return (self._Vt.T * gain) @ self._shares / self._size[:, None]

    def choose_ridge(self, *, free: bool) -> float:
        """Return the ridge of generalised cross-validation; `free` says that a mean was subtracted from P and T."""
        rows = self._rows
        outside = np.sum((rows.T - self._U @ self._shares) ** 2, axis=0) + rows.rest
        return choose_ridge(self._s, self._shares, outside, rows.samples - free, self._cut)


def choose_ridge(
    s: Float[np.ndarray, " k"],
    shares: Float[np.ndarray, "k nt"],
    outside: Float[np.ndarray, " nt"],
    samples: int,
    cut: float,
) -> float:
    """Return λ = argmin Σ_t M ‖t − H t‖² / ‖t‖² / (M − tr H)², H = P (PᵀP + λ I)⁻¹ Pᵀ, P = U diag(s) Vᵀ.

    Each target counts relative to its own size, so that λ does not depend on units. If P fits all targets to rounding
    error, the data have no noise and λ is 0. The errors are those of one step; `select` chooses a ridge by errors over
    a horizon on held-out folds.

    `s` holds the singular values of P on unit-norm columns; those below `cut` times the largest are rounding errors.
    `shares` is UᵀT, `outside` the energy ‖t − U Uᵀ t‖² of each target outside the span of P, and `samples` is M, the
    number of snapshot pairs. λ acts on unit-norm columns.

    References
    ----------
    Golub, Heath & Wahba, "Generalized cross-validation as a method for choosing a good ridge parameter",
    Technometrics 21, 1979.
    """
    resolved = s > cut * s.max(initial=0.0)
    energy = np.sum(shares**2, axis=0) + outside
    residual = outside + np.sum(shares[~resolved] ** 2, axis=0)
    exact = samples > resolved.sum() and not (residual > _ROUNDING * energy).any()
    if exact or not resolved.any():
        return 0.0
    size = np.where(energy > 0, energy, 1.0)
    power = np.sum(shares**2 / size, axis=1)
    rest = float(np.sum(outside / size))
    squares = s**2

    def score(ridge: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        left = ridge[:, None] / (squares + ridge[:, None])  # I − H along each singular direction
        free = samples - len(s) + np.sum(left, axis=1)
        return samples * (left**2 @ power + rest) / free**2

    smallest = float(s[resolved].min())
    low, high, points = np.log(_NOTHING * smallest**2), np.log(_LARGEST * float(s[0]) ** 2), _POINTS
    for _ in range(_ZOOMS):
        grid = np.linspace(low, high, points)
        best = int(np.argmin(score(np.exp(grid))))
        low, high, points = float(grid[max(best - 1, 0)]), float(grid[min(best + 1, points - 1)]), 21
    return float(np.exp(0.5 * (low + high)))


def centre_products(
    rows: RegressionRows, nu: int, which: Int[np.ndarray, " np"], crossed: Sequence[tuple[int, int, int]] = ()
) -> tuple[RegressionRows, Float[np.ndarray, "n n"]]:
    """Return the rows with products (u − ū)(ψ − ψ̄) in place of u ψ, and the matrix that turns their K into that of u ψ.

    `crossed` names further columns of products, each with the two columns of its factors. Both span the same models. A
    ridge on the products of deviations gives the same model for any origin of the data, while far from the origin u ψ
    is nearly dependent: u ψ ≈ ū ψ + ψ̄ u. Without a constant column the rows stay the same.
    """
    back = np.eye(rows.P.shape[1])
    if rows.constant is None:
        return rows, back
    ones, first = rows.P[:, rows.constant], rows.P.shape[1] - nu * (len(which) + 1)
    mean = np.array(ones @ rows.P / (ones @ ones))
    for i in range(nu):
        products = first + nu + i * len(which) + np.arange(len(which))
        back[which, products] = -mean[first + i]
        back[first + i, products] = -mean[which]
        back[rows.constant, products] = mean[first + i] * mean[which]
    for product, left, right in crossed:
        back[left, product], back[right, product] = -mean[right], -mean[left]
        back[rows.constant, product] = mean[left] * mean[right]
    return replace(rows, P=rows.P @ back), back


class BilinearParts(NamedTuple):
    """The matrices of z⁺ = A z + (B + Σ wⱼ Mⱼ) u + E w + Σ uᵢ Nᵢ z + Σ wⱼ Sⱼ z."""

    A: Float[np.ndarray, "nz nz"]
    B: Float[np.ndarray, "nz nu"]
    N: Float[np.ndarray, "nu nz nz"]
    E: Float[np.ndarray, "nz nw"]
    S: Float[np.ndarray, "nw nz nz"]
    M: Float[np.ndarray, "nw nz nu"]


@dataclass(frozen=True)
class BilinearColumns:
    """The columns [ψ w⊗u u w u⊗ψ w⊗ψ] of a bilinear regression, w⊗u only where it is `crossed`."""

    nz: int
    nu: int
    nw: int
    crossed: bool

    @property
    def first(self) -> int:
        """The column of u."""
        return self.nz + self.nu * self.nw * self.crossed

    def arrange(
        self, rows: RegressionRows, products: Int[np.ndarray, " np"], which: Int[np.ndarray, " nk"]
    ) -> RegressionRows:
        """Return these columns of rows [ψ u w w⊗u u⊗ψ w⊗ψ …], with only the `products` in `which` in the last two."""
        nz, drives = self.nz, self.nu + self.nw
        end, block = self.first + drives, np.flatnonzero(np.isin(products, which))
        order = [np.arange(nz), np.arange(nz + drives, end), np.arange(nz, nz + drives)]
        order += [end + i * len(products) + block for i in range(drives)]
        return replace(rows, P=rows.P[:, np.concatenate(order)])

    def name(
        self, signals: tuple[str, ...], observables: tuple[str, ...], which: Int[np.ndarray, " nk"]
    ) -> tuple[str, ...]:
        """Return the names of all columns behind ψ, of the signals u, w and w⊗u."""
        drives, crossed = signals[: self.nu + self.nw], signals[self.nu + self.nw :]
        return (*crossed, *drives, *(f"{u} * {observables[int(i)]}" for u in drives for i in which))

    def centre(
        self, rows: RegressionRows, which: Int[np.ndarray, " nk"]
    ) -> tuple[RegressionRows, Float[np.ndarray, "n n"]]:
        """Return the rows with products of deviations, and the matrix that turns their K, see `centre_products`."""
        nz, nu, first = self.nz, self.nu, self.first
        crossed = [(nz + nu * j + i, first + i, first + nu + j) for j in range(self.nw) for i in range(nu)]
        return centre_products(rows, nu + self.nw, which, crossed if self.crossed else ())

    def split(self, K: Float[np.ndarray, "n nz"], which: Int[np.ndarray, " nk"]) -> BilinearParts:
        """Return the matrices of the coefficients K."""
        nz, nu, nw, first = self.nz, self.nu, self.nw, self.first
        last = first + nu + nw
        N, M = np.zeros((nu + nw, nz, nz)), np.zeros((nw, nz, nu))
        N[:, :, which] = K[last:].reshape(nu + nw, -1, nz).transpose(0, 2, 1)
        if self.crossed:
            M = K[nz:first].reshape(nw, nu, nz).transpose(0, 2, 1)
        return BilinearParts(K[:nz].T, K[first : first + nu].T, N[:nu], K[first + nu : last].T, N[nu:], M)


def scaled_rank(rows: RegressionRows, P: Float[np.ndarray, "m n"]) -> tuple[int, float]:
    """Return rank and condition number of the columns P of `rows`, scaled to unit norm; inf if they are dependent."""
    if P.shape[1] == 0:
        return 0, 1.0
    columns = scale_to_unit_norm(P)
    squares = np.linalg.eigvalsh(columns.T @ columns)
    if squares[0] > _CLEAR * squares[-1]:
        return P.shape[1], float(np.sqrt(squares[-1] / squares[0]))
    s = np.linalg.svd(columns, compute_uv=False)
    rank = int(np.sum(s > rounding_cutoff(rows) * s[0]))
    return rank, float(s[0] / s[-1]) if rank == P.shape[1] else np.inf


def orthonormal_basis(columns: Float[np.ndarray, "m n"], cut: float) -> Float[np.ndarray, "m r"]:
    """Return an orthonormal basis of the span of these columns; columns of norm 0 are left out."""
    U, s, _ = np.linalg.svd(scale_to_unit_norm(columns[:, column_norms(columns) > 0]), full_matrices=False)
    return U[:, s > cut * s.max(initial=0.0)]


def project_onto(basis: Float[np.ndarray, "m k"], columns: Float[np.ndarray, "m c"]) -> Float[np.ndarray, "m c"]:
    """Return the projection of the columns on the span of the basis."""
    U = orthonormal_basis(basis, float(np.finfo(float).eps * max(basis.shape)))
    return U @ (U.T @ columns)


def describe_solve(
    rows: RegressionRows, choice: Ridge, ridge: float, *, scaled: bool = True, light: Sequence[int] = ()
) -> str:
    """Return in words the ridge, or the cut of singular values, of a solve without a rank."""
    columns = "unit-norm" if scaled else "unscaled"
    columns += " columns" if rows.constant is None or ridge == 0 else " deviations"
    spared = ", a millionth of it on states, Constant and inputs" if light else ""
    how = ", chosen by generalised cross-validation" if choice == "gcv" else ""
    if ridge > 0:
        return f"ridge {ridge:.6g} on {columns}{spared}{how}"
    zero = f", ridge 0{how}" if how else ""
    return f"singular values cut at {rounding_cutoff(rows):.1e} of the largest on {columns}{zero}"
