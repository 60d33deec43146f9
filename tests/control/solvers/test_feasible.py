"""Empty sets of rows are told from others, also by a controller whose solver gives up first."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

import koopmpc as km
from koopmpc.control.solvers.osqp import empty
from tests.control.models import in_coordinates


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 6), st.integers(1, 12), st.integers(0, 999))
def test_it_says_what_another_program_says(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((m, n))
    low = rng.standard_normal(m)
    high = low + rng.uniform(0, 1, m)
    low[rng.random(m) < 0.3], high[rng.random(m) < 0.3] = -np.inf, np.inf
    rows, limits = [], []
    for sign, limit in ((1, high), (-1, -low)):
        kept = np.isfinite(limit)
        rows.append(sign * A[kept])
        limits.append(limit[kept])
    other = linprog(np.zeros(n), np.vstack(rows), np.concatenate(limits), bounds=(None, None))
    assert empty(A, low, high) == (other.status == 2)


@pytest.mark.parametrize("coordinates", ["plain", "riccati"])
@pytest.mark.parametrize("solver", ["osqp", "daqp"])
@pytest.mark.parametrize("limit", [0.1, 0.5, 0.55])
def test_a_limit_that_cannot_be_kept_is_found(coordinates: str, solver: str, limit: float) -> None:
    """θ would have to fall from 0.6 rad to the limit in 0.05 s; the input stays inside its limits."""
    plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    limits = km.Limits(-25, 25, x_max=[limit, np.inf], slack=None)
    make = in_coordinates(coordinates, km.LinearMPC)
    mpc = make(plant, [0, 0], [0], km.Cost([10, 1], 0.1), limits, 40, solver=solver)
    move = mpc([0.6, 0.0], [0.0, 0.0])
    assert move.status is km.Status.INFEASIBLE
    assert abs(move.u[0]) <= 25
