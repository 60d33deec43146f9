"""Closed loops with an estimator: no offset, whatever the model lacks."""

import copy
import pickle

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.control.models import PRECISE
from tests.estimate.pendulums import PROBLEM, SETPOINT, angle, learned, truth
from tests.estimate.plants import linear

WHOLE = km.Cost(Q=[10.0, 1.0], R=0.1)
ANGLE = km.Cost(Q=10.0, R=0.1, of=angle())
DESIGNS = {
    "relifted": (km.LiftedDisturbance(), 2, WHOLE),
    "deadbeat": (km.LiftedDisturbance(gain=1.0), 2, WHOLE),
    "angle, load": (km.LiftedKalman("theta"), 1, ANGLE),
    "angle, offset": (km.LiftedKalman("theta", "output"), 1, ANGLE),
    "both, load": (km.LiftedKalman(("theta", "omega")), 2, WHOLE),
    "both, offset": (km.LiftedKalman(("theta", "omega"), "output"), 2, WHOLE),
}
PLANTS = {"nominal": {}, "load": {"load": 2.0}, "heavy": {"m": 1.2}, "light": {"m": 0.8}}


def held(estimator, seen, cost, steps=300, **changes):
    """The last offset of a run from π/4 to the setpoint."""
    mpc = km.KoopmanMPC(learned(), cost, PROBLEM.limits, PROBLEM.horizon, estimator=estimator)
    reference = [SETPOINT, 0.0] if cost is WHOLE else [SETPOINT]
    run = km.simulate(truth(seen=seen, **changes), mpc, x0=[np.pi / 4, 0], reference=reference, steps=steps)
    assert (np.abs(run.U) <= 25.0).all()
    return abs(run.X[-1, 0] - SETPOINT)


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("design", DESIGNS)
def test_a_learned_pendulum_is_held_without_offset(design, plant):
    steps = {"angle, offset": 600, "relifted": 300, "deadbeat": 300}.get(design, 450)
    assert held(*DESIGNS[design], steps, **PLANTS[plant]) < 1e-6


@pytest.mark.parametrize("plant", ["load", "heavy", "light"])
def test_without_an_estimator_there_is_one(plant):
    assert held(None, 2, WHOLE, **PLANTS[plant]) > 1e-2


class InputAlone:
    """What is not offered: z lifted afresh, and a disturbance of the input that explains the angle alone."""

    def start(self, predictor, horizon):
        return Bad(predictor, horizon)


class Bad:
    def __init__(self, predictor, horizon):
        self.whole = km.LiftedDisturbance().start(predictor, horizon)
        self.B = predictor.B[:, 0]

    ny = property(lambda self: 2)
    z = property(lambda self: self.whole.z)
    d = property(lambda self: self.B * (self.B @ self.whole.d) / (self.B @ self.B))

    def reset(self, x0=None):
        self.whole.reset(x0)

    def update(self, predictor):
        self.whole.update(predictor)

    def observe(self, y, u, w):
        return self.whole.observe(y, u, w)


def test_fewer_disturbances_than_lifted_coordinates_leave_an_offset_where_z_is_lifted_afresh():
    assert held(InputAlone(), 2, WHOLE, m=1.2) > 1e-3


A, B = np.array([[0.9, 0.2], [0.0, 0.7]]), np.array([[0.0], [0.3]])


def plant(gain=0.7, load=0.1, seen=2):
    """x⁺ = A x + gain B u + load: not what the model says."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    F = ca.Function("F", [x, u], [ca.DM(A) @ x + gain * ca.DM(B) @ u + load])
    return km.StepMap(F, 0.1, ca.Function("h", [x], [x[:seen]]), states=("x0 [m]", "x1 [m]"), inputs=("u0 [N]",))


def first(x):
    return [x[0]]


POSITION = km.Cost(Q=1.0, R=0.1, of=km.Expressions(first, ["x0 [m]"]))
KNOWN = linear(A, B, [0.0, 0.0])
BOTH = pytest.mark.parametrize("estimator", [km.LiftedDisturbance(), km.LiftedKalman("x0")])


def loop(estimator, limits, reference, steps=200, faults=(), **settings):
    mpc = km.KoopmanMPC(KNOWN, POSITION, limits, 15, estimator=estimator, **settings)
    seen = 2 if isinstance(estimator, km.LiftedDisturbance) else 1
    return km.simulate(
        plant(seen=seen),
        mpc,
        x0=[0, 0],
        reference=reference,
        steps=steps,
        limits=limits,
        options=km.loop.LoopOptions(faults=faults),
    )


@BOTH
def test_a_setpoint_beyond_the_input_limit_is_held_as_nearly_as_the_plant_can(estimator):
    limits = km.Limits(-0.5, 0.5)
    nearest = np.linalg.solve(np.eye(2) - A, 0.7 * B[:, 0] * 0.5 + 0.1)
    run = loop(estimator, limits, [nearest[0] + 1.0], settings=PRECISE)  # its plans stay on the limit
    np.testing.assert_allclose(run.X[-1], nearest, atol=1e-6)
    assert (np.abs(run.U) <= 0.5).all()
    within = loop(estimator, limits, [nearest[0] - 0.1])
    assert abs(within.X[-1, 0] - (nearest[0] - 0.1)) < 1e-6


@pytest.mark.parametrize("estimator", [km.LiftedDisturbance(gain=0.5), km.LiftedKalman("x0", process=0.01)])
def test_a_setpoint_beyond_a_state_limit_is_held_at_the_limit(estimator):
    run = loop(estimator, km.Limits(-5, 5, x_max=[1.0, np.inf]), [1.5])
    assert abs(run.X[-1, 0] - 1.0) < 1e-4
    assert run.X[:, 0].max() < 1.2  # a wrong model runs over it once


@BOTH
def test_what_the_plant_really_got_is_what_the_estimator_uses(estimator):
    """An actuator that lost half its range is no disturbance of a true model."""
    mpc = km.KoopmanMPC(KNOWN, POSITION, km.Limits(-1, 1), 15, estimator=estimator)
    seen = 2 if isinstance(estimator, km.LiftedDisturbance) else 1
    true = plant(1.0, 0.0, seen)
    largest = []

    def look(step):
        largest.append(np.abs(mpc.observer.d).max())

    km.simulate(
        true,
        mpc,
        x0=[0, 0],
        reference=[1.0],
        steps=40,
        limits=km.Limits(-1, 1),
        options=km.loop.LoopOptions(faults=[km.faults.ActuatorLoss(0.5)]),
        observers=[look],
    )
    assert max(largest) < 1e-12


@BOTH
def test_copies_and_pickles_go_on_as_the_original_and_reset_repeats_to_the_bit(estimator):
    seen = 2 if isinstance(estimator, km.LiftedDisturbance) else 1
    mpc = km.KoopmanMPC(KNOWN, POSITION, km.Limits(-0.5, 0.5), 15, estimator=estimator, settings=PRECISE)
    rng = np.random.default_rng(0)
    Y = rng.normal(size=(20, seen))
    for y in Y[:10]:
        mpc(y, [1.0])
    twins = [copy.deepcopy(mpc), pickle.loads(pickle.dumps(mpc))]
    for y in Y[10:]:
        u = mpc(y, [1.0]).u
        for twin in twins:
            np.testing.assert_allclose(twin(y, [1.0]).u, u, atol=1e-6)
    runs = []
    for _ in range(2):
        mpc.reset([0.1, 0.2])
        runs.append([mpc(y, [1.0]).u for y in Y])
    np.testing.assert_array_equal(*runs)


def test_a_missing_state_is_a_bad_measurement_and_leaves_the_disturbance():
    mpc = km.KoopmanMPC(KNOWN, POSITION, km.Limits(-1, 1), 15, estimator=km.LiftedDisturbance())
    for _ in range(6):
        mpc([0.3, 0.1], [1.0], applied=[0.0])
    before = mpc.observer.d.copy()
    assert before.any()
    assert mpc([np.nan, 0.0], [1.0]).status is km.Status.BAD_MEASUREMENT
    assert mpc([0.3, 0.1], [1.0]).status in (km.Status.UNCONSTRAINED, km.Status.OPTIMAL)
    np.testing.assert_array_equal(mpc.observer.d, before)


def test_a_filter_bridges_missed_samples_for_a_while_then_says_so():
    rule = km.LiftedKalman("x0", patience=3)
    mpc = km.KoopmanMPC(KNOWN, POSITION, km.Limits(-1, 1), 15, estimator=rule)
    statuses = [mpc([y], [1.0]).status for y in [0.0, 0.1] + [np.nan] * 6 + [0.5]]
    good = {km.Status.UNCONSTRAINED, km.Status.OPTIMAL}
    assert set(statuses[:5]) <= good
    assert set(statuses[5:8]) == {km.Status.BAD_MEASUREMENT}
    assert statuses[8] in good


def test_late_measurements_leave_no_offset():
    late = km.LiftedKalman("x0", delay=3)
    run = loop(late, km.Limits(-5, 5), [0.7], steps=400, faults=[km.faults.SensorDelay(3)])
    assert abs(run.X[-1, 0] - 0.7) < 1e-6


def test_a_new_model_between_two_steps_keeps_the_state_of_a_filter():
    """A model that becomes true: what was a disturbance is forgotten at the filter's own pace, without a jump."""
    true = linear(A, 0.7 * B, [0.1, 0.1])
    for rule in (km.LiftedDisturbance(gain=0.5), km.LiftedKalman("x0")):
        mpc = km.KoopmanMPC(KNOWN, POSITION, horizon=15, estimator=rule)
        mpc.reset([0.0, 0.0])
        x, seen = np.zeros(2), mpc.observer.ny
        for k in range(160):
            if k == 80:
                assert np.abs(mpc.observer.d).max() > 0.01
                mpc.update(true)
            u = mpc(x[:seen], [0.7]).u
            if k >= 80:
                assert abs(x[0] - 0.7) < 0.3
            x = A @ x + 0.7 * B @ u + 0.1
        assert abs(x[0] - 0.7) < 1e-6
        assert np.abs(mpc.observer.d).max() < 1e-6


def test_y_has_one_value_an_output():
    mpc = km.KoopmanMPC(KNOWN, POSITION, horizon=15, estimator=km.LiftedKalman("x0"))
    with pytest.raises(km.errors.ShapeError, match=r"y has shape \(2,\), expected \(1,\)"):
        mpc([0.0, 0.0], [1.0])
