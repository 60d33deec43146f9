from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from koopmpc.plants.dynamics import output, right_side
from tests.example_plants import CartPole, Pendulum, Spring


def test_right_side_is_the_model_with_its_parameters():
    f = right_side(Pendulum(damping=0.5))
    value = np.asarray(f([0.3, 2.0], [1.5])).ravel()
    assert value == pytest.approx([2.0, -9.81 * np.sin(0.3) - 1.0 + 1.5], rel=1e-15)


def test_sizes_come_from_the_names():
    assert (CartPole().nx, CartPole().nu) == (4, 1)
    assert (Spring().nx, Spring().nu) == (2, 0)


def test_outputs_keep_the_names_of_states_that_they_pass_on():
    h, names = output(Pendulum())
    assert names == Pendulum.states
    assert h.size1_out(0) == 2
    assert output(Spring())[1] == ("v [m/s]", "y1")


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
        right_side(broken(lambda x, u: ca.vertcat(x, u)))


def test_a_list_is_no_expression():
    with pytest.raises(km.errors.DataError, match=r"Broken\.rhs returned a list; return one column, ca\.vertcat"):
        right_side(broken(lambda x, u: [x[1], u]))


def test_free_symbols_are_named():
    with pytest.raises(km.errors.DataError, match=r"Broken\.rhs holds free symbols .*gain.*; make them parameters"):
        right_side(broken(lambda x, u: ca.SX.sym("gain") * x))


@pytest.mark.parametrize("states", ["theta", ["a", "b"], (1, 2)])
def test_names_are_a_tuple_of_strings(states):
    with pytest.raises(km.errors.DataError, match=r"Broken\.states is .*; pass a tuple of names"):
        right_side(broken(lambda x, u: x, states=states))


def test_a_plant_has_states():
    with pytest.raises(km.errors.DataError, match="states is empty; name at least one state"):
        right_side(broken(lambda x, u: x, states=()))


def test_constant_rows_are_allowed():
    f = right_side(broken(lambda x, u: ca.vertcat(0, x[0])))
    assert np.asarray(f([3.0, 1.0], [0.0])).ravel().tolist() == [0.0, 3.0]
