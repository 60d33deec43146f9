"""What is no plant or no controller is told what it lacks; the type hook of the tests would say so first."""

from tests.bare import shown

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


def test_what_cannot_be_driven_says_what_it_lacks():
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
