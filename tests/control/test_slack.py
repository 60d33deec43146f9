"""How far a soft limit gives way: the same number from every controller, and that of a problem written down by hand."""

import cvxpy as cp
import numpy as np
import pytest

import koopmpc as km

A, B, N = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]]), 12
MODEL = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ("p [m]", "v [m/s]"), ("a [N]",))
COST = km.Cost(Q=[10.0, 1.0], R=0.1, Q_N=np.diag([10.0, 1.0]))
LIMITS = km.Limits(-1, 1, x_min=[-np.inf, -0.3], x_max=[np.inf, 0.3], slack=(20.0, 5.0))


def by_hand(x: np.ndarray, price: float = 20.0) -> float:
    """Return the largest slack of the optimal plan."""
    X, U, slack = cp.Variable((N + 1, 2)), cp.Variable((N, 1)), cp.Variable(N, nonneg=True)
    cost = sum(cp.sum_squares(np.diag([10**0.5, 1.0]) @ X[k]) for k in range(1, N + 1))
    cost += 0.1 * cp.sum_squares(U) + price * cp.sum(slack) + 5 * cp.sum_squares(slack)
    held = [X[0] == x, X[1:] == X[:-1] @ A.T + U @ B.T, cp.abs(U) <= 1, cp.abs(X[1:, 1]) <= 0.3 + slack]
    cp.Problem(cp.Minimize(cost), held).solve(solver="CLARABEL")
    return float(np.max(slack.value))


@pytest.mark.parametrize("x", [[0.0, 1.0], [1.0, -0.9], [0.1, 0.0]])
def test_every_controller_says_what_the_plan_of_the_problem_breaks(x: list[float]) -> None:
    expected = by_hand(np.array(x))
    exact = {"eps_abs": 1e-9, "eps_rel": 1e-9}
    for mpc in (
        km.KoopmanMPC(MODEL, COST, LIMITS, N, settings=exact),
        km.KoopmanMPC(MODEL, COST, LIMITS, N, solver="daqp"),
        km.BilinearMPC(MODEL, COST, LIMITS, N),
        km.NonlinearMPC(MODEL.step_map(), COST, LIMITS, N),
    ):
        move = mpc(x, [0.0, 0.0])
        if expected < 1e-6:
            assert move.slack == 0
            assert move.status is not km.Status.SOFTENED
        else:
            assert move.status is km.Status.SOFTENED
            assert abs(move.slack - expected) < 1e-4
            assert mpc.plan() is not None
            assert abs(np.abs(mpc.plan().X[1:, 1]).max() - 0.3 - expected) < 1e-4


@pytest.mark.parametrize("up", [0.5, np.inf])
def test_a_rate_that_the_box_overrules_is_told_in_its_unit(up: float) -> None:
    """u = 3 was applied, the limit is 1, and the rate allows 0.5: it is exceeded by 1.5."""
    limits = km.Limits(-1, 1, du_min=-0.5, du_max=up)
    for mpc in (
        km.KoopmanMPC(MODEL, COST, limits, N),
        km.BilinearMPC(MODEL, COST, limits, N),
        km.NonlinearMPC(MODEL.step_map(), COST, limits, N),
    ):
        mpc.reset(u_prev=[1.0])
        move = mpc([-5.0, 0.0], [0.0, 0.0], applied=[3.0])
        assert move.status is km.Status.SOFTENED
        assert abs(move.slack - 1.5) < 1e-6


def test_a_run_keeps_it() -> None:
    run = km.simulate(
        MODEL.step_map(), km.KoopmanMPC(MODEL, COST, LIMITS, N), x0=[0.0, 1.0], reference=[0.0, 0.0], steps=20
    )
    gave = np.array([status is km.Status.SOFTENED for status in run.status])
    assert gave.any()
    assert ((run.slack > 0) == gave).all()


@pytest.mark.parametrize("solver", ["osqp", "daqp"])
@pytest.mark.parametrize(
    ("x", "price"), [([0.0, 1.0], 20.0), ([1.0, -0.9], 20.0), ([0.6, 0.0], 0.2), ([-0.6, 0.0], 0.2)]
)
def test_what_gives_way_below_gives_way_above_in_the_mirror(x: list[float], price: float, solver: str) -> None:
    """A limit that could be kept gives way where that costs more than the slack, the lower one like the upper one."""
    limits = km.Limits(-1, 1, x_min=[-np.inf, -0.3], x_max=[np.inf, 0.3], slack=(price, 5.0))
    mpc, moves = km.KoopmanMPC(MODEL, COST, limits, N, solver=solver), []
    for sign in (1, -1):
        mpc.reset()
        moves.append(mpc([sign * value for value in x], [0.0, 0.0]))
    up, down = moves
    assert up.status is down.status is km.Status.SOFTENED
    assert abs(up.slack - down.slack) < 1e-6
    assert abs(up.slack - by_hand(np.array(x), price)) < 1e-4
    np.testing.assert_allclose(up.u, -down.u, atol=1e-6)
