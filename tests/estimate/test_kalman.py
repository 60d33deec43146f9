"""LiftedKalman against a textbook filter, and what it finds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.estimate.plants import Textbook, linear, stable

NO_W = np.zeros(0)


def textbook(model, H, disturbance, rule):
    """The filter on [x; d] of an affine model on State() (+ Constant())."""
    nx, nu, ny = model.nx, model.nu, len(H)
    A, B = model.A[:nx, :nx], model.B[:nx]
    c = model.A[:nx, nx] if model.nz > nx else np.zeros(nx)
    Bd = np.hstack([B, np.zeros((nx, ny - nu))]) if disturbance == "input" else np.zeros((nx, ny))
    Cd = np.diag(np.r_[np.zeros(nu), np.ones(ny - nu)]) if disturbance == "input" else np.eye(ny)
    F = np.block([[A, Bd], [np.zeros((ny, nx)), np.eye(ny)]])
    Q = np.diag(np.r_[np.full(nx, float(rule.process)), np.full(ny, float(rule.drift))])
    G = np.vstack([B, np.zeros((ny, nu))])
    loop = Textbook(
        F,
        G,
        np.r_[c, np.zeros(ny)],
        np.hstack([H, Cd]),
        Q,
        float(rule.noise) * np.eye(ny),
        np.zeros(nx + ny),
        Q,
    )
    loop.P = loop.settle()
    return loop, Bd, Cd


@pytest.mark.parametrize("disturbance", ["input", "output"])
@pytest.mark.parametrize("affine", [False, True])
@settings(max_examples=15)
@given(seed=st.integers(0, 10**6))
def test_it_equals_the_textbook_filter(disturbance, affine, seed):
    rng = np.random.default_rng(seed)
    (A, B), H, c = stable(rng, 3, 1), np.eye(2, 3), rng.normal(size=3)
    model = linear(A, B, c if affine else None)
    rule = km.LiftedKalman(("x0", "x1"), disturbance, process=0.1, drift=0.2, noise=0.3)
    try:
        mine = rule.start(model, 20)
    except km.errors.DataError:
        return  # a random plant may be undetectable; test_detectable judges that
    book, Bd, Cd = textbook(model, H, disturbance, rule)
    shift = H.T @ Cd
    mine.reset(np.zeros(3))
    u = np.zeros(1)
    for k in range(30):
        y = rng.normal(size=2)
        if k % 7 == 3:
            y[rng.integers(2)] = np.nan
        if k % 11 == 5:
            y[:] = np.nan
        held = book.P
        if k:
            book.predict(u)
            book.P = held
        s = book.correct(y) if np.isfinite(y).any() else book.s
        book.P = held  # the stationary one throughout
        assert mine.observe(y, u, NO_W)
        x, d = s[:3], s[3:]
        np.testing.assert_allclose(mine.z[:3], x + shift @ d, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(mine.d[:3], Bd @ d + (np.eye(3) - A) @ shift @ d, rtol=1e-6, atol=1e-6)
        if affine:
            assert mine.z[3] == 1.0
            assert mine.d[3] == 0.0
        u = rng.normal(size=1)


def test_the_constant_is_known_whatever_a_fit_has_made_of_its_row():
    A, B = np.diag([0.5, 0.8]), np.ones((2, 1))
    model = linear(A, B, [1.0, 2.0])
    spoiled = km.LinearPredictor(
        model.A + 1e-3 * np.eye(3)[:, [2]] * np.ones(3),
        model.B,
        model.C,
        model.lifting,
        0.1,
        model.states,
        model.inputs,
    )
    for disturbance in ("input", "output"):
        seen = []
        for one in (model, spoiled):
            observer = km.LiftedKalman("x0", disturbance).start(one, 20)
            for k in range(20):
                observer.observe(np.array([np.sin(k)]), np.array([np.cos(k)]), NO_W)
            seen.append(np.r_[observer.z, observer.d])
        np.testing.assert_array_equal(*seen)


@settings(max_examples=15)
@given(st.integers(0, 10**6), st.sampled_from(["input", "output"]))
def test_at_rest_it_explains_the_measurement_exactly(seed, disturbance):
    """Whatever the plant: with constant u and y, H z = y and z = A z + B u + d."""
    rng = np.random.default_rng(seed)
    A, B = np.diag(rng.uniform(-0.5, 0.7, 3)), rng.uniform(0.5, 1.5, (3, 1))
    model = linear(A, B, rng.normal(size=3))
    observer = km.LiftedKalman(("x0", "x1"), disturbance, process=1.0, noise=0.1).start(model, 20)
    y, u = rng.normal(size=2), rng.normal(size=1)
    for _ in range(150):
        observer.observe(y, u, NO_W)
    z, d = observer.z, observer.d
    np.testing.assert_allclose(model.A @ z + model.B @ u + d, z, atol=1e-8)
    np.testing.assert_allclose(z[:2], y, atol=1e-8)


def test_it_finds_a_load_on_the_input():
    A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]])
    model = linear(A, B)
    observer = km.LiftedKalman("x0").start(model, 20)
    rng = np.random.default_rng(0)
    x, u = np.array([0.3, 0.0]), np.zeros(1)
    observer.reset(np.zeros(2))
    for _ in range(300):
        observer.observe(x[:1].copy(), u, NO_W)
        u = rng.normal(size=1)
        x = A @ x + B @ (u + 0.7)
    observer.observe(x[:1].copy(), u, NO_W)
    np.testing.assert_allclose(observer.z, x, atol=1e-8)
    np.testing.assert_allclose(observer.d, B[:, 0] * 0.7, atol=1e-8)


def load_seen(horizon, steps, noise=0.0, seed=0):
    """What a filter finds of a load on the input, of size 1, that begins after it has settled."""
    A, B = np.array([[0.95, 0.1], [-0.1, 0.9]]), np.array([[0.0], [0.1]])
    observer = km.LiftedKalman(["x0", "x1"]).start(linear(A, B), horizon)
    rng, x, u = np.random.default_rng(seed), np.zeros(2), np.zeros(1)
    found = []
    for k in range(100 + steps):
        observer.observe(x + noise * rng.normal(size=2), u, NO_W)
        found.append(observer.d[1] / B[1, 0])
        u = rng.normal(size=1)
        x = A @ x + B @ (u + float(k >= 100))
    return np.array(found)


def test_a_load_is_found_within_the_horizon_and_a_longer_one_takes_less_noise_for_it():
    for horizon in (8, 16, 32, 400):
        late = min(horizon, 38)  # 400 steps settle as those of a mean with gain 0.1
        assert abs(load_seen(horizon, late + 3)[-1] - 1) < 0.05
    quick, slow = (load_seen(horizon, 2000, noise=0.1)[-1500:].std() for horizon in (8, 32))
    assert slow < 0.7 * quick


@given(st.integers(1, 5), st.integers(0, 10**6))
def test_a_late_measurement_gives_the_estimate_of_then_predicted_through_the_inputs_since(delay, seed):
    rng = np.random.default_rng(seed)
    A, B = np.diag([0.5, 0.9, 1.02]), rng.uniform(0.5, 1.5, (3, 1))
    model = linear(A, B, [0.1, 0.2, 0.3])
    H = np.array([[1.0, 1.0, 1.0, 0.0]])
    rule, late_rule = km.LiftedKalman(H), km.LiftedKalman(H, delay=delay)
    prompt, late = rule.start(model, 20), late_rule.start(model, 20)
    x0 = rng.normal(size=3)
    prompt.reset(x0)
    late.reset(x0)
    Y, U = rng.normal(size=(20, 1)), rng.normal(size=(20, 1))
    estimates = []
    for k in range(20):
        u = U[k - 1]
        prompt.observe(Y[k], u, NO_W)
        estimates.append((prompt.z.copy(), prompt.d.copy()))
        late.observe(Y[max(k - delay, 0)], u, NO_W)
        z, d = estimates[k - delay] if k >= delay else (model.lift(x0), np.zeros(4))
        for i in range(max(k - delay, 0), k):
            z = model.A @ z + model.B @ U[i] + d
        np.testing.assert_allclose(late.z, z, atol=1e-9)
        np.testing.assert_allclose(late.d, d, atol=1e-9)


def test_a_measured_disturbance_is_no_news():
    A, B, E = np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.0], [1.0]]), np.array([[1.0], [0.5]])
    observer = km.LiftedKalman("x0").start(linear(A, B, [0.1, 0.0], E), 20)
    x, u, w = np.zeros(2), np.zeros(1), np.zeros(1)
    rng = np.random.default_rng(1)
    observer.reset(x)
    for _ in range(20):
        observer.observe(x[:1].copy(), u, w)
        u, w = rng.normal(size=1), rng.normal(size=1)
        x = A @ x + B @ u + E @ w + [0.1, 0.0]
    np.testing.assert_allclose(observer.d, 0, atol=1e-12)


def test_samples_are_bridged_for_a_while_and_reset_repeats_to_the_bit():
    model = linear(np.diag([0.5, 0.9]), np.ones((2, 1)))
    observer = km.LiftedKalman(("x0", "x1"), patience=3).start(model, 20)
    rng = np.random.default_rng(0)
    Y = rng.normal(size=(12, 2))
    Y[4:9] = np.nan
    runs = []
    for _ in range(2):
        observer.reset([0.1, 0.2])
        good, seen = [], []
        for k, y in enumerate(Y):
            good.append(observer.observe(y, np.array([float(k)]), NO_W))
            seen.append(np.r_[observer.z, observer.d])
        runs.append(np.array(seen))
        assert good == [True] * 7 + [False] * 2 + [True] * 3
    np.testing.assert_array_equal(*runs)
    observer.reset()
    assert [observer.observe(Y[4], np.zeros(1), NO_W) for _ in range(4)] == [True] * 3 + [False]  # from the first step


def test_infinities_are_missed_samples():
    model = linear(np.diag([0.5, 0.9]), np.ones((2, 1)))
    seen = []
    for bad in (np.nan, np.inf, -1e200):
        observer = km.LiftedKalman(("x0", "x1")).start(model, 20)
        observer.observe(np.array([1.0, bad]), np.zeros(1), NO_W)
        seen.append(observer.z.copy())
    np.testing.assert_array_equal(seen[0], seen[1])
    np.testing.assert_array_equal(seen[0], seen[2])


INTEGRATOR = linear(np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]]), [0.0, 0.0])


DATA, SHAPE = km.errors.DataError, km.errors.ShapeError
TWO_INPUTS, UNSTABLE = linear(np.diag([0.5, 0.6]), np.eye(2)), linear(np.diag([0.5, 1.2]), np.ones((2, 1)))


@pytest.mark.parametrize(
    ("rule", "model", "error", "words"),
    [
        (km.LiftedKalman("x0", "output"), INTEGRATOR, DATA, "with λ = 1, 'x0 \\[m\\]', an offset of output"),
        (km.LiftedKalman("x1"), INTEGRATOR, DATA, "'x0 \\[m\\]' can move without a trace"),
        (km.LiftedKalman(("x0", "x0")), INTEGRATOR, DATA, "depend on each other"),
        (km.LiftedKalman("1"), INTEGRATOR, DATA, "or on the Constant"),
        (km.LiftedKalman("theta"), INTEGRATOR, km.errors.ObservableError, "lacks 'theta'; add it"),
        (km.LiftedKalman(np.eye(2)), INTEGRATOR, SHAPE, r"outputs has shape \(2, 2\)"),
        (km.LiftedKalman("x0"), TWO_INPUTS, DATA, "1 outputs cannot tell"),
        (km.LiftedKalman("x0", "output"), UNSTABLE, DATA, "λ = 1.2, 'x1 \\[m\\]' can move"),
    ],
)
def test_what_cannot_be_estimated_is_refused_in_words(rule, model, error, words):
    with pytest.raises(error, match=words):
        rule.start(model, 20)


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"process": 0.0}, km.errors.DefinitenessError, "process is not positive definite"),
        ({"noise": -1.0}, km.errors.DefinitenessError, "noise is indefinite"),
        ({"drift": np.nan}, km.errors.DataError, "drift holds 1 NaN"),
        ({"delay": -1}, km.errors.DataError, "delay is -1"),
        ({"patience": -1}, km.errors.DataError, "patience is -1"),
        ({"outputs": [[1.0, 2.0], [1.0]]}, km.errors.DataError, "outputs is not an array"),
        ({"outputs": ()}, km.errors.ShapeError, "outputs has shape"),
        ({"outputs": ("x0", 2.0)}, km.errors.DataError, "outputs is not an array"),
    ],
)
def test_settings_are_refused_in_words(options, error, words):
    with pytest.raises(error, match=words):
        km.LiftedKalman(**{"outputs": "x0", "disturbance": "input"} | options)


def test_names_with_and_without_units_and_a_matrix_are_the_same():
    model = linear(np.array([[0.9, 0.1], [0.0, 0.8]]), np.ones((2, 1)), [0.1, 0.2])
    seen = []
    for outputs in ("x1", "x1 [m]", ("x1",), ["x1 [m]"], [[0.0, 1.0, 0.0]]):
        observer = km.LiftedKalman(outputs).start(model, 20)
        for k in range(5):
            observer.observe(np.array([float(k)]), np.ones(1), NO_W)
        seen.append(observer.z.copy())
    for other in seen[1:]:
        np.testing.assert_array_equal(seen[0], other)
    assert km.LiftedKalman("x1") == km.LiftedKalman(["x1"])


@settings(max_examples=10)
@given(st.integers(0, 10**6), st.lists(st.floats(-6, 6), min_size=3, max_size=3))
def test_units_do_not_decide_where_the_model_was_learned(seed, powers):
    """x′ = S x and u′ = s u in the data and in the loop give z′ = S z and d′ = S d."""
    rng = np.random.default_rng(seed)
    A, B = stable(rng, 2, 1)
    s, S = 10.0 ** powers[2], 10.0 ** np.array(powers[:2])
    X, U = [rng.normal(size=2)], rng.normal(size=(200, 1))
    for u in U:
        X.append(A @ X[-1] + B @ u + [0.3, -0.2] + 1e-2 * rng.normal(size=2))
    Y, V, found = rng.normal(size=(60, 1)), rng.normal(size=(60, 1)), []
    for size, by in ((np.ones(2), 1.0), (S, s)):
        data = km.Episodes([km.Episode(X=np.array(X) * size, U=U * by)], 0.1, ("x0 [m]", "x1 [m]"), ("u0 [N]",))
        model = km.edmd(data, km.State() + km.Constant())
        observer = km.LiftedKalman("x0").start(model, 20)
        for y, u in zip(Y * size[0], V * by, strict=True):
            observer.observe(y, u, NO_W)
        found.append((observer.z[:2] / size, observer.d[:2] / size))
    np.testing.assert_allclose(found[1], found[0], rtol=1e-4, atol=1e-6 * np.abs(found[0]).max())


def test_a_disturbance_that_cannot_be_seen_is_told_in_any_units():
    """An offset of y is the integrator's own position, whether in metres or in micrometres."""
    rng = np.random.default_rng(0)
    X, U = np.zeros((201, 2)), rng.normal(size=(200, 1))
    for k, u in enumerate(U):
        X[k + 1] = [[1.0, 0.1], [0.0, 0.8]] @ X[k] + [0.0, 0.1] * u
    for size in (1e-6, 1.0, 1e6):
        data = km.Episodes([km.Episode(X=X * [size, 1.0], U=U)], 0.1, ("x0 [m]", "x1 [m]"), ("u0 [N]",))
        with pytest.raises(km.errors.DataError, match=r"not detectable from x0: .*an offset of output 'x0'"):
            km.LiftedKalman("x0", "output").start(km.dmdc(data), 20)


def noises(observer):
    """Return the covariances of a step of [z; d] and of y that a stationary filter is made with."""
    F, M, P, R = observer._system.F, observer._system.M, observer._P, observer._R
    return P - F @ (P - P @ M.T @ np.linalg.solve(M @ P @ M.T + R, M @ P)) @ F.T, R


def left_of(observer, steps):
    """Return the share of an error of each d that is left after so many steps."""
    F, M, P = observer._system.F, observer._system.M, observer._P
    K = P @ M.T @ np.linalg.inv(M @ P @ M.T + observer._R)
    nd = len(M)
    return np.abs(np.linalg.matrix_power(F - F @ K @ M, steps).diagonal()[-nd:])


@pytest.mark.parametrize("horizon", [10, 40, 1000])
def test_the_default_drift_is_the_least_of_a_decade_with_which_d_settles_in_time(horizon):
    A, B = np.diag([0.9, 0.5]), np.array([[3.0], [4.0]])
    model = linear(A, B)
    observer = km.LiftedKalman("x0").start(model, horizon)
    Q, R = noises(observer)
    np.testing.assert_allclose(Q[:2, :2], 1e-4 * np.eye(2), atol=1e-10)
    np.testing.assert_allclose(R, [[1e-4]])
    steps = min(horizon / 4, 1 / -np.log(0.9))
    count = int(np.ceil(4 * steps))
    share = Q[2, 2] * 25  # a disturbance of the input has the unit in which it moves z by one
    assert np.log10(share) == pytest.approx(round(np.log10(share)), abs=1e-3)
    assert left_of(observer, count)[0] <= np.exp(-count / steps)
    if share > 1e-8:
        less = km.LiftedKalman("x0", drift=Q[2, 2] / 10).start(model, horizon)
        assert left_of(less, count)[0] > np.exp(-count / steps)


@pytest.mark.parametrize("outputs", ["x1", [[2.0, 1.0, 0.0]]])
@pytest.mark.parametrize("disturbance", ["input", "output"])
def test_the_default_noises_of_a_learned_model_are_shares_of_its_data_and_the_residuals_of_its_fit(
    outputs, disturbance
):
    rng = np.random.default_rng(0)
    A, B = np.array([[0.8, 0.1], [-0.2, 0.7]]), np.array([[1.0], [30.0]])
    X, U = [np.zeros(2)], rng.normal(size=(200, 1))
    for u in U:
        X.append(A @ X[-1] + B @ u + [0.3, -0.2])
    X = np.array(X) + [0.05, 0.4] * rng.normal(size=(201, 2))
    model = km.edmd(km.Episodes([km.Episode(X=X, U=U)], 0.1, ("x0", "x1"), ("u0",)), km.State() + km.Constant())
    observer = km.LiftedKalman(outputs, disturbance).start(model, 20)
    Q, R = noises(observer)
    sizes = np.sqrt((X[:-1] ** 2).mean(axis=0))
    np.testing.assert_allclose(Q[:2, :2], 1e-4 * np.diag(sizes**2), rtol=1e-5, atol=1e-9)
    if outputs == "x1":
        expected = model.report.residual[1] ** 2
        y = sizes[1]
    else:
        y = np.sqrt(((X[:-1] @ [2.0, 1.0]) ** 2).mean())
        expected = 1e-4 * y**2
    assert R[0, 0] == pytest.approx(expected, rel=1e-6)
    moved = np.linalg.norm(model.B[:2, 0] / sizes)
    share = Q[2, 2] / (y**2 if disturbance == "output" else moved**-2)
    assert np.log10(share) == pytest.approx(round(np.log10(share)), abs=1e-3)


@pytest.mark.parametrize("disturbance", ["input", "output"])
def test_units_of_a_given_model_do_not_decide_its_drift(disturbance):
    """x′ = S x with noises that follow: the same estimates in other units, though the drift is found."""
    rng = np.random.default_rng(2)
    A, B = stable(rng, 2, 1)
    S = np.diag([2.0**12, 2.0**-9])
    Y, U, found = rng.normal(size=(40, 2)), rng.normal(size=(40, 1)), []
    for T in (np.eye(2), S):
        rule = km.LiftedKalman(("x0", "x1"), disturbance, process=T @ T * 1e-4, noise=T @ T * 1e-3)
        observer = rule.start(linear(T @ A @ np.linalg.inv(T), T @ B), 20)
        for y, u in zip(Y, U, strict=True):
            observer.observe(T @ y, u, NO_W)
        found.append(np.linalg.solve(T, np.column_stack([observer.z, observer.d])))
    np.testing.assert_allclose(found[1], found[0], atol=0.01)  # rows and columns are alike up to factors of two


def test_a_model_that_is_not_lifted_and_a_filter_that_does_not_exist_are_refused(monkeypatch):
    plant = km.discretize(km.load_problem("pendulum").dynamics, 0.05)
    with pytest.raises(km.errors.DataError, match=r"filters the lifted state of a .*pass a LiftedDisturbance"):
        km.NonlinearMPC(plant, km.Cost(Q=[1, 1], R=1), horizon=5, estimator=km.LiftedKalman("theta"))

    def none(*arguments):
        raise np.linalg.LinAlgError("no solution")

    monkeypatch.setattr("scipy.linalg.solve_discrete_are", none)
    with pytest.raises(km.errors.DataError, match=r"no stationary filter was found \(no solution\)"):
        km.LiftedKalman("x0").start(INTEGRATOR, 20)
