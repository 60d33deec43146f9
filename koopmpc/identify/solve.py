"""Least squares min ‖T − P K‖ on a few rows that stand for all snapshots."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import qr, solve_triangular

from koopmpc import checks
from koopmpc.errors import DataError
from koopmpc.identify.ridge import cross_validated

Ridge = float | Literal["gcv"]

_CLEAR = 1e-8  # ratio of squared singular values down to which a Gram matrix shows them to 8 digits
_ILL_CONDITIONED = 1e10
_LIGHT = 1e-3  # factor of the norm of columns on which a ridge counts a millionth
_NAMED = 3  # dependent columns that a message names


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

    def leading(self, targets: int) -> "RegressionRows":
        """Return these rows with the first targets only."""
        return RegressionRows(self.P, self.T[:, :targets], self.rest[:targets], self.samples)


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
    """Return K = argmin ‖T − P K‖² + ridge ‖S K‖², S = diag of the columns' norms.

    With ridge = 0 it is the minimum-norm solution of the truncated SVD, cut at eps · max(M, n) · σ₁; `scaled`
    takes norm and cut on columns of unit norm, so that units of the data mean nothing. "gcv" chooses the ridge by
    generalised cross-validation. A ridge above 0 counts a millionth on the columns `light`.
    """
    return path(rows, (ridge,), scaled=scaled, light=light if ridge else ())[0]


def path(
    rows: RegressionRows, ridges: Sequence[Ridge], *, scaled: bool = True, light: Sequence[int] = ()
) -> list[Solution]:
    """Return the solution for each ridge, from one decomposition."""
    size = norms(rows.P) if scaled else np.ones(rows.P.shape[1])
    size[size == 0] = 1.0
    size[list(light)] *= _LIGHT
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
    spared = ", a millionth of it on states, Constant and inputs" if light else ""
    how = ", chosen by generalised cross-validation" if asked == "gcv" else ""
    if ridge > 0:
        return f"ridge {ridge:.6g} on {columns} columns{spared}{how}"
    return f"singular values cut at {cutoff(rows):.1e} of the largest on {columns} columns" + (
        ", ridge 0" + how if how else ""
    )


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
    for P, own, part, what in (
        (Z, rank_z, live[live < nz], "observables"),
        (U, rank_u, live[live >= nz], "inputs"),
    ):
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
