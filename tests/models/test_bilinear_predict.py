"""BilinearPredictor: its recursion, its re-lifted map, its file."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.example_plants import random_predictor

LIFTING = km.State() + km.Fourier(1)


def random_bilinear(seed: int, nx: int, nu: int) -> km.BilinearPredictor:
    """Return the linear predictor of this seed, with small products."""
    linear = random_predictor(seed, nx, nu, LIFTING)
    N = 0.3 * np.random.default_rng(seed).standard_normal((nu, linear.nz, linear.nz))
    return km.BilinearPredictor(linear.A, linear.B, N, linear.C, LIFTING, linear.dt, linear.states, linear.inputs)


@given(st.integers(1, 3), st.integers(1, 3), st.integers(0, 999))
def test_with_the_input_held_it_is_a_linear_predictor(nx: int, nu: int, seed: int) -> None:
    model = random_bilinear(seed, nx, nu)
    rng = np.random.default_rng(seed)
    x, u = rng.standard_normal(nx), rng.uniform(-1, 1, nu)
    A = model.A + sum(u[i] * model.N[i] for i in range(nu))
    linear = km.LinearPredictor(A, model.B, model.C, LIFTING, model.dt, model.states, model.inputs)
    U = np.tile(u, (6, 1))
    assert np.allclose(model.rollout(x, U), linear.rollout(x, U), rtol=1e-10, atol=1e-10)
    assert np.allclose(model.step_map()(x, u), linear.step_map()(x, u), rtol=1e-10, atol=1e-10)


@given(st.integers(0, 999))
def test_the_step_map_lifts_again_at_every_step(seed: int) -> None:
    model = random_bilinear(seed, 2, 1)
    rng = np.random.default_rng(seed)
    x, U = rng.standard_normal(2), rng.uniform(-1, 1, (4, 1))
    X = model.step_map().rollout(x, U)
    for k, u in enumerate(U):
        assert np.allclose(X[k + 1], model.rollout(X[k], [u])[1], atol=1e-12)
    assert model.step_map().states == model.states


def test_without_products_it_is_the_linear_predictor() -> None:
    linear = random_predictor(0, 2, 1, LIFTING)
    zero = np.zeros((1, linear.nz, linear.nz))
    model = km.BilinearPredictor(linear.A, linear.B, zero, linear.C, LIFTING, linear.dt, linear.states, linear.inputs)
    U = np.ones((10, 1))
    assert np.allclose(model.rollout([1, 2], U), linear.rollout([1, 2], U), atol=1e-12)
    assert np.array_equal(model.eigenvalues, linear.eigenvalues)
    assert np.array_equal(model.lift([1, 2]), linear.lift([1, 2]))


def test_it_comes_back_from_a_file_to_the_bit(tmp_path: Path) -> None:
    model = random_bilinear(1, 2, 2)
    model.save(tmp_path / "model.npz")
    assert km.load_model(tmp_path / "model.npz") == model
    linear = random_predictor(0, 2, 1)
    linear.save(tmp_path / "linear.npz")
    assert km.load_model(tmp_path / "linear.npz") == linear


def test_shapes_that_do_not_fit_are_refused() -> None:
    good = random_bilinear(0, 2, 1)
    rest = good.lifting, good.dt, good.states, good.inputs
    with pytest.raises(km.errors.ShapeError, match=r"A has shape \(2, 2\), but the lifting returns 6 observables"):
        km.BilinearPredictor(np.eye(2), good.B, good.N, good.C, *rest)
    with pytest.raises(km.errors.ShapeError, match=r"N has shape \(6, 6\), expected \(1, 6, 6\)"):
        km.BilinearPredictor(good.A, good.B, good.N[0], good.C, *rest)
    with pytest.raises(km.errors.ShapeError, match=r"U has shape \(3, 2\), expected \(any, 1\)"):
        good.rollout([0, 0], np.zeros((3, 2)))
