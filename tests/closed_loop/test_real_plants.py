"""Tasks with what real plants ask for, on two tanks: learned controllers beside NonlinearMPC on the equations.

Each task asks for one thing; measured disturbances have a plant of their own, in `test_heat_pump`.
"""

from dataclasses import replace

import numpy as np
import pytest

import koopmpc as km
from tests.gathered import of_loop

pytestmark = pytest.mark.slow

PROBLEM = km.load_problem("two_tanks")
PLANT = km.discretize(PROBLEM.dynamics, PROBLEM.dt, PROBLEM.integrator)
LIFTING = km.State() + km.Constant() + km.Monomials(2)
COST = replace(PROBLEM.cost, R=0.1)
BOX = km.Limits(u_min=0.0, u_max=10.0, x_min=[0.0, 8.0], x_max=[20.0, 20.0])
REST = PROBLEM.equilibrium
STEPS, HORIZON = 60, 20


@pytest.fixture(scope="module")
def logs():
    return km.collect(PLANT, km.Uniform([3.0, 5.0], [16.0, 16.0]), km.Noise(0, 10, hold=4), episodes=40, steps=30)


@pytest.fixture(scope="module")
def linear(logs):
    return km.edmd(logs, km.State() + km.Constant())


@pytest.fixture(scope="module")
def model(logs):
    return km.bilinear_edmd(logs, LIFTING)


def drive(mpc, cost=COST, limits=BOX, x0=REST[0], **options):
    """The run, and its cost."""
    task = {"reference": [10.0], "steps": STEPS, "cost": cost, "limits": limits}
    run = km.simulate(PLANT, mpc, x0=x0, **task, **of_loop(**options))
    return run, km.metrics(run).cost


def compare(mpc, cost=COST, limits=BOX, x0=(4.0, 8.5), **options):
    """The run, its cost, and its cost over that of NonlinearMPC on the equations."""
    best = drive(km.NonlinearMPC(PLANT, cost, limits, HORIZON), cost, limits, x0, **options)[1]
    run, spent = drive(mpc, cost, limits, x0, **options)
    return run, spent, spent / best


def test_limits_in_time_a_pump_in_maintenance(model, linear):
    u_max = np.full((STEPS + 1, 1), 10.0)
    u_max[20:32] = 1.0
    limits = replace(BOX, u_max=u_max)
    told = {"estimator": km.LiftedDisturbance()}
    for mpc in (km.BilinearMPC(model, COST, limits, HORIZON), km.KoopmanMPC(linear, COST, limits, HORIZON, **told)):
        run, _, ratio = compare(mpc, limits=limits)
        assert run.U[20:32].max() <= 1.0
        assert run.X[10:, 1].min() > 7.98
        assert ratio < 1.1


def test_on_and_off(linear, model):
    limits = km.Limits(levels={"pump": [0, 5]}, dwell={"pump": (2, 2)}, x_min=0)
    for mpc in (km.KoopmanMPC(linear, COST, limits, 8), km.BilinearMPC(model, COST, limits, 8)):
        run, spent = drive(mpc, limits=limits, x0=[4.0, 6.0])
        best = drive(km.NonlinearMPC(PLANT, COST, limits, 8), limits=limits, x0=[4.0, 6.0])[1]
        assert set(np.unique(run.U)) <= {0.0, 5.0}
        assert spent / best < 1.1


def test_a_tariff(linear, model):
    tariff = np.where(np.arange(STEPS) % 30 < 15, 0.02, 0.4)[:, None]
    cost = km.Cost(Q=0.01, R=0.01, of=km.State("lower"), price=tariff)
    plain = drive(km.KoopmanMPC(linear, replace(cost, price=None), BOX, HORIZON), cost)[1]
    for mpc in (km.KoopmanMPC(linear, cost, BOX, HORIZON), km.BilinearMPC(model, cost, BOX, HORIZON)):
        _, spent, ratio = compare(mpc, cost)
        assert ratio < 1.1
        assert spent < plain


def test_a_stage_cost(model):
    cost = km.Cost(
        Q=0.002, R=0.001, of=km.State("lower"), stage=lambda x, u: 0.004 * u[0] * (2 + x[0]) + 2e-4 * u[0] ** 3
    )
    plain = drive(km.BilinearMPC(model, replace(cost, stage=None), BOX, HORIZON), cost, x0=[6.0, 12.0])[1]
    _, spent, ratio = compare(km.BilinearMPC(model, cost, BOX, HORIZON), cost, x0=[6.0, 12.0])
    assert ratio < 1.1
    assert spent < plain


def test_which_limit_gives_way(linear):
    ends = {}
    for first in ("lower", "upper"):
        limits = km.Limits(u_min=0, u_max=10, x_min={"lower": 9}, x_max={"upper": 5}, priority={first: 1})
        mpc = km.KoopmanMPC(linear, COST, limits, HORIZON, estimator=km.LiftedDisturbance())
        ends[first] = drive(mpc, limits=limits, x0=[4.0, 6.0])[0].X[-1]
    assert ends["lower"][1] > 8.99
    assert ends["upper"][0] < 5.01


def test_blocks_of_held_inputs(linear):
    told = km.LiftedDisturbance()
    mpc = km.KoopmanMPC(linear, COST, BOX, HORIZON, moves={"pump": (1, 1, 2, 4, 12)}, estimator=told)
    assert compare(mpc)[2] < 1.1


def test_manual_then_automatic(linear):
    u = REST[1]
    x = PLANT.rollout(REST[0], np.tile(u, (3000, 1)))[-1]
    mpc = km.KoopmanMPC(linear, COST, BOX, HORIZON, estimator=km.LiftedDisturbance())
    pid = km.control.PID.tune(linear, COST, BOX, bias=u)
    station = km.supervise.Station(mpc, pid, limits=km.Limits(u_min=0.0, u_max=10.0), mode="manual", hand=u)
    modes = {100: "automatic", 200: "standby", 300: "automatic"}
    observers = [lambda step: station.switch(modes[step.k]) if step.k in modes else None]
    run = km.simulate(PLANT, station, x0=x, reference=x[1:], steps=400, cost=COST, observers=observers)
    assert np.ptp(run.U) < 1e-6
    assert set(run.actor) == {"manual", "automatic", "standby"}


def test_a_slow_sensor(logs):
    rows = [episode.X.copy() for episode in logs]
    for X in rows:
        X[np.arange(len(X)) % 10 > 0, 0] = np.nan
    data = km.data.PartialEpisodes(X=rows, U=[e.U for e in logs], dt=logs.dt, states=logs.states, inputs=logs.inputs)
    known = km.identify.unequal_rates(data, km.State() + km.Constant())
    assert compare(km.KoopmanMPC(known, COST, BOX, HORIZON, estimator=km.LiftedDisturbance()))[2] < 1.1


def test_a_disturbance_that_repeats_itself(linear, model):
    wave = 0.2 * np.sin(2 * np.pi * np.arange(400) * PROBLEM.dt / 90)
    draw = np.stack([wave, 0 * wave], axis=1)
    cost, errors = km.Cost(Q=1.0, R=1e-3, of=km.State("lower")), {}
    for kind, learned in ((km.KoopmanMPC, linear), (km.BilinearMPC, model)):
        for told in (km.LiftedDisturbance(), km.LiftedDisturbance(period=90.0)):
            mpc = kind(learned, cost, BOX, HORIZON, estimator=told)
            run = km.simulate(
                PLANT,
                mpc,
                x0=REST[0],
                reference=[10.0],
                steps=400,
                cost=cost,
                options=km.loop.LoopOptions(disturbance=draw),
            )
            errors[kind, told.period] = np.abs(run.X[-100:, 1] - 10).max()
        assert errors[kind, 90.0] < 0.3 * errors[kind, None]
