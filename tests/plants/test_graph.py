import json
import pickle

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from koopmpc.plants.graph import OPERATIONS, Graph
from tests.example_plants import CartPole
from tests.roundtrip import from_data, to_data

F = km.discretize(CartPole(), 0.05).F
GRAPH = Graph.trace(F)
# CasADi makes "assign" and "constpow" itself, from nothing and from a constant exponent.
BUILT = sorted(set(OPERATIONS) - {"assign", "constpow"})


def numbers(function, V):
    """The function's own interpreter, row by row."""
    return np.array([np.asarray(function(v)).ravel() for v in V])


@pytest.mark.parametrize("name", BUILT)
def test_every_operation_is_casadis(name):
    v = ca.SX.sym("v", 2)
    operands = [v[0], v[1]][: OPERATIONS[name].operands]
    function = ca.Function("g", [v], [OPERATIONS[name].symbol(*operands)])
    graph = Graph.trace(function)
    assert name in graph.steps
    rng = np.random.default_rng(0)
    V = np.vstack([rng.uniform(0.01, 0.99, (50, 2)), rng.uniform(-4, 4, (50, 2)), [[0, 0], [1, 1], [0, 2], [-1, 0]]])
    want = numbers(function, V)
    assert np.isfinite(want).mean() > 0.2
    np.testing.assert_allclose(graph.evaluate(V), want, rtol=1e-13, atol=1e-15)
    again = ca.Function("again", [v], [graph.symbolic(v)])
    np.testing.assert_allclose(numbers(again, V), want, rtol=1e-13, atol=1e-15)


def test_constant_powers_and_constant_results():
    v = ca.SX.sym("v", 2)
    function = ca.Function("g", [v], [ca.vertcat(v[0] ** 2.5, v[1] ** 3, 4.0, 0, v[1])])
    graph, V = Graph.trace(function), np.random.default_rng(0).uniform(0.1, 2, (10, 2))
    assert "constpow" in graph.steps
    np.testing.assert_allclose(graph.evaluate(V), numbers(function, V), rtol=1e-13)
    again = ca.Function("again", [v], [graph.symbolic(v)])
    np.testing.assert_allclose(numbers(again, V), numbers(function, V), rtol=1e-13)


@given(seed=st.integers(0, 2**32 - 1), rows=st.sampled_from([0, 1, 5, 4097]))
def test_a_step_map_of_two_arguments_over_columns(seed, rows):
    V = np.random.default_rng(seed).normal(size=(rows, 5)) * [1, 3, 2, 5, 10]
    Y = GRAPH.evaluate(V)
    assert Y.shape == (rows, 4)
    for i in {0, rows // 2, rows - 1} & set(range(rows)):
        np.testing.assert_allclose(Y[i], np.asarray(F(V[i, :4], V[i, 4:])).ravel(), rtol=1e-12, atol=1e-12)


def test_symbols_rebuild_the_step_map():
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 1)
    again = ca.Function("F", [x, u], [GRAPH.symbolic(x, u)])
    at = ([0.1, 2.0, -0.4, 3.0], [5.0])
    assert np.asarray(again(*at)).tolist() == np.asarray(F(*at)).tolist()


def test_branches_take_the_side_that_is_defined():
    v = ca.SX.sym("v")
    function = ca.Function("g", [v], [ca.if_else(v > 0, ca.log(v), -1.0)])
    assert Graph.trace(function).evaluate([[-1.0], [0.0], [1.0]]).ravel().tolist() == [-1.0, -1.0, 0.0]


def test_through_json_and_back():
    tree = json.loads(json.dumps(to_data(GRAPH)))
    again = from_data(tree)
    assert again == GRAPH
    V = np.random.default_rng(0).normal(size=(10, 5))
    assert again.evaluate(V).tobytes() == GRAPH.evaluate(V).tobytes()


def test_used_graphs_pickle():
    GRAPH.evaluate(np.zeros((1, 5)))
    again = pickle.loads(pickle.dumps(GRAPH))
    assert again == GRAPH
    assert again.evaluate(np.ones((2, 5))).tobytes() == GRAPH.evaluate(np.ones((2, 5))).tobytes()


def test_matrix_functions_are_written_out():
    v = ca.MX.sym("v", 3)
    A = np.arange(6.0).reshape(2, 3)
    graph = Graph.trace(ca.Function("g", [v], [ca.DM(A) @ v]))
    assert graph.evaluate([[1, 2, 3]]).tolist() == [(A @ [1, 2, 3]).tolist()]


def test_operations_outside_the_list_are_refused_by_name():
    v = ca.SX.sym("v")
    with pytest.raises(
        km.errors.DataError, match="radial uses the operation 'erfinv', which cannot be written as data"
    ):
        Graph.trace(ca.Function("radial", [v], [ca.erfinv(v)]))
    with pytest.raises(km.errors.DataError, match="cannot be written as"):
        Graph.trace(km.discretize(CartPole(), 0.05, km.plants.ImplicitMidpoint()).F)


def test_shapes_are_named():
    v = ca.SX.sym("v")
    with pytest.raises(km.errors.ShapeError, match=r"columns has shape \(3, 4\), expected \(any, 5\)"):
        GRAPH.evaluate(np.zeros((3, 4)))
    with pytest.raises(km.errors.ShapeError, match=r"have shape \(1, 1\) together, expected \(5, 1\)"):
        GRAPH.symbolic(v)
    with pytest.raises(km.errors.ShapeError, match="g has 2 results, expected one"):
        Graph.trace(ca.Function("g", [v], [v, v]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": ["input", "system", "output"]}, "a graph has no operation 'system'"),
        ({"places": [[0, 0, 0], [0, 7, 0], [0, 0, 0]]}, r"step 'sin' at \(0, 7, 0\) uses a missing register"),
        (
            {"places": [[0, 1, 0], [0, 0, 0], [0, 0, 0]]},
            r"step 'input' at \(0, 1, 0\) uses a missing register",
        ),
        (
            {"places": [[-1, 0, 0], [0, 0, 0], [0, 0, 0]]},
            r"step 'input' at \(-1, 0, 0\) uses a missing register",
        ),
        ({"m": 2}, "1 of 2 results are written"),
        ({"steps": ["input", "sin"]}, "places has 3 rows, expected 2, one a step"),
    ],
)
def test_a_forged_file_builds_no_graph(change, message):
    v = ca.SX.sym("v")
    tree = to_data(Graph.trace(ca.Function("g", [v], [ca.sin(v)])))
    for key, value in change.items():
        if key == "places":
            tree[key]["values"] = np.ravel(value).tolist()
        else:
            tree[key] = value
    with pytest.raises(km.errors.LogError, match=message):
        from_data(tree)
