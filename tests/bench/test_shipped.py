"""The shipped problems, run whole: no faults, Koopman MPC close to the oracle, and the swing-up that only it manages."""

import pytest

from koopmpc.bench.library import load_problem, shipped
from koopmpc.bench.sweep import sweep


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    swept = sweep([load_problem(path) for path in shipped()], folder=tmp_path_factory.mktemp("shipped"))
    return {(row.problem, row.case, row.controller): row for row in swept}


def test_every_run_ends_as_it_should(rows):
    assert {key: row.fault for key, row in rows.items() if row.fault} == {}
    assert len(rows) == 20


@pytest.mark.parametrize("case", [("pendulum", "upright"), ("cart_pole", "shift"), ("cart_pole", "recover")])
def test_koopman_mpc_is_within_a_tenth_of_nonlinear_mpc(rows, case):
    koopman, oracle = rows[*case, "koopman-mpc"].metrics, rows[*case, "nonlinear-mpc"].metrics
    assert koopman.cost <= 1.1 * oracle.cost


def test_only_nonlinear_mpc_swings_the_pendulum_up(rows):
    reached = [name for (problem, case, name), row in rows.items() if case == "hang" and row.reached]
    assert reached == ["nonlinear-mpc"]


def test_limits_keep_lqr_from_the_recovery_that_koopman_mpc_manages(rows):
    lqr, koopman = (rows["cart_pole", "recover", name].metrics for name in ("lqr", "koopman-mpc"))
    assert abs(koopman.final_error[2]) < 0.05
    assert lqr.cost > 10 * koopman.cost
