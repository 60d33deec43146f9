"""Limits with margins: each stage of a plan keeps its own, and a margin is capped, told, and never crosses."""

import casadi as ca
import cvxpy as cp
import numpy as np
import pytest

import koopmpc as km

A, B = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]])
Q, R, N = np.diag([1.0, 0.1]), np.array([[0.01]]), 8
BOX = {"u_min": -3, "u_max": 3, "x_min": [-5.0, -0.6], "x_max": [5.0, 0.6], "slack": None}
BAND = np.array([[0.0, 0.02], [0.0, 0.05], [0.0, 0.08], [0.0, 0.1], [0.0, 0.11], [0.0, 0.5]])
START = np.array([-1.0, 0.0])


def lifting():
    return km.State() + km.Constant()


def model():
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(4):
        X, U = [rng.uniform(-1, 1, 2)], rng.uniform(-1, 1, (20, 1))
        for u in U:
            X.append(A @ X[-1] + B @ u)
        episodes.append(km.Episode(X=np.array(X), U=U))
    return km.edmd(km.Episodes(episodes, 0.1), lifting())


def plant():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    return km.StepMap(ca.Function("F", [x, u], [ca.DM(A) @ x + ca.DM(B) @ u]), 0.1)


def controllers(limits):
    cost = km.Cost(Q=Q, R=R, Q_N=Q, u_target="zero")
    return [
        km.KoopmanMPC(model(), cost, limits, N, solver="daqp"),
        km.KoopmanMPC(model(), cost, limits, N, settings={"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 20000}),
        km.BilinearMPC(plant(), cost, limits, N, sqp_iterations=5),
        km.NonlinearMPC(plant(), cost, limits, N),
        km.NonlinearMPC(plant(), cost, limits, N, moves=N - 1),
    ]


def optimum(margin, moves=N):
    """The plan of the same program, by CVXPY."""
    X, U = cp.Variable((N + 1, 2)), cp.Variable((N, 1))
    total = sum(cp.quad_form(X[k], Q) for k in range(1, N + 1)) + sum(cp.quad_form(U[k], R) for k in range(N))
    rules = [X[0] == START, cp.abs(U) <= 3, *(U[k] == U[moves - 1] for k in range(moves, N))]
    for k in range(N):
        rules.append(X[k + 1] == A @ X[k] + B @ U[k])
        room = 0.6 - margin[min(k, len(margin) - 1), 1]
        rules += [X[k + 1, 1] <= room, X[k + 1, 1] >= -room]
    cp.Problem(cp.Minimize(total), rules).solve(solver="CLARABEL")
    return X.value, U.value


@pytest.mark.parametrize("place", range(5))
def test_each_stage_keeps_the_limit_moved_in_by_its_own_margin(place):
    limits = km.Limits(**BOX).tightened(BAND)
    controller = controllers(limits)[place]
    controller.reset()
    for _ in range(4):  # real-time iteration comes to rest at the optimum
        controller.reset()
        controller(START, [0.0, 0.0])
    X, U = optimum(BAND[:5], N - 1 if place == 4 else N)
    plan = controller.plan()
    np.testing.assert_allclose(plan.U, U, atol=2e-4)
    np.testing.assert_allclose(plan.X[1:, 1].max(), X[1:, 1].max(), atol=2e-4)
    assert X[3:, 1].max() == pytest.approx(0.6 - 0.08, abs=0.04)  # the margins are active


def test_the_band_of_five_steps_holds_for_all_later_ones_and_states_without_a_limit_have_none():
    one = km.Limits(x_min=[-np.inf, -1.0], x_max=[np.inf, 1.0]).tightened(np.full((9, 2), 0.1))
    assert np.shape(one.margin) == (5, 2)
    np.testing.assert_array_equal(one.margin, np.tile([0.0, 0.1], (5, 1)))
    assert one.capped == ()


def test_a_margin_is_at_most_a_fifth_of_the_range_and_the_result_says_where_it_was_capped():
    one = km.Limits(x_min=[0.0], x_max=[2.0]).tightened([[0.3], [0.5], [np.inf]])
    np.testing.assert_allclose(one.margin, [[0.3], [0.4], [0.4]])
    assert one.capped == (
        "state 0: from step 2 on the margin is 0.4, 20 % of the range, though the errors ask for up to inf",
    )


def test_metrics_count_from_the_limits_themselves():
    limits = km.Limits(**(BOX | {"slack": (1e4, 1e2)})).tightened(BAND)
    run = km.simulate(plant(), controllers(limits)[0], x0=START, reference=[0, 0], steps=30, limits=limits)
    assert km.metrics(run).violation == 0.0
    assert run.X[:, 1].max() < 0.6 - 0.015


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: km.Limits(x_min=[0.0], x_max=[1.0]).tightened([[0.1]], most=0.6), "limits cross once tightened"),
        (lambda: km.Limits(x_min=[0.0], x_max=[1.0], margin=[[0.6]]), "state 0 cross once tightened: 0 … 1"),
        (lambda: km.Limits(x_max=[1.0]).tightened([[np.inf]]), "infinite for a state with one limit"),
        (lambda: km.Limits(x_max=[1.0]).tightened([[-0.1]]), "0 or above"),
        (lambda: km.Limits(x_max=[1.0]).tightened([0.1]), "a row for each of 1 … h steps ahead"),
        (lambda: km.Limits(x_max=[1.0]).tightened([[np.nan]]), "NaN"),
    ],
)
def test_margins_that_make_no_sense_are_refused(make, sentence):
    with pytest.raises(km.KoopmpcError, match=sentence):
        make()


@pytest.mark.parametrize("margin", [[[0.1, -0.1]], [[0.1, 0.1], [-0.1, 0.1]], np.zeros((0, 2))])
def test_a_margin_that_widens_a_limit_is_refused(margin):
    with pytest.raises(km.errors.DataError, match="pass rows of numbers of 0 or above, one a step"):
        km.Limits(x_min=[-1.0, -1.0], x_max=[1.0, 1.0], margin=margin)
