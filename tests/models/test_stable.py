"""Stable fits: stable, unmoved where nothing has to move, closer than clipping, convex optimum where that is known."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.models.plants import brute_force, random_episodes


def spectral_radius(A: np.ndarray) -> float:
    return float(np.abs(np.linalg.eigvals(A)).max())


def clip_eigenvalues(A: np.ndarray, radius: float) -> np.ndarray:
    values, V = np.linalg.eig(A)
    return ((V * (values * np.minimum(1, radius / np.abs(values)))) @ np.linalg.inv(V)).real


def runs(seed: int, nx: int, nu: int, *, radius: float, noise: float, offset: float = 0.0) -> km.Episodes:
    """Noisy measurements of a linear plant with this spectral radius."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((nx, nx))
    A *= radius / spectral_radius(A)
    B = rng.standard_normal((nx, nu))
    parts: list[km.Episode] = []
    for _ in range(2 + nx // 10):
        X, U = [rng.standard_normal(nx)], rng.uniform(-1, 1, (15, nu))
        for u in U:
            X.append(A @ X[-1] + B @ u + offset)
        parts.append(km.Episode(X=np.array(X) + noise * rng.standard_normal((16, nx)), U=U))
    return km.Episodes(parts, 0.1)


def objective(data: km.Episodes, model) -> float:
    """Return Σᵢ ‖ψᵢ(x⁺) − …‖² / ‖ψᵢ(x)‖² over all rows."""
    D = brute_force(data, model.lifting)
    nz = model.nz
    error = D[:, -nz:] - D[:, :-nz] @ np.hstack([model.A, model.B]).T
    return float(np.sum(np.sum(error**2, axis=0) / np.sum(D[:, :nz] ** 2, axis=0)))


def refitted(data: km.Episodes, model, A: np.ndarray) -> float:
    """Return the objective of another A with the best B."""
    D = brute_force(data, model.lifting)
    nz = model.nz
    Z, U, T = D[:, :nz], D[:, nz:-nz], D[:, -nz:]
    rest = T - Z @ A.T
    rest = rest - U @ np.linalg.lstsq(U, rest, rcond=None)[0]
    return float(np.sum(np.sum(rest**2, axis=0) / np.sum(Z**2, axis=0)))


@pytest.mark.filterwarnings("ignore:stability costs much")
@given(st.integers(0, 999), st.integers(1, 6), st.integers(0, 2), st.floats(0.2, 1.2))
@settings(max_examples=10)
def test_it_is_stable_and_closer_than_clipping(seed: int, nx: int, nu: int, radius: float) -> None:
    data = runs(seed, nx, nu, radius=1.0, noise=0.3)
    plain, model = km.edmd(data, km.State()), km.identify.stable_edmd(data, km.State(), radius=radius)
    assert spectral_radius(model.A) <= radius + 1e-9
    if spectral_radius(plain.A) <= radius:
        assert np.allclose(model.A, plain.A, rtol=0, atol=1e-12)
        assert np.allclose(model.B, plain.B, rtol=0, atol=1e-12)
        assert "the plain fit stays" in model.report.changes[0]
        return
    own = objective(data, model)
    assert own == pytest.approx(refitted(data, model, model.A), rel=1e-9)  # B is the best for this A
    others = (clip_eigenvalues(plain.A, radius), plain.A * radius / spectral_radius(plain.A))
    assert own <= min(refitted(data, model, A) for A in others) * (1 + 1e-9)
    assert (
        f"spectral radius {spectral_radius(plain.A):.6g} before, {spectral_radius(model.A):.6g} after"
        in model.report.changes
    )
    losses = zip(data.states, plain.report.residual, model.report.residual, strict=True)
    said = tuple(f"one-step residual of {n!r}: {b:.3g} before, {a:.3g} after" for n, b, a in losses)
    assert model.report.changes[2:] == said


def test_one_observable_moves_to_the_circle() -> None:
    x = 1.2 ** np.arange(10)[:, None]
    model = km.identify.stable_edmd(km.Episodes([km.Episode(X=x)], 0.1), km.State(), radius=0.9)
    assert np.allclose(model.A, 0.9, rtol=0, atol=1e-9)


def test_a_constant_keeps_its_row_and_its_eigenvalue() -> None:
    data = runs(4, 3, 1, radius=1.0, noise=0.3, offset=0.5)
    lifting = km.State() + km.Constant() + km.Monomials(2)
    model = km.identify.stable_edmd(data, lifting, radius=0.8)
    row = model.lifting.names.index("1")
    assert np.array_equal(model.A[row], np.eye(model.nz)[row])
    assert np.array_equal(model.B[row], [0.0])
    sizes = np.sort(np.abs(model.eigenvalues))[::-1]
    assert sizes[0] == pytest.approx(1.0, abs=1e-9)
    assert sizes[1] <= 0.8 + 1e-9


def test_a_ridge_counts_in_the_plain_and_in_the_stable_fit() -> None:
    data = runs(4, 3, 1, radius=1.0, noise=0.3)
    plain = km.identify.stable_edmd(data, km.State(), ridge=0.1, radius=5.0)
    assert np.allclose(plain.A, km.edmd(data, km.State(), ridge=0.1).A, atol=1e-12)
    model = km.identify.stable_edmd(data, km.State(), ridge=0.1, radius=0.5)
    assert spectral_radius(model.A) <= 0.5 + 1e-9
    assert model.report.ridge == 0.1


def test_the_ridge_of_cross_validation_is_that_of_the_plain_fit() -> None:
    data = runs(1, 3, 1, radius=1.05, noise=0.3)
    plain = km.edmd(data, km.State(), ridge="gcv")
    assert plain.report.ridge > 0
    free, none = km.identify.Prior(mask_A=[[1, 1, 0], [1, 1, 1], [1, 1, 1]]), km.identify.Prior()
    stable = partial(km.identify.stable_edmd, data, km.State())
    constrained = partial(km.identify.constrained_edmd, data, km.State())
    for model, same in (
        (stable(ridge="gcv", radius=5.0), stable(radius=5.0)),
        (stable(ridge="gcv", radius=0.5), stable(radius=0.5)),
        (constrained(prior=none, ridge="gcv"), km.edmd(data, km.State())),
        (constrained(prior=free, ridge="gcv"), km.edmd(data, km.State())),
    ):
        assert model.report.ridge == plain.report.ridge
        assert "chosen by generalised cross-validation" in model.report.route
        assert not np.array_equal(model.A, same.A)
    assert np.array_equal(constrained(prior=free, ridge=plain.report.ridge).A, constrained(prior=free, ridge="gcv").A)
    assert np.allclose(constrained(prior=none, ridge="gcv").A, plain.A, atol=1e-12)


def test_more_observables_than_the_inequality_takes() -> None:
    data = runs(0, 24, 2, radius=1.02, noise=0.3)
    model = km.identify.stable_edmd(data, km.State(), radius=0.9)
    assert spectral_radius(model.A) <= 0.9 + 1e-9
    plain = km.edmd(data, km.State())
    assert objective(data, model) <= refitted(data, model, clip_eigenvalues(plain.A, 0.9))


def test_nearly_dependent_observables_stay_as_close_as_a_ridge_would_have_them() -> None:
    generator = np.random.default_rng(0)
    episodes = []
    for x in generator.uniform(-1, 1, (40, 2)):  # a pendulum, pushed at random
        X, U = [x], generator.uniform(-5, 5, (60, 1))
        for (u,) in U:
            v = X[-1][1] + 0.05 * (u - 9.81 * np.sin(X[-1][0]))
            X.append(np.array([X[-1][0] + 0.05 * v, v]))
        episodes.append(km.Episode(X=np.array(X), U=U))
    data = km.Episodes(episodes, 0.05)
    lifting = km.State() + km.ThinPlate(generator.uniform(-2, 2, (30, 2)))
    plain, model, ridged = (
        km.edmd(data, lifting),
        km.identify.stable_edmd(data, lifting),
        km.identify.stable_edmd(data, lifting, ridge=1e-10),
    )
    assert spectral_radius(plain.A) > 1 >= spectral_radius(model.A) - 1e-9
    least, with_ridge = objective(data, plain), objective(data, ridged)
    assert objective(data, model) - least <= 1.01 * (with_ridge - least)


def test_a_stable_model_that_keeps_little_of_the_plant_says_so() -> None:
    X = np.array([[1.5**k, 0.5**k] for k in range(9)])
    data = km.Episodes([km.Episode(X=X, U=np.zeros((8, 0)))], 0.1)
    with pytest.warns(km.FitWarning, match=r"stability costs much: the stable model misses \d+% .* larger radius"):
        km.identify.stable_edmd(data, km.State(), radius=0.5)


def test_delays_weights_and_the_past_in_all_three_fits() -> None:
    data, lifting = random_episodes(3, [60, 40], 2, 1), km.State() + km.Constant()
    how = {"embedding": km.Delay(1), "weights": lambda episode: len(episode) / 50}
    plain = km.edmd(data, lifting, **how)
    for model in (
        km.identify.stable_edmd(data, lifting, radius=5.0, **how),
        km.identify.constrained_edmd(data, lifting, prior=km.identify.Prior(), **how),
        km.identify.sparse_edmd(data, lifting, penalty=1e-12, adaptive=False, **how),
    ):
        assert np.allclose(model.A, plain.A, rtol=0, atol=1e-9)
        assert np.allclose(model.B, plain.B, rtol=0, atol=1e-9)
        assert np.array_equal(model.C, plain.C)
        assert model.embedding == plain.embedding
        assert model.lifting.names == plain.lifting.names


def test_a_wrong_radius_or_ridge_is_refused() -> None:
    data = random_episodes(0, [30], 2, 1)
    for radius in (0.0, -1.0):
        with pytest.raises(km.errors.DataError, match="radius is"):
            km.identify.stable_edmd(data, km.State(), radius=radius)
    with pytest.raises(km.errors.DataError, match="radius holds 1 NaN"):
        km.identify.stable_edmd(data, km.State(), radius=np.nan)
    with pytest.raises(km.errors.DataError, match="ridge is -1"):
        km.identify.stable_edmd(data, km.State(), ridge=-1)
