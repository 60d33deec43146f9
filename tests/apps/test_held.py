"""The inputs that hold a reference: found on the truth, the same for every controller, and free of charge."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.apps.tiny import write


@pytest.fixture
def tank(tmp_path):
    """A tank held at 1 m, which takes an inflow for as long as it lasts."""
    problem = km.load_problem(write(tmp_path))
    return replace(problem, cases={"fill": km.Case(x0=[0.0], reference=[1.0], steps=30)})


def test_who_misses_the_reference_is_not_cheaper_than_the_oracle(tank, tmp_path):
    rows = km.sweep([tank], ["lqr", "linear-mpc", "koopman-mpc", "nonlinear-mpc"], folder=tmp_path)
    assert [row.failure for row in rows] == [None] * 4
    runs = [km.load_run(row.log) for row in rows]
    for row, run in zip(rows, runs, strict=True):
        assert row.metrics.cost >= 0.999 * rows[-1].metrics.cost
        assert run.u_reference[0, 0] == pytest.approx(0.5 - 0.2 * np.sin(1.0), abs=1e-6)
        assert np.array_equal(run.u_reference, runs[0].u_reference)
    assert abs(runs[-1].U[-1] - runs[-1].u_reference[-1]) < 1e-3


def test_they_hold_each_reference_row_on_the_truth(tank):
    class Heavy(type(tank.dynamics)):
        def rhs(self, x, u):
            return -0.8 * x[0] + 0.1 * ca.sin(x[0]) + u[0]

    rows = np.repeat([[0.2], [1.0], [0.2]], [10, 10, 11], axis=0)
    problem = replace(tank, plant=Heavy(), cases={"steps": km.Case([0.0], rows, 30)})
    parts = km.bench.Prepared(problem)
    for row, u in zip(rows, parts.u_reference("steps"), strict=False):
        np.testing.assert_allclose(parts.truth(row, u), row, atol=1e-6)
    plant = km.plants.SimulatedPlant(parts.truth)
    held = km.bench.Prepared(replace(problem, plant=plant)).u_reference("steps")
    np.testing.assert_array_equal(held, parts.u_reference("steps"))
    assert parts.u_reference("steps") is parts.u_reference("steps")


def test_they_stay_inside_the_limits_of_the_case(tank):
    case = km.Case([0.0], [1.9], 5, limits=km.Limits(-0.3, 0.3))
    held = km.bench.Prepared(replace(tank, cases={"much": case})).u_reference("much")
    np.testing.assert_allclose(held, 0.3, atol=1e-6)


def test_they_are_zero_where_the_cost_says_so(tank):
    zero = replace(tank, cost=km.Cost(Q=1.0, R=0.1, u_target="zero"))
    np.testing.assert_array_equal(km.bench.Prepared(zero).u_reference("fill"), np.zeros((30, 1)))
