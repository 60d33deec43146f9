"""One pass of the real-time iteration at N = 50: without limits in reach, at the input limits, and the first step."""

import sys
from dataclasses import replace

import numpy as np
import pytest

import koopmpc as km

pytestmark = pytest.mark.speed
N = 50


@pytest.fixture(scope="module")
def parts():
    problem = km.load_problem("cart_pole_swing")
    prepared = km.bench.Prepared(problem)
    return prepared, km.bilinear_edmd(prepared.data, problem.lifting, difference=True)


def report(benchmark, **figures):
    benchmark.extra_info.update(figures)
    said = ", ".join(f"{name} {value:.4g}" for name, value in figures.items())
    sys.stdout.write(f"\n{benchmark.name}: {said}\n")


@pytest.mark.parametrize("rated", [False, True])
def test_swing_up_steps(benchmark, parts, rated):
    """All steps of ten seconds from hanging, by kind; with limits and weights of the input's changes, and without."""
    prepared, model = parts
    problem, plant = prepared.problem, prepared.step_map
    cost, limits = problem.cost, problem.limits
    if rated:
        cost, limits = replace(cost, R_delta=0.01), replace(limits, du_max=3.0)
    mpc = km.BilinearMPC(model, cost, limits, N)
    x = np.array([0.0, 0.0, np.pi, 0.1])
    mpc(x, [0, 0, 0, 1, 0])
    moves = []

    def run():
        mpc.reset()
        state = x
        for _ in range(200):
            move = mpc(state, [0, 0, 0, 1, 0])
            moves.append(move)
            state = plant(state, move.u)

    benchmark.pedantic(run, rounds=5)
    times = 1e3 * np.array([m.solve_time for m in moves])
    limited = np.array([m.iterations > 0 for m in moves])
    report(
        benchmark,
        median_ms=float(np.median(times)),
        limited_median_ms=float(np.median(times[limited])),
        free_median_ms=float(np.median(times[~limited])),
        p99_ms=float(np.percentile(times, 99)),
        first_ms=float(times[0]),
        limited_share=float(limited.mean()),
    )
