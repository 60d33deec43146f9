"""The multi-step score: a perfect model scores zero, and errors land on their own step."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.example_plants import random_predictor


def runs(model: km.LinearPredictor, lengths: list[int], seed: int = 0, noise: float = 0.0) -> km.Episodes:
    rng = np.random.default_rng(seed)
    parts: list[km.Episode] = []
    for length in lengths:
        U = rng.standard_normal((length, model.nu))
        X = model.rollout(rng.standard_normal(model.nx), U)
        parts.append(km.Episode(X=X + noise * rng.standard_normal(X.shape), U=U))
    return km.Episodes(parts, model.dt, model.states, model.inputs)


@given(st.integers(1, 4), st.integers(0, 2), st.integers(1, 8), st.integers(1, 3), st.integers(0, 999))
def test_a_perfect_model_scores_zero(nx: int, nu: int, horizon: int, stride: int, seed: int) -> None:
    model = random_predictor(seed, nx, nu)
    data = runs(model, [8, 11, 20], seed)
    result = km.score(model, data, horizon, stride=stride)
    size = max(np.abs(e.X).max() for e in data)
    assert result.rmse.max() <= 1e-12 * max(size, 1)
    assert result.rmse.shape == result.relative.shape == (horizon, nx)
    assert result.horizon == horizon
    assert result.starts == sum(len(range(0, n - horizon + 1, stride)) for n in (8, 11, 20))
    assert result.states == model.states


@given(st.integers(1, 7), st.integers(1, 3), st.integers(0, 99))
def test_the_errors_are_those_of_rollouts_from_each_start(horizon: int, stride: int, seed: int) -> None:
    model = random_predictor(seed, 2, 1, km.State() + km.Constant() + km.Fourier(1))
    data = runs(random_predictor(seed, 2, 1), [7, 10], seed, noise=0.1)
    errors, truths = [], []
    for e in data:
        for k in range(0, len(e) - horizon + 1, stride):
            truths.append(e.X[k + 1 : k + horizon + 1])
            errors.append(model.rollout(e.X[k], e.U[k : k + horizon])[1:] - truths[-1])
    result = km.score(model, data, horizon, stride=stride)
    rmse, size = np.sqrt(np.mean(np.square(errors), axis=0)), np.sqrt(np.mean(np.square(truths), axis=0))
    assert np.allclose(result.rmse, rmse, rtol=1e-10)
    assert np.allclose(result.relative, rmse / size, rtol=1e-10)
    assert result.total == pytest.approx(np.sqrt(np.mean((rmse / size) ** 2)))


def brute_errors(predict, data: km.Episodes, horizon: int, stride: int = 1) -> np.ndarray:
    """x − x̂, (starts, horizon, nx), where predict(x, U) returns x_1 … x_horizon, one start at a time."""
    return np.array(
        [
            e.X[k + 1 : k + horizon + 1] - predict(e.X[k], e.U[k : k + horizon])
            for e in data
            for k in range(0, len(e) - horizon + 1, stride)
        ]
    )


@given(st.integers(1, 6), st.integers(1, 3), st.integers(0, 99))
def test_holding_the_state_scores_its_change_and_quantiles_are_those_of_all_starts(
    horizon: int, stride: int, seed: int
) -> None:
    data = runs(random_predictor(seed, 2, 1), [7, 12, 6], seed, noise=0.1)
    hold = km.LinearPredictor(np.eye(2), np.zeros((2, 1)), np.eye(2), km.State(), data.dt, data.states, data.inputs)
    errors = brute_errors(lambda x, U: np.tile(x, (len(U), 1)), data, horizon, stride)
    result = km.score(hold, data, horizon, stride=stride)
    assert np.allclose(result.rmse, np.sqrt(np.mean(errors**2, axis=0)), rtol=1e-12)
    expected = np.quantile(errors, [0.05, 0.5, 0.95], axis=0, method="inverted_cdf")
    assert np.allclose([result.low, result.median, result.high], expected, rtol=1e-12, atol=1e-14)


@given(st.integers(1, 6), st.integers(1, 2), st.integers(0, 99))
def test_bilinear_predictors_score_as_their_rollouts(horizon: int, nu: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    data = runs(random_predictor(seed, 2, nu), [7, 9], seed, noise=0.1)
    lifting = km.State() + km.Constant() + km.Fourier(1)
    nz = lifting.bind(data.states).nz
    A, B, N, C = (0.3 * rng.standard_normal(size) for size in ((nz, nz), (nz, nu), (nu, nz, nz), (2, nz)))
    model = km.BilinearPredictor(A, B, N, C, lifting, data.dt, data.states, data.inputs)
    errors = brute_errors(lambda x, U: model.rollout(x, U)[1:], data, horizon)
    assert np.allclose(km.score(model, data, horizon).rmse, np.sqrt(np.mean(errors**2, axis=0)), rtol=1e-9)
    step = model.step_map()
    errors = brute_errors(lambda x, U: step.rollout(x, U)[1:], data, horizon)
    relifted = km.score(model, data, horizon, relift=True)
    assert np.allclose(relifted.rmse, np.sqrt(np.mean(errors**2, axis=0)), rtol=1e-9)


def test_relifting_a_linear_predictor_scores_its_step_map() -> None:
    model = random_predictor(1, 2, 1, km.State() + km.Constant() + km.Fourier(1), radius=0.5)
    data = runs(random_predictor(1, 2, 1), [7, 9], 1, noise=0.1)
    step = model.step_map()
    errors = brute_errors(lambda x, U: step.rollout(x, U)[1:], data, 5)
    result = km.score(model, data, 5, relift=True)
    assert np.allclose(result.rmse, np.sqrt(np.mean(errors**2, axis=0)), rtol=1e-9)


@pytest.mark.parametrize("inputs", [True, False])
def test_an_embedding_is_scored_from_the_first_start_with_a_past(inputs: bool) -> None:
    rng = np.random.default_rng(5)
    data = runs(random_predictor(5, 2, 1), [9, 12], 5, noise=0.1)
    past = km.Delay(2, inputs=inputs).bind(data.states, data.inputs)
    lifting = (km.State() + km.Constant()).bind(past.names)
    A, B, C = (0.2 * rng.standard_normal(size) for size in ((lifting.nz, lifting.nz), (lifting.nz, 1), (2, lifting.nz)))
    model = km.LinearPredictor(A, B, C, lifting, data.dt, data.states, data.inputs, embedding=past)
    step = model.step_map()
    for relift in (False, True):
        errors = []
        for e in data:
            for k in range(2, len(e) - 3 + 1):
                before = km.Episode(X=e.X[: k + 1], U=e.U[:k])
                zeta = past.point(e.X[k], before)
                x = step.rollout(zeta, e.U[k : k + 3]) if relift else model.rollout(zeta, e.U[k : k + 3])
                errors.append(e.X[k + 1 : k + 4] - x[1:, :2])
        result = km.score(model, data, 3, relift=relift)
        assert result.starts == len(errors) == 13
        assert np.allclose(result.rmse, np.sqrt(np.mean(np.square(errors), axis=0)), rtol=1e-10)
    with pytest.raises(
        km.errors.DataError, match="episode 0 has 7 steps behind the 2 of the embedding, the horizon is 8"
    ):
        km.score(model, data, 8)


def test_of_many_starts_evenly_spread_ones_give_the_quantiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("koopmpc.validate.scoring._QUANTILE_ERRORS", 1)
    monkeypatch.setattr("koopmpc.validate.scoring._QUANTILE_STARTS", 40)
    monkeypatch.setattr("koopmpc.validate.scoring._BLOCK_STARTS", 17)
    model = random_predictor(3, 2, 1, km.State() + km.Fourier(1))
    data = runs(random_predictor(3, 2, 1), [40, 55, 30], 3, noise=0.1)
    errors = brute_errors(lambda x, U: model.rollout(x, U)[1:], data, 3)
    assert len(errors) == 119
    result = km.score(model, data, 3)
    expected = np.quantile(errors[::3], [0.05, 0.5, 0.95], axis=0, method="inverted_cdf")
    assert np.allclose([result.low, result.median, result.high], expected, rtol=1e-12, atol=1e-14)
    assert np.allclose(result.rmse, np.sqrt(np.mean(errors**2, axis=0)), rtol=1e-12)


def test_a_diverging_prediction_has_an_infinite_error() -> None:
    away = km.LinearPredictor([[1e200]], np.empty((1, 0)), [[1]], km.State(), 0.1, ("a",), ())
    data = km.Episodes([km.Episode(X=[[1.0], [1.0], [1.0], [1.0]])], 0.1, ("a",))
    result = km.score(away, data, 3)
    assert np.array_equal(np.isinf(result.rmse[:, 0]), [True, True, True])  # squares beyond 1e308
    assert np.array_equal(np.isinf(result.high[:, 0]) | np.isinf(result.low[:, 0]), [False, True, True])


def test_long_episodes_are_scored_in_blocks() -> None:
    model = random_predictor(0, 2, 1)
    data = runs(model, [9000], noise=0.1)
    X, U = data[0].X, data[0].U
    halves = [km.Episode(X=X[a : b + 1], U=U[a:b]) for a, b in ((0, 4500), (4499, 9000))]  # horizon 2 overlaps by 1
    whole = km.score(model, data, 2)
    split = km.score(model, km.Episodes(halves, data.dt, data.states, data.inputs), 2)
    assert whole.starts == split.starts == 8999
    assert np.allclose(whole.rmse, split.rmse, rtol=1e-12)


def test_a_state_that_is_zero_throughout() -> None:
    model = km.LinearPredictor(np.eye(2), np.empty((2, 0)), np.eye(2), km.State(), 0.1, ("a", "b"), ())
    data = km.Episodes([km.Episode(X=[[1, 0], [1, 0], [1, 0]])], 0.1, ("a", "b"))
    assert np.array_equal(km.score(model, data, 2).relative, np.zeros((2, 2)))
    off = km.LinearPredictor([[1, 0], [1, 1]], np.empty((2, 0)), np.eye(2), km.State(), 0.1, ("a", "b"), ())
    assert np.array_equal(km.score(off, data, 2).relative, [[0, np.inf], [0, np.inf]])


def test_bad_input_is_refused() -> None:
    model = random_predictor(0, 2, 1)
    data = runs(model, [9, 5])
    with pytest.raises(
        km.errors.DataError, match="episode 1 has 5 steps, the horizon is 6; shorten the horizon or drop"
    ):
        km.score(model, data, 6)
    with pytest.raises(km.errors.DataError, match="horizon is 0; it must be at least 1"):
        km.score(model, data, 0)
    with pytest.raises(km.errors.DataError, match="stride is 0; it must be at least 1"):
        km.score(model, data, 2, stride=0)
    with pytest.raises(km.errors.ShapeError, match="the episodes have states"):
        km.score(random_predictor(0, 3, 1), data, 2)
    with pytest.raises(km.errors.DataError, match=r"the episodes have dt 0.1 s, the predictor 0.2 s"):
        km.score(random_predictor(0, 2, 1, dt=0.2), data, 2)
