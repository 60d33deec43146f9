"""Kernel EDMD: the observables are those of a kernel, and are never written down."""

from typing import Literal, Unpack

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.errors import DataError
from koopmpc.identify.fits.edmd import edmd
from koopmpc.identify.moments.read import ReadOptions
from koopmpc.identify.solve import Ridge
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.composed import Projected, Standardized
from koopmpc.lifting.radial import Gaussian, PolynomialKernel
from koopmpc.predict.predictors import LinearPredictor

_CUT = 1e-11  # eigenvalue of the kernel's matrix, relative to the largest, below which rounding decides


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

    The coordinates z are those of the kernel's own observables φ, k(x, y) = φ(x)ᵀφ(y), on the span of φ at the
    landmarks. Where every state of the data is a landmark, this is kernel EDMD; with fewer it is its Nyström
    approximation. All data enter the fit: they are read in parts, and memory and time go with the number of landmarks
    and not with the number of observables that the kernel stands for.

    Parameters
    ----------
    episodes
        As in `edmd`.
    kernel
        "polynomial", k = (1 + xᵀy)^degree: A has the eigenvalues of EDMD on all monomials up to that degree, where the
        landmarks are at least as many as these. "gaussian", k = exp(−‖x − y‖² / (2 width²)). In both, x stands for
        the states less their mean, in standard deviations, so that units do not matter.
    degree
        Degree of the polynomial kernel.
    width
        Width of the Gaussian kernel in standard deviations; by default the median distance of two landmarks.
    landmarks
        Number of states, drawn from the data at random, that span the observables; all states where the data hold no
        more.
    rank
        Largest number of coordinates z, those of the largest eigenvalues in Λ; by default all above 1e-11 of the
        largest.
    ridge, **options
        As in `edmd`.
    rng
        Generator or seed that draws the landmarks.

    Returns
    -------
    predictor
        Controllers take it like that of `edmd`. C is fitted by least squares, with the residual in
        ``report.state_residual``: a polynomial kernel holds the states exactly, a Gaussian one nearly.

    Raises
    ------
    DataError
        There is no such kernel, or a number is not above zero; the source can be read once only; the landmarks are
        all one state.

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
    centers = (_drawn(source, landmarks, checks.generator(rng)) - frame.mean) / frame.scale
    if kernel == "polynomial":
        inner: Lifting = PolynomialKernel(centers, degree)
    else:
        inner = Gaussian(centers, _median_distance(centers) if width is None else width)
    lifting = Standardized(inner, frame.mean, frame.scale)
    at_landmarks = lifting.bind(source.states)(centers * frame.scale + frame.mean)
    return edmd(source, Projected(lifting, _basis(at_landmarks, rank)), ridge=ridge, **options)


def _drawn(source: Source, count: int, rng: np.random.Generator) -> Float[np.ndarray, "m nx"]:
    """Return `count` different rows x_0 … x_{T−1} of the data, each as likely as any other, from one reading."""
    kept, keys = np.empty((0, source.nx)), np.empty(0)
    for part in source.parts():
        for episode in part.load():
            kept, keys = np.vstack([kept, episode.X[:-1]]), np.append(keys, rng.random(len(episode.X) - 1))
            first = np.sort(np.argsort(keys)[:count])  # the rows with the smallest keys, in the order of the data
            kept, keys = kept[first], keys[first]
    return np.unique(kept, axis=0)


def _basis(K: Float[np.ndarray, "m m"], rank: int | None) -> Float[np.ndarray, "m r"]:
    """Return V Λ^(−½) of K = V Λ Vᵀ, for the largest eigenvalues."""
    values, vectors = np.linalg.eigh((K + K.T) / 2)
    kept = np.flatnonzero(values > _CUT * values[-1])[::-1]
    if rank is not None:
        checks.count(rank, "rank")
        kept = kept[:rank]
    return vectors[:, kept] / np.sqrt(values[kept])


def _median_distance(centers: Float[np.ndarray, "m nx"]) -> float:
    """Return the median distance of two centres."""
    some = centers[:: max(1, len(centers) // 300)]
    distances = np.linalg.norm(some[:, None] - some, axis=2)[np.triu_indices(len(some), 1)]
    if not (distances > 0).any():
        raise DataError("the landmarks are all one state; pass data that move, or more landmarks")
    return float(np.median(distances[distances > 0]))
