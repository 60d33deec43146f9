"""Riccati recursions: residuals and stability, and the same law by roots of P where the plain one loses all digits."""

import casadi as ca
import numpy as np
import pytest
import scipy.integrate
from hypothesis import assume, given
from hypothesis import strategies as st

import koopmpc as km
from koopmpc.control.riccati import (
    Recursion,
    Stage,
    iterate,
    leap,
    one_step,
    recurse,
    recursion,
    stationary,
    step,
    sweep_backwards,
)
from tests.control.models import random_pair

SEEDS = st.integers(0, 2**32 - 1)


def weights(rng, nx, nu):
    root = rng.normal(size=(nx, nx))
    half = rng.normal(size=(nu, nu))
    return root @ root.T + 1e-2 * np.eye(nx), half @ half.T + 1e-2 * np.eye(nu)


@given(seed=SEEDS, nx=st.integers(1, 6), nu=st.integers(1, 3))
def test_care_residual_and_stability(seed, nx, nu):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(nx, nx)), rng.normal(size=(nx, nu))
    Q, R = weights(rng, nx, nu)
    K, P = km.lqr(A, B, Q, R)
    residual = A.T @ P + P @ A - P @ B @ np.linalg.solve(R, B.T @ P) + Q
    assert np.abs(residual).max() <= 1e-8 * (1 + np.abs(P).max()) ** 2
    np.testing.assert_allclose(R @ K, B.T @ P, rtol=1e-8, atol=1e-8 * np.abs(P).max())
    assert np.linalg.eigvals(A - B @ K).real.max() < 0


@given(seed=SEEDS, nx=st.integers(1, 6), nu=st.integers(1, 3))
def test_dare_residual_and_stability(seed, nx, nu):
    rng = np.random.default_rng(seed)
    A, B = random_pair(rng, nx, nu, radius=rng.uniform(0.5, 1.5))
    Q, R = weights(rng, nx, nu)
    K, P = km.dlqr(A, B, Q, R)
    residual = Q + A.T @ P @ (A - B @ K) - P
    assert np.abs(residual).max() <= 1e-8 * (1 + np.abs(P).max()) ** 2
    assert np.abs(np.linalg.eigvals(A - B @ K)).max() < 1
    limit = stationary(one_step(A, B, Q, R), 10_000)
    np.testing.assert_allclose(limit.K, K, atol=1e-5 * (1 + np.abs(K).max()))


def jacobian(rhs, x, u):
    X, U = ca.SX.sym("x", len(x)), ca.SX.sym("u", len(u))
    f = ca.vertcat(*rhs(X, U))
    both = ca.Function("J", [X, U], [ca.jacobian(f, X), ca.jacobian(f, U)])(x, u)
    return both[0].full(), both[1].full()


def pendulum(sign):
    """θ̈ = sign (g/L) sin θ + u / (m L²), m = 1, L = 2; sign −1 hangs at θ = 0."""
    return lambda x, u: [x[1], sign * 9.81 / 2.0 * ca.sin(x[0]) + u[0] / 4.0]


def cart_pole(g, damping=0.0, m=1.0, M=5.0, L=2.0):
    """Pole mass m at the end of a rod L, θ = 0 hanging."""

    def rhs(x, u):
        S, C = ca.sin(x[2]), ca.cos(x[2])
        D = m * L**2 * (M + m * (1 - C**2))
        push = m * L * x[3] ** 2 * S - damping * x[1]
        return [
            x[1],
            (-(m**2) * L**2 * g * C * S + m * L**2 * push) / D + m * L**2 * u[0] / D,
            x[3],
            ((m + M) * m * g * L * S - m * L * C * push) / D - m * L * C * u[0] / D,
        ]

    return rhs


def upright(g, damping=0.0):
    """The same plant, its angle measured so that π is upright."""
    rhs = cart_pole(-g, damping)
    return jacobian(rhs, [0, 0, np.pi, 0], [0])


@pytest.mark.parametrize(("sign", "expected"), [(-1, [0, 3.1623]), (1, [39.24, 17.998])])
def test_gains_of_the_founding_pendulum(sign, expected):
    # Snyder & Song: Q = diag(0, 10), R = 1; hanging, pure damping √10, and upright.
    K = km.lqr(*jacobian(pendulum(sign), [0, 0], [0]), [0, 10], 1).K
    np.testing.assert_allclose(K, [expected], atol=5e-4)


@pytest.mark.parametrize(
    ("g", "expected"),
    [
        (9.81, [-2.2361, -7.9534, 175.6827, 74.7644]),
        (10.0, [-2.2361, -7.9351, 178.4349, 75.1935]),
    ],
)
def test_gains_of_the_founding_cart_pole(g, expected):
    # Snyder & Song: 2 m shift upright, Q = diag(5, 10, 0, 0), R = 1.
    K = km.lqr(*upright(g), [5, 10, 0, 0], 1).K
    np.testing.assert_allclose(K, [expected], atol=5e-5)


def test_gains_of_the_databook():
    # Brunton & Kutz, 8.7: g = 10, damping 1, Q = I, R = 1e-4; the exact Jacobian, and the matrix as printed.
    A, B = upright(10.0, damping=1.0)
    np.testing.assert_allclose(km.lqr(A, B, 1, 1e-4).K, [[-100, -197.537, 1491.281, 668.445]], atol=5e-4)
    printed = A.copy()
    printed[1, 2] *= -1
    np.testing.assert_allclose(km.lqr(printed, B, 1, 1e-4).K, [[-100, -183.179, 1683.180, 646.613]], atol=5e-4)


def test_the_slow_manifold():
    # Brunton et al. 2016: μ = −0.1, λ = 1, x₀ = [−5, 5], Q = I, R = 1, costs over 50 s.
    mu, lam = -0.1, 1.0
    A, B = np.array([[mu, 0, 0], [0, lam, -lam], [0, 0, 2 * mu]]), np.array([[0.0], [1], [0]])
    local = km.lqr(A[:2, :2], B[:2], 1, 1).K[0]
    lifted, P = km.lqr(A, B, [1, 1, 0], 1)
    np.testing.assert_allclose(local, [0, 2.414214], atol=5e-7)
    np.testing.assert_allclose(lifted, [[0, 2.414214, -1.495597]], atol=5e-7)
    z0 = np.array([-5.0, 5, 25])
    assert z0 @ P @ z0 == pytest.approx(990.180, abs=5e-4)

    def cost(feedback):
        def flow(t, s):
            u = feedback(s[0], s[1])
            return [mu * s[0], lam * (s[1] - s[0] ** 2) + u, s[0] ** 2 + s[1] ** 2 + u**2]

        return scipy.integrate.solve_ivp(flow, (0, 50), [-5, 5, 0], rtol=1e-10, atol=1e-12).y[2, -1]

    assert cost(lambda a, b: -local @ [a, b]) == pytest.approx(4485.19, abs=5e-3)
    assert cost(lambda a, b: -lifted[0] @ [a, b, a**2]) == pytest.approx(990.174, abs=5e-4)
    assert cost(lambda a, b: lam * a**2 - local[1] * b) == pytest.approx(1373.95, abs=5e-3)


def with_uncontrollable(rng, nc, nu, modes):
    """A controllable pair, maybe unstable, driven by modes that u does not move, in mixed coordinates."""
    Ac, Bc = random_pair(rng, nc, nu, radius=rng.uniform(0.9, 1.2))
    m = len(modes)
    A = np.block([[Ac, rng.normal(size=(nc, m))], [np.zeros((m, nc)), modes]])
    B = np.vstack([Bc, np.zeros((m, nu))])
    T = np.linalg.qr(rng.normal(size=(nc + m, nc + m)))[0]
    return Ac, Bc, T, T @ A @ T.T, T @ B


@given(
    seed=SEEDS,
    nc=st.integers(1, 4),
    nu=st.integers(1, 2),
    kind=st.sampled_from(["one", "turning", "unstable"]),
)
def test_the_difference_equation_is_never_refused(seed, nc, nu, kind):
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0, np.pi)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    modes = {"one": np.eye(1), "turning": rotation, "unstable": rng.uniform(1.01, 2.0) * rotation}[kind]
    Ac, Bc, T, A, B = with_uncontrollable(rng, nc, nu, modes)
    K, P = stationary(one_step(A, B, np.eye(len(A)), np.eye(nu)), 10_000)
    assert np.isfinite(P).all()
    Kc = (K @ T)[:, :nc]
    assert np.abs(np.linalg.eigvals(Ac - Bc @ Kc)).max() < 1
    np.testing.assert_allclose(Kc, km.dlqr(Ac, Bc, 1, 1).K, atol=1e-4 * (1 + np.abs(Kc).max()))


@given(
    seed=SEEDS,
    nc=st.integers(1, 4),
    nu=st.integers(1, 2),
    kind=st.sampled_from(["none", "one", "turning", "unstable"]),
    free=st.sampled_from(["none", "inputs", "changes"]),
)
def test_a_leap_is_as_many_steps_of_the_difference_equation(seed, nc, nu, kind, free):
    """Also where an input costs nothing, where its changes are weighed, and with modes that it does not move."""
    assume(free != "inputs" or nu <= nc)  # else R + BᵀPB is singular
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0, np.pi)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    modes = {"none": np.eye(0), "one": np.eye(1), "turning": rotation, "unstable": 1.3 * rotation}[kind]
    _, _, _, A, B = with_uncontrollable(rng, nc, nu, modes)
    Q, R = weights(rng, len(A), nu)
    step = one_step(A, B, Q, 0.0 * R if free == "inputs" else R, R if free == "changes" else None)
    P, taken = leap(step, 400)
    assert 1 <= taken < 400
    assert taken & (taken - 1) == 0
    plain, _ = iterate(step, step.Q, taken)
    np.testing.assert_allclose(P, P.T, rtol=0, atol=0)
    np.testing.assert_allclose(
        iterate(step, P, 1)[0].K,
        iterate(step, plain.P, 1)[0].K,
        atol=1e-8 * (1 + np.abs(plain.K).max()),
    )
    if kind == "none":
        found = stationary(step, 10_000).K
        slow = iterate(step, step.Q, 10_000)[0].K
        np.testing.assert_allclose(found, slow, atol=1e-6 * (1 + np.abs(slow).max()))


def test_a_weight_may_take_long_to_reach_an_input():
    # x₀⁺ = 1.2 x₀ + x₁ behind a chain of delays: BᵀQA = 0 for as many steps as the chain is long.
    n = 12
    A = np.diag(np.ones(n - 1), 1)
    A[0, 0] = 1.2
    B = np.eye(n, 1, -n + 1)
    K = stationary(one_step(A, B, np.diag([1.0] + [0.0] * (n - 1)), np.eye(1)), 10_000).K
    assert np.abs(np.linalg.eigvals(A - B @ K)).max() < 1


def test_an_input_may_cost_nothing():
    A, B = np.array([[1.1, 0.1], [0, 0.9]]), np.array([[0.0], [1]])
    K, P = stationary(one_step(A, B, np.eye(2), np.zeros((1, 1))), 10_000)
    np.testing.assert_allclose(np.eye(2) + A.T @ P @ (A - B @ K), P, atol=1e-6)
    assert np.abs(np.linalg.eigvals(A - B @ K)).max() < 1


@given(seed=SEEDS, nx=st.integers(1, 5), nu=st.integers(1, 2), N=st.integers(1, 6))
def test_the_recursion_is_a_bellman_equation(seed, nx, nu, N):
    """From P_N = 0 and R ≻ 0 the first gain minimises the cost of N steps, by least squares in u."""
    rng = np.random.default_rng(seed)
    A, B = random_pair(rng, nx, nu)
    Q, R = weights(rng, nx, nu)
    P_N, _ = weights(rng, nx, nu)
    stages = recursion([Stage(A, B, Q, None, R)] * N, P_N, np.zeros((nx, 0)))
    assert stages.K.shape == (N, nu, nx)
    P = P_N
    for k in range(N - 1, -1, -1):
        S = R + B.T @ P @ B
        np.testing.assert_allclose(stages.L[k] @ stages.L[k].T, S, rtol=1e-9)
        closed = A - B @ stages.K[k]
        P_k = Q + stages.K[k].T @ R @ stages.K[k] + closed.T @ P @ closed  # value of the policy
        lower = Q + A.T @ P @ A - A.T @ P @ B @ np.linalg.solve(S, B.T @ P @ A)  # least value
        np.testing.assert_allclose(P_k, lower, rtol=1e-7, atol=1e-9 * np.abs(P_k).max())
        P = P_k


def test_messages():
    A, B = np.array([[1.1, 0], [0, 0.5]]), np.array([[1.0], [0]])
    with pytest.raises(km.errors.DefinitenessError, match=r"R \+ BᵀPB is not positive definite: .* is 0; raise R"):
        stationary(one_step(A, B, np.diag([0.0, 1]), np.zeros((1, 1))), 10)
    with pytest.raises(km.errors.DefinitenessError, match=r"R is not positive definite: .* is 0; raise it"):
        km.lqr(A, B, 1, 0)
    with pytest.raises(
        km.errors.DefinitenessError, match=r"Q is indefinite: its least eigenvalue is -1; weights must be"
    ):
        km.dlqr(A, B, [1, -1], 1)
    with pytest.raises(km.errors.DefinitenessError, match=r"Q is not symmetric; pass \(M \+ Mᵀ\)/2"):
        km.dlqr(A, B, [[1, 1], [0, 1]], 1)
    with pytest.raises(km.errors.ShapeError, match=r"Q has shape \(3,\), expected \(2, 2\) or its diagonal"):
        km.lqr(A, B, [1, 1, 1], 1)
    with pytest.raises(km.errors.ShapeError, match=r"B has shape \(3, 1\), expected \(2, any\)"):
        km.lqr(A, np.ones((3, 1)), 1, 1)
    with pytest.raises(km.errors.ShapeError, match=r"A has shape \(2, 3\), expected \(2, 2\)"):
        km.lqr(np.ones((2, 3)), B, 1, 1)
    for solve, unstable in ((km.lqr, [[1.0, 0], [0, 1]]), (km.dlqr, [[0.5, 0], [0, 1.1]])):
        with pytest.raises(km.errors.DataError, match=r"no stabilising solution: .* not stabilisable"):
            solve(unstable, B, 1, 1)


@pytest.mark.parametrize("Q", [[1.0, 1.0], [0.0, 1.0], [1.0, 0.0]])
@pytest.mark.parametrize("unstable", [1.05, -1.2])
def test_a_mode_that_no_input_reaches_must_decay_by_itself(Q, unstable):
    """The other mode is stabilised, and one slow mode is enough for no law."""
    with pytest.raises(km.errors.KoopmpcError):
        km.dlqr(np.diag([unstable, 0.5]), [[0.0], [1.0]], np.diag(Q), [[1.0]])


def stage_of(rng, nx, nu, rate=False):
    """Return a random stage with known signals; its plant is unstable."""
    A = rng.standard_normal((nx, nx))
    A *= 1.1 / np.abs(np.linalg.eigvals(A)).max()
    weights = np.eye(nx), np.eye(nu), 0.3 * np.eye(nu) if rate else None
    plain = one_step(A, rng.standard_normal((nx, nu)), *weights)
    n = len(plain.Q)
    signals = {"e": (n, 3), "q": (n, 3), "r": (nu, 3)}
    return plain._replace(**{name: rng.standard_normal(shape) for name, shape in signals.items()})


def moved(stage, T):
    """Return the stage in coordinates T x."""
    back = np.linalg.inv(T)
    M = None if stage.M is None else back.T @ stage.M
    A, B, Q = T @ stage.A @ back, T @ stage.B, back.T @ stage.Q @ back
    return Stage(A, B, 0.5 * (Q + Q.T), M, stage.R, T @ stage.e, back.T @ stage.q, stage.r)


@pytest.mark.parametrize(("nx", "nu", "rate"), [(1, 1, False), (4, 2, False), (4, 2, True), (12, 3, True)])
def test_roots_find_the_law_of_the_plain_recursion(nx, nu, rate):
    stage = stage_of(np.random.default_rng(nx), nx, nu, rate)
    for one, other in zip(
        recursion([stage] * 15, stage.Q, stage.q),
        sweep_backwards([stage] * 15, stage.Q, stage.q, rooted=True),
        strict=True,
    ):
        assert other == pytest.approx(one, rel=1e-9, abs=1e-9 * np.abs(one).max())


@pytest.mark.parametrize(("condition", "accuracy"), [(1e3, 1e-7), (1e5, 1e-6), (1e7, 1e-2)])
def test_a_change_of_coordinates_that_makes_a_large_changes_no_input(condition, accuracy):
    rng = np.random.default_rng(1)
    stage = stage_of(rng, 8, 2, rate=True)
    n = len(stage.Q)
    T = np.linalg.qr(rng.standard_normal((n, n)))[0] * np.logspace(0, -np.log10(condition), n)
    T = T @ np.linalg.qr(rng.standard_normal((n, n)))[0]
    other = moved(stage, T)
    one, found = recursion([stage] * 20, stage.Q, stage.q), recursion([other] * 20, other.Q, other.q)
    assert np.abs(found.K @ T - one.K).max() < accuracy * np.abs(one.K).max()
    assert np.abs(found.v - one.v).max() < accuracy * np.abs(one.v).max()


@pytest.mark.parametrize("seed", range(5))
def test_a_valid_cost_is_never_refused_because_of_the_model(seed):
    """‖A‖ = 1e8 on observables that are almost dependent: P of the plain recursion is indefinite."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((10, 10))
    A *= 1.1 / np.abs(np.linalg.eigvals(A)).max()
    T = np.linalg.qr(rng.standard_normal((10, 10)))[0] * np.logspace(0, -9.7, 10)
    T = T @ np.linalg.qr(rng.standard_normal((10, 10)))[0]
    back = np.linalg.inv(T)
    lifting, scale = km.State() + km.Monomials(10), np.linalg.qr(T.T, mode="r")
    model = km.LinearPredictor(
        T @ A @ back,
        T @ rng.standard_normal((10, 1)),
        np.eye(1, 10),
        lifting,
        0.1,
        ("x",),
        ("u",),
        scale=scale,
    )
    assert np.linalg.norm(model.A) > 1e7
    cost = km.Cost(Q=1.0, R=1.0, u_target="zero")
    for controller in (
        km.KoopmanMPC(model, cost, km.Limits(u_min=-1, u_max=1), horizon=20),
        km.KoopmanMPC(model, km.Cost(Q=1.0, R=1.0, u_target="zero", tail=20), None, horizon=20),
    ):
        assert np.isfinite(controller([0.3], [0.0]).u).all()


def test_an_input_that_costs_nothing_is_refused_in_any_units():
    for unit in (1e-9, 1.0, 1e9):
        stage = Stage(np.eye(2), unit * np.array([[1.0, 1.0], [0.0, 0.0]]), np.eye(2), None, np.zeros((2, 2)))
        with pytest.raises(km.errors.DefinitenessError, match="raise R"):
            sweep_backwards([stage] * 3, stage.Q, np.zeros((2, 1)), rooted=True)


@pytest.mark.parametrize("rates", [False, True])
def test_gains_of_many_coordinates_by_what_a_step_adds_to_the_cost_are_those_of_the_whole_recursion(rates):
    """Three weighed outputs of 120 coordinates, one of which grows; without the last change of the input at the end."""
    rng, nz, nu = np.random.default_rng(0), 120, 2
    A, B, C = rng.normal(size=(nz, nz)), rng.normal(size=(nz, nu)), rng.normal(size=(3, nz))
    A *= 1.02 / np.abs(np.linalg.eigvals(A)).max()
    stage = one_step(A, B, C.T @ C, np.eye(nu), np.eye(nu) if rates else None)
    P = stage.Q.copy()
    if rates:
        P[nz:, nz:] = 0.0
    gains = Recursion(recurse(stage, P))
    for n in range(1, 61):
        K, L, P = step(stage, P)
        found = gains.find_step(n)
        assert found is not None
        np.testing.assert_allclose(found.K, K, atol=1e-9 * np.abs(K).max())
        np.testing.assert_allclose(found.L, L, atol=1e-9 * np.abs(L).max())
        assert found.largest == pytest.approx(np.abs(P).max())


def test_gains_end_where_rounding_hides_the_weight_of_the_inputs():
    rng, nz = np.random.default_rng(0), 120
    A, B, C = 3 * rng.normal(size=(nz, nz)), rng.normal(size=(nz, 1)), rng.normal(size=(2, nz))
    gains = Recursion(recurse(one_step(A, B, C.T @ C, np.eye(1)), C.T @ C))
    assert gains.find_step(1) is not None
    assert gains.find_step(200) is None
