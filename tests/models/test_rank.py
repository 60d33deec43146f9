"""The rank that is kept: a number, a share of energy, or the optimal hard threshold."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.bare import shown
from tests.models.plants import one_step_pairs, random_episodes

LIFTING = km.Constant() + km.State() + km.Monomials(2)


def waves(seed: int, nx: int, steps: int, noise: float, count: int = 2) -> km.Episodes:
    """`count` undamped oscillations of distinct frequencies seen in nx places, and white noise: rank 2 · count."""
    rng = np.random.default_rng(seed)
    times = np.arange(steps + 1)[:, None] * (0.2 + 1.3 / count * (np.arange(count) + rng.uniform(0.2, 0.8, count)))
    Q = np.linalg.qr(rng.standard_normal((nx, 2 * count)))[0]
    X = np.hstack([np.cos(times), np.sin(times)]) @ Q.T
    return km.Episodes([km.Episode(X=X + noise * rng.standard_normal(X.shape))], 0.1)


@given(st.integers(0, 999), st.integers(1, 3), st.sampled_from([(20, 60), (20, 400), (100, 60)]))
def test_the_hard_threshold_finds_the_rank_in_white_noise(seed: int, count: int, size: tuple[int, int]) -> None:
    data = waves(seed, *size, noise=0.02, count=count)
    model = km.dmd(data, rank="hard-threshold")
    assert model.nz == 2 * count
    assert "the singular values above the hard threshold" in model.report.route
    assert np.allclose(np.abs(model.eigenvalues), 1, atol=0.05)


def test_pure_noise_has_no_rank() -> None:
    data = km.Episodes([km.Episode(X=np.random.default_rng(0).standard_normal((60, 30)))], 0.1)
    with pytest.raises(km.errors.DataError, match="they look like white noise alone; pass a rank"):
        km.dmd(data, rank="hard-threshold")


@given(st.integers(0, 99), st.floats(0.05, 0.999999))
def test_a_share_keeps_the_fewest_directions_that_hold_it(seed: int, share: float) -> None:
    data = random_episodes(seed, [60, 30], 3, 1)
    model = km.edmd(data, LIFTING, rank=share)
    energy = np.linalg.svd(LIFTING.bind(data.states)(data.snapshots().X), compute_uv=False) ** 2
    held = np.cumsum(energy) / energy.sum()
    assert held[model.nz - 1] >= share
    assert model.nz == 1 or held[model.nz - 2] < share
    same = km.edmd(data, LIFTING, rank=model.nz)
    assert np.array_equal(model.A, same.A)
    assert model.report.rank == model.nz
    assert f"which holds {share:g} of the energy" in model.report.route


def test_every_fit_with_a_rank_takes_the_rules() -> None:
    rng = np.random.default_rng(0)
    waving = waves(0, 20, 200, 0.01)[0].X
    data = km.Episodes([km.Episode(X=waving, U=0.01 * rng.standard_normal((200, 1)))], 0.1)
    assert km.dmdc(data, rank="hard-threshold").nz == 4
    assert km.edmd(data, km.State(), rank="hard-threshold").nz == 4
    assert km.bilinear_edmd(data, km.State(), rank="hard-threshold").nz == 4
    assert km.dmdc(data, rank=0.99).nz == km.bilinear_edmd(data, km.State(), rank=0.99).nz == 4


@pytest.mark.parametrize("difference", [False, True])
@pytest.mark.parametrize("rank", [2, 4])
def test_a_truncated_bilinear_fit_is_the_regression_on_the_leading_directions(rank: int, difference: bool) -> None:
    data = random_episodes(5, [90, 60], 2, 2)
    lifting = LIFTING.bind(data.states)
    s = data.snapshots()
    Z, Z_next = lifting(s.X), lifting(s.X_next)
    model = km.bilinear_edmd(data, LIFTING, rank=rank, difference=difference)
    V = model.lifting.basis
    assert np.allclose(V @ V.T @ Z.T, Z.T @ _leading(Z, rank), atol=1e-8)
    z = Z @ V
    P = np.hstack([z, s.U, s.U[:, :1] * z, s.U[:, 1:] * z])
    K = np.linalg.lstsq(P, Z_next @ V, rcond=None)[0]
    assert np.allclose(model.A, K[:rank].T, atol=1e-8)
    assert np.allclose(model.B, K[rank : rank + 2].T, atol=1e-8)
    assert np.allclose(model.N[0], K[rank + 2 : 2 * rank + 2].T, atol=1e-8)
    assert np.allclose(model.N[1], K[2 * rank + 2 :].T, atol=1e-8)
    error = s.X_next - P @ K @ model.C.T
    assert np.allclose(model.report.residual, np.sqrt(np.mean(error**2, axis=0)), rtol=1e-6)


def _leading(Z: np.ndarray, rank: int) -> np.ndarray:
    left = np.linalg.svd(Z, full_matrices=False)[0][:, :rank]
    return left @ left.T


def test_a_bilinear_fit_of_full_rank_predicts_the_same() -> None:
    data = random_episodes(2, [150], 2, 1)
    whole, reduced = km.bilinear_edmd(data, LIFTING), km.bilinear_edmd(data, LIFTING, rank=6)
    U = np.random.default_rng(0).uniform(-1, 1, (5, 1))
    assert np.allclose(whole.rollout([0.3, -0.2], U), reduced.rollout([0.3, -0.2], U), atol=1e-8)


@given(st.integers(0, 99))
def test_inputs_multiply_the_named_observables_alone(seed: int) -> None:
    """x₁⁺ = .9x₁ + .1x₂, x₂⁺ = .8x₂ + (1 + .5x₁) u₁ − .3 u₂: only x₁ is multiplied."""
    data = one_step_pairs(
        lambda x, u: np.array([0.9 * x[0] + 0.1 * x[1], 0.8 * x[1] + (1 + 0.5 * x[0]) * u[0] - 0.3 * u[1]]),
        2,
        2,
        40,
        seed,
    )
    model = km.bilinear_edmd(data, km.State(), products=["x0"])
    assert np.allclose(model.A, [[0.9, 0.1], [0, 0.8]], atol=1e-11)
    assert np.allclose(model.B, [[0, 0], [1, -0.3]], atol=1e-11)
    assert np.allclose(model.N, [[[0, 0], [0.5, 0]], np.zeros((2, 2))], atol=1e-11)
    assert model.report.columns == 2 + 2 + 2
    noisy = random_episodes(seed, [60], 2, 2)
    model, s = km.bilinear_edmd(noisy, LIFTING, products=["x1", "1", "x0^2"]), noisy.snapshots()
    Z = LIFTING.bind(noisy.states)(s.X)
    names = model.lifting.names
    which = [i for i, name in enumerate(names) if name in ("x1", "x0^2")]
    P = np.hstack([Z, s.U, s.U[:, :1] * Z[:, which], s.U[:, 1:] * Z[:, which]])
    K = np.linalg.lstsq(P, model.lift(s.X_next), rcond=None)[0]
    assert np.allclose(model.A, K[:6].T, atol=1e-8)
    assert np.allclose(model.N[1][:, which], K[10:].T, atol=1e-8)
    assert not np.delete(model.N, which, axis=2).any()
    none = km.bilinear_edmd(noisy, LIFTING, products=[])
    assert np.allclose(none.A, km.edmd(noisy, LIFTING).A, atol=1e-9)
    assert not none.N.any()


def test_a_rank_that_cannot_be_kept_is_refused() -> None:
    data = random_episodes(0, [50], 2, 1)
    with pytest.raises(km.errors.DataError, match="rank is 1; pass a whole"):
        km.edmd(data, LIFTING, rank=1.0)
    with pytest.raises(km.errors.DataError, match="rank is 7, but the lifting has 6 observables; pass 6 or less"):
        km.bilinear_edmd(data, LIFTING, rank=7)
    with pytest.raises(km.errors.DataError, match="a rank mixes all observables"):
        km.bilinear_edmd(data, LIFTING, rank=2, products=["x0"])
    with pytest.raises(km.errors.ObservableError, match="products names 'y', which the lifting lacks; it holds 1, x0"):
        km.bilinear_edmd(data, LIFTING, products=["y"])
    code = 'data = km.Episodes([km.Episode(X=np.eye(4))], 0.1)\nshow(lambda: km.dmd(data, rank="soft"))'
    said = "DataError rank is 'soft'; pass a whole number, a share of energy in (0, 1), or \"hard-threshold\""
    assert shown(code) == [said]
