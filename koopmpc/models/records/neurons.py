"""Where fits with neurons begin, the candidates for neurons and the choice among them, and an error without growth."""

from dataclasses import replace
from math import factorial

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base.errors import DataError
from koopmpc.models.records.forward import list_terms
from koopmpc.models.records.hidden import (
    HiddenModel,
    RecordSegments,
    Sets,
    SimulationError,
    read_features,
    start_states,
)

_FULL = 8  # of more past rows only the smooth part tells where the state begins
_SMOOTH = 3  # degree in time of that part
_DRAWN = 40  # candidates for neurons, of random directions
_SHARP = (1.0, 4.0, 16.0)  # slopes of candidates along the output and its differences, for each spread
_PLACES = (0.1, 0.5, 0.9)  # quantiles at which their bends lie
_SOFT = 1e-6  # weight of the diagonal where the best candidates are sought
WEIGHT = 1e5  # of the squared excess of an eigenvalue, beside the mean squared error in spreads²
_INSIDE = 1e-12  # an eigenvalue that is moved to one ends by this share inside
_DEFECTIVE = 1e8  # eigenvectors of a larger condition number do not tell eigenvalues apart


def draw_neurons(model: HiddenModel, data: RecordSegments, rng: np.random.Generator) -> Float[np.ndarray, "count n1"]:
    """Return candidates that bend along the outputs, their differences and random directions, where z has been."""
    z = _visit(model, data)
    if not len(z):
        raise DataError("no output moves, so there is nothing to learn; pass a record whose inputs move its outputs")
    n, A = model.order, model.E[:, 1 : 1 + model.order]
    found: list[np.ndarray] = []

    def add(direction: Float[np.ndarray, " n"], slope: float, place: float) -> None:
        size = float((z @ direction).std())
        if np.isfinite(size) and size > 0:
            found.append(np.append(direction, -place) * slope / size)

    for output in model.H:
        direction, place = output[:-1], -output[-1]
        for _ in range(n):
            along = z @ direction
            for slope in _SHARP:
                for at in (place, *np.quantile(along, _PLACES)):
                    add(direction, slope, float(at))
            direction, place = direction @ A - direction, 0.0
    for _ in range(_DRAWN):
        direction, slope = rng.standard_normal(n), 10 ** rng.uniform(0, 1.2)
        add(direction, float(slope), float(z[rng.integers(len(z))] @ direction))
    return np.array(found).reshape(-1, n + 1)


def _visit(model: HiddenModel, data: RecordSegments) -> Float[np.ndarray, "rows n"]:
    """Return the states of all steps of these segments, those that stay near the data."""
    z = start_states(model, data.points)
    found = [z]
    for u in data.inputs:
        z = read_features(model, z, u) @ model.E.T
        found.append(z)
    states = np.concatenate(found)
    return states[(np.abs(states) < 10 * np.abs(found[0]).max()).all(axis=1)]


def take_neurons(
    model: HiddenModel, data: Sets, drawn: Float[np.ndarray, "count n1"], most: int, noise: float
) -> Float[np.ndarray, "q n1"]:
    """Return the neurons that lower the simulation error most, one after the other, to first order in their weights.

    Forward orthogonal least squares on the sensitivities: a candidate gains gᵀ S⁻¹ g, g and S the gradient and the
    Gauss-Newton matrix of its weights after all other coefficients, and the neurons taken before, have adjusted.
    """
    wide = model.add_neurons(drawn)
    gradient, matrix = SimulationError(wide, noise).derivatives(wide.parameters, data)
    (n, width), count = wide.E.shape, len(drawn)
    places: Int[np.ndarray, "n w"] = np.arange(n * width, dtype=np.intp).reshape(n, width)
    matrix: Float[np.ndarray, "p p"] = matrix + _SOFT * np.diag(matrix.diagonal() + 1e-12)
    output = np.arange(n * width, n * width + model.H.size, dtype=np.intp)
    known: Int[np.ndarray, " known"] = np.concatenate([places[:, : width - count].ravel(), output])
    taken: list[int] = []
    while len(taken) < min(most, count):
        own: Int[np.ndarray, " known"] = np.concatenate([known, *(places[:, width - count + i] for i in taken)])
        inverse = np.linalg.pinv(matrix[np.ix_(own, own)], hermitian=True)
        gains = np.full(count, -1.0)
        for i in set(range(count)) - set(taken):
            new = places[:, width - count + i]
            cross = matrix[np.ix_(own, new)]
            left = gradient[new] - cross.T @ (inverse @ gradient[own])
            gains[i] = left @ np.linalg.lstsq(matrix[np.ix_(new, new)] - cross.T @ inverse @ cross, left, rcond=1e-9)[0]
        taken.append(int(np.argmax(gains)))
    return drawn[taken]


class ContainedError:
    """A simulation error plus w Σ max(0, |λᵢ| − 1)², λᵢ the eigenvalues of z ↦ A z without products and neurons.

    Neurons are bounded, so far from the data z⁺ is A z and a bounded rest. With |λᵢ| ≤ 1 no free run grows
    exponentially, whatever bounded inputs act. Its derivative is d|λ| = Re(λ̄ / |λ| wᴴ dA v), v and w the right and
    left eigenvectors with wᴴ v = 1.
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


def start_with_differences(ny: int, nu: int, order: int, delays: int) -> HiddenModel:
    """Return z = the outputs and their derivatives in time, one per row, which go on as polynomials in time do.

    The past rows give them by least squares. It is what every plant looks like where samples are fast.
    """
    owner = [i % ny for i in range(order)]
    rank = [i // ny for i in range(order)]
    E, H, T = np.zeros((order, 1 + order + nu)), np.zeros((ny, order + 1)), np.zeros((order, _size(ny, nu, delays) + 1))
    lags = -np.arange(delays + 1.0)[:, None]
    for i in range(order):
        own = [j for j in range(order) if owner[j] == owner[i]]
        powers = np.arange(len(own))
        derivatives = np.linalg.pinv(lags**powers / [factorial(int(p)) for p in powers])
        T[i, _rows_of(owner[i], ny, nu, delays)] = derivatives[rank[i]]
        for j in own:
            if rank[j] >= rank[i]:
                E[i, 1 + j] = 1 / factorial(rank[j] - rank[i])
        if rank[i] == 0:
            H[owner[i], i] = 1.0
    return HiddenModel(list_terms(order, nu, 1), E, H, T, np.full(order, np.inf))


def _size(ny: int, nu: int, delays: int) -> int:
    return ny + delays * (ny + nu)


def _rows_of(signal: int, ny: int, nu: int, delays: int) -> Int[np.ndarray, " rows"]:
    """Return the places in ζ of an output, newest first, or of an input, signals ny and more."""
    past = ny + np.arange(delays) * (ny + nu)
    return np.append(signal, past + nu + signal) if signal < ny else past + signal - ny


def smooth_basis(ny: int, nu: int, delays: int) -> Float[np.ndarray, "k nzeta"]:
    """Return orthonormal rows, of many past rows Legendre polynomials in time of each signal; of few all of ζ."""
    n = _size(ny, nu, delays)
    if delays <= _FULL:
        return np.eye(n)
    rows: list[np.ndarray] = []
    for signal in range(ny + nu):
        places = _rows_of(signal, ny, nu, delays)
        time = np.linspace(-1, 1, len(places))
        part = np.zeros((_SMOOTH + 1, n))
        part[:, places] = np.linalg.qr(np.polynomial.legendre.legvander(time, _SMOOTH))[0].T
        rows.append(part)
    return np.vstack(rows)
