"""LASSO and group LASSO: CVXPY's solution, the true observables out of a redundant dictionary, and what stays."""

import cvxpy as cp
import numpy as np
import pytest

import koopmpc as km
from tests.bare import shown
from tests.models.plants import brute_force, one_step_pairs

SMALL = km.Constant() + km.State() + km.Monomials(4)
DICTIONARY = SMALL + km.Fourier(2)  # collinear to 1e-13


CODE = "show(lambda: km.identify.sparse_edmd(km.Episodes([km.Episode(X=np.eye(4))], 0.1), km.State(), over='rows'))"


def slow_manifold(noise: float = 0.0, seed: int = 0, count: int = 600) -> km.Episodes:
    """x₀⁺ = 0.9 x₀, x₁⁺ = 0.5 x₁ + 0.3 x₀² + u: exact on x₀, x₁, x₀² (Brunton et al., PLoS ONE 11, 2016)."""
    rng = np.random.default_rng(seed)

    def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        ahead = np.array([0.9 * x[0], 0.5 * x[1] + 0.3 * x[0] ** 2 + u[0]])
        return ahead + noise * rng.standard_normal(2)

    return one_step_pairs(step, 2, 1, count, seed)


@pytest.mark.parametrize(("noise", "penalty"), [(0.0, 1e-6), (0.02, 1e-3), (0.1, 1e-2)])
@pytest.mark.parametrize("over", ["observables", "entries"])
def test_the_right_observables_are_found(noise: float, penalty: float, over: str) -> None:
    dictionary = SMALL if noise else DICTIONARY
    model = km.identify.sparse_edmd(slow_manifold(noise, seed=1), dictionary, penalty=penalty, over=over)
    assert model.lifting.names == ("1", "x0", "x1", "x0^2")
    true = np.array([[1, 0, 0, 0], [0, 0.9, 0, 0], [0, 0, 0.5, 0.3], [noise**2, 0, 0, 0.81]])
    assert np.allclose(model.A, true, rtol=0, atol=1e-9 + noise / 2)
    assert np.allclose(model.B, [[0], [0], [1], [0]], rtol=0, atol=1e-9 + noise / 2)
    assert np.array_equal(model.C, np.eye(4)[1:3])
    dropped = model.report.changes[0]
    whole = dictionary.bind(("x0", "x1")).nz
    assert dropped.startswith(f"{whole - 4} of {whole} observables dropped: x0*x1, x1^2")
    if noise == 0:
        x0, U = np.array([0.7, -0.4]), np.linspace(-1, 1, 20)[:, None]
        X = [x0]
        for u in U:
            X.append(np.array([0.9 * X[-1][0], 0.5 * X[-1][1] + 0.3 * X[-1][0] ** 2 + u[0]]))
        assert np.allclose(model.rollout(x0, U), X, rtol=0, atol=1e-8)


def test_entries_that_are_zero_are_exactly_zero() -> None:
    model = km.identify.sparse_edmd(slow_manifold(0.02, seed=1), SMALL, over="entries")
    assert np.array_equal(model.A[1:] != 0, np.array([[0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]], bool))
    assert np.array_equal(model.B[:, 0] != 0, [False, False, True, False])


def test_least_squares_on_what_is_kept() -> None:
    data = slow_manifold(0.02, seed=2)
    model = km.identify.sparse_edmd(data, SMALL)
    refit = km.edmd(data, model.lifting)
    assert np.allclose(model.A, refit.A, rtol=0, atol=1e-9)
    assert np.allclose(model.B, refit.B, rtol=0, atol=1e-9)
    assert np.allclose(model.report.residual, refit.report.residual, rtol=1e-6)


def test_a_large_penalty_leaves_the_states_and_a_small_one_everything() -> None:
    data = slow_manifold(0.02)
    few = km.identify.sparse_edmd(data, DICTIONARY, penalty=1e3)
    assert few.lifting.names == ("1", "x0", "x1")
    plain = km.edmd(data, few.lifting)
    assert np.allclose(few.A, plain.A, rtol=0, atol=1e-9)
    assert np.allclose(few.B, plain.B, rtol=0, atol=1e-9)  # inputs have no penalty
    every = km.State() + km.Monomials(2)
    whole = km.identify.sparse_edmd(data, every, penalty=1e-12, adaptive=False)
    assert whole.lifting.names == every.bind(data.states).names
    assert np.allclose(whole.A, km.edmd(data, every).A, rtol=0, atol=1e-9)


def test_the_kept_observables_do_not_depend_on_units() -> None:
    data = slow_manifold(0.02, seed=3)
    units = np.array([1e-4, 1e4])
    scaled = km.Episodes([type(e)(X=e.X * units, U=1e3 * e.U) for e in data], data.dt)
    a, b = (km.identify.sparse_edmd(d, SMALL).lifting.names for d in (data, scaled))
    assert a == b


def test_the_chosen_lifting_is_data_and_the_same_function_twice(tmp_path) -> None:
    model = km.identify.sparse_edmd(slow_manifold(), DICTIONARY, penalty=1e-6)
    model.save(tmp_path / "model.npz")
    again = km.load_model(tmp_path / "model.npz")
    assert again == model
    X = np.random.default_rng(0).uniform(-1, 1, (7, 2))
    whole = DICTIONARY.bind(("x0", "x1"))
    places = [whole.names.index(name) for name in model.lifting.names]
    assert np.allclose(again.lift(X), whole(X)[:, places], rtol=0, atol=1e-15)
    assert np.allclose(model.step_map()(X[0], [0.3]), [0.9 * X[0, 0], 0.5 * X[0, 1] + 0.3 * X[0, 0] ** 2 + 0.3])


def test_a_wrong_penalty_or_lifting_is_refused() -> None:
    assert shown(CODE) == ['DataError over is \'rows\'; pass "observables" or "entries"']
    data = slow_manifold(count=30)
    with pytest.raises(km.errors.DataError, match="penalty is 0"):
        km.identify.sparse_edmd(data, DICTIONARY, penalty=0)
    with pytest.raises(km.errors.DataError, match="the lifting lacks the state 'x0'"):
        km.identify.sparse_edmd(data, km.Monomials(2), penalty=1)


def cross_validated(P: np.ndarray, T: np.ndarray, constant: int) -> np.ndarray:
    """Ridge regression on deviations from the mean, its weight by Golub, Heath & Wahba's formula on a fine grid."""
    moving = np.delete(np.arange(P.shape[1]), constant)
    size = np.linalg.norm(P - P.mean(axis=0), axis=0)[moving]
    U, s, Vt = np.linalg.svd((P - P.mean(axis=0))[:, moving] / size, full_matrices=False)
    Y = T - T.mean(axis=0)
    energy = np.sum(Y**2, axis=0)
    energy[energy < 1e-20] = 1.0  # the Constant

    def score(ridge: float) -> float:
        rest = Y - U @ ((s**2 / (s**2 + ridge))[:, None] * (U.T @ Y))
        return float(np.sum(np.sum(rest**2, axis=0) / energy) / (len(P) - 1 - np.sum(s**2 / (s**2 + ridge))) ** 2)

    ridge = min(np.logspace(-14, 3, 4000), key=score)
    K = np.zeros((P.shape[1], T.shape[1]))
    K[moving] = (Vt.T * (s / (s**2 + ridge))) @ U.T @ Y / size[:, None]
    K[constant] = (T - P @ K).mean(axis=0) / P[0, constant]
    return K


@pytest.mark.parametrize("over", ["observables", "entries"])
@pytest.mark.parametrize("adaptive", [False, True])
@pytest.mark.parametrize("penalty", [1e-3, 3e-2])
def test_what_is_zero_is_zero_in_the_solution_of_cvxpy_on_the_rows_of_the_data(over, adaptive, penalty) -> None:
    data = slow_manifold(0.05, seed=4, count=80)
    model = km.identify.sparse_edmd(data, SMALL, penalty=penalty, over=over, adaptive=adaptive)
    lifting = SMALL.bind(data.states)
    D = brute_force(data, lifting)
    nz, n = lifting.nz, lifting.nz + 1
    P, T = D[:, :n] / np.linalg.norm(D[:, :n], axis=0), D[:, n:] / np.linalg.norm(D[:, n:], axis=0)
    stay = [lifting.names.index(name) for name in model.lifting.names]
    large = np.abs(cross_validated(P, T[:, stay], lifting.constant_index))
    if over == "observables":
        large = np.linalg.norm(large, axis=1, keepdims=True) * np.ones_like(large)
    weights = penalty / np.maximum(large, 1e-12) if adaptive else np.full_like(large, penalty)
    K = cp.Variable((n, len(stay)))
    if over == "observables":
        rated = [j for j in range(nz) if j not in stay]
        price = sum(weights[j, 0] * cp.norm(K[j]) for j in rated)
    else:
        price = cp.sum(cp.multiply(weights, cp.abs(K)))
    cp.Problem(cp.Minimize(0.5 * cp.sum_squares(T[:, stay] - P @ K) + price)).solve(solver=cp.CLARABEL)
    own = np.zeros((n, len(stay)))
    own[[*stay, nz]] = np.hstack([model.A, model.B]).T
    if over == "observables":
        assert np.abs(K.value[rated]).max(initial=0) < 1e-5
    else:
        away = (np.abs(K.value) < 1e-6) | (np.abs(K.value) > 1e-4)  # what the solver says clearly
        assert np.array_equal((own != 0)[away], (np.abs(K.value) > 1e-5)[away])


def test_a_state_that_is_zero_throughout_is_kept_and_said_to_be() -> None:
    data = slow_manifold(0.02)
    still = km.Episodes([km.Episode(X=e.X * [1, 0], U=e.U) for e in data], data.dt, data.states, data.inputs)
    with pytest.warns(km.FitWarning, match="'x1' was 0 in all snapshots"):
        model = km.identify.sparse_edmd(still, km.State() + km.Monomials(2))
    assert model.lifting.names[:2] == ("x0", "x1")
    assert np.isfinite(model.A).all()
    assert not model.A[1].any()
