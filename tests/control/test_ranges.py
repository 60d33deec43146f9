"""fatrop takes models that are numbers everywhere, and refuses others by what may be none."""

import casadi as ca
import numpy as np
import pytest

import koopmpc as km

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


@pytest.mark.parametrize("name", NAMED)
def test_what_is_a_number_everywhere_is_accepted(name):
    assert np.isfinite(plan_with_fatrop(NAMED[name])([0.3, -0.2], [0.0]).u).all()


@pytest.mark.parametrize("name", REFUSED)
def test_an_observable_that_may_be_no_number_is_refused_by_its_name(name):
    of, word = REFUSED[name]
    with pytest.raises(km.errors.DataError, match=word):
        plan_with_fatrop(of)


class Outflow(km.Dynamics):
    states, inputs = ("level [m]",), ("inflow [m/s]",)

    def rhs(self, x, u):
        return u - ca.sqrt(x - 0.2)


def test_fatrop_which_would_not_end_is_refused_where_a_model_may_be_no_number():
    plant = km.discretize(Outflow(), dt=0.1)
    asked = plant, km.Cost(Q=[1.0], R=0.1), km.Limits(u_min=0, u_max=2), 5
    with pytest.raises(km.errors.DataError, match=r'a root of .*pass solver="ipopt" or "sqpmethod"'):
        km.NonlinearMPC(*asked, solver="fatrop")
