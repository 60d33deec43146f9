import os

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import pade
from scipy.special import factorial

import koopmpc as km
from tests.example_plants import CartPole, Pendulum, Spring, energy

X0, TORQUE, END = [1.0, 0.5], 0.7, 2.0


def right_side(dynamics):
    """f of ẋ = f(x, u), traced here."""
    x, u = ca.SX.sym("x", dynamics.nx), ca.SX.sym("u", dynamics.nu)
    return ca.Function("f", [x, u], [dynamics.rhs(x, u)])


def exact():
    """x(END) by another code: Dormand & Prince's order 8 at rtol 1e-13."""
    f, x0, u, end = right_side(Pendulum(damping=0.3)), X0, TORQUE, END
    flow = solve_ivp(lambda t, x: np.asarray(f(x, u)).ravel(), (0, end), x0, method="DOP853", rtol=1e-13, atol=1e-14)
    return flow.y[:, -1]


@pytest.mark.parametrize(
    ("integrator", "order", "steps"),
    [
        (km.plants.Euler(), 1, (400, 800, 1600, 3200)),
        (km.RK4(), 4, (20, 40, 80, 160)),
        (km.RK4(substeps=3), 4, (10, 20, 40, 80)),
        (km.plants.ImplicitMidpoint(), 2, (50, 100, 200, 400)),
        (km.plants.Collocation(1), 2, (50, 100, 200, 400)),
        (km.plants.Collocation(2), 4, (10, 20, 40, 80)),
        (km.plants.Collocation(3), 6, (6, 9, 12, 18)),
    ],
    ids=repr,
)
def test_order_by_regression(integrator, order, steps):
    truth = exact()
    errors = []
    for n in steps:
        plant = km.discretize(Pendulum(damping=0.3), END / n, integrator)
        errors.append(np.abs(plant.rollout(X0, np.full((n, 1), TORQUE))[-1] - truth).max())
    slope = np.polyfit(np.log([END / n for n in steps]), np.log(errors), 1)[0]
    assert slope == pytest.approx(order, abs=0.15 * order**0.5)


@pytest.mark.parametrize("tolerance", [1e-6, 1e-8, 1e-10])
def test_cvodes_keeps_its_tolerance(tolerance):
    plant = km.discretize(Pendulum(damping=0.3), END, km.plants.CVODES(rtol=tolerance, atol=tolerance))
    assert np.abs(plant(X0, [TORQUE]) - exact()).max() < 100 * tolerance


def test_substeps_are_steps():
    fine = km.discretize(CartPole(), 0.01).rollout([0, 0.3, 0, 0], np.full((4, 1), 2.0))[-1]
    assert km.discretize(CartPole(), 0.04, km.RK4(4))([0, 0.3, 0, 0], [2.0]) == pytest.approx(
        fine, rel=1e-13, abs=1e-15
    )


def test_implicit_midpoint_has_its_own_equation():
    dt, plant = 0.1, km.discretize(CartPole(), 0.1, km.plants.ImplicitMidpoint())
    x, u = np.array([0.1, 0.5, -0.3, 2.0]), np.array([4.0])
    x_next = plant(x, u)
    slope = np.asarray(right_side(CartPole())((x + x_next) / 2, u)).ravel()
    assert x_next == pytest.approx(x + dt * slope, abs=1e-13)


@pytest.mark.parametrize("stages", [1, 2, 3, 5, 8])
def test_collocation_integrates_polynomials_below_twice_its_stages_exactly(stages):
    """x_k' = (k + 1) s^k with s' = 1, from 0 to 1: Gauss–Legendre is exact for k < 2 stages, and no further."""
    most = 2 * stages
    s, u = ca.SX.sym("s", most + 2), ca.SX.sym("u", 0)
    f = ca.Function("f", [s, u], [ca.vertcat(1, *((k + 1) * s[0] ** k for k in range(most + 1)))])
    x_next = km.StepMap(km.plants.Collocation(stages).step(f, 1.0), 1.0)(np.zeros(most + 2), [])
    assert x_next[: most + 1] == pytest.approx(np.ones(most + 1), rel=1e-11)
    assert abs(x_next[-1] - 1) > 1e-12


@pytest.mark.parametrize(
    ("integrator", "stages"),
    [(km.plants.ImplicitMidpoint(), 1), (km.plants.Collocation(2), 2), (km.plants.Collocation(4), 4)],
)
def test_gauss_methods_turn_a_linear_oscillator_by_its_pade_approximant(integrator, stages):
    A = km.discretize(Spring(), 0.5, integrator).linearize([0.0, 0.0], []).A
    assert pytest.approx(np.eye(2), abs=1e-13) == A.T @ A  # on the circle: no damping at all
    p, q = pade(1 / factorial(np.arange(2 * stages + 1)), stages)  # of exp, of degrees (stages, stages)
    step = 0.5 * np.array([[0.0, 1.0], [-1.0, 0.0]])
    values, V = np.linalg.eig(step)
    exact = (V * (p(values) / q(values))) @ np.linalg.inv(V)
    assert pytest.approx(exact.real, abs=1e-13) == A


def test_implicit_methods_take_stiff_plants_at_large_steps():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    f = ca.Function("f", [x, u], [ca.vertcat(-1e6 * (x[0] - x[1]), u - x[1])])
    plant = km.StepMap(km.plants.Collocation(2).step(f, 0.1), 0.1)
    X = plant.rollout([1e4, 1e4], np.zeros((100, 1)))
    assert X[-1, 1] == pytest.approx(1e4 * np.exp(-10), rel=1e-4)
    assert np.isfinite(X).all()


PERIOD = 2.1393  # [s] about, at 1 rad


@pytest.mark.skipif(
    os.environ.get("KOOPMPC_TESTS") == "typed", reason="takes minutes with the type hook; make test runs it"
)
@pytest.mark.parametrize("periods", [2_000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_implicit_midpoint_keeps_the_energy_for_thousands_of_periods(periods):
    plant = km.discretize(Pendulum(), PERIOD / 20, km.plants.ImplicitMidpoint())
    E = energy(plant.rollout([1.0, 0.0], np.zeros((20 * periods, 1)))).reshape(-1)
    swing = np.ptp(E[:2000])
    assert np.ptp(E) < 1.01 * swing  # as far off in the last hundred periods as in the first
    assert abs(E[-2 * periods :].mean() - E[: 2 * periods].mean()) < 1e-3 * swing


def test_the_energy_drift_of_rk4_falls_with_its_order():
    drifts, steps = [], (10, 14, 20, 28, 40)
    for n in steps:
        plant = km.discretize(Pendulum(), PERIOD / n)
        E = energy(plant.rollout([1.0, 0.0], np.zeros((200 * n, 1))))
        drifts.append(E[0] - E[-1])
    assert min(drifts) > 0
    slope = -np.polyfit(np.log(steps), np.log(drifts), 1)[0]
    assert 4 < slope < 5.5  # at least the method's order; 5 on a linear oscillator


def test_a_step_without_an_answer_is_nan_and_says_so():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    blow_up = ca.Function("f", [x, u], [x**2 + u])  # x(t) = 1/(1 − t)
    for integrator in (km.plants.CVODES(), km.plants.ImplicitMidpoint()):
        plant = km.StepMap(integrator.step(blow_up, 2.0), 2.0)
        with pytest.warns(RuntimeWarning, match=r"found no x⁺ from x=\[1\.\].*x⁺ is NaN, try a smaller dt"):
            assert np.isnan(plant(1.0, 0.0)).all()
        with pytest.warns(RuntimeWarning, match="found no x⁺"):
            X = plant.rollout([1.0], np.zeros((3, 1)))
        assert X[0] == 1.0
        assert np.isnan(X[1:]).all()


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: km.RK4(0), "substeps is 0; it must be at least 1"),
        (lambda: km.plants.Collocation(0), "degree is 0; it must be at least 1"),
        (lambda: km.plants.CVODES(rtol=0.0), "rtol is 0; it must be above zero"),
        (lambda: km.plants.CVODES(atol=-1.0), "atol is -1; it must be above zero"),
    ],
)
def test_settings_are_checked(build, message):
    with pytest.raises(km.errors.DataError, match=message):
        build()
