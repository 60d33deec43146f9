"""Inputs on levels in BilinearMPC and NonlinearMPC: on a linear plant the plans of KoopmanMPC, on a nonlinear one the
best of all sequences, on levels through every failure."""

import copy
import itertools
import tracemalloc

import casadi as ca
import numpy as np
import pytest
from scipy.signal import StateSpace

import koopmpc as km

A, B = np.array([[1.0, 0.2], [-0.1, 0.9]]), np.array([[0.02], [0.2]])
MODEL = km.LinearPredictor.from_state_space(StateSpace(A, B, np.eye(2), np.zeros((2, 1)), dt=0.2))
COST = {"Q": [3, 0.5], "R": 0.02, "Q_N": np.diag([3.0, 1.0]), "u_target": "zero"}
slow = pytest.mark.slow


@pytest.mark.parametrize(
    ("kind", "rate", "moves"),
    [
        (km.BilinearMPC, None, None),
        pytest.param(km.BilinearMPC, 0.05, (1, 2, 2), marks=slow),
        pytest.param(km.NonlinearMPC, None, None, marks=slow),
        (km.NonlinearMPC, 0.05, (1, 2, 2)),
    ],
)
def test_plans_on_a_linear_plant_are_those_of_koopman_mpc(kind, rate, moves):
    limits = km.Limits(levels=[[-1, 0, 1]], dwell=[2], x_min=[-3, -0.4], x_max=[3, 0.4])
    cost = km.Cost(**COST, R_delta=rate)
    mpcs = [each(MODEL, cost, limits, 5, moves=moves) for each in (km.KoopmanMPC, kind)]
    x, used = np.array([1.5, 0.3]), set()
    for _ in range(8):
        one, other = (mpc(x, [0, 0]) for mpc in mpcs)
        np.testing.assert_array_equal(mpcs[1].plan().U, mpcs[0].plan().U)
        assert other.gap == one.gap == 0
        used.add(float(one.u[0]))
        x = A @ x + B @ one.u
    assert len(used) > 1


def test_rows_of_limits_leave_the_levels_that_koopman_mpc_takes():
    limits = km.Limits(levels=[[-1, 0, 1]], u_max=np.array([[1.0]] * 3 + [[0.2]] * 4 + [[1.0]] * 9), x_min=[-3, -0.4])
    mpcs = [each(MODEL, km.Cost(**COST), limits, 4) for each in (km.KoopmanMPC, km.NonlinearMPC)]
    x = np.array([-1.5, 0.3])
    for _ in range(8):
        one, _ = (mpc(x, [0, 0]) for mpc in mpcs)
        np.testing.assert_array_equal(mpcs[1].plan().U, mpcs[0].plan().U)
        x = A @ x + B @ one.u


@pytest.mark.parametrize("more", [{}, {"dwell": [2]}, {"du_max": 1}])
def test_sequences_cost_no_more_than_what_branch_and_bound_finds(more, monkeypatch):
    x, costs = np.array([-0.8, 0.5]), []
    for searched in (True, False):
        mpc = km.NonlinearMPC(make_swing(), km.Cost(**COST), km.Limits(levels=[[-1, 0, 1]], **more), 5)
        if not searched:
            monkeypatch.setattr(mpc._step.solver, "_rollouts", None)
        assert mpc(x, [0, 0]).status in (km.Status.OPTIMAL, km.Status.SOFTENED)
        costs.append(cost_of(x, mpc.plan().U[:, 0]))
    assert costs[0] <= costs[1] * (1 + 1e-9)


def swing(x, u):
    return ca.vertcat(x[0] + 0.2 * x[1], x[1] + 0.2 * (-ca.sin(2 * x[0]) - 0.2 * x[1] + u[0] * (1 + 0.3 * x[0])))


def make_swing():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    return km.StepMap(ca.Function("swing", [x, u], [swing(x, u)]), 0.2)


def cost_of(x, U):
    """Return what a sequence of inputs costs on the plant itself."""
    total = 0.0
    for k, u in enumerate(U):
        x = np.array(ca.DM(swing(x, [u])), dtype=float).ravel()
        total += 0.02 * u**2
        total += x @ np.diag([3.0, 1.0]) @ x if k + 1 == len(U) else 3 * x[0] ** 2 + 0.5 * x[1] ** 2
    return total


@pytest.mark.parametrize("kind", [km.BilinearMPC, km.NonlinearMPC])
def test_plans_on_a_nonlinear_plant_are_the_best_of_all_sequences(kind):
    mpc = kind(make_swing(), km.Cost(**COST), km.Limits(levels=[[-1, 0, 1]]), 4)
    for seed in range(4):
        x = np.random.default_rng(seed).uniform(-1, 1, 2)
        mpc.reset()
        mpc(x, [0, 0])
        costs = {U: cost_of(x, U) for U in itertools.product((-1.0, 0.0, 1.0), repeat=4)}
        planned = costs[tuple(mpc.plan().U[:, 0].tolist())]
        least = min(costs.values())
        assert planned == pytest.approx(least, rel=1e-9 if kind is km.NonlinearMPC else 0.02)


def test_inputs_of_too_many_combinations_of_levels_are_not_listed():
    """A move of four inputs on 31 levels each has 923,521 combinations, which took 130 MB at each step."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u", 4)
    plant = km.StepMap(ca.Function("sum", [x, u], [x - 0.1 * ca.sin(x) + 0.1 * ca.sum1(u)]), 0.1)
    limits = km.Limits(levels=[np.linspace(-1, 1, 31)] * 4)
    mpc = km.NonlinearMPC(plant, km.Cost(Q=1.0, R=0.1), limits, 1)
    tracemalloc.start()
    try:
        move = mpc([0.313], [0.1])
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert move.status is km.Status.OPTIMAL
    assert limits.input_levels(4).count_broken(move.u[None]) == (0, 0)
    assert peak < 10e6


def test_a_search_that_fixes_all_inputs_prints_nothing(capfd):
    mpc = km.NonlinearMPC(MODEL, km.Cost(**COST), km.Limits(levels=[[-1, 0, 1]], dwell=[2]), 5, moves=(1, 2, 2))
    for x in ([1.5, 0.3], [1.4, 0.1], [1.2, -0.2]):
        assert mpc(x, [0.2, 0]).status is km.Status.OPTIMAL
    assert capfd.readouterr() == ("", "")


def drive(mpc, seed, steps=30):
    """Return the inputs of a loop in which measurements and solvers fail now and then."""
    rng, x, U = np.random.default_rng(seed), np.array([1.0, 0.0]), []
    mpc.reset()
    for k in range(steps):
        mpc.solver_fails = bool(k % 7 == 3)
        y = np.array([np.nan, 0.0]) if k % 11 == 5 else x
        U.append(mpc(y, [0.3 * (k > 15), 0]).u)
        x = np.array(ca.DM(swing(x, U[-1])), dtype=float).ravel() + rng.normal(0, 0.02, 2)
    mpc.solver_fails = False
    return np.array(U)


@pytest.mark.parametrize("kind", [km.BilinearMPC, pytest.param(km.NonlinearMPC, marks=slow)])
def test_loops_stay_on_levels_and_copies_repeat_them(kind):
    limits = km.Limits(levels=[[-1, 0, 1]], dwell=[3], x_max=[1.2, 1.5])
    mpc = kind(make_swing(), km.Cost(**COST, R_delta=0.01), limits, 4)
    U = drive(mpc, 1)
    assert limits.input_levels(1).count_broken(U) == (0, 0)
    assert len(set(U.ravel())) > 1
    twin = copy.deepcopy(mpc)
    np.testing.assert_array_equal(twin([0.2, 0.1], [0, 0]).u, mpc([0.2, 0.1], [0, 0]).u)
    np.testing.assert_array_equal(drive(twin, 1), U)


@pytest.mark.parametrize("kind", [km.BilinearMPC, km.NonlinearMPC])
def test_without_time_the_levels_are_held(kind):
    mpc = kind(make_swing(), km.Cost(**COST), km.Limits(levels=[[-1, 0, 1]]), 6, time_limit=1e-6)
    mpc.reset(u_prev=[1.0])
    move = mpc([0.9, 0.3], [0, 0])
    assert (move.status.name, move.fallback.name) == ("TIME_LIMIT", "HOLD")
    assert move.u == 1.0


def test_limits_in_time_bound_the_levels():
    limits = km.Limits(levels=[[-1, 0, 1]], u_min=-1, u_max=np.repeat([[1.0], [0.0]], [3, 40], axis=0))
    mpc = km.BilinearMPC(MODEL, km.Cost(**COST), limits, 4)
    x, U = np.array([-1.5, 0.0]), []
    for _ in range(5):
        U.append(float(mpc(x, [0, 0]).u[0]))
        x = A @ x + B[:, 0] * U[-1]
    assert max(U[:3]) == 1
    assert max(U[3:]) <= 0


def test_c_code_of_levels_is_refused():
    mpc = km.BilinearMPC(MODEL, km.Cost(**COST), km.Limits(levels=[[-1, 0, 1]]), 4)
    with pytest.raises(km.errors.DataError, match="levels"):
        mpc.build_program(None)
