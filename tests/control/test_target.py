import cvxpy as cp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from koopmpc.control.ask.limits import Interval
from koopmpc.control.step.aim import extend_rows
from koopmpc.control.target import targets
from tests.control.models import equilibrium

SEEDS = st.integers(0, 2**32 - 1)


def system(seed, nz, nu, constant):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(nz, nz)), rng.normal(size=(nz, nu))
    if constant:
        A = np.block([[A, rng.normal(size=(nz, 1))], [np.zeros((1, nz)), np.ones((1, 1))]])
        B = np.vstack([B, np.zeros((1, nu))])
    nr = int(rng.integers(1, nz + 1))
    half = rng.normal(size=(nr, nr))
    Q = (half @ half.T + 0.1 * np.eye(nr)) * 10 ** rng.uniform(-4, 3)
    return rng, A, B, rng.normal(size=(nr, len(A))), Q, nz if constant else None


def is_equilibrium(A, B, z, u, constant):
    residual = np.abs(A @ z + B @ u - z)
    assert residual.max() <= 1e-7 * (1 + np.abs(z).max() + np.abs(u).max())
    if constant is not None:
        assert z[constant] == 1.0


@given(seed=SEEDS, nz=st.integers(1, 5), nu=st.integers(1, 2), constant=st.booleans())
def test_without_limits_it_is_the_nearest_equilibrium(seed, nz, nu, constant):
    rng, A, B, C, Q, pinned = system(seed, nz, nu, constant)
    nothing = np.zeros((0, len(A)))
    free, no = Interval(np.full(nu, -np.inf), np.full(nu, np.inf)), Interval(np.zeros(0), np.zeros(0))
    found = targets(A, B, C, np.linalg.cholesky(Q).T, free, (nothing, no), pinned, hold=True)
    R = rng.normal(size=(3, len(C)))
    for r, alpha in zip(R, found.coordinates(R), strict=True):
        z, u = found.z0 + found.Z @ alpha, found.u0 + found.W @ alpha
        is_equilibrium(A, B, z, u, pinned)
        other, _ = equilibrium(A, B, C, Q, r, pinned)
        distance = lambda v, r=r: (C @ v - r) @ Q @ (C @ v - r)  # noqa: E731
        assert distance(z) <= distance(other) * (1 + 1e-6) + 1e-9 * np.trace(Q)
    at_zero = targets(A, B, C, np.linalg.cholesky(Q).T, free, (nothing, no), pinned, hold=False)
    assert not at_zero.u0.any()
    assert not at_zero.W.any()
    np.testing.assert_array_equal(at_zero.coordinates(R), found.coordinates(R))


@given(seed=SEEDS, nz=st.integers(1, 5), nu=st.integers(1, 2), size=st.sampled_from([0.1, 1.0, 100.0]))
def test_with_limits_it_is_the_nearest_inside_them(seed, nz, nu, size):
    """The Q-distance equals CVXPY's; references far outside come back to the limits."""
    rng, A, B, C, Q, _ = system(seed, nz, nu, constant=False)
    G = rng.normal(size=(int(rng.integers(0, 3)), nz))
    inputs = Interval(-(high := rng.uniform(0.1, 1, nu)), high)
    outputs = Interval(-(high := rng.uniform(0.1, 2, len(G))), high)
    found = targets(A, B, C, np.linalg.cholesky(Q).T, inputs, (G, outputs), None, hold=True)
    r = size * rng.normal(size=len(C))
    alpha = found.coordinates(r[None])[0]
    z, u = found.z0 + found.Z @ alpha, found.u0 + found.W @ alpha
    is_equilibrium(A, B, z, u, None)
    for values, (low, high) in ((u, inputs), (G @ z, outputs)):
        assert (values >= low - 1e-6).all()
        assert (values <= high + 1e-6).all()
    Z, U = cp.Variable(nz), cp.Variable(nu)
    held = [A @ Z + B @ U == Z, cp.abs(U) <= inputs.high]
    if len(G):
        held += [cp.abs(G @ Z) <= outputs.high]
    root = np.linalg.cholesky(Q / np.trace(Q)).T
    problem = cp.Problem(cp.Minimize(cp.sum_squares(root @ (C @ Z - r))), held)
    problem.solve(cp.CLARABEL)
    error = root @ (C @ z - r)
    assert error @ error <= problem.value + 1e-5 * (r @ r + 1)


def test_where_no_equilibrium_meets_the_state_limits_the_inputs_still_hold():
    """Rest at 4 ≤ x ≤ 5 would take |u| > 1: the target is the nearest that the inputs hold."""
    A, B = np.array([[0.5]]), np.array([[1.0]])
    state = Interval(np.array([4.0]), np.array([5.0]))  # x = 2 u at rest
    found = targets(A, B, np.eye(1), np.eye(1), Interval(-np.ones(1), np.ones(1)), (np.eye(1), state), None, hold=True)
    alpha = found.coordinates(np.array([[4.5]]))[0]
    np.testing.assert_allclose(found.z0 + found.Z @ alpha, [2.0], atol=1e-6)
    np.testing.assert_allclose(found.u0 + found.W @ alpha, [1.0], atol=1e-6)


def test_where_no_equilibrium_meets_the_input_limits_the_target_is_the_first_one():
    """x⁺ = x + u + 0.5 rests at u = −0.5 alone, which 0 ≤ u ≤ 1 does not allow."""
    A, B = np.array([[1.0, 0.5], [0.0, 1.0]]), np.array([[1.0], [0.0]])
    none = Interval(np.zeros(0), np.zeros(0))
    found = targets(
        A, B, np.eye(1, 2), np.eye(1), Interval(np.zeros(1), np.ones(1)), (np.zeros((0, 2)), none), 1, hold=True
    )
    for r in (4.5, -3.0):
        alpha = found.coordinates(np.array([[r], [2 * r]]))
        assert alpha.shape == (2, found.Z.shape[1])
        assert not alpha.any()


@given(seed=SEEDS, nz=st.integers(1, 4), nu=st.integers(1, 2), size=st.sampled_from([0.1, 1.0, 30.0]))
def test_a_disturbance_is_a_constant_of_the_model(seed, nz, nu, size):
    """The equilibria of A z + B u + e are those of the model whose Constant adds e, inside the limits and without."""
    rng, A, B, C, Q, _ = system(seed, nz, nu, constant=False)
    e, root = 0.1 * rng.normal(size=nz), np.linalg.cholesky(Q).T
    G, R_root = rng.normal(size=(1, nz)), np.diag(rng.uniform(0.2, 5, nu))
    inputs, outputs = Interval(-2 * np.ones(nu), np.ones(nu)), Interval(np.full(1, -np.inf), np.full(1, 2.0))
    whole = np.block([[A, e[:, None]], [np.zeros((1, nz)), np.ones((1, 1))]])
    pushed = targets(A, B, C, root, inputs, (G, outputs), None, hold=True, R_root=R_root)
    own = targets(
        whole,
        np.vstack([B, np.zeros((1, nu))]),
        np.hstack([C, np.zeros((len(C), 1))]),
        root,
        inputs,
        (np.hstack([G, np.zeros((1, 1))]), outputs),
        nz,
        hold=True,
        R_root=R_root,
    )
    R = size * rng.normal(size=(3, len(C)))
    for found, wanted in zip(pushed.coordinates(R, e), own.coordinates(R), strict=True):
        z = pushed.z0 + pushed.z_disturbance @ e + pushed.Z @ found
        u = pushed.u0 + pushed.u_disturbance @ e + pushed.W @ found
        scale = 1 + np.abs(z).max() + np.abs(u).max()
        np.testing.assert_allclose(A @ z + B @ u + e, z, atol=1e-7 * scale)
        other_z, other_u = own.z0 + own.Z @ wanted, own.u0 + own.W @ wanted
        assert np.linalg.norm(root @ C @ (z - other_z[:nz])) <= 1e-4 * (1 + np.linalg.norm(root @ C @ z))
        if np.abs(u - other_u).max() > 1e-4 * scale:  # as near, and u costs as much
            assert np.linalg.norm(R_root @ u) <= np.linalg.norm(R_root @ other_u) * (1 + 1e-3) + 1e-3


@given(seed=SEEDS, nz=st.integers(1, 3))
def test_of_all_equilibria_as_near_the_one_that_costs_least_is_taken(seed, nz):
    """Two inputs more than tracked outputs: ‖u‖_R is least among all that hold r, by the equations of Lagrange."""
    rng = np.random.default_rng(seed)
    nu = nz + 1
    A, B, C = 0.5 * rng.normal(size=(nz, nz)), rng.normal(size=(nz, nu)), rng.normal(size=(1, nz))
    R = np.diag(rng.uniform(0.2, 5, nu))
    none, free = Interval(np.zeros(0), np.zeros(0)), Interval(np.full(nu, -np.inf), np.full(nu, np.inf))
    found = targets(A, B, C, np.eye(1), free, (np.zeros((0, nz)), none), None, hold=True, R_root=np.sqrt(R))
    r, e = rng.normal(size=1), 0.3 * rng.normal(size=nz)
    alpha = found.coordinates(r[None], e)[0]
    u = found.u0 + found.u_disturbance @ e + found.W @ alpha
    z = found.z0 + found.z_disturbance @ e + found.Z @ alpha
    E = np.block([[A - np.eye(nz), B], [C, np.zeros((1, nu))]])
    H = np.zeros((nz + nu, nz + nu))
    H[nz:, nz:] = R
    K = np.block([[H, E.T], [E, np.zeros((nz + 1, nz + 1))]])
    exact = np.linalg.lstsq(K, np.concatenate([np.zeros(nz + nu), -e, r]), rcond=None)[0]
    np.testing.assert_allclose(u, exact[nz : nz + nu], atol=1e-6 * (1 + np.abs(u).max()))
    np.testing.assert_allclose(C @ z, r, atol=1e-7 * (1 + np.abs(z).max()))


@given(
    period=st.floats(5, 200),
    phase=st.floats(0, 6),
    slope=st.floats(-2, 2),
    offset=st.floats(-50, 50),
    size=st.floats(0.1, 9),
)
@settings(max_examples=60, deadline=None)
def test_sines_and_ramps_go_on(period, phase, slope, offset, size):
    k = np.arange(70)
    sine, ramp = size * np.sin(2 * np.pi * k / period + phase) + offset, slope * k + offset
    rows = np.column_stack([sine, ramp, np.full(70, offset)])
    for columns in (rows[:, ::2], rows[:, 1:]):
        course = extend_rows(columns[:20], 3)
        if np.ptp(columns[:20], axis=0).max() > 1e-3:
            seen = 19 if course.drifts else 50  # a ramp goes on for a horizon, and rests then
            np.testing.assert_allclose(
                course.rows[:seen], columns[20 : 20 + seen], atol=2e-4 * (1 + np.abs(rows).max())
            )
            assert (course.rows[seen:] == course.rows[seen - 1]).all() or not course.drifts


def test_rows_that_rest_or_obey_no_recurrence_do_not_go_on():
    rng = np.random.default_rng(0)
    step = np.repeat([0.0, 1.0], [9, 6])
    for resting in (np.ones(15), step):
        assert extend_rows(resting[:, None]) is None
    for column in (rng.uniform(size=15), 1.2 ** np.arange(15)):
        assert extend_rows(column[:, None]).rows.shape == (0, 1)
    assert extend_rows(np.column_stack([np.sin(np.arange(15)), rng.uniform(size=15)])).rows.shape == (0, 2)
    assert extend_rows(np.arange(5.0)[:, None]).rows.shape == (0, 1)  # too few rows to tell
    assert extend_rows(np.round(np.sin(np.arange(15) / 9), 3)[:, None]).rows.shape == (0, 1)  # and rounded ones
