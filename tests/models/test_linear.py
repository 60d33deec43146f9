"""LinearPredictor: the recursion, the re-lifted map, the linearisation, and what it refuses."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.example_plants import random_predictor

LIFTING = km.State() + km.Constant() + km.Fourier(1)


@given(st.integers(1, 4), st.integers(0, 2), st.integers(0, 20), st.integers(0, 999))
def test_on_the_state_itself_a_rollout_is_the_linear_recursion(nx: int, nu: int, T: int, seed: int) -> None:
    model = random_predictor(seed, nx, nu)
    rng = np.random.default_rng(seed)
    x, U = rng.standard_normal(nx), rng.standard_normal((T, nu))
    X = model.rollout(x, U)
    assert X.shape == (T + 1, nx)
    for k, u in enumerate(U):
        assert np.array_equal(X[0], x) or k
        x = model.A @ x + model.B @ u
        assert np.allclose(X[k + 1], x, atol=1e-12)


@given(st.integers(0, 999))
def test_the_lift_happens_once_at_the_start(seed: int) -> None:
    model = random_predictor(seed, 2, 1, LIFTING)
    rng = np.random.default_rng(seed)
    x, U = rng.standard_normal(2), rng.standard_normal((7, 1))
    z = model.lift(x)
    X = model.rollout(x, U)
    assert np.array_equal(X[0], x)
    for k, u in enumerate(U):
        z = model.A @ z + model.B @ u
        assert np.allclose(X[k + 1], model.C @ z, atol=1e-12)


@given(st.integers(0, 2), st.integers(0, 999))
def test_the_step_map_is_re_lifted(nu: int, seed: int) -> None:
    model = random_predictor(seed, 2, nu, LIFTING + km.Monomials(2))
    rng = np.random.default_rng(seed)
    plant = model.step_map()
    assert (plant.states, plant.inputs, plant.dt) == (model.states, model.inputs, model.dt)
    x, U = rng.standard_normal(2), rng.standard_normal((4, nu))
    expected = model.C @ (model.A @ model.lift(x) + model.B @ U[0])
    assert np.allclose(plant(x, U[0]), expected, atol=1e-12)
    assert np.allclose(plant.rollout(x, U[:1])[1], model.rollout(x, U[:1])[1], atol=1e-12)


def test_a_linear_map_is_its_own_linearisation() -> None:
    model = random_predictor(0, 3, 2)
    affine = km.LinearPredictor.local(model.step_map(), [1, 2, 3], [0.5, -1])
    assert np.allclose(affine.A[:3, :3], model.A, atol=1e-14)
    assert np.allclose(affine.A[:3, 3], 0, atol=1e-14)
    assert np.allclose(affine.B[:3], model.B, atol=1e-14)
    assert affine.lifting.names == (*model.states, "1")
    assert affine.report is None


def test_a_linearisation_is_tangent_away_from_an_equilibrium() -> None:
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    F = ca.Function("F", [x, u], [ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * ca.sin(x[0]) * u)])
    plant = km.StepMap(F, 0.1)
    at, push = np.array([0.7, -0.3]), np.array([0.4])
    model = km.LinearPredictor.local(plant, at, push)
    assert np.allclose(model.rollout(at, [push])[1], plant(at, push), atol=1e-14)
    sizes = np.array([1e-2, 1e-3])
    gaps = []
    for h in sizes:
        near = at + h * np.array([0.6, 0.8])
        gaps.append(np.linalg.norm(model.rollout(near, [push + h])[1] - plant(near, push + h)))
    assert np.log10(gaps[0] / gaps[1]) == pytest.approx(2, abs=0.1)  # the error falls with the square


@given(st.integers(0, 999))
def test_eigenfunctions_evolve_by_their_eigenvalues(seed: int) -> None:
    model = random_predictor(seed, 3, 0)
    rng = np.random.default_rng(seed)
    X = rng.standard_normal((10, 3))
    phi, ahead = model.eigenfunctions(X), model.eigenfunctions(X @ model.A.T)
    scale = np.linalg.cond(model.eigenvectors)
    assert np.allclose(ahead, phi * model.eigenvalues, atol=1e-12 * scale)
    assert np.allclose((phi @ model.modes.T).real, X, atol=1e-12 * scale)  # x = Σ φ_j(x) v_j
    assert np.all(np.diff(np.abs(model.eigenvalues)) <= 1e-12)


def test_a_defective_model_has_no_eigenfunctions() -> None:
    model = km.LinearPredictor([[0, 1], [0, 0]], np.empty((2, 0)), np.eye(2), km.State(), 0.1, ("a", "b"), ())
    assert np.array_equal(model.eigenvalues, [0, 0])
    with pytest.raises(km.errors.DataError, match="A is defective: its eigenvectors do not span"):
        model.eigenfunctions([[1, 2]])


def test_shapes_that_do_not_fit_are_refused() -> None:
    names = {"states": ("a", "b"), "inputs": ("u",), "dt": 0.1}
    with pytest.raises(km.errors.ShapeError, match=r"A has shape \(3, 3\), but"):
        km.LinearPredictor(np.eye(3), np.ones((3, 1)), np.ones((2, 3)), km.State(), **names)
    with pytest.raises(km.errors.ShapeError, match=r"B has shape \(2, 2\), expected \(2, 1\)"):
        km.LinearPredictor(np.eye(2), np.ones((2, 2)), np.eye(2), km.State(), **names)
    with pytest.raises(km.errors.ShapeError, match=r"C has shape \(1, 2\), expected \(2, 2\)"):
        km.LinearPredictor(np.eye(2), np.ones((2, 1)), np.ones((1, 2)), km.State(), **names)
    with pytest.raises(km.errors.DataError, match="A holds 1 NaN or inf"):
        km.LinearPredictor([[np.nan, 0], [0, 1]], np.ones((2, 1)), np.eye(2), km.State(), **names)
    with pytest.raises(km.errors.ShapeError, match=r"exact_modes has shape .* it needs a Projected lifting"):
        km.LinearPredictor(
            np.eye(2), np.ones((2, 1)), np.eye(2), km.State(), **names, exact_modes=np.eye(2).astype(complex)
        )
    projected = km.lifting.Projected(km.State(), np.ones((2, 1)))
    with pytest.raises(km.errors.ShapeError, match="exact_modes has shape"):
        km.LinearPredictor([[1]], [[1]], [[1], [1]], projected, **names, exact_modes=np.ones((3, 1), dtype=complex))


def test_rollout_and_lift_refuse_wrong_shapes() -> None:
    model = random_predictor(0, 2, 1)
    with pytest.raises(km.errors.ShapeError, match=r"U has shape \(3, 2\), expected \(any, 1\)"):
        model.rollout([0, 0], np.zeros((3, 2)))
    with pytest.raises(km.errors.ShapeError, match=r"x0 has shape \(3,\), expected \(2,\)"):
        model.rollout([0, 0, 0], np.zeros((3, 1)))
    with pytest.raises(km.errors.DataError, match="x0 holds 1 NaN"):
        model.rollout([0, np.nan], np.zeros((3, 1)))
    with pytest.raises(km.errors.ShapeError, match="has 3 states, the lifting was bound to 2"):
        model.lift([0, 0, 0])


def test_the_model_keeps_no_hold_on_the_callers_arrays() -> None:
    A = np.eye(2)
    model = km.LinearPredictor(A, np.ones((2, 1)), np.eye(2), km.State(), 0.1, ("a", "b"), ("u",))
    A[:] = 7
    assert np.array_equal(model.A, np.eye(2))
