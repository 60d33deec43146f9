"""Whether a model is a number everywhere: what is accepted never meets a NaN, and fatrop takes nothing else."""

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from koopmpc.control.nonlinear.ranges import find_undefined_operation

NAMED = {
    "pendulum": lambda x: ca.sin(x[0]) / (1 + 0.2 * ca.sin(x[0]) ** 2),
    "softplus": lambda x: ca.log(1 + ca.exp(-ca.fabs(x[0]))),
    "gaussian": lambda x: ca.exp(-(x[0] ** 2) - x[1] ** 2),
    "thin plate": lambda x: (x[0] ** 2 + 1e-6) * ca.log(x[0] ** 2 + 1e-6),
    "cubic": lambda x: x[0] ** 3 - 2 * x[1],
    "saturated": lambda x: ca.fmin(ca.fmax(x[0], -1), 1) * ca.tanh(x[1]),
    "smooth root": lambda x: ca.sqrt(x[0] ** 2 + 0.01),
}
REFUSED = {
    "root": (lambda x: ca.sqrt(x[0]), "root"),
    "root that ends": (lambda x: ca.sqrt(ca.fmax(x[0], 0)), "root"),  # it has no slope at 0
    "division": (lambda x: 1 / x[0], "division"),
    "ratio": (lambda x: x[1] / (1 + x[0]), "division"),
    "logarithm": (lambda x: ca.log(x[0]), "logarithm"),
    "power": (lambda x: ca.power(x[0], 1.5), "power"),
    "growth": (lambda x: ca.exp(x[0]), "exponential"),
    "arc": (lambda x: ca.asin(x[0]), "ASIN"),
}


def plan_with_fatrop(of):
    plant = km.LinearPredictor(np.eye(2), np.eye(2), np.eye(2), km.State(), 0.1, ("a", "b"), ("u", "v")).step_map()
    cost = km.Cost(Q=[1.0], R=0.1, of=km.Expressions(lambda x: [of(x)], ["value"]), u_target="zero", Q_N=[[1.0]])
    return km.NonlinearMPC(plant, cost, km.Limits(-1, 1), 2, solver="fatrop")


def function(of) -> ca.Function:
    x = ca.SX.sym("x", 2)
    return ca.Function("f", [x], [of(x)])


def with_slopes(f: ca.Function, at) -> np.ndarray:
    """Return the value, its gradient and its curvature."""
    x = ca.SX.sym("x", 2)
    H, g = ca.hessian(f(x), x)
    return np.array(ca.Function("all", [x], [ca.vertcat(f(x), g, ca.vec(ca.densify(H)))])(at)).ravel()


@pytest.mark.parametrize("name", NAMED)
def test_what_is_a_number_everywhere_is_accepted_and_is_one(name):
    rng, f = np.random.default_rng(0), function(NAMED[name])
    for at in [np.zeros(2), np.ones(2), -np.ones(2), *rng.normal(0, 30, (50, 2))]:
        assert np.isfinite(with_slopes(f, at)).all()
    assert np.isfinite(plan_with_fatrop(NAMED[name])([0.3, -0.2], [0.0]).u).all()


@pytest.mark.parametrize("name", REFUSED)
def test_an_observable_that_may_be_no_number_is_refused_by_its_name(name):
    of, word = REFUSED[name]
    with pytest.raises(km.errors.DataError, match=word):
        plan_with_fatrop(of)


LEAVES = st.one_of(st.sampled_from(["x", "y"]), st.floats(-3, 3).map(lambda v: round(v, 2)))
ALONE = {
    "sin": ca.sin,
    "exp": ca.exp,
    "sqrt": ca.sqrt,
    "log": ca.log,
    "tanh": ca.tanh,
    "sq": lambda e: e * e,
    "abs": ca.fabs,
}
PAIRS = {"+": lambda a, b: a + b, "-": lambda a, b: a - b, "*": lambda a, b: a * b, "/": lambda a, b: a / b}
TREES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.tuples(st.sampled_from(list(ALONE)), inner), st.tuples(st.sampled_from(list(PAIRS)), inner, inner)
    ),
    max_leaves=8,
)


def grown(tree, x):
    if isinstance(tree, tuple):
        name, *parts = tree
        return (ALONE | PAIRS)[name](*(grown(part, x) for part in parts))
    return {"x": x[0], "y": x[1]}.get(tree, ca.SX(tree) if not isinstance(tree, str) else None)


@given(TREES, st.lists(st.floats(-20, 20), min_size=2, max_size=2))
def test_no_accepted_expression_meets_what_is_no_number(tree, at):
    f = function(lambda x: grown(tree, x) + 0 * x[0])
    if find_undefined_operation(f) is None:
        values = with_slopes(f, at)
        assert np.isfinite(values).all() or np.abs(values[np.isfinite(values)]).max(initial=0) > 1e100  # an overflow


class Outflow(km.Dynamics):
    states, inputs = ("level [m]",), ("inflow [m/s]",)

    def rhs(self, x, u):
        return u - ca.sqrt(x - 0.2)


def test_fatrop_which_would_not_end_is_refused_where_a_model_may_be_no_number():
    plant = km.discretize(Outflow(), dt=0.1)
    asked = plant, km.Cost(Q=[1.0], R=0.1), km.Limits(u_min=0, u_max=2), 5
    with pytest.raises(km.errors.DataError, match=r'a root of .*pass solver="ipopt" or "sqpmethod"'):
        km.NonlinearMPC(*asked, solver="fatrop")
