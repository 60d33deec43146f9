"""Measured disturbances in simulate, and rates in the metrics."""

import numpy as np
import pytest

import koopmpc as km
from tests.control.models import linear, step_map

A, B, E = np.array([[1.05, 0.1], [0.08, 1.0]]), np.array([[0.005], [0.1]]), np.array([[0.02], [0.1]])


class Told:
    """A controller that keeps what w it was told."""

    dt, nu = 0.1, 1

    def __init__(self, horizon):
        self.horizon, self.told = horizon, []

    def reset(self, x0=None, u_prev=None):
        pass

    def __call__(self, y, reference, applied=None, w=None):
        self.told.append(None if w is None else np.array(w))
        return km.Move(np.zeros(1), km.Status.OPTIMAL, km.control.Fallback.NONE, 0.0, 0)


def run(controller, **more):
    return km.simulate(step_map(A, B), controller, x0=[0.0, 0.0], reference=[0.0, 0.0], steps=6, **more)


def test_a_controller_is_told_the_rows_ahead():
    W = np.arange(12.0).reshape(6, 2)
    whole = np.vstack([W, np.tile(W[-1], (3, 1))])
    controller = Told(3)
    result = run(controller, measured=W)
    for k, told in enumerate(controller.told):
        np.testing.assert_array_equal(told, whole[k : k + 3])
    assert result.metadata["measured"] == W.tolist()
    controller = Told(3)
    run(controller, measured=W, preview=False)
    np.testing.assert_array_equal(controller.told, W)
    controller = Told(0)
    run(controller, measured=[4.0])
    assert all(told.tolist() == [[4.0]] for told in controller.told)
    controller = Told(3)
    assert "measured" not in run(controller).metadata
    assert controller.told == [None] * 6
    with pytest.raises(
        km.errors.ShapeError, match=r"measured has shape \(5, 2\), expected \(nw,\) or \(steps, nw\) = \(6, nw\)"
    ):
        run(Told(3), measured=W[:5])


def test_to_be_told_is_to_be_better():
    """A pulse that is measured costs less than one that is not, and least with its preview."""
    base = linear(A, B)
    model = km.LinearPredictor(A, B, np.eye(2), base.lifting, 0.1, base.states, base.inputs, E=E)
    cost, steps = km.Cost([2, 1], 0.01), 60
    W = np.where((np.arange(steps) >= 25) & (np.arange(steps) < 40), 0.5, 0.0)[:, None]
    costs = []
    for more in ({}, {"measured": W, "preview": False}, {"measured": W}):
        result = km.simulate(
            step_map(A, B),
            km.KoopmanMPC(model, cost, km.Limits(-3, 3), 15),
            x0=[0.0, 0.0],
            reference=[0.0, 0.0],
            steps=steps,
            cost=cost,
            disturbance=W @ E.T,
            **more,
        )
        costs.append(km.metrics(result).cost)
    assert costs[2] < costs[1] < costs[0]


def test_metrics_count_rates():
    cost, limits = km.Cost(1, 0.1), km.Limits(-1, 1)
    mpc = km.KoopmanMPC(linear(A, B), cost, limits, 10)
    go = lambda cost, limits: km.metrics(  # noqa: E731
        km.simulate(step_map(A, B), mpc, x0=[0.6, 0.0], reference=[0.0, 0.0], steps=20, cost=cost, limits=limits)
    )
    plain = go(cost, limits)
    result = km.simulate(step_map(A, B), mpc, x0=[0.6, 0.0], reference=[0.0, 0.0], steps=20)
    changes = np.diff(result.U[:, 0])
    dearer = go(km.Cost(1, 0.1, R_delta=2.0), limits)
    assert dearer.cost == pytest.approx(plain.cost + 2.0 * changes @ changes)
    rated = go(cost, km.Limits(-1, 1, du_max=0.05))
    assert plain.violation == 0.0
    assert rated.violation == pytest.approx(np.abs(changes).max() - 0.05)
    assert rated.input_violation == 0.0
