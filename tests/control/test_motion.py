"""Cost(beyond="motion"): a reference goes on by its linear recurrence, and the end of a short plan aims there."""

import casadi as ca
import numpy as np
import pytest

import koopmpc as km

WAYS = (None, "motion", "rest")
A, B = np.array([[1.0, 0.1], [-0.2, 0.95]]), np.array([[0.005], [0.1]])


def line(x, u):
    return ca.mtimes(ca.DM(A), x) + ca.mtimes(ca.DM(B), u)


def plant():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    F, h = ca.Function("F", [x, u], [line(x, u)]), ca.Function("h", [x], [x])
    return km.StepMap(F, 0.1, h, ("p", "v"), ("u",), ("p", "v"))


@pytest.mark.parametrize("u_target", ["equilibrium", "zero"])
def test_without_limits_a_short_plan_moves_as_one_that_sees_everything(u_target):
    """The end is exact on a linear plant: eight steps with the recurrence are as good as 160 with the true rows."""
    k = np.arange(400)
    rows = 0.7 * np.sin(2 * np.pi * k / 50) + 0.2
    cost = {"Q": [5.0, 0.3], "R": 0.2, "u_target": u_target}
    rows = np.column_stack([rows, 0 * rows])
    short, blind = (km.BilinearMPC(plant(), km.Cost(**cost, beyond=way), None, 8) for way in ("motion", "rest"))
    whole = km.BilinearMPC(plant(), km.Cost(**cost), None, 160)
    for first in (0, 13, 31):
        seen = rows[first : first + 9]
        true = whole([0.1, -0.2], rows[first : first + 161]).u
        assert short([0.1, -0.2], seen).u == pytest.approx(true, rel=2e-5)
        assert abs(blind([0.1, -0.2], seen).u - true) > 1e-3


def test_a_reference_that_rests_is_followed_as_before():
    both = [km.BilinearMPC(plant(), km.Cost(Q=[5, 1], R=0.2, beyond=way), None, 8) for way in ("motion", "rest")]
    for rows in ([0.3, 0.0], np.column_stack([np.repeat([0.0, 1.0], [4, 5]), np.zeros(9)])):
        moved, rested = (one([0.1, -0.2], rows).u for one in both)
        assert (moved == rested).all()


@pytest.mark.unhooked
def test_it_is_refused_where_it_cannot_be():
    with pytest.raises(km.errors.DataError, match="leave Q_N and tail out"):
        km.Cost(Q=[1, 1], R=1, tail=0, beyond="motion")
    with pytest.raises(km.errors.DataError, match='pass "rest" or "motion"'):
        km.Cost(Q=[1, 1], R=1, beyond="hold")
    cost = km.Cost(Q=[1, 1], R=1, beyond="motion")
    with pytest.raises(km.errors.DataError, match="needs a BilinearMPC"):
        km.LinearMPC(plant(), [0, 0], [0], cost, None, 5)


def test_it_is_the_default_of_plans_over_stages_without_an_end_of_their_own():
    rows = np.column_stack([np.sin(0.2 * np.arange(9)), np.zeros(9)])
    for kind in (km.BilinearMPC, km.NonlinearMPC):
        inputs = [kind(plant(), km.Cost(Q=[5, 1], R=0.2, beyond=way), None, 8)([0.1, 0], rows).u for way in WAYS]
        assert (inputs[0] == inputs[1]).all()
        assert abs(inputs[0] - inputs[2]) > 1e-3
    assert not km.Cost(Q=1, R=1, tail=4).moves_on
    assert (
        km.LinearMPC(plant(), [0, 0], [0], km.Cost(Q=[5, 1], R=0.2), None, 8)([0.1, 0], rows).status.name
        == "UNCONSTRAINED"
    )
