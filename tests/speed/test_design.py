"""How long a design from data takes, by the steps of the data."""

import numpy as np
import pytest

import koopmpc as km

pytestmark = [pytest.mark.speed, pytest.mark.filterwarnings("ignore::koopmpc.errors.FitWarning")]


@pytest.mark.parametrize("steps", [2000, 5000])
def test_a_design_of_a_pendulum_with_the_defaults(benchmark, steps) -> None:
    problem = km.load_problem("pendulum")
    plant = km.discretize(problem.dynamics, problem.dt)
    training = problem.training
    data = km.collect(plant, training.x0, training.excitation, episodes=steps // 40, steps=40, rng=0)
    arguments = {"horizon": 20, "reference": np.zeros(data.nx), "workers": 1}
    made = benchmark.pedantic(km.design, (data, problem.cost, problem.limits), arguments, rounds=1)
    benchmark.extra_info["chosen"] = made.best.title
