"""The stable matrix that is nearest in a quadratic misfit: descent over A = S⁻¹ X S with ‖X‖₂ ≤ ρ."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import solve_discrete_lyapunov

# Margins of the metric of a start, as shares of the radius: a small one is closer to the start, a large one gives a
# better conditioned metric.
_MARGINS = (1e-3, 1e-2, 1e-1)
_TRIAL, _STEPS = 60, 600  # descent steps from each start, and then from the best of them
_STALL, _GAIN = 30, 1e-3  # the descent stops where 30 steps reduce the misfit by less than this share


@dataclass(frozen=True, eq=False)
class Misfit:
    """f(A) = tr (A − A₀) G (A − A₀)ᵀ."""

    A0: Float[np.ndarray, "n n"]
    G: Float[np.ndarray, "n n"]

    def __call__(self, A: Float[np.ndarray, "n n"]) -> float:
        """Return the misfit f(A) of A, (n, n)."""
        error = A - self.A0
        return float(np.sum((error @ self.G) * error))


def radius_of(A: Float[np.ndarray, "n n"]) -> float:
    """Return the spectral radius, 0 for an empty matrix."""
    return float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))


def clipped(A: Float[np.ndarray, "n n"], radius: float) -> Float[np.ndarray, "n n"]:
    """Return A with its eigenvalues outside the circle moved onto it; A ρ / |λ|max where A is nearly defective."""
    result = np.linalg.eig(A)
    values, V = np.asarray(result.eigenvalues), np.asarray(result.eigenvectors)
    size = np.abs(values)
    if np.linalg.cond(V) < 1e8:
        kept = np.where(size > radius, values * radius / np.where(size > 0, size, 1.0), values)
        moved = np.ascontiguousarray(((V * kept) @ np.linalg.inv(V)).real)
        if radius_of(moved) <= radius * (1 + 1e-9):
            return moved
    return A * (radius / size.max())


def nearest(misfit: Misfit, radius: float, starts: list[Float[np.ndarray, "n n"]]) -> Float[np.ndarray, "n n"]:
    """Return A with |λ(A)| ≤ radius and f(A) no larger than at any start.

    A matrix is stable exactly if some S makes S A S⁻¹ a contraction, so projected gradient steps with momentum
    (restarted where f would rise) move S and X = S A S⁻¹, X clipped to ‖X‖₂ ≤ radius by its singular values. The
    problem is not convex: the result is the best of several starts, and a local optimum.

    References
    ----------
    Gillis, Karow & Sharma, "Approximating the nearest stable discrete-time system", Linear Algebra Appl. 573, 2019;
    with data: Mamakoukas, Xherija & Murphey, "Memory-efficient learning of stable linear dynamical systems for
    prediction and control", NeurIPS 2020.
    """
    n = len(misfit.A0)
    runs = [_Descent(misfit, radius, np.eye(n), misfit.A0)]
    for start in starts:
        S = _metric(start, radius)
        runs.append(_Descent(misfit, radius, S, S @ start @ np.linalg.inv(S)))
    for run in runs:
        run.go(_TRIAL)
    best = min(runs, key=lambda run: run.value)
    best.go(_STEPS)
    candidates = [inside(A, radius) for A in (best.A, *starts)]
    return min(candidates, key=misfit)


def inside(A: Float[np.ndarray, "n n"], radius: float) -> Float[np.ndarray, "n n"]:
    """Return A, scaled down until no eigenvalue lies outside the circle, not even by rounding."""
    for _ in range(5):
        size = radius_of(A)
        if size <= radius:
            break
        A = A * (radius / size * (1 - 1e-15))
    return A


class _Descent:
    """Projected gradient descent with momentum on (S, X); the misfit `value` never rises."""

    def __init__(self, misfit: Misfit, radius: float, S: Float[np.ndarray, "n n"], X: Float[np.ndarray, "n n"]) -> None:
        self._misfit, self._radius = misfit, radius
        self._S, self._X = S, _ball(X, radius)
        self._old = self._S, self._X
        self._momentum = 1.0
        self.A = np.linalg.solve(S, self._X @ S)
        self.value = misfit(self.A)
        largest = float(np.linalg.eigvalsh(misfit.G)[-1])
        self._step = 0.5 / max(largest * float(np.linalg.cond(S)) ** 2, 1e-300)

    def go(self, steps: int) -> None:
        """Take at most `steps` steps; stop earlier where the misfit stalls."""
        history = [self.value]
        for _ in range(steps):
            if not self._advance():
                return
            history.append(self.value)
            if len(history) > _STALL and history[-_STALL] - self.value <= _GAIN * self.value:
                return

    def _advance(self) -> bool:
        ahead = 0.5 * (1 + np.sqrt(1 + 4 * self._momentum**2))
        beta = (self._momentum - 1) / ahead
        S, X = (now + beta * (now - old) for now, old in zip((self._S, self._X), self._old, strict=True))
        if self._try(S, X):
            self._momentum, self._step = ahead, 1.1 * self._step
            return True
        self._momentum = 1.0
        for _ in range(40):
            if self._try(self._S, self._X):
                return True
            self._step /= 2
        return False

    def _try(self, S: Float[np.ndarray, "n n"], X: Float[np.ndarray, "n n"]) -> bool:
        """Take a step from (S, X); keep it and return True where f falls, else return False."""
        inverse = np.linalg.inv(S)
        A = inverse @ X @ S
        slope = inverse.T @ (2 * (A - self._misfit.A0) @ self._misfit.G)
        S_new = S - self._step * (X.T @ slope - slope @ A.T)
        X_new = _ball(X - self._step * slope @ S.T, self._radius)
        A_new = np.linalg.solve(S_new, X_new @ S_new)
        value = self._misfit(A_new)
        if not value < self.value:
            return False
        self._old = self._S, self._X
        self._S, self._X, self.A, self.value = S_new, X_new, A_new, value
        return True


def _ball(X: Float[np.ndarray, "n n"], radius: float) -> Float[np.ndarray, "n n"]:
    """Return the nearest matrix with ‖X‖₂ ≤ radius; only singular values above it are needed."""
    values, V = np.linalg.eigh(X.T @ X)
    large = values > radius**2
    W = V[:, large]
    return X - (X @ W) * (1 - radius / np.sqrt(values[large])) @ W.T


def _metric(A: Float[np.ndarray, "n n"], radius: float) -> Float[np.ndarray, "n n"]:
    """Return S = P^½, AᵀP A ⪯ (ρ (1 + margin))² P, with the least margin that leaves P well conditioned."""
    S = np.eye(len(A))
    for margin in _MARGINS:
        P = solve_discrete_lyapunov((A / (radius * (1 + margin))).T, np.eye(len(A)))
        values, vectors = np.linalg.eigh(0.5 * (P + P.T))
        if values[0] > 0 and values[-1] < 1e6 * values[0]:
            return (vectors * np.sqrt(values / values[0])) @ vectors.T
    return S
