"""Swing-up from data alone: a bilinear model and one linearisation a step, from random starts."""

import numpy as np
import pytest

import koopmpc as km
from tests.tiers import few

NAMES = ["cart_pole_swing", "pendulum_swing"]
SECONDS, HELD = 10.0, 2.0


def starts(nx: int, count: int) -> np.ndarray:
    """θ ~ U[−π, π], θ̇ ~ U[−1, 1], the cart at rest at U[−.5, .5]."""
    rng = np.random.default_rng(0)
    theta, omega = rng.uniform(-np.pi, np.pi, count), rng.uniform(-1, 1, count)
    if nx == 2:
        return np.column_stack([theta, omega])
    return np.column_stack([rng.uniform(-0.5, 0.5, count), np.zeros(count), theta, omega])


def upright(run: km.Run) -> bool:
    """Whether the last 2 s of 10 s are upright and slow, and the cart was on its rail throughout."""
    i = run.states.index("theta [rad]")
    last = run.X[-round(HELD / run.dt) - 1 :]
    held = (np.cos(last[:, i]) > 0.99).all() and (np.abs(last[:, i + 1]) < 0.3).all()
    return bool(held and (i == 0 or (np.abs(run.X[:, 0]) <= 2.4).all()))


class Learned:
    """A problem, its plant, and the bilinear model of its data."""

    def __init__(self, name: str) -> None:
        self.problem = km.load_problem(name)
        self.parts = km.bench.Prepared(self.problem)
        self.model = km.bilinear_edmd(self.parts.data, self.problem.lifting, difference=True)
        self.reference = next(iter(self.problem.cases.values())).reference

    def runs(self, controller, count: int) -> list[km.Run]:
        problem = self.problem
        steps = round(SECONDS / problem.dt)
        return [
            km.simulate(self.parts.step_map, controller, x0=x0, reference=self.reference, steps=steps)
            for x0 in starts(problem.dynamics.nx, count)
        ]

    def bilinear(self) -> km.BilinearMPC:
        problem = self.problem
        return km.BilinearMPC(self.model, problem.cost, problem.limits, problem.horizon)


@pytest.fixture(scope="module", params=few(NAMES, "pendulum_swing"))
def learned(request) -> Learned:
    return Learned(request.param)


def test_the_bilinear_model_swings_up_and_holds(learned: Learned) -> None:
    runs = learned.runs(learned.bilinear(), 6)
    assert all(upright(run) for run in runs)
    for run in runs:
        limit = float(learned.problem.limits.u_max)
        assert np.abs(run.U).max() <= limit
        assert set(run.status) <= {km.Status.UNCONSTRAINED, km.Status.OPTIMAL, km.Status.SOFTENED}


def test_a_linear_model_of_the_same_data_does_not() -> None:
    learned = Learned("cart_pole_swing")
    problem = learned.problem
    linear = km.KoopmanMPC(learned.parts.model, problem.cost, problem.limits, problem.horizon)
    assert sum(upright(run) for run in learned.runs(linear, 2)) == 0


def test_its_first_plan_stays_where_the_model_was_learned() -> None:
    """Half a radian off: a first plan along the free fall, beyond the data, would end in the model's own invention."""
    learned = Learned("cart_pole")
    problem, case = learned.problem, learned.problem.cases["recover"]
    mpc = km.BilinearMPC(learned.model, problem.cost, problem.limits, problem.horizon)
    run = km.simulate(learned.parts.step_map, mpc, x0=case.x0, reference=case.reference, steps=case.steps)
    assert np.abs(run.X[-1] - case.reference).max() < 0.05
    assert np.abs(run.X[:, 2] - np.pi).max() < 0.7


@pytest.mark.slow
def test_at_least_95_of_100_starts_swing_up(learned: Learned) -> None:
    runs = learned.runs(learned.bilinear(), 100)
    assert sum(upright(run) for run in runs) >= 95
