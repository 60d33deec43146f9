"""Pendulum and cart-pole, run whole: no faults, Koopman MPC near the oracle, a swing-up that only the oracle manages."""

from dataclasses import replace

import pytest

import koopmpc as km


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    # Drawing is what takes long.
    problems = [replace(km.load_problem(name), scene=lambda x, u: []) for name in ("cart_pole", "pendulum")]
    names = ["lqr", "koopman-mpc", "offset-free", "nonlinear-mpc"]
    swept = km.sweep(problems, names, folder=tmp_path_factory.mktemp("shipped"))
    return {(row.problem, row.case, row.controller): row for row in swept}


def test_every_run_ends_as_it_should(rows):
    assert {key: row.failure for key, row in rows.items() if row.failure} == {}
    assert len(rows) == 4 * (3 + 3)


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


@pytest.mark.parametrize("case", [("pendulum", "hold"), ("cart_pole", "wind")])
def test_only_the_estimator_leaves_no_offset_where_nobody_was_told_of_the_load(rows, case):
    free = rows[*case, "offset-free"].metrics
    assert max(abs(free.final_error)) < 1e-3
    for name in ("lqr", "koopman-mpc", "nonlinear-mpc"):
        other = rows[*case, name].metrics
        assert max(abs(other.final_error)) > 0.02
        assert free.cost < other.cost


@pytest.mark.slow
def test_all_eight_controllers_end_as_they_should_on_all_cases(tmp_path):
    swept = km.sweep([km.load_problem(path) for path in km.bench.shipped()], folder=tmp_path)
    assert [row.failure for row in swept if row.failure] == []


def test_a_payload_that_grows_leaves_an_error_to_those_who_neither_learn_nor_estimate(tmp_path):
    problem = replace(km.load_problem("drifting_arm"), scene=lambda x, u: [])
    rows = {(row.case, row.controller): row for row in km.sweep([problem], folder=tmp_path, monitor=True)}
    assert {row.failure for row in rows.values()} == {None}
    assert [name for (case, name), row in rows.items() if case == "drift" and row.reached] == [
        "offset-free",
        "adaptive",
    ]
    cost = {key: row.metrics.cost for key, row in rows.items()}
    assert cost["drift", "adaptive"] < cost["drift", "koopman-mpc"]
    assert cost["steady", "adaptive"] == pytest.approx(cost["steady", "koopman-mpc"], rel=1e-6)
    assert rows["drift", "koopman-mpc"].metrics.unknown > 10 * rows["steady", "koopman-mpc"].metrics.unknown + 50
