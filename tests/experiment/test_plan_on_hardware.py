"""Plans of inputs and of set points under `realtime`: late steps, readings that are missing, a shorter plan."""

import pickle
import time
from dataclasses import replace

import numpy as np
import pytest

import koopmpc as km
from koopmpc.experiment.planner import UnsafePlanError
from tests.experiment.test_next_experiment import CART, COST, LIMITS, log_noisily
from tests.fitting.mass import A, B

DT = 0.02
MASS = km.LinearPredictor(A, B, np.eye(2), km.State(), dt=DT, states=("x", "v"), inputs=("F",)).step_map()
STANDING = km.LQR(km.LinearPredictor.local(CART, [0, 0], [0]), km.Cost(Q=[4, 1], R=1), km.Limits(u_min=-2, u_max=2))


class Stalling(km.plants.SimulatedPlant):
    """A plant whose third step takes three sampling times, and whose reading after `blind` steps is missing."""

    def __init__(self, plant, *, stalls=True, blind=-1):
        super().__init__(plant)
        self.calls, self.stalls, self.blind = 0, stalls, blind

    def step(self, u):
        self.calls += 1
        if self.stalls and self.calls == 3:
            time.sleep(3 * DT)
        y = super().step(u)
        return np.full_like(y, np.nan) if self.calls == self.blind else y


@pytest.fixture(scope="module")
def set_points():
    logs = log_noisily(CART, [0, 0], km.Feedback([[1.5, 1.2]], km.Noise(-0.1, 0.1)), 0.001, episodes=4, steps=40)
    return km.next_experiment(logs, COST, LIMITS, reference=[0.5, 0], controller=STANDING, steps=40, rng=0)


@pytest.fixture(scope="module")
def held():
    """A plan of inputs with feedback of the deviation, for the model of the mass has an integrator."""
    logs = log_noisily(MASS, [0, 0], km.Noise(-1, 1, hold=3), 0.001, episodes=4, steps=40)
    limits = km.Limits(u_min=-1, u_max=1, x_min=[-9, -9], x_max=[9, 9])
    return km.next_experiment(logs, COST, limits, reference=[0.2, 0], steps=40, rng=0)


def run(plan, plant, steps, dt):
    seen = []
    km.realtime(plan, plant, dt=dt, reference=[0, 0], steps=steps, x0=plan.starts[0], recorder=seen.append, watchdog=20)
    return [one for one in seen if one.move.status != km.Status.TIME_LIMIT]


def test_a_plan_keeps_its_time_where_steps_are_skipped(held):
    plan = replace(held, K=np.zeros_like(held.K))
    done = run(plan, Stalling(MASS), 12, DT)
    assert len(done) < 12  # some were skipped
    k = np.array([one.k for one in done])
    assert np.allclose([one.u for one in done], plan.U[0, k])
    assert np.ptp(plan.U[0, :12]) > 0.2


@pytest.mark.parametrize("blind", [0, 3])
def test_set_points_run_in_real_time_with_a_reading_missing(set_points, blind):
    done = run(set_points, Stalling(CART, stalls=False, blind=blind), 5, CART.dt)
    U = np.array([one.u for one in done])
    assert np.isfinite(U).all()
    k = [one.k for one in done]
    assert np.abs(U - set_points.U[0, k]).max() < 0.2


def test_a_missing_reading_leaves_a_plan_with_feedback_its_inputs(held):
    assert held.K.any()
    policy = held.start(40, DT, np.random.default_rng(0))
    before = [policy(k, held.X[0, k] + 0.01) for k in range(3)]
    assert np.isfinite(policy(3, np.full(2, np.nan))).all()
    assert np.allclose(policy(4, held.X[0, 4]), held.U[0, 4])
    assert not np.allclose(before, held.U[0, :3])


def test_a_shorter_plan_is_tried_where_none_of_the_asked_length_is_safe():
    logs = log_noisily(CART, [0.5, 0.0], km.Noise(-0.2, 0.2, hold=3), 0.005, episodes=2, steps=25)
    limits = km.Limits(u_min=-2, u_max=2, x_min=[0.2, -0.3], x_max=[0.8, 0.3])
    plan = km.next_experiment(logs, COST, limits, reference=[0.6, 0], starts=[0.5, 0.0], steps=100)
    assert 8 <= plan.steps < 100
    assert (plan.low[:, 1:] >= [0.2, -0.3]).all()
    assert (plan.high[:, 1:] <= [0.8, 0.3]).all()
    assert f"no plan of 100 steps is safe, so this one has {plan.steps}" in str(plan)


def test_a_refusal_comes_whole_out_of_a_worker():
    refusal = UnsafePlanError("the band crosses the limit 1")
    read = pickle.loads(pickle.dumps(refusal))
    assert (str(read), read.worst) == (str(refusal), refusal.worst)
