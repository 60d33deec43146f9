import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.control.models import PRECISE, linear, step_map

A, B = np.array([[1.02, 0.1], [0.05, 1.01]]), np.array([[0.005], [0.1]])
DRIFT = np.array([0.02, -0.03])
SHARP = {"ipopt.tol": 1e-11, "ipopt.bound_relax_factor": 0.0}
CASES = {
    "free": (km.Cost(Q=[1, 0.2], R=0.1), km.Limits()),
    "inputs": (km.Cost(Q=[1, 0.2], R=0.1), km.Limits(-0.8, 0.9)),
    "soft": (km.Cost(Q=[1, 0.2], R=0.1), km.Limits(-2, 2, x_min=[-np.inf, -0.5], x_max=[0.9, 0.4])),
    "cheap slack": (km.Cost(Q=[1, 0.2], R=0.1), km.Limits(-2, 2, x_max=[0.3, 0.2], slack=(0.4, 0.3))),
    "u_target zero": (km.Cost(Q=[1, 0.2], R=0.5, u_target="zero"), km.Limits(-0.8, 0.9)),
    "Q_N": (km.Cost(Q=[1, 0.2], R=0.1, Q_N=[[3, 1], [1, 2]]), km.Limits(-0.8, 0.9)),
    "of": (
        km.Cost(Q=1, R=0.1, of=km.Expressions(lambda x: [x[0]], ["x0"])),
        km.Limits(-0.8, 0.9, of=km.Expressions(lambda x: [x[1]], ["x1"]), y_max=0.3),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_on_a_linear_plant_it_equals_koopman_mpc(name):
    cost, limits = CASES[name]
    N, nr = 10, 1 if name == "of" else 2
    one = km.KoopmanMPC(linear(A, B, constant=DRIFT), cost, limits, N, settings=PRECISE)
    other = km.NonlinearMPC(step_map(A, B, constant=DRIFT), cost, limits, N, settings=SHARP)
    t = np.arange(40)
    signal = np.column_stack([0.6 * np.sign(np.sin(0.4 * t)), 0.2 * np.cos(0.3 * t)])[:, :nr]
    x, seen = np.array([0.6, 0.5]), set()
    for k in range(8):
        rows = signal[k : k + N + 1]
        first, second = one(x, rows), other(x, rows)
        np.testing.assert_allclose(second.u, first.u, atol=1e-5)
        np.testing.assert_allclose(other.plan().U, one.plan().U, atol=1e-4)
        np.testing.assert_allclose(other.plan().X, one.plan().X, atol=1e-4)
        assert (second.status is km.Status.SOFTENED) == (first.status is km.Status.SOFTENED)
        seen.add(first.status)
        x = A @ x + B @ first.u + DRIFT
    assert (seen == {km.Status.UNCONSTRAINED}) == (name == "free")


def test_the_plan_is_a_trajectory_of_the_model_and_u_is_fresh():
    plant = step_map(A, B)
    mpc = km.NonlinearMPC(plant, km.Cost(1, 0.1), km.Limits(-0.5, 0.5), 6)
    assert mpc.plan() is None
    move = mpc([0.4, 0.2], [0, 0])
    plan = mpc.plan()
    np.testing.assert_array_equal(plan.U[0], move.u)
    np.testing.assert_allclose(plan.X, plant.rollout([0.4, 0.2], plan.U), atol=1e-6)
    kept = plan.U.copy()
    move.u[:], plan.U[:] = 99.0, 99.0
    np.testing.assert_array_equal(mpc([np.nan, 0], [0, 0]).u, kept[1])
    assert (mpc.dt, mpc.nu, mpc.horizon) == (0.1, 1, 6)


def test_a_held_reference_is_its_rows_repeated():
    mpc = km.NonlinearMPC(step_map(A, B), km.Cost(1, 0.1), horizon=5)
    first = mpc([0.2, 0.1], [0.3, 0]).u
    for rows in ([[0.3, 0]], [[0.3, 0]] * 3, [[0.3, 0]] * 9):
        mpc.reset()
        np.testing.assert_array_equal(mpc([0.2, 0.1], rows).u, first)


def test_every_end_has_a_status_and_a_safe_input():
    short = km.NonlinearMPC(step_map(A, B), km.Cost(1, 0.1), km.Limits(-0.5, 0.5), 6, settings={"ipopt.max_iter": 1})
    move = short([2.0, 1.0], [0, 0])
    assert (move.status, move.fallback) == (km.Status.MAX_ITERATIONS, km.control.Fallback.HOLD)
    assert move.iterations == 1
    np.testing.assert_array_equal(move.u, [0.0])

    mpc = km.NonlinearMPC(step_map(A, B), km.Cost(1, 0.1), km.Limits(-1, 1, x_max=[0.5, 2], slack=None), 6)
    good = mpc([0.4, 0.1], [0, 0])
    plan = mpc.plan().U
    assert good.status is km.Status.OPTIMAL
    failed = mpc([3.0, 0.0], [0, 0])
    assert failed.status is km.Status.INFEASIBLE
    assert failed.fallback is km.control.Fallback.SHIFTED_PLAN
    assert mpc.plan() is None
    np.testing.assert_array_equal(failed.u, plan[1])
    for k in range(2, 6):
        move = mpc([0.1, np.nan], [0, 0])
        assert (move.status, move.fallback) == (km.Status.BAD_MEASUREMENT, km.control.Fallback.SHIFTED_PLAN)
        np.testing.assert_array_equal(move.u, plan[k])
    held = mpc([0.1, 0.1], [np.inf, 0])
    assert (held.status, held.fallback) == (km.Status.BAD_MEASUREMENT, km.control.Fallback.HOLD)
    np.testing.assert_array_equal(held.u, plan[-1])
    mpc.reset(u_prev=[7.0])
    np.testing.assert_array_equal(mpc([np.nan, 0], [0, 0]).u, [1.0])
    again = mpc([0.4, 0.1], [0, 0])
    assert again.status is km.Status.OPTIMAL
    np.testing.assert_allclose(again.u, good.u, atol=1e-6)


def pendulum():
    """θ̈ = (g/L) sin θ + u / (m L²): θ = 0 is upright, m = 1 kg, L = 2 m; level takes 19.6 N m."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    flow = ca.Function("f", [x, u], [ca.vertcat(x[1], 9.81 / 2 * ca.sin(x[0]) + u / 4)])
    h, state = 0.1, x
    k1 = flow(state, u)
    k2 = flow(state + h / 2 * k1, u)
    k3 = flow(state + h / 2 * k2, u)
    k4 = flow(state + h * k3, u)
    step = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return km.StepMap(ca.Function("F", [x, u], [step]), h, states=("theta", "omega"))


def test_it_swings_a_pendulum_up_with_half_the_torque_that_lifts_it():
    plant = pendulum()
    mpc = km.NonlinearMPC(plant, km.Cost(Q=[10, 1], R=0.05), km.Limits(-10, 10), 40)
    x = np.array([np.pi, 0.0])
    for _ in range(80):
        move = mpc(x, [0, 0])
        assert abs(move.u[0]) <= 10
        x = plant(x, move.u)
    np.testing.assert_allclose(np.angle(np.exp(1j * x[0])), 0, atol=1e-2)
    np.testing.assert_allclose(x[1], 0, atol=1e-2)


def test_messages():
    plant, cost = step_map(A, B), km.Cost(1, 0.1)
    for error, text, call in (
        (
            km.errors.DataError,
            r"horizon is 0; it must be at least 1",
            lambda: km.NonlinearMPC(plant, cost, horizon=0),
        ),
        (
            km.errors.ShapeError,
            r"Q has shape \(3,\), expected \(2, 2\) or its diagonal",
            lambda: km.NonlinearMPC(plant, km.Cost([1, 1, 1], 1)),
        ),
        (
            km.errors.ShapeError,
            r"Q_N has shape \(3, 3\), expected \(2, 2\)",
            lambda: km.NonlinearMPC(plant, km.Cost(1, 1, Q_N=np.eye(3))),
        ),
        (
            km.errors.ShapeError,
            r"Q_N weighs x_N − r_N, but the reference is not of the state; leave Q_N out",
            lambda: km.NonlinearMPC(plant, km.Cost(1, 1, Q_N=np.eye(2), of=km.Constant())),
        ),
        (
            km.errors.ShapeError,
            r"x_max has shape \(3,\), expected \(2,\) or a scalar",
            lambda: km.NonlinearMPC(plant, cost, km.Limits(x_max=[1, 1, 1])),
        ),
        (
            km.errors.ShapeError,
            r"y has shape \(3,\), expected \(2,\)",
            lambda: km.NonlinearMPC(plant, cost)([0] * 3, [0, 0]),
        ),
        (
            km.errors.ShapeError,
            r"reference has shape \(3,\), expected \(2,\), or rows of 2",
            lambda: km.NonlinearMPC(plant, cost)([0, 0], [0, 0, 0]),
        ),
    ):
        with pytest.raises(error, match=text):
            call()
