"""How many singular directions of the snapshots are signal: a number, a share of energy, or the optimal threshold.

References
----------
Gavish & Donoho, "The optimal hard threshold for singular values is 4/√3", IEEE Trans. Inf. Theory 60, 2014.
"""

from collections.abc import Sequence
from typing import Literal, cast

import numpy as np
from jaxtyping import Float
from scipy.linalg import qr, solve_triangular

from koopmpc import checks
from koopmpc.errors import DataError
from koopmpc.identify.solve import Rows, cutoff, norms, scaled_rank, unit

Rank = int | float | Literal["hard-threshold"] | None

_NODES = 200  # of the quadrature of the Marchenko–Pastur law, smooth in the angle
_HALVINGS = 60


def leading(rows: Rows, nz: int, rank: Rank, sentences: list[str]) -> tuple[Float[np.ndarray, "nz r"], str]:
    """Return U_r, the leading left singular vectors of the snapshots ψ(x), columns unscaled, and the rule in words.

    Parameters
    ----------
    rows
        P begins with ψ(x).
    nz
        Number of observables.
    rank
        A whole number; the least number of directions that hold this share of Σσ², between 0 and 1; or
        "hard-threshold", all σ above ω(β) times their median.
    sentences
        Gets one where the snapshots have a lower rank than was asked for, which is taken.
    """
    Z = rows.P[:, :nz]
    if len(Z) < nz:  # LAPACK is faster on the tall side
        U, s, _ = np.linalg.svd(Z.T, full_matrices=False)
    else:
        _, s, Vt = np.linalg.svd(Z, full_matrices=False)
        U = Vt.T
    held = int(np.sum(s > cutoff(rows) * s[0]))
    r, words = kept(rank, s, rows.samples, nz)
    if held < r:
        sentences.append(
            f"rank-deficient: rank {r} was asked for, the snapshots have rank {held}, which is taken; "
            f"pass rank={held}, or collect richer data"
        )
    r = max(min(held, r), 1)
    return np.ascontiguousarray(U[:, :r]), f"truncated SVD of unscaled columns at rank {r}{words}"


def kept(rank: Rank, s: Float[np.ndarray, " k"], samples: int, nz: int) -> tuple[int, str]:
    """Return how many singular values of the (samples, nz) snapshots a rank keeps, and the rule in words."""
    if isinstance(rank, str):
        if rank != "hard-threshold":
            raise DataError(f'rank is {rank!r}; pass a whole number, a share of energy in (0, 1), or "hard-threshold"')
        short, long = sorted((samples, nz))
        every = np.pad(s, (0, max(short - len(s), 0)))[:short]
        threshold = optimal_factor(short / long) * float(np.median(every))
        r = int(np.sum(s > threshold))
        if r == 0:
            raise DataError(
                f"no singular value of the snapshots is above the hard threshold {threshold:.3g}: they look like "
                "white noise alone; pass a rank, or collect richer data"
            )
        return r, f", the singular values above the hard threshold {threshold:.3g}"
    if isinstance(rank, float | np.floating):
        share = float(rank)
        if not 0 < share < 1:
            raise DataError(f"rank is {share:g}; pass a whole number, or a share of energy between 0 and 1")
        energy = np.cumsum(s**2)
        return int(np.sum(energy < share * energy[-1])) + 1, f", which holds {share:g} of the energy"
    whole = checks.count(cast(int, rank), "rank")
    if whole > nz:
        raise DataError(f"rank is {whole}, but the lifting has {nz} observables; pass {nz} or less")
    return whole, ""


def lost(
    Z: Float[np.ndarray, "m nz"],
    basis: Float[np.ndarray, "nz r"],
    C: Float[np.ndarray, "nx nz"] | None,
    samples: int,
) -> Float[np.ndarray, " nx"]:
    """Return the root-mean-square of C (I − U_r U_rᵀ) ψ(x), what the truncation takes from each state."""
    gap = (Z @ basis) @ basis.T
    np.subtract(Z, gap, out=gap)
    gap = gap if C is None else gap @ C.T
    return np.sqrt(np.einsum("ij,ij->j", gap, gap) / samples)


def known_factor(beta: float) -> float:
    """Return λ(β), the optimal threshold in units of √(long side) · σ for noise of known σ; λ(1) = 4/√3."""
    return float(np.sqrt(2 * (beta + 1) + 8 * beta / (beta + 1 + np.sqrt(beta**2 + 14 * beta + 1))))


def optimal_factor(beta: float) -> float:
    """Return ω(β) = λ(β) / √μ(β), the optimal threshold in units of the median singular value, 0 < β ≤ 1.

    μ(β) is the median of the Marchenko–Pastur law. With t = 1 + β + 2√β cos φ its density is
    2 sin²φ / (π t) on 0 ≤ φ ≤ π.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)

    def above(phi: float) -> float:  # the share of the law with t above t(φ)
        angles = 0.5 * phi * (nodes + 1)
        t = 1 + beta + 2 * np.sqrt(beta) * np.cos(angles)
        return float(0.5 * phi * weights @ (2 * np.sin(angles) ** 2 / (np.pi * t)))

    low, high = 0.0, np.pi
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if above(middle) < 0.5 else (low, middle)
    median = 1 + beta + 2 * np.sqrt(beta) * np.cos(low)
    return float(known_factor(beta) / np.sqrt(median))


_ILL_CONDITIONED = 1e10
_NAMED = 3  # dependent columns that a message names


def doubts(rows: Rows, observables: Sequence[str], inputs: Sequence[str], *, regular: bool) -> tuple[list[str], float]:
    """Return one sentence for each reason to doubt a regression on [ψ(x) u], P of `rows`, and its condition number.

    The condition number is that of columns scaled to unit norm; inf where they are dependent.

    Parameters
    ----------
    rows
        Their P holds the observables, then the inputs.
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
    found: list[str] = []
    if zero.size:
        found.append(
            f"{_listed([names[j] for j in zero])} was 0 in all snapshots, so its coefficients are set to 0; "
            "excite it or drop it"
        )
    if rows.samples < nz + nu:
        if not regular:
            found.append(
                f"rank-deficient: {rows.samples} snapshot pairs cannot determine {nz + nu} coefficients "
                "a row; the minimum-norm solution is taken; collect more, or lift to fewer observables"
            )
        return found, np.inf
    live = np.flatnonzero(size > 0)
    Z, U = rows.P[:, live[live < nz]], rows.P[:, live[live >= nz]]
    rank, condition = scaled_rank(rows, rows.P[:, live])
    if rank == len(live):
        if condition > _ILL_CONDITIONED and not regular:
            found.append(
                f"ill-conditioned: the observables have condition number {condition:.1e} on unit-norm "
                "columns; pass a ridge, or drop observables that are almost functions of others"
            )
        return found, condition if rank == nz + nu else np.inf
    rank_z, rank_u = scaled_rank(rows, Z)[0], scaled_rank(rows, U)[0]
    for P, own, part, what in (
        (Z, rank_z, live[live < nz], "observables"),
        (U, rank_u, live[live >= nz], "inputs"),
    ):
        if own < P.shape[1] and not (regular and what == "observables"):
            found.append(
                f"rank-deficient: {P.shape[1] - own} of {P.shape[1]} {what} are linear functions of others "
                f"on these data ({_dependent(P, own, [names[int(j)] for j in part])}); the minimum-norm solution "
                "is taken; drop them, or collect richer data"
            )
    if rank < rank_z + rank_u:
        found.append(
            "feedback made A and B inseparable: on these data inputs are linear functions of ψ(x) "
            f"(rank [Z U] = {rank}, rank Z + rank U = {rank_z + rank_u}); the minimum-norm split is taken; "
            "add noise to the input, or pass a known B to dmdc"
        )
    return found, condition


def _dependent(P: Float[np.ndarray, "m n"], rank: int, names: Sequence[str]) -> str:
    """Return for the columns beyond `rank` which others they depend on."""
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
