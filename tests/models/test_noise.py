"""Noisy snapshots: least squares shrinks A, total least squares and forward–backward DMD do not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.bare import shown
from tests.models.plants import random_episodes

METHODS = ("ls", "tls", "fb")
SEEDS = 60


def turning(size: float, angle: float) -> np.ndarray:
    return size * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def measured(A: np.ndarray, seed: int, noise: float, steps: int = 100, B: np.ndarray | None = None) -> km.Episodes:
    """One run of x⁺ = A x + B u, u = ±½, seen with white noise."""
    rng = np.random.default_rng(seed)
    drive = np.zeros((len(A), 0)) if B is None else B
    X, U = [2 * rng.standard_normal(len(A))], rng.choice([-0.5, 0.5], (steps, drive.shape[1]))
    for u in U:
        X.append(A @ X[-1] + drive @ u)
    return km.Episodes([km.Episode(X=X + noise * rng.standard_normal((steps + 1, len(A))), U=U)], 0.1)


@pytest.mark.parametrize(("size", "angle"), [(0.99, 0.3), (1.0, 0.3), (0.99, 2.0)])
@pytest.mark.parametrize("lifting", [None, km.State() + km.Constant()])
def test_the_bias_of_the_eigenvalues_falls(size: float, angle: float, lifting) -> None:
    A = turning(size, angle)
    bias = dict.fromkeys(METHODS, 0.0)
    for seed in range(SEEDS):
        data = measured(A, seed, 0.2)
        for method in METHODS:
            model = km.dmd(data, method=method) if lifting is None else km.edmd(data, lifting, method=method)
            swinging = model.eigenvalues[np.abs(model.eigenvalues.imag) > 0.05]
            bias[method] += (np.abs(swinging).mean() - size) / SEEDS
    assert bias["ls"] < -0.02  # least squares makes the motion decay
    assert abs(bias["tls"]) < 0.1 * abs(bias["ls"])
    assert abs(bias["fb"]) < 0.1 * abs(bias["ls"])


def test_the_bias_falls_with_inputs_too() -> None:
    A, B = turning(0.95, 0.3), np.array([[0.0], [1.0]])
    bias, gap = dict.fromkeys(METHODS, 0.0), {name: np.zeros((2, 1)) for name in METHODS}
    for seed in range(SEEDS):
        data = measured(A, seed, 0.2, B=B)
        for method in METHODS:
            model = km.dmdc(data, method=method)
            bias[method] += (np.abs(model.eigenvalues).mean() - 0.95) / SEEDS
            gap[method] += (model.B - B) / SEEDS
    for method in ("tls", "fb"):
        assert abs(bias[method]) < 0.2 * abs(bias["ls"])
        assert np.abs(gap[method]).max() < 0.02


@pytest.mark.parametrize("rank", [4, "hard-threshold"])
def test_the_bias_falls_for_many_sensors_at_a_rank(rank) -> None:
    rng = np.random.default_rng(0)
    Q = np.linalg.qr(rng.standard_normal((30, 4)))[0]
    A = np.zeros((4, 4))
    A[:2, :2], A[2:, 2:] = turning(0.995, 0.3), turning(0.99, 0.9)
    size = np.sort(np.abs(np.linalg.eigvals(A)))
    bias = dict.fromkeys(METHODS, 0.0)
    for seed in range(15):
        clean = measured(A, seed, 0.0, steps=60)[0].X
        noisy = 4 * clean @ Q.T + 0.3 * np.random.default_rng(seed).standard_normal((61, 30))
        data = km.Episodes([km.Episode(X=noisy)], 0.1)
        for method in METHODS:
            model = km.dmd(data, rank=rank, method=method)
            bias[method] += float(np.abs(model.eigenvalues).sum() / model.nz - size.mean()) / 15
    assert bias["ls"] < 0
    assert abs(bias["tls"]) < 0.5 * abs(bias["ls"])
    assert abs(bias["fb"]) < 0.5 * abs(bias["ls"])


@pytest.mark.parametrize("method", ["tls", "fb"])
@given(st.integers(1, 4), st.integers(0, 2), st.integers(0, 999))
def test_without_noise_the_answer_is_exact(method: str, nx: int, nu: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    Q = np.linalg.qr(rng.standard_normal((nx, nx)))[0]
    A = Q @ np.diag(rng.uniform(0.5, 1.1, nx) * rng.choice([-1, 1], nx)) @ Q.T
    B = rng.standard_normal((nx, nu))
    parts = []
    for _ in range(12):
        X, U = [rng.standard_normal(nx)], rng.standard_normal((8, nu))
        for u in U:
            X.append(A @ X[-1] + B @ u)
        parts.append(km.Episode(X=X, U=U))
    data = km.Episodes(parts, 0.1)
    model = km.dmdc(data, method=method) if nu else km.dmd(data, method=method)
    assert np.allclose(model.A, A, atol=1e-8)
    assert np.allclose(model.B, B, atol=1e-8)
    assert np.all(model.report.residual < 1e-7)
    if nu:
        known = km.dmdc(data, B=B, method=method)
        assert np.allclose(known.A, A, atol=1e-8)
    reduced = km.dmdc(data, rank=nx, method=method) if nu else km.dmd(data, rank=nx, method=method)
    assert np.allclose(np.sort_complex(reduced.eigenvalues), np.sort_complex(model.eigenvalues), atol=1e-6)


@pytest.mark.parametrize("method", ["tls", "fb"])
def test_without_noise_a_lifted_model_is_exact(method: str) -> None:
    """x₀⁺ = .9x₀ + .1, x₁⁺ = .5x₁ + .3x₀² + u, on [x₀, x₁, x₀², 1]."""
    rng = np.random.default_rng(0)
    lifting = km.State() + km.Expressions(lambda x: [x[0] ** 2], ["x0^2"]) + km.Constant()
    parts = []
    for x, u in zip(rng.uniform(-1, 1, (80, 2)), rng.uniform(-1, 1, (80, 1)), strict=True):
        parts.append(km.Episode(X=[x, [0.9 * x[0] + 0.1, 0.5 * x[1] + 0.3 * x[0] ** 2 + u[0]]], U=[u]))
    model = km.edmd(km.Episodes(parts, 0.1), lifting, method=method)
    exact = [[0.9, 0, 0, 0.1], [0, 0.5, 0.3, 0], [0.18, 0, 0.81, 0.01], [0, 0, 0, 1]]
    assert np.allclose(model.A, exact, atol=1e-7)
    assert np.allclose(model.B, [[0], [1], [0], [0]], atol=1e-7)
    word = {"tls": "total least squares", "fb": "forward and backward"}[method]
    assert f"{word}, singular values cut" in model.report.route


def test_total_least_squares_is_the_smallest_change_that_makes_the_data_exact() -> None:
    """Golub & Van Loan: min ‖[ΔX ΔX⁺]‖_F with x⁺ + Δx⁺ = A (x + Δx) is the sum of the last n squared σ."""
    data = measured(turning(0.9, 0.5), 3, 0.3)
    s = data.snapshots()
    A = km.dmd(data, method="tls").A

    def least_change(A: np.ndarray) -> float:
        # rows e = x⁺ − A x; the smallest [Δx Δx⁺] with Δx⁺ − A Δx = −e
        E, W = s.X_next - s.X @ A.T, np.hstack([-A, np.eye(2)])
        return float(np.sum(E @ np.linalg.inv(W @ W.T) * E))

    best = least_change(A)
    sigma = np.linalg.svd(np.hstack([s.X, s.X_next]), compute_uv=False)
    assert best == pytest.approx(np.sum(sigma[2:] ** 2))
    rng = np.random.default_rng(0)
    assert all(least_change(A + 1e-3 * rng.standard_normal((2, 2))) > best for _ in range(20))


def test_units_of_a_lifted_fit_mean_nothing() -> None:
    data = measured(turning(0.95, 0.4), 1, 0.1, B=np.array([[0.0], [1.0]]))
    units = np.array([1e3, 1e-2])
    other = km.Episodes([km.Episode(X=e.X * units, U=e.U) for e in data], data.dt)
    for method in ("tls", "fb"):
        a, b = (km.edmd(d, km.State() + km.Constant(), method=method) for d in (data, other))
        size = np.append(units, 1.0)
        assert np.allclose(b.A * size / size[:, None], a.A, atol=1e-8)
        assert np.allclose(b.B / size[:, None], a.B, atol=1e-8)


def test_a_double_integrator_runs_backward_though_it_is_defective() -> None:
    A = np.array([[1.0, 0.1], [0.0, 1.0]])
    data = measured(A, 0, 0.0, steps=30, B=np.array([[0.005], [0.1]]))
    assert np.allclose(km.dmdc(data, method="fb").A, A, atol=1e-7)


def test_what_has_no_sound_form_is_refused() -> None:
    data = measured(turning(0.9, 0.5), 0, 0.1)
    with pytest.raises(km.errors.DataError, match='a ridge shrinks A, and method="tls" undoes what noise shrank'):
        km.edmd(data, km.State(), ridge=0.1, method="tls")
    few = random_episodes(0, [5], 4, 2)
    with pytest.raises(
        km.errors.DataError, match=r"5 snapshot pairs cannot tell noise from 4 directions.*a rank below 3"
    ):
        km.dmdc(few, rank=4, method="tls")
    dead = km.Episodes([km.Episode(X=[x, [0.5 * x[0], 0]]) for x in np.random.default_rng(0).random((20, 2))], 0.1)
    with pytest.raises(km.errors.DataError, match=r"a direction of ψ.x. decays to 0 in one step"):
        km.dmd(dead, method="fb")
    turned = random_episodes(5, [12], 3, 0)
    with pytest.raises(km.errors.DataError, match="no real square root"):
        km.dmd(turned, method="fb")
    code = 'data = km.Episodes([km.Episode(X=np.eye(4))], 0.1)\nshow(lambda: km.dmd(data, method="odr"))'
    assert shown(code) == ["DataError method is 'odr'; pass one of 'ls', 'tls', 'fb'"]


@pytest.mark.parametrize("angle", [0.3, 0.8, 1.2, 1.5, 1.7, 2.5, 3.1])
def test_without_noise_a_fast_rotation_keeps_its_frequency(angle: float) -> None:
    """The square root of A² has two signs; beyond 45° the principal one of a real part is no longer A's."""
    A = np.block([[turning(0.9, angle), np.zeros((2, 1))], [np.zeros((1, 2)), -0.7]])
    model = km.dmd(measured(A, 0, 0.0, steps=15), method="fb")
    assert np.allclose(model.A, A, atol=1e-8)
