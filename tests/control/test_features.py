"""Rates, blocks, disturbances and soft rows: against CVXPY, against each other, and in what is returned."""

import copy
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.control.models import PRECISE, Told, in_coordinates, linear, random_pair, with_disturbances
from tests.control.oracle import oracle

SEEDS = st.integers(0, 2**32 - 1)
UNSTABLE = np.array([[1.05, 0.1], [0.08, 1.0]]), np.array([[0.005], [0.1]])
SOLVED = (km.Status.UNCONSTRAINED, km.Status.OPTIMAL, km.Status.SOFTENED)


def draw(rng):
    """A random problem that mixes all features."""
    nx, nu, N = int(rng.integers(1, 4)), int(rng.integers(1, 3)), int(rng.integers(1, 8))
    A, B = random_pair(rng, nx, nu, radius=rng.uniform(0.7, 1.15))
    constant = 0.1 * rng.normal(size=nx) if rng.random() < 0.4 else None
    model = linear(A, B, constant=constant)
    E = rng.normal(size=(model.nz, int(rng.integers(0, 3))))
    E[nx:] = 0.0
    blocks = [1] * N
    if rng.random() < 0.6:
        ends = np.flatnonzero(rng.random(N - 1) < 0.5) + 1
        blocks = np.diff([0, *ends, N]).tolist()
    maybe = lambda p, value: value if rng.random() < p else None  # noqa: E731
    cost = km.Cost(
        Q=rng.uniform(0.1, 2, nx),
        R=rng.uniform(0.05, 1, nu),
        R_delta=maybe(0.6, rng.uniform(0.05, 1, nu)),
        Q_N=maybe(0.4, rng.uniform(0.5, 2, model.nz)),
        # with more inputs than states many inputs hold a reference, and Q does not choose one of them
        u_target=str(rng.choice(["equilibrium", "zero"])) if nu <= nx else "zero",
    )
    linear_weight = rng.uniform(0.1, 20, nx)
    linear_weight[rng.random(nx) < 0.3] = np.inf
    limits = km.Limits(
        u_min=maybe(0.7, -rng.uniform(0.2, 1, nu)),
        u_max=maybe(0.7, rng.uniform(0.2, 1, nu)),
        du_max=maybe(0.6, rng.uniform(0.05, 0.4, nu)),
        du_min=maybe(0.3, -rng.uniform(0.05, 0.4, nu)),
        du_slack=maybe(0.4, (rng.uniform(0.1, 5, nu), 1.0)),
        x_min=-rng.uniform(0.2, 1, nx),
        x_max=maybe(0.6, rng.uniform(0.2, 1, nx)),
        slack=(linear_weight, rng.uniform(0.1, 5, nx)),
    )
    return A, B, with_disturbances(model, E), cost, limits, tuple(blocks), rng.random() < 0.5


@settings(max_examples=15)  # a thousand in the slow tier
@given(seed=SEEDS, coordinates=st.sampled_from([None, "riccati", "plain"]))
def test_everything_at_once_equals_cvxpy_along_a_closed_loop(seed, coordinates):
    equals_cvxpy(seed, coordinates)


@pytest.mark.slow
def test_everything_at_once_a_thousand_times():
    for seed in range(1000):
        equals_cvxpy(seed, (None, "riccati", "plain")[seed % 3])


def equals_cvxpy(seed, coordinates):
    rng = np.random.default_rng(seed)
    A, B, model, cost, limits, blocks, disturbed = draw(rng)
    N, nx, nu, nw, nz = sum(blocks), model.nx, model.nu, model.nw, model.nz
    d = np.zeros(nz)
    told = Told(d) if disturbed else None
    mpc = in_coordinates(coordinates)(model, cost, limits, N, moves=blocks, estimator=told, settings=PRECISE)
    x = rng.normal(size=nx)
    u_prev = np.clip(0.3 * rng.normal(size=nu), *limits.inputs(nu))
    mpc.reset(u_prev=u_prev)
    for _ in range(2):
        rows, W = 0.5 * rng.normal(size=(N + 1, nx)), 0.2 * rng.normal(size=(N, nw))
        if disturbed:
            d[:nx] = 0.1 * rng.normal(size=nx)
        move = mpc(x, rows, u_prev if rng.random() < 0.5 else None, W if nw else None)
        found = oracle(model, cost, limits, model.lift(x), rows, u_prev=u_prev, W=W, d=d, blocks=blocks)
        if found is not None and np.abs(found[0]).max() > 100:
            return  # hard states without input limits: beyond the digits of both solvers
        if found is None:
            assert move.status is km.Status.INFEASIBLE
        else:
            assert move.status in SOLVED
            np.testing.assert_allclose(mpc.plan().U, found[0], atol=2e-5)
            X = mpc.plan().X
            z = model.lift(x)
            for k in range(N):
                np.testing.assert_allclose(X[k], model.C @ z, atol=1e-8)
                z = model.A @ z + model.B @ mpc.plan().U[k] + model.E @ W[k] + d
        x = A @ x + B @ move.u + 0.05 * rng.normal(size=nx)
        u_prev = move.u


def closed_loop(mpc, steps=30, x=(0.6, -0.5), seed=0, **call):
    rng = np.random.default_rng(seed)
    A, B = UNSTABLE
    x, moves = np.array(x), []
    for k in range(steps):
        moves.append(mpc(x, [0.3 * np.sign(np.sin(0.2 * k)), 0.0], **call))
        x = A @ x + B @ moves[-1].u + 0.005 * rng.normal(size=2)
    return moves


def inputs(moves):
    return np.array([move.u for move in moves])


def test_rates_that_cost_and_limit_nothing_change_nothing():
    model, cost, limits = linear(*UNSTABLE), km.Cost([2, 0.5], 0.1), km.Limits(-0.6, 0.6, x_max=0.8)
    plain = closed_loop(km.KoopmanMPC(model, cost, limits, 12, settings=PRECISE))
    assert {move.status for move in plain} > {km.Status.UNCONSTRAINED}
    cheap = km.Cost([2, 0.5], 0.1, R_delta=1e-9)
    loose = km.Limits(-0.6, 0.6, x_max=0.8, du_max=1e6)
    for other in (
        km.KoopmanMPC(model, cheap, limits, 12, settings=PRECISE),
        km.KoopmanMPC(model, cost, loose, 12, settings=PRECISE),
        km.KoopmanMPC(model, cost, limits, 12, moves=(1,) * 12, settings=PRECISE),
        km.KoopmanMPC(model, cost, limits, 12, moves=12, settings=PRECISE),
        km.KoopmanMPC(model, cost, limits, 12, estimator=Told([0, 0]), settings=PRECISE),
        in_coordinates("riccati")(
            with_disturbances(model, np.ones((2, 1))),
            cost,
            limits,
            12,
            settings=PRECISE,
        ),
        in_coordinates("plain")(model, cost, limits, 12, settings=PRECISE),
    ):
        np.testing.assert_allclose(inputs(closed_loop(other)), inputs(plain), atol=1e-5)
    zero = km.KoopmanMPC(model, km.Cost([2, 0.5], 0.1, R_delta=0), limits, 12, settings=PRECISE)
    np.testing.assert_array_equal(
        inputs(closed_loop(zero)),
        inputs(closed_loop(km.KoopmanMPC(model, cost, limits, 12, settings=PRECISE))),
    )


def test_with_a_weight_on_rates_the_plan_starts_the_infinite_horizon():
    """Loose limits, R_delta, the default terminal weight: u = −K [x; u_prev] of SciPy's Riccati equation."""
    A, B = UNSTABLE
    Q, R, R_delta = np.diag([2.0, 0.5]), np.array([[0.1]]), np.array([[0.7]])
    whole = scipy.linalg.block_diag(A, 0.0)
    both = np.vstack([B, [[1.0]]])
    S = np.vstack([np.zeros((2, 1)), -R_delta])
    P = scipy.linalg.solve_discrete_are(whole, both, scipy.linalg.block_diag(Q, R_delta), R + R_delta, s=S)
    K = np.linalg.solve(R + R_delta + both.T @ P @ both, both.T @ P @ whole + S.T)
    for constant in (None, np.zeros(2)):  # the Constant stands in no one's way
        model = linear(A, B, constant=constant)
        mpc = km.KoopmanMPC(model, km.Cost(np.diag(Q), 0.1, R_delta=0.7), km.Limits(-9, 9, du_max=9), 30)
        x, u = np.array([0.3, -0.2]), np.array([0.1])
        mpc.reset(u_prev=u)
        for _ in range(5):
            expected = -K @ np.append(x, u)
            u = mpc(x, [0, 0]).u
            np.testing.assert_allclose(u, expected, atol=1e-7)
            x = A @ x + B @ u


def test_a_move_is_held_through_its_block():
    model, cost = linear(*UNSTABLE), km.Cost([2, 0.5], 0.1)
    mpc = km.KoopmanMPC(model, cost, km.Limits(-0.6, 0.6), 10, moves=(1, 2, 3, 4), settings=PRECISE)
    mpc([0.9, -0.5], [0, 0])
    U = mpc.plan().U
    for first, last in ((0, 1), (1, 3), (3, 6), (6, 10)):
        assert (U[first:last] == U[first]).all()
    few = km.KoopmanMPC(model, cost, km.Limits(-0.6, 0.6), 10, moves=3, settings=PRECISE)
    few([0.9, -0.5], [0, 0])
    assert (few.plan().U[2:] == few.plan().U[2]).all()
    same = km.KoopmanMPC(model, cost, km.Limits(-0.6, 0.6), 10, moves=[1, 1, 8], settings=PRECISE)
    few.reset()
    np.testing.assert_array_equal(inputs(closed_loop(few)), inputs(closed_loop(same)))
    failed = few([np.nan, 0], [0, 0])  # the plan that stands in is held through its blocks too
    assert failed.fallback is km.control.Fallback.SHIFTED_PLAN


ODD = st.sampled_from([0.0, 0.3, -2.0, 5.0, np.nan, 1e31])


@given(
    seed=SEEDS,
    applied=st.lists(st.one_of(st.none(), ODD), min_size=6, max_size=6),
    start=st.sampled_from([0.0, 0.3, 7.0, -7.0]),
    trouble=st.sampled_from(["none", "iterations", "measurement", "infeasible"]),
    soft=st.booleans(),
)
def test_what_is_returned_keeps_inputs_and_rates(seed, applied, start, trouble, soft):
    """Whatever fails: the input is inside its limits, and inside its rates wherever these reach the limits."""
    rng = np.random.default_rng(seed)
    A, B = UNSTABLE
    box, rate = km.Limits(-0.6, 0.7).inputs(1), 0.15
    limits = km.Limits(
        -0.6,
        0.7,
        x_max=-5.0 if trouble == "infeasible" else 0.5,
        slack=(50.0, 1.0) if soft else None,
        du_max=rate,
    )
    few = {"max_iter": 5, "check_termination": 1} if trouble == "iterations" else {}
    mpc = km.KoopmanMPC(linear(A, B), km.Cost(1, 0.1), limits, 8, settings=few)
    mpc.reset(u_prev=[start])
    last = start
    for k in range(6):
        got = None if applied[k] is None else np.array([applied[k]])
        known = last if got is None or not abs(got[0]) < 1e30 else got[0]
        y = rng.normal(size=2) * (np.nan if trouble == "measurement" and k % 2 else 1.0)
        move = mpc(y, [0, 0], got)
        assert box.low[0] <= move.u[0] <= box.high[0]
        reach = np.clip([known - rate, known + rate], box.low[0], box.high[0])
        assert reach[0] - 1e-9 <= move.u[0] <= reach[1] + 1e-9
        out_of_reach = known - rate > box.high[0] + 1e-8 or known + rate < box.low[0] - 1e-8
        if out_of_reach and move.fallback is km.control.Fallback.NONE:
            assert move.status is km.Status.SOFTENED
        last = move.u[0]


def test_soft_rates_give_way_and_say_so():
    model, cost = linear(*UNSTABLE), km.Cost([2, 0.5], 0.01)
    x = [2.0, 0.0]
    hard = km.KoopmanMPC(model, cost, km.Limits(-3, 3, du_max=0.1), 10)
    move = hard(x, [0, 0])
    assert move.status is km.Status.OPTIMAL
    assert abs(move.u[0]) <= 0.1
    soft = km.KoopmanMPC(model, cost, km.Limits(-3, 3, du_max=0.1, du_slack=(0.1, 0.1)), 10)
    move = soft(x, [0, 0])
    assert move.status is km.Status.SOFTENED
    assert abs(move.u[0]) > 0.2
    dear = km.KoopmanMPC(model, cost, km.Limits(-3, 3, du_max=0.1, du_slack=(1e5, 1.0)), 10, settings=PRECISE)
    move = dear(x, [0, 0])
    assert move.status is km.Status.OPTIMAL
    np.testing.assert_allclose(move.u, hard(x, [0, 0], applied=[0.0]).u, atol=1e-3)


def test_of_two_limits_the_soft_one_gives_way():
    """x₀ ≤ 0.5 hard, x₁ ≤ 0.1 soft: both cannot be, and the hard one is kept; both hard is infeasible."""
    A, B = UNSTABLE
    B = np.hstack([B, [[0.1], [0.0]]])
    model, cost = linear(A, B), km.Cost(1, 0.1)
    make = lambda slack: km.KoopmanMPC(  # noqa: E731
        model, cost, km.Limits(-1, 1, x_max=[0.5, 0.1], slack=slack), 8, settings=PRECISE
    )
    x = [0.4, 0.9]
    mixed = make(([np.inf, 10.0], 1.0))
    assert mixed(x, [0, 0]).status is km.Status.SOFTENED
    X = mixed.plan().X[1:]
    assert X[:, 0].max() <= 0.5 + 1e-6
    assert X[:, 1].max() > 0.1
    for slack in (None, (np.inf, 0.0), ([np.inf, np.inf], [0.0, 0.0])):
        assert make(slack)(x, [0, 0]).status is km.Status.INFEASIBLE


def test_a_disturbance_is_a_constant_of_the_model():
    """d on z⁺ = A z + B u is c on the model with a Constant: the same moves, where the target is limited too."""
    A, B = UNSTABLE
    c, cost = np.array([0.02, -0.05]), km.Cost([2, 0.5], 0.1, R_delta=0.05)
    for reference in ([0.3, 0.0], [2.5, 0.0]):
        limits = km.Limits(-0.6, 0.6, x_max=[0.7, 1.0], du_max=0.5)
        one = km.KoopmanMPC(linear(A, B, constant=c), cost, limits, 12, settings=PRECISE)
        other = km.KoopmanMPC(linear(A, B), cost, limits, 12, estimator=Told(c), settings=PRECISE)
        third = km.KoopmanMPC(with_disturbances(linear(A, B), c[:, None]), cost, limits, 12, settings=PRECISE)
        x = np.array([0.5, -0.5])
        for _ in range(8):
            u = one(x, reference).u
            np.testing.assert_allclose(other(x, reference).u, u, atol=1e-5)
            np.testing.assert_allclose(third(x, reference, w=[1.0]).u, u, atol=1e-5)
            x = A @ x + B @ u + c


def test_the_preview_of_a_disturbance():
    A, B = UNSTABLE
    model, N = with_disturbances(linear(A, B), np.array([[0.1], [0.3]])), 8
    make = lambda: km.KoopmanMPC(model, km.Cost([2, 0.5], 0.1), km.Limits(-5, 5), N)  # noqa: E731
    mpc, x, r = make(), [0.1, 0.0], [0.2, 0.0]
    u = lambda w: mpc(x, r, w=w).u  # noqa: E731
    np.testing.assert_array_equal(u(None), u([0.0]))
    np.testing.assert_array_equal(u([0.3]), u(np.full((N, 1), 0.3)))
    np.testing.assert_array_equal(u([[0.1], [0.3]]), u([[0.1]] + [[0.3]] * (N - 1)))
    np.testing.assert_allclose(u(np.arange(20.0)[:, None]), u(np.arange(float(N))[:, None]), atol=1e-4)
    step = np.r_[np.zeros(4), np.ones(4)][:, None]
    assert u(step)[0] != u([0.0])[0]  # it acts before the step comes
    bad = mpc(x, r, w=[np.nan])
    assert bad.status is km.Status.BAD_MEASUREMENT
    assert mpc(x, r, w=[0.1]).status is km.Status.UNCONSTRAINED
    exact, state = make(), np.array(x)  # w known: rest on every reference that one input can hold
    push = model.E @ [0.2]
    held = np.linalg.solve(np.eye(2) - A, B @ [0.1] + push)
    for _ in range(300):
        state = A @ state + B @ exact(state, held, w=[0.2]).u + push
    np.testing.assert_allclose(state, held, atol=1e-9)


def test_cost_and_limits_on_lifted_coordinates():
    """Any observables of the lifting may be tracked: all of z with Q on the states' entries alone is Q on x."""
    rng = np.random.default_rng(3)
    lifting = (km.State() + km.Fourier(1, states=["x0"])).bind(["x0", "x1"])
    A, B = random_pair(rng, lifting.nz, 1, radius=0.9)
    model = km.LinearPredictor(A, B, np.eye(2, 4), lifting, 0.1, ("x0", "x1"), ("u0",))
    Q_N, limits = np.eye(4), km.Limits(-0.2, 0.2)
    on_z = km.KoopmanMPC(model, km.Cost([1, 1, 0, 0], 0.1, Q_N=Q_N, of=lifting, u_target="zero"), limits, 6)
    on_x = km.KoopmanMPC(model, km.Cost([1, 1], 0.1, Q_N=Q_N, u_target="zero"), limits, 6)
    for _ in range(5):
        x = rng.normal(size=2)
        np.testing.assert_allclose(on_z(x, np.zeros(4)).u, on_x(x, np.zeros(2)).u, atol=1e-4)


@pytest.mark.parametrize("moves", [None, 4])
def test_update_is_a_fresh_controller(moves):
    rng = np.random.default_rng(8)
    A, B = UNSTABLE
    cost = km.Cost([2, 0.5], 0.1, R_delta=0.05)
    limits = km.Limits(-0.6, 0.6, du_max=0.3, x_max=0.8)
    options = {"moves": moves, "settings": PRECISE}
    mpc = km.KoopmanMPC(linear(A, B), cost, limits, 12, **options)
    x = np.array([0.9, -0.5])
    for k in range(8):
        model = linear(A + 0.01 * k * rng.normal(size=(2, 2)), B * (1 + 0.02 * k))
        before = mpc.plan()
        mpc.update(model)
        fresh = km.KoopmanMPC(model, cost, limits, 12, **options)
        if before is not None:
            np.testing.assert_array_equal(mpc.plan().U, before.U)
            fresh.reset(u_prev=before.U[0])
        move = mpc(x, [0.3, 0])
        np.testing.assert_allclose(move.u, fresh(x, [0.3, 0]).u, atol=1e-6)
        assert mpc.predictor is model
        x = A @ x + B @ move.u
    with pytest.raises(km.errors.DataError, match=r"another lifting than the controller's; make a new controller"):
        mpc.update(linear(A, B, constant=[0, 0]))
    with pytest.raises(km.errors.DataError, match=r"another dt than"):
        mpc.update(linear(A, B, dt=0.2))
    np.testing.assert_allclose(mpc(x, [0.3, 0]).u, fresh(x, [0.3, 0], applied=move.u).u, atol=1e-6)


def test_an_update_that_is_refused_changes_nothing():
    A, B = UNSTABLE
    model = linear(A, B)
    mpc = km.KoopmanMPC(model, km.Cost([2, 0.5], 0), km.Limits(-0.6, 0.6), 4)
    u = mpc([0.1, 0.0], [0.0, 0.0]).u
    with pytest.raises(km.errors.DefinitenessError):
        mpc.update(linear(A, 0 * B))
    assert mpc.predictor is model
    mpc.reset()
    np.testing.assert_array_equal(mpc([0.1, 0.0], [0.0, 0.0]).u, u)


def whole(seed=0):
    """A controller with all there is to copy."""
    A, B = UNSTABLE
    model = with_disturbances(linear(A, B, constant=[0.01, -0.02]), np.array([[0.05], [0.1], [0.0]]))
    limits = km.Limits(-0.6, 0.6, du_max=0.2, x_max=[0.7, 0.4], slack=([10.0, np.inf], 1.0))
    cost = km.Cost([2, 0.5], 0.1, R_delta=0.05)
    return km.KoopmanMPC(model, cost, limits, 10, moves=6, estimator=Told([0.01, 0.0, 0.0]))


def test_controllers_in_threads_do_not_disturb_each_other():
    mpcs = [whole() for _ in range(2)] + [copy.deepcopy(whole())]
    drive = lambda job: inputs(closed_loop(job[0], 150, seed=job[1], w=[0.1]))  # noqa: E731
    jobs = [(mpc, seed) for seed, mpc in enumerate(mpcs)]
    alone = [drive((whole(), seed)) for _, seed in jobs]
    with ThreadPoolExecutor(3) as pool:
        together = list(pool.map(drive, jobs))
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_coordinates_follow_the_condition_number():
    rng = np.random.default_rng(4)
    tame = linear(*random_pair(rng, 3, 2, radius=0.6))
    wild = linear(*random_pair(rng, 3, 1, radius=1.6))
    choose = lambda model, **o: km.KoopmanMPC(model, km.Cost(1, 1), km.Limits(-1, 1), 30, **o).coordinates  # noqa: E731
    assert choose(tame) == "riccati"
    assert choose(tame, solver="osqp") == "plain"
    assert choose(wild) == "riccati"
    assert choose(tame, solver="daqp") == "riccati"


@pytest.mark.parametrize(
    ("R_delta", "du_max", "moves"), [(None, None, None), ([0.5, 0.1], 0.2, None), (None, None, (1, 1, 2, 3, 5, 13))]
)
def test_a_step_that_starts_from_the_last_one_moved_on_takes_half_of_the_iterations(R_delta, du_max, moves):
    A = np.array([[1.05, 0.1, 0], [0, 1.02, 0.1], [0.05, 0, 0.9]])
    B = np.array([[0.02, 0.1], [0.1, 0], [0, 0.2]])
    model = km.LinearPredictor(A, B, np.eye(3), km.State(), 0.1, ("a", "b", "c"), ("u", "v"))
    cost, limits = km.Cost(Q=[1, 2, 1], R=0.3, R_delta=R_delta), km.Limits(-0.8, 0.8, du_max=du_max)
    taken = []
    for cold in (False, True):
        mpc, rng, x = (
            km.KoopmanMPC(model, cost, limits, 25, solver="daqp", moves=moves),
            np.random.default_rng(0),
            [0.5, -0.4, 0.3],
        )
        taken.append(0)
        for k in range(40):
            if cold:
                mpc._step.solver.qps.cool()
            move = mpc(x, [1.5 * (-1) ** (k // 10), 0, 0])
            taken[-1] += move.iterations
            x = A @ x + B @ move.u + 0.01 * rng.standard_normal(3)
    assert taken[0] < 0.5 * taken[1]
