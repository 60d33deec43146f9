"""Total least squares: noise is taken out of ψ(x) and ψ(x⁺) together, before they are regressed."""

import numpy as np
from jaxtyping import Float, Int

from koopmpc.errors import DataError
from koopmpc.identify.solve import Rows


def denoised(rows: Rows, exact: Int[np.ndarray, " e"], nz: int, directions: int, *, scaled: bool) -> Rows:
    """Return the rows projected on the leading directions that [ψ(x) ψ(x⁺)] span together.

    Least squares on the result is the total least squares solution: with D = [ψ(x) ψ(x⁺)] freed of the exact
    columns E, D ≈ L Σ Rᵀ and `directions` singular vectors L_r, the rows become [E, L_r]ᵀ of themselves. It is
    right where the noise is white and equally large in all columns but E; with `scaled` relative to each
    observable's size, else in the data's own units.

    Parameters
    ----------
    rows
        P = [ψ(x) u]; T begins with ψ(x⁺), all of it inside the rows (`rest` is 0).
    exact
        The columns of P that hold no noise: inputs, a Constant.
    nz
        Number of observables.
    directions
        How many the signal spans, the Constant not counted.

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
    E = _basis(rows.P[:, exact])
    D = np.hstack([rows.P[:, noisy], rows.T[:, noisy]])
    if scaled:
        size = np.sqrt(np.sum(D.reshape(len(D), 2, -1) ** 2, axis=(0, 1)))
        D = D / np.tile(np.where(size > 0, size, 1.0), 2)
    L = np.linalg.svd(D - E @ (E.T @ D), full_matrices=False)[0][:, :directions]
    onto = np.hstack([E, L]).T
    return Rows(onto @ rows.P, onto @ rows.T, rows.rest, rows.samples)


def _basis(P: Float[np.ndarray, "m e"]) -> Float[np.ndarray, "m r"]:
    """Return orthonormal columns that span those of P."""
    U, s, _ = np.linalg.svd(P, full_matrices=False)
    return U[:, s > np.finfo(float).eps * len(P) * s.max(initial=0.0)]
