"""The rank that a truncated fit keeps: a number, a share of energy, or the optimal hard threshold."""

from typing import Literal, cast

import numpy as np
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.models.moments.solve import (
    RegressionRows,
    rounding_cutoff,
)

Rank = int | float | Literal["hard-threshold"] | None
_NODES = 200  # nodes of the quadrature of the Marchenko–Pastur law, which is smooth in the angle
_HALVINGS = 60  # bisection steps for the median of that law: the interval shrinks to rounding error


def leading_directions(
    rows: RegressionRows, nz: int, rank: Rank, sentences: list[str]
) -> tuple[Float[np.ndarray, "nz r"], str]:
    """Return U_r, the leading left singular vectors of the unscaled snapshots ψ(x), and the rule in words.

    If the snapshots have a lower rank, that one is used and a doubt is appended to `sentences`.
    """
    Z = rows.P[:, :nz]
    if len(Z) < nz:  # LAPACK is faster on the tall side
        U, s, _ = np.linalg.svd(Z.T, full_matrices=False)
    else:
        _, s, Vt = np.linalg.svd(Z, full_matrices=False)
        U = Vt.T
    numerical_rank = int(np.sum(s > rounding_cutoff(rows) * s[0]))
    r, words = choose_rank(rank, s, rows.samples, nz)
    if numerical_rank < r:
        sentences.append(
            f"rank-deficient: rank {r} was asked for, the snapshots have rank {numerical_rank}, which is taken; "
            f"pass rank={numerical_rank}, or collect richer data"
        )
    r = max(min(numerical_rank, r), 1)
    return np.ascontiguousarray(U[:, :r]), f"truncated SVD of unscaled columns at rank {r}{words}"


def choose_rank(rank: Rank, s: Float[np.ndarray, " k"], samples: int, nz: int) -> tuple[int, str]:
    """Return the number of singular values of (samples, nz) snapshots that a rank keeps, and the rule in words."""
    if isinstance(rank, str):
        if rank != "hard-threshold":
            raise DataError(f'rank is {rank!r}; pass a whole number, a share of energy in (0, 1), or "hard-threshold"')
        short, long = sorted((samples, nz))
        padded = np.zeros(short)
        padded[: len(s)] = s[:short]
        threshold = median_threshold(short / long) * float(np.median(padded))
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


def truncation_loss(
    Z: Float[np.ndarray, "m nz"], basis: Float[np.ndarray, "nz r"], C: Float[np.ndarray, "nx nz"] | None, samples: int
) -> Float[np.ndarray, " nx"]:
    """Return the root-mean-square of C (I − U_r U_rᵀ) ψ(x), the part of each state that the truncation loses."""
    gap = (Z @ basis) @ basis.T
    np.subtract(Z, gap, out=gap)
    gap = gap if C is None else gap @ C.T
    return np.sqrt(np.einsum("ij,ij->j", gap, gap) / samples)


def known_noise_threshold(beta: float) -> float:
    """Return λ(β), the optimal threshold in units of √(long side) · σ for noise of known σ; λ(1) = 4/√3."""
    return float(np.sqrt(2 * (beta + 1) + 8 * beta / (beta + 1 + np.sqrt(beta**2 + 14 * beta + 1))))


def median_threshold(beta: float) -> float:
    """Return ω(β) = λ(β) / √μ(β), the optimal threshold in units of the median singular value, 0 < β ≤ 1.

    μ(β) is the median of the Marchenko–Pastur law. With t = 1 + β + 2√β cos φ its density is
    2 sin²φ / (π t) on 0 ≤ φ ≤ π.

    References
    ----------
    Gavish & Donoho, "The optimal hard threshold for singular values is 4/√3", IEEE Trans. Inf. Theory 60, 2014.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)

    def mass_above(phi: float) -> float:  # the share of the law's mass with t above t(φ)
        angles = 0.5 * phi * (nodes + 1)
        t = 1 + beta + 2 * np.sqrt(beta) * np.cos(angles)
        return float(0.5 * phi * weights @ (2 * np.sin(angles) ** 2 / (np.pi * t)))

    low, high = 0.0, np.pi
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if mass_above(middle) < 0.5 else (low, middle)
    median = 1 + beta + 2 * np.sqrt(beta) * np.cos(low)
    return float(known_noise_threshold(beta) / np.sqrt(median))
