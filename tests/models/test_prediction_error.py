"""The direct method: unbiased under feedback with noisy sensors, least squares where they are exact, else refused."""

import numpy as np
import pytest

import koopmpc as km
from tests.models.test_instruments import TRUTH, run_loop


def fit(data):
    model = km.identify.prediction_error(km.edmd(data, km.State()), data)
    return np.hstack([model.A, model.B])


def fit_plain(data):
    model = km.edmd(data, km.State())
    return np.hstack([model.A, model.B])


def test_noisy_sensors_bias_least_squares_and_not_the_direct_method():
    rng = np.random.default_rng(2)
    records = [run_loop(rng, 600, sensor=0.1)[0] for _ in range(4)]
    plain, ours = (np.mean([way(d) for d in records], axis=0) - TRUTH for way in (fit_plain, fit))
    assert np.linalg.norm(ours) <= np.linalg.norm(plain) / 5


@pytest.mark.slow
def test_the_bias_over_100_records_stays_within_three_standard_errors_which_fall_with_the_length():
    rng, bound = np.random.default_rng(3), {}
    for steps in (500, 2000, 8000):
        records = [run_loop(rng, steps, sensor=0.1, process=0.03)[0] for _ in range(100)]
        plain = np.linalg.norm(np.mean([fit_plain(d) for d in records], axis=0) - TRUTH)
        ours = np.array([fit(d) for d in records])
        bias = np.linalg.norm(ours.mean(axis=0) - TRUTH)
        bound[steps] = 3 * np.linalg.norm(ours.std(axis=0)) / np.sqrt(len(ours))
        assert bias <= plain / 5
        assert bias <= bound[steps]
    assert bound[8000] <= 1.2 * bound[500] * (500 / 8000) ** 0.5


@pytest.mark.slow
def test_with_process_noise_alone_the_variance_is_that_of_least_squares():
    rng = np.random.default_rng(0)
    records = [run_loop(rng, 800, process=0.05)[0] for _ in range(100)]
    plain, ours = (np.array([way(d) for d in records]).var(axis=0).sum() for way in (fit_plain, fit))
    assert ours <= 1.1 * plain


def test_units_of_the_states_change_nothing_else():
    data, _ = run_loop(np.random.default_rng(1), 400, sensor=0.1)
    T = np.diag([1e3, 1e-2])
    K = fit(km.Episodes([km.Episode(X=data[0].X @ T, U=data[0].U)], dt=0.1))
    np.testing.assert_allclose(np.linalg.solve(T, K[:, :2] @ T), fit(data)[:, :2], rtol=1e-4, atol=1e-6)


def test_exact_readings_keep_the_model():
    data, _ = run_loop(np.random.default_rng(0), 400)
    model = km.edmd(data, km.State())
    assert km.identify.prediction_error(model, data) is model


def test_logs_that_identify_nothing_are_refused():
    resting, _ = run_loop(np.random.default_rng(4), 400, sensor=0.1, moves=False)
    with pytest.raises(km.errors.DataError, match="not identifiable from these logs: u0"):
        fit(resting)


def test_too_few_rows_do_not_make_an_input_follow_from_the_readings():
    rng = np.random.default_rng(0)
    data = km.Episodes([km.Episode(X=rng.standard_normal((81, 4)), U=rng.standard_normal((80, 20)))], dt=0.1)
    km.identify.prediction_error(km.edmd(data, km.State()), data, iterations=2)


def test_models_that_it_does_not_know_are_refused():
    data, _ = run_loop(np.random.default_rng(6), 200, sensor=0.1)
    with pytest.raises(km.errors.DataError, match="has past rows"):
        km.identify.prediction_error(km.edmd(data, km.State(), embedding=km.Delay(1)), data)
    other = km.Episodes([km.Episode(X=data[0].X[:, :1], U=data[0].U)], dt=0.1)
    with pytest.raises(km.errors.ShapeError):
        km.identify.prediction_error(km.edmd(data, km.State()), other)
