"""cross_validated: the ridge of one fit by generalised cross-validation, ``ridge="gcv"``.

It is chosen by the errors of one step. `select` chooses one by the errors over a horizon on held-out folds, see
synthesis/cross_validation.py.
"""

import numpy as np
from jaxtyping import Float

_ROUNDING = 1e3 * np.finfo(float).eps  # share of a target's energy below which a residual is rounding of sums
_NOTHING = 1e-14  # share of the smallest σ² below which a ridge changes nothing
_LARGEST = 1e3  # share of σ₁² above which a ridge leaves next to nothing of K
_POINTS = 300  # points of the first grid, about ten a decade
_ZOOMS = 5  # refinements of the grid, each ten times finer than the one before


def cross_validated(
    s: Float[np.ndarray, " k"],
    shares: Float[np.ndarray, "k nt"],
    outside: Float[np.ndarray, " nt"],
    samples: int,
    cut: float,
) -> float:
    """Return λ = argmin Σ_t M ‖t − H t‖² / ‖t‖² / (M − tr H)², H = P (PᵀP + λ I)⁻¹ Pᵀ, P = U diag(s) Vᵀ.

    Each target counts relative to its own size, so that λ does not depend on units. Where P fits all targets to
    rounding, there is no noise, and λ is 0.

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
