"""Station switches without a bump; PID by its laws; a plain function wherever a controller is."""

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.bare import shown


def model_of(A, B):
    n, nu = np.shape(B)
    system = scipy.signal.StateSpace(A, B, np.eye(n), np.zeros((n, nu)), dt=0.1)
    return km.LinearPredictor.from_state_space(system)


TANK = model_of([[0.9]], [[0.2]])  # gain 2, pole 0.9
BOX = km.Limits(u_min=-1.0, u_max=1.0)
COST = km.Cost(Q=1.0, R=0.1)


def loop(controller, steps, r=0.5, x0=0.0, push=0.0, applied=lambda u: u, act=None):
    """Drive the tank, and return states, inputs and moves."""
    controller.reset()
    x, got, X, U, moves = x0, None, [x0], [], []
    for k in range(steps):
        if act is not None:
            act(k)
        move = controller([x], [r], got)
        got = applied(move.u)
        x = 0.9 * x + 0.2 * float(got[0]) + push
        X.append(x)
        U.append(float(move.u[0]))
        moves.append(move)
    return np.array(X), np.array(U), moves


def test_a_pid_without_limits_is_its_transfer_function():
    kp, ki, kd, filter_time, dt = 2.0, 0.7, 0.3, 0.25, 0.1
    pid = km.control.PID(kp, ki, kd, dt=dt, options=km.control.PIDOptions(filter_time=filter_time, b=1.0, c=1.0))
    error = np.random.default_rng(0).standard_normal(60)
    u = [float(pid([-e], [0.0]).u[0]) for e in error]
    integral = scipy.signal.lfilter([0.0, ki * dt], [1.0, -1.0], error)
    change = np.diff(error, prepend=error[0])
    derivative = scipy.signal.lfilter([kd / (filter_time + dt)], [1.0, -filter_time / (filter_time + dt)], change)
    np.testing.assert_allclose(u, kp * error + integral + derivative, rtol=1e-12, atol=1e-12)


def test_the_integral_of_a_pid_leaves_no_error_and_does_not_wind_up():
    pid = km.control.PID(1.0, 1.0, dt=0.1, limits=BOX)
    X, U, _ = loop(pid, 400, r=1.5, push=0.02)
    assert abs(X[-1] - 1.5) < 1e-6
    out_of_reach = np.r_[np.full(200, 5.0), np.full(60, 0.0)]
    pid.reset()
    x, U = 0.0, []
    for r in out_of_reach:
        u = pid([x], [r]).u
        x = 0.9 * x + 0.2 * float(u[0])
        U.append(float(u[0]))
    assert np.abs(U).max() <= 1.0
    assert U[150] == 1.0
    assert U[205] < 0.5  # 200 saturated steps with an error of 3 would have wound I up to 60
    assert abs(x) < 0.05


def test_simc_recovers_the_first_order_plant_and_settles_it():
    pid = km.control.PID.tune(TANK, COST, BOX)
    tau = -0.1 / np.log(0.9)
    theta = 0.05  # half a step for the hold; the plant has no delay of its own
    assert pid.kp[0] == pytest.approx(tau / (2 * 2.0 * theta), rel=0.1)
    assert pid.kp[0] / pid.ki[0] == pytest.approx(min(tau, 8 * theta), rel=0.1)
    X, _, _ = loop(pid, 100)
    assert abs(X[-1] - 0.5) < 1e-6
    assert X.max() < 0.5 * 1.3


def test_simc_pairs_by_relative_gains():
    A, B = np.diag([0.8, 0.9]), np.array([[0.02, 0.4], [0.3, 0.01]])
    pid = km.control.PID.tune(model_of(A, B), km.Cost(Q=[1, 1], R=1))
    assert pid.outputs.tolist() == pid.references.tolist() == [1, 0]


@pytest.mark.parametrize(
    ("A", "B", "Q", "said"),
    [
        ([[1.1]], [[1.0]], [1.0], "not stable where it is linearised"),
        ([[0.9, 0.1], [0.0, 0.9]], [[0.0], [1.0]], [1.0, 1.0], "weighs 2 outputs, the plant has 1 inputs"),
        ([[0.95, 0.3], [-0.3, 0.95]], [[0.0], [0.1]], [1.0, 0.0], "overshoots by"),
        ([[0.9]], [[0.0]], [1.0], "does not move the output"),
    ],
)
def test_simc_says_why_it_has_no_rule(A, B, Q, said):
    with pytest.raises(km.errors.DataError, match=said):
        km.control.PID.tune(model_of(A, B), km.Cost(Q=Q, R=1))


def test_an_integrator_is_told_from_a_constant_by_its_row_and_not_by_its_column():
    """Both have a pole of 1: a Constant keeps its value, an integrator keeps it only while nothing else acts."""
    filled = model_of([[1.0, 0.1], [0.0, 0.9]], [[0.0], [1.0]])  # the first state integrates the second one
    with pytest.raises(km.errors.DataError, match="not stable where it is linearised, largest pole 1;"):
        km.control.PID.tune(filled, km.Cost(Q=[1, 0], R=1))
    A, B, C = np.array([[0.9, 0.05], [0.0, 1.0]]), np.array([[0.2], [0.0]]), np.array([[1.0, 0.0]])
    pushed = km.LinearPredictor(A, B, C, km.State() + km.Constant(), 0.1, ("x0",), ("u0",))
    one, other = km.control.PID.tune(pushed, COST, BOX), km.control.PID.tune(TANK, COST, BOX)
    np.testing.assert_allclose([one.kp, one.ki], [other.kp, other.ki], rtol=1e-9)


def test_gains_of_two_signs_and_short_signals_are_refused():
    with pytest.raises(km.errors.DataError, match="gains of one loop have one sign"):
        km.control.PID(1.0, -1.0, dt=0.1)
    with pytest.raises(km.errors.ShapeError, match="the PID reads its entry 1"):
        km.control.PID(1.0, dt=0.1, outputs=[1])([0.0], [0.0])
    with pytest.raises(km.errors.ShapeError, match="outputs has 1 entries, the PID 2 loops"):
        km.control.PID([1.0, 1.0], dt=0.1, outputs=[1])


def test_a_bad_measurement_holds_the_input_of_a_pid():
    pid = km.control.PID(1.0, 1.0, dt=0.1, limits=BOX)
    u = pid([0.0], [0.5]).u
    move = pid([np.nan], [0.5])
    assert move.status is km.Status.BAD_MEASUREMENT
    assert (move.u == u).all()


@given(st.floats(-0.9, 0.9), st.floats(0.1, 5), st.floats(0.1, 5), st.floats(0, 1))
@settings(max_examples=30, deadline=None)
def test_at_rest_a_switch_to_a_pid_moves_nothing(hand, kp, ki, b):
    pid = km.control.PID(kp, ki, dt=0.1, limits=BOX, options=km.control.PIDOptions(b=b))
    station = km.supervise.Station(pid, limits=BOX, mode="manual", hand=[hand])
    rest = 2.0 * hand
    station.reset()
    for k in range(20):
        if k == 10:
            station.switch("automatic")
        assert abs(station([rest], [rest]).u[0] - hand) < 1e-9 * 2
        assert station.actor == ("automatic" if k >= 10 else "manual")


def test_a_switch_to_offset_free_mpc_whose_estimator_settled_moves_nothing():
    mpc = km.KoopmanMPC(TANK, COST, BOX, 10, estimator=km.LiftedDisturbance())
    station = km.supervise.Station(mpc, limits=BOX, mode="manual", hand=[0.3], bump=[np.inf])
    rest = (0.2 * 0.3 + 0.05) / 0.1  # under a push that the model does not know

    def act(k):
        if k == 300:
            station.switch("automatic")

    _, U, moves = loop(station, 320, r=rest, x0=rest, push=0.05, act=act)
    assert np.abs(U - 0.3).max() < 1e-9 * 2
    assert [move.actor for move in moves] == ["manual"] * 300 + ["automatic"] * 20


def test_a_law_that_cannot_take_over_is_approached_by_the_stated_bump():
    station = km.supervise.Station(km.LQR(TANK, COST, BOX), limits=BOX, mode="manual", hand=[-0.6], bump=[0.1])

    def act(k):
        if k == 5:
            station.switch("automatic")

    X, U, _ = loop(station, 40, act=act)
    law = km.LQR(TANK, COST, BOX)
    own = np.array([float(law([x], [0.5]).u[0]) for x in X[:-1]])
    reached = 5 + int(np.argmax(np.abs(own[5:] - U[4:-1]) <= 0.1))
    assert reached > 7
    np.testing.assert_allclose(np.diff(U[4:reached]), 0.1, rtol=1e-12)
    np.testing.assert_array_equal(U[reached:], own[reached:])


def test_the_standby_acts_while_the_primary_fails_and_the_run_keeps_who_acted(tmp_path):
    plant = km.discretize(Leak(), 0.1)
    primary = km.LinearMPC(plant, [0.0], [0.0], COST, BOX, 10)
    station = km.supervise.Station(primary, km.control.PID(1.0, 1.0, dt=0.1), limits=BOX, patience=2)
    calls = iter(range(100))

    class Failing:  # readings 10 and 11 are lost
        dt, nu, horizon, reset = 0.1, 1, station.horizon, station.reset

        def __call__(self, y, reference, applied=None, w=None):
            return station([np.nan] if next(calls) in (10, 11) else y, reference, applied, w)

    run = km.simulate(plant, Failing(), x0=[0.2], reference=[0.5], steps=30, cost=COST, limits=BOX)
    assert run.actor == ("automatic",) * 11 + ("standby",) * 2 + ("automatic",) * 17
    assert run.fallback[11] is km.control.Fallback.OTHER_CONTROLLER
    km.record(run, tmp_path / "run.rrd")
    assert km.load_run(tmp_path / "run.rrd").actor == run.actor


def test_the_plan_of_a_station_is_that_of_its_controller_while_that_acts():
    mpc = km.KoopmanMPC(TANK, COST, BOX, 5)
    station = km.supervise.Station(mpc, standby=km.control.PID.tune(TANK, COST, BOX))
    station([0.2], [0.5])
    plan = station.plan()
    assert plan is not None
    assert (plan.X == mpc.plan().X).all()
    for mode in ("manual", "standby"):
        station.mode = mode
        station([0.2], [0.5])
        assert station.plan() is None


def test_a_second_manual_mode_begins_with_the_input_of_its_moment_and_not_with_the_old_hand():
    station = km.supervise.Station(km.LQR(TANK, COST, BOX), limits=BOX, mode="manual", hand=[0.7])
    _, U, _ = loop(station, 20, act=lambda k: station.switch("automatic" if k in range(3, 15) else "manual"))
    assert (U[:3] == 0.7).all()
    assert abs(U[14] - 0.7) > 0.1
    assert (U[15:] == U[14]).all()


def test_set_points_move_by_the_ramp_and_start_at_the_measurement_after_a_hand():
    seen = []

    class Spy(km.control.PID):
        def __call__(self, y, reference, applied=None, w=None):
            seen.append(float(np.atleast_2d(reference)[0, 0]))
            return super().__call__(y, reference, applied, w)

    station = km.supervise.Station(Spy(1.0, 1.0, dt=0.1), ramp=[2.0], mode="manual", hand=[0.0])
    for k in range(8):
        if k == 3:
            station.switch("automatic")
        station([0.1], [1.0])
    automatic = seen[-5:]
    assert automatic[0] <= 0.1 + 2 * 0.2 + 1e-12
    np.testing.assert_allclose(np.diff(automatic), np.minimum(0.2, 1.0 - np.array(automatic[:-1])), atol=1e-12)


@given(st.lists(st.sampled_from(["manual", "automatic", "standby"]), min_size=20, max_size=20), st.integers(0, 99))
@settings(max_examples=25, deadline=None)
def test_whoever_acts_keeps_the_limits(modes, seed):
    rng = np.random.default_rng(seed)
    limits = km.Limits(-1.0, 1.0, du_max=0.3)
    station = km.supervise.Station(
        km.KoopmanMPC(TANK, COST, BOX, 5), lambda y, r: 9.0 * (r - y), limits=limits, mode="manual", hand=[5.0]
    )
    x, last = 0.0, 0.0
    for mode in modes:
        station.switch(mode)
        if rng.random() < 0.3:
            station.set_hand(rng.uniform(-3, 3, 1))
        u = float(station([np.nan if rng.random() < 0.1 else x], rng.uniform(-2, 2, 1)).u[0])
        assert abs(u) <= 1.0
        assert abs(u - last) <= 0.3 + 1e-12
        last, x = u, 0.9 * x + 0.2 * u


def test_what_is_no_station_is_refused():
    pid = km.control.PID(1.0, dt=0.1)
    for options, said in (
        ({"mode": "auto"}, "mode is 'auto'"),
        ({"bump": [0.0]}, "bump is"),
        ({"ramp": [-1.0]}, "ramp is"),
        ({"standby": km.control.PID(1.0, dt=0.2)}, "dt = 0.1, the standby 0.2"),
    ):
        with pytest.raises(km.errors.DataError, match=said):
            km.supervise.Station(pid, **options)


class Leak(km.Dynamics):
    states = ("level [m]",)
    inputs = ("valve [1]",)

    def rhs(self, x, u):
        return 2 * u - x


def test_a_plain_function_is_a_controller():
    plant = km.discretize(Leak(), 0.1)
    run = km.simulate(plant, lambda y, r: 2.0 * (r - y), x0=[0.0], reference=[0.5], steps=40)
    np.testing.assert_allclose(run.U[:, 0], 2.0 * (0.5 - run.X[:-1, 0]), rtol=1e-12)
    paced = km.realtime(lambda y, r: 0.5, km.plants.SimulatedPlant(plant), dt=0.1, reference=[0.5], steps=2, x0=[0.0])
    assert paced.steps == 2
    with pytest.raises(km.errors.ShapeError, match="returned u of shape"):
        km.simulate(plant, lambda y, r: [1.0, 2.0], x0=[0.0], reference=[0.5], steps=2)
    with pytest.raises(km.errors.DataError, match="for a finite y and r"):
        km.simulate(plant, lambda y, r: np.nan, x0=[0.0], reference=[0.5], steps=2)
    with pytest.raises(km.errors.DataError, match="which returns the input u"):
        km.simulate(plant, lambda y: 0.0, x0=[0.0], reference=[0.5], steps=2)


def test_a_plain_function_and_a_pid_run_in_a_sweep(tmp_path):
    km.bench.register_law("half", lambda y, r: 4.0)
    try:
        tanks = km.load_problem("two_tanks:fill")
        rows = km.sweep([tanks], ["half", "pid"], folder=tmp_path, options=km.bench.SweepOptions(log_starts=0))
    finally:
        del km.bench.CONTROLLERS["half"]
    assert [(row.controller, row.failure) for row in rows] == [("half", None), ("pid", None)]
    assert abs(rows[1].metrics.final_error[0]) < 0.2


def test_hand_values_move_over_levels_no_faster_than_the_rate():
    limits = km.Limits(levels=[[0, 1, 2, 3]], du_max=1.0)
    mpc = km.KoopmanMPC(TANK, COST, limits, 5)
    station = km.supervise.Station(mpc, limits=limits, mode="manual", hand=[2.7])
    station.reset()
    U = [float(station([0.0], [0.0]).u[0]) for _ in range(4)]
    np.testing.assert_array_equal(U, [1.0, 2.0, 3.0, 3.0])


def test_only_controllers_whose_model_has_w_are_told_it():
    """Whichever of the two has it: a run acts as that controller does alone while it is well."""
    steps, W = 6, np.sin(np.arange(6.0))[:, None]
    told = km.LinearPredictor(
        TANK.A, TANK.B, TANK.C, TANK.lifting, 0.1, TANK.states, TANK.inputs, E=[[0.3]], disturbances=["w"]
    )
    plant = told.step_map()
    knows, blind = (km.KoopmanMPC(model, COST, BOX, 5) for model in (told, TANK))
    task = {"x0": [0.0], "reference": [0.5], "steps": steps, "measured": W}
    for first, second, mode in ((knows, blind, "automatic"), (blind, knows, "standby")):
        station = km.supervise.Station(first, second, limits=BOX, mode=mode)
        assert station.nw == 1
        np.testing.assert_array_equal(km.simulate(plant, station, **task).U, km.simulate(plant, knows, **task).U)
    assert km.supervise.Station(blind).nw == 0
    assert km.supervise.Station(km.control.PID(kp=1.0, dt=0.1)).nw is None
    with pytest.raises(km.errors.DataError, match="w was passed"):
        km.supervise.Station(blind, limits=BOX)([0.0], [0.5], w=[1.0])


@pytest.mark.parametrize("mode", ["manual", "automatic", "standby"])
def test_whoever_acts_keeps_the_row_of_the_step(mode):
    rows = np.array([[0.6], [0.2], [-0.1], [0.5], [0.9]])
    limits = km.Limits(u_min=-1.0, u_max=rows, du_max=0.3)
    standby = km.control.PID(5.0, 1.0, dt=0.1, limits=BOX)
    station = km.supervise.Station(km.LQR(TANK, COST, BOX), standby, limits=limits, mode=mode, hand=[1.0], bump=1.0)
    _, U, _ = loop(station, 7, r=3.0)
    expected = [0.3, 0.2, -0.1, 0.2, 0.5, 0.8, 0.9]  # the box wins over the rate, which bounds the way back
    np.testing.assert_allclose(U, expected, atol=1e-12)
    with pytest.raises(km.errors.DataError, match="cross for index 0 at step 1"):
        km.supervise.Station(km.LQR(TANK, COST, BOX), limits=km.Limits(u_min=[[-1.0], [0.5]], u_max=[[1.0], [0.2]]))


def test_a_station_with_levels_keeps_to_those_inside_its_row():
    limits = km.Limits(levels={"u0": [0, 1]}, u_max=[[1.0], [0.5], [1.0]]).resolve((), ("u0",))
    station = km.supervise.Station(km.control.PID(5.0, 1.0, dt=0.1), limits=limits, mode="manual", hand=[1.0])
    assert [float(station([0.0], [0.0]).u[0]) for _ in range(3)] == [1.0, 0.0, 1.0]


def test_an_input_that_acts_later_keeps_the_row_of_the_step_in_which_it_acts():
    u_max = np.full((10, 1), 2.0)
    u_max[5:8] = 0.5
    limits = km.Limits(u_min=-2.0, u_max=u_max)
    model = km.LinearPredictor([[0.9]], [[1.0]], np.eye(1), km.State(), 0.1, ("x",), ("u",))
    mpc = km.KoopmanMPC(model, km.Cost(Q=1, R=0.1), limits, 5, latency=2)
    station = km.supervise.Station(mpc, limits=limits, mode="manual", hand=[3.0])
    U = [station([0.0], [0.0]).u[0] for _ in range(8)]
    np.testing.assert_array_equal(U, u_max[2:, 0])


A3, B3 = np.array([[0.9, 0.1, 0.0], [0.0, 0.8, 0.1], [0.0, 0.0, 0.5]]), np.array([[0.0], [0.2], [0.5]])
TWO_OF_THREE = km.black_box(
    lambda x, u: A3 @ x + B3 @ u,
    dt=0.1,
    states=["a", "b", "c"],
    inputs=["u"],
    measure=lambda x: x[:2],
    outputs=["y", "v"],
)


def mpc_of(size, **options):
    model = model_of(A3[:size, :size], B3[:size])
    return km.KoopmanMPC(model, km.Cost(Q=np.ones(size), R=0.1), BOX, 10, **options)


def test_a_station_begins_on_a_plant_of_more_states_than_its_models():
    pid, how = km.control.PID(kp=1.0, ki=0.1, dt=0.1), {"x0": [1.0, 1.0, 1.0], "reference": [0.0, 0.0], "steps": 4}
    alone = km.simulate(TWO_OF_THREE, mpc_of(2), **how).U
    for parts, mode in (((pid, mpc_of(2)), "standby"), ((mpc_of(2), pid), "automatic"), ((mpc_of(2),), "automatic")):
        station = km.supervise.Station(*parts, mode=mode)
        np.testing.assert_allclose(km.simulate(TWO_OF_THREE, station, **how).U, alone, atol=1e-9)


@pytest.mark.parametrize("make", [km.supervise.Station, km.supervise.Guarded])
def test_each_of_two_controllers_begins_with_what_its_model_can_know(make):
    rng, begun = np.random.default_rng(0), []
    data = km.Episodes(
        [km.Episode(X=rng.normal(size=(200, 2)), U=rng.normal(size=(199, 1)))], 0.1, ("x0", "x1"), ("u0",)
    )
    watched = mpc_of(2, monitor=data)
    both = make(watched, mpc_of(3))
    for part in (both.controller, both.standby):
        part.reset = lambda x0, u_prev=None: begun.append(None if x0 is None else len(x0))
    both.reset([1.0, 1.0, 1.0])
    both.reset([1.0, 1.0])
    both.reset()
    assert begun == [None, 3, 2, None, None, None]
    with pytest.raises(km.errors.ShapeError, match=r"x0 has shape \(4,\), expected \(2,\) or \(3,\)"):
        both.reset([1.0] * 4)
    with pytest.raises(km.errors.ShapeError, match=r"x0 has shape \(\), expected \(2,\) or \(3,\)"):
        both.reset(1.0)


class OwnLaw:
    """A law as users write it: an object with a step of its own that is called with y and r."""

    dt = 0.1

    def __init__(self):
        self.sum = 0.0

    def __call__(self, y, r):
        self.sum += 0.1 * (r[0] - y[0])
        return [1.5 * (r[0] - y[0]) + self.sum]


def test_an_object_with_a_step_of_its_own_is_a_law_as_a_function_is():
    plant = km.black_box(lambda x, u: 0.9 * x + 0.2 * u, dt=0.1, states=["x"], inputs=["u"])
    own, law = OwnLaw(), OwnLaw()
    runs = [km.simulate(plant, c, x0=[0], reference=[1.0], steps=20) for c in (own, lambda y, r: law(y, r))]
    np.testing.assert_array_equal(runs[0].U, runs[1].U)
    own.dt = 0.2
    with pytest.raises(km.errors.DataError, match=r"the controller has dt = 0\.2 s, the plant 0\.1 s"):
        km.simulate(plant, own, x0=[0], reference=[1.0], steps=2)


def test_an_object_whose_step_is_a_word_is_refused():
    code = """
class Law:
    dt = "fast"
    def __call__(self, y, r):
        return [0.0]
plant = km.black_box(lambda x, u: 0.9 * x + u, dt=0.1, states=["x"], inputs=["u"])
show(lambda: km.simulate(plant, Law(), x0=[0], reference=[1.0], steps=2))
"""
    assert shown(code)[0].startswith("DataError dt of the controller")
