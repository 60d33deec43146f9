"""What is no plant or no controller is told what it lacks, and one that writes into the arrays of others moves nothing."""

import numpy as np

import koopmpc as km
from tests.bare import shown
from tests.control.models import step_map
from tests.loop.test_simulate import A, B, Careless, Outside, Recorded, mpc

PARTS = """
import casadi as ca

class Pendulum(km.Dynamics):
    states, inputs = ("theta", "omega"), ("torque",)
    def rhs(self, x, u):
        return ca.vertcat(x[1], u[0])

class Rig:
    def reset(self, x0, rng): return np.zeros(2)
    def step(self, u): return np.zeros(2)

class Push:
    dt, nu, horizon = 0.1, 1, 0
    def reset(self, x0=None, u_prev=None): pass
    def __call__(self, y, reference, applied=None): return np.zeros(1)

plant = km.discretize(Pendulum(), 0.1)
simulate = lambda plant, controller: km.simulate(plant, controller, x0=[0, 0], reference=[0, 0], steps=2)
collect = lambda plant: km.collect(plant, [0, 0], km.Noise(-1, 1), episodes=2, steps=2)
"""


def test_what_cannot_be_driven_says_what_it_lacks():  # the type hook of the tests would say so first
    lines = shown(
        PARTS
        + """
show(lambda: simulate(Rig(), Push()))
show(lambda: collect(Rig()))
show(lambda: simulate(Pendulum(), Push()))
show(lambda: collect(Pendulum()))
"""
    )
    lacks = "DataError the plant is a Rig and has no dt, states, inputs, outputs, state; a Plant has dt [s], "
    first = "DataError the plant is Pendulum, ẋ = f(x, u) without a sample time; discretize it first: "
    assert all(line.startswith(lacks) for line in lines[:2])
    assert all(line.startswith(first) for line in lines[2:])
    assert len(lines) == 4


def test_a_function_of_three_arguments_is_no_controller_and_an_array_no_move():
    lines = shown(
        PARTS
        + """
show(lambda: simulate(plant, lambda y, reference, applied: y))
show(lambda: simulate(plant, Push()))
"""
    )
    assert lines[0].startswith("DataError the function ")
    assert "write def f(y, r), which returns the input u" in lines[0]
    assert lines[1].startswith("DataError what the controller returned is a ndarray and has no u, status, fallback, ")


class Rough(Outside):
    """A plant that shows its own arrays, and writes into what it is given."""

    x = np.zeros(2)

    @property
    def state(self):
        return self.x

    def reset(self, x0, rng):
        self.x = np.array(x0, dtype=float)
        return self.x

    def step(self, u):
        self.x[:] = A @ self.x + B @ u
        u[:] = 1e9
        return self.x


def test_a_plant_that_writes_into_its_input_and_shows_its_own_arrays_moves_neither_loop_nor_record():
    loop = {"x0": [0.5, 0], "reference": [0.2, 0], "steps": 6}
    for controller in (Recorded(), Careless(), mpc()):
        whole = km.simulate(step_map(A, B), controller, **loop)
        moves = []
        rough = km.simulate(
            Rough(), controller, **loop, observers=[lambda step, moves=moves: moves.append(step.move.u)]
        )
        np.testing.assert_array_equal(rough.U, moves)
        for name in ("X", "Y", "U"):
            np.testing.assert_allclose(getattr(rough, name), getattr(whole, name), atol=1e-12)
