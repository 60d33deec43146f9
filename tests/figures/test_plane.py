"""A plane through the states, and eigenfunctions on it."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.figures.plane import eigenfunctions_on, plane_through

NAMES = ("a [m]", "b [m/s]", "c [A]")


def three_states() -> km.LinearPredictor:
    """A turn of (a, b) by 0.3 rad a step, and c halved."""
    A = np.zeros((3, 3))
    A[:2, :2] = 0.9 * np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    A[2, 2] = 0.5
    return km.LinearPredictor(A, np.ones((3, 1)), np.eye(3), km.State(), 0.1, NAMES, ["u"])


def test_the_grid_goes_through_the_point() -> None:
    plane = plane_through(NAMES, ("c", 0), [(-1, 1), (2, 3)], [7, 8, 9], points=3)
    assert plane.names == ("c [A]", "a [m]")
    assert plane.points[:4].tolist() == [[2, 8, -1], [2, 8, 0], [2, 8, 1], [2.5, 8, -1]]
    assert plane.points.shape == (9, 3)


def test_episodes_give_ranges_and_the_median() -> None:
    X = np.random.default_rng(0).normal(size=(51, 3))
    plane = plane_through(NAMES, (0, 1), km.Episodes([km.Episode(X=X[:20]), km.Episode(X=X[20:])], 0.1))
    assert (plane.across[0], plane.across[-1]) == (X[:, 0].min(), X[:, 0].max())
    assert (plane.up[0], plane.up[-1]) == (X[:, 1].min(), X[:, 1].max())
    assert plane.at == pytest.approx(np.median(X, axis=0))


def test_the_eigenfunctions_of_a_turn_are_the_polar_coordinates() -> None:
    model = three_states()
    plane = plane_through(NAMES, (0, 1), [(-1, 1), (-1, 1)], points=20)
    a, b = plane.points[:, 0], plane.points[:, 1]
    phi = eigenfunctions_on(model, [0, 1], plane).reshape(2, -1)
    assert np.abs(phi) == pytest.approx(np.tile(np.hypot(a, b) / np.sqrt(2), (2, 1)))
    for row, eigenvalue in zip(phi, model.eigenvalues, strict=False):
        turned = row / np.exp(1j * np.sign(eigenvalue.imag) * np.arctan2(b, a))
        assert np.ptp(np.angle(turned / turned[0])) < 1e-9
