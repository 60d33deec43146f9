"""Invariance proximity: 0 on an invariant dictionary, else the worst relative error over its span."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import subspace_angles

import koopmpc as km
from tests.example_plants import one_step_pairs, random_episodes
from tests.validate.test_residual_dmd import CLOSED, manifold, pendulum

DICTIONARY = km.State() + km.Monomials(2)


def both(data, lifting: km.Lifting) -> tuple[np.ndarray, np.ndarray]:
    pairs, psi = data.snapshots(), lifting.bind(data.states)
    return np.hstack([psi(pairs.X), pairs.U]), psi(pairs.X_next)


@pytest.mark.parametrize("nu", [0, 1])
def test_an_invariant_dictionary_has_none(nu: int) -> None:
    data = one_step_pairs(manifold, 2, nu, 200)
    found = km.validate.invariance(data, CLOSED)
    assert found.proximity < 1e-12
    assert found.index < 1e-24
    assert found.errors.max() < 1e-12
    assert found.names == CLOSED.bind(data.states).names


@settings(max_examples=10)
@given(st.integers(0, 99), st.integers(0, 2))
def test_it_is_the_sine_of_the_largest_principal_angle(seed: int, nu: int) -> None:
    data = one_step_pairs(pendulum, 2, nu, 80, seed)
    found = km.validate.invariance(data, DICTIONARY)
    P, T = both(data, DICTIONARY)
    assert found.proximity == pytest.approx(np.sin(subspace_angles(T, P).max()), rel=1e-6)
    forward, backward = np.linalg.lstsq(P, T)[0], np.linalg.lstsq(T, P)[0]
    consistency = np.linalg.eigvals(np.eye(T.shape[1]) - backward @ forward).real
    assert found.index == pytest.approx(consistency.max(), rel=1e-5)
    assert 0 <= found.index <= 1


@settings(max_examples=10)
@given(st.integers(0, 99))
def test_no_function_of_the_span_is_worse_and_the_worst_is_as_bad(seed: int) -> None:
    data = one_step_pairs(pendulum, 2, 1, 80, seed)
    found = km.validate.invariance(data, DICTIONARY)
    P, T = both(data, DICTIONARY)

    def error(f: np.ndarray) -> np.ndarray:
        g = np.linalg.lstsq(P, T @ f)[0]
        return np.linalg.norm(T @ f - P @ g, axis=0) / np.linalg.norm(T @ f, axis=0)

    rng = np.random.default_rng(seed)
    drawn = rng.standard_normal((T.shape[1], 200))
    assert error(drawn).max() <= found.proximity * (1 + 1e-9)
    assert error(found.worst) == pytest.approx(found.proximity, rel=1e-8)
    assert np.sqrt(np.mean((T @ found.worst) ** 2)) == pytest.approx(1, rel=1e-8)
    assert np.allclose(found.errors, error(np.eye(T.shape[1])), rtol=1e-8, atol=1e-12)


@settings(max_examples=10)
@given(st.integers(0, 99))
def test_no_choice_of_basis_changes_it(seed: int) -> None:
    data = one_step_pairs(pendulum, 2, 1, 80, seed)
    rng = np.random.default_rng(seed)
    whole = DICTIONARY.bind(data.states)
    mixed = km.lifting.Projected(
        whole, np.linalg.qr(rng.standard_normal((whole.nz, whole.nz)))[0] * rng.uniform(0.5, 2, whole.nz)
    )
    one, other = (km.validate.invariance(data, psi).proximity for psi in (whole, mixed))
    assert one == pytest.approx(other, rel=1e-9)


def test_noise_is_as_bad_as_can_be_and_zeros_do_no_harm() -> None:
    data = random_episodes(0, [3000], 2, 0)
    assert km.validate.invariance(data, km.State()).proximity > 0.99
    zero = km.Expressions(lambda x: [0 * x[0]], ("nought",))
    exact = one_step_pairs(manifold, 2, 1, 100)
    found = km.validate.invariance(exact, CLOSED + zero)
    assert found.proximity < 1e-12
    assert found.errors[-1] == 0
    assert km.validate.invariance(exact, zero).proximity == 0


def test_a_bilinear_model_predicts_with_the_products_too() -> None:
    data = one_step_pairs(lambda x, u: np.array([0.5 * x[0] + 0.3 * u[0] * x[0]]), 1, 1, 60)
    lifting = km.State() + km.Constant()
    assert km.validate.invariance(data, lifting).proximity > 0.1
    assert km.validate.invariance(data, lifting, bilinear=True).proximity < 1e-12
    assert km.validate.invariance(data, km.bilinear_edmd(data, lifting)).proximity < 1e-12  # a predictor says so itself
