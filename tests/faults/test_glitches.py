"""One bad sample has no echo: the next good one is answered, and learned from, as if it had not been."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import koopmpc as km

PENDULUM = km.load_problem("pendulum")
PLANT = km.discretize(PENDULUM.dynamics, 0.05)
LIFTING = km.State() + km.Fourier(1, states=[0]) + km.Constant()


@pytest.fixture(scope="module")
def bilinear():
    data = km.collect(PLANT, km.Uniform([-1, -1], [1, 1]), km.Noise(-8, 8), episodes=60, steps=30)
    return km.bilinear_edmd(data, LIFTING)


@pytest.mark.parametrize("kind", ["learned", "given"])
def test_the_step_after_a_glitch_is_that_of_a_controller_that_never_saw_it(bilinear, kind):
    controller = km.BilinearMPC(
        bilinear if kind == "learned" else PLANT, PENDULUM.cost, km.Limits(u_min=-10, u_max=10), 20
    )
    fresh = km.BilinearMPC(controller.model, PENDULUM.cost, controller.limits, 20)
    rng = np.random.default_rng(0)
    for _ in range(6):
        x = 0.2 * rng.standard_normal(2)
        controller.reset(x)
        for _ in range(5):
            u = controller(x, [0.0, 0.0]).u
            x = PLANT(x, u)
        u = controller(x + 50 * rng.standard_normal(2), [0.0, 0.0]).u
        x = PLANT(x, u)
        fresh.reset(x, u)
        assert np.allclose(controller(x, [0.0, 0.0]).u, fresh(x, [0.0, 0.0]).u, atol=0.1)


def pairs(plant, count, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        x, u = rng.uniform(-1, 1, 2), rng.uniform(-3, 3, 1)
        yield x, u, plant(x, u)


def online():
    return km.OnlineEDMD(LIFTING, dt=0.05, states=PLANT.states, inputs=PLANT.inputs, forgetting=0.99)


def worst(model, plant):
    return max(np.abs(model.step_map()(x, u) - x_next).max() for x, u, x_next in pairs(plant, 50, seed=1))


@pytest.mark.parametrize("size", [50.0, 1e5])
@pytest.mark.parametrize("where", ["x", "x_next", "both"])
def test_an_outlier_is_not_learned_and_is_counted(size, where):
    learner, twin = online(), online()
    for k, (x, u, x_next) in enumerate(pairs(PLANT, 400)):
        if k == 300:
            learner.learn(x + size * (where != "x_next"), u, x_next + size * (where != "x"))
        else:
            learner.learn(x, u, x_next)
            twin.learn(x, u, x_next)
    assert (learner.outliers, twin.outliers) == (1, 0)
    assert learner.pairs == twin.pairs == 399
    assert "1 pairs were outliers" in learner.predictor().report.route
    assert worst(learner.predictor(), PLANT) == pytest.approx(worst(twin.predictor(), PLANT), rel=0.2)


@pytest.mark.parametrize(("size", "outliers"), [(0.29, 0), (0.31, 1)])
def test_where_forecasts_are_exact_the_gate_is_thirty_percent_of_what_the_column_is_itself(size, outliers):
    """30 spreads, which count as at least 1 % of the column's root-mean-square."""
    A, B = np.array([[0.9, 0.2], [-0.2, 0.8]]), np.array([[0.5], [1.0]])
    learner = km.OnlineEDMD(km.State(), dt=0.05, states=("a", "b"), inputs=("u",), forgetting=0.99)
    rng = np.random.default_rng(0)
    X, U = rng.choice([-1.0, 1.0], (1001, 2)), rng.uniform(-1, 1, (1001, 1))
    X_next = X @ A.T + U @ B.T
    rms = np.sqrt(np.mean(X_next[:, 0] ** 2))
    learner.learn(X[:-1], U[:-1], X_next[:-1])
    assert learner.outliers == 0
    learner.learn(X[-1], U[-1], X_next[-1] + [size * rms, 0.0])
    assert learner.outliers == outliers


@pytest.mark.parametrize("at", [0, 3, 19, 25, 32, 40, 60])  # memory of 32 pairs a block, forecasts from some 60 on
@pytest.mark.parametrize("where", ["x", "x_next", "both"])
def test_an_outlier_before_there_are_forecasts_is_not_learned_either(at, where):
    learner, twin = online(), online()
    for k, (x, u, x_next) in enumerate(pairs(PLANT, 300)):
        if k == at:
            learner.learn(x + 1e5 * (where != "x_next"), u, x_next + 1e5 * (where != "x"))
        else:
            learner.learn(x, u, x_next)
            twin.learn(x, u, x_next)
    assert (learner.outliers, twin.outliers) == (1, 0)
    assert worst(learner.predictor(), PLANT) == pytest.approx(worst(twin.predictor(), PLANT), rel=0.2)


def test_what_a_plant_really_does_is_no_outlier_before_there_are_forecasts():
    learner, rng = online(), np.random.default_rng(0)
    for k in range(26):  # a first step of the input after a long rest
        x, u = np.array([0.3, 0.0]) + 0.005 * rng.standard_normal(2), np.array([5.0 if k == 25 else 1e-5])
        learner.learn(x, u, PLANT(x, u))
    for x, u, x_next in pairs(PLANT, 200):
        learner.learn(x, u, x_next)
    assert learner.outliers == 0


def test_signals_that_grow_for_good_are_learned_before_there_are_forecasts():
    learner, twin = online(), online()
    for k, (x, u, x_next) in enumerate(pairs(PLANT, 300)):
        size = 1e-4 if k < 30 else 1.0
        learner.learn(size * x, size * u, PLANT(size * x, size * u))
        twin.learn(x, u, x_next)
    assert learner.outliers < 10
    assert worst(learner.predictor(), PLANT) < 1.2 * worst(twin.predictor(), PLANT)


def test_a_plant_that_has_changed_is_learned_all_the_same():
    heavy = km.discretize(replace(PENDULUM.dynamics, m=8 * PENDULUM.dynamics.m), 0.05)
    learner = online()
    for plant in (PLANT, heavy):
        for x, u, x_next in pairs(plant, 1200):
            learner.learn(x, u, x_next)
    assert worst(learner.predictor(), heavy) < 0.1 * worst(learner.predictor(), PLANT)
    assert learner.outliers < 30


class Drift(km.Dynamics):
    """Two integrators that no input within the limits brings to rest."""

    states, inputs = ("x", "v"), ("u",)

    def rhs(self, x, u):
        return ca.vertcat(x[1], 5.0 + u[0])


def test_a_plant_without_an_equilibrium_inside_its_limits_is_controlled_by_the_reference_alone():
    plant = km.discretize(Drift(), 0.1)
    controller = km.BilinearMPC(plant, km.Cost(Q=[1.0, 1.0], R=0.1), km.Limits(u_min=-1, u_max=1), 10)
    moves = [controller([0.1 * k, 0.5], [0.0, 0.0]) for k in range(3)]
    assert all(move.u[0] == pytest.approx(-1.0, abs=1e-3) for move in moves)  # it holds against the drift


@pytest.mark.parametrize("begin", [10, 200])  # before there are forecasts, and after
@pytest.mark.parametrize("size", [50.0, 1e5])
def test_a_burst_of_bad_readings_that_was_learned_is_left_behind(begin, size):
    learner, twin, rng = online(), online(), np.random.default_rng(0)
    for k, (x, u, x_next) in enumerate(pairs(PLANT, 2300)):
        bad = size * rng.standard_normal((2, 2)) if begin <= k < begin + 25 else np.zeros((2, 2))
        learner.learn(x + bad[0], u, x_next + bad[1])
        twin.learn(x, u, x_next)
    assert worst(learner.predictor(), PLANT) < 2 * worst(twin.predictor(), PLANT)


def test_a_plant_at_rest_keeps_its_model():
    learner, rng = online(), np.random.default_rng(0)
    for x, u, x_next in pairs(PLANT, 300):
        learner.learn(x, u, x_next)
    before = worst(learner.predictor(), PLANT)
    for _ in range(5000):
        x, u = 1e-4 * rng.standard_normal(2), 1e-4 * rng.standard_normal(1)
        learner.learn(x, u, PLANT(x, u))
    assert worst(learner.predictor(), PLANT) < 2 * before
