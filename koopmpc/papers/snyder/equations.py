"""The equations of Snyder & Song (2021), each beside the public function that computes it, and how far they agree."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Complex, Float

from koopmpc.data.episodes import Episodes
from koopmpc.identify.fits.edmd import edmd
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.reduced import Projected
from koopmpc.predict.spectrum import amplitudes, continuous_eigenvalues, linearity_error, reconstruct


@dataclass(frozen=True)
class Equation:
    """One equation: its number in the paper, the formula, the function, and what separates the two on the data."""

    number: str
    formula: str
    function: str
    residual: float


def equations(trajectory: Episodes, lifting: Lifting, rank: int) -> list[Equation]:
    """Check every equation of the paper on one trajectory; a residual is relative, rounding where it is small.

    Parameters
    ----------
    trajectory
        One episode without inputs.
    lifting
        Θ; the snapshots Y are its observables, and with `State()` alone they are x.
    rank
        r of the truncated SVD.
    """
    (episode,) = trajectory
    bound = lifting.bind(trajectory.states)
    snapshots = trajectory.snapshots()
    Y, Y_next = bound(snapshots.X).T, bound(snapshots.X_next).T  # columns, as the paper has them
    whole, reduced = edmd(trajectory, bound), edmd(trajectory, bound, rank=rank)
    assert isinstance(reduced.lifting, Projected)
    assert reduced.exact_modes is not None
    U, s, Vt = np.linalg.svd(Y, full_matrices=False)
    forward = Y_next @ Vt[:rank].T / s[:rank]  # Y′ V Σ⁻¹
    A = forward @ U[:, :rank].T
    basis, modes, values = reduced.lifting.basis, reduced.exact_modes, reduced.eigenvalues
    W = reduced.eigenvectors
    t = np.arange(len(episode.X)) * trajectory.dt
    b = amplitudes(reduced, episode.X[0])
    exponents = np.exp(continuous_eigenvalues(reduced) * t[:, None])
    ahead = np.real((exponents * b) @ reduced.modes.T)
    Theta, Theta_next = Y.T, Y_next.T
    phi = whole.eigenfunctions(snapshots.X)
    xi = whole.left_eigenvectors.T  # ξ_j in column j, φ_j = Θ ξ_j
    K = np.linalg.pinv(Theta) @ Theta_next
    worst = linearity_error(whole, trajectory)
    by_hand = np.linalg.norm(whole.eigenfunctions(snapshots.X_next) - phi * whole.eigenvalues, axis=0) / np.linalg.norm(
        phi, axis=0
    )
    return [
        Equation("10–12", "X = [x₁ … x_m], X′ = [x₂ … x_{m+1}]", "Episodes.snapshots",
                 _gap(snapshots.X_next[:-1], snapshots.X[1:])),
        Equation("14–17", "A = X′X⁺, X = U Σ Vᵀ", "dmd, edmd", _gap(whole.A, Y_next @ np.linalg.pinv(Y))),
        Equation("18–23", "Ã = Uᵀ X′ V Σ⁻¹", "dmd(rank=r).A, edmd(rank=r).A", _gap(reduced.A, basis.T @ A @ basis)),
        Equation("18–23", "Ã W = W Λ", "LinearPredictor.eigenvalues, eigenvectors", _gap(reduced.A @ W, W * values)),
        Equation("18–23", "Φ = X′ V Σ⁻¹ W, A Φ = Φ Λ", "LinearPredictor.exact_modes, modes",
                 _gap(A @ modes, modes * values)),
        Equation("18–23", "b = Φ⁺ x₁", "amplitudes", _gap(b, np.linalg.pinv(modes) @ bound(episode.X[0]))),
        Equation("18–23", "x(t) = Φ exp(Ω t) b, Ω = ln Λ / Δt", "continuous_eigenvalues, reconstruct",
                 _gap(reconstruct(reduced, episode.X[0], t), ahead)),
        Equation("24–26", "y = Θᵀ(x), A_Y = Y′ Y⁺", "Lifting, edmd", _gap(whole.A @ Y, Y_next @ np.linalg.pinv(Y) @ Y)),
        Equation("27–31", "φ(x) = Θ(x) ξ", "LinearPredictor.eigenfunctions", _gap(phi, Theta @ xi)),
        Equation("27–31", "λ φ(x_k) = φ(x_{k+1})", "linearity_error", _gap(worst, by_hand)),
        Equation("27–31", "λ ξ = Θ⁺ Θ′ ξ", "LinearPredictor.left_eigenvectors", _gap(K @ xi, xi * whole.eigenvalues)),
    ]  # fmt: skip


def sides(trajectory: Episodes, lifting: Lifting) -> tuple[float, float]:
    """Return the median of ‖φ(x⁺) − λ φ(x)‖ / ‖φ(x)‖ over φ = ξᴴψ of left, and over φ = vᵀψ of right eigenvectors.

    Θ⁺Θ′ is Aᵀ: its right eigenvectors are the left ones of A. The right ones of A are modes, no eigenfunctions.
    """
    model = edmd(trajectory, lifting)
    snapshots = trajectory.snapshots()
    Z, Z_next = model.lift(snapshots.X), model.lift(snapshots.X_next)
    left = _linear(Z, Z_next, model.left_eigenvectors.T, model.eigenvalues)
    return left, _linear(Z, Z_next, model.eigenvectors, model.eigenvalues)


def _linear(
    Z: Float[np.ndarray, "M nz"],
    Z_next: Float[np.ndarray, "M nz"],
    V: Complex[np.ndarray, "nz nz"],
    values: Complex[np.ndarray, " nz"],
) -> float:
    phi = Z @ V
    return float(np.median(np.linalg.norm(Z_next @ V - phi * values, axis=0) / np.linalg.norm(phi, axis=0)))


def _gap(a: np.ndarray, b: np.ndarray) -> float:
    """Return ‖a − b‖ / ‖b‖."""
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))
