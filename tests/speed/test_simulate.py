"""simulate against a bare loop of its controller and its plant, without plans and with them, in interleaved runs."""

import sys
import time

import numpy as np
import pytest

import koopmpc as km
from tests.gathered import of_loop

pytestmark = pytest.mark.speed

STEPS, ROUNDS = 500, 200


def test_a_simulated_step_against_controller_and_plant_alone(benchmark):
    problem = km.load_problem("pendulum")
    plant = km.discretize(problem.dynamics, 0.05)
    excitation = km.Feedback([[40, 15]], km.Noise(-20, 20), u_min=-25, u_max=25)
    data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), excitation, episodes=20, steps=60)
    model = km.edmd(data, km.State() + km.Fourier(2, states="theta") + km.Constant())
    mpc = km.KoopmanMPC(model, km.Cost(Q=[10, 1], R=0.1), km.Limits(-30, 30), 20)
    ahead = np.zeros((21, 2))

    def bare():
        mpc.reset([0.1, 0.0])
        x, u = np.array([0.1, 0.0]), None
        for _ in range(STEPS):
            u = mpc(x, ahead, u).u
            x = plant(x, u)

    def simulated(**more):
        return km.simulate(plant, mpc, x0=[0.1, 0.0], reference=[0.0, 0.0], steps=STEPS, **of_loop(**more))

    loops = {
        "bare": bare,
        "simulate": simulated,
        "with plans": lambda: simulated(plans=True),
        "an observer that asks for no plan": lambda: simulated(observers=[lambda step: None]),
    }
    times = {name: [] for name in loops}
    for _ in range(ROUNDS):
        for name, loop in loops.items():
            start = time.perf_counter()
            loop()
            times[name].append(time.perf_counter() - start)
    least = {name: min(found) for name, found in times.items()}
    figures = {f"{name} / bare": least[name] / least["bare"] for name in loops if name != "bare"}
    benchmark.extra_info.update(figures)
    sys.stdout.write("\n" + ", ".join(f"{name} {value:.3g}" for name, value in figures.items()) + "\n")
    benchmark.pedantic(simulated, rounds=20)
