"""LiftedDisturbance: what the model lacks, filtered, in every lifted coordinate but the Constant."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.estimate.plants import linear

NO_W = np.zeros(0)
LIFTING = km.State() + km.Expressions(lambda x: [ca.sin(x[0])], ["sin"]) + km.Constant()


def predictor(rng):
    A = rng.normal(size=(4, 4)) / 3
    return km.LinearPredictor(A, rng.normal(size=(4, 1)), np.eye(2, 4), LIFTING, 0.1, ("a [m]", "b [m/s]"), ("u [N]",))


@given(st.floats(0.01, 1.0), st.integers(0, 10**6))
def test_it_is_a_first_order_filter_of_the_misfit(gain, seed):
    rng = np.random.default_rng(seed)
    model = predictor(rng)
    observer = km.LiftedDisturbance(gain).start(model)
    X, U = rng.normal(size=(12, 2)), rng.normal(size=(12, 1))
    d = np.zeros(4)
    for k in range(12):
        assert observer.observe(X[k], U[k - 1], NO_W)
        if k:
            misfit = model.lift(X[k]) - model.A @ model.lift(X[k - 1]) - model.B @ U[k - 1]
            d = (1 - gain) * d + gain * misfit
            d[3] = 0.0
        np.testing.assert_allclose(observer.z, model.lift(X[k]), atol=1e-14)
        np.testing.assert_allclose(observer.d, d, atol=1e-12)


@given(st.integers(0, 10**6))
def test_at_rest_the_plant_is_an_equilibrium_of_the_model(seed):
    rng = np.random.default_rng(seed)
    model = predictor(rng)
    observer = km.LiftedDisturbance(0.5).start(model)
    x, u = rng.normal(size=2), rng.normal(size=1)
    for _ in range(60):
        observer.observe(x, u, NO_W)
    z = model.lift(x)
    rest = model.A @ z + model.B @ u + observer.d
    np.testing.assert_allclose(rest[:3], z[:3], atol=1e-12)


def test_a_true_model_has_no_disturbance_and_a_measured_one_is_no_news():
    A, B, E = np.diag([0.5, 0.9]), np.ones((2, 1)), np.array([[1.0], [2.0]])
    observer = km.LiftedDisturbance(1.0).start(linear(A, B, [0.1, 0.2], E))
    rng = np.random.default_rng(0)
    x, u, w = np.zeros(2), np.zeros(1), np.zeros(1)
    for _ in range(10):
        observer.observe(x, u, w)
        u, w = rng.normal(size=1), rng.normal(size=1)
        x = A @ x + B @ u + E @ w + [0.1, 0.2]
    np.testing.assert_allclose(observer.d, 0, atol=1e-14)


def test_a_missed_sample_leaves_the_disturbance_as_it_is():
    observer = km.LiftedDisturbance(0.5).start(linear(np.diag([0.5, 0.9]), np.ones((2, 1))))
    u = np.zeros(1)
    for x in ([1.0, 2.0], [2.0, 1.0]):
        observer.observe(np.array(x), u, NO_W)
    before = observer.d.copy()
    assert before.any()
    assert not observer.observe(np.array([np.nan, 1.0]), u, NO_W)
    assert not observer.observe(np.array([1e200, 1.0]), u, NO_W)
    assert observer.observe(np.array([5.0, 5.0]), u, NO_W)  # what came before is unknown
    np.testing.assert_array_equal(observer.d, before)
    assert observer.observe(np.array([5.0, 5.0]), u, NO_W)
    assert (observer.d != before).all()
    observer.reset()
    assert not observer.d.any()


@pytest.mark.parametrize("gain", [0.0, -0.1, 1.1, np.nan])
def test_the_gain_is_checked(gain):
    with pytest.raises(km.errors.DataError, match="gain"):
        km.LiftedDisturbance(gain)
