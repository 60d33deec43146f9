"""A simulation error that keeps the linear part of a hidden state from growing."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from koopmpc.identify.records.hidden import HiddenModel, Sets, SimulationError

WEIGHT = 1e5  # of the squared excess of an eigenvalue, beside the mean squared error in spreads²
_INSIDE = 1e-12  # an eigenvalue that is moved to one ends by this share inside
_DEFECTIVE = 1e8  # eigenvectors of a larger condition number do not tell eigenvalues apart


class ContainedError:
    """A simulation error plus w Σ max(0, |λᵢ| − 1)², λᵢ the eigenvalues of z ↦ A z without products and neurons.

    Neurons are bounded, so far from the data z⁺ is A z and a bounded rest. With |λᵢ| ≤ 1 no free run grows
    exponentially, whatever bounded inputs act. Its derivative is d|λ| = Re(λ̄ / |λ| wᴴ dA v), v and w the right and
    left eigenvectors with wᴴ v = 1.

    Parameters
    ----------
    error
        What is minimised beside it.
    """

    def __init__(self, error: SimulationError) -> None:
        self._error = error
        n, width = error.model.E.shape
        self._n = n
        place = np.arange(n * width, dtype=np.intp).reshape(n, width)
        self._places: Int[np.ndarray, " n2"] = place[:, 1 : n + 1].ravel()

    def evaluate(self, theta: Float[np.ndarray, " p"], data: Sets) -> float:
        """Return the mean squared error and the weighted excess; inf where a state leaves the model."""
        radii = np.abs(np.linalg.eigvals(theta[self._places].reshape(self._n, self._n)))
        return self._error.evaluate(theta, data) + WEIGHT * float(np.sum(np.maximum(radii - 1, 0) ** 2))

    def derivatives(
        self, theta: Float[np.ndarray, " p"], data: Sets
    ) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p p"]]:
        """Return half the gradient of `evaluate`, and the Gauss-Newton matrix."""
        gradient, matrix = self._error.derivatives(theta, data)
        values, right = np.linalg.eig(theta[self._places].reshape(self._n, self._n))
        if not (np.abs(values) > 1).any():
            return gradient, matrix
        left = np.linalg.pinv(right)  # rows wᴴ
        for value, v, w in zip(values, right.T, left, strict=True):
            excess = abs(value) - 1
            if excess > 0:
                slope = np.real(np.conj(value) / abs(value) * np.outer(w, v)).ravel()
                gradient[self._places] += WEIGHT * excess * slope
                matrix[np.ix_(self._places, self._places)] += WEIGHT * np.outer(slope, slope)
        return gradient, matrix

    def project(self, theta: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return Θ with the eigenvalues of A that are above one moved to one, along their eigenvectors.

        A step near |λ| = 1 would otherwise be refused for an eigenvalue that it hardly needs.
        """
        A = theta[self._places].reshape(self._n, self._n)
        values, right = np.linalg.eig(A)
        size = np.abs(values)
        if not (size > 1).any() or not np.linalg.cond(right) < _DEFECTIVE:
            return theta
        inside = np.where(size > 1, values / (size * (1 + _INSIDE)), values)
        projected = theta.copy()
        projected[self._places] = np.real((right * inside) @ np.linalg.inv(right)).ravel()
        return projected


def contain(model: HiddenModel) -> HiddenModel:
    """Return the model with A divided by its spectral radius, where that is above one."""
    n = model.order
    radius = float(np.abs(np.linalg.eigvals(model.E[:, 1 : 1 + n])).max())
    if radius <= 1:
        return model
    E = model.E.copy()
    E[:, 1 : 1 + n] /= radius * (1 + _INSIDE)
    return replace(model, E=E)
