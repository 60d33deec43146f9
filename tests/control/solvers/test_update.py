"""Another QP of the same size between two solves, and copies."""

import copy
import pickle

import numpy as np
import pytest

import koopmpc as km
from tests.control.solvers.random_qps import QP, SOLVERS

TIGHT = {"osqp": {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 20_000}, "daqp": {}}


def qp(seed, holes=0):
    rng = np.random.default_rng(seed)
    n, m = 6, 15
    half = rng.normal(size=(n, n))
    A = np.vstack([np.eye(n), rng.normal(size=(m - n, n))])
    A[-1, :holes] = 0.0
    return QP(half @ half.T + np.eye(n), rng.normal(size=n), A, -0.2 * np.ones(m), 0.3 * np.ones(m))


@pytest.mark.parametrize("name", ["osqp", "daqp"])
def test_updating_a_qp_is_setting_it_up(name):
    make = SOLVERS[name]
    solver, cold = make(qp(0), TIGHT[name]), (np.zeros(6), np.zeros(15))
    for other in (qp(1), qp(2), qp(3, holes=4), qp(4)):
        solver.solve(*cold)
        solver.update(other)
        found, fresh = solver.solve(*cold), make(other, TIGHT[name]).solve(*cold)
        assert found.status is fresh.status is km.Status.OPTIMAL
        np.testing.assert_allclose(found.v, fresh.v, atol=1e-7)


@pytest.mark.parametrize("name", ["osqp", "daqp"])
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda solver: pickle.loads(pickle.dumps(solver))])
def test_a_copy_has_the_answers_of_its_original(name, copied):
    rng = np.random.default_rng(1)
    solver, start = SOLVERS[name](qp(5), None), (np.zeros(6), np.zeros(15))
    for _ in range(30):
        high = rng.uniform(0.01, 2.0, 15)
        solver.set_bounds(-high[::-1].copy(), high)
        found = solver.solve(*start)
        start = found.v, found.y
    twin = copied(solver)
    for _ in range(10):
        high = rng.uniform(0.01, 2.0, 15)
        for each in (solver, twin):
            each.set_bounds(-high[::-1].copy(), high)
        mine, its = solver.solve(*start), twin.solve(*start)
        if name == "osqp":  # DAQP's active rows stay behind: the same answer by another way
            np.testing.assert_array_equal(mine.v, its.v)
            assert mine.iterations == its.iterations
        np.testing.assert_allclose(mine.v, its.v, atol=1e-7)
        start = mine.v, mine.y
