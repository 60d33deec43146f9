"""move.known: whether state and input lie where the data were, and whether what came is what the model predicted."""

import copy

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.bare import shown
from tests.example_plants import Pendulum
from tests.gathered import of_loop

DT = 0.05
LIFTING = km.State() + km.Fourier(1, states=[0]) + km.Constant()
COST, LIMITS = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-8, u_max=8)


def collected(rng=0, episodes=40, **plant):
    step_map = km.discretize(Pendulum(**plant), DT)
    return km.collect(
        step_map, km.Uniform([-1.5, -3], [1.5, 3]), km.Noise(-6, 6, hold=3), episodes=episodes, steps=40, rng=rng
    )


def run_pendulum(mpc, x0, steps, **options):
    """Return a run of the pendulum towards its rest."""
    plant = km.discretize(Pendulum(), DT)
    return km.simulate(plant, mpc, x0=x0, reference=[0, 0], steps=steps, **of_loop(**options))


@pytest.fixture(scope="module")
def data():
    return collected()


@pytest.fixture(scope="module")
def model(data):
    return km.edmd(data, LIFTING)


def test_the_monitor_is_the_leverage_and_the_conformal_quantile_of_the_data(model, data):
    """‖L v‖² is vᵀ(VᵀV)⁻¹v over its 0.99 quantile; of the squared errors ‖W e‖² 99 % are at most 1."""
    monitor = km.supervise.Monitor.of(model, data)
    V = np.vstack([np.hstack([model.lifting(e.X[:-1]), e.U]) for e in data])
    leverage = np.einsum("ki,ij,kj->k", V, np.linalg.inv(V.T @ V), V)
    own = ((V @ monitor.leverage.T) ** 2).sum(axis=1)
    assert np.allclose(own, leverage / np.sort(leverage)[int(np.ceil(0.99 * (len(V) + 1))) - 1], rtol=1e-6)
    E = np.vstack([e.X[1:] - (model.lifting(e.X[:-1]) @ model.A.T + e.U @ model.B.T) @ model.C.T for e in data])
    assert np.mean(((E @ monitor.band.T) ** 2).sum(axis=1) <= 1) == pytest.approx(0.99, abs=0.001)


def driven(controller, episodes):
    """Return what the controller knows of each step of these episodes, its own inputs left aside."""
    known = []
    for e in episodes:
        controller.reset(e.X[0])
        for k in range(len(e)):
            controller(e.X[k], [0, 0], None if k == 0 else e.U[k - 1])
            known.append(controller.watch.fits)
    return np.array(known)


def test_steps_like_the_data_are_known_and_a_changed_plant_is_not(model, data):
    mpc = km.KoopmanMPC(model, COST, LIMITS, 15, monitor=data)
    assert driven(mpc, collected(rng=1, episodes=10)).mean() > 0.96
    assert driven(mpc, collected(rng=1, episodes=10, damping=3.0)).mean() < 0.7


def test_the_verdict_of_each_step_is_that_of_its_two_norms(model, data):
    mpc, rng, inside, fits = km.KoopmanMPC(model, COST, LIMITS, 15, monitor=data), np.random.default_rng(0), [], []
    monitor, expected, x = mpc.watch.monitor, None, np.array([0.3, 0.0])
    for k in range(80):
        u, z = mpc(x, [0, 0]).u, model.lifting(x)
        inside.append(np.linalg.norm(monitor.leverage @ np.concatenate([z, u])) <= 1)
        fits.append(expected is None or np.linalg.norm(monitor.band @ (expected - x)) <= 1)
        assert (mpc.watch.inside, mpc.watch.fits) == (inside[-1], fits[-1])
        expected = model.C @ (model.A @ z + model.B @ u)
        x = expected + rng.normal(0.0, 0.02 if k % 9 == 4 else 1e-4, 2) + 4.0 * (k % 13 == 12)
    assert 5 < np.sum(inside) < 80 > np.sum(fits) > 5


def test_a_state_or_an_input_beyond_the_data_is_unknown(model, data):
    mpc = km.KoopmanMPC(model, COST, LIMITS, 15, monitor=data)
    assert mpc([0.1, 0.2], [0, 0]).known
    assert mpc.watch.inside
    assert mpc([0.1, 0.2], [0, 0], None).known is not None
    mpc.reset()
    assert mpc([1.0, 40.0], [0, 0]).known is False
    assert not mpc.watch.inside
    far = km.KoopmanMPC(model, km.Cost(Q=[1e5, 1], R=1e-6), None, 15, monitor=data)  # an input of hundreds
    move = far([0.5, 0.0], [-0.5, 0])
    assert abs(move.u[0]) > 50
    assert move.known is False


def test_a_push_is_unknown_when_it_comes_and_for_that_step_alone(model, data):
    mpc = km.KoopmanMPC(model, COST, LIMITS, 15, monitor=data)
    push = np.zeros((40, 2))
    push[20, 1] = 1.0
    run = run_pendulum(mpc, [0.5, 0], 40, disturbance=push)
    assert np.flatnonzero(run.known == 0).tolist() == [21]
    assert km.metrics(run).unknown == 1
    assert "unknown steps             1" in str(km.metrics(run))


def test_without_a_monitor_nobody_says(model):
    mpc = km.KoopmanMPC(model, COST, LIMITS, 15)
    assert mpc([0.1, 0], [0, 0]).known is None
    run = run_pendulum(mpc, [0.5, 0], 5)
    assert (run.known == -1).all()
    assert km.metrics(run).unknown is None
    assert "unknown" not in str(km.metrics(run))


def test_a_measurement_that_is_nan_is_unknown_and_the_next_step_but_one_is_known_again(model, data):
    mpc = km.KoopmanMPC(model, COST, LIMITS, 15, monitor=data)
    run = run_pendulum(mpc, [0.5, 0], 8, faults=[km.faults.NaNSensor(begin=4, end=5)])
    assert run.known.tolist() == [1, 1, 1, 1, 0, 0, 1, 1]


def test_a_sensor_that_stands_still_is_unknown(model, data):
    mpc = km.KoopmanMPC(model, COST, LIMITS, 15, monitor=data)
    assert [mpc([0.5, 0.5], [0, 0]).known for _ in range(4)] == [True, False, False, False]


def test_the_estimated_disturbance_and_the_input_that_was_applied_count_in_the_prediction(model, data):
    """A constant push is unknown at first, and known once it is estimated."""
    mpc = km.KoopmanMPC(model, COST, LIMITS, 15, estimator=km.LiftedDisturbance(), monitor=data)
    run = run_pendulum(mpc, [0.1, 0], 150, disturbance=[0.0, 0.1])
    assert (run.known[1:3] == 0).all()
    assert (run.known[100:] == 1).all()
    plain = km.KoopmanMPC(model, COST, LIMITS, 15, monitor=data)
    broken = run_pendulum(plain, [1.0, 0], 60, limits=LIMITS, faults=[km.faults.ActuatorLoss(0.5)])
    assert broken.known.mean() > 0.95  # the loop tells the controller what was applied


def test_measured_disturbances_count_in_the_prediction():
    rng, made = np.random.default_rng(0), []
    A, B, E = np.array([[1, 0.1], [-0.1, 0.9]]), np.array([[0.0], [0.1]]), np.array([[0.0], [0.5]])
    for _ in range(20):
        X, U, W = [rng.normal(size=2)], rng.uniform(-1, 1, (30, 1)), rng.uniform(-1, 1, (30, 1))
        for u, w in zip(U, W, strict=True):
            X.append(A @ X[-1] + B @ u + E @ w + 1e-3 * rng.normal(size=2))
        made.append(km.Episode(X=X, U=U, W=W))
    data = km.Episodes(made, 0.1)
    mpc = km.KoopmanMPC(km.edmd(data, km.State()), km.Cost(Q=[1, 1], R=1), None, 10, monitor=data)
    x, known = np.zeros(2), []
    for k in range(100):
        w = np.sin(0.3 * k)
        move = mpc(x, [0, 0], None, [w])
        known.append(mpc.watch.fits)
        x = A @ x + B @ move.u + E @ [w]
    assert np.mean(known) > 0.98


def test_a_bilinear_mpc_knows_likewise(data):
    bilinear = km.bilinear_edmd(data, LIFTING, difference=True)
    mpc = km.BilinearMPC(bilinear, COST, LIMITS, 10, monitor=data)
    push = np.zeros((30, 2))
    push[20, 1] = 1.0
    run = run_pendulum(mpc, [0.3, 0], 30, disturbance=push)
    assert run.known[21] == 0
    assert np.delete(run.known, 21).mean() > 0.9
    again = copy.copy(mpc)
    assert again([0.1, 0.0], [0, 0]).known == copy.deepcopy(mpc)([0.1, 0.0], [0, 0]).known


def test_a_controller_that_is_saved_or_copied_knows_the_same(model, data, tmp_path):
    mpc = km.KoopmanMPC(model, COST, LIMITS, 15, monitor=data)
    mpc.save(tmp_path / "mpc.npz")
    for again in (km.load_controller(tmp_path / "mpc.npz"), copy.copy(mpc)):
        assert again.watch.monitor == mpc.watch.monitor
        assert again([1.0, 40.0], [0, 0]).known is False
    assert mpc([0.1, 0], [0, 0]).known


def test_a_log_keeps_what_was_known(model, data, tmp_path):
    mpc = km.KoopmanMPC(model, COST, LIMITS, 15, monitor=data)
    run = run_pendulum(mpc, [1.0, 9.0], 30)
    assert 0 < (run.known == 0).sum() < 30
    km.record(run, tmp_path / "run.rrd")
    assert km.load_run(tmp_path / "run.rrd") == run


def test_what_cannot_be_monitored_is_refused_in_words(model, data):
    with pytest.raises(km.errors.DataError, match="this controller's model is not learned"):
        km.BilinearMPC(km.discretize(Pendulum(), DT), COST, LIMITS, 10, monitor=data)
    other = km.supervise.Monitor.of(km.edmd(data, km.State()), data)
    with pytest.raises(km.errors.DataError, match="the monitor is of another lifting"):
        km.KoopmanMPC(model, COST, LIMITS, 15, monitor=other)
    with pytest.raises(km.errors.DataError, match=r"at least 99 are needed for a level of 0\.99"):
        km.supervise.Monitor.of(model, data[:1])
    with pytest.raises(km.errors.DataError, match="level is 1"):
        km.supervise.Monitor.of(model, data, level=1.0)
    said = shown(
        "model = km.edmd(km.Episodes([km.Episode(X=np.random.rand(9, 1), U=np.random.rand(8, 1))], 0.1), km.State())\n"
        "show(lambda: km.KoopmanMPC(model, km.Cost(1, 1), None, 5, monitor=3))"
    )
    assert "monitor is an int" in said[0]


def test_a_level_needs_as_many_rows_as_its_quantile_has(model):
    """The 0.9 quantile of M errors is the ⌈0.9 (M + 1)⌉-th: nine are enough, eight are not."""
    whole = collected(1, episodes=1)[0]

    def head(rows):
        return km.Episodes([km.Episode(X=whole.X[: rows + 1], U=whole.U[:rows])], DT, model.states, model.inputs)

    assert km.supervise.Monitor.of(model, head(9), level=0.9).level == 0.9
    with pytest.raises(km.errors.DataError, match=r"8 rows, at least 9 are needed for a level of 0\.9"):
        km.supervise.Monitor.of(model, head(8), level=0.9)


def watched(pairs, level):
    """The monitor of x⁺ = 0 on pairs (x, x⁺), one an episode: x⁺ is all error."""
    n = len(pairs[0][0])
    still = km.LinearPredictor(np.zeros((n, n)), np.zeros((n, 0)), np.eye(n), km.State(), DT, tuple("abc")[:n], ())
    rows = [km.Episode(X=np.array(pair), U=np.zeros((1, 0))) for pair in pairs]
    return km.supervise.Monitor.of(still, km.Episodes(rows, DT, still.states, ()), level=level)


def test_where_the_data_have_no_width_they_count_as_a_billionth_of_their_widest_direction():
    """Rows (a, a) in units of their size: along (1, 1) the second moment is 2, along (1, −1) it is 2e-9 in place of 0."""
    a = np.random.default_rng(0).standard_normal(50)
    L = watched([((x, 3 * x), (0.0, 0.0)) for x in a], 40 / 51).leverage
    size = np.sqrt(np.mean(a**2))
    inside = np.sort((a / size) ** 2)[39]  # (a, a) in units of the size, by the width along it
    across = np.array([1.0, -3.0]) * size
    assert (L @ across) @ (L @ across) == pytest.approx(2 / 2e-9 / inside, rel=1e-4)


def test_a_billionth_of_each_state_is_inside_whatever_the_errors_are():
    """‖W e‖² is at most 1 where e is 1e-9 of one state's size, and 1 for the worst of these or the rank-th of the errors."""
    rng = np.random.default_rng(0)
    for spread in (0.02e-9, 0.6e-9, 20e-9):
        errors = spread * rng.standard_normal((60, 3)) @ rng.standard_normal((3, 3))
        X = rng.standard_normal((60, 3)) * [1, 5, 0.2]
        W = watched(list(zip(X, errors, strict=True)), 50 / 61).band
        shares = 1e-9 * np.diag(np.sqrt(np.mean(np.vstack([X, errors]) ** 2, axis=0)))
        worst = max(float(np.sum((W @ v) ** 2)) for v in shares)
        ranked = np.sort(np.sum((errors @ W.T) ** 2, axis=1))[49]
        assert max(worst, ranked) == pytest.approx(1.0)


def test_a_guard_of_models_of_outputs_starts_a_run_whose_state_it_does_not_know():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    step = ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * (u[0] - x[1] - x[0]))
    F, h = ca.Function("F", [x, u], [step]), ca.Function("h", [x], [x[0]])
    plant = km.StepMap(F, 0.1, h, states=("p", "v"), inputs=("u",), outputs=("p",))
    data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-2, 2), episodes=20, steps=30)
    cost, limits, past = km.Cost(1.0, 0.1), km.Limits(-2, 2), km.Delay(1)
    bilinear = km.bilinear_edmd(data, km.State() + km.Constant(), embedding=past, ridge=1e-8)
    linear = km.edmd(data, km.State() + km.Constant(), embedding=past, ridge=1e-8)
    main = km.BilinearMPC(bilinear, cost, limits, 10, monitor=data)
    guard = km.supervise.Guarded(main, km.KoopmanMPC(linear, cost, limits, 10))
    run = km.simulate(plant, guard, x0=[0.5, 0.0], reference=[0.2], steps=60)
    assert abs(run.X[-1, 0] - 0.2) < 0.1
