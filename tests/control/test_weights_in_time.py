"""Weights in time: constant rows are constant weights, moving ones give the plan of a solver that knows nothing of
stages, metrics count them, and laws that do not know them refuse them."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import lsq_linear
from scipy.signal import StateSpace

import koopmpc as km
from tests.control.oracle import oracle

A, B = np.array([[1.0, 0.2], [-0.1, 0.9]]), np.array([[0.02], [0.2]])
MODEL = km.LinearPredictor.from_state_space(StateSpace(A, B, np.eye(2), np.zeros((2, 1)), dt=0.2))
LIMITS, END, N = km.Limits(u_min=-1, u_max=1), np.diag([3.0, 1.0]), 5
Q_ROWS = np.random.default_rng(0).uniform(0, 4, (12, 2))
R_ROWS = np.random.default_rng(1).uniform(0.05, 2, (12, 1))
KINDS = [km.BilinearMPC, km.NonlinearMPC, km.KoopmanMPC]
slow = pytest.mark.slow


def make(kind, **cost):
    return kind(MODEL, km.Cost(**{"Q": [1, 0.5], "R": 0.2, "Q_N": END, "u_target": "zero"} | cost), LIMITS, N)


def row(table, k):
    return table[min(k, len(table) - 1)]


def find_best(x, k, R_delta, last):
    """Return the inputs of least cost at step k, by least squares in all inputs at once."""
    forced = np.vstack([np.linalg.matrix_power(A, i + 1) for i in range(N)]) @ x
    response = np.zeros((2 * N, N))
    for i in range(N):
        for j in range(i + 1):
            response[2 * i : 2 * i + 2, j] = (np.linalg.matrix_power(A, i - j) @ B)[:, 0]
    states = [np.diag(np.sqrt(row(Q_ROWS, k + i + 1))) for i in range(N - 1)]
    weigh = block_diag(*states, np.sqrt(END))
    inputs = np.diag([float(np.sqrt(row(R_ROWS, k + i)[0])) for i in range(N)])
    change = np.sqrt(R_delta) * (np.eye(N) - np.eye(N, k=-1))
    rows = np.vstack([weigh @ response, inputs, change])
    right = np.concatenate([-weigh @ forced, np.zeros(N), np.sqrt(R_delta) * last * np.eye(N)[0]])
    return lsq_linear(rows, right, (-1, 1), tol=1e-14).x


@pytest.mark.parametrize(
    ("kind", "R_delta"),
    [
        *((kind, 0.0) for kind in KINDS),
        (KINDS[0], 0.3),
        pytest.param(KINDS[1], 0.3, marks=slow),
        (KINDS[2], 0.3),
    ],
)
def test_the_plan_of_each_step_is_that_of_least_squares(kind, R_delta):
    mpc = make(kind, Q_rows=Q_ROWS, R_rows=R_ROWS, R_delta=R_delta or None)
    for _ in range(2):  # a reset begins at the first row
        x, last = np.array([2.0, 0.5]), 0.0
        mpc.reset()
        for k in range(9):
            u = mpc(x, [0, 0]).u
            np.testing.assert_allclose(mpc.plan().U[:, 0], find_best(x, k, R_delta, last), atol=2e-5)
            x, last = A @ x + B @ u, float(u[0])


def test_a_call_that_is_refused_counts_as_no_step():
    mpc, x = make(km.BilinearMPC, Q_rows=Q_ROWS, R_rows=R_ROWS), np.array([2.0, 0.5])
    with pytest.raises(km.errors.ShapeError):
        mpc(x, [0, 0, 0])
    mpc(x, [0, 0])
    np.testing.assert_allclose(mpc.plan().U[:, 0], find_best(x, 0, 0.0, 0.0), atol=2e-5)


@pytest.mark.parametrize(
    ("blocks", "R_delta", "limited"),
    [
        pytest.param(None, None, True, id="limits"),
        pytest.param((1, 1, 3), 0.3, False, id="blocks, changes", marks=slow),
    ],
)
def test_linear_plans_with_limits_and_a_preview_are_those_of_cvxpy(blocks, R_delta, limited):
    cost = km.Cost(Q=[1, 0.5], R=0.2, Q_rows=Q_ROWS, R_rows=R_ROWS, R_delta=R_delta)
    limits = km.Limits(u_min=-0.6, u_max=0.5, du_max=0.4, **({"x_max": [0.4, np.inf]} if limited else {}), slack=(9, 5))
    mpc = km.KoopmanMPC(MODEL, cost, limits, N, moves=blocks)
    reference, x, u = np.column_stack([np.sin(np.arange(20) / 3), np.zeros(20)]), np.array([0.5, 0.3]), np.zeros(1)
    for k in range(2):
        rows = reference[k : k + N + 1]
        move = mpc(x, rows)
        found = oracle(MODEL, cost, limits, x, rows, u_prev=u, blocks=blocks, step=k)
        assert found is not None
        plan = mpc.plan()
        assert plan is not None
        np.testing.assert_allclose(plan.U, found[0], atol=2e-6)
        u, x = move.u, A @ x + B @ move.u


def test_linear_plans_whose_preview_holds_the_constant_weights_are_alike_to_the_bit_and_copies_go_on():
    rows = np.vstack([np.tile([1, 0.5], (10, 1)), [[5, 0]]])
    plain, moving = make(km.KoopmanMPC), make(km.KoopmanMPC, Q_rows=rows)
    for _ in range(2):
        x = np.array([2.0, 0.5])
        moving.reset()
        for k in range(12):
            now = plain(x, [0.3, 0]).u, moving(x, [0.3, 0]).u
            assert np.array_equal(*now) == (k < 6)  # of 5 steps the plan weighs x_1 … x_4
            x = A @ x + B @ now[1]
            if k == 8:
                twin = copy.copy(moving)
                np.testing.assert_array_equal(twin(x, [0.3, 0]).u, copy.copy(moving)(x, [0.3, 0]).u)


def test_linear_mpc_weighs_the_rows_of_a_controller_on_its_linearisation():
    cost = km.Cost(Q=[1, 0.5], R=0.2, Q_rows=Q_ROWS, R_rows=R_ROWS)
    kinds = km.LinearMPC(MODEL.step_map(), [0, 0], [0], cost, LIMITS, N), km.KoopmanMPC(MODEL, cost, LIMITS, N)
    x = np.array([1.0, 0.2])
    for _ in range(3):
        a, b = (mpc(x, [0.1, 0]).u for mpc in kinds)
        np.testing.assert_allclose(a, b, atol=1e-10)
        x = A @ x + B @ a


def test_with_a_latency_the_rows_are_those_of_the_steps_in_which_inputs_act():
    late, now = (make(km.KoopmanMPC, Q_rows=Q_ROWS[k:], R_rows=R_ROWS[k:]) for k in (0, 1))
    late = km.KoopmanMPC(MODEL, late.cost, LIMITS, N, latency=1)
    late.reset(u_prev=[0.0])
    x = np.array([0.3, 0.1])
    np.testing.assert_allclose(late(x, [0, 0]).u, now(A @ x, [0, 0]).u, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_constant_rows_are_the_constant_weights(kind):
    plain, rows = make(kind), make(kind, Q_rows=[[1, 0.5]] * 3, R_rows=[[0.2]])
    x = np.array([2.0, 0.5])
    for _ in range(6):
        u = plain(x, [0.3, 0]).u
        np.testing.assert_array_equal(rows(x, [0.3, 0]).u, u)
        x = A @ x + B @ u


def test_metrics_count_the_rows_and_names_are_resolved():
    names = {"Q_rows": {"x0": Q_ROWS[:, 0]}, "R_rows": {"u0": R_ROWS[:, 0]}}
    mpc = make(km.BilinearMPC, **names)
    run = km.simulate(MODEL.step_map(), mpc, x0=[1.0, 0.0], reference=[0, 0], steps=6, cost=mpc.cost)
    expected = sum(Q_ROWS[k, 0] * run.X[k, 0] ** 2 for k in range(1, 7))
    expected += sum(R_ROWS[k, 0] * run.U[k, 0] ** 2 for k in range(6))
    assert km.metrics(run).cost == pytest.approx(expected)


REFUSED = {
    "below 0": {"Q_rows": [[-1, 0]]},
    "Q_rows holds 1 NaN or inf": {"Q_rows": [[1, np.nan]]},
    "R_rows holds 1 NaN or inf": {"R_rows": {"u0": [0.1, np.inf]}},
    "pass rows": {"R_rows": [0.1, 0.2]},
    "one of the two": {"R_rows": [[0.1]], "price": [0.1]},
    "Q_rows are diagonals, and Q is a full matrix": {"Q": [[1, 0.2], [0.2, 1]], "Q_rows": [[1, 1]]},
    "R_rows are diagonals, and Q is a full matrix": {"Q": [[1, 0.2], [0.2, 1]], "R_rows": [[0.1]]},
    "Q_rows are diagonals, and R is a full matrix": {"R": [[1, 0.2], [0.2, 1]], "Q_rows": [[1, 1]]},
    "pass rows of 2": {"Q_rows": [[1, 1, 1]]},
    r"Q_rows has shape \(1, 3\)": {"Q": 1, "Q_rows": [[1, 1, 1]]},
    r"R_rows has shape \(1, 2\)": {"R": 0.1, "R_rows": [[0.1, 0.1]]},
}


@pytest.mark.parametrize("said", REFUSED)
def test_rows_that_cannot_be_are_refused(said):
    with pytest.raises((km.errors.DataError, km.errors.ShapeError), match=said):
        make(km.BilinearMPC, **REFUSED[said])


def test_weights_that_leave_a_later_input_without_cost_are_refused_before_the_first_step():
    weights = {"Q_rows": [[1, 1]] * 9 + [[0, 0]] * 5 + [[1, 1]], "Q_N": np.zeros((2, 2))}
    with pytest.raises(km.errors.DefinitenessError, match=r"begins at row 7 of .* some change of the inp"):
        make(km.KoopmanMPC, R_rows=[[0.1]] * 11 + [[0], [0.1]], **weights)
    mpc = make(km.KoopmanMPC, R_rows=[[0.1]] * 11 + [[0], [0.1]], Q_rows=weights["Q_rows"])
    for k in range(16):  # a free input is decided where a later state has a weight
        assert mpc([0.2, 0.1], [0, 0]).status.name in ("UNCONSTRAINED", "OPTIMAL"), k
    model, u = mpc.predictor, mpc([0.2, 0.1], [0, 0]).u
    with pytest.raises(km.errors.DefinitenessError, match="some change of the inp"):
        mpc.update(replace(model, B=0 * model.B))
    assert mpc.predictor is model
    np.testing.assert_array_equal(mpc([0.2, 0.1], [0, 0]).u, u)  # a refused model has changed nothing


def test_laws_that_do_not_know_rows_refuse_them():
    with pytest.raises(
        km.errors.DataError, match="which a law with one gain for all steps does not know; take a Koopm"
    ):
        km.LQR(MODEL, km.Cost(Q=1, R=1, Q_rows=[[1, 2]]))
    for kind in (km.BilinearMPC, km.KoopmanMPC):
        with pytest.raises(km.errors.DataError, match="weights move in time"):
            make(kind, Q_rows=[[1, 2]]).build_program(None)
