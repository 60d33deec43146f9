"""Mistakes at simulate, at its faults and at metrics say what was got and what to do."""

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.gathered import of_loop
from tests.loop.test_faults import ramp
from tests.loop.test_metrics import random_run
from tests.loop.test_simulate import A, B, Outside, Recorded, Told, step_map

ONES = np.ones((5, 2))


class Says(Recorded):
    def __init__(self, u):
        super().__init__()
        self.u = np.array(u)

    def __call__(self, y, reference, applied=None):
        move = super().__call__(y, reference, applied)
        move.u = self.u
        return move


def run(plant=None, controller=None, steps=5, reference=(0, 0), x0=(0, 0), **more):
    plant = step_map(A, B) if plant is None else plant
    controller = Recorded() if controller is None else controller
    km.simulate(plant, controller, x0=x0, reference=reference, steps=steps, **of_loop(**more))


def slow():
    x = ca.SX.sym("x", 2)
    return km.StepMap(ca.Function("F", [x, ca.SX.sym("u", 1)], [x]), 0.2)


def speed_alone():
    """Return a plant of two states that measures the second."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    h = ca.Function("h", [x], [x[1]])
    return km.StepMap(ca.Function("F", [x, u], [x]), 0.1, h, ["p", "v [m/s]"], ["u"], ["v [m/s]"])


def follow(measure, output):
    """Ask for the metrics of a run whose reference is for a measured output, and whose cost is missing."""
    how = {"dt": 0.1, "states": ["p", "v [m/s]"], "inputs": ["u"], "measure": measure, "outputs": [output]}
    plant = km.black_box(lambda x, u: 0.5 * x, **how)
    km.metrics(km.simulate(plant, lambda y, r: [0.0], x0=[1.0, 1.0], reference=[0.0], steps=3))


class Longer(Outside):
    """A plant whose state has an entry more than its states have names."""

    state = np.zeros(3)


DATA, SHAPE = km.errors.DataError, km.errors.ShapeError
MISTAKES = [
    (DATA, "the controller has dt = 0.1 s, the plant 0.2 s; use one dt for both", lambda: run(slow())),
    (SHAPE, "the controller returns 1 inputs, the plant takes 2", lambda: run(step_map(A, np.eye(2)))),
    (DATA, "steps is 0; it must be at least 1", lambda: run(steps=0)),
    (SHAPE, "x0 has shape (3,), expected (2,)", lambda: run(x0=[0, 0, 0])),
    (SHAPE, "reference has shape (5, 2), expected (nr,) or (steps+1, nr) = (6, nr)", lambda: run(reference=ONES)),
    (DATA, "reference holds 1 NaN or inf", lambda: run(reference=[0, np.nan])),
    (SHAPE, "reference has 2 columns, and the cost tracks 3: x0, x1, 1; pass a column for each",
        lambda: run(cost=km.Cost(1, 1, of=km.State() + km.Constant()))),
    (SHAPE, "reference has 1 column, and the cost tracks 2: p, v [m/s]; pass a column for each, or track fewer by "
        "Cost(of=km.State('v'), …)", lambda: run(speed_alone(), reference=[0.0], cost=km.Cost([1, 1], 1))),
    (DATA, "angles holds 2; pass indices of states, 0 to 1", lambda: run(angles=[2])),
    (SHAPE, "disturbance has shape (3,), expected (2,) or a scalar", lambda: run(disturbance=[1, 1, 1])),
    (SHAPE, "disturbance has shape (6, 2), expected (5, 2)", lambda: run(disturbance=np.ones((6, 2)))),
    (SHAPE, "disturbance has shape (3,), expected (2,)", lambda: run(disturbance=lambda k, r: ONES[:3, 0])),
    (SHAPE, "u_reference has shape (6, 1), expected (5, 1)", lambda: run(u_reference=np.ones((6, 1)))),
    (SHAPE, "u_reference has shape (2,), expected (1,)", lambda: run(u_reference=[1.0, 2.0])),
    (SHAPE, "noise has shape (3,), expected (2,) or a scalar", lambda: run(noise=[1, 1, 1])),
    (SHAPE, "noise has shape (5, 2), expected (6, 2)", lambda: run(noise=ONES)),
    (SHAPE, "measured has shape (4, 2), expected (nw,) or (steps, nw) = (5, nw)",
        lambda: run(controller=Told(3), measured=ONES[:4])),
    (DATA, "a disturbance is added to the next state: pass a StepMap or a SimulatedPlant",
        lambda: run(Outside(), disturbance=0.1)),
    (SHAPE, "the plant's state has shape (3,), its states name 2; they must agree", lambda: run(Longer())),
    (DATA, "the controller returned u = [nan] at step 0; every input must be finite",
        lambda: run(controller=Says([np.nan]))),
    (SHAPE, "the controller returned u of shape (2,) at step 0, expected (1,)",
        lambda: run(controller=Says([1.0, 2.0]))),
    (DATA, "probability is 1.5; it must be between 0 and 1", lambda: km.faults.NaNSensor(probability=1.5)),
    (DATA, "probability is -0.1; it must be between 0 and 1", lambda: km.faults.DroppedSamples(-0.1)),
    (DATA, "probability is 2; it must be between 0 and 1", lambda: km.faults.SolverFailure(2.0)),
    (DATA, "fraction is 1.1; it must be between 0 and 1", lambda: km.faults.ActuatorLoss(1.1)),
    (DATA, "begin is -1; it must be at least 0", lambda: km.faults.FrozenSensor(begin=-1)),
    (DATA, "end is 5; it must be at least 6", lambda: km.faults.FrozenSensor(begin=5, end=5)),
    (DATA, "steps is -1; it must be at least 0", lambda: km.faults.SensorDelay(-1)),
    (DATA, "steps is -2; it must be at least 0", lambda: km.faults.ActuatorDelay(-2)),
    (DATA, "channels is -1; it must be at least 0", lambda: km.faults.NaNSensor([-1])),
    (DATA, "channels holds 2; pass indices of measurements, 0 to 1", lambda: ramp((km.faults.NaNSensor([0, 2]),))),
    (DATA, "takes a share of the input range, and there is none; pass limits=",
        lambda: ramp((km.faults.ActuatorLoss(0.5),))),
    (SHAPE, "the reference has shape (13, 1), and what it is compared with (13, 2); pass simulate a cost that says what",
        lambda: km.metrics(random_run(np.random.default_rng(4), nr=1))),
    (SHAPE, "reference is for: cost=km.Cost(Q=…, R=…, of=km.State(['v']))", lambda: follow(lambda x: x[1:], "v [m/s]")),
    (SHAPE, "reference is for: cost=km.Cost(Q=…, R=…, of=…)", lambda: follow(lambda x: x[1:] ** 2, "square")),
]  # fmt: skip


@pytest.mark.parametrize(("error", "text", "mistake"), MISTAKES, ids=[text for _, text, _ in MISTAKES])
def test_a_mistake_says_what_was_got_and_what_to_do(error, text, mistake):
    with pytest.raises(error) as caught:
        mistake()
    assert text in str(caught.value)
