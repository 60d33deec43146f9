"""LASSO and group LASSO on a Gram matrix: min ½ tr KᵀGK − tr HᵀK + Σ wᵢⱼ |Kᵢⱼ|, or Σ wⱼ ‖kⱼ‖₂ over rows."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_STEPS = 20_000


@dataclass(frozen=True, eq=False)
class Sparse:
    """K (n, nt), and by how much it misses the optimality conditions."""

    K: Float[np.ndarray, "n nt"]
    missed: float


def lasso(
    G: Float[np.ndarray, "n n"],
    H: Float[np.ndarray, "n nt"],
    weights: Float[np.ndarray, "n nt"],
    *,
    grouped: bool,
    tolerance: float = 1e-10,
) -> Sparse:
    """Return the minimiser by accelerated proximal gradient, restarted where it turns back.

    Parameters
    ----------
    G
        PᵀP ⪰ 0.
    H
        PᵀT.
    weights
        Penalties ≥ 0 of the entries; `grouped` takes the first column, one penalty a row of K.
    grouped
        Penalise rows by their Euclidean norm, so that whole rows vanish.
    tolerance
        On the optimality conditions, relative to the largest entry of H.

    References
    ----------
    Beck & Teboulle, "A fast iterative shrinkage-thresholding algorithm", SIAM J. Imaging Sci. 2, 2009; restart:
    O'Donoghue & Candès, Found. Comput. Math. 15, 2015; groups: Yuan & Lin, J. R. Stat. Soc. B 68, 2006.
    """
    K = np.zeros_like(H)
    if not H.size:
        return Sparse(K, 0.0)
    step = 1.0 / max(float(np.linalg.eigvalsh(G)[-1]), 1e-300)
    enough = tolerance * max(float(np.abs(H).max()), 1e-300)
    ahead, momentum, missed = K, 1.0, np.inf
    for _ in range(_STEPS):
        new = _shrunk(ahead - step * (G @ ahead - H), step * weights, grouped)
        missed = float(np.abs(new - ahead).max()) / step
        if missed <= enough:
            return Sparse(new, missed)
        if np.sum((ahead - new) * (new - K)) > 0:
            momentum = 1.0
        later = 0.5 * (1 + np.sqrt(1 + 4 * momentum**2))
        ahead = new + (momentum - 1) / later * (new - K)
        K, momentum = new, later
    return Sparse(K, missed)


def _shrunk(
    K: Float[np.ndarray, "n nt"], by: Float[np.ndarray, "n nt"], grouped: bool
) -> Float[np.ndarray, "n nt"]:
    """Return argmin ½ ‖X − K‖² + the penalty of X."""
    size = np.sqrt(np.sum(K**2, axis=1, keepdims=True)) if grouped else np.abs(K)
    least = by[:, :1] if grouped else by
    return K * np.maximum(1.0 - least / np.where(size > 0, size, 1.0), 0.0)
