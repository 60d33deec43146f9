"""ExtendedKalman: the linear filter where the model is linear, hidden states, delays, rails, and no offset in a loop."""

import numpy as np
import pytest

import koopmpc as km


def observer_of(model, rule=None, **settings):
    mpc = km.BilinearMPC(model, km.Cost(Q=1.0, R=1.0), None, 10, estimator=rule or km.ExtendedKalman(**settings))
    return mpc, mpc.observer


def narx_plant(k, y, before, u):
    return 1.5 * y - 0.7 * before - 0.05 * y**3 + 0.3 * u


def narx_record(rng, steps=500, noise=0.0, load=0.0, rail=np.inf):
    y, u = np.zeros(steps + 1), rng.uniform(-1, 1, steps)
    for k in range(1, steps):
        y[k + 1] = narx_plant(k, y[k], y[k - 1], u[k]) + load
    shown = np.minimum(y + noise * rng.standard_normal(steps + 1), rail)
    return y, km.Episodes([km.Episode(X=shown[:, None], U=u[:, None])], 0.1, ["y"], ["u"])


@pytest.fixture(scope="module")
def narx():
    return km.identify.narx(narx_record(np.random.default_rng(0))[1], delays=1, degrees=3)


def test_on_a_linear_map_it_is_the_kalman_filter():
    """The covariance recursion and the estimate are those of the textbook, written out."""
    rng = np.random.default_rng(1)
    A, B = np.array([[0.9, 0.2], [-0.1, 0.8]]), np.array([[0.1], [1.0]])
    model = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ["a", "b"], ["u"])
    q, r, v = 0.02, 0.05, 0.01
    _, observer = observer_of(model, process=q, noise=r, drift=v)
    F, H = np.block([[A, np.eye(2)], [np.zeros((2, 2)), np.eye(2)]]), np.eye(2, 4)
    Q = np.diag([q, q, v, v])
    x = np.zeros(2)
    s = P = last = None
    for _ in range(40):
        y, u = x + 0.2 * rng.standard_normal(2), rng.standard_normal(1)
        if s is None:
            assert observer.observe(y, np.zeros(1), np.zeros(0))
            s, P = np.append(observer.z, np.zeros(2)), observer._P.copy()
        else:
            assert observer.observe(y, last, np.zeros(0))
            s, P = F @ s + np.append(B @ last, np.zeros(2)), F @ P @ F.T + Q
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + r * np.eye(2))
            s, P = s + K @ (y - H @ s), (np.eye(4) - K @ H) @ P
            assert np.allclose(observer.z, s[:2], atol=1e-9)
            assert np.allclose(observer.d, s[2:], atol=1e-9)
        last, x = u, A @ x + B @ u


def test_delays_are_filtered_better_than_they_are_measured(narx):
    rng = np.random.default_rng(2)
    y, data = narx_record(rng, 300, noise=0.2)
    _, observer = observer_of(narx, process=1e-6, drift=1e-10, noise=0.04)
    shown, U = data[0].X, data[0].U
    errors, raw = [], []
    for k in range(300):
        assert observer.observe(shown[k], U[k - 1] if k else np.zeros(1), np.zeros(0))
        if k > 100:
            errors.append(observer.z[0] - y[k])
            raw.append(shown[k, 0] - y[k])
    assert np.std(errors) < 0.5 * np.std(raw)


def test_readings_at_the_rail_correct_nothing_where_the_prediction_lies_beyond(narx):
    rng = np.random.default_rng(3)
    _, data = narx_record(rng, rail=0.4)
    railed = km.identify.narx(data, delays=1, degrees=1)
    delay = km.Delay(1, rails=np.array([[-np.inf], [0.4]])).bind(("y",), ("u",))
    assert delay.is_beyond(np.array([0.4]), np.array([0.7])).all()
    assert not delay.is_beyond(np.array([0.4]), np.array([0.2])).any()
    model = km.LinearPredictor(railed.A, railed.B, railed.C, railed.lifting, 0.1, ["y"], ["u"], embedding=delay)
    _, observer = observer_of(model, noise=0.01)
    observer.observe(np.array([0.35]), np.zeros(1), np.zeros(0))
    observer.z[:] = [0.6, 0.0, 0.5]
    free = observer._model.advance(observer.z, np.array([1.0]), np.zeros(0), observer.d)
    assert free[0] > 0.4
    observer.observe(np.array([0.4]), np.array([1.0]), np.zeros(0))
    assert np.allclose(observer.z, free)


def test_missing_readings_are_bridged_and_then_reported(narx):
    _, observer = observer_of(narx)
    assert observer.observe(np.array([0.1]), np.zeros(1), np.zeros(0))
    nothing = np.array([np.nan])
    assert all(observer.observe(nothing, np.zeros(1), np.zeros(0)) for _ in range(10))
    assert not observer.observe(nothing, np.zeros(1), np.zeros(0))


@pytest.mark.parametrize("kind", ["narx", "hidden"])
def test_no_offset_is_left_under_a_load(narx, kind):
    model = narx
    if kind == "hidden":
        model = km.identify.polynomial_state_space(narx_record(np.random.default_rng(0))[1], [2], [3], horizon=30)
        assert isinstance(model, km.BilinearPredictor)
    rule = km.ExtendedKalman()
    mpc = km.BilinearMPC(model, km.Cost(Q=1.0, R=1e-2), km.Limits(u_min=-2, u_max=2), 15, estimator=rule)
    y, before, u = 0.0, 0.0, 0.0
    for k in range(120):
        u = float(mpc([y], [0.5]).u[0])
        y, before = narx_plant(k, y, before, u) + 0.05, y
    assert abs(y - 0.5) < 1e-3
    with pytest.raises(km.errors.DataError, match=r"ExtendedKalman cannot be written in C|hidden state"):
        mpc.build_program([0.5])


def test_the_state_behind_an_output_is_found():
    """NonlinearMPC on given equations, of which one output is measured."""
    import casadi as ca

    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    F = ca.Function("F", [x, u], [ca.vertcat(x[0] + 0.1 * x[1], 0.9 * x[1] - 0.1 * ca.sin(x[0]) + 0.1 * u)])
    plant = km.StepMap(F, 0.1, ca.Function("h", [x], [x[0]]))
    _, observer = observer_of(plant, process=1e-4, noise=1e-4)
    state = np.array([0.5, 1.0])
    for _ in range(60):
        observer.observe(state[:1], np.array([0.3]), np.zeros(0))
        before, state = state, plant(state, [0.3])
    assert np.abs(observer.z - before).max() < 0.02


def test_linear_models_that_are_lifted_once_are_refused_in_a_sentence(narx):
    linear = km.identify.narx(narx_record(np.random.default_rng(0))[1], delays=2, degrees=1)
    with pytest.raises(km.errors.DataError, match="LiftedKalman"):
        km.KoopmanMPC(linear, km.Cost(Q=1.0, R=1.0), None, 10, estimator=km.ExtendedKalman())
    with pytest.raises(km.errors.DataError, match="variance"):
        km.ExtendedKalman(noise=-1.0)


@pytest.mark.parametrize("kind", ["disturbance", "kalman"])
def test_linear_observers_learn_nothing_at_a_rail_either(kind):
    rails = np.array([[-np.inf], [1.0]])
    delay = km.Delay(1, rails=rails).bind(("y",), ("u",))
    A = np.array([[0.9, 0.1, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    B = np.array([[0.3], [1.0], [0.0]])
    found = []
    for embedding in (delay, delay.without_rails()):
        model = km.LinearPredictor(A, B, np.eye(1, 3), km.State(), 0.1, ["y"], ["u"], embedding=embedding)
        rule = km.LiftedDisturbance() if kind == "disturbance" else km.LiftedKalman(model.C)
        observer = km.KoopmanMPC(model, km.Cost(Q=1.0, R=1.0), None, 10, estimator=rule).observer
        y = 0.0
        for k in range(60):  # the input drives the output far beyond the sensor's limit
            observer.observe(np.array([min(y, 1.0)]), np.array([1.0 if k else 0.0]), np.zeros(0))
            y = 0.9 * y + 0.3 + 0.1 * (k > 0)
        assert y > 2.0
        found.append(float(np.abs(observer.d).max()))
    assert found[0] < 0.02
    assert found[1] > 0.1


def test_an_output_that_is_a_state_and_a_constant_has_the_rails_of_the_state_moved_by_it():
    delay = km.Delay(1, rails=np.array([[-np.inf], [1.0]])).bind(("y",), ("u",))
    A = np.array([[0.9, 0.1, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    B = np.array([[0.3], [1.0], [0.0], [0.0]])
    lifting = km.State() + km.Constant()
    model = km.LinearPredictor(A, B, np.eye(1, 4), lifting, 0.1, ["y"], ["u"], embedding=delay)
    H = model.C.copy()
    H[0, 3] = 0.5
    mpc = km.KoopmanMPC(model, km.Cost(Q=1.0, R=1.0), None, 10, estimator=km.LiftedKalman(H))
    observer, y = mpc.observer, 0.0
    assert not observer.program().shows  # y is no state: a lost estimate does not begin again at x = y
    for k in range(110):  # the sensor reads y + 0.5, and is at its rail from 1.5 on; y rests at 0.9
        observer.observe(np.array([y + 0.5]), np.array([0.2 if k else 0.0]), np.zeros(0))
        y = 0.9 * y + 0.06 + 0.02 * (k > 0) + 0.01 * (k >= 60)
    assert 0.8 < y < 1.0
    assert abs(observer.z[0] - y) < 0.01


@pytest.mark.parametrize("kind", ["disturbance", "kalman"])
def test_nothing_is_learned_where_one_of_two_sensors_is_at_its_rail(kind):
    delay = km.Delay(1, rails=np.array([[-np.inf, -np.inf], [1.0, np.inf]])).bind(("y", "v"), ("u",))
    A, B = np.zeros((5, 5)), np.array([[0.3], [0.3], [1.0], [0.0], [0.0]])  # of y, v, u[k-1], y[k-1], v[k-1]
    A[[0, 1, 0, 1, 3, 4], [0, 1, 2, 2, 0, 1]] = 0.9, 0.9, 0.1, 0.1, 1.0, 1.0
    model = km.LinearPredictor(A, B, np.eye(2, 5), km.State(), 0.1, ["y", "v"], ["u"], embedding=delay)
    rule = km.LiftedDisturbance() if kind == "disturbance" else km.LiftedKalman(model.C, disturbance="output")
    observer = km.KoopmanMPC(model, km.Cost(Q=1.0, R=1.0), None, 10, estimator=rule).observer
    y, most = 0.0, 0.0
    for k in range(60):
        observer.observe(np.array([min(y, 1.0), y]), np.array([float(k > 0)]), np.zeros(0))
        most = max(most, float(np.abs(observer.d).max()))
        y = 0.9 * y + 0.3 + 0.1 * (k > 0)
    assert y > 2.0
    assert most < 1e-3


@pytest.mark.parametrize("zero", [0.0, 5.0, -5.0])
def test_the_zero_of_a_sensor_that_saturates_does_not_count(zero):
    delay = km.Delay(1, rails=np.array([[-np.inf], [1.0 + zero]])).bind(("y",), ("u",))
    A, B, C = np.zeros((4, 4)), np.array([[0.3], [1.0], [0.0], [0.0]]), np.array([[1.0, 0.0, 0.0, zero]])
    A[[0, 0, 2, 3], [0, 1, 0, 3]] = 0.9, 0.1, 1.0, 1.0
    lifting = km.State() + km.Constant()
    model = km.LinearPredictor(A, B, C, lifting, 0.1, ["y"], ["u"], embedding=delay)
    observer = km.KoopmanMPC(model, km.Cost(Q=1, R=1), None, 10, estimator=km.LiftedKalman(C)).observer
    observer.reset()
    y, shares = 0.0, []
    for k in range(60):  # the input drives the output far beyond the rail, and the model knows
        observer.observe(np.array([min(y, 1.0) + zero]), np.array([float(k > 0)]), np.zeros(0))
        shares.append(float(np.abs(observer.d).max()))
        y = 0.9 * y + 0.3 + 0.1 * (k > 0)
    assert y > 2.0
    assert max(shares) < 1e-9
