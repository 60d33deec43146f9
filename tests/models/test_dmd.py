"""DMD and DMDc, tall data included."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.models.plants import random_episodes


@given(st.integers(1, 4), st.integers(0, 2), st.integers(0, 999))
def test_dmd_is_the_pseudo_inverse_and_leaves_inputs_out(nx: int, nu: int, seed: int) -> None:
    data = random_episodes(seed, [15, 20], nx, nu)
    s = data.snapshots()
    model = km.dmd(data)
    assert np.allclose(model.A, s.X_next.T @ np.linalg.pinv(s.X.T), atol=1e-10)
    assert model.nu == 0
    assert np.allclose(model.report.residual, np.sqrt(np.mean((s.X_next - s.X @ model.A.T) ** 2, axis=0)))


@given(st.integers(1, 3), st.integers(1, 2), st.integers(0, 999))
def test_dmdc_is_the_pseudo_inverse_of_states_and_inputs(nx: int, nu: int, seed: int) -> None:
    data = random_episodes(seed, [15, 20], nx, nu)
    s = data.snapshots()
    K = s.X_next.T @ np.linalg.pinv(np.hstack([s.X, s.U]).T)
    model = km.dmdc(data)
    assert np.allclose(np.hstack([model.A, model.B]), K, atol=1e-10)
    B = np.ones((nx, nu))
    known = km.dmdc(data, B=B)
    assert np.array_equal(known.B, B)
    assert np.allclose(known.A, (s.X_next - s.U @ B.T).T @ np.linalg.pinv(s.X.T), atol=1e-10)
    error = s.X_next - s.X @ known.A.T - s.U @ B.T
    assert np.allclose(known.report.residual, np.sqrt(np.mean(error**2, axis=0)))


def tall(nx: int, r: int, steps: int) -> tuple[km.Episodes, np.ndarray]:
    """r oscillations seen in nx places: more states than snapshots; and their eigenvalues."""
    rng = np.random.default_rng(0)
    angles, sizes = rng.uniform(0.2, 1.5, r // 2), rng.uniform(0.8, 1.0, r // 2)
    A = np.zeros((r, r))
    for i, (a, s) in enumerate(zip(angles, sizes, strict=True)):
        A[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = s * np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    Q = np.linalg.qr(rng.standard_normal((nx, r)))[0]
    episodes = []
    for _ in range(3):
        z = [rng.standard_normal(r)]
        for _ in range(steps):
            z.append(A @ z[-1])
        episodes.append(km.Episode(X=np.array(z) @ Q.T))
    return km.Episodes(episodes, 0.1), np.linalg.eigvals(A)


def test_tall_data_without_a_square_array_of_the_states() -> None:
    nx = 40_000  # an (nx, nx) array would be 12.8 GB
    data, eigenvalues = tall(nx, 4, 8)
    model = km.dmd(data, rank=4)
    assert model.A.shape == (4, 4)
    assert np.allclose(np.sort_complex(model.eigenvalues), np.sort_complex(eigenvalues), atol=1e-10)
    assert model.modes.shape == (nx, 4)
    ahead = model.rollout(data[0].X[0], np.empty((8, 0)))
    assert np.allclose(ahead, data[0].X, atol=1e-10)
    assert np.all(model.report.residual < 1e-12)


@pytest.mark.parametrize("with_input", [False, True])
def test_the_small_side_and_the_moments_agree(with_input: bool) -> None:
    # 20 pairs of 8 states go through moments; the same turned into 13 states do not
    rng = np.random.default_rng(0)
    data = random_episodes(0, [10, 10], 8, 1 if with_input else 0)
    Q = np.linalg.qr(rng.standard_normal((13, 8)))[0]
    wide = km.Episodes([km.Episode(X=e.X @ Q.T, U=e.U) for e in data], 0.1)
    fit = km.dmdc if with_input else km.dmd
    a, b = fit(data, rank=3), fit(wide, rank=3)
    assert np.allclose(np.sort_complex(a.eigenvalues), np.sort_complex(b.eigenvalues), atol=1e-10)
    assert np.linalg.norm(a.report.residual) == pytest.approx(np.linalg.norm(b.report.residual))
    U = rng.uniform(-1, 1, (5, a.nu))
    x = data[0].X[0]
    assert np.allclose(a.rollout(x, U) @ Q.T, b.rollout(Q @ x, U), atol=1e-9)


def test_known_B_and_rank_together() -> None:
    data = random_episodes(0, [30, 30], 4, 1)
    B = np.arange(4.0)[:, None]
    s = data.snapshots()
    model: km.LinearPredictor = km.dmdc(data, B=B, rank=2)
    U_r = np.linalg.svd(s.X.T, full_matrices=False)[0][:, :2]
    A = U_r.T @ (s.X_next - s.U @ B.T).T @ np.linalg.pinv((s.X @ U_r).T)
    U = np.random.default_rng(0).uniform(-1, 1, (6, 1))
    z, expected = U_r.T @ s.X[0], [s.X[0]]
    for u in U:
        z = A @ z + U_r.T @ B @ u
        expected.append(U_r @ z)
    assert np.allclose(model.rollout(s.X[0], U), expected, atol=1e-10)
    error = (s.X_next - (s.X @ U_r @ A.T + s.U @ B.T @ U_r) @ U_r.T) ** 2
    assert np.allclose(model.report.residual, np.sqrt(np.mean(error, axis=0)))


def test_the_report_states_the_cut_of_singular_values() -> None:
    data = random_episodes(0, [200], 3, 1)
    report = km.dmd(data).report
    assert (
        report.route
        == f"svd, singular values cut at {200 * np.finfo(float).eps:.1e} of the largest on unscaled columns"
    )
    assert km.dmd(data, rank=2).report.route == "svd, truncated SVD of unscaled columns at rank 2"


def test_a_wrong_rank_or_known_matrix_is_refused() -> None:
    data = random_episodes(0, [20], 2, 0)
    with pytest.raises(km.errors.DataError, match="the episodes have no inputs; pass them to dmd"):
        km.dmdc(data)
    with pytest.raises(km.errors.ShapeError, match=r"B has shape \(2,\), expected \(2, 1\)"):
        km.dmdc(random_episodes(0, [20], 2, 1), B=[1, 2])
    with pytest.raises(km.errors.DataError, match="rank is 3, but the lifting has 2 observables"):
        km.dmd(data, rank=3)


def test_fewer_snapshots_than_states_warn_unless_a_rank_is_given() -> None:
    data = random_episodes(0, [3], 5, 0)
    with pytest.warns(km.FitWarning, match="3 snapshot pairs cannot determine 5 coefficients"):
        model = km.dmd(data)
    s = data.snapshots()
    assert np.allclose(model.A, s.X_next.T @ np.linalg.pinv(s.X.T))
    km.dmd(data, rank=2)  # no warning
