"""Kernel EDMD: a kernel defines the observables, without a formula for each."""

from typing import Literal, Unpack

import numpy as np
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.composed import Projected, Standardized
from koopmpc.lifting.radial import Gaussian, PolynomialKernel
from koopmpc.models.fits.edmd import edmd
from koopmpc.models.moments.read import ReadOptions
from koopmpc.models.moments.solve import Ridge
from koopmpc.models.predictors import LinearPredictor

_CUT = 1e-11  # drop eigenvalues of the kernel's matrix below this share of the largest: they are rounding errors


def kernel_edmd(
    episodes: Episodes | Source,
    kernel: Literal["polynomial", "gaussian"] = "gaussian",
    *,
    degree: int = 3,
    width: float | None = None,
    landmarks: int = 300,
    rank: int | None = None,
    ridge: Ridge = 0.0,
    rng: np.random.Generator | int = 0,
    **options: Unpack[ReadOptions],
) -> LinearPredictor:
    """Fit z⁺ = A z + B u, z = Λ^(−½) Vᵀ k(x, landmarks), where k(landmarks, landmarks) = V Λ Vᵀ.

    A kernel k(x, y) = φ(x)ᵀφ(y) has observables φ, and z are the coordinates of φ(x) in the span of φ at the landmarks.
    If every state of the data is a landmark, this is kernel EDMD; with fewer landmarks it is its Nyström approximation.
    All data enter the fit in parts. Memory and time depend on the number of landmarks, not on the number of observables
    in φ.

    Parameters
    ----------
    episodes
        As in `edmd`.
    kernel
        "polynomial", k = (1 + xᵀy)^degree: with at least as many landmarks as there are monomials up to that degree, A
        has the eigenvalues of EDMD on these monomials. "gaussian", k = exp(−‖x − y‖² / (2 width²)). In both, x are
        deviations of the states from their mean in standard deviations, so that units do not matter.
    degree
        Degree of the polynomial kernel.
    width
        Width of the Gaussian kernel in standard deviations; by default the median distance of two landmarks.
    landmarks
        Number of states that are drawn from the data at random; all states if the data hold no more.
    rank
        Largest number of coordinates z, which belong to the largest eigenvalues in Λ; by default all eigenvalues above
        1e-11 of the largest are used.
    ridge, **options
        As in `edmd`.
    rng
        Generator or seed that draws the landmarks.

    Returns
    -------
    predictor
        Controllers accept it like that of `edmd`. C is fitted by least squares, with the residual in
        ``report.state_residual``. A polynomial kernel represents the states exactly, a Gaussian one nearly.

    Raises
    ------
    DataError
        There is no such kernel; a number is not above zero; the source can be read only once; all landmarks are the
        same state.

    Warns
    -----
    FitWarning
        As in `edmd`.

    References
    ----------
    Williams, Rowley & Kevrekidis, "A kernel-based method for data-driven Koopman spectral analysis", J. Comput. Dyn. 2,
    2015. Nyström: Williams & Seeger, NIPS 13, 2001; for the Koopman operator Meanti et al., NeurIPS 36, 2023.
    """
    if not checks.among(kernel, ("polynomial", "gaussian")):
        raise DataError(f'kernel is {kernel!r}; pass "polynomial" or "gaussian"')
    checks.count(landmarks, "landmarks")
    source = source_of(episodes)
    if not source.replayable:
        raise DataError(
            "a stream is read once, and kernel_edmd needs it for its landmarks first; save it, and pass that"
        )
    frame = Standardized.of(source, PolynomialKernel(np.ones((1, source.nx)), 1))
    centers = (_draw_landmarks(source, landmarks, checks.generator(rng)) - frame.mean) / frame.scale
    if kernel == "polynomial":
        inner: Lifting = PolynomialKernel(centers, degree)
    else:
        inner = Gaussian(centers, _median_distance(centers) if width is None else width)
    lifting = Standardized(inner, frame.mean, frame.scale)
    at_landmarks = lifting.bind(source.states)(centers * frame.scale + frame.mean)
    return edmd(source, Projected(lifting, _kernel_basis(at_landmarks, rank)), ridge=ridge, **options)


def _draw_landmarks(source: Source, count: int, rng: np.random.Generator) -> Float[np.ndarray, "m nx"]:
    """Return up to `count` different states x_0 … x_{T−1}, drawn with equal probability in one pass over the data."""
    rows, keys = np.empty((0, source.nx)), np.empty(0)
    for part in source.parts():
        for episode in part.load():
            rows, keys = np.vstack([rows, episode.X[:-1]]), np.append(keys, rng.random(len(episode.X) - 1))
            smallest = np.sort(np.argsort(keys)[:count])  # the rows with the smallest keys, in the order of the data
            rows, keys = rows[smallest], keys[smallest]
    return np.unique(rows, axis=0)


def _kernel_basis(K: Float[np.ndarray, "m m"], rank: int | None) -> Float[np.ndarray, "m r"]:
    """Return V Λ^(−½) of K = V Λ Vᵀ, for the largest eigenvalues."""
    values, vectors = np.linalg.eigh((K + K.T) / 2)
    largest = np.flatnonzero(values > _CUT * values[-1])[::-1]
    if rank is not None:
        checks.count(rank, "rank")
        largest = largest[:rank]
    return vectors[:, largest] / np.sqrt(values[largest])


def _median_distance(centers: Float[np.ndarray, "m nx"]) -> float:
    """Return the median distance of two centres."""
    sample = centers[:: max(1, len(centers) // 300)]
    distances = np.linalg.norm(sample[:, None] - sample, axis=2)[np.triu_indices(len(sample), 1)]
    if not (distances > 0).any():
        raise DataError("all landmarks are the same state; pass data that move, or more landmarks")
    return float(np.median(distances[distances > 0]))
