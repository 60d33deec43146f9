"""Fits to sensors of unequal rates: exact plants, order of the error in noise, invariances, and errors."""

import numpy as np
import pytest

import koopmpc as km


def draw(seed, noise=0.0, keep=10, runs=3, T=300):
    """A random stable linear plant, and its runs with one state measured in every tenth row."""
    rng = np.random.default_rng(seed)
    n, nu = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    A, B = rng.standard_normal((n, n)), rng.standard_normal((n, nu))
    A *= rng.uniform(0.5, 0.98) / np.abs(np.linalg.eigvals(A)).max()
    X, U = [], []
    for _ in range(runs):
        u, x = rng.standard_normal((T, nu)), [rng.standard_normal(n)]
        for v in u:
            x.append(A @ x[-1] + B @ v)
        rows = np.array(x) + noise * rng.standard_normal((T + 1, n))
        rows[np.arange(T + 1) % keep > 0, n - 1] = np.nan
        X.append(rows)
        U.append(u)
    return A, B, km.data.PartialEpisodes(X=X, U=U, dt=0.1)


@pytest.mark.parametrize("seed", [0, 1, 2, 11])
def test_an_exact_linear_plant_is_recovered_from_every_tenth_row(seed):
    A, B, data = draw(seed)
    model = km.identify.unequal_rates(data, km.State())
    np.testing.assert_allclose(model.A, A, atol=1e-6)
    np.testing.assert_allclose(model.B, B, atol=1e-6)
    assert model.report.samples == data.count_measured().sum()


@pytest.mark.slow
def test_the_error_falls_with_the_noise():
    errors = []
    for noise in (1e-2, 1e-4):
        A, _, data = draw(1, noise)
        errors.append(np.abs(km.identify.unequal_rates(data, km.State()).A - A).max())
    assert errors[0] < 0.05
    assert errors[1] < 0.03 * errors[0]


def test_units_change_nothing():
    A, _, data = draw(11)
    size = np.array([1e3, 1e-2])
    scaled = km.data.PartialEpisodes(X=[x * size for x in data.X], U=data.U, dt=0.1)
    model = km.identify.unequal_rates(scaled, km.State())
    np.testing.assert_allclose(model.A / size[:, None] * size, A, atol=1e-6)


def test_a_nonlinear_plant_is_recovered_too():
    rng, X, U = np.random.default_rng(0), [], []
    for _ in range(4):
        u, x = rng.uniform(-1, 1, (120, 1)), [rng.uniform(-1, 1, 2)]
        for v in u:
            a, b = x[-1]
            x.append(np.array([0.9 * a + 0.1 * b, 0.8 * b - 0.2 * a**2 + 0.3 * v[0]]))
        rows = np.array(x)
        rows[np.arange(121) % 4 > 0, 0] = np.nan
        X.append(rows)
        U.append(u)
    data = km.data.PartialEpisodes(X=X, U=U, dt=0.1, states=["a", "b"])
    model = km.identify.unequal_rates(data, km.State() + km.Monomials(2))
    places = [model.lifting.names.index(name) for name in ("a", "b")]
    found = dict(zip(model.lifting.names, model.A[places[1]], strict=True))
    assert found["b"] == pytest.approx(0.8, abs=1e-6)
    assert found["a^2"] == pytest.approx(-0.2, abs=1e-6)
    assert model.B[places[1], 0] == pytest.approx(0.3, abs=1e-6)


def test_complete_pairs_are_those_of_complete_rows_and_fit_one_step():
    A, _, data = draw(1)
    with pytest.raises(km.errors.DataError, match="0 of 900 pairs of rows are complete, and 1 are needed"):
        data.complete_pairs()
    X = [x.copy() for x in draw(1, keep=1)[2].X]
    X[0][7, 0] = X[1][0, 1] = np.nan
    some = km.data.PartialEpisodes(X=X, U=data.U, dt=0.1)
    pairs = some.complete_pairs()
    assert sum(map(len, pairs)) == 900 - 3
    np.testing.assert_allclose(km.edmd(pairs, km.State()).A, A, atol=1e-9)
    with pytest.raises(km.errors.DataError, match="897 of 900 pairs of rows are complete, and 898 are needed"):
        some.complete_pairs(898)


def draw_driven(seed, *, bilinear, nw=1):
    """The matrices of a random plant with measured disturbances, and its runs with a state of every tenth row."""
    rng = np.random.default_rng(seed)
    n, nu = int(rng.integers(2, 4)), int(rng.integers(1, 3))
    A = rng.standard_normal((n, n))
    A *= rng.uniform(0.5, 0.9) / np.abs(np.linalg.eigvals(A)).max()
    B, E = rng.standard_normal((n, nu)), rng.standard_normal((n, nw))
    N, S = 0.08 * rng.standard_normal((nu, n, n)), 0.08 * rng.standard_normal((nw, n, n))
    M = 0.3 * rng.standard_normal((nw, n, nu))
    X, U, W = [], [], []
    for _ in range(3):
        u, w, x = rng.standard_normal((300, nu)), rng.standard_normal((300, nw)), [rng.standard_normal(n)]
        for a, b in zip(u, w, strict=True):
            products = np.einsum("i,ijk,k->j", a, N, x[-1]) + np.einsum("i,ijk,k->j", b, S, x[-1])
            products = products + np.einsum("i,ijk,k->j", b, M, a)
            x.append(A @ x[-1] + B @ a + E @ b + bilinear * products)
        rows = np.array(x)
        rows[(np.arange(301) + 3) % 10 > 0, -1] = np.nan
        X.append(rows)
        U.append(u)
        W.append(w)
    names = {"disturbances": [f"weather {j}" for j in range(nw)]}
    return (A, B, E, N, S, M), km.data.PartialEpisodes(X=X, U=U, W=W, dt=0.1, **names)


SEEDS = [3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(10, 20))]


@pytest.mark.parametrize("seed", SEEDS)
def test_an_exact_plant_with_measured_disturbances_is_recovered(seed):
    (A, B, E, *_), data = draw_driven(seed, bilinear=False, nw=2)
    model = km.identify.unequal_rates(data, km.State())
    for found, true in ((model.A, A), (model.B, B), (model.E, E)):
        np.testing.assert_allclose(found, true, atol=1e-6)
    assert model.disturbances == ("weather 0", "weather 1")


@pytest.mark.parametrize("seed", SEEDS)
def test_an_exact_bilinear_plant_is_recovered_with_all_its_products(seed):
    true, data = draw_driven(seed, bilinear=True)
    model = km.identify.unequal_rates(data, km.State(), bilinear=True, scheduled_inputs=True)
    for found, matrix in zip((model.A, model.B, model.E, model.N, model.S, model.M), true, strict=True):
        np.testing.assert_allclose(found, matrix, atol=1e-6)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:rank-deficient")  # exact rows of two outputs and their past have five dimensions
@pytest.mark.filterwarnings("ignore:ill-conditioned")
@pytest.mark.parametrize(("seed", "T", "every"), [(5, 100, 5), (0, 100, 5), (1, 150, 10)])
def test_a_model_with_delays_forecasts_a_plant_whose_state_is_hidden(seed, T, every):
    """Two outputs of three states, one in every fifth or tenth row: past rows hold what is hidden."""
    rng = np.random.default_rng(seed)
    A, B, C = rng.standard_normal((3, 3)), rng.standard_normal((3, 1)), rng.standard_normal((2, 3))
    A *= 0.8 / np.abs(np.linalg.eigvals(A)).max()
    Y, U = [], []
    for _ in range(3):
        u, x = rng.standard_normal((T, 1)), [rng.standard_normal(3)]
        for v in u:
            x.append(A @ x[-1] + B @ v)
        Y.append(np.array(x) @ C.T)
        U.append(u)
    rows = [y.copy() for y in Y[:2]]
    for y in rows:
        y[np.arange(T + 1) % every > 0, 1] = np.nan
    data = km.data.PartialEpisodes(X=rows, U=U[:2], dt=0.1)
    model = km.identify.unequal_rates(data, km.State(), embedding=km.Delay(2))
    forecast = model.rollout(Y[2][2], U[2][2:], history=km.Episode(X=Y[2][:3], U=U[2][:2]))
    np.testing.assert_allclose(forecast, Y[2][2:], atol=1e-6 * Y[2].std())


@pytest.mark.filterwarnings("ignore:rank-deficient")
def test_delays_to_spare_add_no_unstable_mode():
    """Poles at 0.8 and 0.5, and four poles to spare that nothing in the rows excites."""
    rng, A, X, U = np.random.default_rng(2), np.array([[0.8, 0.2], [0.0, 0.5]]), [], []
    for _ in range(2):
        u, x = rng.standard_normal((40, 1)), [rng.standard_normal(2)]
        for v in u:
            x.append(A @ x[-1] + np.array([0.3, 1.0]) * v)
        whole = np.array(x)
        X.append(np.where(np.arange(41)[:, None] % [1, 3] > 0, np.nan, whole))
        U.append(u)
    model = km.identify.unequal_rates(km.data.PartialEpisodes(X=X, U=U, dt=0.1), km.State(), embedding=km.Delay(2))
    assert np.abs(np.linalg.eigvals(model.A)).max() == pytest.approx(0.8, abs=1e-6)
    forecast = model.rollout(whole[2], U[1][2:], history=km.Episode(X=whole[:3], U=U[1][:2]))
    np.testing.assert_allclose(forecast, whole[2:], atol=1e-6)


X, U = [[0.0, 1.0], [np.nan, 1.0], [2.0, 1.0]], [[1.0], [1.0]]
REFUSED = {
    "X has 1 runs, U 2 and W 2": {"X": [X], "U": [U, U]},
    "X has 1 runs, U 1 and W 2": {"X": [X], "U": [U], "W": [U, U]},
    "W of run 0": {"X": [X], "U": [U], "W": [[[np.nan], [1.0]]]},
    r"W \(1, 1\)": {"X": [X], "U": [U], "W": [U[:1]]},
    "one row more than U": {"X": [X], "U": [U[:1]]},
    "is inf in row 1": {"X": [[[0.0], [np.inf], [1.0]]], "U": [U]},
    "x1 was never measured": {"X": [[[0.0, np.nan]] * 3], "U": [U]},
    "U of run 0": {"X": [X], "U": [[[np.nan], [1.0]]]},
}


@pytest.mark.parametrize("said", REFUSED)
def test_runs_that_cannot_be_are_refused(said):
    with pytest.raises((km.errors.DataError, km.errors.ShapeError), match=said):
        km.data.PartialEpisodes(**REFUSED[said], dt=0.1)


def test_fits_say_what_they_cannot_take():
    data = km.data.PartialEpisodes(X=[X], U=[U], dt=0.1)
    with pytest.raises(km.errors.DataError, match="cells were measured, and the fit has"):
        km.identify.unequal_rates(data, km.State())
    with pytest.raises(km.errors.DataError, match="the longest has 2, pass a shorter horizon"):
        km.identify.unequal_rates(data, km.State(), horizon=5)
    with pytest.raises(km.errors.DataError, match="lacks a state"):
        km.identify.unequal_rates(data, km.State(["x0"]))
    with pytest.raises(km.errors.DataError, match="pass W, and bilinear=True"):
        km.identify.unequal_rates(data, km.State(), bilinear=True, scheduled_inputs=True)
    with pytest.raises(km.errors.DataError, match="the embedding has rails"):
        km.identify.unequal_rates(data, km.State(), embedding=km.Delay(1, rails=np.array([[0.0, 0.0], [1.0, 1.0]])))
    with pytest.raises(km.errors.DataError, match="a segment has 2 steps, and the embedding keeps 2"):
        km.identify.unequal_rates(data, km.State(), embedding=km.Delay(2))
    still = km.data.PartialEpisodes(X=[X], U=[np.zeros((2, 0))], dt=0.1)
    with pytest.raises(km.errors.DataError, match="no inputs, so nothing multiplies"):
        km.identify.unequal_rates(still, km.State(), bilinear=True)


@pytest.mark.unhooked
def test_one_step_fits_name_what_takes_partial_rows():
    data = km.data.PartialEpisodes(X=[X], U=[U], dt=0.1)
    with pytest.raises(km.errors.DataError, match="complete_pairs"):
        km.edmd(data, km.State())
