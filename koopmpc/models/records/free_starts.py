"""Simulation error with a free state at the start of each segment: multiple shooting for hidden states."""

import numpy as np
from jaxtyping import Float, Int

from koopmpc.models.records.hidden import (
    HiddenModel,
    RecordSegments,
    Sets,
    SimulationError,
    find_gap,
    list_states,
    start_states,
)
from koopmpc.models.shared.levenberg_marquardt import find_starts, minimise

_STEPS = 12  # Gauss-Newton steps for the states of the segments, at most
_SOFT = 1e-9  # weight of the states' own size in such a step, as a share of the mean of its diagonal
_FAR = 1e3  # a state beyond this many spreads has left the model
_LEAST = 1e-6  # ridge of the encoder that is fitted to the states found, as a share of its regressors


class FreeStartsError(SimulationError):
    """The mean squared error over segments, each from its best z_0, and its derivatives by E, H and V.

    With the least of each segment over z_0 (variable projection) gradients by z_0 vanish, and the Gauss-Newton matrix
    is its Schur complement, J_θᵀ J_θ − Σ_s J_θᵀ J_s (J_sᵀ J_s)⁻¹ J_sᵀ J_θ. T plays no part but as a first guess.

    References
    ----------
    Golub & Pereyra, "Separable nonlinear least squares: the variable projection method", Inverse Problems 19, 2003;
    Bock, "Recent advances in parameter identification techniques for O.D.E.", 1983 (multiple shooting).
    """

    def begin(self, model: HiddenModel, data: RecordSegments) -> Float[np.ndarray, "m n"]:
        """Return the z_0 of each segment that explains its outputs best."""
        return find_starts(
            lambda z: _errors_of(model, z, data),
            lambda z: self._step(model, z, data),
            start_states(model, data.points),
            steps=_STEPS,
            shares=(1.0, 0.3, 0.1, 0.03, 0.01),
            converged=1e-14,
        )

    def _step(self, model: HiddenModel, z: Float[np.ndarray, "m n"], data: RecordSegments) -> Float[np.ndarray, "m n"]:
        """Return the Gauss-Newton step of each segment's sum of squares by its z_0."""
        C, (m, n) = model.H[:, :-1], z.shape
        slope, square, D = np.zeros((m, n)), np.zeros((m, n, n)), np.tile(np.eye(n), (m, 1, 1))
        ahead = list_states(model, z, data.inputs)
        gap = find_gap(ahead[1:] @ C.T + model.H[:, -1], data)
        for k, u in enumerate(data.inputs):
            D = np.matmul(D, self._features(model, ahead[k], u)[1].swapaxes(1, 2))
            S = D @ C.T
            if data.low is not None:
                S = S * (gap[k] != 0.0)[:, None]
            slope += np.matmul(S, gap[k][..., None])[..., 0]
            square += np.matmul(S, S.swapaxes(1, 2))
        return -_solve_softly(square, slope[..., None])[..., 0]

    def _assemble(
        self,
        size: int,
        others: Int[np.ndarray, " width"],
        by_others: tuple[Float[np.ndarray, " width"], Float[np.ndarray, "width width"]],
        by_starts: tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n width"], Float[np.ndarray, "m n n"]],
        points: Float[np.ndarray, "m nzeta"],
    ) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p p"]]:
        """Return sums by E, H and V, those of z_0 taken out; by T they are zero."""
        (slope, both), (early, cross, square) = by_others, by_starts
        n = square.shape[1]
        joined = np.concatenate([early.reshape(-1, n, 1), cross], axis=2)
        follows = _solve_softly(square, joined)
        gradient, matrix = np.zeros(size), np.zeros((size, size))
        gradient[others] = slope - np.einsum("snw,sn->w", cross, follows[..., 0])
        matrix[np.ix_(others, others)] = both - np.tensordot(cross, follows[..., 1:], axes=([0, 1], [0, 1]))
        return gradient, matrix


def _solve_softly(square: Float[np.ndarray, "m n n"], right: Float[np.ndarray, "m n w"]) -> Float[np.ndarray, "m n w"]:
    """Return the solution for each matrix, with a little weight on its diagonal."""
    n = square.shape[1]
    weighed = square.copy()
    weighed[:, np.arange(n), np.arange(n)] += _SOFT * np.trace(square, axis1=1, axis2=2)[:, None] / n + 1e-300
    return np.asarray(np.linalg.solve(weighed, right), dtype=np.float64)


def shoot(model: HiddenModel, fitted: Sets, judged: Sets, iterations: int) -> tuple[HiddenModel, int]:
    """Return the model with E, H and V of least error from free starts, and T that gives these best; and its iteration.

    Where no step lowers the error of the judged segments, from free starts too, it is the model itself.
    """
    error, first = FreeStartsError(model), model.E.size + model.H.size
    free = np.delete(np.arange(model.parameters.size), np.arange(first, first + model.T.size))
    theta, steps = minimise(error, model.parameters, fitted, judged, iterations, free=free)
    if not steps:
        return model, 0
    found = model.with_parameters(theta)
    zeta = np.vstack([np.hstack([part.points, np.ones((len(part.points), 1))]) for part in fitted])
    z = np.vstack([error.begin(found, part) for part in fitted])
    gap = z - zeta @ found.T.T
    ridge = np.sqrt(len(zeta)) * np.append(np.full(zeta.shape[1] - 1, _LEAST), 0.0)
    rows, target = np.vstack([zeta, np.diag(ridge)]), np.vstack([gap, np.zeros((len(ridge), z.shape[1]))])
    turn = np.linalg.lstsq(rows, target, rcond=None)[0]
    theta = theta.copy()
    theta[first : first + model.T.size] += turn.T.ravel()
    return model.with_parameters(theta), steps


def _errors_of(model: HiddenModel, z: Float[np.ndarray, "m n"], data: RecordSegments) -> Float[np.ndarray, " m"]:
    """Return the sum of squares of each segment; inf where a state leaves the model."""
    ahead = list_states(model, z, data.inputs)[1:]
    errors = np.sum(find_gap(ahead @ model.H[:, :-1].T + model.H[:, -1], data) ** 2, axis=(0, 2))
    return np.where((np.abs(ahead) < _FAR).all(axis=(0, 2)), errors, np.inf)
