"""A hard limit that no plan can keep is found, whichever solver is asked first, and in few iterations."""

import pytest

import koopmpc as km
from tests.control.models import in_coordinates


@pytest.mark.parametrize("coordinates", ["plain", "riccati"])
@pytest.mark.parametrize("solver", ["osqp", "daqp"])
@pytest.mark.parametrize("limit", [0.1, 0.5, 0.55])
def test_a_limit_that_cannot_be_kept_is_found(coordinates: str, solver: str, limit: float) -> None:
    """θ would have to fall from 0.6 rad to the limit in 0.05 s; the input stays inside its limits."""
    plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    limits = km.Limits(-25, 25, x_max=[limit, float("inf")], slack=None)
    make = in_coordinates(coordinates, km.LinearMPC)
    mpc = make(plant, [0, 0], [0], km.Cost([10, 1], 0.1), limits, 40, solver=solver)
    move = mpc([0.6, 0.0], [0.0, 0.0])
    assert move.status is km.Status.INFEASIBLE
    assert move.iterations < 250
    assert abs(move.u[0]) <= 25
