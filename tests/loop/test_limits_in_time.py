"""Limits in time in a run: judged row by row, kept in its log, and drawn as they were."""

import numpy as np
import pytest

import koopmpc as km

STEPS = 60
U_MAX = np.where(np.arange(STEPS + 1) < 30, 25.0, 6.0)[:, None]
LIMITS = km.Limits(
    u_min=-25, u_max=U_MAX, x_max=np.column_stack([np.linspace(0.9, 0.2, STEPS + 1), np.full(61, np.inf)])
)
COST = km.Cost(Q=[10, 1], R=0.1)


@pytest.fixture(scope="module")
def plant():
    return km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)


@pytest.fixture(scope="module")
def run(plant):
    mpc = km.LinearMPC(plant, [0, 0], [0], COST, LIMITS, horizon=15)
    return km.simulate(plant, mpc, x0=[0.5, 0.0], reference=[0.15, 0], steps=STEPS, cost=COST, limits=LIMITS)


def test_metrics_judge_each_step_by_its_row(plant, run):
    found = km.metrics(run)
    assert found.input_violation == 0
    over = np.maximum(run.X[1:, 0] - LIMITS.x_max[1:, 0], 0).max()
    assert found.violation == pytest.approx(over, abs=1e-15)
    free = km.LinearMPC(plant, [0, 0], [0], COST, LIMITS.base, horizon=15)
    other = km.simulate(plant, free, x0=[1.5, 0.0], reference=[0.5, 0], steps=STEPS, cost=COST, limits=LIMITS)
    judged = km.metrics(other)
    assert judged.violation == pytest.approx((other.X[1:, 0] - LIMITS.x_max[1:, 0]).max())
    assert judged.input_violation == pytest.approx(max((other.U - U_MAX[:STEPS]).max(), 0.0))
    assert judged.violation_share > 0


def test_a_log_keeps_the_rows(run, tmp_path):
    km.record(run, tmp_path / "run.rrd")
    again = km.load_run(tmp_path / "run.rrd")
    assert again == run
    assert km.metrics(again).violation == km.metrics(run).violation


def test_figures_draw_the_rows(run):
    figure = km.plot.run(run)
    lines = [line for axes in figure.axes for line in axes.get_lines() if line.get_label() == "limit"]
    assert any(np.array_equal(np.asarray(line.get_ydata(), float), U_MAX[:STEPS, 0]) for line in lines)
    assert any(np.array_equal(np.asarray(line.get_ydata(), float), LIMITS.x_max[:, 0]) for line in lines)


def test_a_run_longer_than_its_limits_is_refused(plant):
    mpc = km.LinearMPC(plant, [0, 0], [0], COST, LIMITS.base, horizon=15)
    with pytest.raises(km.errors.ShapeError, match="the run reads rows 0 … 99, and row 61 is missing"):
        km.simulate(plant, mpc, x0=[0, 0], reference=[0, 0], steps=100, limits=LIMITS)
