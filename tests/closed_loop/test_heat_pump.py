"""A task with measured weather: a heat pump under controllers that learned with W, without W, and on its equations."""

import numpy as np
import pytest

import koopmpc as km
from tests.searches import select

pytestmark = pytest.mark.slow

DT, HORIZON, STEPS = 0.5, 48, 192  # hours, a day, four days
COST = km.Cost(Q={"room": 1.0}, R=0.02, of=km.State("room"), u_target="zero")
LIMITS = km.Limits(u_min=0.0, u_max=4.0)
AFFINE = km.State() + km.Constant()
CURVED = AFFINE + km.Monomials(2)


def make_weather(seed: int, steps: int) -> np.ndarray:
    """A day's swing on a random mean, and fronts that wander: (steps, 1) temperatures."""
    rng, t = np.random.default_rng(seed), DT * np.arange(steps)
    fronts = np.cumsum(rng.normal(0.0, 0.5, steps))
    day = rng.uniform(2, 7) * np.sin(2 * np.pi * (t - 9 + rng.uniform(-2, 2)) / 24)
    return (rng.uniform(-8, 10) + day + fronts)[:, None]


@pytest.fixture(scope="module")
def plant():
    return km.discretize(km.load_problem("heat_pump").dynamics, DT)


@pytest.fixture(scope="module")
def logs(plant):
    W = np.array([make_weather(100 + i, 96) for i in range(20)])
    start, excitation = km.Uniform([17, 20], [24, 32]), km.Noise(0, 4, hold=6)
    return km.collect(plant, start, excitation, episodes=20, steps=96, measured=W)


@pytest.fixture(scope="module")
def blind(logs):
    return km.Episodes([km.Episode(X=e.X, U=e.U) for e in logs], DT, logs.states, logs.inputs)


def spend(plant, controller, seed, **options):
    """The cost of four days; every step has a plan."""
    task = {"x0": [20, 24], "reference": [21.0], "steps": STEPS, "cost": COST, "limits": LIMITS}
    run = km.simulate(plant, controller, measured=make_weather(seed, STEPS), **task, **options)
    assert {each.name for each in run.fallback} == {"NONE"}
    return km.metrics(run).cost


@pytest.mark.parametrize("seed", [11, 12, 13])
def test_learned_with_the_weather_it_costs_what_the_equations_cost(plant, logs, blind, seed, record_property):
    best = spend(plant, km.NonlinearMPC(plant, COST, LIMITS, HORIZON), seed)

    def ratio(data, lifting, estimator=None, preview=True, **options):
        model = km.bilinear_edmd(data, lifting, **options)
        mpc = km.BilinearMPC(model, COST, LIMITS, HORIZON, estimator=estimator)
        return spend(plant, mpc, seed, preview=preview) / best

    told = ratio(logs, CURVED, scheduled_inputs=True)
    plain = ratio(logs, CURVED)  # without the products of compressor and weather
    now_only = ratio(logs, CURVED, scheduled_inputs=True, preview=False)
    without = min(ratio(blind, AFFINE), ratio(blind, AFFINE, km.LiftedDisturbance()))
    record_property("cost over NonlinearMPC on the equations", [told, plain, now_only, without])
    assert told <= 1.05
    assert told <= 1.001 * plain
    assert told <= 0.98 * now_only
    assert told <= 0.9 * without


def test_what_select_takes_from_logs_with_the_weather_beats_all_without(plant, logs, blind, record_property):
    costs = []
    for data in (logs, blind):
        found = select(data, horizon=HORIZON, workers=1)
        mpc = km.BilinearMPC(found.bilinear, COST, LIMITS, HORIZON)
        costs.append(sum(spend(plant, mpc, seed) for seed in (11, 12)))
    best = sum(spend(plant, km.BilinearMPC(plant, COST, LIMITS, HORIZON), seed) for seed in (11, 12))
    record_property("select with W, without, exact", [*costs, best])
    assert costs[0] <= 1.05 * best
    assert costs[0] <= 0.7 * costs[1]
