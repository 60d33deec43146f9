"""What all fits share: units of the lifted data, relative misfits, and the square root of a forward and a backward fit."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.identify.fits.edmd import _root_next_to
from koopmpc.identify.regression import read, relative_misfit, scale_factor
from koopmpc.identify.solve import RegressionRows
from tests.identify.plants import random_episodes


def test_the_units_of_the_data_are_a_triangle_with_their_second_moments():
    P = np.random.default_rng(0).normal(size=(40, 4)) * [1e-6, 1.0, 1e6, 3.0]
    R = scale_factor(P, 160)
    size = np.linalg.norm(P, axis=0)
    np.testing.assert_allclose((R.T @ R) / np.outer(size, size), (P.T @ P) / 160 / np.outer(size, size), atol=1e-13)
    np.testing.assert_array_equal(R, np.triu(R))
    assert (R.diagonal() > 0).all()


def test_units_are_found_where_columns_are_zero_or_depend_on_each_other():
    P = np.random.default_rng(0).normal(size=(40, 2))
    R = scale_factor(np.column_stack([P, np.zeros(40), 5 * P[:, 0]]), 40)
    np.testing.assert_allclose(R[:, 2], [0, 0, 1, 0], atol=1e-12)
    assert np.isfinite(np.linalg.inv(R)).all()
    assert 1e-9 < R[3, 3] / np.linalg.norm(R[:, 3]) < 1e-7


def test_a_relative_misfit_is_the_mean_over_observables_of_those_to_their_own_size():
    rng = np.random.default_rng(1)
    P, T, K = rng.normal(size=(30, 3)), rng.normal(size=(30, 2)) * [1e-3, 1e3], rng.normal(size=(3, 2)) * [1e-3, 1e3]
    rest = np.array([1e-5, 0.0])
    error = np.sum((T - P @ K) ** 2, axis=0) + rest
    expected = np.sqrt(np.mean(error / (np.sum(T**2, axis=0) + rest)))
    assert relative_misfit(RegressionRows(P, T, rest, 90), K) == pytest.approx(expected)
    still = RegressionRows(P, np.zeros((30, 1)), np.zeros(1), 30)
    assert relative_misfit(still, np.zeros((3, 1))) == 0.0


def test_the_affine_columns_are_those_of_states_the_constant_and_all_inputs():
    data = random_episodes(0, [40], 2, 2)
    lifting = km.Monomials(2) + km.State() + km.Fourier(1) + km.Constant()
    regression = read(data, lifting, None, "edmd")
    names = [*regression.lifting.names, *data.inputs]
    assert {names[i] for i in regression.affine} == {*data.states, "1", *data.inputs}
    assert regression.columns == len(names)


@pytest.mark.parametrize("eigenvalues", [[0.9, -0.5, 0.3], [0.9, 0.9, -0.2], [0.5, 0.4 + 0.6j, 0.4 - 0.6j], [-0.5, -0.4 + 0.6j, -0.4 - 0.6j]])  # fmt: skip
def test_of_exact_fits_forward_and_backward_the_root_is_the_matrix(eigenvalues):
    rng = np.random.default_rng(2)
    V = rng.normal(size=(3, 3)) + 0j
    if np.iscomplex(eigenvalues).any():
        V[:, 1] += 1j * rng.normal(size=3)
        V[:, 2] = V[:, 1].conj()
    A = ((V * eigenvalues) @ np.linalg.inv(V)).real
    np.testing.assert_allclose(_root_next_to(A, np.linalg.inv(A)), A, atol=1e-9)
    np.testing.assert_allclose(_root_next_to(0.99 * A, 0.99 * np.linalg.inv(A)), A, atol=1e-9)  # shrunk alike


def test_a_root_of_a_defective_matrix_and_of_what_has_none():
    jordan = np.array([[0.5, 1.0], [0.0, 0.5]])
    np.testing.assert_allclose(_root_next_to(jordan, np.linalg.inv(jordan)), jordan, atol=1e-6)
    with pytest.raises(km.errors.DataError, match='method "fb" has no real square root'):
        _root_next_to(np.diag([0.5, 0.3]), np.diag([2.0, -3.0]))
    with pytest.raises(km.errors.DataError, match='method "fb" needs a motion that can be run backward'):
        _root_next_to(np.eye(2), np.diag([1.0, 1e-17]))
