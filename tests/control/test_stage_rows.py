"""Limits in time of BilinearMPC and NonlinearMPC: constant rows change nothing, moving ones give CVXPY's plan."""

import copy

import numpy as np
import pytest

import koopmpc as km
from tests.control.models import linear
from tests.control.oracle import oracle
from tests.control.test_limits_in_time import REFERENCES, constant, moving_limits

N = 8
A, B = np.array([[1.02, 0.2], [-0.1, 0.95]]), np.array([[0.02, 0.1], [0.2, -0.05]])
KINDS = [km.BilinearMPC, km.NonlinearMPC]


def cost(**more):
    return km.Cost(Q=[2, 0.5], R=[0.1, 0.2], tail=0, u_target="zero", **more)


def wander(mpc, steps, **more):
    x, moves = np.array([0.6, -0.4]), []
    mpc.reset(x)
    for k in range(steps):
        move = mpc(x, [0.4, 0.0], **{name: value(k) for name, value in more.items()})
        moves.append(move)
        x = A @ x + B @ move.u
    return moves


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("more", [{}, {"R_delta": 0.1}], ids=["plain", "rates"])
def test_constant_rows_give_the_same_inputs_to_the_bit(kind, more):
    model = linear(A, B)
    own = km.Limits(u_min=-0.6, u_max=[0.5, 0.6], x_max=[0.55, np.inf], slack=(50.0, 5.0))
    plain = wander(kind(model, cost(**more), own, N), 10)
    rows = wander(kind(model, cost(**more), constant(own), N), 10)
    called = wander(kind(model, cost(**more), own, N), 10, limits=lambda k: constant(own) if k % 2 else None)
    for a, b, c in zip(plain, rows, called, strict=True):
        assert np.array_equal(a.u, b.u)
        assert np.array_equal(a.u, c.u)
        assert a.status == b.status == c.status
    assert {m.status for m in plain} & {km.Status.OPTIMAL, km.Status.SOFTENED}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rated", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_moving_rows_give_the_plan_of_cvxpy(kind, rated):
    model, limits = linear(A, B), moving_limits(2)
    weights = cost(R_delta=0.05) if rated else cost()
    mpc, reference, x, u = kind(model, weights, limits, N), REFERENCES["moving"], np.array([0.5, -0.3]), np.zeros(2)
    mpc.reset(x, u_prev=u)
    seen = set()
    for k in range(4):
        rows = reference[k : k + N + 1]
        move = mpc(x, rows)
        seen.add(move.status)
        now = limits.with_bounds(**{end: getattr(limits, end)[k:] for end in limits.count_rows()})
        found = oracle(model, weights, now, x, rows, u_prev=u)
        np.testing.assert_allclose(mpc.plan().U, found[0], atol=2e-4)
        u, x = move.u, A @ x + B @ move.u
    assert seen & {km.Status.OPTIMAL, km.Status.SOFTENED}


@pytest.mark.parametrize("kind", KINDS)
def test_a_failed_step_keeps_its_row_and_copies_go_on(kind):
    model = linear(A, B)
    u_max = np.linspace(1.0, 0.05, 20)[:, None] * np.ones(2)
    mpc = kind(model, cost(), km.Limits(u_min=-u_max, u_max=u_max), N)
    x = np.array([-2.0, -2.0])
    for k in range(8):
        mpc.solver_fails = k % 3 > 0
        assert (np.abs(mpc(x, [2.0, 2.0]).u) <= u_max[k] + 1e-9).all()
    mpc.solver_fails = False
    twin = copy.copy(mpc)
    for k in (8, 9):
        assert (np.abs(twin(x, [2.0, 2.0]).u) <= u_max[k] + 1e-9).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_call_that_is_refused_counts_as_no_step(kind):
    u_max = np.linspace(1.0, 0.05, 20)[:, None] * np.ones(2)
    mpc, twin = (kind(linear(A, B), cost(), km.Limits(u_min=-u_max, u_max=u_max), N) for _ in range(2))
    for _ in range(3):
        with pytest.raises(km.errors.ShapeError):
            mpc([0.0, 0.0, 0.0], [2.0, 2.0])
        assert (mpc([-2.0, -2.0], [2.0, 2.0]).u == twin([-2.0, -2.0], [2.0, 2.0]).u).all()


def test_what_the_stages_do_not_have_is_refused():
    model, rows = linear(A, B), np.ones((20, 2))
    with pytest.raises(km.errors.DataError, match="du_max has rows"):
        km.BilinearMPC(model, cost(), km.Limits(-1, 1, du_max=rows), N)
    with pytest.raises(km.errors.DataError, match="moves that are held"):
        km.BilinearMPC(model, cost(), km.Limits(-1, rows), N, moves=3)
    mpc = km.BilinearMPC(model, cost(), km.Limits(-1, 1), N)
    with pytest.raises(km.errors.DataError, match="upper limit at step 0"):
        mpc([0, 0], [0, 0], limits=mpc.limits.with_bounds(x_max=1.0))


def test_a_plan_pays_for_breaking_the_row_of_its_step():
    mpc = km.BilinearMPC(
        linear(A, B), cost(), km.Limits(-1, 1, x_max=[[0.9, 9]] * 3 + [[0.1, 9]], slack=(50.0, 5.0)), N
    )
    mpc.reset([0.6, -0.4])
    mpc([0.6, -0.4], [0.4, 0.0])
    x = mpc.plan().X
    without = mpc._iteration.cost() - sum(50 * past + 5 * past**2 for past in np.maximum(x[3:, 0] - 0.1, 0.0))
    weighed = sum((each - [0.4, 0.0]) ** 2 @ [2, 0.5] for each in x[1:])
    assert without == pytest.approx(weighed + sum(u**2 @ [0.1, 0.2] for u in mpc.plan().U), rel=1e-6)
