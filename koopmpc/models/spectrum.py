"""Functions of the spectrum of a predictor: Ω = log Λ / dt, b = Φ⁺ψ(x₀), x(t) = Re Φ exp(Ωt) b, φ(x⁺) = λ φ(x).

References
----------
Tu et al., "On dynamic mode decomposition: theory and applications", J. Comput. Dyn. 1, 2014; Snyder & Song,
"Koopman operator theory for nonlinear dynamic modeling using dynamic mode decomposition", 2021.
"""

import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike
from scipy.linalg import lstsq

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.composed import Projected
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor

__all__ = [
    "amplitudes",
    "continuous_eigenvalues",
    "evolution_error",
    "linearity_error",
    "reconstruct",
]


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__


_ROUNDING = float(np.finfo(float).eps)
_ROWS = 4096  # evaluate the eigenfunctions of so many states at once, to bound the memory
_FITTED = "pass one that edmd returned"
_EPISODES = "pass Episodes, of collect or load_episodes"


def continuous_eigenvalues(predictor: LinearPredictor) -> Complex[np.ndarray, " nz"]:
    """Return ω = log(λ) / dt [rad/s], principal branch, in the order of ``predictor.eigenvalues``.

    λ = 0 gives −∞; a frequency beyond π/dt is folded back.
    """
    checks.members(predictor, "the predictor", ("eigenvalues", "modes", "point_names", "nu"), _FITTED)
    values = predictor.eigenvalues
    with np.errstate(divide="ignore"):
        growth = np.log(np.abs(values)) / predictor.dt
    return growth + 1j * (np.angle(values) / predictor.dt)


def amplitudes(predictor: LinearPredictor, x: ArrayLike) -> Complex[np.ndarray, " nz"]:
    """Return b = Φ⁺ ψ(x), the amplitude of each mode in the state x, or the best amplitudes over a whole run.

    Φ holds the modes in the lifted coordinates, one a column: the exact modes of a rank-truncated fit, else
    the eigenvectors of A. For a run b = argmin Σ_k ‖ψ(x_k) − Φ Λᵏ b‖², which depends less on the noise in x_0.

    Parameters
    ----------
    predictor
        Its `modes` are the state's rows of Φ.
    x
        (nx,), or (steps, nx): x_0, x_1, … of a run without input, one `dt` apart; with an embedding points ζ, as
        ``predictor.embed(episodes)`` has them.

    Raises
    ------
    ShapeError
        x has another number of columns than the predictor has states.
    """
    checks.members(predictor, "the predictor", ("eigenvalues", "modes", "point_names", "nu"), _FITTED)
    states, width = checks.array(x, "x"), len(predictor.point_names)
    modes, lifting = _lift_modes(predictor)
    if states.ndim == 1:
        z = lifting(checks.array(states, "x", (width,)))
        return lstsq(modes, z.astype(complex), cond=_ROUNDING * max(modes.shape), lapack_driver="gelsy")[0]
    Z = lifting(checks.array(states, "x", (None, width)))
    basis, R = np.linalg.qr(modes)  # the part of ψ(x_k) outside the span of Φ does not depend on b
    powers = np.power(predictor.eigenvalues, np.arange(len(Z))[:, None])
    stacked = (R * powers[:, None, :]).reshape(-1, modes.shape[1])
    coordinates = (Z @ basis.conj()).ravel()
    return lstsq(stacked, coordinates, cond=_ROUNDING * max(stacked.shape), lapack_driver="gelsy")[0]


def reconstruct(predictor: LinearPredictor, x0: ArrayLike, times: ArrayLike) -> Float[np.ndarray, "steps nx"]:
    """Return x(t) = Re Φ exp(Ωt) b, b = Φ⁺ ψ(x0): the motion without input at any times.

    Parameters
    ----------
    predictor
        Its inputs are taken as 0.
    x0
        (nx,), the state at t = 0; or (steps, nx), a run from t = 0 on, whose best amplitudes are taken; with an
        embedding points ζ.
    times
        (steps,) [s].

    Raises
    ------
    ShapeError
        x0 has another number of columns than the predictor has states, or the times are not a vector.
    """
    checks.members(predictor, "the predictor", ("eigenvalues", "modes", "point_names", "nu"), _FITTED)
    t = checks.array(times, "times", (None,))
    b = amplitudes(predictor, x0)
    with np.errstate(divide="ignore", invalid="ignore"):
        # exp(Ωt) = λ^(t/dt) on the principal branch, and 0^0 = 1
        growth = np.power(predictor.eigenvalues, t[:, None] / predictor.dt)
    return np.real((growth * b) @ predictor.modes.T).astype(np.float64)


def linearity_error(predictor: LinearPredictor, episodes: Episodes) -> Float[np.ndarray, " nz"]:
    """Return ‖φ(x⁺) − λ φ(x) − ξᴴB u‖ / ‖φ(x)‖ for each eigenfunction: 0 where it evolves linearly.

    The norm runs over all snapshot pairs; the order is that of ``predictor.eigenvalues``.

    Parameters
    ----------
    predictor
        φ = ξᴴ ψ with ξᴴ A = λ ξᴴ.
    episodes
        Data of the same states and inputs, best not those of the fit.

    Raises
    ------
    ShapeError
        The data have other states or inputs.
    DataError
        The data have another dt, an eigenfunction is 0 on all of them, or A is defective.
    """
    check_same_names(predictor, episodes)
    checks.members(episodes, "episodes", ("__iter__",), _EPISODES)
    forced = predictor.left_eigenvectors @ np.hstack([predictor.B, predictor.E])
    error, size = np.zeros(predictor.nz), np.zeros(predictor.nz)
    points = predictor.embed(episodes)
    for episode in points.driven() if predictor.nw else points:
        for first in range(0, len(episode), _ROWS):
            phi = predictor.eigenfunctions(episode.X[first : first + _ROWS + 1])
            gap = phi[1:] - phi[:-1] * predictor.eigenvalues - episode.U[first : first + _ROWS] @ forced.T
            error += np.sum(np.abs(gap) ** 2, axis=0)
            size += np.sum(np.abs(phi[:-1]) ** 2, axis=0)
    return _divide_errors(error, size)


def check_same_names(predictor: LinearPredictor | BilinearPredictor, episodes: Episodes | Source) -> None:
    """Raise if data and predictor differ in states, inputs, dt, or the disturbances of the predictor."""
    checks.members(predictor, "the model", ("states", "inputs", "dt"), "pass one that edmd or bilinear_edmd returned")
    checks.members(episodes, "episodes", ("states", "inputs", "dt"), _EPISODES)
    known = getattr(predictor, "disturbances", ())
    for model_names, data_names, what in (
        (predictor.states, episodes.states, "states"),
        (predictor.inputs, episodes.inputs, "inputs"),
        (known, episodes.disturbances if known else (), "disturbances"),
    ):
        if model_names != data_names:
            raise ShapeError(
                f"the episodes have {what} ({', '.join(data_names)}), the predictor has ({', '.join(model_names)}); "
                "pass data of the same plant"
            )
    if episodes.dt != predictor.dt:
        raise DataError(
            f"the episodes have dt {episodes.dt:g} s, the predictor {predictor.dt:g} s; resample one of them"
        )


def _lift_modes(predictor: LinearPredictor) -> tuple[Complex[np.ndarray, "nl nz"], Lifting]:
    if predictor.exact_modes is not None and isinstance(predictor.lifting, Projected):
        return predictor.exact_modes, predictor.lifting.lifting
    return predictor.eigenvectors, predictor.lifting


def evolution_error(predictor: LinearPredictor, episodes: Episodes) -> Float[np.ndarray, " nz"]:
    """Return ‖φ(x_k) − λᵏ φ(x₀)‖ / ‖φ(x_k)‖, k = 0 … T, for each eigenfunction: 0 where it evolves linearly.

    The norm runs over all steps of all episodes; the order is that of ``predictor.eigenvalues``. Here errors add up
    over the run, while `linearity_error` checks single steps.

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
    checks.members(predictor, "the predictor", ("eigenvalues", "modes", "point_names", "nu"), _FITTED)
    if predictor.nu + predictor.nw:
        raise DataError(
            "the predictor has inputs, and φ(x_k) = λᵏ φ(x₀) holds only without inputs; pass an autonomous fit, or use "
            "linearity_error"
        )
    check_same_names(predictor, episodes)
    checks.members(episodes, "episodes", ("__iter__",), _EPISODES)
    error, size = np.zeros(predictor.nz), np.zeros(predictor.nz)
    for episode in episodes:
        phi = predictor.eigenfunctions(episode.X)
        with np.errstate(over="ignore", invalid="ignore"):
            predicted = predictor.eigenvalues ** np.arange(len(phi))[:, None] * phi[0]
            error += np.sum(np.abs(phi - predicted) ** 2, axis=0)
        size += np.sum(np.abs(phi) ** 2, axis=0)
    return _divide_errors(error, size)


def _divide_errors(error: Float[np.ndarray, " nz"], size: Float[np.ndarray, " nz"]) -> Float[np.ndarray, " nz"]:
    """Return the root of the error as a share of the size, both sums of squares for each eigenfunction."""
    if (size == 0).any():
        raise DataError(f"eigenfunction {int(np.argmin(size))} is 0 in all snapshots; pass episodes that excite it")
    return np.sqrt(error / size)
