"""Candidates for neurons of a hidden state, and the choice of those that lower its simulation error most."""

import numpy as np
from jaxtyping import Float, Int

from koopmpc.errors import DataError
from koopmpc.identify.records.hidden import (
    HiddenModel,
    RecordSegments,
    Sets,
    SimulationError,
    read_features,
    start_states,
)

_DRAWN = 40  # candidates for neurons, of random directions
_SHARP = (1.0, 4.0, 16.0)  # slopes of candidates along the output and its differences, for each spread
_PLACES = (0.1, 0.5, 0.9)  # quantiles at which their bends lie
_SOFT = 1e-6  # weight of the diagonal where the best candidates are sought


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
