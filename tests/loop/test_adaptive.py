"""Adaptive learns while it runs, with guards; Guarded hands over where the model does not know."""

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.drift.arm import (
    COST,
    HORIZON,
    LIFTING,
    LIMITS,
    DriftingArm,
    Told,
    controllers,
    data,
    payloads,
    reference,
    run,
)


@pytest.fixture(scope="module")
def train():
    return data(1.0, 0)


@pytest.fixture(scope="module")
def model(train):
    return km.edmd(train, LIFTING)


def adaptive(model, train, **options):
    online = km.OnlineEDMD.start(train, LIFTING, forgetting=0.98)
    return km.supervise.Adaptive(km.KoopmanMPC(model, COST, LIMITS, HORIZON, monitor=train), online, **options)


def test_it_follows_a_payload_that_grows_by_half():
    """It costs at most 1.1 times a controller that is told the payload, and less than one that learns nothing."""
    m = payloads(0.5)
    cost = {name: km.metrics(run(mpc, m)).cost for name, mpc in controllers(m).items()}
    assert cost["adaptive"] <= 1.10 * cost["told"]
    assert cost["adaptive"] < cost["fixed"]


def test_without_drift_it_is_the_controller_that_it_was_made_of():
    m = payloads(0.0)
    made = controllers(m)
    still, fixed = run(made["adaptive"], m), run(made["fixed"], m)
    assert np.array_equal(still.U, fixed.U)
    assert made["adaptive"].renewed == 0
    assert made["adaptive"].learned > 350


def test_nothing_is_learned_from_spikes_nan_or_a_frozen_sensor(model, train):
    """The models of runs with and without faults of the sensors are the same but for the samples left out."""
    mpc = adaptive(model, train)
    noise = np.zeros((401, 2))
    noise[[60, 130, 200]] = [3.0, 20.0]
    found = km.simulate(
        DriftingArm(payloads(0.0)), mpc, x0=[0, 0], reference=reference(), steps=400, options=km.loop.LoopOptions(noise=noise, faults=[km.faults.FrozenSensor(begin=250, end=270), km.faults.NaNSensor(begin=90, end=91)]),
        cost=COST, limits=LIMITS,
    )  # fmt: skip
    assert mpc.skipped >= 3 * 2 + 2 + 19
    errors = km.score(mpc.online.predictor(), data(1.0, 1), 1).rmse[0] / km.score(model, data(1.0, 1), 1).rmse[0]
    assert errors.max() < 3
    assert np.isfinite(found.U).all()


def test_a_model_that_fails_on_recent_data_is_not_used_and_an_earlier_one_comes_back(model, train):
    """What was learned from a plant of another kind is given up once the first plant is back."""
    m = np.where(np.arange(400) % 400 < 150, 3.0, 1.0)
    mpc = adaptive(model, train)
    run(mpc, m)
    assert mpc.renewed >= 1
    assert mpc.returned + mpc.renewed >= 2
    pairs = data(1.0, 2)
    used, first = km.score(mpc.predictor, pairs, 1).rmse[0], km.score(model, pairs, 1).rmse[0]
    assert (used < 5 * first).all()


def test_a_run_begins_with_the_first_model_and_repeats_what_it_was_told(model, train):
    mpc = adaptive(model, train)
    run(mpc, payloads(0.5))
    assert mpc.predictor != model
    mpc.reset([0, 0])
    assert mpc.predictor == model
    assert (mpc.learned, mpc.renewed) == (0, 0)


def test_what_cannot_learn_is_refused_in_words(model, train):
    mpc = km.KoopmanMPC(model, COST, LIMITS, HORIZON)
    with pytest.raises(km.errors.DataError, match="OnlineEDMD learns another lifting than the model's"):
        km.supervise.Adaptive(mpc, km.OnlineEDMD.start(train, km.State()))
    late = km.edmd(train, km.State(), embedding=km.Delay(1))
    with pytest.raises(km.errors.DataError, match="has an embedding, and OnlineEDMD takes none"):
        km.supervise.Adaptive(km.KoopmanMPC(late, COST, LIMITS, HORIZON), km.OnlineEDMD.start(train, LIFTING))


def test_the_controller_that_stands_by_takes_over_where_the_model_does_not_know(model, train):
    """Far outside the data LQR acts, and inside them the first controller again."""
    plant = DriftingArm(np.ones(60))
    standby = km.LQR(km.edmd(train, km.State()), km.Cost(Q=[100.0, 1.0], R=0.01), LIMITS)
    first = km.KoopmanMPC(model, COST, LIMITS, HORIZON, monitor=train)
    mpc = km.supervise.Guarded(first, standby, patience=2)
    found = km.simulate(plant, mpc, x0=[1.0, 40.0], reference=[0.0, 0.0], steps=60, cost=COST, limits=LIMITS)
    other = [k for k, f in enumerate(found.fallback) if f is km.control.Fallback.OTHER_CONTROLLER]
    assert other[0] == 1  # the second unknown step
    assert found.known[0] == found.known[1] == 0
    assert found.fallback[-1] is not km.control.Fallback.OTHER_CONTROLLER
    assert (found.known[-5:] == 1).all()
    assert km.metrics(found).fallback["OTHER_CONTROLLER"] == len(other)


class Scripted:
    """A controller that returns its own number, and knows what it is told to."""

    dt, nu, horizon = 0.1, 1, 0

    def __init__(self, own, known):
        self.own, self.told = own, known

    def reset(self, x0=None, u_prev=None):
        self.left = iter(self.told)

    def __call__(self, y, reference, applied=None, w=None):
        known = next(self.left, None)
        return km.Move(np.array([self.own]), km.Status.OPTIMAL, km.control.Fallback.NONE, 0.25, 1, known=known)


def test_only_so_many_unknown_steps_in_sequence_hand_over_and_as_many_known_ones_back():
    known = [bool(int(digit)) for digit in "0010010001101110000"]
    acting = [int(digit) for digit in "0000000011111100011"]  # 1: the one that stands by
    guarded = km.supervise.Guarded(Scripted(0.0, known), Scripted(1.0, ()), patience=3)
    for _ in range(2):
        guarded.reset()
        moves = [guarded([0.0], [0.0]) for _ in known]
        assert [int(move.u[0]) for move in moves] == acting
        assert [move.known for move in moves] == known
        assert {move.solve_time for move in moves} == {0.5}  # of both


def test_both_controllers_are_told_the_input_that_acted_and_the_last_move_where_nobody_says_which():
    class Noting(Scripted):
        def reset(self, x0=None, u_prev=None):
            super().reset()
            self.seen = []

        def __call__(self, y, reference, applied=None, w=None):
            self.seen.append(None if applied is None else float(applied[0]))
            return super().__call__(y, reference)

    both = Noting(0.25, [True, False, False, False, True]), Noting(0.75, ())
    guarded = km.supervise.Guarded(*both, patience=2)
    guarded.reset()
    for applied in (None, None, [0.5], None, None):
        guarded([0.0], [0.0], applied)
    assert [one.seen for one in both] == [[None, 0.25, 0.5, 0.75, 0.75]] * 2


def test_by_region_a_plant_that_has_changed_hands_nothing_over_and_a_state_outside_the_data_does(
    model, train, tmp_path
):
    """A stronger arm inside the data: its misfit is for an estimator, whatever the standby makes of it."""
    standby = km.LQR(km.edmd(train, km.State()), km.Cost(Q=[100.0, 1.0], R=0.01), LIMITS)
    handed: dict[tuple[bool, float], int] = {}
    for region, speed in ((False, 0.0), (True, 0.0), (True, 40.0)):
        first = km.KoopmanMPC(model, COST, LIMITS, HORIZON, monitor=train)
        mpc = km.supervise.Guarded(first, standby, patience=2, region=region)
        run = km.simulate(
            DriftingArm(np.full(60, 3.0)),
            mpc,
            x0=[0.3, speed],
            reference=[0.3, 0.0],
            steps=40,
            cost=COST,
            limits=LIMITS,
        )
        handed[region, speed] = sum(one is km.control.Fallback.OTHER_CONTROLLER for one in run.fallback)
        mpc.save(tmp_path / "guarded.npz")
        assert km.load_controller(tmp_path / "guarded.npz").as_data().options["region"] is region
    assert handed[True, 0.0] == 0 < min(handed[False, 0.0], handed[True, 40.0])
    with pytest.raises(km.errors.DataError, match="region=True asks the controller's monitor"):
        km.supervise.Guarded(km.KoopmanMPC(model, COST, LIMITS, HORIZON), standby, region=True)


def test_guarded_controllers_must_agree_and_the_first_must_say_what_it_knows(model, train):
    first, other = km.KoopmanMPC(model, COST, LIMITS, HORIZON), km.LQR(model, COST, LIMITS)
    with pytest.raises(km.errors.DataError, match="does not say whether it knows; give it monitor=data"):
        km.supervise.Guarded(first, other)([0, 0], [0, 0])
    slower = km.LQR(km.LinearPredictor(model.A, model.B, model.C, model.lifting, 0.1, model.states, model.inputs), COST)
    with pytest.raises(km.errors.DataError, match=r"the controller has dt = 0\.05, the one that stands by 0\.1"):
        km.supervise.Guarded(first, slower)


@pytest.mark.unhooked
def test_what_is_no_controller_is_not_guarded(model):
    first, other = km.KoopmanMPC(model, COST, LIMITS, HORIZON), km.LQR(model, COST, LIMITS)
    with pytest.raises(km.errors.DataError, match="the one that stands by is a LinearPredictor"):
        km.supervise.Guarded(first, model)
    with pytest.raises(km.errors.DataError, match="the controller is a NoneType"):
        km.supervise.Guarded(None, other)


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 2e-3])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_drift_bench(seed, noise):
    """The issue's numbers on every training seed."""
    for drift in (0.5, 0.0):
        m = payloads(drift)
        cost = {name: km.metrics(run(mpc, m, noise)).cost for name, mpc in controllers(m, seed, noise).items()}
        assert cost["adaptive"] <= 1.10 * cost["told"]
        assert cost["adaptive"] <= cost["fixed"] * (1 + 1e-9)


def test_the_controller_that_is_told_is_better_than_one_that_is_not():
    m = payloads(0.5)
    assert km.metrics(run(Told(m), m)).cost < km.metrics(run(controllers(m)["fixed"], m)).cost


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_forecast_that_turns_nan_is_the_worst_of_all(model, train, monkeypatch, value):
    """NaN is smaller than nothing: such a model would neither be refused nor left."""
    one = adaptive(model, train)
    monkeypatch.setattr(one, "_errors", lambda *_: np.full((3, 2), value))
    assert one._error(model, []) == np.inf


def test_it_begins_as_after_a_reset(model, train):
    fresh, again = adaptive(model, train), adaptive(model, train)
    again.reset()
    x = np.array(train[0].X[0])
    for _ in range(3):
        assert np.array_equal(fresh(x, np.zeros(len(x))).u, again(x, np.zeros(len(x))).u)
    assert (fresh.learned, fresh.renewed) == (again.learned, again.renewed)


class Joint(km.Dynamics):
    """A light joint that swings with 12 rad/s."""

    states, inputs = ("theta [rad]", "omega [rad/s]"), ("torque [N m]",)

    def rhs(self, x, u):
        return ca.vertcat(x[1], (u[0] - 0.004 * x[1] - 0.35 * ca.sin(x[0])) / 0.012)


@pytest.mark.parametrize("remembers", [{"forgetting": 0.98}, {"window": 200}])
def test_a_fit_of_the_last_steps_does_not_replace_a_model_that_plans_better(remembers):
    """Data of small swings, then large and fast ones: each fit knows the steps behind it, and not the plan's."""
    plant, torque = km.discretize(Joint(), 0.01), 0.15 * np.cos(0.02 * np.arange(500))[:, None]
    lifting = km.State() + km.Fourier(1, states=[0]) + km.Fourier(1, states=[0]) * km.State([1])
    X = [np.zeros(2)]
    for u in torque:
        X.append(np.asarray(plant(X[-1], u)).ravel())
    little = km.Episodes([km.Episode(X=np.array(X), U=torque)], 0.01, Joint.states, Joint.inputs)
    model = km.edmd(little, lifting, ridge=1e-9)
    k = np.arange(301)
    swing = np.where(k < 200, 1.6 * (1 - np.cos(0.02 * np.pi * k)) * np.sin(0.0125 * np.pi * k), 0.0)
    cost = km.Cost(Q=[1.0, 0.0], R=0.0, R_delta=1.0, u_target="zero")

    def missed(controller):
        rows = np.column_stack([swing, 0.0 * k])
        found = km.simulate(plant, controller, x0=X[-1], reference=rows, steps=300, cost=cost)
        return np.sqrt(((found.X[:, 0] - swing) ** 2).mean())

    fixed, mpc = (km.KoopmanMPC(model, cost, km.Limits(-6, 6), 30) for _ in range(2))
    learning = km.supervise.Adaptive(mpc, km.OnlineEDMD.start(little, lifting, **remembers))
    assert missed(learning) <= 1.01 * missed(fixed)
    assert learning.refused + learning.renewed > 0  # models were on trial


def run_with_drift(share, change, pushed=range(0), steps=450):
    """Return the data of a design, and a learning controller after a run with a gain that changes once."""
    A, B, rng = np.array([[0.9, 0.1], [-0.1, 0.8]]), np.array([[0.0], [0.2]]), np.random.default_rng(0)
    plant = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ["x", "v"], ["F"]).step_map()
    old = km.collect(plant, [0, 0], km.Noise(-2, 2, hold=3), episodes=4, steps=150)
    old = old.with_episodes([km.Episode(X=e.X + 1e-3 * rng.standard_normal(e.X.shape), U=e.U) for e in old])
    model = km.edmd(old, km.State() + km.Constant())
    mpc = km.KoopmanMPC(model, km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-2, u_max=2), 15)
    online = km.OnlineEDMD.start(old, km.State() + km.Constant(), forgetting=0.98)
    learning = km.supervise.Adaptive(mpc, online)
    with pytest.raises(km.errors.DataError, match="nothing was learned"):
        learning.find_drift(old)
    x, goal = np.zeros(2), np.zeros(2)
    for k in range(steps):
        if k % 15 == 0:
            goal = np.array([rng.uniform(-0.6, 0.6), 0.0])
        u = learning(x + 1e-3 * rng.standard_normal(2), goal).u
        x = A @ x + B @ u * (share if k >= change else 1.0) + np.array([0.0, 0.1 * (k in pushed)])
    return old, learning


@pytest.mark.parametrize("share", [1.0, 0.6, 0.8, 1.2])
def test_it_names_what_changed_since_the_design(share):
    """The gain of the input changes after 150 steps, or does not."""
    old, learning = run_with_drift(share, 150)
    report = learning.find_drift(old)
    if share == 1:
        assert report.verdict == "unchanged"
        assert (learning.alarms, learning.renewed) == (0, 0)
    else:
        assert report.verdict == "changed"
        assert learning.alarms >= 1
        assert report.changes[0].share == pytest.approx(share - 1, abs=0.08)
        assert "the gain of F" in [change.name for change in report.changes]


def test_an_alarm_that_passed_does_not_blur_what_changed_later():
    """Something pushes for 8 steps; the gain falls 180 steps later, and pairs before that are not of the change."""
    pushed = range(60, 68)
    _, learning = run_with_drift(0.6, 250, pushed, steps=100)
    assert (learning.alarms, learning.refused, learning.renewed) == (1, 1, 0)  # a false alarm
    old, learning = run_with_drift(0.6, 250, pushed)
    assert learning.renewed >= 1
    assert learning.find_drift(old).changes[0].share == pytest.approx(-0.4, abs=0.08)
