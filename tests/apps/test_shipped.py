"""Pendulum and cart-pole, run whole: no faults, Koopman MPC near the oracle, a swing-up that only the oracle manages."""

from dataclasses import replace
from functools import cache

import pytest

import koopmpc as km

FAST, SLOW = "pendulum", pytest.param("cart_pole", marks=pytest.mark.slow)
NAMES = ["lqr", "koopman-mpc", "offset-free", "nonlinear-mpc"]


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """Return the rows of a problem, by case and controller; each problem is swept once."""

    @cache
    def rows(name):
        problem = replace(km.load_problem(name), scene=lambda x, u: [])  # drawing is what takes long
        found = km.sweep([problem], NAMES, folder=tmp_path_factory.mktemp(name))
        return {(row.case, row.controller): row for row in found}

    return rows


@pytest.mark.parametrize("problem", [FAST, SLOW])
def test_every_run_ends_as_it_should(swept, problem):
    rows = swept(problem)
    assert {key: row.failure for key, row in rows.items() if row.failure} == {}
    assert len(rows) == 4 * 3


@pytest.mark.slow
def test_limits_keep_lqr_from_the_recovery_that_koopman_mpc_manages(swept):
    lqr, koopman = (swept("cart_pole")["recover", name].metrics for name in ("lqr", "koopman-mpc"))
    assert abs(koopman.final_error[2]) < 0.05
    assert lqr.cost > 10 * koopman.cost


@pytest.mark.parametrize(
    ("problem", "cases"),
    [("pendulum", ["upright"]), pytest.param("cart_pole", ["shift", "recover"], marks=pytest.mark.slow)],
)
def test_koopman_mpc_is_within_a_tenth_of_nonlinear_mpc(swept, problem, cases):
    for case in cases:
        koopman, oracle = (swept(problem)[case, name].metrics for name in ("koopman-mpc", "nonlinear-mpc"))
        assert koopman.cost <= 1.1 * oracle.cost


def test_only_nonlinear_mpc_swings_the_pendulum_up(swept):
    reached = [name for (case, name), row in swept("pendulum").items() if case == "hang" and row.reached]
    assert reached == ["nonlinear-mpc"]


@pytest.mark.parametrize(
    ("problem", "case"), [("pendulum", "hold"), pytest.param("cart_pole", "wind", marks=pytest.mark.slow)]
)
def test_only_the_estimator_leaves_no_offset_where_nobody_was_told_of_the_load(swept, problem, case):
    rows = swept(problem)
    free = rows[case, "offset-free"].metrics
    assert max(abs(free.final_error)) < 1e-3
    for name in ("lqr", "koopman-mpc", "nonlinear-mpc"):
        other = rows[case, name].metrics
        assert max(abs(other.final_error)) > 0.02
        assert free.cost < other.cost


@pytest.mark.slow
def test_all_eight_controllers_end_as_they_should_on_all_cases(tmp_path):
    swept = km.sweep([km.load_problem(path) for path in km.bench.shipped()], folder=tmp_path)
    assert [row.failure for row in swept if row.failure] == []


@pytest.mark.slow
def test_a_payload_that_grows_leaves_an_error_to_those_who_neither_learn_nor_estimate(tmp_path):
    problem = replace(km.load_problem("drifting_arm"), scene=lambda x, u: [])
    names = ["lqr", "koopman-mpc", "offset-free", "bilinear-mpc", "adaptive"]
    rows = {
        (row.case, row.controller): row
        for row in km.sweep([problem], names, folder=tmp_path, options=km.bench.SweepOptions(monitor=True))
    }
    assert {row.failure for row in rows.values()} == {None}
    assert [name for (case, name), row in rows.items() if case == "drift" and row.reached] == [
        "offset-free",
        "adaptive",
    ]
    cost = {key: row.metrics.cost for key, row in rows.items()}
    assert cost["drift", "adaptive"] < cost["drift", "koopman-mpc"]
    assert cost["steady", "adaptive"] == pytest.approx(cost["steady", "koopman-mpc"], rel=1e-6)
    assert rows["drift", "koopman-mpc"].metrics.unknown > 10 * rows["steady", "koopman-mpc"].metrics.unknown + 50
