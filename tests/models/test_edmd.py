"""EDMD: least squares where that is well posed, exact on invariant subspaces, reduced on request."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.models.plants import brute_force, one_step_pairs, random_episodes

LIFTING = km.Constant() + km.State() + km.Monomials(2)


def step(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """A plant that no small lifting holds."""
    return np.array([0.9 * x[0] + 0.1 * np.sin(x[1]), 0.8 * x[1] - 0.1 * x[0] ** 3 + 0.2 * u[0]])


@given(st.lists(st.integers(1, 40), min_size=3, max_size=8), st.integers(0, 2), st.integers(0, 999))
def test_coefficients_are_those_of_lstsq(lengths: list[int], nu: int, seed: int) -> None:
    data = random_episodes(seed, [*lengths, 40], 2, nu)
    model = km.edmd(data, LIFTING)
    D = brute_force(data, model.lifting)
    nz = model.nz
    K = np.linalg.lstsq(D[:, : nz + nu], D[:, nz + nu :], rcond=None)[0]
    assert np.allclose(model.A, K[:nz].T, rtol=0, atol=1e-9)
    assert np.allclose(model.B, K[nz:].T, rtol=0, atol=1e-9)
    error = D[:, nz + nu :] - D[:, : nz + nu] @ K
    assert np.allclose(model.report.residual, np.sqrt(np.mean(error[:, 1:3] ** 2, axis=0)), rtol=1e-9)
    assert model.report.samples == sum(lengths) + 40
    assert model.report.rank == model.report.columns == nz + nu
    assert not model.report.warnings


def test_episodes_of_two_regimes_are_not_paired() -> None:
    # within each regime x⁺ = x/2; a pair across the seam would be −100 → +100
    halves = 0.5 ** np.arange(6)[:, None]
    data = km.Episodes([km.Episode(X=-100 * halves), km.Episode(X=100 * halves), km.Episode(X=-100 * halves)], 0.1)
    assert np.allclose(km.edmd(data, km.State()).A, 0.5, rtol=0, atol=1e-14)


def test_no_observable_is_added() -> None:
    data = one_step_pairs(step, 2, 1, 100)
    for lifting in (km.State(), km.Fourier(1), km.Monomials(2) + km.State()):
        assert km.edmd(data, lifting).lifting.names == lifting.bind(data.states).names


def test_C_picks_the_states_by_name() -> None:
    data = one_step_pairs(step, 2, 1, 100)
    model = km.edmd(data, km.Monomials(2) + km.State())
    assert np.array_equal(model.C, np.eye(5)[3:])
    assert np.array_equal(model.report.state_residual, [0, 0])


def test_C_is_a_least_squares_fit_where_the_lifting_lacks_a_state() -> None:
    data = one_step_pairs(step, 2, 1, 100)
    theta = km.Expressions(lambda x: [x[0]], ["x0"])  # one state is held, the other is not
    lifting = (theta + km.Fourier(1)).bind(data.states)
    model = km.edmd(data, lifting)
    snapshots = data.snapshots()
    Z, X = lifting(snapshots.X), snapshots.X
    C = np.linalg.lstsq(Z, X, rcond=None)[0].T
    assert np.array_equal(model.C[0], [1, 0, 0, 0, 0])
    assert np.allclose(model.C[1], C[1], atol=1e-9)
    error = np.sqrt(np.mean((X - Z @ model.C.T) ** 2, axis=0))
    assert np.allclose(model.report.state_residual, error, atol=1e-7)
    ahead = (Z @ model.A.T + snapshots.U @ model.B.T) @ model.C.T
    residual = np.sqrt(np.mean((snapshots.X_next - ahead) ** 2, axis=0))
    # the first is exact: Gram sums see its residual to 1e-8 of the state
    assert np.allclose(model.report.residual, residual, rtol=1e-6, atol=1e-7)


@given(st.floats(1e-6, 10), st.integers(0, 99))
def test_ridge_solves_the_normal_equations_of_deviations_from_the_mean(ridge: float, seed: int) -> None:
    data = random_episodes(seed, [50, 20], 2, 1)
    model = km.edmd(data, LIFTING, ridge=ridge)
    D = brute_force(data, model.lifting)
    P, T = D[:, : model.nz + 1], D[:, model.nz + 1 :]
    spread = np.linalg.norm(P - P.mean(axis=0), axis=0)  # 0 for the constant
    K = np.linalg.solve(P.T @ P + ridge * np.diag(spread**2), P.T @ T)
    assert np.allclose(np.hstack([model.A, model.B]), K.T, rtol=0, atol=1e-9)
    assert f"ridge {ridge:g} on unit-norm deviations" in model.report.route
    assert model.report.ridge == ridge
    plain = km.edmd(data, km.State(), ridge=ridge)
    P, T = np.delete(D[:, : model.nz + 1], [0, *range(3, model.nz)], axis=1), D[:, model.nz + 2 : model.nz + 4]
    K = np.linalg.solve(P.T @ P + ridge * np.diag(np.sum(P**2, axis=0)), P.T @ T)
    assert np.allclose(np.hstack([plain.A, plain.B]), K.T, rtol=0, atol=1e-9)


@given(
    st.sampled_from(["edmd", "bilinear", "stable", "constrained"]),
    st.sampled_from([1e-6, 1e-2, "gcv"]),
    st.integers(0, 99),
)
def test_where_the_data_have_their_zero_changes_no_ridge(kind: str, ridge: float | str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, shift, drive = np.array([50.0, -20.0]), np.array([50.0, -20.0]), np.array([7.0])
    fits = {
        "edmd": km.edmd,
        "bilinear": km.bilinear_edmd,
        "stable": km.identify.stable_edmd,
        "constrained": lambda *a, **k: km.identify.constrained_edmd(
            *a, prior=km.identify.Prior(rows={"1": {"1": 1.0}}), **k
        ),
    }

    def fitted(at: np.ndarray, by: np.ndarray) -> np.ndarray:
        moved = km.Episodes([km.Episode(X=e.X + at, U=e.U + by) for e in data], data.dt)
        model = fits[kind](moved, km.State() + km.Constant(), ridge=ridge, route="qr")
        points, inputs = x - shift + at + ahead, by + pushes
        z = model.lift(points)
        nonlinear = 0.0 if kind != "bilinear" else np.einsum("ku,uij,kj->ki", inputs, model.N, z)
        return (z @ model.A.T + inputs @ model.B.T + nonlinear) @ model.C.T - at

    data = one_step_pairs(lambda x, u: np.sin(2 * x) * 0.6 + 0.3 * u + 0.2 * u * x, 2, 1, 60, seed)
    ahead, pushes = rng.uniform(-1, 1, (10, 2)), rng.uniform(-1, 1, (10, 1))
    assert np.allclose(
        fitted(shift, drive), fitted(0 * shift, 0 * drive), rtol=0, atol=1e-4 if ridge == "gcv" else 1e-8
    )


def test_units_of_the_states_mean_nothing() -> None:
    units = np.array([1.0, 1e4, 1.0, 1e-4])
    rng = np.random.default_rng(0)
    A = 0.5 * rng.standard_normal((4, 4))

    def four(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.sin(A @ x) + u[0] * np.array([0, 0.1, 0, 1])

    data = one_step_pairs(four, 4, 1, 400)
    other = km.Episodes([km.Episode(X=e.X * units, U=e.U) for e in data], data.dt)
    plain, scaled = km.edmd(data, LIFTING), km.edmd(other, LIFTING)
    U = rng.uniform(-0.2, 0.2, (20, 1))
    x0 = rng.uniform(-0.5, 0.5, 4)
    assert np.allclose(scaled.rollout(x0 * units, U) / units, plain.rollout(x0, U), rtol=0, atol=1e-10)
    assert np.allclose(scaled.report.residual / units, plain.report.residual)


def test_ridge_zero_says_what_it_cuts() -> None:
    data = random_episodes(0, [200], 2, 1)
    report = km.edmd(data, LIFTING).report
    cut = 200 * np.finfo(float).eps
    assert report.route == f"gram, singular values cut at {cut:.1e} of the largest on unit-norm columns"
    assert report.method == "edmd"


@pytest.mark.parametrize("nu", [0, 1])
@pytest.mark.parametrize("rank", [1, 3, 6])
def test_a_truncated_fit_is_the_regression_on_the_leading_directions(rank: int, nu: int) -> None:
    data = random_episodes(0, [80, 40], 2, nu)
    lifting = LIFTING.bind(data.states)
    model = km.edmd(data, LIFTING, rank=rank)
    s = data.snapshots()
    Z, Z_next = lifting(s.X), lifting(s.X_next)
    U_r = np.linalg.svd(Z.T, full_matrices=False)[0][:, :rank]
    assert isinstance(model.lifting, km.lifting.Projected)
    assert model.A.shape == (rank, rank)
    assert model.lifting.nz == rank
    projector = model.lifting.basis @ model.lifting.basis.T
    assert np.allclose(projector, U_r @ U_r.T, atol=1e-8)
    K = np.linalg.lstsq(np.hstack([Z @ U_r, s.U]), Z_next, rcond=None)[0]
    whole = U_r.T @ K[:rank].T  # Ã in the oracle's basis
    assert np.allclose(
        np.sort_complex(np.linalg.eigvals(whole)), np.sort_complex(np.linalg.eigvals(model.A)), atol=1e-8
    )
    ahead = (Z @ U_r @ whole.T + s.U @ (U_r.T @ K[rank:].T).T) @ (lifting_rows() @ U_r).T
    residual = np.sqrt(np.mean((s.X_next - ahead) ** 2, axis=0))
    assert np.allclose(model.report.residual, residual, rtol=1e-6, atol=1e-9)
    lost = np.sqrt(np.mean((s.X - Z @ projector @ lifting_rows().T) ** 2, axis=0))
    assert np.allclose(model.report.state_residual, lost, atol=1e-7)
    assert model.report.rank == rank


def lifting_rows() -> np.ndarray:
    """C of `LIFTING` on two states: rows 1 and 2 of six."""
    return np.eye(6)[1:3]


def test_exact_modes_are_eigenvectors_of_the_fitted_operator() -> None:
    # Tu et al. 2014, theorem 1: Φ = X′VΣ⁻¹W are eigenvectors of X′X⁺ on the rank-r data
    data = random_episodes(0, [120], 2, 0)
    model = km.edmd(data, LIFTING, rank=3)
    lifting = LIFTING.bind(data.states)
    s = data.snapshots()
    Z, Z_next = lifting(s.X).T, lifting(s.X_next).T
    U, S, Vt = np.linalg.svd(Z, full_matrices=False)
    operator = Z_next @ (Vt[:3].T / S[:3]) @ U[:, :3].T
    assert model.exact_modes is not None
    Phi = model.exact_modes
    assert np.allclose(operator @ Phi, Phi * model.eigenvalues, atol=1e-8)
    assert np.linalg.norm(Phi, axis=0).min() > 1e-3
    assert np.allclose(model.modes, Phi[1:3])


def test_full_rank_without_truncation_predicts_the_same() -> None:
    data = one_step_pairs(step, 2, 1, 200)
    whole, reduced = km.edmd(data, LIFTING), km.edmd(data, LIFTING, rank=6)
    U = np.random.default_rng(0).uniform(-1, 1, (20, 1))
    assert np.allclose(whole.rollout([0.3, -0.2], U), reduced.rollout([0.3, -0.2], U), atol=1e-10)


def test_who_asks_edmd_for_a_bilinear_model_is_told_its_function() -> None:
    with pytest.raises(km.errors.DataError, match=r"km\.bilinear_edmd"):
        km.edmd(random_episodes(0, [50], 2, 1), LIFTING, **{"bilinear": True})


def test_a_wrong_ridge_or_rank_is_refused() -> None:
    data = random_episodes(0, [50], 2, 1)
    with pytest.raises(km.errors.DataError, match=r"ridge is -1; it must be 0 or above"):
        km.edmd(data, LIFTING, ridge=-1)
    with pytest.raises(km.errors.DataError, match=r"rank is 7, but the lifting has 6 observables; pass 6 or less"):
        km.edmd(data, LIFTING, rank=7)
    with pytest.raises(km.errors.DataError, match=r"rank is 0; it must be at least 1"):
        km.edmd(data, LIFTING, rank=0)
