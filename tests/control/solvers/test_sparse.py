"""Long plans are solved stage by stage: the same inputs as the condensed QP, and as CVXPY on the problem itself."""

import copy

import cvxpy as cp
import numpy as np
import pytest
import scipy.linalg

import koopmpc as km
from koopmpc.control.solvers import order, piqp

pytest.importorskip("piqp", reason="an extra")

A = np.array([[1, 0.1, 0, 0], [0, 1.0, 0.1, 0], [0, 0, 0.95, 0.1], [0, 0, 0, 0.9]])
B = np.array([[0.0, 0.02], [0.05, 0.0], [0.1, 0.0], [0.1, 0.05]])
FAR = np.array([np.inf, 0.5, np.inf, np.inf])


def shorten(monkeypatch) -> None:
    """Let a plan of 60 steps be a long one."""
    monkeypatch.setattr(order, "LONG", 60)
    monkeypatch.setattr(order, "WIDE", 1)


def controller(solver: str, N: int, rates: bool = False, nu: int = 1, **limits):
    model = km.LinearPredictor(A, B[:, :nu], np.eye(4), km.State(), 0.1, tuple("abcd"), ("u", "v")[:nu])
    more = {"du_max": 0.4, "du_min": -0.3} if rates else {}
    cost = km.Cost(np.ones(4), 0.1 * np.ones(nu), R_delta=0.05 if rates else None)
    box = km.Limits(-1, 1, **{"x_min": -FAR, "x_max": FAR, "slack": None, **more, **limits})
    return km.KoopmanMPC(model, cost, box, N, solver=solver)


@pytest.mark.parametrize(("rates", "nu"), [(False, 1), (True, 1), (False, 2), (True, 2)])
def test_the_stages_and_the_condensed_qp_have_the_same_plan(rates, nu):
    dense, sparse = (controller(name, 60, rates, nu) for name in ("daqp", "piqp"))
    x, r = np.array([3.0, 0.0, 0.0, 0.0]), np.zeros(4)
    for _ in range(5):
        one, other = dense(x, r), sparse(x, r)
        assert (one.status, other.status, other.solver) == (km.Status.OPTIMAL, km.Status.OPTIMAL, "piqp")
        assert other.u == pytest.approx(one.u, abs=1e-6)
        assert np.abs(sparse.plan().U - dense.plan().U).max() < 2e-5
        x = A @ x + B[:, :nu] @ one.u


def test_the_stages_agree_with_cvxpy_on_the_problem_itself():
    N, x0 = 30, np.array([1.5, 0.0, 0.0, 0.0])
    mpc = controller("piqp", N)
    mpc(x0, np.zeros(4))
    P = scipy.linalg.solve_discrete_are(A, B[:, :1], np.eye(4), np.array([[0.1]]))
    X, U = cp.Variable((N + 1, 4)), cp.Variable((N, 1))
    cost = cp.sum_squares(X[1:N]) + 0.1 * cp.sum_squares(U) + cp.quad_form(X[N], P)
    rows = [X[0] == x0, X[1:] == X[:-1] @ A.T + U @ B[:, :1].T, cp.abs(U) <= 1, cp.abs(X[1:, 1]) <= 0.5]
    cp.Problem(cp.Minimize(cost), rows).solve(solver="CLARABEL", tol_gap_rel=1e-10, tol_gap_abs=1e-10, tol_feas=1e-10)
    assert np.abs(mpc.plan().U - U.value).max() < 1e-5
    assert np.abs(U.value).max() > 1 - 1e-6
    assert np.abs(X.value[:, 1]).max() > 0.5 - 1e-6


def test_only_a_long_plan_whose_solver_nobody_named_is_solved_stage_by_stage(monkeypatch):
    shorten(monkeypatch)
    x, r = np.array([3.0, 0.0, 0.0, 0.0]), np.zeros(4)
    moves = {
        name: mpc(x, r)
        for name, mpc in {
            "long": controller("auto", 60),
            "short": controller("auto", 59),
            "named": controller("daqp", 60),
            "soft": controller("auto", 60, slack="auto"),
        }.items()
    }
    assert {name: move.solver for name, move in moves.items()} == {
        "long": "piqp",
        "short": "daqp",
        "named": "daqp",
        "soft": "daqp",
    }
    assert moves["long"].u == pytest.approx(moves["named"].u, abs=1e-6)


def test_copies_and_restored_controllers_go_on_alike(monkeypatch, tmp_path):
    shorten(monkeypatch)
    mpc, x, r = controller("auto", 60), np.array([3.0, 0.0, 0.0, 0.0]), np.zeros(4)
    mpc(x, r)
    twin = copy.deepcopy(mpc)
    assert np.array_equal(mpc(0.9 * x, r).u, twin(0.9 * x, r).u)
    mpc.save(tmp_path / "mpc.npz")
    again = km.load_controller(tmp_path / "mpc.npz")
    assert again(x, r).solver == "piqp"
    assert mpc.build_program(None).solver.settings == controller("daqp", 60).build_program(None).solver.settings


def test_what_has_no_solution_is_left_to_the_condensed_qp(monkeypatch):
    shorten(monkeypatch)
    mpc = controller("auto", 60)
    move = mpc([0.0, 3.0, 0.0, 0.0], np.zeros(4))
    assert move.status is km.Status.INFEASIBLE
    assert move.solver != "piqp"


def test_a_step_without_a_solution_does_not_leave_all_later_ones_to_the_slow_solver(monkeypatch):
    shorten(monkeypatch)
    mpc = controller("auto", 60)
    first = mpc([3.0, 0.45, 2.0, 0.0], np.zeros(4))
    assert (first.status, first.solver) == (km.Status.INFEASIBLE, "daqp")
    assert mpc([3.0, 0.0, 0.0, 0.0], np.zeros(4)).solver == "piqp"


def test_without_its_extra_it_is_refused_and_auto_does_without(monkeypatch):
    shorten(monkeypatch)
    for module in (piqp, order):
        monkeypatch.setattr(module, "has_piqp", lambda: False)
    assert controller("auto", 60)([3.0, 0.0, 0.0, 0.0], np.zeros(4)).solver == "daqp"
    with pytest.raises(km.errors.DataError, match=r'pip install "koopmpc\[piqp\]"'):
        controller("piqp", 60)


def test_a_setting_that_it_does_not_have_is_refused():
    model = km.LinearPredictor(A, B[:, :1], np.eye(4), km.State(), 0.1, tuple("abcd"), ("u",))
    with pytest.raises(km.errors.DataError, match="PIQP has no setting 'rho'"):
        km.KoopmanMPC(model, km.Cost(np.ones(4), 0.1), km.Limits(-1, 1), 5, solver="piqp", settings={"rho": 1.0})


@pytest.mark.parametrize("value", [-1.0, np.nan])
def test_a_setting_that_is_no_positive_number_is_refused(value):
    model = km.LinearPredictor(A, B[:, :1], np.eye(4), km.State(), 0.1, tuple("abcd"), ("u",))
    with pytest.raises(km.errors.DataError, match="PIQP's setting eps_abs"):
        km.KoopmanMPC(model, km.Cost(np.ones(4), 0.1), km.Limits(-1, 1), 5, solver="piqp", settings={"eps_abs": value})
