import casadi as ca
import cvxpy as cp
import numpy as np
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.control.models import PRECISE, dense_plan, equilibrium, linear, random_pair
from tests.control.oracle import oracle

SEEDS = st.integers(0, 2**32 - 1)


@given(
    seed=SEEDS,
    nx=st.integers(1, 4),
    nu=st.integers(1, 3),
    N=st.integers(1, 7),
    constant=st.booleans(),
    terminal=st.sampled_from([None, "nx", "nz"]),
    target=st.sampled_from(["equilibrium", "zero"]),
)
def test_the_plan_is_the_least_squares_solution(seed, nx, nu, N, constant, terminal, target):
    rng = np.random.default_rng(seed)
    A, B = random_pair(rng, nx, nu)
    model = linear(A, B, constant=rng.normal(size=nx) if constant else None)
    size = {None: None, "nx": model.nx, "nz": model.nz}[terminal]
    half = None if size is None else rng.normal(size=(size, size))
    cost = km.Cost(
        Q=rng.uniform(0.1, 2, nx),
        R=rng.uniform(0.1, 2, nu),
        Q_N=None if half is None else half @ half.T,
        u_target=target,
    )
    rows = rng.normal(size=(N + 1, nx))
    mpc = km.KoopmanMPC(model, cost, horizon=N)
    x = rng.normal(size=nx)
    move = mpc(x, rows)
    assert move.status is km.Status.UNCONSTRAINED
    pinned = nx if constant else None
    targets = [equilibrium(model.A, model.B, model.C, np.diag(cost.Q), row, pinned, np.diag(cost.R)) for row in rows]
    if target == "zero":
        targets = [(z, np.zeros(nu)) for z, _ in targets]
    U = dense_plan(model, cost, model.lift(x), rows, targets)
    plan = mpc.plan()
    np.testing.assert_allclose(plan.U, U, atol=1e-6 * (1 + np.abs(U).max()))
    np.testing.assert_array_equal(plan.U[0], move.u)
    np.testing.assert_allclose(plan.X, model.rollout(x, plan.U), atol=1e-9 * (1 + np.abs(plan.X).max()))


def test_cost_on_observables_and_on_few_states():
    """The tracked outputs are rows of z, more or fewer than the states."""
    rng = np.random.default_rng(3)
    lifting = (km.State() + km.Fourier(1, states=["x0"])).bind(["x0", "x1"])
    A, B = random_pair(rng, lifting.nz, 1)
    model = km.LinearPredictor(A, B, np.eye(2, 4), lifting, 0.1, ("x0", "x1"), ("u0",))
    for of in (km.Fourier(1, states=["x0"]), km.State() + km.Fourier(1, states=["x0"])):
        C = np.eye(4)[[model.lifting.names.index(name) for name in of.bind(model.states).names]]
        cost = km.Cost(Q=np.ones(len(C)), R=0.1, of=of)
        rows = rng.normal(size=(9, len(C)))
        targets = [equilibrium(A, B, C, np.eye(len(C)), row) for row in rows]
        mpc = km.KoopmanMPC(model, cost, horizon=8)
        mpc([0.3, -0.2], rows)
        np.testing.assert_allclose(
            mpc.plan().U, dense_plan(model, cost, model.lift([0.3, -0.2]), rows, targets, C), atol=1e-8
        )


def plain_condensing(A, B, Q, R, P, N):
    """H and F of ½ UᵀH U + (F x)ᵀU with the inputs themselves as variables."""
    nx, nu = B.shape
    S = np.zeros((N * nx, N * nu))
    T = np.vstack([np.linalg.matrix_power(A, k + 1) for k in range(N)])
    for i in range(N):
        for j in range(i + 1):
            S[i * nx : (i + 1) * nx, j * nu : (j + 1) * nu] = np.linalg.matrix_power(A, i - j) @ B
    W = scipy.linalg.block_diag(*[Q] * (N - 1), P)
    return 2 * (S.T @ W @ S + np.kron(np.eye(N), R)), 2 * S.T @ W @ T


def test_riccati_coordinates_equal_plain_condensing_on_a_stable_plant():
    rng = np.random.default_rng(11)
    N, nu = 12, 2
    A, B = random_pair(rng, 3, nu, radius=0.9)
    Q, R = np.diag([1.0, 2, 0.5]), np.diag([0.1, 0.2])
    P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    H, F = plain_condensing(A, B, Q, R, P, N)
    assert np.linalg.cond(H) < 1e4
    mpc = km.KoopmanMPC(linear(A, B), km.Cost(Q, R), km.Limits(-0.3, 0.3), N, settings=PRECISE)
    U, met = cp.Variable(N * nu), set()
    for _ in range(10):
        x = rng.normal(size=3)
        met.add(mpc(x, np.zeros(3)).status)
        cp.Problem(cp.Minimize(0.5 * cp.quad_form(U, cp.psd_wrap(H)) + (F @ x) @ U), [U <= 0.3, U >= -0.3]).solve(
            cp.CLARABEL, tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11
        )
        np.testing.assert_allclose(mpc.plan().U.ravel(), U.value, atol=1e-5)
    assert km.Status.OPTIMAL in met


def upright_cart_pole(dt):
    """A cart of 1 kg and a pole of 0.2 kg and 0.5 m about upright: one mode grows by e^{5.4 t}."""
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 1)
    M, m, L, g = 1.0, 0.2, 0.5, 9.81
    S, C = ca.sin(x[2]), ca.cos(x[2])
    a = (u + m * S * (L * x[3] ** 2 - g * C)) / (M + m * S**2)
    f = ca.vertcat(x[1], a, x[3], (g * S - a * C) / L)
    jacobian = ca.Function("J", [x, u], [ca.jacobian(f, x), ca.jacobian(f, u)])(0, 0)
    whole = scipy.linalg.expm(dt * np.block([[jacobian[0].full(), jacobian[1].full()], [np.zeros((1, 5))]]))
    return whole[:4, :4], whole[:4, 4:]


def test_an_unstable_plant_with_a_long_horizon():
    """Where plain condensing has lost its digits, the plan still is the one with the states as variables."""
    N = 100
    A, B = upright_cart_pole(0.05)
    cost, limits = km.Cost(Q=[10, 1, 10, 1], R=0.1), km.Limits(-3.0, 3.0)
    P = scipy.linalg.solve_discrete_are(A, B, np.diag(cost.Q), np.array([[0.1]]))
    H, _ = plain_condensing(A, B, np.diag(cost.Q), np.array([[0.1]]), P, N)
    assert np.linalg.cond(H) > 1e9
    model = linear(A, B)
    mpc = km.KoopmanMPC(model, cost, limits, N, settings=PRECISE)
    x = np.array([0.5, 0.0, 0.12, 0.0])
    at_limit = 0
    for _ in range(4):
        move = mpc(x, np.zeros(4))
        U, _ = oracle(model, cost, limits, x, np.zeros((N + 1, 4)))
        np.testing.assert_allclose(mpc.plan().U, U, atol=1e-5)
        at_limit += move.status is km.Status.OPTIMAL
        x = A @ x + B @ move.u
    assert at_limit >= 3


def test_in_inputs_the_QP_is_curved_alike_along_each_of_them():
    """1 along w moves each input by its share of the room: the mean of the Hessian's diagonal over the stages is 1."""
    model, N = linear(np.array([[0.9, 0.1], [0.0, 0.8]]), np.array([[0.0, 0.3], [0.2, 0.0]])), 8
    mpc = km.KoopmanMPC(model, km.Cost([1, 1], [2, 30]), km.Limits([-1, -50], [1, 50]), N, solver="osqp")
    assert mpc.coordinates == "plain"
    np.testing.assert_allclose(np.diag(mpc.program.qp.P).reshape(N, 2).mean(axis=0), [1, 1], rtol=1e-12)


def test_an_input_without_limits_between_others_acts_as_one_with_limits_that_nothing_meets():
    A = np.array([[1.0, 0.1, 0.0], [0.0, 1.0, 0.1], [0.0, -0.2, 0.9]])
    model, cost, x = linear(A, np.diag([0.1, 0.05, 0.2])), km.Cost([1, 1, 1], 0.01), [2.0, 1.0, -1.0]
    free, far = (
        km.KoopmanMPC(model, cost, km.Limits([-3, -end, -2], [3, end, 2], x_max=[9, 0.5, 9]), 15, solver="daqp")
        for end in (np.inf, 40.0)
    )
    for k in range(10):
        one, other = free(x, np.zeros(3)), far(x, np.zeros(3))
        np.testing.assert_allclose(one.u, other.u, atol=1e-5)
        assert k > 2 or one.status is not km.Status.UNCONSTRAINED
        x = A @ x + model.B @ one.u
