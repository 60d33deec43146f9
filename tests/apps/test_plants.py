"""Trajectories are exact to far below what is reported, and feedback acts as it says."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import koopmpc as km

kaiser, plants = (km.papers.import_paper_module(name) for name in ("kaiser", "plants"))
UP = [0.0, 0.0, np.pi, 0.0]


def cart_pole(t, x, K=(0.0,) * 4, x_ref=(0.0,) * 4):
    S, C = np.sin(x[2]), np.cos(x[2])
    u = -np.dot(K, x - x_ref)
    a = (u + S * (2 * x[3] ** 2 + 9.81 * C)) / (5 + S**2)
    return [x[1], a, x[3], -(a * C + 9.81 * S) / 2]


@pytest.mark.parametrize("fed", [False, True])
def test_trajectories_agree_with_another_integrator(fed):
    K = plants.design_feedback(plants.CartPole(), UP, [5.0, 10.0, 0.0, 0.0], 1.0).K if fed else None
    start, target = [-1.0, 0.0, np.pi + 0.1, 0.0], [1.0, 0.0, np.pi, 0.0]
    X = plants.integrate_trajectories(plants.CartPole(), start, dt=0.01, steps=1000, K=K, x_ref=target)[0].X
    arguments = (K.ravel(), target) if fed else ()
    other = solve_ivp(
        cart_pole, (0, 10), start, "DOP853", np.arange(1001) * 0.01, args=arguments, rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(X, other.y.T, rtol=0, atol=1e-8)


def test_the_saddle_of_the_asymmetric_well_is_its_highest_point_between_the_wells():
    q = ca.SX.sym("q")
    energy = kaiser.POTENTIALS["asymmetric well"](q)
    slopes = ca.Function("slopes", [q], [ca.jacobian(energy, q), ca.hessian(energy, q)[0]])
    slope, bend = map(float, slopes(kaiser.SADDLE))
    assert abs(slope) < 1e-12
    assert bend < 0


def test_energy_of_the_hanging_pendulum_is_kept():
    theta, omega = plants.integrate_trajectories(plants.Pendulum(), [np.pi / 4, 0.0], dt=0.01, steps=1000)[0].X.T
    energy = 2 * omega**2 + 2 * 9.81 * (1 - np.cos(theta))
    np.testing.assert_allclose(energy, energy[0], rtol=1e-12)


def test_a_held_input_tends_to_the_continuous_one():
    def end(dt, held):
        steps = round(2 / dt)
        return plants.integrate_trajectories(
            plants.Pendulum(), [np.pi / 4, 0.0], dt=dt, steps=steps, K=[0, 3.0], held=held
        )[0].X[-1]

    gaps = [np.linalg.norm(end(dt, True) - end(dt, False)) for dt in (0.02, 0.01)]
    assert gaps[1] == pytest.approx(gaps[0] / 2, rel=0.05)  # order 1 in the sample


def test_jacobians_are_those_of_differences():
    A, B = plants.linearize_exactly(plants.CartPole(g=10.0, d=1.0), UP)
    np.testing.assert_allclose(A[1], [0, -0.2, 2.0, 0], atol=1e-12)
    np.testing.assert_allclose(A[3], [0, -0.1, 6.0, 0], atol=1e-12)
    np.testing.assert_allclose(B.ravel(), [0, 0.2, 0, 0.1], atol=1e-12)


def test_the_printed_jacobian_still_stabilises_the_true_plant():
    plant = plants.CartPole(g=10.0, d=1.0)
    A, B = plants.linearize_exactly(plant, UP)
    K = plants.design_printed_feedback(plant, [1.0, 1.0, 1.0, 1.0], 1e-4).K
    assert np.linalg.eigvals(A - B @ K).real.max() < 0


def test_recorded_inputs_are_those_of_the_feedback():
    K, start = [[0.0, 3.0]], [np.pi / 4, 0.0]
    held = plants.integrate_trajectories(plants.Pendulum(), start, dt=0.01, steps=50, K=K, held=True)
    data = plants.attach_inputs(held, plants.Pendulum.inputs, K)
    np.testing.assert_allclose(data[0].U[:, 0], -3.0 * held[0].X[:-1, 1])
    assert data.inputs == plants.Pendulum.inputs
