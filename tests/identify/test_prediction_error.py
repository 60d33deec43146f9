"""The direct method: unbiased under feedback with noisy sensors, least squares where they are exact, else refused."""

import numpy as np
import pytest

import koopmpc as km
from koopmpc.errors import DataError, ShapeError
from koopmpc.identify.fits.refinement import cut_into_segments
from koopmpc.identify.innovations import InnovationsError, filter_states, fit_with_gain
from tests.identify.test_instruments import TRUTH, run_loop


def fit(data):
    model = km.identify.prediction_error(km.edmd(data, km.State()), data)
    return np.hstack([model.A, model.B])


def fit_plain(data):
    model = km.edmd(data, km.State())
    return np.hstack([model.A, model.B])


@pytest.mark.parametrize("kind", [km.edmd, km.bilinear_edmd])
def test_the_gradient_is_that_of_finite_differences(kind):
    data, _ = run_loop(np.random.default_rng(0), 120, sensor=0.1, process=0.05)
    model = kind(data, km.State() + km.Monomials(2) + km.Constant())
    segments = cut_into_segments(model, data, 40, "")
    error = InnovationsError(model, np.array([[2.0, 0.0], [0.5, 1.5]]))
    rng = np.random.default_rng(1)
    theta = np.hstack(
        [np.hstack([model.A[:2], model.B[:2], *getattr(model, "N", np.zeros((0, 2, 1)))[:, :2]]), rng.random((2, 2))]
    )
    slope = error.derivatives(theta, segments)[0]
    for i in range(theta.size):
        step = np.zeros(theta.size)
        step[i] = 1e-6
        step = step.reshape(theta.shape)
        difference = (error.evaluate(theta + step, segments) - error.evaluate(theta - step, segments)) / 4e-6
        assert slope[i] == pytest.approx(difference, rel=1e-5, abs=1e-7)


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


def test_the_filter_is_a_kalman_filter_once_settled():
    """Its states obey x̃⁺ = A x̃ + B u + L (y⁺ − A x̃ − B u), by a loop that shares nothing with the code."""
    data, _ = run_loop(np.random.default_rng(4), 400, sensor=0.1, process=0.05)
    model, gain = fit_with_gain(km.edmd(data, km.State()), data)
    X, e = filter_states(model, gain, data)[0].X, data[0]
    ahead = X[:-1] @ model.A.T + e.U @ model.B.T
    weight = gain + (np.eye(2) - gain)[None] / (np.arange(len(ahead)) + 2)[:, None, None]
    np.testing.assert_allclose(X[1:], ahead + np.einsum("kij,kj->ki", weight, e.X[1:] - ahead), atol=1e-12)


def test_logs_that_identify_nothing_are_refused():
    resting, _ = run_loop(np.random.default_rng(4), 400, sensor=0.1, moves=False)
    with pytest.raises(DataError, match="not identifiable from these logs: u0 follows from the readings alone"):
        fit(resting)


def test_too_few_rows_do_not_make_an_input_follow_from_the_readings():
    rng = np.random.default_rng(0)
    data = km.Episodes([km.Episode(X=rng.standard_normal((81, 4)), U=rng.standard_normal((80, 20)))], dt=0.1)
    km.identify.prediction_error(km.edmd(data, km.State()), data, iterations=2)


def test_models_that_it_does_not_know_are_refused():
    data, _ = run_loop(np.random.default_rng(6), 200, sensor=0.1)
    with pytest.raises(DataError, match="has past rows"):
        km.identify.prediction_error(km.edmd(data, km.State(), embedding=km.Delay(1)), data)
    other = km.Episodes([km.Episode(X=data[0].X[:, :1], U=data[0].U)], dt=0.1)
    with pytest.raises(ShapeError):
        km.identify.prediction_error(km.edmd(data, km.State()), other)
