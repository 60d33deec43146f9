"""A stage cost of one's own: it plans what the same quadratic cost plans, is optimal by an independent solver, is
counted by metrics, kept in files, and refused where it is not known."""

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.signal import StateSpace

import koopmpc as km

A, B = np.array([[1.0, 0.2], [-0.1, 0.9]]), np.array([[0.02], [0.2]])
MODEL = km.LinearPredictor.from_state_space(StateSpace(A, B, np.eye(2), np.zeros((2, 1)), dt=0.2))
LIMITS = km.Limits(u_min=-2, u_max=2, x_min=[-3, -1], x_max=[3, 1])
END = np.diag([3.0, 1.0])
KINDS = [km.BilinearMPC, km.NonlinearMPC]


def quadratic(x, u):
    return 3 * x[0] ** 2 + 0.5 * x[1] ** 2 + 0.19 * u[0] ** 2


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rate", [None, pytest.param(0.05, marks=pytest.mark.slow)])
def test_a_quadratic_stage_plans_what_the_quadratic_cost_plans(kind, rate):
    common = {"Q_N": END, "u_target": "zero", "R_delta": rate}
    plain = kind(MODEL, km.Cost(Q=[3, 0.5], R=0.2, **common), LIMITS, 8)
    own = kind(MODEL, km.Cost(Q=0, R=0.01, stage=quadratic, **common), LIMITS, 8)
    x, limited = np.array([2.5, 0.5]), False
    for _ in range(6):
        move = plain(x, [0, 0])
        limited = limited or move.status is km.Status.OPTIMAL
        np.testing.assert_allclose(own(x, [0, 0]).u, move.u, atol=1e-4 if kind is km.NonlinearMPC else 1e-7)
        x = A @ x + B @ move.u
    assert limited


def economic(x, u):
    return ca.exp(0.6 * u[0]) + 0.2 * x[0] * u[0] + ca.log(1 + ca.exp(-4 * x[1]))


def find_best(x, N=4):
    """Return the inputs of least cost by a solver that knows nothing of stages."""

    def cost(U):
        state, total = x, 0.0
        for u in U:
            total += np.exp(0.6 * u) + 0.2 * state[0] * u + np.log(1 + np.exp(-4 * state[1])) + 0.3 * u**2
            state = A @ state + B[:, 0] * u
        return total + state @ END @ state

    found = minimize(cost, np.zeros(N), bounds=[(-2, 2)] * N, tol=1e-14, options={"maxfun": 100_000})
    return found.x


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("x", [[1.0, -0.5], [-2.0, 0.8], [0.1, 0.0]])
def test_an_economic_stage_is_planned_to_its_optimum(kind, x):
    cost = km.Cost(Q=0, R=0.3, Q_N=END, u_target="zero", stage=economic)
    options = (
        {"sqp_iterations": 100} if kind is km.BilinearMPC else {"solver": km.control.NLP(settings={"ipopt.tol": 1e-10})}
    )
    mpc = kind(MODEL, cost, km.Limits(u_min=-2, u_max=2), 4, **options)
    for _ in range(3):
        mpc(x, [0, 0])
    np.testing.assert_allclose(mpc.plan().U[:, 0], find_best(np.array(x)), atol=2e-4)


def test_a_stage_that_is_not_convex_is_said_and_still_planned_with():
    cost, x = {"Q": [1, 0.1], "R": 0.1, "u_target": "zero"}, [1.0, 0.0]
    bent = km.Cost(**cost, stage=lambda x, u: -0.05 * x[0] ** 2 + 0.1 * u[0])
    for own, convex in ((km.Cost(**cost, stage=quadratic), True), (bent, False)):
        mpc, other = km.BilinearMPC(MODEL, own, LIMITS, 6), km.NonlinearMPC(MODEL, own, LIMITS, 6)
        assert [each(x, [0, 0]).status for each in (mpc, other)] == [km.Status.OPTIMAL] * 2
        np.testing.assert_allclose(mpc.plan().U, other.plan().U, atol=2e-4)
        assert mpc.stage_is_convex is convex
    assert km.BilinearMPC(MODEL, km.Cost(**cost), LIMITS, 6).stage_is_convex


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("stage", "x"),
    [(lambda x, u: ca.fabs(x[1]) ** 1.5, [0.0, 0.0]), (lambda x, u: 5e307 * x[0] ** 2, [2.5, 0.5])],
    ids=["its curvature", "its slope"],
)
def test_a_stage_that_is_infinite_in_one_of_its_derivatives_fails_the_step_and_holds_the_input(kind, stage, x):
    mpc = kind(MODEL, km.Cost(Q=0, R=0.01, Q_N=END, u_target="zero", stage=stage), LIMITS, 8)
    move = mpc(x, [0, 0])
    assert move.status is km.Status.FAILED
    assert move.u == pytest.approx(0.0)


def test_metrics_and_files_know_the_stage(tmp_path):
    cost = km.Cost(Q=[1, 0.1], R=0.1, u_target="zero", stage=economic)
    mpc = km.BilinearMPC(MODEL, cost, LIMITS, 6)
    mpc.save(tmp_path / "mpc.npz")
    twin, plant = km.load_controller(tmp_path / "mpc.npz"), MODEL.step_map()
    runs = [km.simulate(plant, each, x0=[1.0, 0.0], reference=[0, 0], steps=6, cost=each.cost) for each in (mpc, twin)]
    np.testing.assert_array_equal(runs[0].U, runs[1].U)
    plain = km.Cost(Q=[1, 0.1], R=0.1, u_target="zero")
    X, U = runs[0].X[:-1], runs[0].U[:, 0]
    own = np.exp(0.6 * U) + 0.2 * X[:, 0] * U + np.log(1 + np.exp(-4 * X[:, 1]))
    judged = km.simulate(plant, mpc, x0=[1.0, 0.0], reference=[0, 0], steps=6, cost=plain)
    assert km.metrics(runs[0]).cost == pytest.approx(km.metrics(judged).cost + own.sum())


REFUSED = {
    "raised IndexError|raised RuntimeError": lambda x, u: x[7],
    "expected one number": lambda x, u: x,
    "the symbol p": lambda x, u: x[0] * ca.SX.sym("p"),
}


@pytest.mark.parametrize("said", REFUSED)
def test_stages_that_cannot_be_are_refused(said):
    with pytest.raises((km.errors.DataError, km.errors.ShapeError), match=said):
        km.BilinearMPC(MODEL, km.Cost(Q=1, R=1, stage=REFUSED[said]), None, 3)


def test_laws_that_do_not_know_a_stage_refuse_it(tmp_path):
    cost = km.Cost(Q=1, R=1, stage=quadratic)
    for make in (lambda: km.KoopmanMPC(MODEL, cost), lambda: km.LQR(MODEL, cost)):
        with pytest.raises(km.errors.DataError, match="stage of its own"):
            make()
    with pytest.raises(km.errors.DataError, match="its C does not know"):
        km.export(km.BilinearMPC(MODEL, cost, None, 3), tmp_path)
