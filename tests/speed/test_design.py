"""How long a design from data takes, by the steps of the data."""

from time import process_time

import numpy as np
import pytest

import koopmpc as km

pytestmark = [pytest.mark.speed, pytest.mark.filterwarnings("ignore::koopmpc.base.errors.FitWarning")]


def record(name: str, steps: int, each: int) -> tuple[km.Problem, km.Episodes]:
    problem = km.load_problem(name)
    training = problem.training
    plant = km.discretize(problem.dynamics, problem.dt)
    return problem, km.collect(plant, training.x0, training.excitation, episodes=steps // each, steps=each, rng=0)


@pytest.mark.parametrize(
    ("name", "steps", "each", "horizon"),
    [
        ("pendulum", 2000, 40, 20),
        ("pendulum", 5000, 40, 40),
        ("pendulum", 5000, 250, 40),
        ("duffing", 5000, 40, 40),
        ("van_der_pol", 5000, 40, 40),
        ("cart_pole", 5000, 40, 40),
    ],
)
def test_a_design_with_the_defaults(benchmark, name, steps, each, horizon) -> None:
    problem, data = record(name, steps, each)
    arguments = {"horizon": horizon, "reference": np.zeros(data.nx), "workers": 1}
    start = process_time()
    made = benchmark.pedantic(km.design, (data, problem.cost, problem.limits), arguments, rounds=1)
    benchmark.extra_info["CPU [s]"] = process_time() - start
    benchmark.extra_info["chosen"] = made.best.title


@pytest.mark.parametrize("name", ["pendulum", "duffing", "van_der_pol", "cart_pole"])
def test_a_selection_with_the_defaults(benchmark, name) -> None:
    _, data = record(name, 5000, 250)
    start = process_time()
    benchmark.pedantic(km.select, (data,), {"horizon": 40, "workers": 1}, rounds=1)
    benchmark.extra_info["CPU [s]"] = process_time() - start
