"""Random closed loops of BilinearMPC: soft limits of states, references beyond them, models that are wrong."""

from collections import Counter
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.compiler import avoid_compiling, needs_compiler

FALLBACKS = ("FAILED", "MAX_ITERATIONS", "INFEASIBLE")


@dataclass(frozen=True)
class Oscillator(km.Dynamics):
    """x₁' = x₂, x₂' = a x₁ − b x₁³ + c sin x₁ − d x₂ + u: unstable at zero, as a Duffing oscillator or a pendulum."""

    states = ("x1", "x2")
    inputs = ("u",)
    a: float = 1.0
    b: float = 1.0
    c: float = 0.0
    d: float = 0.3

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """Return [x₁', x₂']."""
        return ca.vertcat(x[1], self.a * x[0] - self.b * x[0] ** 3 + self.c * ca.sin(x[0]) - self.d * x[1] + u)


PLANTS = [
    km.discretize(dynamics, dt)
    for dynamics in (Oscillator(), Oscillator(a=0.0, b=0.0, c=4.9, d=0.1))
    for dt in (0.05, 0.1)
]


def learned(plant: km.StepMap, seed: int, noise: float, degree: int, episodes: int) -> km.BilinearPredictor:
    """Return a bilinear model of a few episodes, whose error leaves the state a hair beyond its limits."""
    starts, excitation = km.Uniform([-1.2, -1.5], [1.2, 1.5]), km.Noise(-3.0, 3.0, hold=3)
    data = km.collect(plant, starts, excitation, episodes=episodes, steps=30, rng=seed)
    rng = np.random.default_rng(seed)
    noisy = [km.Episode(X=e.X + noise * rng.standard_normal(e.X.shape), U=e.U) for e in data]
    return km.bilinear_edmd(
        km.Episodes(noisy, data.dt, data.states, data.inputs),
        km.State() + km.Constant() + km.Monomials(degree),
        ridge=1e-9,
    )


@pytest.fixture(scope="module")
def models() -> list[list[km.StepMap | km.BilinearPredictor]]:
    return [[plant, learned(plant, 0, 0.0, 5, 15), learned(plant, 1, 0.02, 4, 10)] for plant in PLANTS]


def statuses(trial: int, models: list[list[km.StepMap | km.BilinearPredictor]]) -> Counter[str]:
    """Return how the 40 steps of a random loop end; every input is inside its limits."""
    rng = np.random.default_rng(trial)
    which = int(rng.integers(len(PLANTS)))
    model = models[which][int(rng.integers(3))]
    x_max, u_max, v = rng.uniform(0.1, 0.9), 10.0 ** rng.uniform(-0.3, 1), rng.choice([np.inf, 0.5, 1.0])
    reference = [x_max + 10.0 ** rng.uniform(-2, 0.3), 0.0]
    target = str(rng.choice(["zero", "equilibrium"]))
    cost = km.Cost(Q=10.0 ** rng.uniform(-1, 3, 2), R=10.0 ** rng.uniform(-3, 0), u_target=target)
    limits = km.Limits(-u_max, u_max, x_max=[x_max, v], x_min=[-np.inf, -v])
    mpc = km.BilinearMPC(model, cost, limits, int(rng.integers(5, 40)))
    x, count = rng.uniform([-0.5, -0.5], [0.9 * x_max, 0.5]), Counter()
    for _ in range(40):
        move = mpc(x, reference)
        assert np.abs(move.u).max() <= u_max
        count[move.status.name] += 1
        x = PLANTS[which](x, move.u)
    return count


@pytest.mark.parametrize("trials", [range(10), pytest.param(range(300), marks=pytest.mark.slow)])
def test_a_soft_limit_or_a_reference_beyond_it_is_no_reason_to_fail(models, trials, monkeypatch) -> None:
    avoid_compiling(monkeypatch)
    count = sum((statuses(trial, models) for trial in trials), Counter())
    assert not any(count[name] for name in FALLBACKS), count
    assert count["SOFTENED"] > 0


@dataclass(frozen=True)
class CubeAndRoot(km.Dynamics):
    """x₁' = x₁³ − x₁ + u, x₂' = √(1 + x₂) − 1 + u: x₁ grows beyond all numbers, and x₂ is none below −1."""

    states = ("x1", "x2")
    inputs = ("u",)

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """Return [x₁', x₂']."""
        return ca.vertcat(x[0] ** 3 - x[0] + u, ca.sqrt(1 + x[1]) - 1 + u)


@needs_compiler
def test_a_reading_from_which_the_model_runs_away_is_a_bad_measurement_and_no_failed_step() -> None:
    """From 50 a cube leaves all numbers within ten steps, whatever an input of 2 does; a root is NaN before."""
    plant = km.discretize(CubeAndRoot(), 0.05)
    mpc = km.BilinearMPC(plant, km.Cost(Q=[10.0, 1.0], R=0.1), km.Limits(-2, 2, x_max=[0.5, 1.0]), 15)
    for controller in (mpc, km.compiled(mpc)):
        controller([0.1, 0.0], [0.3, 0.0])
        planned = controller.plan().U[1]
        for y in ([50.0, 0.0], [-1e6, 0.1], [1e29, 0.0]):
            move = controller(y, [0.3, 0.0])
            assert move.status is km.Status.BAD_MEASUREMENT, y
            assert np.abs(move.u).max() <= 2
            if y[0] == 50.0:
                assert move.fallback is km.control.Fallback.SHIFTED_PLAN
                np.testing.assert_array_equal(move.u, planned)
        assert controller([2.0, -2.0], [0.3, 0.0]).status is km.Status.FAILED  # the model has no answer there
        assert controller([0.1, 0.0], [0.3, 0.0]).status.name in ("OPTIMAL", "SOFTENED", "UNCONSTRAINED")
    mpc.solver_fails = True
    assert mpc([50.0, 0.0], [0.3, 0.0]).status is km.Status.FAILED  # a fault that is made keeps its name


def test_a_step_that_finds_no_plan_forgets_the_disturbance() -> None:
    cost, limits = km.Cost(Q=[10.0, 1.0], R=0.1), km.Limits(-2, 2, x_max=[0.5, 1.0])
    mpc = km.BilinearMPC(PLANTS[1], cost, limits, 10, estimator=km.LiftedDisturbance())
    mpc([0.1, 0.0], [0.3, 0.0])
    mpc.observer._gate.judge = lambda y, predicted: False  # it would find such a prediction absurd
    mpc.observer.d[:], mpc.observer._stood_in = [0.0, 1e3], True  # so that the next reading does not change d
    assert mpc([0.1, 0.0], [0.3, 0.0]).status is km.Status.FAILED
    assert not mpc.observer.d.any()
    assert mpc([0.1, 0.0], [0.3, 0.0]).status.name in ("OPTIMAL", "SOFTENED", "UNCONSTRAINED")
    mpc.observer.d[:], mpc.solver_fails, mpc.observer._stood_in = 1e-3, True, True
    assert mpc([0.1, 0.0], [0.3, 0.0]).status is km.Status.FAILED
    assert mpc.observer.d.all()  # a fault that is made says nothing of d


@pytest.mark.parametrize("case", ["hang", pytest.param("aside", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["cart_pole_swing", "pendulum_swing"])
def test_a_swing_up_on_given_equations_costs_what_nonlinear_mpc_costs(name: str, case: str) -> None:
    """Under the slack weights (1e4, 1e2): as they change, ipopt ends in plans of 272, 475 or 518 from one start."""
    problem = km.load_problem(name)
    limits = replace(problem.limits, slack=(1e4, 1e2))
    plant, asked = km.discretize(problem.dynamics, problem.dt, problem.integrator), problem.cases[case]
    cost = []
    for kind in (km.BilinearMPC, km.NonlinearMPC):
        mpc = kind(plant, problem.cost, limits, problem.horizon)
        run = km.simulate(
            plant,
            mpc,
            x0=asked.x0,
            reference=asked.reference,
            steps=asked.steps,
            cost=problem.cost,
            limits=limits,
        )
        cost.append(km.metrics(run).cost)
    assert cost[0] <= 1.10 * cost[1]


@pytest.mark.parametrize("kind", [km.BilinearMPC, km.NonlinearMPC])
def test_a_trajectory_that_comes_with_its_inputs_is_followed_exactly(kind: type) -> None:
    plant = PLANTS[0]
    U = np.sin(np.arange(40.0))[:, None]
    X = plant.rollout([0.1, 0.0], U)
    mpc = kind(plant, km.Cost(Q=[10.0, 1.0], R=0.1, u_target=U), horizon=10)
    for _ in range(2):  # a reset begins at the first row again
        run = km.simulate(plant, mpc, x0=X[0], reference=X, steps=40)
        assert np.abs(run.X[:30] - X[:30]).max() < 1e-7
        assert np.abs(run.U[:28] - U[:28]).max() < 1e-6


@pytest.mark.parametrize("R_delta", [None, 0.1])
@pytest.mark.parametrize("kind", [km.BilinearMPC, km.NonlinearMPC])
def test_given_inputs_of_zero_are_the_target_zero(kind: type, R_delta: float | None) -> None:
    inputs = []
    for target in ("zero", [0.0], np.zeros((5, 1))):
        mpc = kind(PLANTS[0], km.Cost(Q=[10.0, 1.0], R=0.1, R_delta=R_delta, u_target=target), km.Limits(-2, 2), 10)
        inputs.append(km.simulate(PLANTS[0], mpc, x0=[0.5, 0.0], reference=[0.3, 0.0], steps=10).U)
    np.testing.assert_array_equal(inputs[1], inputs[0])
    np.testing.assert_array_equal(inputs[2], inputs[0])
