"""What all fits share, against NumPy on a few rows: ridges, means, ranks, spans, units, misfits, a root of two fits."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.identify.fits.edmd import _nearest_root
from koopmpc.identify.regression import compute_scale_factor, read_regression, relative_misfit
from koopmpc.identify.solve import (
    RegressionRows,
    centre_products,
    column_norms,
    describe_solve,
    orthonormal_basis,
    project_onto,
    rounding_cutoff,
    scale_to_unit_norm,
    scaled_rank,
    solve,
    solve_path,
)
from tests.identify.plants import random_episodes

EPS = np.finfo(float).eps


def rows_of(seed=0, m=30, n=4, nt=2, constant=None, samples=None, rest=0.0):
    rng = np.random.default_rng(seed)
    P = rng.normal(size=(m, n)) * np.logspace(-2, 2, n) + 1.0
    if constant is not None:
        P[:, constant] = 1.0
    return RegressionRows(P, rng.normal(size=(m, nt)) + 3.0, np.full(nt, rest), samples or m, constant)


def shrunk(rows, ridge, light=()):
    """Return argmin ‖T − P K‖² + ridge ‖S K‖² with rows of their own for the penalty."""
    spread = np.linalg.norm(rows.P - (0 if rows.constant is None else rows.P.mean(axis=0)), axis=0)
    spread[list(light)] *= 1e-3
    penalty = np.sqrt(ridge) * np.diag(spread)
    P, T = np.vstack([rows.P, penalty]), np.vstack([rows.T, np.zeros((rows.P.shape[1], rows.T.shape[1]))])
    return np.linalg.lstsq(P, T, rcond=None)[0]


@pytest.mark.parametrize("constant", [None, 0, 3])
def test_each_ridge_of_a_path_is_the_least_squares_of_its_own_penalty(constant):
    rows = rows_of(constant=constant)
    ridges = (1e-3, 0.0, 2.0)
    for ridge, found in zip(ridges, solve_path(rows, ridges), strict=True):
        np.testing.assert_allclose(found.K, shrunk(rows, ridge), rtol=1e-7, atol=1e-10)
        assert (found.rank, found.ridge) == (4, ridge)
        np.testing.assert_allclose(found.K, solve(rows, ridge=ridge).K)
    np.testing.assert_allclose(solve(rows, ridge=0.5, light=[1, 2]).K, shrunk(rows, 0.5, [1, 2]), rtol=1e-7)
    np.testing.assert_array_equal(solve(rows, light=[1, 2]).K, solve(rows).K)  # without a ridge nothing is light


def test_unscaled_columns_shrink_by_the_ridge_itself_and_are_cut_by_their_own_size():
    rows = rows_of()
    K = np.linalg.solve(rows.P.T @ rows.P + 0.3 * np.eye(4), rows.P.T @ rows.T)
    np.testing.assert_allclose(solve(rows, ridge=0.3, scaled=False).K, K, rtol=1e-7)
    tiny = RegressionRows(rows.P * [1e-17, 1, 1, 1], rows.T, rows.rest, rows.samples)
    assert solve(tiny, scaled=False).rank == 3
    assert solve(tiny).rank == 4
    assert np.abs(solve(tiny, scaled=False).K[0]).max() < 1e-12


@pytest.mark.parametrize(("m", "n", "samples"), [(30, 4, 30), (30, 4, 1000), (3, 8, 3)])
def test_the_cut_is_rounding_of_so_many_numbers(m, n, samples):
    rows = rows_of(m=m, n=n, samples=samples)
    assert rounding_cutoff(rows) == EPS * max(samples, n)


def test_a_direction_below_the_cut_takes_the_minimum_norm():
    rng = np.random.default_rng(0)
    Q, V = np.linalg.qr(rng.normal(size=(30, 3)))[0], np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T = rng.normal(size=(30, 1))
    for share, rank in ((2 * 30 * EPS, 3), (0.5 * 30 * EPS, 2)):
        P = (Q * [1.0, 0.5, share]) @ V
        found = solve(RegressionRows(P, T, np.zeros(1), 30), scaled=False)
        assert found.rank == rank
        if rank == 2:
            np.testing.assert_allclose(found.K, V[:2].T @ ((Q[:, :2].T @ T) / [[1.0], [0.5]]), atol=1e-9)


def test_the_residual_counts_what_lies_outside_the_rows():
    rows, columns = rows_of(rest=5.0, nt=3, samples=90), np.array([2, 0])
    K = np.random.default_rng(1).normal(size=(4, 2))
    error = rows.T[:, columns] - rows.P @ K
    np.testing.assert_allclose(rows.residual(columns, K), np.sqrt((np.sum(error**2, axis=0) + 5.0) / 90))


def test_leading_targets_and_some_regressors_are_the_same_rows():
    rows = rows_of(nt=3, constant=2, rest=1.0)
    few = rows.keep_targets(2)
    np.testing.assert_array_equal(few.T, rows.T[:, :2])
    np.testing.assert_array_equal(few.rest, rows.rest[:2])
    for columns, constant in (([3, 2], 1), ([0, 1], None), ([2], 0)):
        part = rows.keep_regressors(np.array(columns))
        np.testing.assert_array_equal(part.P, rows.P[:, columns])
        assert part.constant == constant
    assert rows_of().keep_regressors(np.array([0, 1])).constant is None


def test_rows_about_their_means_are_deviations_and_what_does_not_move_is_zero():
    rows = rows_of(constant=1, rest=0.0)
    rows.P[:, 2], rows.T[:, 0] = 7.0, -2.0
    about = rows.subtract_means()
    assert about.constant is None
    expected = rows.P - rows.P.mean(axis=0)
    expected[:, [1, 2]] = 0.0
    np.testing.assert_allclose(about.P, expected, atol=1e-12)
    np.testing.assert_array_equal(about.P[:, [1, 2]], 0.0)
    np.testing.assert_array_equal(about.T[:, 0], 0.0)
    np.testing.assert_allclose(about.T[:, 1], rows.T[:, 1] - rows.T[:, 1].mean())
    outside = RegressionRows(rows.P, rows.T, np.array([1e-20, 4.0]), 30, 1).subtract_means()
    np.testing.assert_array_equal(outside.rest, [0.0, 4.0])  # of a target that does not move it is rounding
    moving = RegressionRows(rows.P, rows.T, np.array([1.0, 4.0]), 30, 1).subtract_means()
    np.testing.assert_array_equal(moving.rest, [1.0, 4.0])
    plain = rows_of()
    assert plain.subtract_means() is plain


@pytest.mark.parametrize("nu", [1, 2])
def test_products_of_deviations_span_the_same_models(nu):
    rng = np.random.default_rng(0)
    M, which = 40, np.array([1, 2])  # ψ = [1, a, b, c], of which a and b are multiplied
    psi = np.column_stack([np.ones(M), rng.normal(size=(M, 3)) + 5.0])
    U = rng.normal(size=(M, nu)) - 3.0
    products = [u[:, None] * psi[:, which] for u in U.T]
    rows = RegressionRows(np.hstack([psi, U, *products]), psi[:, :1], np.zeros(1), M, 0)
    about, back = centre_products(rows, nu, which)
    deviations = [(u - u.mean())[:, None] * (psi[:, which] - psi[:, which].mean(axis=0)) for u in U.T]
    np.testing.assert_allclose(about.P, np.hstack([psi, U, *deviations]), atol=1e-9)
    np.testing.assert_allclose(rows.P @ back, about.P, atol=1e-9)
    same, eye = centre_products(RegressionRows(rows.P, rows.T, rows.rest, M), nu, which)
    assert same.P is rows.P
    np.testing.assert_array_equal(eye, np.eye(len(eye)))


def test_ranks_and_condition_numbers_are_those_of_columns_of_unit_norm():
    rows = rows_of(m=50, n=5)
    P = rows.P * np.logspace(-6, 6, 5)
    assert scaled_rank(rows, P) == (5, pytest.approx(np.linalg.cond(P / np.linalg.norm(P, axis=0)), rel=1e-6))
    rank, condition = scaled_rank(rows, np.column_stack([P, 2 * P[:, 0]]))
    assert (rank, condition) == (5, np.inf)
    near = np.column_stack([P[:, 0], P[:, 0] + 1e-9 * np.linalg.norm(P[:, 0]) * rows.T[:, 0]])
    rank, condition = scaled_rank(rows, near)
    assert rank == 2
    assert condition == pytest.approx(np.linalg.cond(near / np.linalg.norm(near, axis=0)), rel=1e-3)
    assert scaled_rank(rows, P[:, :0]) == (0, 1.0)


def test_a_projection_is_that_on_the_span():
    rng = np.random.default_rng(0)
    basis, columns = rng.normal(size=(20, 3)) * [1e-8, 1.0, 1e8], rng.normal(size=(20, 4))
    exact = basis @ np.linalg.lstsq(basis, columns, rcond=1e-20)[0]
    twice = np.column_stack([basis, basis[:, 1], np.zeros(20)])
    for given in (basis, twice):
        np.testing.assert_allclose(project_onto(given, columns), exact, atol=1e-7)
    U = orthonormal_basis(twice, 1e-12)
    assert U.shape == (20, 3)
    np.testing.assert_allclose(U.T @ U, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(column_norms(columns), np.linalg.norm(columns, axis=0))
    np.testing.assert_allclose(column_norms(scale_to_unit_norm(twice)), [1, 1, 1, 1, 0])


@pytest.mark.parametrize(
    ("constant", "ridge", "options", "words"),
    [
        (None, 0.0, {}, "singular values cut at 6.7e-15 of the largest on unit-norm columns"),
        (None, 0.0, {"scaled": False}, "singular values cut at 6.7e-15 of the largest on unscaled columns"),
        (None, 0.5, {}, "ridge 0.5 on unit-norm columns"),
        (0, 0.5, {}, "ridge 0.5 on unit-norm deviations"),
        (0, 0.0, {}, "singular values cut at 6.7e-15 of the largest on unit-norm columns"),
        (None, 0.5, {"scaled": False}, "ridge 0.5 on unscaled columns"),
        (None, 0.5, {"light": [1]}, "ridge 0.5 on unit-norm columns, a millionth of it on states, Constant and inputs"),
    ],
)
def test_a_rule_says_what_was_done(constant, ridge, options, words):
    assert describe_solve(rows_of(constant=constant), ridge, ridge, **options) == words


def test_a_rule_of_cross_validation_says_so():
    rows = rows_of()
    assert describe_solve(rows, "gcv", 0.5).endswith(
        "ridge 0.5 on unit-norm columns, chosen by generalised cross-validation"
    )
    assert describe_solve(rows, "gcv", 0.0).endswith(", ridge 0, chosen by generalised cross-validation")


def test_the_units_of_the_data_are_a_triangle_with_their_second_moments():
    P = np.random.default_rng(0).normal(size=(40, 4)) * [1e-6, 1.0, 1e6, 3.0]
    R = compute_scale_factor(P, 160)
    size = np.linalg.norm(P, axis=0)
    np.testing.assert_allclose((R.T @ R) / np.outer(size, size), (P.T @ P) / 160 / np.outer(size, size), atol=1e-13)
    np.testing.assert_array_equal(R, np.triu(R))
    assert (R.diagonal() > 0).all()


def test_units_are_found_where_columns_are_zero_or_depend_on_each_other():
    P = np.random.default_rng(0).normal(size=(40, 2))
    R = compute_scale_factor(np.column_stack([P, np.zeros(40), 5 * P[:, 0]]), 40)
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
    regression = read_regression(data, lifting, None, "edmd")
    names = [*regression.lifting.names, *data.inputs]
    assert {names[i] for i in regression.affine_columns} == {*data.states, "1", *data.inputs}
    assert regression.columns == len(names)


@pytest.mark.parametrize("eigenvalues", [[0.9, -0.5, 0.3], [0.9, 0.9, -0.2], [0.5, 0.4 + 0.6j, 0.4 - 0.6j], [-0.5, -0.4 + 0.6j, -0.4 - 0.6j]])  # fmt: skip
def test_of_exact_fits_forward_and_backward_the_root_is_the_matrix(eigenvalues):
    rng = np.random.default_rng(2)
    V = rng.normal(size=(3, 3)) + 0j
    if np.iscomplex(eigenvalues).any():
        V[:, 1] += 1j * rng.normal(size=3)
        V[:, 2] = V[:, 1].conj()
    A = ((V * eigenvalues) @ np.linalg.inv(V)).real
    np.testing.assert_allclose(_nearest_root(A, np.linalg.inv(A)), A, atol=1e-9)
    np.testing.assert_allclose(_nearest_root(0.99 * A, 0.99 * np.linalg.inv(A)), A, atol=1e-9)  # shrunk alike


def test_a_root_of_a_defective_matrix_and_of_what_has_none():
    jordan = np.array([[0.5, 1.0], [0.0, 0.5]])
    np.testing.assert_allclose(_nearest_root(jordan, np.linalg.inv(jordan)), jordan, atol=1e-6)
    with pytest.raises(km.errors.DataError, match='method "fb" has no real square root'):
        _nearest_root(np.diag([0.5, 0.3]), np.diag([2.0, -3.0]))
    with pytest.raises(km.errors.DataError, match='method "fb" needs a motion that can be reversed'):
        _nearest_root(np.eye(2), np.diag([1.0, 1e-17]))
