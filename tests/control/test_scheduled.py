"""Measured disturbances in bilinear models: exact recovery, the linear parameter-varying case, and both controllers."""

import copy

import numpy as np
import pytest

import koopmpc as km

DT = 0.1
A = np.array([[0.95, 0.1], [-0.1, 0.9]])
B = np.array([[0.0], [0.2]])
E = np.array([[0.05], [0.02]])
N1 = np.array([[0.0, 0.0], [0.1, -0.05]])  # u x
S1 = np.array([[-0.1, 0.0], [0.05, 0.1]])  # w x


def step(x, u, w):
    return A @ x + B @ u + E @ w + u[0] * N1 @ x + w[0] * S1 @ x


def logs(rng, episodes=12, steps=40, nw=1):
    found = []
    for _ in range(episodes):
        X, U, W = [rng.uniform(-1, 1, 2)], rng.uniform(-1, 1, (steps, 1)), rng.uniform(-1, 1, (steps, nw))
        for u, w in zip(U, W, strict=True):
            X.append(step(X[-1], u, w))
        found.append(km.Episode(X=np.array(X), U=U, W=W))
    return km.Episodes(found, DT)


@pytest.fixture(scope="module")
def model():
    return km.bilinear_edmd(logs(np.random.default_rng(0)), km.State() + km.Constant())


def test_an_exact_bilinear_plant_with_measured_disturbances_is_recovered(model):
    np.testing.assert_allclose(model.A[:2, :2], A, atol=1e-10)
    np.testing.assert_allclose(model.B[:2], B, atol=1e-10)
    np.testing.assert_allclose(model.E[:2], E, atol=1e-10)
    np.testing.assert_allclose(model.N[0][:2, :2], N1, atol=1e-10)
    np.testing.assert_allclose(model.S[0][:2, :2], S1, atol=1e-10)
    assert (model.nw, model.is_scheduled, model.inputs) == (1, True, ("u0",))


@pytest.mark.parametrize("rank", [None, 3])
def test_forecasts_follow_w_and_files_keep_it(model, rank, tmp_path):
    data = logs(np.random.default_rng(1), 1)
    own = model if rank is None else km.bilinear_edmd(data, km.State() + km.Constant(), rank=rank)
    episode = data[0]
    X = own.rollout(episode.X[0], episode.U, episode.W)
    np.testing.assert_allclose(X, episode.X, atol=1e-8)
    own.save(tmp_path / "model.npz")
    assert km.load_model(tmp_path / "model.npz") == own
    if rank is None:
        held = own.rollout(episode.X[0], episode.U, np.full((40, 1), 0.4))
        np.testing.assert_allclose(own.at([0.4]).rollout(episode.X[0], episode.U), held, atol=1e-9)
    with pytest.raises(km.errors.ShapeError, match="W has shape"):
        own.rollout(episode.X[0], episode.U, np.zeros((40, 2)))


def test_a_schedule_alone_is_a_linear_parameter_varying_model():
    """x⁺ = (A + w S) x + B u, without products of u: N vanishes and S is exact."""
    rng = np.random.default_rng(3)
    found = []
    for _ in range(10):
        X, U, W = [rng.uniform(-1, 1, 2)], rng.uniform(-1, 1, (30, 1)), rng.uniform(-1, 1, (30, 1))
        for u, w in zip(U, W, strict=True):
            X.append((A + w[0] * S1) @ X[-1] + B @ u)
        found.append(km.Episode(X=np.array(X), U=U, W=W))
    own = km.bilinear_edmd(km.Episodes(found, DT), km.State())
    np.testing.assert_allclose(own.S[0], S1, atol=1e-10)
    assert np.abs(own.N).max() < 1e-10
    assert np.abs(own.E).max() < 1e-10


def optimum(x, W, horizon, Q, R, reference):
    """The inputs that minimise the cost of the exact plant under the rows W, by SciPy; no tail."""
    from scipy.optimize import minimize

    def cost(U):
        z, total = x, 0.0
        for k in range(horizon):
            z = step(z, U[k : k + 1], W[k])
            total += Q * float((z[0] - reference) ** 2) + R * float(U[k] ** 2)
        return total

    return minimize(cost, np.zeros(horizon), method="L-BFGS-B", bounds=[(-1.5, 1.5)] * horizon, tol=1e-14).x


@pytest.mark.parametrize("kind", [km.NonlinearMPC, km.BilinearMPC])
def test_plans_follow_the_preview_of_w(model, kind):
    """With preview the plan is the optimum of the exact plant, found by another program."""
    horizon, W = 6, np.array([[0.9], [-0.8], [0.7], [0.9], [-0.9], [0.5]])
    options = {"sqp_iterations": 20} if kind is km.BilinearMPC else {}
    cost = km.Cost(Q=[1.0, 0.0], R=0.02, tail=0, u_target="zero")
    mpc = kind(model, cost, km.Limits(u_min=-1.5, u_max=1.5), horizon, **options)
    x, last = np.array([0.6, -0.8]), None
    for _ in range(3):
        mpc.reset()
        last = mpc(x, [0.5, 0.0], w=W)
        last = mpc(x, [0.5, 0.0], w=W)
    plan = mpc.plan()
    wanted = optimum(x, W, horizon, 1.0, 0.02, 0.5)
    assert last is not None
    assert last.fallback is km.control.Fallback.NONE
    np.testing.assert_allclose(plan.U[:, 0], wanted, atol=2e-3)
    blind = kind(model, cost, km.Limits(u_min=-1.5, u_max=1.5), horizon, **options)
    blind(x, [0.5, 0.0])
    assert np.abs(blind.plan().U[:, 0] - wanted).max() > 0.01


@pytest.mark.parametrize("estimator", [None, km.LiftedDisturbance(), km.ExtendedKalman()], ids=["none", "d", "ekf"])
def test_a_loop_that_is_told_w_tracks_better_than_one_that_is_not(model, estimator):
    T, rng = 60, np.random.default_rng(5)
    W = 0.8 * np.sign(np.sin(np.arange(T + 10) / 4))[:, None]
    cost = km.Cost(Q=[1.0, 0.0], R=0.01)
    errors = []
    for told in (True, False):
        mpc, x, total = km.BilinearMPC(model, cost, km.Limits(-3, 3), 8, estimator=estimator), np.array([0.5, 0.0]), 0.0
        for k in range(T):
            move = mpc(x, [0.3, 0.0], **({"w": W[k : k + 8]} if told else {}))
            assert move.fallback is km.control.Fallback.NONE
            x = step(x, move.u, W[k]) + 1e-4 * rng.normal(size=2)
            total += (x[0] - 0.3) ** 2
        errors.append(total)
    assert errors[0] < 0.7 * errors[1]


def test_a_run_repeats_to_the_bit_and_copies_go_on(model):
    mpc = km.BilinearMPC(model, km.Cost(Q=[1, 0], R=0.01), km.Limits(-2, 2), 6)
    W = np.array([[0.3], [0.5], [-0.2]])
    runs = []
    for _ in range(2):
        mpc.reset()
        runs.append([mpc([0.4, 0.1], [0.2, 0], w=w).u[0] for w in W])
    assert runs[0] == runs[1]
    twin = copy.copy(mpc)
    assert np.allclose(twin([0.3, 0.1], [0.2, 0], w=[0.4]).u, mpc([0.3, 0.1], [0.2, 0], w=[0.4]).u, atol=1e-7)


def test_w_that_does_not_fit_is_refused(model):
    mpc = km.BilinearMPC(model, km.Cost(Q=[1, 0], R=0.01), km.Limits(-2, 2), 6)
    with pytest.raises(km.errors.ShapeError, match="w has shape"):
        mpc([0, 0], [0, 0], w=[1.0, 2.0])
    assert mpc([0, 0], [0, 0], w=[np.nan]).status is km.Status.BAD_MEASUREMENT
    W = np.zeros((20, 1))
    W[3] = np.nan
    with pytest.raises(km.errors.DataError, match="W"):
        km.Episode(X=np.zeros((21, 2)), U=np.zeros((20, 1)), W=W)
    with pytest.raises(km.errors.DataError, match="Constant"):
        km.BilinearPredictor(A, B, N1[None], np.eye(2), km.State(), DT, ("a", "b"), ("u",), E=E).at([1.0])
