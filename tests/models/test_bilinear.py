"""bilinear_edmd: exact on bilinear systems, equal to plain least squares, doubtful out loud."""

import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.models.plants import one_step_pairs, random_episodes

SQUARE = km.State() + km.Expressions(lambda x: [x[0] ** 2], ["x0^2"])


@given(st.integers(1, 3), st.integers(1, 2), st.booleans(), st.integers(0, 999))
def test_a_bilinear_system_is_recovered_exactly(nx: int, nu: int, difference: bool, seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, B = rng.uniform(-1, 1, (nx, nx)), rng.uniform(-1, 1, (nx, nu))
    N = rng.uniform(-1, 1, (nu, nx, nx))
    data = one_step_pairs(lambda x, u: A @ x + B @ u + u @ (N @ x), nx, nu, 100, seed)
    model = km.bilinear_edmd(data, km.State(), difference=difference)
    for found, true in ((model.A, A), (model.B, B), (model.N, N), (model.C, np.eye(nx))):
        assert np.allclose(found, true, rtol=0, atol=1e-11)
    U = rng.uniform(-0.3, 0.3, (8, nu))
    x = X0 = rng.uniform(-1, 1, nx)
    for u in U:
        x = A @ x + B @ u + u @ (N @ x)
    assert np.allclose(model.rollout(X0, U)[-1], x, rtol=1e-8, atol=1e-9)


def test_proctor_2018_inputs_that_enter_linearly_have_no_products() -> None:
    lam, mu, delta = 0.9, 0.5, 0.7
    data = one_step_pairs(
        lambda x, u: np.array([lam * x[0], mu * x[1] + (lam**2 - mu) * x[0] ** 2 + delta * u[0]]), 2, 1, 200
    )
    model = km.bilinear_edmd(data, SQUARE)
    assert np.allclose(model.A, [[lam, 0, 0], [0, mu, lam**2 - mu], [0, 0, lam**2]], rtol=0, atol=1e-12)
    assert np.allclose(model.B, [[0], [delta], [0]], rtol=0, atol=1e-12)
    assert np.allclose(model.N, 0, rtol=0, atol=1e-12)
    assert np.allclose(model.eigenvalues, [lam, lam**2, mu], rtol=0, atol=1e-12)
    assert np.abs(model.report.residual).max() < 1e-7  # as far as the Gram route resolves it


def test_an_input_on_the_squared_state_needs_the_products() -> None:
    """x₁⁺ = λx₁ + u: then x₁² has λ²x₁² + 2λ u x₁ + u², bilinear up to u²; with u ∈ {−1, 1} u² is the Constant."""
    rng = np.random.default_rng(0)
    lam, sign = 0.8, iter(rng.choice([-1.0, 1.0], 400))

    data = one_step_pairs(lambda x, u: lam * x + u, 1, 1, 300)
    binary = km.Episodes(
        [km.Episode(X=[e.X[0], lam * e.X[0] + v], U=[[v]]) for e, v in zip(data, sign, strict=False)], data.dt
    )
    model = km.bilinear_edmd(binary, km.State() + km.Monomials(2) + km.Constant())
    assert np.allclose(model.A, [[lam, 0, 0], [0, lam**2, 1], [0, 0, 1]], rtol=0, atol=1e-11)
    assert np.allclose(model.B, [[1], [0], [0]], rtol=0, atol=1e-11)
    assert np.allclose(model.N, [[[0, 0, 0], [2 * lam, 0, 0], [0, 0, 0]]], rtol=0, atol=1e-11)
    assert model.report.columns == 3 + 1 + 2  # u · 1 is u, and is not held twice


@pytest.mark.parametrize("route", ["gram", "qr"])
@pytest.mark.parametrize(
    "lifting", [km.State() + km.Fourier(1), km.Constant() + km.State() + km.Monomials(2), km.Fourier(2)]
)
def test_it_is_the_least_squares_of_numpy(route: str, lifting, monkeypatch: pytest.MonkeyPatch) -> None:
    data = random_episodes(1, [40, 900, 300], 2, 2)
    read = km.moments.second_moments
    monkeypatch.setattr("koopmpc.models.fits.bilinear.second_moments", lambda *a, **k: read(*a, route=route, **k))
    model = km.bilinear_edmd(data, lifting)
    s, bound = data.snapshots(), lifting.bind(data.states)
    Z, keep = bound(s.X), [i for i, name in enumerate(bound.names) if name != "1"]
    products = np.einsum("mi,mj->mij", s.U, Z[:, keep]).reshape(len(Z), -1)
    K = np.linalg.lstsq(np.hstack([Z, s.U, products]), bound(s.X_next), rcond=None)[0]
    nz = bound.nz
    assert np.allclose(model.A, K[:nz].T, rtol=0, atol=1e-8)
    assert np.allclose(model.B, K[nz : nz + 2].T, rtol=0, atol=1e-8)
    assert np.allclose(model.N[:, :, keep].transpose(0, 2, 1).reshape(-1, nz), K[nz + 2 :], rtol=0, atol=1e-8)
    gap = s.X_next @ np.eye(2) - np.hstack([Z, s.U, products]) @ K @ model.C.T
    assert np.allclose(model.report.residual, np.sqrt(np.mean(gap**2, axis=0)), rtol=1e-6)


def test_a_ridge_draws_towards_zero_or_towards_no_change() -> None:
    data = random_episodes(0, [200], 2, 1)
    heavy = 1e9
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plain = km.bilinear_edmd(data, km.State(), ridge=heavy)
        still = km.bilinear_edmd(data, km.State(), ridge=heavy, difference=True)
    assert np.allclose(plain.A, 0, atol=1e-6)
    assert np.allclose(still.A, np.eye(2), atol=1e-6)
    assert np.allclose(still.B, 0, atol=1e-6)


@given(st.integers(0, 99))
def test_its_residual_is_no_worse_than_that_of_edmd(seed: int) -> None:
    data = random_episodes(seed, [120], 2, 1)
    linear, bilinear = km.edmd(data, km.State() + km.Constant()), km.bilinear_edmd(data, km.State() + km.Constant())
    assert (bilinear.report.residual <= linear.report.residual * (1 + 1e-9)).all()


def test_moments_of_parts_add_up() -> None:
    data = random_episodes(3, [50, 70], 2, 1)
    parts = [km.moments.second_moments(data[i : i + 1], SQUARE, route="gram", bilinear=True) for i in range(2)]
    whole = km.moments.second_moments(data, SQUARE, route="gram", bilinear=True)
    assert np.allclose((parts[0] + parts[1]).sums, whole.sums, rtol=1e-12)
    with pytest.raises(km.errors.DataError, match="or one is bilinear"):
        _ = whole + km.moments.second_moments(data, SQUARE, route="gram")


def test_doubts_are_said_and_kept() -> None:
    data = one_step_pairs(lambda x, u: x, 2, 1, 4)
    with pytest.warns(km.FitWarning, match="4 snapshot pairs cannot determine 5 coefficients") as caught:
        model = km.bilinear_edmd(data, km.State())
    assert len(caught) == 1
    assert model.report.warnings == (str(caught[0].message),)


def test_data_without_inputs_and_wrong_settings_are_refused() -> None:
    with pytest.raises(km.errors.DataError, match="the episodes have no inputs; pass them to edmd"):
        km.bilinear_edmd(random_episodes(0, [20], 2, 0), km.State())
    with pytest.raises(km.errors.DataError, match="ridge is -1; it must be 0 or above"):
        km.bilinear_edmd(random_episodes(0, [20], 2, 1), km.State(), ridge=-1)
    wild = km.State() + km.Expressions(lambda x: [1e200 * x[0]], ["huge"])
    with np.errstate(over="ignore"), pytest.raises(km.errors.DataError, match="observable 'huge' is NaN, infinite"):
        km.bilinear_edmd(random_episodes(0, [20], 2, 1), wild)
