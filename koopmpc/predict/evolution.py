"""Whether an eigenfunction keeps its promise over a whole run: φ(x_k) = λᵏ φ(x₀)."""

import numpy as np
from jaxtyping import Float

from koopmpc.data.episodes import Episodes
from koopmpc.errors import DataError
from koopmpc.predict.linear import LinearPredictor
from koopmpc.predict.spectrum import same_names


def evolution_error(predictor: LinearPredictor, episodes: Episodes) -> Float[np.ndarray, " nz"]:
    """Return ‖φ(x_k) − λᵏ φ(x₀)‖ / ‖φ(x_k)‖, k = 0 … T, for each eigenfunction: 0 where it evolves linearly.

    The norm runs over all steps of all episodes; the order is that of ``predictor.eigenvalues``. One step is what
    `linearity_error` checks; here errors add up over the run.

    Parameters
    ----------
    predictor
        Autonomous: φ = ξᴴ ψ with ξᴴ A = λ ξᴴ.
    episodes
        Data of the same states, without inputs.

    Raises
    ------
    ShapeError
        The data have other states or inputs.
    DataError
        The predictor has inputs, an eigenfunction is 0 on all data, dt differs, or A is defective.

    References
    ----------
    Snyder & Song, "Koopman operator theory for nonlinear dynamic modeling using dynamic mode decomposition", 2021.
    """
    if predictor.nu + predictor.nw:
        raise DataError(
            "the predictor has inputs, and φ(x_k) = λᵏ φ(x₀) holds without; pass an autonomous fit, or use "
            "linearity_error"
        )
    same_names(predictor, episodes)
    error, size = np.zeros(predictor.nz), np.zeros(predictor.nz)
    for episode in episodes:
        phi = predictor.eigenfunctions(episode.X)
        with np.errstate(over="ignore", invalid="ignore"):
            promised = predictor.eigenvalues ** np.arange(len(phi))[:, None] * phi[0]
            error += np.sum(np.abs(phi - promised) ** 2, axis=0)
        size += np.sum(np.abs(phi) ** 2, axis=0)
    if (size == 0).any():
        raise DataError(
            f"eigenfunction {int(np.argmin(size))} is 0 in all snapshots; pass episodes that excite it"
        )
    return np.sqrt(error / size)
