"""km.control.EigenfunctionLQR: its gain is the Riccati solution, energies arrive, limits hold, bad input is refused."""

import copy

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

import koopmpc as km

STATES = ("theta [rad]", "omega [rad/s]")
H = km.Expressions(lambda x: [x[1] ** 2 / 2 - ca.cos(x[0])], ["H"]).bind(STATES)


class Pendulum(km.Dynamics):
    """θ̈ = −sin θ + u."""

    states, inputs = STATES, ("u [1/s²]",)

    def rhs(self, x, u):
        return ca.vertcat(x[1], -ca.sin(x[0]) + u[0])


def controller(**options):
    given = {"cost": km.Cost(Q=1, R=1, of=H), "dt": 0.01, "B": [[0], [1]], "eigenvalue": 0.0} | options
    return km.control.EigenfunctionLQR(given.pop("eigenfunction", H), **given)


@pytest.mark.parametrize("rate", [-1.5, 0.0, 0.7])
def test_the_input_is_that_of_the_scalar_riccati_equation_at_the_present_b(rate):
    first = km.Expressions(lambda x: [x[0]], ["φ"]).bind(("x0", "x1"))
    R = np.array([[2.0, 0.3], [0.3, 1.0]])

    def effect(x):
        return ca.vertcat(ca.horzcat(ca.sin(x[1]), 1 + x[0] ** 2), ca.DM.zeros(1, 2))

    law = controller(
        eigenfunction=first, cost=km.Cost(Q=3.0, R=R, of=first, u_target="zero"), B=effect, eigenvalue=rate
    )
    for x in np.random.default_rng(0).uniform(-2, 2, (10, 2)):
        b = np.array([[np.sin(x[1]), 1 + x[0] ** 2]])
        P = solve_continuous_are([[rate]], b, [[3.0]], R)
        K = np.linalg.solve(R, b.T @ P)
        np.testing.assert_allclose(law(x, [0.4]).u, -(K * (x[0] - 0.4)).ravel(), rtol=1e-7)


def test_a_weight_in_brackets_is_the_same_weight():
    x, plain = [0.3, -0.7], controller(cost=km.Cost(Q=3, R=2, of=H))
    for Q in ([3.0], [[3.0]]):
        assert np.array_equal(controller(cost=km.Cost(Q=Q, R=[2.0], of=H))(x, [0.1]).u, plain(x, [0.1]).u)


def test_a_reference_off_zero_is_held_by_the_input_that_the_eigenvalue_asks_for():
    class Leak(km.Dynamics):
        states, inputs = ("level [m]",), ("flow [m/s]",)

        def rhs(self, x, u):
            return -0.5 * x + 2.0 * u

    level = km.State().bind(Leak.states)
    law = controller(eigenfunction=level, cost=km.Cost(Q=1, R=1), B=[[2.0]], eigenvalue=-0.5)
    run = km.simulate(km.discretize(Leak(), 0.01), law, x0=[0.0], reference=[0.8], steps=500)
    assert run.X[-1, 0] == pytest.approx(0.8, abs=1e-3)
    assert run.U[-1, 0] == pytest.approx(0.2, abs=1e-3)


@pytest.mark.parametrize("target", [0.0, 1.0, 2.0])
def test_the_energy_of_a_pendulum_arrives_and_the_cost_is_counted_as_for_any_controller(target):
    cost = km.Cost(Q=1, R=1, of=H)
    run = km.simulate(
        km.discretize(Pendulum(), 0.01), controller(), x0=[0.5, 0.5], reference=[target], steps=1500, cost=cost
    )
    assert np.abs(H(run.X)[-1] - target) < 1e-3
    assert km.metrics(run).cost * 0.01 == pytest.approx({0.0: 1.208, 1.0: 3.996, 2.0: 7.274}[target], rel=0.01)


def test_the_input_saturates_inside_its_limits_and_says_so():
    limits = km.Limits(u_min=-0.2, u_max=0.3, du_max=0.1)
    run = km.simulate(
        km.discretize(Pendulum(), 0.01), controller(limits=limits), x0=[0.5, 0.5], reference=[1.0], steps=4000
    )
    assert run.U.min() >= -0.2
    assert run.U.max() <= 0.3
    assert np.abs(np.diff(run.U[:, 0])).max() <= 0.1 + 1e-12
    assert {km.Status(s) for s in run.status} == {km.Status.SATURATED, km.Status.UNCONSTRAINED}
    assert np.abs(H(run.X)[-1] - 1.0) < 1e-2


def test_an_eigenfunction_from_forced_data_is_controlled_without_knowing_the_plant():
    plant = km.discretize(Pendulum(), 0.02, km.RK4(4))
    data = km.collect(plant, km.Uniform([-2, -1], [2, 1]), km.Noise(-1, 1), episodes=20, steps=100)
    library = km.State() + km.Monomials(2) + km.Fourier(1, states=[0])
    found = km.identify.eigenfunctions(data, library)[0]
    energy = found.scaled(0.5 / found.coefficients[0, found.lifting.names.index("omega^2")], "energy")
    law = km.control.EigenfunctionLQR(energy, km.Cost(Q=1, R=1, of=energy), dt=0.02)
    run = km.simulate(plant, law, x0=[0.5, 0.5], reference=[0.0], steps=750)
    assert H(run.X)[-1, 0] == pytest.approx(0.0, abs=2e-3)


def test_where_no_input_moves_the_energy_there_is_none_and_bad_measurements_hold_the_last():
    law = controller()
    assert law([0.5, 0.0], [1.0]).u == 0.0
    last = law([0.5, 0.5], [1.0]).u
    held = law([np.nan, 0.5], [1.0])
    assert held.status is km.Status.BAD_MEASUREMENT
    np.testing.assert_array_equal(held.u, last)
    law.reset(u_prev=[0.25])
    assert law([0.5, 0.5], [np.nan]).u == 0.25


def test_a_copy_goes_on_by_itself():
    law = controller(limits=km.Limits(du_max=0.1))
    law([0.5, 0.5], [1.0])
    other = copy.copy(law)
    first, second = law([0.5, 0.5], [1.0]).u, other([0.5, 0.5], [1.0]).u
    np.testing.assert_array_equal(first, second)
    assert (law.dt, law.nu, law.horizon) == (0.01, 1, 0)


@pytest.mark.unhooked
def test_bad_input_is_refused_in_a_sentence():
    pair = km.Expressions(lambda x: [x[0], x[1]], ["a", "b"]).bind(STATES)
    for options, text in (
        ({"eigenfunction": "H"}, "find one with km.identify.eigenfunctions"),
        ({"eigenfunction": pair}, "has 2 observables .*; pass a real one"),
        ({"eigenvalue": None}, "eigenvalue is missing; pass that of the observable, 0 for a conserved"),
        ({"cost": km.Cost(Q=1, R=1)}, "the cost is of theta .*, omega .*, the controller moves H"),
        ({"cost": km.Cost(Q=1, R=1, R_delta=1, of=H)}, "the cost has an R_delta or a u_target in numbers"),
        ({"cost": km.Cost(Q=1, R=0, of=H)}, "R"),
        ({"cost": km.Cost(Q=1, R=1, of=H, price=[1.0])}, "the cost has a price"),
        ({"cost": km.Cost(Q=1, R=1, of=H, stage=lambda x, u: x[0])}, "the cost has a stage of its own"),
        ({"cost": km.Cost(Q=1, R=1, of=H, Q_rows=[[1], [2]])}, "the cost has rows of weights in time"),
        ({"limits": km.Limits(u_max=np.array([[1.0], [2.0]]))}, "u_max has a row for each step"),
        ({"B": None}, "nothing says how inputs move the eigenfunction; pass B"),
        ({"B": [[1.0]]}, "B has shape"),
        ({"B": lambda x: x[0]}, "B.x. has 1 rows, expected 2, one a state"),
        ({"dt": 0.0}, "dt"),
    ):
        with pytest.raises(km.KoopmpcError, match=text):
            controller(**options)
    with pytest.raises(km.KoopmpcError, match="y has shape"):
        controller()([0.0, 0.0, 0.0], [1.0])
