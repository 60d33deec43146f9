"""The equations of the spectrum, checked against exponentials and rollouts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import block_diag, expm

import koopmpc as km
from tests.example_plants import one_step_pairs, random_predictor

OSCILLATOR = np.array([[0.0, 1.0], [-4.0, -0.3]])  # ẍ = −4x − 0.3ẋ


def sampled(dt: float) -> km.LinearPredictor:
    return km.LinearPredictor(expm(OSCILLATOR * dt), np.empty((2, 0)), np.eye(2), km.State(), dt, ("x", "v"), ())


@given(st.floats(0.01, 0.5))
def test_continuous_eigenvalues_are_those_of_the_differential_equation(dt: float) -> None:
    found = np.sort_complex(km.spectrum.continuous_eigenvalues(sampled(dt)))
    assert np.allclose(found, np.sort_complex(np.linalg.eigvals(OSCILLATOR)), atol=1e-9)


def test_an_eigenvalue_of_zero_decays_at_once() -> None:
    model = km.LinearPredictor([[0, 0], [0, 0.5]], np.empty((2, 0)), np.eye(2), km.State(), 0.1, ("a", "b"), ())
    assert km.spectrum.continuous_eigenvalues(model)[1].real == -np.inf
    assert np.allclose(km.spectrum.reconstruct(model, [3, 4], [0, 0.1, 0.2]), [[3, 4], [0, 2], [0, 1]])


@given(st.floats(0.05, 0.5), st.integers(0, 99))
def test_reconstruction_between_the_samples_is_the_flow(dt: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x0, times = rng.standard_normal(2), rng.uniform(0, 3, 5)
    X = km.spectrum.reconstruct(sampled(dt), x0, times)
    assert np.allclose(X, [expm(OSCILLATOR * t) @ x0 for t in times], atol=1e-10)


@given(st.integers(1, 5), st.integers(0, 999))
def test_reconstruction_equals_the_rollout_of_a_diagonalisable_model(nx: int, seed: int) -> None:
    model = random_predictor(seed, nx, 0)
    x0 = np.random.default_rng(seed).standard_normal(nx)
    X = model.rollout(x0, np.empty((15, 0)))
    scale = np.linalg.cond(model.eigenvectors) * max(1, np.abs(X).max())
    assert np.allclose(km.spectrum.reconstruct(model, x0, np.arange(16) * model.dt), X, atol=1e-11 * scale)


def test_reconstruction_of_a_lifted_model_equals_its_rollout() -> None:
    data = quadratic_data()
    lifting = km.State() + km.Expressions(lambda x: [x[0] ** 2], ["x0^2"])
    x0, times = [0.7, -0.4], np.arange(30) * data.dt
    whole = km.edmd(data, lifting)
    expected = whole.rollout(x0, np.empty((29, 0)))
    assert np.allclose(km.spectrum.reconstruct(whole, x0, times), expected, atol=1e-10)
    # at full rank the exact modes carry the same motion
    reduced = km.edmd(data, lifting, rank=3)
    assert reduced.exact_modes is not None
    assert np.allclose(km.spectrum.reconstruct(reduced, x0, times), expected, atol=1e-8)


def quadratic_data() -> km.Episodes:
    """x₀⁺ = .9x₀, x₁⁺ = .5x₁ + .3x₀²: exact on [x₀, x₁, x₀²]."""
    return one_step_pairs(lambda x, u: np.array([0.9 * x[0], 0.5 * x[1] + 0.3 * x[0] ** 2]), 2, 0, 100)


@given(st.integers(0, 99))
def test_amplitudes_are_the_least_squares_share_of_each_exact_mode(seed: int) -> None:
    rng = np.random.default_rng(seed)
    X = [rng.standard_normal(6)]
    A = random_predictor(seed, 6, 0).A
    for _ in range(8):
        X.append(A @ X[-1])
    data = km.Episodes([km.Episode(X=np.array(X))], 0.1)
    model = km.dmd(data, rank=3)
    b = km.spectrum.amplitudes(model, X[0])
    assert np.allclose(b, np.linalg.pinv(model.modes) @ X[0], atol=1e-6 * max(1, np.abs(b).max()))


def test_amplitudes_of_an_unreduced_model_are_its_eigenfunctions() -> None:
    model = random_predictor(3, 2, 0, km.State() + km.Constant() + km.Monomials(2))
    assert np.allclose(km.spectrum.amplitudes(model, [0.3, 0.4]), model.eigenfunctions([[0.3, 0.4]])[0])


@given(st.integers(0, 99), st.sampled_from([None, 3]))
def test_amplitudes_of_a_run_are_the_best_over_all_its_snapshots(seed: int, rank: int | None) -> None:
    rng = np.random.default_rng(seed)
    A = random_predictor(seed, 5, 0).A
    X = [rng.standard_normal(5)]
    for _ in range(12):
        X.append(A @ X[-1])
    X = np.array(X) + 0.05 * rng.standard_normal((13, 5))
    model = km.dmd(km.Episodes([km.Episode(X=X)], 0.1), rank=rank)
    powers = model.eigenvalues ** np.arange(13)[:, None]

    def error(b: np.ndarray) -> float:
        return float(np.sum(np.abs(X - (powers * b) @ model.modes.T) ** 2))

    best = km.spectrum.amplitudes(model, X)
    least = error(best)
    assert least <= error(km.spectrum.amplitudes(model, X[0]))
    assert all(
        error(best + 1e-3 * (rng.standard_normal(b) + 1j * rng.standard_normal(b))) >= least for b in [len(best)] * 10
    )
    ahead = km.spectrum.reconstruct(model, X, 0.1 * np.arange(13))
    assert np.sum((X - ahead) ** 2) == pytest.approx(least, rel=1e-6)


def test_amplitudes_of_an_exact_run_are_those_of_its_start() -> None:
    model = random_predictor(1, 4, 0)
    X = model.rollout([1.0, -2, 0.5, 0.3], np.empty((10, 0)))
    assert np.allclose(km.spectrum.amplitudes(model, X), km.spectrum.amplitudes(model, X[0]), atol=1e-10)


def test_eigenfunctions_of_an_exact_model_evolve_linearly() -> None:
    data = quadratic_data()
    lifting = km.State() + km.Expressions(lambda x: [x[0] ** 2], ["x0^2"])
    error = km.spectrum.linearity_error(km.edmd(data, lifting), data)
    assert error.shape == (3,)
    assert error.max() < 1e-10


def test_eigenfunctions_of_a_wrong_lifting_do_not() -> None:
    data = quadratic_data()
    model = km.edmd(data, km.State())
    s = data.snapshots()
    phi, ahead = model.eigenfunctions(s.X), model.eigenfunctions(s.X_next)
    expected = [
        np.linalg.norm(ahead[:, j] - model.eigenvalues[j] * phi[:, j]) / np.linalg.norm(phi[:, j]) for j in (0, 1)
    ]
    error = km.spectrum.linearity_error(model, data)
    assert np.allclose(error, expected, atol=1e-12)
    assert error.min() < 1e-10  # x₀ alone is an eigenfunction
    assert error.max() > 0.05


def test_inputs_are_accounted_for() -> None:
    model = random_predictor(0, 3, 2)
    rng = np.random.default_rng(0)
    U = rng.standard_normal((9000, 2))  # longer than one block
    data = km.Episodes(
        [km.Episode(X=model.rollout(rng.standard_normal(3), U), U=U)], model.dt, model.states, model.inputs
    )
    assert km.spectrum.linearity_error(model, data).max() < 1e-12


def test_data_of_another_plant_are_refused() -> None:
    model = random_predictor(0, 2, 1)
    X, U = np.ones((4, 2)), np.ones((3, 1))
    with pytest.raises(km.errors.ShapeError, match=r"the episodes have states \(x0, x1\)"):
        km.spectrum.linearity_error(model, km.Episodes([km.Episode(X=X, U=U)], 0.1))
    with pytest.raises(km.errors.ShapeError, match=r"the episodes have inputs \(\), the predictor has \(u0 \[N\]\)"):
        km.spectrum.linearity_error(model, km.Episodes([km.Episode(X=X)], 0.1, model.states))
    with pytest.raises(km.errors.DataError, match=r"the episodes have dt 0.2 s, the predictor 0.1 s"):
        km.spectrum.linearity_error(model, km.Episodes([km.Episode(X=X, U=U)], 0.2, model.states, model.inputs))


def test_an_eigenfunction_that_is_zero_on_the_data_has_no_relative_error() -> None:
    model = km.LinearPredictor(np.diag([0.9, 0.5]), np.empty((2, 0)), np.eye(2), km.State(), 0.1, ("a", "b"), ())
    data = km.Episodes([km.Episode(X=[[1, 0], [0.9, 0]])], 0.1, ("a", "b"))
    with pytest.raises(km.errors.DataError, match="eigenfunction 1 is 0 in all snapshots"):
        km.spectrum.linearity_error(model, data)


@pytest.mark.parametrize("seed", range(5))
def test_eigenvalues_come_by_magnitude_and_of_a_pair_the_negative_frequency_first(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angles, sizes = rng.uniform(0.2, 2.9, 3), rng.uniform(0.2, 0.6, 3)
    blocks = [
        r * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]) for r, a in zip(sizes, angles, strict=True)
    ]
    A, T = block_diag(*blocks, [[0.9]]), rng.standard_normal((7, 7))
    names = tuple(f"x{i}" for i in range(7))
    model = km.LinearPredictor(T @ A @ np.linalg.inv(T), np.zeros((7, 0)), np.eye(7), km.State(), 0.1, names, ())
    pairs = [r * np.exp(s * 1j * a) for r, a in sorted(zip(sizes, angles, strict=True), reverse=True) for s in (-1, 1)]
    np.testing.assert_allclose(model.eigenvalues, [0.9, *pairs], atol=1e-9)
    np.testing.assert_allclose(model.A @ model.modes, model.modes * model.eigenvalues, atol=1e-9)


@given(st.integers(0, 99))
def test_a_step_of_each_continuous_eigenvalue_is_the_eigenvalue_in_its_place(seed: int) -> None:
    model = random_predictor(seed, 5, 0)
    np.testing.assert_allclose(np.exp(km.spectrum.continuous_eigenvalues(model) * model.dt), model.eigenvalues)


def test_the_error_over_an_evolution_is_that_of_its_definition() -> None:
    model = random_predictor(4, 3, 0)
    rng = np.random.default_rng(0)
    runs = [rng.standard_normal((steps, 3)) for steps in (4, 7)]
    data = km.Episodes([km.Episode(X=X) for X in runs], model.dt, model.states)
    phis = [model.eigenfunctions(X) for X in runs]
    gaps = [phi - phi[0] * model.eigenvalues ** np.arange(len(phi))[:, None] for phi in phis]
    missed, size = (np.linalg.norm(np.vstack(some), axis=0) for some in (gaps, phis))
    np.testing.assert_allclose(km.spectrum.evolution_error(model, data), missed / size)


@given(st.floats(0.2, 1.0), st.floats(0.1, 3.0), st.integers(2, 40))
def test_an_evolution_on_an_invariant_subspace_has_no_error(rho: float, turn: float, steps: int) -> None:
    A = rho * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    X = np.array([np.linalg.matrix_power(A, k) @ [1.0, 0.3] for k in range(steps + 1)])
    model = km.LinearPredictor(A, np.zeros((2, 0)), np.eye(2), km.State(), 0.1, ("x0", "x1"), ())
    data = km.Episodes([km.Episode(X=X)], 0.1)
    assert km.spectrum.evolution_error(model, data).max() < 1e-9
    driven = km.LinearPredictor(A, np.ones((2, 1)), np.eye(2), km.State(), 0.1, data.states, ("u0",))
    with pytest.raises(km.errors.DataError, match=r"the predictor has inputs, .* pass an autonomous fit"):
        km.spectrum.evolution_error(driven, data)
