"""The shipped plants are the ones of the papers, and are physically right."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import solve_continuous_are

import koopmpc as km

angle, speed = st.floats(-3.1, 3.1), st.floats(-4.0, 4.0)


def right_side(dynamics):
    """Return the CasADi function ẋ = f(x, u)."""
    x, u = ca.SX.sym("x", dynamics.nx), ca.SX.sym("u", dynamics.nu)
    return ca.Function("f", [x, u], [dynamics.rhs(x, u)])


def rate(dynamics, x, u):
    return np.array(right_side(dynamics)(x, u)).ravel()


def linearised(dynamics, x, u):
    f = right_side(dynamics)
    X, U = ca.SX.sym("x", dynamics.nx), ca.SX.sym("u", dynamics.nu)
    J = ca.Function("J", [X, U], [ca.jacobian(f(X, U), X), ca.jacobian(f(X, U), U)])
    return tuple(np.array(m) for m in J(x, u))


def continuous_gain(A, B, Q, R):
    P = solve_continuous_are(A, B, Q, R)
    return np.linalg.solve(R, B.T @ P)


PENDULUM, CART_POLE = km.load_problem("pendulum"), km.load_problem("cart_pole")


def test_the_pendulum_has_the_papers_upright_gain():
    A, B = linearised(PENDULUM.dynamics, [0.0, 0.0], [0.0])
    K = continuous_gain(A, B, np.diag([0.0, 10.0]), np.eye(1))
    np.testing.assert_allclose(K, [[39.24, 17.998]], atol=1e-3)


def test_the_cart_pole_has_the_papers_gain():
    A, B = linearised(CART_POLE.dynamics, [0.0, 0.0, np.pi, 0.0], [0.0])
    K = continuous_gain(A, B, np.diag([5.0, 10.0, 0.0, 0.0]), np.eye(1))
    np.testing.assert_allclose(K, [[-2.2361, -7.9534, 175.6827, 74.7644]], atol=1e-4)


@given(angle, speed, st.floats(-25.0, 25.0))
def test_the_torques_work_is_the_pendulums_energy(theta, omega, u):
    p = PENDULUM.dynamics
    x = ca.SX.sym("x", 2)
    energy = 0.5 * p.m * (p.L * x[1]) ** 2 + p.m * p.g * p.L * ca.cos(x[0])
    slope = np.array(ca.Function("dE", [x], [ca.gradient(energy, x)])([theta, omega])).ravel()
    dx = rate(p, [theta, omega], [u])
    np.testing.assert_allclose(slope @ dx, u * omega, atol=1e-9)


@given(angle, speed, speed, st.floats(-40.0, 40.0))
def test_the_forces_work_is_the_cart_poles_energy(theta, omega, velocity, u):
    p = CART_POLE.dynamics
    x = ca.SX.sym("x", 4)
    tip = ca.vertcat(x[1] + p.L * x[3] * ca.cos(x[2]), p.L * x[3] * ca.sin(x[2]))
    energy = 0.5 * p.M * x[1] ** 2 + 0.5 * p.m * ca.sumsqr(tip) - p.m * p.g * p.L * ca.cos(x[2])
    point = [0.3, velocity, theta, omega]
    slope = np.array(ca.Function("dE", [x], [ca.gradient(energy, x)])(point)).ravel()
    dx = rate(p, point, [u])
    np.testing.assert_allclose(slope @ dx, u * velocity, atol=1e-8)


@pytest.mark.parametrize("problem", [PENDULUM, CART_POLE], ids=lambda p: p.name)
def test_references_are_held_by_an_input_inside_the_limits(problem):
    for name, case in problem.cases.items():  # f is affine in u
        free = rate(problem.dynamics, case.reference, [0.0])
        gain = rate(problem.dynamics, case.reference, [1.0]) - free
        held = -float(gain @ free) / float(gain @ gain)
        np.testing.assert_allclose(free + gain * held, 0.0, atol=1e-12)
        low, high = problem.limits_of(name).inputs(1)
        assert low[0] < held < high[0]


def test_ten_newton_metres_cannot_hold_the_pendulum_level():
    p = PENDULUM.dynamics
    assert p.m * p.g * p.L > 10.0
    assert rate(p, [np.pi / 2, 0.0], [-10.0])[1] > 0.0  # θ = 0 is upright: it still falls away
