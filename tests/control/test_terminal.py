"""The terminal cost is the tail of the same tracking problem: against LQR, against Q_N = Q, against plain least squares."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest
import scipy.linalg
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from koopmpc.control.riccati import Recursion, RecursionStep, stationary
from koopmpc.control.terminal_cost import believed_steps, stop_growing_modes, tail_stage
from tests.bare import shown
from tests.control.models import Told, linear, random_pair, step_map

SEEDS = st.integers(0, 2**32 - 1)
TARGETS = st.sampled_from(["equilibrium", "zero", "given"])


def target(rng, kind, nu):
    return rng.normal(size=nu) if kind == "given" else kind


@given(
    seed=SEEDS,
    nx=st.integers(1, 4),
    nu=st.integers(1, 2),
    N=st.integers(1, 12),
    kind=TARGETS,
    reachable=st.booleans(),
    rated=st.booleans(),
)
def test_without_limits_a_tail_that_rests_makes_linear_mpc_the_lqr(seed, nx, nu, N, kind, reachable, rated):
    """Also where no equilibrium holds the reference, and where its input target is not that of an equilibrium."""
    rng = np.random.default_rng(seed)
    A, B = random_pair(rng, nx, nu, radius=rng.uniform(0.5, 1.15))
    plant = step_map(A, B, constant=0.3 * rng.normal(size=nx))
    cost = km.Cost(
        Q=rng.uniform(0.5, 2, nx),
        R=rng.uniform(0.2, 2, nu),
        R_delta=rng.uniform(0.2, 2, nu) if rated else None,
        u_target=target(rng, kind, nu),
    )
    mpc = km.LinearMPC(plant, np.zeros(nx), np.zeros(nu), cost, horizon=N)
    lqr = km.LQR(km.LinearPredictor.local(plant, np.zeros(nx), np.zeros(nu)), cost)
    r = rng.normal(size=nx)
    if reachable:
        r = np.linalg.solve(np.eye(nx) - A, B @ rng.normal(size=nu) + plant(np.zeros(nx), np.zeros(nu)))
    u = rng.normal(size=nu)
    for controller in (mpc, lqr):
        controller.reset(u_prev=u)
    for _ in range(3):
        x = rng.normal(size=nx)
        a, b = mpc(x, r), lqr(x, r)
        assert a.status is km.Status.UNCONSTRAINED
        np.testing.assert_allclose(a.u, b.u, rtol=1e-9, atol=1e-9 * (1 + np.abs(r).max()))


@given(seed=SEEDS, nx=st.integers(1, 4), nu=st.integers(1, 2), N=st.integers(1, 8), kind=TARGETS, rated=st.booleans())
def test_no_tail_is_the_weight_q_at_the_end(seed, nx, nu, N, kind, rated):
    rng = np.random.default_rng(seed)
    model = linear(*random_pair(rng, nx, nu), constant=rng.normal(size=nx))
    weights = {"Q": rng.uniform(0.1, 2, nx), "R": 0.3, "u_target": target(rng, kind, nu)}
    weights["R_delta"] = 0.5 if rated else None
    bare = km.KoopmanMPC(model, km.Cost(**weights, tail=0), horizon=N)
    plain = km.KoopmanMPC(model, km.Cost(**weights, Q_N=weights["Q"]), horizon=N)
    rows = rng.normal(size=(N + 1, nx))
    for _ in range(2):
        x = rng.normal(size=nx)
        u = bare(x, rows).u
        np.testing.assert_allclose(u, plain(x, rows).u, rtol=1e-9, atol=1e-11 * (1 + np.abs(u).max()))


def least_squares(model, cost, z, rows, targets, u_prev, blocks, M, W, d):
    """u_0 of one least-squares problem in all inputs of the horizon and of M tail steps, each with an input of its own."""
    A, B, C, nu, N = model.A, model.B, model.C, model.nu, len(rows) - 1
    starts = np.concatenate([np.repeat(np.arange(len(blocks)), blocks), len(blocks) + np.arange(M)])
    n = (starts[-1] + 1) * nu
    Q, R = (np.linalg.cholesky(M).T for M in cost.matrices(len(C), nu))
    S = np.zeros((nu, nu)) if cost.R_delta is None else np.linalg.cholesky(cost.rate(nu)).T
    state, moved, last, lhs, rhs = np.array(z), np.zeros((len(A), n)), np.zeros((nu, n)), [], []
    for k, j in enumerate(starts):
        u = np.eye(nu, n, j * nu)
        lhs += [R @ u, S @ (u - last)]
        rhs += [R @ targets[min(k, N)], S @ u_prev if k == 0 else np.zeros(nu)]
        state, moved = A @ state + model.E @ W[min(k, N - 1)] + d, A @ moved + B @ u
        lhs.append(Q @ C @ moved)
        rhs.append(Q @ (rows[min(k + 1, N)] - C @ state))
        last = u
    state = state + moved @ (U := np.linalg.lstsq(np.vstack(lhs), np.concatenate(rhs), rcond=None)[0])
    return U[:nu]


@given(
    seed=SEEDS,
    nx=st.integers(1, 3),
    nu=st.integers(1, 2),
    M=st.integers(0, 9),
    kind=TARGETS,
    rated=st.booleans(),
    latency=st.integers(0, 2),
)
def test_a_tail_is_so_many_more_steps_of_the_same_problem(seed, nx, nu, M, kind, rated, latency):
    """With blocked moves in the horizon, preview, measured and estimated disturbances, latency, and given rows."""
    rng = np.random.default_rng(seed)
    blocks = rng.integers(1, 4, size=rng.integers(1, 4)).tolist()
    N = sum(blocks)
    model = linear(*random_pair(rng, nx, nu, radius=rng.uniform(0.6, 1.2)), E=rng.normal(size=(nx, 1)))
    given_rows = rng.normal(size=(N + 3, nu))
    cost = km.Cost(
        Q=rng.uniform(0.1, 2, nx),
        R=rng.uniform(0.1, 2, nu),
        R_delta=rng.uniform(0.1, 2, nu) if rated else None,
        u_target=given_rows if kind == "given" else kind,
        tail=M,
    )
    d = 0.3 * rng.normal(size=nx)
    mpc = km.KoopmanMPC(model, cost, horizon=N, moves=blocks, estimator=Told(d), latency=latency)
    u_prev = rng.normal(size=nu)
    mpc.reset(u_prev=u_prev)
    acting = [u_prev] * latency
    for k in range(3):
        x, rows = rng.normal(size=nx), rng.normal(size=(N + 1 + latency, nx))
        W = rng.normal(size=(N + latency, 1))
        u = mpc(x, rows, w=W).u
        z = x
        for i in range(latency):
            z = model.A @ z + model.B @ acting[k + i] + model.E @ W[i] + d
        rows, W, e = rows[latency:], W[latency:], model.E @ W[-1] + d
        if kind == "equilibrium":
            targets = [equilibrium_input(model, cost, row, e) for row in rows]
        elif kind == "zero":
            targets = np.zeros((N + 1, nu))
        else:
            targets = given_rows[np.minimum(k + latency + np.arange(N + 1), N + 2)]
        best = least_squares(model, cost, z, rows, targets, u_prev, blocks, M, W, d)
        np.testing.assert_allclose(u, best, rtol=1e-6, atol=1e-7 * (1 + np.abs(best).max()))
        acting.append(u)
        u_prev = u


def equilibrium_input(model, cost, r, e):
    """The input of z = A z + B u + e that brings C z nearest to r, of all such inputs the one of least [z; u] in its span."""
    nz = len(model.A)
    span = np.linalg.svd(np.hstack([model.A - np.eye(nz), model.B]))[2][nz:].T
    base = -np.linalg.pinv(np.hstack([model.A - np.eye(nz), model.B])) @ e
    Q = np.sqrt(np.diag(cost.matrices(len(r), model.nu)[0]))[:, None]
    alpha = np.linalg.lstsq(Q * (model.C @ span[:nz]), Q[:, 0] * (r - model.C @ base[:nz]), rcond=1e-8)[0]
    return (base + span @ alpha)[nz:]


def learned(seed, noise, lifting, steps=40):
    """A model of a pendulum from noisy data, and these data."""
    rng = np.random.default_rng(seed)
    plant = km.discretize(km.load_problem("pendulum").dynamics, 0.1)
    clean = km.collect(plant, km.Uniform([-1, -2], [1, 2]), km.Noise(-4, 4, hold=3), episodes=30, steps=steps, rng=seed)
    noisy = [km.Episode(X=e.X + noise * rng.normal(size=e.X.shape), U=e.U) for e in clean]
    data = km.Episodes(noisy, clean.dt, clean.states, clean.inputs)
    return km.edmd(data, lifting), data


@pytest.mark.parametrize("rated", [False, True])
@pytest.mark.parametrize("noise", [1e-3, 3e-2])
def test_the_tail_of_a_learned_model_ends_where_its_gain_rests_as_far_as_the_model_is_accurate(noise, rated):
    lifting = km.State() + km.Constant() + km.Monomials(3)
    model, data = learned(0, noise, lifting)
    cost = {"Q": np.diag([10, 1.0]), "R": [[0.1]], "R_delta": [[0.3]] if rated else None}
    X, Y, U = data.snapshots().X, data.snapshots().X_next, data.snapshots().U
    Z = model.lifting(X)
    spread = (Z - Z.mean(axis=0)).T
    misses = Y - (Z @ model.A.T + U @ model.B.T) @ model.C.T
    accuracy = np.sqrt((misses**2).mean(axis=0) / X.var(axis=0))
    accuracy = np.sqrt((accuracy**2).mean())
    nz, A, B, Q = model.nz, model.A, model.B, model.C.T @ cost["Q"] @ model.C
    S = np.zeros((nz, 1))  # the stage cost is z'Qz + (u − v)'R_delta (u − v) + u'R u on ξ = [z; v]
    weight, R, P = Q, np.array(cost["R"]), Q
    if rated:
        D = np.array(cost["R_delta"])
        A, B = scipy.linalg.block_diag(A, 0), np.vstack([B, 1])
        weight, P = scipy.linalg.block_diag(Q, D), scipy.linalg.block_diag(Q, 0)
        S, R = np.vstack([S, -D]), R + D
    changes, K = [], np.zeros((1, len(A)))
    for _ in range(200):
        H = R + B.T @ P @ B
        K_next = np.linalg.solve(H, B.T @ P @ A + S.T)
        P = weight + A.T @ P @ A - K_next.T @ H @ K_next
        changes.append(np.linalg.norm((K_next - K)[:, :nz] @ spread) / np.linalg.norm(K_next[:, :nz] @ spread))
        K = K_next
    met = np.array(changes) <= accuracy
    n = 2 + int(np.flatnonzero(met[1:] & met[:-1])[0])  # two steps in a row, for two states

    def moved(tail):
        mpc = km.KoopmanMPC(model, km.Cost(**cost, tail=tail), horizon=8)
        return mpc([0.7, -0.3], [0.2, 0.0]).u

    np.testing.assert_allclose(moved(None), moved(n), rtol=1e-12)
    assert not np.allclose(moved(None), moved(n + 1), rtol=1e-9)
    assert n < 80


@pytest.mark.parametrize("offset", [3.0, 40.0])
def test_the_origin_of_the_states_does_not_matter_to_the_tail(offset):
    _, data = learned(0, 3e-2, km.State())
    moved = km.Episodes([km.Episode(X=e.X + offset, U=e.U) for e in data], data.dt, data.states, data.inputs)
    here, there = (
        km.KoopmanMPC(km.edmd(each, km.State() + km.Constant()), km.Cost(Q=[10, 1], R=0.1, u_target=[0.0]), horizon=8)
        for each in (data, moved)
    )
    x, r = np.array([0.7, -0.3]), np.array([0.2, 0.0])
    np.testing.assert_allclose(there(x + offset, r + offset).u, here(x, r).u, rtol=1e-7)


def test_a_model_without_errors_has_the_tail_of_a_given_one():
    rng = np.random.default_rng(1)
    A, B = random_pair(rng, 3, 1, radius=1.1)
    X = np.zeros((61, 3))
    U = rng.normal(size=(60, 1))
    for k in range(60):
        X[k + 1] = A @ X[k] + B @ U[k] if k % 6 else rng.normal(size=3)
    parts = [km.Episode(X=X[k + 1 : k + 6], U=U[k + 1 : k + 5]) for k in range(0, 54, 6)]
    fitted = km.edmd(km.Episodes(parts, 0.1), km.State())
    cost, x = km.Cost(Q=[1, 2, 0.5], R=0.3), [1.0, -0.5, 0.2]
    for r, rtol in ([0.0, 0.0, 0.0], 1e-5), ([0.3, 0.0, 0.0], 1e-3):  # the gain rests before the feedforward does
        short, given = (km.KoopmanMPC(model, cost, horizon=4)(x, r).u for model in (fitted, linear(A, B)))
        np.testing.assert_allclose(short, given, rtol=rtol)


def test_update_goes_on_with_the_tail_of_the_new_model():
    rng = np.random.default_rng(0)
    old, new = (linear(*random_pair(rng, 2, 1)) for _ in range(2))
    cost, rows = km.Cost([2, 0.5], 0.1, R_delta=0.2, u_target=rng.normal(size=(9, 1))), rng.normal(size=(7, 2))
    mpc, fresh = km.KoopmanMPC(old, cost, horizon=6), km.KoopmanMPC(new, cost, horizon=6)
    x = np.array([0.4, -0.3])
    for controller in (mpc, fresh):
        u = controller(x, rows).u
        fresh.reset(u_prev=u)
    fresh.reset()
    mpc.reset()
    mpc.update(new)
    for _ in range(4):
        np.testing.assert_array_equal(mpc(x, rows).u, fresh(x, rows).u)


def test_no_offset_is_left_by_a_disturbance_that_is_estimated():
    """A learned and a given model, a load on the plant: the reference is held to 1e-9."""
    A, B, load = np.array([[1.02, 0.1], [0.05, 1.01]]), np.array([[0.005], [0.1]]), np.array([0.01, -0.02])
    plant = step_map(A, B, constant=load)
    data = km.collect(step_map(A, B), km.Uniform([-1, -1], [1, 1]), km.Noise(-1, 1), episodes=20, steps=10)
    for model in (linear(1.02 * A, 0.9 * B), km.dmdc(data)):
        for options in ({}, {"moves": [1, 1, 2, 4]}, {"latency": 1}):
            cost = km.Cost([2, 0.5], 0.1, R_delta=0.05)
            mpc = km.KoopmanMPC(model, cost, horizon=8, estimator=km.LiftedDisturbance(0.5), **options)
            run = km.simulate(plant, mpc, x0=[0.3, 0], reference=(goal := rest(A, B, load, 0.4)), steps=600)
            assert np.abs(run.X[-1] - goal).max() < 1e-9


def rest(A, B, load, position):
    """The equilibrium of x = A x + B u + load at this position."""
    E = np.hstack([A - np.eye(2), B])
    E = np.vstack([E, [1, 0, 0]])
    return np.linalg.solve(E, np.append(-load, position))[:2]


@pytest.mark.parametrize("growth", [1.05, 1.3])
def test_a_mode_that_grows_and_that_no_input_moves_does_not_decide_the_plan(growth):
    """x₂⁺ = growth x₂ pushes x₀, beyond any effort of u: its tail stays as large as it is at the end of the horizon."""
    A, B = np.array([[1.0, 0.1, 0.02], [0.0, 0.9, 0.0], [0.0, 0.0, growth]]), np.array([[0.0], [0.1], [0.0]])
    cost = km.Cost([1, 0.1, 0], 0.1, u_target="zero")
    N, x = 10, np.array([0.5, 0.0, 1e-3])
    for model in (linear(A, B), linear(A, B, constant=[0.0, 0.0, 0.0])):
        u = km.KoopmanMPC(model, cost, horizon=N)(x, [0, 0, 0]).u
        assert np.isfinite(u).all()
        without = km.KoopmanMPC(linear(A[:2, :2], B[:2]), km.Cost([1, 0.1], 0.1, u_target="zero"), horizon=N)
        assert np.abs(u - without(x[:2], [0, 0]).u).max() < 0.05
        # the same problem with the mode as a measured disturbance that is held beyond the horizon
        known = linear(A[:2, :2], B[:2], E=A[:2, 2:])
        W = 1e-3 * growth ** np.minimum(np.arange(N + 1), N)[:, None]
        longer = km.KoopmanMPC(known, km.Cost([1, 0.1], 0.1, u_target="zero"), horizon=N + 1)
        np.testing.assert_allclose(u, longer(x[:2], [0, 0], w=W).u, atol=1e-9)


@given(seed=SEEDS, nc=st.integers(1, 3), nu=st.integers(1, 2), size=st.floats(-4, 4))
def test_only_modes_that_grow_and_that_no_input_moves_are_held(seed, nc, nu, size):
    """The others keep their eigenvalue, and their motion; in any units."""
    rng = np.random.default_rng(seed)
    Ac, Bc = random_pair(rng, nc, nu, radius=1.3)
    turn = rng.uniform(0.1, 3)
    pair = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    blocks = [Ac, 1.2 * pair, np.eye(1), np.array([[-1.5]]), 0.8 * np.eye(1)]
    n = sum(map(len, blocks))
    A, B = np.zeros((n, n)), np.zeros((n, nu))
    at = 0
    for block in blocks:
        A[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    A[:nc, nc:], A[nc : nc + 2, -1], B[:nc] = rng.normal(size=(nc, 5)), rng.normal(size=2), Bc
    units = np.diag(10.0 ** rng.uniform(-abs(size), abs(size), n))
    T = units @ np.linalg.qr(rng.normal(size=(n, n)))[0]
    A, B = T @ A @ np.linalg.inv(T), T @ B
    still = stop_growing_modes(A, B)
    before, after = np.linalg.eigvals(A), np.linalg.eigvals(still)
    expected = np.concatenate([np.linalg.eigvals(Ac), np.exp([1j * turn, -1j * turn]), [1, -1, 0.8]])
    for value in expected:
        assert np.abs(after - value).min() < 1e-5 * (1 + abs(value)), (before, after)
    span = np.linalg.inv(T)  # a stable mode of A, and all that inputs reach, move as before
    stable = np.linalg.eig(A)
    v = stable.eigenvectors[:, np.abs(stable.eigenvalues - 0.8).argmin()].real
    np.testing.assert_allclose(span @ still @ v, span @ (0.8 * v), atol=1e-6 * np.abs(span @ v).max())
    np.testing.assert_allclose(span @ still @ B, span @ A @ B, atol=1e-6 * np.abs(span @ A @ B).max())


@given(seed=SEEDS)
def test_no_model_makes_the_constructor_raise(seed):
    """Integrators in a row, defective and turning modes that no input moves, in mixed coordinates."""
    rng = np.random.default_rng(seed)
    turn = rng.uniform(0, np.pi)
    pair = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    kinds = [np.eye(1), pair, 1.2 * pair, 1.01 * np.eye(1), [[1.0, 1.0], [0.0, 1.0]], [[1.1, 1.0], [0.0, 1.1]]]
    free = scipy.linalg.block_diag(*(kinds[i] for i in rng.integers(0, 6, size=rng.integers(1, 5))))
    A, B = random_pair(rng, int(rng.integers(1, 5)), int(rng.integers(1, 3)), radius=rng.uniform(0.5, 1.3))
    n, m, nu = len(A), len(free), B.shape[1]
    T = np.linalg.qr(rng.normal(size=(n + m, n + m)))[0]
    whole = T @ np.block([[A, 0.3 * rng.normal(size=(n, m))], [np.zeros((m, n)), free]]) @ T.T
    model = linear(whole, T @ np.vstack([B, np.zeros((m, nu))]), constant=rng.normal(size=n + m))
    cost = km.Cost(rng.uniform(0.1, 2, n + m), 0.3, R_delta=[None, 0.3][seed % 2], tail=[None, 30][seed // 2 % 2])
    for controller in (km.KoopmanMPC(model, cost, km.Limits(-1, 1), int(rng.integers(1, 15))), km.LQR(model, cost)):
        assert np.isfinite(controller(0.1 * rng.normal(size=n + m), np.zeros(n + m)).u).all()


def test_rows_of_inputs_go_with_the_rows_of_a_reference():
    """Without a tail, which holds the last row, a trajectory is followed to rounding; the run counts from its inputs."""
    A, B = np.array([[1.02, 0.1], [0.05, 1.01]]), np.array([[0.005], [0.1]])
    plant, U = step_map(A, B), 0.3 * np.sin(0.3 * np.arange(40))[:, None]
    X = plant.rollout([0.2, -0.1], U)
    cost = km.Cost([2, 0.5], 0.1, u_target=U, tail=0)
    for mpc in (km.KoopmanMPC(linear(A, B), cost, horizon=7), km.KoopmanMPC(linear(A, B), cost, horizon=7, moves=7)):
        for _ in range(2):  # a run starts its rows anew
            run = km.simulate(plant, mpc, x0=X[0], reference=X, steps=40, cost=cost)
            np.testing.assert_allclose(run.X[:34], X[:34], atol=1e-9)  # then its last row counts as held
            np.testing.assert_array_equal(run.u_reference, U)
    held_input = km.Cost([2, 0.5], 0.1, u_target=[0.2])
    run = km.simulate(plant, km.LQR(linear(A, B), held_input), x0=X[0], reference=X, steps=40, cost=held_input)
    np.testing.assert_array_equal(run.u_reference, np.full((40, 1), 0.2))


@pytest.mark.parametrize("kind", [km.BilinearMPC, km.NonlinearMPC])
@pytest.mark.parametrize("latency", [0, 1])
def test_nonlinear_controllers_take_the_same_inputs(kind, latency):
    """On a linear plant they are KoopmanMPC, with a terminal weight of the cost and rows of inputs."""
    model, rows = linear(*random_pair(np.random.default_rng(3), 2, 1)), 0.3 * np.sin(np.arange(7))[:, None]
    for R_delta in (None, 0.2):
        cost = km.Cost([2, 0.5], 0.1, Q_N=[[5, 1], [1, 3]], R_delta=R_delta, u_target=rows)
        mpcs = [km.KoopmanMPC(model, cost, horizon=4, latency=latency), kind(model, cost, horizon=4, latency=latency)]
        for _ in range(2):
            runs = [
                km.simulate(model.step_map(), mpc, x0=[0.3, -0.2], reference=[0.2, 0], steps=7, cost=cost)
                for mpc in mpcs
            ]
            np.testing.assert_allclose(runs[0].U, runs[1].U, atol=1e-6)


def test_lqr_takes_a_row_of_inputs_a_step():
    A, B = np.array([[1.02, 0.1], [0.05, 1.01]]), np.array([[0.005], [0.1]])
    rows, x = np.array([[0.1], [-0.3], [0.2]]), np.array([0.1, 0.2])
    lqr = km.LQR(linear(A, B), km.Cost([2, 0.5], 0.1, u_target=rows))
    for _ in range(2):
        for row in (*rows, rows[-1]):
            single = km.LQR(linear(A, B), km.Cost([2, 0.5], 0.1, u_target=row))
            np.testing.assert_array_equal(lqr(x, [0.3, 0]).u, single(x, [0.3, 0]).u)
        lqr.reset()


def test_a_cost_with_a_tail_or_inputs_is_kept_in_files(tmp_path):
    plant = step_map(np.array([[0.9]]), np.array([[1.0]]))
    for cost in (km.Cost(1, 1, tail=3), km.Cost(1, 1, u_target=[[0.1], [0.2]] * 3), km.Cost(1, 1, u_target=0.3)):
        run = km.simulate(plant, km.LQR(linear([[0.9]], [[1.0]]), cost), x0=[1], reference=[0], steps=6, cost=cost)
        km.record(run, tmp_path / "run.rrd")
        assert km.load_run(tmp_path / "run.rrd").cost == cost


MESSAGES = {
    "km.Cost(1, 1, tail=-1)": "DataError tail is -1; it must be at least 0",
    "km.Cost(1, 1, tail=np.nan)": "DataError tail is nan; pass a whole number",
    "km.Cost(1, 1, Q_N=1, tail=4)": "DataError Q_N and tail = 4 are given; Q_N takes the tail's place: pass one of them",
    "km.Cost(1, 1, u_target=[])": "ShapeError u_target has shape (0,), expected (nu,) or rows (k, nu), one a step",
    "km.Cost(1, 1, u_target=[[np.nan]])": "DataError u_target holds 1 NaN or inf, the first at (0, 0); remove or",
    "mpc([[1, 2], [3, 4]])": "ShapeError u_target has shape (2, 2), expected (1,) or rows (k, 1), one value an input",
    "mpc([0.5, 0.5])": "ShapeError u_target has shape (2,), expected (1,) or rows (k, 1), one value an input",
    "mpc([[0.1], [2.5]])": "DataError u_target is 2.5 for input 0 in row 1, outside its limits -1 … 2; pass inputs that",
    "lqr([-1.5])": "DataError u_target is -1.5 for input 0 in row 0, outside its limits -1 … 2; pass inputs that the",
    "run([[0.1], [0.2]])": "ShapeError u_target has 2 rows, the run 5 steps; pass one row, or one a step",
}


def test_what_cannot_be_a_tail_or_an_input_target_is_said():
    lines = shown(
        """
plant = km.StepMap.__new__(km.StepMap)
model = km.LinearPredictor(np.eye(1), np.eye(1), np.eye(1), km.State(), 0.1, ("x",), ("u",))
limits = km.Limits(-1, 2)
def mpc(target): return km.KoopmanMPC(model, km.Cost(1, 1, u_target=target), limits)
def lqr(target): return km.LQR(model, km.Cost(1, 1, u_target=target), limits)
def run(target):
    cost = km.Cost(1, 1, u_target=target)
    km.simulate(model.step_map(), mpc(target), x0=[0], reference=[0], steps=5, cost=cost)
"""
        + "".join(f"show(lambda: {call})\n" for call in MESSAGES)
    )
    for line, expected in zip(lines, MESSAGES.values(), strict=True):
        assert line.startswith(expected)


@dataclass(frozen=True)
class MotorPendulum(km.Dynamics):
    """θ'' = 15 sin θ − 0.2 θ' − 3 w cos θ, w' = 10 (u − w): an inverted pendulum with a lagging motor."""

    states = ("theta", "omega", "w")
    inputs = ("u",)

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """Return [θ', θ'', w']."""
        return ca.vertcat(x[1], 15 * ca.sin(x[0]) - 0.2 * x[1] - 3 * x[2] * ca.cos(x[0]), 10 * (u - x[2]))


@pytest.mark.parametrize(
    ("dt", "noise", "degree", "R", "episodes", "seed"),
    [
        (
            0.06,
            5e-3,
            3,
            0.014,
            15,
            5,
        ),  # modes of 1.23 that the plant lacks: a tail until the gain rests loses the plant
        (0.04, 5e-3, 2, 0.31, 15, 109),
        (0.02, 5e-3, 3, 1.5, 60, 8),  # a good model: without a tail the plant is lost
        (0.02, 0.0, 3, 1.4, 60, 103),
    ],
)
def test_the_tail_of_a_learned_model_is_as_long_as_helps_on_the_model_itself(dt, noise, degree, R, episodes, seed):
    """Models with fast modes that the plant lacks, and good ones: none costs more than 1.2 times the linearised plant."""
    plant, box, reference = km.discretize(MotorPendulum(), dt), km.Limits(-5, 5), np.zeros(3)
    high = np.random.default_rng(seed).uniform(0.8, 1.2) * np.array([0.5, 0.9, 1.0])
    hands = km.Feedback([[-9.0, -2.4, 0.0]], km.Noise(-0.3, 0.3, hold=2), u_min=-5, u_max=5)
    clean = km.collect(plant, km.Uniform(-high, high), hands, episodes=episodes, steps=30, rng=seed)
    size, rng = noise * np.concatenate([e.X for e in clean]).std(axis=0), np.random.default_rng(seed)
    noisy = [km.Episode(X=e.X + size * rng.standard_normal(e.X.shape), U=e.U) for e in clean]
    data = km.Episodes(noisy, dt, clean.states, clean.inputs)
    model = km.edmd(data, km.State() + km.Constant() + km.Monomials(degree), ridge=1e-9)
    cost = km.Cost(Q=[20, 1, 0.1], R=R)
    costs = []
    for mpc in (km.KoopmanMPC(model, cost, box, 10), km.LinearMPC(plant, reference, [0.0], cost, box, 60)):
        run = km.simulate(plant, mpc, x0=[0.3, 0, 0], reference=reference, steps=int(4 / dt), cost=cost, limits=box)
        costs.append(km.metrics(run).cost)
    assert costs[0] < 1.2 * costs[1]


def test_a_horizon_of_three_steps_does_not_shorten_the_tail_of_an_unstable_plant():
    """The gain of x⁺ = 1.02 x + 0.02 u rests after more than thirty steps, ten horizons; with three steps it is far from it."""
    rng = np.random.default_rng(0)
    U = rng.uniform(-1, 1, (20, 30, 1))
    X = np.zeros((20, 31, 1))
    X[:, 0] = rng.uniform(-1, 1, (20, 1))
    for k in range(30):
        X[:, k + 1] = 1.02 * X[:, k] + 0.02 * U[:, k]
    data = km.Episodes([km.Episode(X=x, U=u) for x, u in zip(X, U, strict=True)], 0.1)
    model = km.edmd(data, km.State() + km.Constant(), ridge=1e-9)
    cost = km.Cost(Q=1, R=10)
    mpc, lqr = km.KoopmanMPC(model, cost, km.Limits(), 3), km.LQR(model, cost)
    assert mpc([0.1], [0.0]).u == pytest.approx(lqr([0.1], [0.0]).u, rel=1e-2)


class WrittenLaws(Recursion):
    """The law u = −K z of each length as it is written down, and the lengths that are asked for."""

    def __init__(self, laws):
        self.laws, self.asked = iter(np.array(laws)), []

    def find_step(self, n):
        self.asked.append(n - 10)
        return RecursionStep(next(self.laws).T, np.eye(1), 1.0)


def tried(model, laws, most=18):
    """Return the tail behind 10 steps that is taken where each length has its own law, and the lengths."""
    nx, nz = model.C.shape
    stage = tail_stage(model.A, model.B, np.zeros((nz, 0)), model.C, np.eye(nx), 0.01 * np.eye(1), None)
    written = WrittenLaws(laws)
    return believed_steps(written, stage, model, 10, most, np.eye(nz)), written.asked


def test_the_shortest_tail_that_is_good_on_the_model_is_taken():
    """Laws before the good ones push the wrong way; one that costs a few thousandths more than the best is good too."""
    model, _ = learned(0, 1e-3, km.State() + km.Constant())
    stage = tail_stage(model.A, model.B, np.zeros((3, 0)), model.C, np.eye(2), 0.01 * np.eye(1), None)
    good, lengths = stationary(stage, 1000).K.T, [0, 4, 9, 10, 18]
    for best in range(1, 5):
        assert tried(model, [-good] * best + [good] * (5 - best)) == (lengths[best], lengths)
    assert tried(model, [1.05 * good] + [good] * 4)[0] == 0
    assert tried(model, [2.0 * good] + [good] * 4)[0] == 4


@pytest.mark.parametrize(("noise", "taken"), [(0.0, 0), (1e-3, 4)])
def test_a_law_that_suffers_from_late_inputs_is_good_on_a_model_without_errors_alone(noise, taken):
    """x⁺ = x + u under u = −1.2 x comes to rest sooner than under −0.6 x, but not where half of u comes a step late."""
    rng = np.random.default_rng(0)
    U = rng.uniform(-1, 1, (30, 5, 1))
    X = np.concatenate([np.zeros((30, 1, 1)), np.cumsum(U, axis=1)], axis=1) + rng.uniform(-1, 1, (30, 1, 1))
    X += noise * rng.normal(size=X.shape)
    model = km.edmd(km.Episodes([km.Episode(X=x, U=u) for x, u in zip(X, U, strict=True)], 0.1), km.State())
    assert tried(model, [[[1.2]]] + 4 * [[[0.6]]])[0] == taken
