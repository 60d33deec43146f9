import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.control.models import linear

A, B = np.array([[1.05, 0.1], [0.08, 1.0]]), np.array([[0.005], [0.1]])


def test_the_feedback_law_and_its_limits():
    lqr = km.LQR(linear(A, B), km.Cost([2, 1], 0.1), km.Limits(-0.5, 0.7, x_max=0.01))
    K = km.dlqr(A, B, [2, 1], 0.1).K
    np.testing.assert_allclose(lqr.gain.K, K, atol=1e-7)
    for x in ([0.05, 0.02], [0.3, 0.1], [-0.6, 0.4]):
        move, free = lqr(x, [0, 0]), -K @ x
        np.testing.assert_allclose(move.u, np.clip(free, -0.5, 0.7), atol=1e-6)
        inside = -0.5 <= free[0] <= 0.7
        assert move.status is (km.Status.UNCONSTRAINED if inside else km.Status.SATURATED)
        assert move.fallback is km.control.Fallback.NONE
        assert move.iterations == 0
    assert (lqr.dt, lqr.nu, lqr.horizon) == (0.1, 1, 0)


def test_it_does_not_look_ahead_the_first_of_several_reference_rows_counts():
    lqr = km.LQR(linear(A, B), km.Cost([2, 1], 0.1))
    x, rows = [0.3, 0.1], np.random.default_rng(0).normal(size=(5, 2))
    alone = lqr(x, rows[0]).u
    np.testing.assert_array_equal(lqr(x, rows).u, alone)
    assert abs(lqr(x, rows[1]).u - alone) > 1e-3


def test_nan_holds_the_last_input():
    lqr = km.LQR(linear(A, B), km.Cost(1, 0.1), km.Limits(-0.5, 0.5))
    for bad in ([np.nan, 0], [np.inf, 0], [0, 1e31]):
        move = lqr(bad, [0, 0])
        assert (move.status, move.fallback) == (km.Status.BAD_MEASUREMENT, km.control.Fallback.HOLD)
        np.testing.assert_array_equal(move.u, [0.0])
    u = lqr([0.02, 0.01], [0, 0]).u
    assert u[0] != 0
    for reference in ([0, 0], [np.nan, 0]):
        held = lqr([np.nan, 0], reference).u
        np.testing.assert_array_equal(held, u)
        held[:] = 99.0
    np.testing.assert_array_equal(lqr([np.nan, 0], [0, 0], applied=[np.nan]).u, u)
    np.testing.assert_array_equal(lqr([np.nan, 0], [0, 0], applied=[3.0]).u, [0.5])
    lqr.reset(u_prev=[-9.0])
    np.testing.assert_array_equal(lqr([np.nan, 0], [0, 0]).u, [-0.5])
    lqr.reset()
    np.testing.assert_array_equal(lqr([np.nan, 0], [0, 0]).u, [0.0])


def test_an_affine_model_reaches_its_own_equilibrium():
    """Linearised at a point that is not an equilibrium, the law still drives the affine model to the reference."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    f = ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.1 * (ca.sin(x[0]) + u))
    plant = km.StepMap(ca.Function("F", [x, u], [f]), 0.1)
    model = km.LinearPredictor.local(plant, [0.9, 0.4], [0.3])
    affine = plant.linearize([0.9, 0.4], [0.3])
    lqr = km.LQR(model, km.Cost([2, 1], 0.1))
    state = np.array([0.2, 0.1])
    for _ in range(300):
        state = affine.A @ state + affine.B @ lqr(state, [0.8, 0]).u + affine.c
    np.testing.assert_allclose(state, [0.8, 0], atol=1e-6)
    rest = lqr(state, [0.8, 0]).u
    np.testing.assert_allclose(affine.A @ state + affine.B @ rest + affine.c, state, atol=1e-6)


def test_messages():
    lqr = km.LQR(linear(A, B), km.Cost(1, 0.1))
    for error, text, call in (
        (km.errors.ShapeError, r"y has shape \(3,\), expected \(2,\)", lambda: lqr([0, 0, 0], [0, 0])),
        (km.errors.ShapeError, r"reference has shape \(1,\), expected \(2,\)", lambda: lqr([0, 0], [0])),
        (km.errors.ShapeError, r"applied has shape \(2,\), expected \(1,\)", lambda: lqr([0, 0], [0, 0], [0, 0])),
        (km.errors.ShapeError, r"u_prev has shape \(2,\), expected \(1,\)", lambda: lqr.reset(u_prev=[0, 0])),
        (
            km.errors.ObservableError,
            r"the lifting lacks",
            lambda: km.LQR(linear(A, B), km.Cost(1, 1, of=km.Constant())),
        ),
        (
            km.errors.DefinitenessError,
            r"R \+ BᵀPB is not positive definite: its least eigenvalue is 0; raise R, or weight a state",
            lambda: km.LQR(linear(A, B), km.Cost(0, 0)),
        ),
    ):
        with pytest.raises(error, match=text):
            call()


def test_with_a_weight_on_rates_it_is_the_unconstrained_mpc():
    cost = km.Cost([2, 1], 0.1, R_delta=0.4)
    model = linear(A, B, constant=[0.01, -0.02])
    lqr, mpc = km.LQR(model, cost), km.KoopmanMPC(model, cost, horizon=60)
    held = np.linalg.solve(np.eye(2) - A, B @ [0.1] + [0.01, -0.02])
    x = np.array([0.4, -0.3])
    for controller in (lqr, mpc):
        controller.reset(u_prev=[0.2])
    for _ in range(10):
        u = mpc(x, held).u
        np.testing.assert_allclose(lqr(x, held).u, u, atol=1e-6)
        x = A @ x + B @ u + [0.01, -0.02]


def test_rates_are_clipped():
    lqr = km.LQR(linear(A, B), km.Cost([2, 1], 0.1), km.Limits(-0.5, 0.7, du_max=0.1))
    lqr.reset(u_prev=[0.0])
    us = [lqr([-0.9, 0.4], [0, 0]) for _ in range(9)]
    np.testing.assert_allclose(np.diff([0.0, *(move.u[0] for move in us)])[:7], 0.1)
    assert us[0].status is km.Status.SATURATED
    assert us[-1].u[0] == 0.7
    np.testing.assert_allclose(lqr([-0.9, 0.4], [0, 0], applied=[0.3]).u, [0.4])
    np.testing.assert_allclose(lqr([-0.9, 0.4], [0, 0], applied=[9.0]).u, [0.7])  # the box wins
    np.testing.assert_allclose(lqr([np.nan, 0], [0, 0]).u, [0.7])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200])
def test_a_reference_or_a_disturbance_that_is_no_number_holds_the_last_input(value):
    plain = linear(A, B)
    model = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, plain.states, plain.inputs, E=[[0.1], [0.3]])
    lqr = km.LQR(model, km.Cost([2, 1], 0.1), km.Limits(-0.5, 0.5))
    u = lqr([0.02, 0.01], [0.0, 0.0]).u
    for move in (lqr([0.1, 0.0], [value, 0.0]), lqr([0.1, 0.0], [0.0, 0.0], w=[value])):
        assert move.status is km.Status.BAD_MEASUREMENT
        np.testing.assert_array_equal(move.u, u)
    assert lqr([0.02, 0.01], [0.0, 0.0]).status is km.Status.UNCONSTRAINED


def test_a_measured_disturbance_moves_the_target():
    plain = linear(A, B)
    model = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, plain.states, plain.inputs, E=[[0.1], [0.3]])
    lqr, push = km.LQR(model, km.Cost([2, 1], 0.1)), np.array([0.1, 0.3]) * 0.2
    held = np.linalg.solve(np.eye(2) - A, B @ [0.1] + push)
    x = np.zeros(2)
    for k in range(300):
        w = [0.2] if k % 2 else [[0.2], [0.7]]
        x = A @ x + B @ lqr(x, held, w=w).u + push
    np.testing.assert_allclose(x, held, atol=1e-9)
    assert lqr(x, held, w=[np.nan]).status is km.Status.BAD_MEASUREMENT
    with pytest.raises(
        km.errors.ShapeError, match=r"w has shape \(2,\), the predictor has 1 disturbances; pass one value"
    ):
        lqr(x, held, w=[0, 0])


@pytest.mark.parametrize("gain", [km.dlqr, km.lqr])
def test_a_mode_on_the_boundary_that_the_cost_does_not_see_has_no_gain(gain):
    """The Riccati equation has a solution, under which the mode stays where it is."""
    for A_, Q in (
        (np.diag([1.0 if gain is km.dlqr else 0.0, -0.5]), [0.0, 1.0]),
        (np.array([[0.0, 1.0], [-1.0, 0.0]]), [0.0, 0.0]),
    ):
        with pytest.raises(km.errors.DataError, match="Q does not see a mode on the stability boundary"):
            gain(A_, [[1.0 if Q[1] else 0.0], [1.0]], Q, 1.0)
