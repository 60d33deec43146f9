"""Periodic disturbances: forecasts of exact harmonics, loops on them, periods found in logs, and errors."""

import copy

import numpy as np
import pytest

import koopmpc as km
from tests.compiler import avoid_compiling

DT, PERIOD = 0.5, 7.3
A, B = np.array([[0.9, 0.1], [-0.1, 0.8]]), np.array([[0.0], [0.3]])
MODEL = km.LinearPredictor(A, B, np.eye(2), km.State().bind(("a", "b")), DT, ("a", "b"), ("u",))


@pytest.fixture(autouse=True)
def interpret(monkeypatch):
    avoid_compiling(monkeypatch)


def push(k):
    """A constant, and two harmonics of the period, on both states."""
    turn = 2 * np.pi * k * DT / PERIOD
    return np.array([0.02 + 0.05 * np.sin(turn + 1), 0.1 * np.cos(turn) - 0.04 * np.sin(2 * turn)])


def run(mpc, steps, r=(0.0, 0.0), latency=0):
    x, X, U, moves, sent = np.zeros(2), [], [], [], [np.zeros(1)] * latency
    for k in range(steps):
        move = mpc(x, np.array(r))
        sent.append(move.u)
        x = A @ x + B @ sent.pop(0) + push(k)
        X.append(x)
        U.append(move.u)
        moves.append(move)
    return np.array(X), np.array(U), moves


def controller(latency=0, kind=km.KoopmanMPC, horizon=12, **estimator):
    cost = km.Cost(Q=[0, 1], R=1e-6, u_target="zero")
    told = km.LiftedDisturbance(**estimator)
    return kind(MODEL, cost, km.Limits(u_min=-5, u_max=5), horizon, estimator=told, latency=latency)


@pytest.mark.parametrize("latency", [0, 2])
def test_the_plan_of_an_exact_model_foretells_the_disturbance(latency):
    mpc = controller(latency, period=PERIOD)
    run(mpc, 900, latency=latency)
    observer = mpc.observer
    ahead = observer.d + observer.forecast(12)
    np.testing.assert_allclose(ahead, [push(900 - 1 + i) for i in range(12)], atol=1e-6)
    states = mpc.plan().X
    assert np.isfinite(states).all()


def test_a_loop_with_the_period_has_no_error_where_one_without_has():
    knowing, plain = (run(controller(**kind), 300)[0][200:, 1] for kind in ({"period": PERIOD}, {}))
    assert np.abs(knowing).max() < 1e-4
    assert np.abs(plain).max() > 1e-2


@pytest.mark.parametrize("kind", [km.BilinearMPC, pytest.param(km.NonlinearMPC, marks=pytest.mark.slow)])
def test_controllers_that_plan_in_the_state_know_the_period_too(kind):
    """The loop has no error, the next state is the planned one, and a copy and a reset run repeat the inputs."""
    mpc = controller(kind=kind, horizon=5, period=PERIOD)
    X, U, moves = run(mpc, 240)
    assert {move.status.name for move in moves[100:]} <= {"OPTIMAL", "UNCONSTRAINED"}
    assert np.abs(X[200:, 1]).max() < 1e-4
    other = copy.deepcopy(mpc)
    after = other(X[-1], np.zeros(2)).u
    np.testing.assert_array_equal(mpc(X[-1], np.zeros(2)).u, after)
    np.testing.assert_allclose(mpc.plan().X[1], A @ X[-1] + B @ after + push(240), atol=5e-5)
    mpc.reset()
    np.testing.assert_array_equal(run(mpc, 20)[1], U[:20])


def test_the_target_of_a_plan_is_that_of_the_constant_part():
    """At an exact model's rest a long plan of BilinearMPC is KoopmanMPC's, though the disturbance goes on to move."""
    plans = []
    for kind in (km.KoopmanMPC, km.BilinearMPC):
        cost = km.Cost(Q=[1, 1], R=0.1, Q_N=[1, 1])
        mpc = kind(MODEL, cost, km.Limits(u_min=-5, u_max=5), 12, estimator=km.LiftedDisturbance(period=PERIOD))
        x = np.zeros(2)
        for k in range(60):
            mpc(x, np.array([0.3, 0.1]), applied=[0.1])
            x = A @ x + B @ [0.1] + push(k)
        plans.append(mpc.plan())
    np.testing.assert_allclose(plans[1].U, plans[0].U, atol=1e-6)
    np.testing.assert_allclose(plans[1].X, plans[0].X, atol=1e-6)


def test_without_a_disturbance_nothing_changes():
    cost = km.Cost(Q=1.0, R=0.1)
    plain = km.KoopmanMPC(MODEL, cost, km.Limits(), 10)
    knowing = km.KoopmanMPC(MODEL, cost, km.Limits(), 10, estimator=km.LiftedDisturbance(period=PERIOD))
    x = np.array([1.0, -0.5])
    for _ in range(10):
        u = plain(x, [0.3, 0.0]).u
        np.testing.assert_allclose(knowing(x, [0.3, 0.0]).u, u, atol=1e-12)
        x = A @ x + B @ u


def test_the_planned_states_are_those_that_come():
    mpc = controller(period=PERIOD)
    X, _, _ = run(mpc, 300)
    planned = mpc.plan().X
    np.testing.assert_allclose(planned[1], X[-1], atol=1e-5)


def test_runs_repeat_and_files_keep_the_period(tmp_path):
    mpc = controller(period=PERIOD)
    first = run(mpc, 30)[1]
    mpc.reset()
    np.testing.assert_array_equal(run(mpc, 30)[1], first)
    mpc.save(tmp_path / "mpc.npz")
    np.testing.assert_array_equal(run(km.load_controller(tmp_path / "mpc.npz"), 30)[1], first)


def test_missed_and_wild_readings_do_not_end_the_phase():
    mpc, x, rng = controller(period=PERIOD), np.zeros(2), np.random.default_rng(0)
    for k in range(400):
        y = np.full(2, np.nan) if k % 50 == 7 else x + 100.0 * (k % 60 == 11)
        u = mpc(y, np.zeros(2)).u
        assert np.abs(u).max() <= 5
        x = A @ x + B @ u + push(k) + 1e-6 * rng.standard_normal(2)
    np.testing.assert_allclose(mpc.observer.d + mpc.observer.forecast(1)[0], push(399), atol=1e-2)


def logs(seed, amplitude=0.1, noise=0.05, period=PERIOD, T=600):
    rng, X = np.random.default_rng(seed), [np.zeros(2)]
    U = rng.standard_normal((T, 1))
    for k, u in enumerate(U):
        wave = amplitude * np.sin(2 * np.pi * k * DT / period + seed)
        X.append(A @ X[-1] + B @ u + np.array([0, wave]) + noise * rng.standard_normal(2))
    return km.Episodes([km.Episode(X=np.array(X), U=U)], DT, states=["a", "b"], inputs=["u"])


@pytest.mark.parametrize("period", [1.7, 7.3, 61.0])
def test_a_period_is_found_in_logs(period):
    found = km.estimate.find_period(MODEL, logs(0, period=period))
    assert found == pytest.approx(period, rel=0.02)


def test_noise_has_no_period():
    for seed in range(3):
        with pytest.raises(km.errors.DataError, match="no period stands out"):
            km.estimate.find_period(MODEL, logs(seed, amplitude=0.0))


def test_bad_periods_are_refused_in_a_sentence(tmp_path):
    with pytest.raises(km.errors.DataError, match=r"period is 0.9 s, less than two samples of 0.5 s"):
        controller(period=0.9)
    with pytest.raises(km.errors.DataError, match="period"):
        km.LiftedDisturbance(period=-1.0)
    with pytest.raises(km.errors.DataError, match="leave out gain"):
        km.LiftedDisturbance(gain=0.5, period=3.0)
    for kind in (km.KoopmanMPC, km.BilinearMPC):
        with pytest.raises(km.errors.DataError, match="period"):
            km.export(controller(kind=kind, period=PERIOD), tmp_path)


def kalman(**more):
    cost = km.Cost(Q=[0, 1], R=1e-6, u_target="zero")
    told = km.LiftedKalman(["a", "b"], **more)
    return km.KoopmanMPC(MODEL, cost, km.Limits(u_min=-5, u_max=5), 12, estimator=told)


@pytest.mark.parametrize("disturbance", ["input", "output"])
def test_a_filter_foretells_the_disturbance_of_its_own_model(disturbance):
    """The error of a one-step forecast of y dies out where the disturbance is a constant and two harmonics."""
    mpc = kalman(period=PERIOD, disturbance=disturbance)
    plain = kalman(disturbance=disturbance)
    errors = []
    for each in (mpc, plain):
        x, late = np.zeros(2), []
        for k in range(500):
            move = each(x, np.zeros(2))
            foretold = each.plan().X[1]
            wave = np.array([0.0, push(k)[1]])
            x = A @ x + B @ move.u + (wave if disturbance == "input" else push(k))
            late.append(np.abs(foretold - x).max())
        errors.append(max(late[-50:]))
    assert errors[0] < 1e-5
    assert errors[1] > 1e-2


def test_a_filter_without_a_period_is_the_same_as_ever_and_bad_periods_are_refused():
    assert not hasattr(kalman().observer, "forecast")
    with pytest.raises(km.errors.DataError, match="less than two samples"):
        kalman(period=0.9)
    with pytest.raises(km.errors.DataError, match="period"):
        kalman(period=0.0)
