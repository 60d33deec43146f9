"""Least squares min ‖T − P K‖ on a few rows that stand for all snapshots, and the ridge that data ask for."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import qr, solve_triangular

from koopmpc import checks
from koopmpc.errors import DataError

Ridge = float | Literal["gcv"]

_STILL = 1e-7  # share of a column's norm below which its deviations from its mean may be rounding of Gram sums
_CLEAR = 1e-8  # ratio of squared singular values down to which a Gram matrix shows them to 8 digits
_ILL_CONDITIONED = 1e10
_LIGHT = 1e-3  # factor of the norm of columns on which a ridge counts a millionth
_NAMED = 3  # dependent columns that a message names
_ROUNDING = 1e3 * np.finfo(float).eps  # share of a target's energy below which a residual is rounding of sums
_NOTHING = 1e-14  # share of the smallest σ² below which a ridge changes nothing
_LARGEST = 1e3  # share of σ₁² above which a ridge leaves next to nothing of K
_POINTS = 300  # points of the first grid, about ten a decade
_ZOOMS = 5  # refinements of the grid, each ten times finer than the one before


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


@dataclass(frozen=True, eq=False)
class RegressionRows:
    """Rows [P T] with the second moments of M snapshots.

    Attributes
    ----------
    P
        (m, n) regressors.
    T
        (m, nt) targets, as far as they lie in these rows.
    rest
        (nt,) the energy Σt² of the part of each target outside these rows, which no K can fit.
    samples
        The number M of snapshots.
    constant
        The column of P that is 1 in every snapshot; None where there is none.
    """

    P: Float[np.ndarray, "m n"]
    T: Float[np.ndarray, "m nt"]
    rest: Float[np.ndarray, " nt"]
    samples: int
    constant: int | None = None

    def residual(self, columns: Int[np.ndarray, " c"], K: Float[np.ndarray, "n c"]) -> Float[np.ndarray, " c"]:
        """Return the root-mean-square of T − P K for these columns of T."""
        error = self.P @ K
        np.subtract(self.T[:, columns], error, out=error)
        return np.sqrt((np.einsum("ij,ij->j", error, error) + self.rest[columns]) / self.samples)

    def leading(self, targets: int) -> "RegressionRows":
        """Return these rows with the first targets only."""
        return replace(self, T=self.T[:, :targets], rest=self.rest[:targets])

    def part(self, columns: Int[np.ndarray, " c"]) -> "RegressionRows":
        """Return these rows with some columns of P only."""
        place = np.flatnonzero(columns == (-1 if self.constant is None else self.constant))
        return replace(self, P=self.P[:, columns], constant=int(place[0]) if place.size else None)

    def centred(self) -> "RegressionRows":
        """Return the rows of the deviations from the mean: what the constant column explains is taken out of P and T.

        Columns that do not move become zero. Without a constant column the rows stay as they are.
        """
        if self.constant is None:
            return self
        one = self.P[:, self.constant] / np.linalg.norm(self.P[:, self.constant])
        P, T = (full - np.outer(one, one @ full) for full in (self.P, self.T))
        P[:, norms(P) <= _STILL * norms(self.P)] = 0.0
        still = np.sum(T**2, axis=0) + self.rest <= _STILL**2 * (np.sum(self.T**2, axis=0) + self.rest)
        T[:, still] = P[:, self.constant] = 0.0
        return replace(self, P=P, T=T, rest=np.where(still, 0.0, self.rest), constant=None)


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
    """Return P with columns of norm 1; a column of zeros stays as it is."""
    size = norms(P)
    return P / np.where(size > 0, size, 1.0)


def cutoff(rows: RegressionRows) -> float:
    """Return eps · max(M, n): below it, relative to the largest, a singular value is rounding."""
    return float(np.finfo(float).eps * max(rows.samples, rows.P.shape[1]))


def solve(rows: RegressionRows, *, ridge: Ridge = 0.0, scaled: bool = True, light: Sequence[int] = ()) -> Solution:
    """Return K = argmin ‖T − P K‖² + ridge ‖S K‖², S = diag(‖pⱼ − p̄ⱼ‖), p̄ⱼ the mean of column j, S = 0 for a constant.

    So neither the units of the data nor where their zero is change what a ridge does: the constant column takes up the
    mean, as an intercept does, and the other coefficients are shrunk as those of deviations. Without a constant column
    p̄ = 0. With ridge = 0 it is the minimum-norm solution of the truncated SVD, cut at eps · max(M, n) · σ₁; `scaled`
    takes norm and cut on columns of unit norm, so that units of the data mean nothing. "gcv" chooses the ridge by
    generalised cross-validation. A ridge above 0 counts a millionth on the columns `light`.
    """
    return path(rows, (ridge,), scaled=scaled, light=light if ridge else ())[0]


def path(
    rows: RegressionRows, ridges: Sequence[Ridge], *, scaled: bool = True, light: Sequence[int] = ()
) -> list[Solution]:
    """Return the solution for each ridge, from one decomposition, or from two where some are 0 and some are not."""
    plain, shrunk = cache(partial(_Factors, rows, scaled)), cache(partial(_Factors, rows.centred(), scaled, light))
    found: list[Solution] = []
    for each in ridges:
        ridge = shrunk().cross_validated(free=rows.constant is not None) if each == "gcv" else each
        factors = shrunk() if ridge > 0 else plain()
        K, rank = factors.least_squares(ridge), factors.rank
        if ridge > 0 and rows.constant is not None:
            one, rank = rows.P[:, rows.constant], rank + 1
            K[rows.constant] = one @ (rows.T - rows.P @ K) / (one @ one)  # the intercept, once the others are known
        found.append(Solution(K, rank, ridge))
    return found


class _Factors:
    """P = U diag(s) Vᵀ diag(size) of these rows, and the shares Uᵀ T of the targets."""

    def __init__(self, rows: RegressionRows, scaled: bool, light: Sequence[int] = ()) -> None:
        self._rows, self._cut = rows, cutoff(rows)
        size = norms(rows.P) if scaled else np.ones(rows.P.shape[1])
        self._size = np.where(size > 0, size, 1.0)
        self._size[list(light)] *= _LIGHT
        self._U, self._s, self._Vt = np.linalg.svd(rows.P / self._size, full_matrices=False)
        self._shares = self._U.T @ rows.T
        self._held = self._s > self._cut * self._s.max(initial=0.0)

    @property
    def rank(self) -> int:
        """Number of singular values above rounding."""
        return int(self._held.sum())

    def least_squares(self, ridge: float) -> Float[np.ndarray, "n nt"]:
        """Return K of this ridge on unit-norm columns; of the truncated decomposition where it is 0."""
        s, held = self._s, self._held
        gain = s / (s**2 + ridge) if ridge > 0 else np.where(held, 1.0, 0.0) / np.where(held, s, 1.0)
        return (self._Vt.T * gain) @ self._shares / self._size[:, None]

    def cross_validated(self, *, free: bool) -> float:
        """Return the ridge of generalised cross-validation; `free` counts the mean that was taken out."""
        rows = self._rows
        outside = np.sum((rows.T - self._U @ self._shares) ** 2, axis=0) + rows.rest
        return cross_validated(self._s, self._shares, outside, rows.samples - free, self._cut)


def cross_validated(
    s: Float[np.ndarray, " k"],
    shares: Float[np.ndarray, "k nt"],
    outside: Float[np.ndarray, " nt"],
    samples: int,
    cut: float,
) -> float:
    """Return λ = argmin Σ_t M ‖t − H t‖² / ‖t‖² / (M − tr H)², H = P (PᵀP + λ I)⁻¹ Pᵀ, P = U diag(s) Vᵀ.

    Each target counts relative to its own size, so that λ does not depend on units. Where P fits all targets to
    rounding, there is no noise, and λ is 0. The errors are those of one step; `select` chooses a ridge by errors over a
    horizon, on held-out folds.

    Parameters
    ----------
    s
        Singular values of P on unit-norm columns.
    shares
        Uᵀ T.
    outside
        Energy of each target that P cannot reach.
    samples
        The number M of snapshot pairs.
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


def about_means(
    rows: RegressionRows, nu: int, which: Int[np.ndarray, " np"]
) -> tuple[RegressionRows, Float[np.ndarray, "n n"]]:
    """Return the rows with products (u − ū)(ψ − ψ̄) in place of u ψ, and the matrix that turns their K into that of u ψ.

    Both span the same models. A ridge on the products of deviations shrinks a model to the same one wherever the data
    have their zero; u ψ is nearly ū ψ + ψ̄ u where the data lie far from it. Without a constant the rows stay as given.
    """
    back = np.eye(rows.P.shape[1])
    if rows.constant is None:
        return rows, back
    one, first = rows.P[:, rows.constant], rows.P.shape[1] - nu * (len(which) + 1)
    mean = np.array(one @ rows.P / (one @ one))
    for i in range(nu):
        products = first + nu + i * len(which) + np.arange(len(which))
        back[which, products] = -mean[first + i]
        back[first + i, products] = -mean[which]
        back[rows.constant, products] = mean[first + i] * mean[which]
    return replace(rows, P=rows.P @ back), back


def scaled_rank(rows: RegressionRows, P: Float[np.ndarray, "m n"]) -> tuple[int, float]:
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


def orthonormal(columns: Float[np.ndarray, "m n"], cut: float) -> Float[np.ndarray, "m r"]:
    """Return an orthonormal basis of the span of these columns; columns of norm 0 are left out."""
    U, s, _ = np.linalg.svd(unit(columns[:, norms(columns) > 0]), full_matrices=False)
    return U[:, s > cut * s.max(initial=0.0)]


def onto(basis: Float[np.ndarray, "m k"], columns: Float[np.ndarray, "m c"]) -> Float[np.ndarray, "m c"]:
    """Return the columns projected on the span of the basis."""
    U = orthonormal(basis, float(np.finfo(float).eps * max(basis.shape)))
    return U @ (U.T @ columns)


def rule(rows: RegressionRows, asked: Ridge, ridge: float, *, scaled: bool = True, light: Sequence[int] = ()) -> str:
    """Return what a solve without a rank cut or added, in words."""
    columns = "unit-norm" if scaled else "unscaled"
    columns += " columns" if rows.constant is None or ridge == 0 else " deviations"
    spared = ", a millionth of it on states, Constant and inputs" if light else ""
    how = ", chosen by generalised cross-validation" if asked == "gcv" else ""
    if ridge > 0:
        return f"ridge {ridge:.6g} on {columns}{spared}{how}"
    return f"singular values cut at {cutoff(rows):.1e} of the largest on {columns}" + (", ridge 0" + how if how else "")


def doubts(
    rows: RegressionRows, observables: Sequence[str], inputs: Sequence[str], *, regular: bool
) -> tuple[list[str], float]:
    """Return a sentence for each reason to doubt the regression on P = [ψ(x) u], and its condition number.

    The condition number is that of columns scaled to unit norm; inf where they are dependent.

    Parameters
    ----------
    rows
        The rows; their P holds the observables, then the inputs.
    observables, inputs
        Names of the columns of P.
    regular
        The user asked for a ridge or a rank: dependent or ill-conditioned observables are no surprise then.
    """
    nz, nu = len(observables), len(inputs)
    names = [*observables, *inputs]
    size = norms(rows.P)
    zero = np.flatnonzero(size == 0)
    zero = zero[zero >= nz] if regular else zero
    sentences: list[str] = []
    if zero.size:
        sentences.append(
            f"{_listed([names[j] for j in zero])} was 0 in all snapshots, so its coefficients are set to 0; "
            "excite it or drop it"
        )
    if rows.samples < nz + nu:
        if not regular:
            sentences.append(
                f"rank-deficient: {rows.samples} snapshot pairs cannot determine {nz + nu} coefficients "
                "a row; the minimum-norm solution is taken; collect more, or lift to fewer observables"
            )
        return sentences, np.inf
    live = np.flatnonzero(size > 0)
    Z, U = rows.P[:, live[live < nz]], rows.P[:, live[live >= nz]]
    rank, condition = scaled_rank(rows, rows.P[:, live])
    if rank == len(live):
        if condition > _ILL_CONDITIONED and not regular:
            sentences.append(
                f"ill-conditioned: the observables have condition number {condition:.1e} on unit-norm "
                "columns; pass a ridge, or drop observables that are almost functions of others"
            )
        return sentences, condition if rank == nz + nu else np.inf
    rank_z, rank_u = scaled_rank(rows, Z)[0], scaled_rank(rows, U)[0]
    for P, own, part, what in ((Z, rank_z, live[live < nz], "observables"), (U, rank_u, live[live >= nz], "inputs")):
        if own < P.shape[1] and not (regular and what == "observables"):
            sentences.append(
                f"rank-deficient: {P.shape[1] - own} of {P.shape[1]} {what} are linear functions of others "
                f"on these data ({_dependent(P, own, [names[int(j)] for j in part])}); the minimum-norm solution "
                "is taken; drop them, or collect richer data"
            )
    if rank < rank_z + rank_u:
        sentences.append(
            "feedback made A and B inseparable: on these data inputs are linear functions of ψ(x) "
            f"(rank [Z U] = {rank}, rank Z + rank U = {rank_z + rank_u}); the minimum-norm split is taken; "
            "add noise to the input, or pass a known B to dmdc"
        )
    return sentences, condition


def _dependent(P: Float[np.ndarray, "m n"], rank: int, names: Sequence[str]) -> str:
    """Return, for each column beyond `rank`, the other columns on which it depends."""
    R, pivots = qr(unit(P), mode="r", pivoting=True)
    sorted_names = [names[int(j)] for j in pivots]
    weights = np.abs(solve_triangular(R[:rank, :rank], R[:rank, rank:]))
    said: list[str] = []
    for name, column in zip(sorted_names[rank : rank + _NAMED], weights.T, strict=False):
        sources = [sorted_names[int(i)] for i in np.argsort(-column, kind="stable") if column[i] > 1e-6]
        said.append(f"{name!r} of {_listed(sources)}")
    return ", ".join(said) + (", …" if P.shape[1] - rank > _NAMED else "")


def _listed(names: Sequence[str]) -> str:
    return ", ".join(repr(name) for name in names[:_NAMED]) + (", …" if len(names) > _NAMED else "")
