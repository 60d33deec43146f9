"""The units of inputs, states and cost change nothing: not the plan, not the iterations that it takes."""

import numpy as np
import pytest

import koopmpc as km
from tests.control.models import in_coordinates

A, B = np.array([[1.1, 0.2], [0.1, 0.95]]), np.array([[0.1, 0.0], [0.05, 0.2]])


def moves(solver, coordinates, states=(1.0, 1.0), inputs=(1.0, 1.0), price=1.0, slack=(30.0, 5.0)):
    """The moves of a short loop whose states, inputs and cost are in other units, in those of the first."""
    sx, su = np.array(states), np.array(inputs)
    pair = A * sx[:, None] / sx, B * sx[:, None] / su
    model = km.LinearPredictor(*pair, np.eye(2), km.State(), 0.1, ("x0", "x1"), ("u0", "u1"))
    cost = km.Cost(
        price * np.array([2.0, 0.5]) / sx**2,
        price * np.array([0.1, 0.3]) / su**2,
        Q_N=price * np.array([[3.0, 0.5], [0.5, 1.0]]) / np.outer(sx, sx),
        u_target="zero",
    )
    limits = km.Limits(
        -0.8 * su,
        0.6 * su,
        du_max=0.5 * su,
        x_min=-0.7 * sx,
        x_max=0.9 * sx,
        slack=None if slack is None else (price * slack[0] / sx, price * slack[1] / sx**2),
    )
    mpc = in_coordinates(coordinates)(model, cost, limits, 8, solver=solver)
    x, found = np.array([0.8, -0.9]), []
    for _ in range(6):
        move = mpc(x * sx, [0.0, 0.0])
        found.append((move.status, move.iterations, *(move.u / su)))
        x = A @ x + B @ (move.u / su)
    return found


@pytest.mark.parametrize("slack", [None, (30.0, 5.0)], ids=["hard", "soft"])
@pytest.mark.parametrize("coordinates", ["plain", "riccati"])
@pytest.mark.parametrize("solver", ["osqp", "daqp"])
def test_units_change_neither_plan_nor_iterations(solver, coordinates, slack):
    base = moves(solver, coordinates, slack=slack)
    assert any(status is not km.Status.UNCONSTRAINED for status, *_ in base)
    for units in (
        {"states": (1e-5, 1e-5)},
        {"states": (1e4, 1e-3)},
        {"inputs": (1e5, 1e5)},
        {"inputs": (1e-4, 1e-4), "states": (1e3, 10.0)},
        {"price": 1e8},
        {"price": 1e-8},
    ):
        for one, other in zip(base, moves(solver, coordinates, slack=slack, **units), strict=True):
            assert one[:2] == other[:2], units
            np.testing.assert_allclose(one[2:], other[2:], rtol=1e-6, atol=1e-7)
