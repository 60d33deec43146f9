"""ridge="gcv" is generalised cross-validation on all the data, though it sees only moments."""

from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import hadamard

import koopmpc as km
from tests.bare import shown
from tests.models.plants import brute_force, one_step_pairs, random_episodes

LIFTING = km.Constant() + km.State() + km.Monomials(3)


def noisy(seed: int, count: int, noise: float, nu: int = 1) -> km.Episodes:
    """Pairs of a smooth map, with noise on what follows."""
    rng = np.random.default_rng(seed)
    A = rng.uniform(-0.6, 0.6, (2, 2))
    return one_step_pairs(
        lambda x, u: np.sin(A @ x) + 0.2 * u.sum() + noise * rng.standard_normal(2), 2, nu, count, seed
    )


def score(P: np.ndarray, T: np.ndarray, ridge: float) -> float:
    """Return GCV by its definition, with the (M, M) hat matrix; a constant column is not shrunk."""
    free = (P == 1).all(axis=0).any()
    spread = np.linalg.norm(P - P.mean(axis=0) * free, axis=0)
    H = P @ np.linalg.solve(P.T @ P + ridge * np.diag(spread**2), P.T)
    M, moving = len(P), np.ptp(T, axis=0) > 0
    energy = np.sum((T - T.mean(axis=0) * free)[:, moving] ** 2, axis=0)
    error = np.sum((T - H @ T)[:, moving] ** 2, axis=0) / energy
    return M * float(error.sum()) / (M - np.trace(H)) ** 2


@settings(max_examples=15)
@given(st.integers(0, 999), st.integers(25, 80), st.floats(0.02, 1), st.integers(0, 2))
def test_no_ridge_on_a_fine_grid_scores_better_on_the_full_data(seed: int, count: int, noise: float, nu: int) -> None:
    data = noisy(seed, count, noise, nu)
    model = km.edmd(data, LIFTING, ridge="gcv")
    D = brute_force(data, model.lifting)
    P, T = D[:, : model.nz + nu], D[:, model.nz + nu :]
    best = min(score(P, T, ridge) for ridge in np.geomspace(1e-8, 1e3, 45))
    assert score(P, T, model.report.ridge) <= best * (1 + 1e-7)
    plain = km.edmd(data, LIFTING, ridge=model.report.ridge)
    assert np.array_equal(model.A, plain.A)
    assert "chosen by generalised cross-validation" in model.report.route


def test_on_an_orthogonal_design_it_is_leave_one_out() -> None:
    """Columns of ±1 give every pair the same leverage, and then both criteria are one."""
    rng = np.random.default_rng(3)
    X = hadamard(32)[:, 1:9].astype(float)
    ahead = 0.6 * X + rng.standard_normal(X.shape)
    data = km.Episodes([km.Episode(X=[x, y]) for x, y in zip(X, ahead, strict=True)], 0.1)
    ridge = km.edmd(data, km.State(), ridge="gcv").report.ridge
    S = X / np.linalg.norm(X, axis=0)
    T = ahead / np.linalg.norm(ahead, axis=0)

    def left_out(value: float) -> float:
        total = 0.0
        for k in range(len(S)):
            keep = np.arange(len(S)) != k
            K = np.linalg.solve(S[keep].T @ S[keep] + value * np.eye(8), S[keep].T @ T[keep])
            total += float(np.sum((T[k] - S[k] @ K) ** 2))
        return total

    grid = np.geomspace(1e-3, 1e3, 121)
    best = grid[int(np.argmin([left_out(v) for v in grid]))]
    assert 1e-2 < best < 1e2  # inside
    assert left_out(ridge) <= left_out(best) * (1 + 1e-9)


@given(st.integers(0, 99))
def test_the_chosen_ridge_does_not_depend_on_units(seed: int) -> None:
    data = noisy(seed, 40, 0.3)
    units = np.array([1e4, 1e-3])
    other = km.Episodes([km.Episode(X=e.X * units, U=e.U) for e in data], data.dt)
    a, b = km.edmd(data, LIFTING, ridge="gcv"), km.edmd(other, LIFTING, ridge="gcv")
    assert b.report.ridge == pytest.approx(a.report.ridge, rel=1e-3)


def test_few_noisy_pairs_predict_better_with_it() -> None:
    held_out = noisy(7, 400, 0.0)
    s = held_out.snapshots()
    won = 0
    for seed in range(20):
        rng = np.random.default_rng(7)
        A = rng.uniform(-0.6, 0.6, (2, 2))
        noise = np.random.default_rng(100 + seed)
        data = one_step_pairs(
            lambda x, u, A=A, noise=noise: np.sin(A @ x) + 0.2 * u.sum() + 0.5 * noise.standard_normal(2),
            2,
            1,
            20,
            seed,
        )
        error = [
            np.linalg.norm(s.X_next - (m.lift(s.X) @ m.A.T + s.U @ m.B.T) @ m.C.T)
            for m in (km.edmd(data, LIFTING), km.edmd(data, LIFTING, ridge="gcv"))
        ]
        won += error[1] < error[0]
    assert won >= 18


def test_exact_data_need_no_ridge() -> None:
    data = one_step_pairs(lambda x, u: np.array([0.9 * x[0] + u[0], 0.5 * x[1]]), 2, 1, 60)
    model = km.edmd(data, km.State(), ridge="gcv")
    assert model.report.ridge == 0
    assert np.allclose(model.A, np.diag([0.9, 0.5]), rtol=0, atol=1e-13)
    assert "ridge 0, chosen by generalised cross-validation" in model.report.route


def test_white_noise_is_shrunk_away() -> None:
    data = km.Episodes([km.Episode(X=x) for x in np.random.default_rng(1).standard_normal((60, 2, 6))], 0.1)
    assert km.edmd(data, km.State(), ridge="gcv").report.ridge > 1


def test_of_fewer_pairs_than_coefficients_it_chooses_too() -> None:
    data = noisy(0, 8, 0.3)
    model = km.edmd(data, LIFTING, ridge="gcv")
    D = brute_force(data, model.lifting)
    P, T = D[:, :11], D[:, 11:]
    best = min(score(P, T, ridge) for ridge in np.geomspace(1e-6, 1e3, 37))
    assert score(P, T, model.report.ridge) <= best * (1 + 1e-6)


@given(st.integers(0, 99))
def test_the_ridge_of_a_bilinear_model_minimises_its_score(seed: int) -> None:
    data = random_episodes(seed, [60], 2, 1)
    model = km.bilinear_edmd(data, km.State(), ridge="gcv")
    D = brute_force(data, model.lifting)
    P, T = np.hstack([D[:, :3], D[:, 2:3] * D[:, :2]]), D[:, 3:]
    best = min(score(P, T, ridge) for ridge in np.geomspace(1e-6, 1e3, 37))
    assert score(P, T, model.report.ridge) <= best * (1 + 1e-6)
    plain = km.bilinear_edmd(data, km.State(), ridge=model.report.ridge)
    assert np.array_equal(model.N, plain.N)


def test_a_ridge_that_is_no_number_or_gcv_is_refused() -> None:
    code = 'data = km.Episodes([km.Episode(X=np.eye(4))], 0.1)\nshow(lambda: km.edmd(data, km.State(), ridge="cv"))'
    assert shown(code) == ["DataError ridge is 'cv'; pass a number, or \"gcv\""]
    with pytest.raises(km.errors.DataError, match="ridge is -1; it must be 0 or above"):
        km.edmd(noisy(0, 30, 0.1), km.State(), ridge=-1)


@pytest.mark.parametrize("ridge", [1e-6, 1e-2, 10.0])
def test_towards_affine_counts_a_millionth_on_states_constant_and_inputs(ridge: float) -> None:
    """By its definition, min ‖T − P K‖² + ridge ‖S W K‖², as least squares with rows of their own for the penalty."""
    data = noisy(1, 60, 0.1)
    model = km.edmd(data, LIFTING, ridge=ridge, towards="affine")
    D = brute_force(data, model.lifting)
    n = model.nz + 1
    P, T = D[:, :n], D[:, n:]
    light = [name in ("1", *data.states) for name in model.lifting.names] + [True]
    assert sum(light) == 4
    penalty = np.diag(np.sqrt(ridge) * np.linalg.norm(P - P.mean(axis=0), axis=0) * np.where(light, 1e-3, 1.0))
    K = np.linalg.lstsq(np.vstack([P, penalty]), np.vstack([T, np.zeros((n, T.shape[1]))]), rcond=None)[0]
    np.testing.assert_allclose(np.vstack([model.A.T, model.B.T]), K, atol=1e-9)
    assert "a millionth of it on states, Constant and inputs" in model.report.route


def test_towards_affine_an_unstable_plant_stays_as_unstable_as_it_is() -> None:
    """Data of a feedback: a ridge on all columns makes the model tame, one on the lifted ones does not."""
    rng, made = np.random.default_rng(0), []
    for _ in range(40):
        X, U = [rng.uniform(-1, 1, 1)], []
        for noise in rng.uniform(-0.1, 0.1, 30):
            U.append(-1.1 * X[-1] + noise)
            X.append(1.2 * X[-1] - 0.1 * X[-1] ** 3 + U[-1])
        made.append(km.Episode(X=np.array(X), U=np.array(U)))
    data = km.Episodes(made, 0.1)
    radius = {
        towards: np.abs(km.edmd(data, km.State() + km.Monomials(3), ridge=1e-2, towards=towards).A[0, 0])
        for towards in ("zero", "affine")
    }
    assert radius["zero"] < 1.1
    assert abs(radius["affine"] - 1.2) < 0.03


@pytest.mark.unhooked
def test_what_a_ridge_pulls_to_is_checked() -> None:
    data = noisy(0, 40, 0.1)
    with pytest.raises(km.KoopmpcError, match='pass "zero" or "affine"'):
        km.edmd(data, LIFTING, ridge=1e-6, towards=cast("Any", "dmd"))
    with pytest.raises(km.KoopmpcError, match="rank mixes them; pass one of the two"):
        km.edmd(data, LIFTING, ridge=1e-6, rank=2, towards="affine")
