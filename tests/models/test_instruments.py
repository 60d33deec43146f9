"""Instruments and the direct method: unbiased under feedback with noisy sensors, least squares where they are exact."""

import numpy as np
import pytest

import koopmpc as km

A, B = np.array([[0.9, 0.1], [-0.1, 0.8]]), np.array([[0.0], [0.2]])
TRUTH = np.hstack([A, B])


def run_loop(rng, steps, *, sensor=0.0, process=0.0, moves=True, gain=(1.5, 0.15), plant=(A, B)):
    """Return a record of a PI loop on the first state, and its set point."""
    held = -(-steps // 12)
    r = np.repeat(rng.choice([-1.0, 1.0], held), 12)[:steps, None] if moves else np.ones((steps, 1))
    (A, B), x, total = plant, np.zeros(2), 0.0
    X, U = np.empty((steps + 1, 2)), np.empty((steps, 1))
    for k in range(steps):
        X[k] = x + sensor * rng.standard_normal(2)
        error = r[k, 0] - X[k, 0]
        total += error
        U[k] = gain[0] * error + gain[1] * total
        x = A @ x + B @ U[k] + process * rng.standard_normal(2)
    X[-1] = x + sensor * rng.standard_normal(2)
    return km.Episodes([km.Episode(X=X, U=U)], dt=0.1), [r]


def fit(data, r, **options):
    model = km.identify.instrumental_edmd(data, km.State(), r, **options)
    return np.hstack([model.A, model.B])


def fit_plain(data):
    model = km.edmd(data, km.State())
    return np.hstack([model.A, model.B])


def fit_directly(data, r=None):
    model = km.identify.prediction_error(km.edmd(data, km.State()), data)
    return np.hstack([model.A, model.B])


def test_a_loop_without_noise_gives_the_plant_exactly():
    data, r = run_loop(np.random.default_rng(0), 400)
    np.testing.assert_allclose(fit(data, r), TRUTH, atol=1e-9)


@pytest.mark.parametrize(("way", "noise", "rtol"), [(fit, 0.05, 1e-6), (fit_directly, 0.1, 1e-4)])
def test_units_of_the_states_and_of_the_set_point_change_nothing_else(way, noise, rtol):
    data, r = run_loop(np.random.default_rng(1), 400, sensor=noise)
    T = np.diag([1e3, 1e-2])
    K = way(km.Episodes([km.Episode(X=data[0].X @ T, U=data[0].U)], dt=0.1), [1e4 * r[0]])
    np.testing.assert_allclose(np.linalg.solve(T, K[:, :2] @ T), way(data, r)[:, :2], rtol=rtol, atol=1e-2 * rtol)


@pytest.mark.parametrize(("way", "noise", "count", "steps"), [(fit, 0.2, 30, 800), (fit_directly, 0.1, 4, 600)])
def test_noisy_sensors_bias_least_squares_and_neither_instruments_nor_the_direct_method(way, noise, count, steps):
    rng = np.random.default_rng(2)
    records = [run_loop(rng, steps, sensor=noise) for _ in range(count)]
    plain = np.linalg.norm(np.mean([fit_plain(d) for d, _ in records], axis=0) - TRUTH)
    ours = np.linalg.norm(np.mean([way(d, r) for d, r in records], axis=0) - TRUTH)
    assert ours <= plain / 5


@pytest.mark.slow
@pytest.mark.parametrize(("way", "process"), [(fit, 0.0), (fit_directly, 0.03)])
def test_the_bias_over_100_records_stays_within_three_standard_errors_which_fall_with_the_length(way, process):
    rng, bound = np.random.default_rng(3), {}
    for steps in (500, 2000, 8000):
        records = [run_loop(rng, steps, sensor=0.1, process=process) for _ in range(100)]
        plain = np.linalg.norm(np.mean([fit_plain(d) for d, _ in records], axis=0) - TRUTH)
        ours = np.array([way(d, r) for d, r in records])
        bias = np.linalg.norm(ours.mean(axis=0) - TRUTH)
        bound[steps] = 3 * np.linalg.norm(ours.std(axis=0)) / np.sqrt(len(ours))
        assert bias <= plain / 5
        assert bias <= bound[steps]
    assert bound[8000] <= 1.2 * bound[500] * (500 / 8000) ** 0.5


def test_a_constant_set_point_is_refused():
    data, r = run_loop(np.random.default_rng(4), 400, sensor=0.1, moves=False)
    with pytest.raises(km.errors.DataError, match="not identifiable from these logs"):
        fit(data, r)


def test_a_signal_that_does_not_act_on_the_loop_is_refused():
    rng = np.random.default_rng(5)
    data, _ = run_loop(rng, 400, sensor=0.1)
    with pytest.raises(km.errors.DataError, match="not identifiable"):
        fit(data, [rng.standard_normal((400, 1))])


def test_a_short_record_with_much_noise_is_called_weak():
    data, r = run_loop(np.random.default_rng(7), 150, sensor=0.4)
    with pytest.warns(km.errors.FitWarning, match="the instruments are weak"):
        fit(data, r)


def test_set_points_of_other_lengths_are_refused():
    data, r = run_loop(np.random.default_rng(6), 50)
    with pytest.raises(km.errors.ShapeError, match="pass one an episode"):
        fit(data, [])
    with pytest.raises(km.errors.ShapeError, match=r"instruments\[0\] has 40 rows for 50 steps"):
        fit(data, [r[0][:40]])
    with pytest.raises(km.errors.DataError, match="fewer than lags"):
        fit(data, r, lags=51)


def compare_fits(records, **noise):
    """Return the bias and the variance of least squares and of `level=0.01`, over many records."""
    rng = np.random.default_rng(0)
    logs = [run_loop(rng, 800, **noise) for _ in range(records)]
    both = np.array([[fit_plain(d) for d, _ in logs], [fit(d, r, level=0.01) for d, r in logs]])
    bias = np.linalg.norm(both.mean(axis=1) - TRUTH, axis=(1, 2))
    return bias, both.var(axis=1).sum(axis=(1, 2))


@pytest.mark.parametrize("records", [20, pytest.param(100, marks=pytest.mark.slow)])
def test_least_squares_stays_with_process_noise_alone_and_goes_with_noisy_sensors(records):
    _, variance = compare_fits(records, process=0.05)
    assert variance[1] <= 1.1 * variance[0]
    bias, _ = compare_fits(records, sensor=0.1)
    assert bias[1] <= bias[0] / 5


@pytest.mark.slow
def test_with_process_noise_alone_the_variance_is_that_of_least_squares():
    rng = np.random.default_rng(0)
    records = [run_loop(rng, 800, process=0.05)[0] for _ in range(100)]
    plain, ours = (np.array([way(d) for d in records]).var(axis=0).sum() for way in (fit_plain, fit_directly))
    assert ours <= 1.1 * plain


def test_exact_readings_keep_the_model():
    data, _ = run_loop(np.random.default_rng(0), 400)
    model = km.edmd(data, km.State())
    assert km.identify.prediction_error(model, data) is model


def test_logs_that_identify_nothing_are_refused():
    resting, _ = run_loop(np.random.default_rng(4), 400, sensor=0.1, moves=False)
    with pytest.raises(km.errors.DataError, match="not identifiable from these logs: u0"):
        fit_directly(resting)


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
