"""Detectability: which motions of s⁺ = F s that do not die out leave no trace in y = M s."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

TOLERANCE = (
    1e-6  # singular values below this share of the largest, or of |λ|; |λ| as near to 1 does not die out
)


class Hidden(NamedTuple):
    """A mode that y does not show: λ, and its direction s, of length 1."""

    eigenvalue: complex
    direction: Complex[np.ndarray, " n"]


def hidden(F: Float[np.ndarray, "n n"], M: Float[np.ndarray, "ny n"]) -> Hidden | None:
    """Return a mode with |λ| ≥ 1 for which [F − λ I; M] has less than full rank; None where (F, M) is detectable.

    For F = [A, B_d; 0, I] and M = [C, C_d], λ = 1 is the rank condition on [A − I, B_d; C, C_d]. Rows of M are
    scaled to length 1, so that units of y do not decide.

    References
    ----------
    Pannocchia & Rawlings, "Disturbance models for offset-free model-predictive control", AIChE Journal 49, 2003.
    """
    scaled = M / np.maximum(np.linalg.norm(M, axis=1, keepdims=True), 1e-300)
    for value in np.linalg.eigvals(F):
        if abs(value) < 1 - TOLERANCE:
            continue
        sigma, right = np.linalg.svd(np.vstack([F - value * np.eye(len(F)), scaled]))[1:]
        if sigma[-1] < TOLERANCE * max(sigma[0], abs(value)):
            return Hidden(complex(value), np.conj(np.asarray(right[-1], complex)))
    return None
