"""Fits of noisy states: total least squares, and the mean of the forward and the backward fit."""

import numpy as np
from jaxtyping import Complex, Float, Int
from scipy.linalg import sqrtm

from koopmpc.errors import DataError
from koopmpc.identify.solve import RegressionRows, Solution, orthonormal, solve
from koopmpc.predict.base import eigen


def denoised(
    rows: RegressionRows, exact: Int[np.ndarray, " e"], nz: int, directions: int, *, scaled: bool
) -> RegressionRows:
    """Return the rows projected on the leading directions that [ψ(x) ψ(x⁺)] span together.

    Least squares on the result is the total least squares solution: with D = [ψ(x) ψ(x⁺)] freed of the exact
    columns E, D ≈ L Σ Rᵀ and `directions` singular vectors L_r, the rows are multiplied by [E, L_r]ᵀ. This assumes
    noise that is white and equally large in all columns but E: relative to each observable's size where `scaled`,
    else in the data's own units.

    Parameters
    ----------
    rows
        P = [ψ(x) u]; T begins with ψ(x⁺), all of it inside the rows (`rest` is 0).
    exact
        The columns of P that hold no noise: inputs, a Constant.
    nz
        Number of observables.
    directions
        Number of directions that the signal spans, the Constant not counted.

    References
    ----------
    Hemati, Rowley, Deem & Cattafesta, "De-biasing the dynamic mode decomposition for applied Koopman spectral
    analysis of noisy datasets", Theor. Comput. Fluid Dyn. 31, 2017; exact columns: Van Huffel & Vandewalle, "The
    total least squares problem", SIAM 1991.
    """
    most = rows.samples - len(exact)
    if directions >= most:
        raise DataError(
            f'method "tls" with {rows.samples} snapshot pairs cannot tell noise from {directions} directions of '
            f"signal; pass a rank below {max(most, 1)}, or collect more"
        )
    noisy = np.setdiff1d(np.arange(nz), exact)
    E = orthonormal(rows.P[:, exact], float(np.finfo(float).eps * len(rows.P)))
    D = np.hstack([rows.P[:, noisy], rows.T[:, noisy]])
    if scaled:
        size = np.sqrt(np.sum(D.reshape(len(D), 2, -1) ** 2, axis=(0, 1)))
        D = D / np.tile(np.where(size > 0, size, 1.0), 2)
    L = np.linalg.svd(D - E @ (E.T @ D), full_matrices=False)[0][:, :directions]
    onto = np.hstack([E, L]).T
    return RegressionRows(onto @ rows.P, onto @ rows.T, rows.rest, rows.samples)


_DEFECTIVE = 1e7  # condition of the eigenvectors beyond which the principal root is taken
_REAL = 1e-6  # share of the size of A below which an imaginary part is rounding


def forward_backward(rows: RegressionRows, nz: int) -> Solution:
    """Return K = [Aᵀ; Bᵀ] of z⁺ = A z + B u with the A whose bias by noise cancels to first order.

    A_f is the fit of z⁺ by [z u], A_b that of z by [z⁺ u]: noise shrinks both, and A_b is A⁻¹. Of the square
    roots of A_f A_b⁻¹ the one next to A_f is taken. B is the least squares fit of z⁺ − A z by u.

    Parameters
    ----------
    rows
        P = [z u]; T = z⁺, all of it inside the rows (`rest` is 0).
    nz
        Number of columns of z.

    Raises
    ------
    DataError
        A_b is singular, or the square root is not real: the motion cannot be run backward from these data.

    References
    ----------
    Dawson, Hemati, Williams & Rowley, "Characterizing and correcting for the effect of sensor noise in the
    dynamic mode decomposition", Exp. Fluids 57, 2016.
    """
    now, U, ahead = rows.P[:, :nz], rows.P[:, nz:], rows.T
    forward = solve(rows)
    backward = solve(RegressionRows(np.hstack([ahead, U]), now, rows.rest, rows.samples))
    A = _root_next_to(forward.K[:nz].T, backward.K[:nz].T)
    B = solve(RegressionRows(U, ahead - now @ A.T, rows.rest, rows.samples)).K
    return Solution(np.vstack([A.T, B]), forward.rank, 0.0)


def _root_next_to(forward: Float[np.ndarray, "r r"], backward: Float[np.ndarray, "r r"]) -> Float[np.ndarray, "r r"]:
    """Return (A_f A_b⁻¹)^½ with the sign of each eigenvalue that A_f has along its eigenvector."""
    if np.linalg.cond(backward) > 1 / np.finfo(float).eps:
        raise DataError(
            'method "fb" needs a motion that can be run backward, and on these data a direction of ψ(x) dies in '
            'one step; pass a rank, or method="tls"'
        )
    square = np.linalg.solve(backward.T, forward.T).T
    squares, V = eigen(square)
    A: Complex[np.ndarray, "r r"]
    if np.linalg.cond(V) > _DEFECTIVE:
        A = np.asarray(sqrtm(square), dtype=np.complex128)
    else:
        W = np.linalg.inv(V)
        roots = np.sqrt(squares)
        along = np.einsum("ij,jk,ki->i", W, forward, V)
        A = (V * np.where(np.real(np.conj(roots) * along) < 0, -roots, roots)) @ W
    real = np.real(A)
    if not np.abs(A - real).max() <= _REAL * np.abs(A).max():
        raise DataError(
            'method "fb" has no real square root of A_f A_b⁻¹ on these data: an eigenvalue near 0 changed its sign '
            'in the noise; pass a smaller rank, or method="tls"'
        )
    return np.ascontiguousarray(real)
