"""Residual DMD: rounding on an exact subspace, large on spurious pairs, and the brute force of all snapshots."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.example_plants import one_step_pairs, random_episodes

CLOSED = km.State() + km.Expressions(lambda x: [x[0] ** 2], ("square",))


def manifold(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Proctor's KIC example: linear on [x₁, x₂, x₁²], eigenvalues 0.9, 0.5, 0.81."""
    return np.array([0.9 * x[0], 0.5 * x[1] + (0.81 - 0.5) * x[0] ** 2 + u.sum()])


def pendulum(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.array([x[0] + 0.1 * x[1], x[1] - 0.5 * np.sin(3 * x[0]) + 0.1 * u.sum()])


@pytest.mark.parametrize("nu", [0, 1, 2])
def test_an_exact_subspace_has_residuals_of_rounding(nu: int) -> None:
    data = one_step_pairs(manifold, 2, nu, 200)
    model = km.edmd(data, CLOSED)
    found = km.validate.residual_dmd(model, data)
    assert np.allclose(found.eigenvalues, [0.9, 0.81, 0.5], atol=1e-10)
    assert found.residuals.max() < 1e-13
    assert not found.spurious.any()
    assert found.samples == 200


def test_monomials_that_are_not_closed_are_flagged_and_the_true_pairs_are_not() -> None:
    data = one_step_pairs(manifold, 2, 0, 400)
    lifting = km.State() + km.Monomials(3)  # holds x₂², whose next value needs x₁⁴
    model = km.edmd(data, lifting)
    found = km.validate.residual_dmd(model, data)
    assert found.spurious.any()
    for true in (0.9, 0.5, 0.81):
        nearest = int(np.argmin(np.abs(found.eigenvalues - true)))
        assert found.residuals[nearest] < 1e-8
        assert not found.spurious[nearest]
    assert np.array_equal(found.spurious, found.residuals > found.tolerance)


@given(st.integers(0, 99), st.integers(0, 2))
def test_the_moments_give_the_brute_force_and_the_linearity_error(seed: int, nu: int) -> None:
    data = random_episodes(seed, [9, 40, 13], 2, nu)
    lifting = km.State() + km.Constant() + km.Monomials(2)
    model = km.edmd(data, lifting)
    held_out = random_episodes(seed + 1, [30, 8], 2, nu)
    found = km.validate.residual_dmd(model, held_out)
    pairs = held_out.snapshots()
    Z, Z_next = model.lift(pairs.X), model.lift(pairs.X_next)
    values, V = np.linalg.eig(model.A.T)
    gap = Z_next @ V - Z @ V * values - pairs.U @ model.B.T @ V
    brute = np.linalg.norm(gap, axis=0) / np.linalg.norm(Z @ V, axis=0)
    assert np.allclose(np.sort(found.residuals), np.sort(brute), rtol=1e-6, atol=1e-7)
    assert np.allclose(
        np.sort(found.residuals), np.sort(km.spectrum.linearity_error(model, held_out)), rtol=1e-6, atol=1e-7
    )


@given(st.integers(0, 99))
def test_what_inputs_do_in_a_bilinear_model_is_taken_off(seed: int) -> None:
    data = random_episodes(seed, [60, 40], 2, 2)
    lifting = km.State() + km.Constant() + km.Monomials(2)
    fitted = km.bilinear_edmd(data, lifting)
    rng = np.random.default_rng(seed)
    N = fitted.N + 0.1 * rng.standard_normal(fitted.N.shape)  # a Constant's column of N acts as B does
    model = km.BilinearPredictor(fitted.A, fitted.B, N, fitted.C, lifting, data.dt, data.states, data.inputs)
    found = km.validate.residual_dmd(model, data)
    pairs = data.snapshots()
    Z, Z_next = model.lift(pairs.X), model.lift(pairs.X_next)
    driven = Z_next - Z @ model.A.T - pairs.U @ model.B.T - np.einsum("mi,izw,mw->mz", pairs.U, N, Z)
    _, V = np.linalg.eig(model.A.T)
    brute = np.linalg.norm(driven @ V, axis=0) / np.linalg.norm(Z @ V, axis=0)
    assert np.allclose(np.sort(found.residuals), np.sort(brute), rtol=1e-8)


def test_measured_disturbances_are_inputs_here() -> None:
    rng = np.random.default_rng(0)
    A, G = 0.3 * rng.standard_normal((2, 2)), rng.standard_normal((2, 2))
    driven = one_step_pairs(lambda x, u: A @ x + G @ u, 2, 2, 60)
    model = km.LinearPredictor(
        A, G[:, :1], np.eye(2), km.State(), driven.dt, driven.states, ("u0",), E=G[:, 1:], disturbances=("u1",)
    )
    runs = [km.Episode(X=e.X, U=e.U[:, :1], W=e.U[:, 1:]) for e in driven]
    measured = km.Episodes(runs, driven.dt, driven.states, ("u0",), ("u1",))
    assert km.validate.residual_dmd(model, measured).residuals.max() < 1e-13


def test_an_eigenfunction_that_was_never_excited_is_spurious() -> None:
    model = km.LinearPredictor(np.diag([0.9, 0.5]), np.zeros((2, 0)), np.eye(2), km.State(), 0.01, ("x0", "x1"), ())
    flat = one_step_pairs(lambda x, u: np.array([0.9 * x[0], 0.0]), 2, 0, 30)
    still = km.Episodes([type(e)(X=e.X * [1, 0]) for e in flat], 0.01)
    found = km.validate.residual_dmd(model, still)
    assert found.residuals[0] < 1e-13
    assert np.isinf(found.residuals[1])
    assert np.array_equal(found.spurious, [False, True])


def test_a_defective_matrix_has_residuals_all_the_same() -> None:
    model = km.LinearPredictor([[0.9, 1], [0, 0.9]], np.zeros((2, 0)), np.eye(2), km.State(), 0.01, ("x0", "x1"), ())
    data = one_step_pairs(lambda x, u: model.A @ x, 2, 0, 30)
    assert km.validate.residual_dmd(model, data).residuals.max() < 1e-7


def test_data_of_something_else_are_refused() -> None:
    data = one_step_pairs(pendulum, 2, 1, 60)
    model = km.edmd(data, km.State())
    with pytest.raises(km.errors.ShapeError, match=r"the episodes have inputs \(\), the predictor has \(u0\)"):
        km.validate.residual_dmd(model, one_step_pairs(pendulum, 2, 0, 60))
    with pytest.raises(km.errors.DataError, match=r"the episodes have dt 0\.02 s, the predictor 0\.01 s"):
        km.validate.residual_dmd(model, km.Episodes(list(data), 0.02, data.states, data.inputs))
    with pytest.raises(km.errors.DataError, match="tolerance is 0; it must be above zero"):
        km.validate.residual_dmd(model, data, tolerance=0)


def test_a_source_is_read_as_its_episodes_are() -> None:
    data = one_step_pairs(pendulum, 2, 1, 60)
    model = km.edmd(data, km.State())
    streamed = km.validate.residual_dmd(model, km.data.Stream([data[:20], data[20:]]))
    assert np.allclose(streamed.residuals, km.validate.residual_dmd(model, data).residuals, rtol=1e-10)
