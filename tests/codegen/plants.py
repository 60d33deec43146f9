"""Plants and models of these tests, each made once."""

from functools import cache

import casadi as ca
import numpy as np
from scipy.signal import StateSpace

import koopmpc as km

DT = 0.05
PAIR = np.array([[1.0, 0.2], [-0.1, 0.9]]), np.array([[0.02, 0.01], [0.2, -0.1]])
WAVE = np.array([[1.0, 0.1], [-0.1, 0.95]]), np.array([[0.0], [0.1]])


@cache
def make_pendulum():
    """Return the pendulum driven upright: its map, and a model of twelve observables that was fitted in closed loop."""
    problem = km.load_problem("pendulum")
    plant = km.discretize(problem.dynamics, dt=DT)
    data = km.collect(plant, problem.training.x0, problem.training.excitation, episodes=50, steps=40, rng=0)
    return plant, km.edmd(data, problem.lifting)


@cache
def make_past_model():
    """Return a model of the pendulum's present row and the two before."""
    problem = km.load_problem("pendulum")
    data = km.collect(
        make_pendulum()[0], problem.training.x0, problem.training.excitation, episodes=30, steps=40, rng=2
    )
    return km.edmd(data, km.State() + km.Constant(), embedding=km.Delay(2), ridge=1e-6)


@cache
def make_cart():
    """Return a mass that two inputs push, with a measured disturbance, and a model of its past."""
    A, B, E = np.array([[1.0, DT], [0.0, 0.98]]), np.array([[0.0, 0.01], [DT, 0.02]]), np.array([[0.0], [0.03]])

    def plant(x, u, w=0.0):
        return A @ x + B @ u + E @ np.ravel(w) + 0.01 * np.sin(x)

    rng, episodes = np.random.default_rng(3), []
    for _ in range(20):
        U, W, X = rng.uniform(-2, 2, (30, 2)), rng.uniform(-1, 1, (30, 1)), [rng.uniform(-1, 1, 2)]
        for u, w in zip(U, W, strict=True):
            X.append(plant(X[-1], u, w))
        episodes.append(km.Episode(X=np.array(X), U=U, W=W))
    return plant, km.edmd(km.Episodes(episodes, DT), km.State() + km.Constant(), embedding=km.Delay(2), ridge=1e-6)


@cache
def make_swung():
    """Return a pendulum, θ = 0 upright, and a bilinear model of its observables."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    ahead = ca.vertcat(x[0] + DT * x[1], x[1] + DT * (4.9 * ca.sin(x[0]) + 0.5 * u - 0.1 * x[1]))
    plant = km.StepMap(ca.Function("F", [x, u], [ahead]), DT, states=("theta", "omega"), inputs=("torque",))
    start = km.Uniform([-np.pi, -5.0], [np.pi, 5.0])
    data = km.collect(plant, start, km.Noise(-8.0, 8.0), episodes=300, steps=10, rng=0)
    return plant, km.bilinear_edmd(data, km.State() + km.Fourier(2, states=[0]) + km.Constant())


@cache
def make_thousandths():
    """Return that pendulum with its angle in thousandths: sizes differ."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    angle = x[0] / 1000
    ahead = ca.vertcat(x[0] + 50 * x[1], x[1] + DT * (4.9 * ca.sin(angle) + 0.5 * u - 0.1 * x[1]))
    return km.StepMap(ca.Function("F", [x, u], [ahead]), DT, states=("theta", "omega"), inputs=("torque",))


@cache
def make_vehicle():
    """Return a vehicle, which at rest cannot move sideways, of x, y and heading under speed and turn."""
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    ahead = x + DT * ca.vertcat(u[0] * ca.cos(x[2]), u[0] * ca.sin(x[2]), u[1])
    return km.StepMap(ca.Function("F", [x, u], [ahead]), DT)


@cache
def make_pair():
    """Return a linear model of two inputs, and equations in which one of them multiplies a state."""
    (A, B), x, u = PAIR, ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    space = StateSpace(A, B, np.eye(2), np.zeros((2, 2)), dt=0.2)
    bent = ca.Function("F", [x, u], [A @ x + B @ u + 0.1 * u[0] * ca.vertcat(0, x[0])])
    return km.LinearPredictor.from_state_space(space, inputs=("a", "b")), km.StepMap(bent, 0.2)


@cache
def make_wave():
    """Return a linear model whose plans are long."""
    return km.LinearPredictor(*WAVE, np.eye(2), km.State(), 0.1, ("a", "b"), ("u",))


def drive_scheduled(x, u, w):
    """The input counts as w says, and not at all without it; w also moves the state, and multiplies it."""
    return [0.95 * x[0] + 0.1 * x[1] + 0.05 * w[0], 0.9 * x[1] - 0.1 * x[0] + 0.2 * w[0] * u[0] + 0.1 * w[0] * x[0]]


@cache
def make_scheduled():
    """Return the equations of `drive_scheduled`, and a model of its logs."""
    x, u, w, rng, episodes = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w"), np.random.default_rng(3), []
    plant = km.StepMap(ca.Function("F", [x, u, w], [ca.vertcat(*drive_scheduled(x, u, w))]), 0.1)
    for _ in range(8):
        X, U, W = [rng.uniform(-1, 1, 2)], rng.uniform(-1, 1, (25, 1)), rng.uniform(-1, 1, (25, 1))
        for inputs, pushes in zip(U, W, strict=True):
            X.append(drive_scheduled(X[-1], inputs, pushes))
        episodes.append(km.Episode(X=np.array(X), U=U, W=W))
    return plant, km.bilinear_edmd(km.Episodes(episodes, 0.1), km.State() + km.Constant(), scheduled_inputs=True)
