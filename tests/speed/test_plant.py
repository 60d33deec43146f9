"""Million RK4 cart-pole steps a second in batches, and one step alone."""

import os
import shlex
import shutil
import time

import numpy as np
import pytest

import koopmpc as km
from tests.example_plants import CartPole

pytestmark = pytest.mark.speed
EPISODES, STEPS = 5000, 200
COMPILERS = (*shlex.split(os.environ.get("CC", ""))[:1], "cc", "gcc", "clang")


@pytest.fixture(scope="module")
def plant():
    return km.discretize(CartPole(), 0.02)


@pytest.fixture(scope="module")
def episodes():
    rng = np.random.default_rng(0)
    return rng.normal(size=(EPISODES, 4)), 5 * rng.normal(size=(EPISODES, STEPS, 1))


def report(benchmark, unit, value):
    benchmark.extra_info[unit] = value


@pytest.mark.skipif(not any(map(shutil.which, COMPILERS)), reason="no C compiler here")
def test_batch_in_machine_code(benchmark, plant, episodes):
    plant.rollouts(*episodes)  # compile
    benchmark.pedantic(plant.rollouts, episodes, rounds=7, warmup_rounds=2)
    report(benchmark, "million steps/s", EPISODES * STEPS / benchmark.stats.stats.median / 1e6)


def test_batch_over_columns_where_there_is_no_compiler(benchmark, plant, episodes, monkeypatch):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", "")
    fresh = km.StepMap(plant.F, plant.dt)
    benchmark.pedantic(fresh.rollouts, episodes, rounds=5, warmup_rounds=1)
    report(benchmark, "million steps/s", EPISODES * STEPS / benchmark.stats.stats.median / 1e6)


def test_one_step(benchmark, plant):
    x, u = np.array([0.0, 0.3, 0.0, 0.0]), np.array([1.0])
    benchmark(plant, x, u)
    report(benchmark, "µs a step", benchmark.stats.stats.median * 1e6)


def test_one_step_in_a_rollout(benchmark, plant, episodes):
    X0, U = episodes
    long = U[:50].reshape(-1, 1)
    benchmark.pedantic(plant.rollout, (X0[0], long), rounds=7, warmup_rounds=1)
    report(benchmark, "µs a step", benchmark.stats.stats.median / len(long) * 1e6)


def test_linearization_against_one_step(benchmark, plant):
    x, u = np.array([0.0, 0.3, 0.0, 0.0]), np.array([1.0])
    plant.linearize(x, u)

    def both():
        start = time.perf_counter()
        plant(x, u)
        middle = time.perf_counter()
        plant.linearize(x, u)
        return (time.perf_counter() - middle) / (middle - start)

    ratio = float(np.median([both() for _ in range(500)]))
    benchmark(plant.linearize, x, u)
    report(benchmark, "× one step", ratio)
