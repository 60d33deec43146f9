from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.example_plants import CartPole, Pendulum, Spring


def rate(dynamics, x, u, dt=0.5):
    """ẋ = f(x, u), read off a step of Euler's method."""
    return (km.discretize(dynamics, dt, km.plants.Euler())(x, u) - x) / dt


def test_a_step_map_holds_the_model_with_its_parameters():
    value = rate(Pendulum(damping=0.5), [0.3, 2.0], [1.5])
    assert value == pytest.approx([2.0, -9.81 * np.sin(0.3) - 1.0 + 1.5], rel=1e-14)


def test_sizes_come_from_the_names():
    assert (CartPole().nx, CartPole().nu) == (4, 1)
    assert (Spring().nx, Spring().nu) == (2, 0)


def test_outputs_keep_the_names_of_states_that_they_pass_on():
    plant = km.discretize(Pendulum(), 0.1)
    assert plant.outputs == Pendulum.states
    assert plant.measure([0.1, 0.2]).tolist() == [0.1, 0.2]
    assert km.discretize(Spring(), 0.1).outputs == ("v [m/s]", "y1")


def broken(returns, states=("a", "b"), inputs=("c",)):
    @dataclass(frozen=True)
    class Broken(km.Dynamics):
        def rhs(self, x, u):
            return returns(x, u)

    Broken.states, Broken.inputs = states, inputs
    return Broken()


def test_too_many_rows_are_named():
    with pytest.raises(
        km.errors.ShapeError, match=r"Broken\.rhs returned shape \(3, 1\), expected \(2, 1\), one row a state"
    ):
        km.discretize(broken(lambda x, u: ca.vertcat(x, u)), 0.1)


def test_a_list_is_no_expression():
    with pytest.raises(km.errors.DataError, match=r"Broken\.rhs returned a list; return one column, ca\.vertcat"):
        km.discretize(broken(lambda x, u: [x[1], u]), 0.1)


def test_free_symbols_are_named():
    with pytest.raises(km.errors.DataError, match=r"Broken\.rhs holds free symbols .*gain.*; make them parameters"):
        km.discretize(broken(lambda x, u: ca.SX.sym("gain") * x), 0.1)


@pytest.mark.parametrize("states", ["theta", ["a", "b"], (1, 2)])
def test_names_are_a_tuple_of_strings(states):
    with pytest.raises(km.errors.DataError, match=r"Broken\.states is .*; pass a tuple of names"):
        km.discretize(broken(lambda x, u: x, states=states), 0.1)


def test_a_plant_has_states():
    with pytest.raises(km.errors.DataError, match="states is empty; name at least one state"):
        km.discretize(broken(lambda x, u: x, states=()), 0.1)


def test_constant_rows_are_allowed():
    assert rate(broken(lambda x, u: ca.vertcat(0, x[0])), [3.0, 1.0], [0.0]).tolist() == [0.0, 3.0]
