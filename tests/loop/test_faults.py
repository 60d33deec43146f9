"""Faults: each does what its sentence says; none moves an input out of its limits, whatever they are together."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.bare import shown
from tests.example_plants import Swing
from tests.gathered import of_loop

COST = km.Cost(Q=[10.0, 1.0], R=0.1)
LIMITS = km.Limits(u_min=-3.0, u_max=5.0)
GOOD = {km.Status.UNCONSTRAINED, km.Status.OPTIMAL, km.Status.SOFTENED, km.Status.SATURATED}


PLANT = km.discretize(Swing(), 0.1)


class Recorded:
    """A controller that keeps what it got and gave."""

    def __init__(self, controller):
        self._controller, self.got, self.told, self.moves = controller, [], [], []
        self.dt, self.nu, self.horizon = controller.dt, controller.nu, controller.horizon

    def reset(self, x0=None, u_prev=None):
        self._controller.reset(x0, u_prev)

    @property
    def solver_fails(self):
        return getattr(self._controller, "solver_fails", False)

    @solver_fails.setter
    def solver_fails(self, value):
        if isinstance(self._controller, km.control.Fallible):
            self._controller.solver_fails = value

    def __call__(self, y, reference, applied=None):
        move = self._controller(y, reference, applied)
        self.got.append(y.copy())
        self.told.append(None if applied is None else np.array(applied))
        self.moves.append(move)
        return move


class Ramp:
    """u_k = k + 1: a controller whose every input can be told from the others."""

    dt, nu, horizon = 0.1, 1, 0

    def reset(self, x0=None, u_prev=None):
        self._k = 0

    def __call__(self, y, reference, applied=None):
        self._k += 1
        return km.Move(np.array([float(self._k)]), km.Status.OPTIMAL, km.control.Fallback.NONE, 0.0, 0)


@pytest.fixture(scope="module")
def model():
    upright = km.Feedback([[5.0, 3.0]], km.Noise(-2.0, 2.0))
    data = km.collect(PLANT, km.Uniform([-1.0, -1.0], [1.0, 1.0]), upright, episodes=40, steps=20)
    return km.edmd(data, km.State() + km.Fourier(1, states="theta") + km.Constant())


@pytest.fixture(scope="module")
def controllers(model):
    origin = ([0.0, 0.0], [0.0])
    built = {
        "lqr": km.LQR(model.local(PLANT, *origin), COST, LIMITS),
        "koopman-lqr": km.LQR(model, COST, LIMITS),
        "linear-mpc": km.LinearMPC(PLANT, *origin, COST, LIMITS, 8),
        "koopman-mpc": km.KoopmanMPC(model, COST, LIMITS, 8),
        "nonlinear-mpc": km.NonlinearMPC(PLANT, COST, LIMITS, 8),
    }
    assert len(built) == 5
    return built


def closed_loop(controller, faults, *, steps=12, x0=(0.9, 0.0), limits=LIMITS, **rest):
    return km.simulate(
        PLANT,
        controller,
        x0=x0,
        reference=[0.0, 0.0],
        steps=steps,
        cost=COST,
        limits=limits,
        **of_loop(faults=faults, **rest),
    )


def ramp(faults, steps=8, limits=None, x0=(0.9, 0.0), **rest):
    """A run of inputs 1, 2, 3, … that no fault has seen before."""
    return closed_loop(Ramp(), faults, steps=steps, limits=limits, x0=x0, **rest)


def test_faults_that_never_strike_change_only_the_metadata(controllers):
    never = (
        km.faults.NaNSensor(probability=0.0),
        km.faults.FrozenSensor(begin=100),
        km.faults.DroppedSamples(0.0),
        km.faults.SensorDelay(0),
        km.faults.ActuatorLoss(0.0),
        km.faults.ActuatorDelay(0),
        km.faults.SolverFailure(0.0),
    )
    noise = [0.01, 0.02]
    for controller in controllers.values():
        bare = closed_loop(controller, (), noise=noise)
        run = closed_loop(controller, never, noise=noise)
        assert run.metadata["faults"] == [str(fault) for fault in never]
        assert replace(run, solve_time=bare.solve_time, metadata=bare.metadata) == bare


def test_a_nan_sensor_hides_its_channels_in_its_window():
    run = ramp((km.faults.NaNSensor([1], begin=2, end=5),))
    assert np.isnan(run.Y[2:5, 1]).all()
    assert np.isnan(run.Y).sum() == 3
    assert np.isfinite(run.X).all()
    everywhere = ramp((km.faults.NaNSensor(),))
    assert np.isnan(everywhere.Y).all()


def test_a_nan_sensor_strikes_as_often_as_it_says():
    run = ramp((km.faults.NaNSensor(probability=0.3),), steps=2000)
    lost = np.isnan(run.Y)
    assert (lost[:, 0] == lost[:, 1]).all()
    assert abs(lost[:, 0].mean() - 0.3) < 4 * np.sqrt(0.3 * 0.7 / 2000)


def test_a_frozen_sensor_shows_what_it_showed_at_the_beginning_of_its_window():
    run = ramp((km.faults.FrozenSensor([0], begin=2, end=6),))
    assert (run.Y[2:6, 0] == run.X[2, 0]).all()
    assert (run.Y[[0, 1, 6, 7, 8], 0] == run.X[[0, 1, 6, 7, 8], 0]).all()
    assert np.array_equal(run.Y[:, 1], run.X[:, 1])


def test_a_dropped_sample_repeats_the_last_that_arrived():
    run = ramp((km.faults.DroppedSamples(0.5),), steps=400, x0=(0.9, 0.0))
    arrived = (run.Y == run.X).all(axis=1)
    assert arrived[0]
    last = np.maximum.accumulate(np.where(arrived, np.arange(401), 0))
    assert np.array_equal(run.Y, run.X[last])
    assert abs(arrived.mean() - 0.5) < 0.1
    assert (ramp((km.faults.DroppedSamples(1.0, begin=3),)).Y[3:] == run.X[2]).all()


@pytest.mark.parametrize("d", [0, 1, 3, 50])
def test_a_delay_shifts_by_its_steps(d):
    seen = ramp((km.faults.SensorDelay(d),))
    assert np.array_equal(seen.Y, seen.X[np.maximum(np.arange(9) - d, 0)])
    run = ramp((km.faults.ActuatorDelay(d),))
    expected = np.maximum(np.arange(8.0) + 1 - d, 0.0)
    assert np.array_equal(run.U[:, 0], expected)


def test_before_the_first_input_arrives_the_actuator_rests_inside_its_limits():
    run = ramp((km.faults.ActuatorDelay(2),), limits=km.Limits(u_min=0.5, u_max=100.0))
    assert run.U[:, 0].tolist() == [0.5, 0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]


@pytest.mark.parametrize(
    ("low", "high", "kept"),
    [(-8.0, 8.0, (-4.0, 4.0)), (0.0, 8.0, (0.0, 4.0)), (-6.0, 8.0, (-3.0, 4.0)), (2.0, 8.0, (2.0, 5.0))],
)
def test_half_the_range_is_lost_about_the_input_nearest_to_zero(low, high, kept):
    limits = km.Limits(u_min=low, u_max=high)
    run = ramp((km.faults.ActuatorLoss(0.5),), limits=limits)
    assert np.array_equal(run.U[:, 0], np.clip(np.arange(1.0, 9.0), *kept))
    whole = ramp((km.faults.ActuatorLoss(1.0),), limits=limits)
    assert (np.clip(0.0, low, high) == whole.U).all()
    later = ramp((km.faults.ActuatorLoss(0.5, begin=3, end=7),), limits=limits)
    assert np.array_equal(later.U[3:7, 0], run.U[3:7, 0])
    assert later.U[7, 0] == 8.0


def test_a_limit_on_one_side_alone_is_all_that_an_actuator_can_lose():
    assert ramp((km.faults.ActuatorLoss(0.5),), limits=km.Limits(u_max=8.0)).U.max() == 4.0


def test_the_controller_is_told_what_the_plant_got(controllers):
    for name, controller in controllers.items():
        watched = Recorded(controller)
        run = closed_loop(watched, (km.faults.ActuatorLoss(0.5), km.faults.ActuatorDelay(1)), x0=(1.2, 1.0))
        assert watched.told[0] is None
        assert np.array_equal(np.array(watched.told[1:]), run.U[:-1]), name
        assert np.array_equal(np.array(watched.got), run.Y[:-1])
        commanded = np.array([move.u for move in watched.moves])
        assert not np.array_equal(commanded, run.U)
        X = [run.X[0]]
        for u in run.U:  # the plant got run.U, not what was commanded
            X.append(PLANT(X[-1], u))
        assert np.array_equal(np.array(X), run.X)


def test_a_signal_passes_through_the_faults_in_order():
    first = ramp((km.faults.ActuatorLoss(0.5), km.faults.ActuatorDelay(2)), limits=km.Limits(u_min=1.0, u_max=5.0))
    assert first.U[:, 0].tolist() == [1.0, 1.0, 1.0, 2.0, 3.0, 3.0, 3.0, 3.0]
    then = ramp((km.faults.NaNSensor(begin=2, end=3), km.faults.SensorDelay(1)))
    assert np.flatnonzero(np.isnan(then.Y[:, 0])).tolist() == [3]
    assert np.isnan(ramp((km.faults.SensorDelay(1), km.faults.NaNSensor(begin=2, end=3))).Y[2]).all()


def test_a_failing_solver_leads_into_the_fallback_of_every_mpc(controllers):
    for name in ("linear-mpc", "koopman-mpc", "nonlinear-mpc"):
        controller = controllers[name]
        x0 = (1.5, 2.0)  # limits are active, so that a QP is due
        whole = closed_loop(controller, (), x0=x0, steps=6)
        run = closed_loop(controller, (km.faults.SolverFailure(1.0, begin=1, end=3),), x0=x0, steps=6)
        assert run.status[0] is whole.status[0] is not km.Status.UNCONSTRAINED
        assert run.status[1:3] == (km.Status.FAILED, km.Status.FAILED), name
        assert run.fallback[1:3] == (km.control.Fallback.SHIFTED_PLAN, km.control.Fallback.SHIFTED_PLAN)
        assert set(run.status[3:]) <= GOOD
        assert controller.solver_fails is False
        first = closed_loop(controller, (km.faults.SolverFailure(1.0),), x0=x0, steps=1)
        assert first.status == (km.Status.FAILED,)
        expected = km.control.Fallback.HOLD if name == "nonlinear-mpc" else km.control.Fallback.CLIPPED_LQR
        assert first.fallback == (expected,)


def test_what_a_shifted_plan_applies_is_the_plan_of_the_last_good_step(controllers):
    for name in ("koopman-mpc", "nonlinear-mpc"):
        run = closed_loop(
            controllers[name], (km.faults.SolverFailure(1.0, begin=1, end=4),), x0=(1.5, 2.0), steps=5, plans=True
        )
        assert np.array_equal(run.U[:4], run.plans.U[0, :4]), name
        assert np.isnan(run.plans.U[1:4]).all()


def test_a_controller_that_raises_gets_its_solver_back():
    class Broken(Ramp):
        solver_fails = False

        def __call__(self, y, reference, applied=None):
            assert self.solver_fails
            raise RuntimeError("no more")

    controller = Broken()
    with pytest.raises(RuntimeError, match="no more"):
        closed_loop(controller, (km.faults.SolverFailure(1.0),))
    assert controller.solver_fails is False


def test_faults_of_one_seed_are_the_same_for_every_controller_and_leave_the_noise_alone(controllers):
    faults = (km.faults.NaNSensor([0], probability=0.5), km.faults.DroppedSamples(0.5), km.faults.SolverFailure(0.5))
    masks = [np.isnan(closed_loop(c, faults, noise=[0.1, 0.1], rng=3).Y) for c in controllers.values()]
    assert all(np.array_equal(masks[0], mask) for mask in masks)
    assert not np.array_equal(masks[0], np.isnan(ramp(faults, steps=12, rng=4).Y))
    bare, faulty = (ramp(f, noise=[0.1, 0.1], rng=3) for f in ((), (km.faults.NaNSensor([0]),)))
    assert np.array_equal(bare.Y[:, 1], faulty.Y[:, 1])


def test_one_fault_has_the_same_luck_whatever_comes_with_it():
    hidden = [
        np.isnan(ramp((km.faults.NaNSensor([0], probability=0.5), other), steps=50).Y[:, 0])
        for other in (
            km.faults.NaNSensor([1], probability=0.9),
            km.faults.SensorDelay(0),
            km.faults.NaNSensor([1], begin=30),
        )
    ]
    assert all(np.array_equal(hidden[0], mask) for mask in hidden)
    windowed = ramp((km.faults.NaNSensor([0], probability=0.5, begin=20, end=30),), steps=50)
    assert np.array_equal(np.isnan(windowed.Y[20:30, 0]), hidden[0][20:30])


SHARE = st.floats(0.0, 1.0)
CHANNELS = st.sampled_from([None, (0,), (1,), (0, 1)])
WINDOW = st.tuples(st.integers(0, 10), st.none() | st.integers(1, 10)).map(
    lambda w: {"begin": w[0], "end": None if w[1] is None else w[0] + w[1]}
)
FAULT = st.one_of(  # built in the test: beartype picks at random what it checks, and strategies must not
    st.tuples(st.just(km.faults.NaNSensor), st.tuples(CHANNELS, SHARE), WINDOW),
    st.tuples(st.just(km.faults.FrozenSensor), st.tuples(CHANNELS), WINDOW),
    st.tuples(
        st.sampled_from([km.faults.DroppedSamples, km.faults.ActuatorLoss, km.faults.SolverFailure]),
        st.tuples(SHARE),
        WINDOW,
    ),
    st.tuples(
        st.sampled_from([km.faults.SensorDelay, km.faults.ActuatorDelay]), st.tuples(st.integers(0, 4)), st.just({})
    ),
)
NAMES = ("lqr", "koopman-lqr", "linear-mpc", "koopman-mpc", "nonlinear-mpc")
SEEDS = st.integers(0, 2**31)
STARTS = st.tuples(st.floats(-3.0, 3.0), st.floats(-4.0, 4.0))


def build(specified):
    return [kind(*arguments, **window) for kind, arguments, window in specified]


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=20)
@given(faults=st.lists(FAULT, min_size=1, max_size=5), seed=SEEDS, x0=STARTS)
def test_no_faults_together_move_an_input_out_of_its_limits(controllers, name, faults, seed, x0):
    faults, watched = build(faults), Recorded(controllers[name])
    run = closed_loop(watched, faults, rng=seed, x0=x0)
    low, high = LIMITS.inputs(1)
    for u in (run.U, np.array([move.u for move in watched.moves])):
        assert np.isfinite(u).all()
        assert (low <= u).all()
        assert (u <= high).all()
    assert len(run.status) == len(run.fallback) == run.steps == 12
    for y, status, fallback in zip(run.Y, run.status, run.fallback, strict=False):
        assert (status is km.Status.BAD_MEASUREMENT) == bool(np.isnan(y).any())
        assert (fallback is km.control.Fallback.NONE) == (status in GOOD)
    assert run.metadata["faults"] == [str(fault) for fault in faults]
    again = closed_loop(controllers[name], faults, rng=seed, x0=x0)
    assert replace(again, solve_time=run.solve_time, metadata=run.metadata) == run


@settings(max_examples=15)
@given(faults=st.lists(FAULT, min_size=1, max_size=4), seed=SEEDS)
def test_a_faulty_run_comes_back_from_its_log_to_the_bit(controllers, tmp_path_factory, faults, seed):
    run = closed_loop(
        controllers["koopman-mpc"], build(faults), rng=seed, x0=(1.5, 1.0), noise=[0.01, 0.01], plans=True
    )
    path = tmp_path_factory.mktemp("log") / "run.rrd"
    km.record(run, path)
    loaded = km.load_run(path)
    assert loaded == run
    assert km.metrics(loaded) == km.metrics(run)


class Loud(km.faults.Fault):
    """Multiplies every input, by inf if need be."""

    def __init__(self, factor):
        self.factor = factor

    def start(self, wiring, rng):
        injection = km.faults.Injection()
        injection.applied = lambda k, u: self.factor * u
        return injection


def test_a_fault_of_your_own_is_any_object_that_starts():
    assert ramp((Loud(2.0),)).U[:, 0].tolist() == [2.0 * k for k in range(1, 9)]
    with pytest.raises(km.errors.DataError, match=r"the faults made u = \[inf\] of u = \[1\.\] at step 0; they must"):
        ramp((Loud(np.inf),))


def test_what_is_no_fault_is_refused():
    """What the type hook of the tests would catch first, as users see it."""
    lines = shown(
        """
import casadi as ca
x, u = ca.SX.sym("x"), ca.SX.sym("u")
plant = km.StepMap(ca.Function("F", [x, u], [x + u]), 0.1, states=("x",), inputs=("u",))
mpc = km.LinearMPC(plant, [0], [0], km.Cost(1, 1))
run = lambda faults: km.simulate(plant, mpc, x0=[1], reference=[0], steps=2, options=km.loop.LoopOptions(faults=faults))
show(lambda: run(km.faults.SensorDelay(1)))
show(lambda: run([km.faults.SensorDelay]))
"""
    )
    assert lines == [
        "DataError faults is SensorDelay(steps=1); pass a list of faults, for example faults=[SensorDelay(steps=1)]",
        "DataError faults holds <class 'koopmpc.loop.faults.SensorDelay'>; pass objects, for example "
        "faults=[km.faults.NaNSensor()]",
    ]


@pytest.mark.parametrize("name", ["koopman-mpc", "nonlinear-mpc"])
def test_what_a_shifted_plan_of_blocked_moves_applies_is_the_plan_of_the_last_good_step(model, name):
    """A move of several steps is applied as often as it is planned."""
    build = {
        "koopman-mpc": lambda: km.KoopmanMPC(model, COST, LIMITS, 8, moves=(1, 2, 5)),
        "nonlinear-mpc": lambda: km.NonlinearMPC(PLANT, COST, LIMITS, 8, moves=(1, 2, 5)),
    }
    run = closed_loop(build[name](), (km.faults.SolverFailure(1.0, begin=1, end=4),), steps=4, plans=True)
    planned = run.plans.U[0, :4]
    assert planned[2] < planned[3]  # the second move, and the third
    assert run.fallback[1:] == (km.control.Fallback.SHIFTED_PLAN,) * 3
    assert np.array_equal(run.U, planned)
