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


@given(st.floats(0.05, 1.0), st.integers(0, 10**6))
def test_d_moves_to_the_mean_of_the_misfits_by_the_share_that_was_constant(gain, seed):
    """The formula of the docstring with sums over all misfits in place of recursions."""
    rng = np.random.default_rng(seed)
    model = predictor(rng)
    observer = km.LiftedDisturbance(gain).start(model, 20)
    X, U = rng.normal(size=(12, 2)), rng.normal(size=(12, 1))
    X[:, 0] += 5.0
    X[:, 1] = 1e3 + 0.1 * X[:, 1]  # a state whose misfits hardly vary, in a unit of its own
    if seed % 2:  # or states that the model foretells: they move more than they are missed
        X[0] = rng.normal(size=2)
        for k in range(1, 12):
            X[k] = model.C @ (model.A @ model.lift(X[k - 1]) + model.B @ U[k - 1]) + rng.uniform(0.5, 1, 2) * [
                0.3,
                3e-3,
            ]
    d, E = np.zeros(4), []
    for k in range(12):
        assert observer.observe(X[k], U[k - 1], NO_W)
        if k:
            E.append(model.lift(X[k]) - model.A @ model.lift(X[k - 1]) - model.B @ U[k - 1])
            E[-1][3] = 0.0
            weights = gain * (1 - gain) ** np.arange(k)[::-1]
            seen = np.array(E) @ model.C.T
            rough = weights[1:] @ np.diff(seen, axis=0) ** 2 / 2 if k > 1 else 0.0
            varied = np.maximum(weights @ seen**2 - (weights @ seen) ** 2 - rough, 0)
            largest = np.maximum((weights @ seen) ** 2, (model.C @ d) ** 2)
            size = np.maximum((np.diff(X[: k + 1], axis=0) ** 2).max(axis=0), (seen**2).max(axis=0))
            share = max(1 - (varied / size).sum() / (largest / size).sum(), 0)
            d = d + share * (weights @ np.array(E) - d)
        np.testing.assert_allclose(observer.z, model.lift(X[k]), atol=1e-14)
        np.testing.assert_allclose(observer.d, d, rtol=1e-6, atol=1e-9)


def after(misfits, gain=None, horizon=20, noise=0.0):
    """d of x⁺ = x / 2 after these misfits of a plant that moves all the time."""
    observer = km.LiftedDisturbance(gain).start(linear(np.array([[0.5]]), np.ones((1, 1))), horizon)
    rng = np.random.default_rng(0)
    x, found = 0.0, []
    for misfit in misfits:
        observer.observe(np.array([x + noise * rng.normal()]), np.zeros(1), NO_W)
        found.append(observer.d[0])
        x = 0.5 * x + misfit
    return np.array(found)


def test_what_lasts_is_learned_within_the_horizon_and_forgotten_again():
    assert abs(after(np.ones(21))[-1] - 1) < 0.03
    assert abs(after(np.ones(200))[-1] - 1) < 1e-12
    assert abs(after(np.r_[np.ones(50), np.zeros(300)])[-1]) < 1e-9


def test_what_a_transient_shows_is_not_held():
    """A misfit that dies out within a quarter of the horizon leaves a fifth of what a plain filter makes of it."""
    misfits, plain, most = 0.7 ** np.arange(40), 0.0, 0.0
    for misfit in misfits:
        plain += (1 - np.exp(-0.2)) * (misfit - plain)
        most = max(most, plain)
    assert np.abs(after(misfits)).max() < 0.2 * most


def test_noise_is_averaged_and_does_not_stop_it():
    """The noise of y is no transient: an offset of a fifth of it is found, and d varies by less than y."""
    found = after(np.full(2000, 0.2), noise=1.0)[500:]
    assert abs(found.mean() - 0.2) < 0.1
    assert found.std() < 0.5


def test_the_gain_follows_the_horizon_and_is_never_below_a_tenth():
    misfits = np.full(200, 0.1)
    np.testing.assert_array_equal(after(misfits, None, 10, 1.0), after(misfits, 1 - np.exp(-0.4), 10, 1.0))
    np.testing.assert_array_equal(after(misfits, None, 400, 1.0), after(misfits, 0.1, 400, 1.0))


def test_exact_measurements_need_no_mean():
    """A load is known with its second misfit, and followed where it drifts; a mean of gain 0.1 lags nine steps behind."""
    assert (after(np.ones(30))[2:] == 1).all()
    drifting = 1 + 0.01 * np.arange(200)
    assert np.abs(after(drifting)[3:] - drifting[2:-1]).max() < 0.002
    assert np.abs(after(drifting, 0.1)[100:] - drifting[99:-1]).min() > 0.08


@pytest.mark.parametrize("horizon", [1, 20, 50])
def test_a_drift_is_followed_as_far_as_it_is_slow_over_two_fifths_of_the_horizon(horizon):
    """Of misfits f that grow by s a step, d lacks (0.4 N s / f)² s, and N is 2.5 at least."""
    misfits = 1 + 0.02 * np.arange(900)
    late = misfits[700:-1]
    lack = late - after(misfits, horizon=horizon)[701:]
    np.testing.assert_allclose(lack, (max(0.4 * horizon, 1) * 0.02 / late) ** 2 * 0.02, rtol=0.1)


def test_constant_leaks_cost_at_most_three_percent():
    """Two tanks in line, outflows 20 % off, leaks, exact measurements: against the same controller that knows the leaks."""

    def tanks(leak, wide):
        x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
        out = ca.sqrt(x + 0.01)
        F = x + 0.1 * ca.vertcat(u - 1.2**wide * out[0] - leak, 1.2**wide * out[0] - 0.8**wide * out[1] - leak)
        return km.StepMap(ca.Function("F", [x, u], [F]), 0.1, states=("a [m]", "b [m]"), inputs=("u [m/s]",))

    cost, limits = km.Cost(Q=[0.1, 1.0], R=0.05), km.Limits(u_min=0, u_max=3)
    truth, start, aim = tanks(0.15, 1), [1.0, 1.0], [1.3, 1.5]
    data = km.collect(tanks(0, 0), km.Uniform([0.3, 0.3], [2, 2]), km.Noise(0, 3, 4), episodes=40, steps=40)
    model = km.bilinear_edmd(data, km.State() + km.Monomials(2) + km.Constant())
    costs = [
        km.metrics(km.simulate(truth, c, x0=start, reference=aim, steps=80, cost=cost, limits=limits)).cost
        for c in (
            km.NonlinearMPC(truth, cost, limits, 30),
            km.BilinearMPC(model, cost, limits, 30, estimator=km.LiftedDisturbance()),
            km.BilinearMPC(model, cost, limits, 30, estimator=km.LiftedDisturbance(gain=0.15)),
        )
    ]
    assert costs[1] < 1.03 * costs[0]
    assert costs[2] > costs[1]


@given(st.integers(0, 10**6), st.lists(st.floats(-6, 6), min_size=3, max_size=3))
def test_units_do_not_decide(seed, powers):
    """x′ = S x and u′ = s u give d′ = S d."""
    rng = np.random.default_rng(seed)
    A, B, S, s = rng.normal(size=(2, 2)) / 2, rng.normal(size=(2, 1)), np.diag(10.0 ** np.array(powers[:2])), powers[2]
    X, U, found = np.cumsum(rng.normal(size=(30, 2)), axis=0), rng.normal(size=(30, 1)), []
    X[15:] = X[15]
    U[15:] = U[15]
    back = np.linalg.inv(S)
    for model, x, u in ((linear(A, B), X, U), (linear(S @ A @ back, S @ B / 10.0**s), X @ S, U * 10.0**s)):
        observer = km.LiftedDisturbance().start(model, 20)
        for k in range(30):
            observer.observe(x[k], u[k - 1], NO_W)
        found.append(observer.d)
    assert found[0].any()
    np.testing.assert_allclose(back @ found[1], found[0], rtol=1e-6, atol=1e-9)


@given(st.integers(0, 10**6))
def test_at_rest_the_plant_is_an_equilibrium_of_the_model(seed):
    rng = np.random.default_rng(seed)
    model = predictor(rng)
    observer = km.LiftedDisturbance(0.5).start(model, 20)
    x, u = rng.normal(size=2), rng.normal(size=1)
    for _ in range(60):
        observer.observe(x, u, NO_W)
    z = model.lift(x)
    rest = model.A @ z + model.B @ u + observer.d
    np.testing.assert_allclose(rest[:3], z[:3], atol=1e-12)


def test_a_true_model_has_no_disturbance_and_a_measured_one_is_no_news():
    A, B, E = np.diag([0.5, 0.9]), np.ones((2, 1)), np.array([[1.0], [2.0]])
    observer = km.LiftedDisturbance(1.0).start(linear(A, B, [0.1, 0.2], E), 20)
    rng = np.random.default_rng(0)
    x, u, w = np.zeros(2), np.zeros(1), np.zeros(1)
    for _ in range(10):
        observer.observe(x, u, w)
        u, w = rng.normal(size=1), rng.normal(size=1)
        x = A @ x + B @ u + E @ w + [0.1, 0.2]
    np.testing.assert_allclose(observer.d, 0, atol=1e-14)


def test_a_missed_sample_leaves_the_disturbance_as_it_is():
    observer = km.LiftedDisturbance(0.5).start(linear(np.diag([0.5, 0.9]), np.ones((2, 1))), 20)
    u = np.zeros(1)
    for k in range(8):  # six readings that agree make a gate sure; before, a leap starts the observer again
        observer.observe(np.array([1.0, 2.0]) + 0.5 * (k % 2), u, NO_W)
    before = observer.d.copy()
    assert before.any()
    assert not observer.observe(np.array([np.nan, 1.0]), u, NO_W)
    assert not observer.observe(np.array([1e200, 1.0]), u, NO_W)
    assert observer.observe(np.array([1.2, 2.2]), u, NO_W)  # what came before is unknown
    np.testing.assert_array_equal(observer.d, before)
    assert observer.observe(np.array([1.2, 2.2]), u, NO_W)
    assert (observer.d != before).all()
    observer.reset()
    assert not observer.d.any()


@pytest.mark.parametrize("gain", [0.0, -0.1, 1.1, np.nan])
def test_the_gain_is_checked(gain):
    with pytest.raises(km.errors.DataError, match="gain"):
        km.LiftedDisturbance(gain)
