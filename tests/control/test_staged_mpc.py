"""Rates, blocks, disturbances, latency, deadlines and copies of the controllers on x⁺ = F(x, u): both do the same."""

import copy
import pickle
from functools import cache

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.bare import shown
from tests.tiers import slow

N = 12
GOOD = (km.Status.UNCONSTRAINED, km.Status.OPTIMAL, km.Status.SOFTENED)
A = np.array([[1.05, 0.1, 0], [0, 1.02, 0.1], [0.05, 0, 0.9]])
B = np.array([[0.02, 0.1], [0.1, 0], [0, 0.2]])
E = np.array([[0.0], [0.1], [0.05]])
END = [[9, 1, 2], [1, 8, 3], [2, 3, 6]]  # the default end of KoopmanMPC is another than that of a nonlinear controller
R_DELTA = km.Cost(Q=[1, 2, 1], R=0.3, R_delta=[0.5, 0.1], Q_N=END)
PLAIN = km.Cost(Q=[1, 2, 1], R=0.3, Q_N=END)
BOX = {"u_min": -0.8, "u_max": 0.8}
MIXES = [
    (R_DELTA, km.Limits(), None),
    (R_DELTA, km.Limits(**BOX, du_max=0.2), None),
    (PLAIN, km.Limits(**BOX, du_min=-0.1, du_max=0.3), None),
    (PLAIN, km.Limits(**BOX, du_max=0.1, du_slack=(2.0, 3.0)), None),
    (R_DELTA, km.Limits(**BOX, du_max=[0.1, 0.3], du_slack=([np.inf, 5.0], [0, 2.0])), None),
    (R_DELTA, km.Limits(**BOX, du_max=0.3, x_max=[0.45, np.inf, 0.3], slack=(20.0, 10.0)), None),
    (PLAIN, km.Limits(-3, 3, du_max=2, x_max=[0.9, np.inf, np.inf], slack=None), None),
    (PLAIN, km.Limits(**BOX), 4),
    (R_DELTA, km.Limits(**BOX, du_max=0.4), (1, 1, 2, 3, 5)),
    (km.Cost(Q=[1, 2, 1], R=0.3, R_delta=0.2, Q_N=[5, 5, 5]), km.Limits(**BOX), (2, 10)),
]


def linear(disturbed: bool = False, mass: float = 1.0) -> km.LinearPredictor:
    """Return an unstable plant of three states and two inputs, with a measured disturbance or without."""
    names = ("a", "b", "c"), ("u", "v")
    return km.LinearPredictor(A, B / mass, np.eye(3), km.State(), 0.1, *names, E=E if disturbed else None)


KINDS = ["bilinear", "nonlinear"]


def built(kind, model, cost, limits, horizon=N, **options):
    if kind == "bilinear":
        return km.BilinearMPC(model, cost, limits, horizon, sqp_iterations=3, **options)
    tight = {"ipopt.tol": 1e-10, "ipopt.bound_relax_factor": 0.0}
    return km.NonlinearMPC(model, cost, limits, horizon, solver=km.control.NLP(settings=tight), **options)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("mix", [1, 4, 5, 6, 8, *slow([0, 2, 3, 7, 9])])
def test_on_a_linear_plant_all_features_are_koopman_mpc(kind, mix):
    cost, limits, moves = MIXES[mix]
    model = linear()
    ours = built(kind, model, cost, limits, moves=moves)
    theirs = km.KoopmanMPC(model, cost, limits, N, moves=moves, solver="daqp")
    x, u = np.array([0.5, -0.4, 0.3]), np.array([0.1, -0.1])
    for mpc in (ours, theirs):
        mpc.reset(u_prev=u)
    for k in range(5):
        ahead = np.tile([0.1 if k > 2 else 0.0, 0, 0], (N + 1, 1))
        given_u = u if k % 2 else None
        a, b = ours(x, ahead, given_u), theirs(x, ahead, given_u)
        assert a.status in GOOD
        assert b.status in GOOD
        assert (a.status is km.Status.SOFTENED) == (b.status is km.Status.SOFTENED)
        np.testing.assert_allclose(a.u, b.u, atol=1e-6)
        np.testing.assert_allclose(ours.plan().U, theirs.plan().U, atol=2e-5)
        np.testing.assert_allclose(ours.plan().X, theirs.plan().X, atol=2e-5)
        u = a.u
        x = model.A @ x + model.B @ u


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("horizon", [1, *slow([2]), 3])
@pytest.mark.parametrize("cost", [*slow([PLAIN]), R_DELTA])
def test_a_short_horizon_is_that_of_koopman_mpc(kind, horizon, cost):
    limits = km.Limits(**BOX, x_max=[0.45, np.inf, 0.3], slack=(20.0, 10.0))
    ours = built(kind, linear(), cost, limits, horizon)
    theirs = km.KoopmanMPC(linear(), cost, limits, horizon, solver="daqp")
    for x in ([0.5, -0.4, 0.3], [-0.2, 0.1, 0.0]):
        rows = [[0.1, 0, 0], [0.0, 0.1, 0], [0.2, 0, 0.1], [0, 0.1, 0.2]][: horizon + 1]
        np.testing.assert_allclose(ours(x, rows).u, theirs(x, rows).u, atol=1e-6)
        np.testing.assert_allclose(ours.plan().X, theirs.plan().X, atol=2e-5)


@pytest.mark.parametrize("most", [100, 0])
def test_the_program_with_rates_is_that_of_cvxpy(most, monkeypatch):
    """By interior points, and by the active-set method that finishes what they do not."""
    import cvxpy as cp

    monkeypatch.setattr("koopmpc.control.nonlinear.iteration.MOST", most)
    cost = km.Cost(Q=[1, 2, 1], R=[0.3, 0.2], R_delta=[0.5, 0.1], Q_N=[4, 3, 2], u_target="zero")
    limits = km.Limits(**BOX, du_max=0.25, du_slack=(0.1, 2.0), x_max=[np.inf, 0.1, np.inf], slack=(5.0, 1.0))
    x0, u0 = np.array([0.5, -0.1, 0.3]), np.array([0.3, -0.2])
    X, U, s, t = cp.Variable((N + 1, 3)), cp.Variable((N, 2)), cp.Variable((N, 2)), cp.Variable(N)
    held = [X[0] == x0, s >= 0, t >= 0, U <= 0.8, U >= -0.8]
    objective, last = 5 * cp.sum(t) + cp.sum_squares(t) + 0.1 * cp.sum(s) + 2 * cp.sum_squares(s), u0
    for k in range(N):
        held += [
            X[k + 1] == A @ X[k] + B @ U[k],
            cp.abs(U[k] - last) <= 0.25 + s[k],
            X[k + 1, 1] <= 0.1 + t[k],
        ]
        weight = np.diag([4, 3, 2]) if k == N - 1 else np.diag([1, 2, 1])
        objective += cp.quad_form(X[k + 1], weight) + cp.quad_form(U[k], np.diag([0.3, 0.2]))
        objective += cp.quad_form(U[k] - last, np.diag([0.5, 0.1]))
        last = U[k]
    cp.Problem(cp.Minimize(objective), held).solve(cp.CLARABEL, tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11)
    for kind in KINDS:
        mpc = built(kind, linear(), cost, limits)
        mpc.reset(u_prev=u0)
        assert mpc(x0, [0, 0, 0]).status is km.Status.SOFTENED
        np.testing.assert_allclose(mpc.plan().U, U.value, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("latency", [0, 2])
def test_a_measured_disturbance_and_its_preview_are_koopman_mpcs(kind, latency):
    model, cost, limits = linear(disturbed=True), R_DELTA, km.Limits(**BOX, du_max=0.3)
    ours = built(kind, model, cost, limits, latency=latency)
    theirs = km.KoopmanMPC(model, cost, limits, N, latency=latency, solver="daqp")
    assert ours.horizon == theirs.horizon == N + latency
    rng, x = np.random.default_rng(0), np.array([0.3, -0.2, 0.1])
    for k in range(6):
        W = 0.1 * rng.normal(size=(N + latency, 1)) if k % 2 else [0.1]
        r = 0.02 * rng.normal(size=(N + 1 + latency, 3)) if k % 3 else [0.02, 0, 0]
        a, b = ours(x, r, w=W), theirs(x, r, w=W)
        np.testing.assert_allclose(a.u, b.u, atol=1e-6)
        x = A @ x + B @ a.u + 0.01 * rng.normal(size=3)


@pytest.mark.parametrize("kind", KINDS)
def test_simulate_tells_them_what_is_measured(kind):
    model = linear(disturbed=True)
    W = 0.3 * np.sin(np.arange(15))[:, None]
    runs = []
    for mpc in (built(kind, model, R_DELTA, km.Limits(**BOX)), km.KoopmanMPC(model, R_DELTA, km.Limits(**BOX), N)):
        x0, push = [0.3, -0.2, 0.1], W @ E.T
        runs.append(
            km.simulate(
                model.step_map(),
                mpc,
                x0=x0,
                reference=[0, 0, 0],
                steps=15,
                measured=W,
                options=km.loop.LoopOptions(disturbance=push),
            )
        )
    np.testing.assert_allclose(runs[0].X, runs[1].X, atol=1e-5)


def pendulum(mass: float = 1.0, load: float = 0.0, gravity: float = 0.05) -> km.BilinearPredictor:
    """Return θ⁺ = θ + 0.1 ω, ω⁺ = 0.98 ω + gravity sin θ + (0.1 u cos θ + load) / mass."""
    M = np.eye(5)
    M[0, 1], M[1, 1], M[1, 2], M[1, 4] = 0.1, 0.98, gravity, load / mass
    Nu = np.zeros((1, 5, 5))
    Nu[0, 1, 3] = 0.1 / mass
    lifting = km.State() + km.Fourier(1, states="theta") + km.Constant()
    return km.BilinearPredictor(M, np.zeros((5, 1)), Nu, np.eye(2, 5), lifting, 0.1, ("theta", "omega"), ("u",))


TRACKED = km.Cost(Q=[10, 1], R=0.1, R_delta=0.01)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("mass", "load"),
    [
        (1.0, 0.0),
        pytest.param(1.0, 0.02, marks=pytest.mark.slow),
        pytest.param(1.2, 0.0, marks=pytest.mark.slow),
        (1.2, -0.02),
    ],
)
def test_an_estimator_leaves_no_offset(kind, mass, load):
    mpc = built(kind, pendulum(), TRACKED, km.Limits(-3, 3, du_max=1), 20, estimator=km.LiftedDisturbance(gain=0.2))
    truth = pendulum(mass, load).step_map()
    run = km.simulate(truth, mpc, x0=[0, 0], reference=[0.4, 0], steps=120)
    assert abs(run.X[-1, 0] - 0.4) < 1e-6
    assert set(run.status) <= set(GOOD)


def test_without_an_estimator_there_is_an_offset():
    mpc = km.BilinearMPC(pendulum(), TRACKED, km.Limits(-3, 3), 20)
    run = km.simulate(pendulum(1.2, 0.02).step_map(), mpc, x0=[0, 0], reference=[0.4, 0], steps=60)
    assert abs(run.X[-1, 0] - 0.4) > 1e-3


def test_a_setpoint_beyond_the_input_limit_is_held_as_nearly_as_the_plant_can():
    model = pendulum(gravity=-0.05)
    mpc = km.BilinearMPC(model, TRACKED, km.Limits(-0.15, 0.15), 20, estimator=km.LiftedDisturbance(gain=0.2))
    truth = pendulum(1.0, 0.005, gravity=-0.05).step_map()
    run = km.simulate(truth, mpc, x0=[0, 0], reference=[0.6, 0], steps=300)
    assert set(run.status) <= set(GOOD)
    assert run.U[-1, 0] == pytest.approx(0.15, abs=1e-4)
    theta = run.X[-1, 0]
    assert abs(-0.05 * np.sin(theta) + 0.1 * 0.15 * np.cos(theta) + 0.005) < 2e-3


@pytest.mark.parametrize("kind", KINDS)
def test_on_a_true_model_the_plan_happens_late(kind):
    model = pendulum()
    options = {"sqp_iterations": 30} if kind == "bilinear" else {}
    maker = km.BilinearMPC if kind == "bilinear" else km.NonlinearMPC
    mpc = maker(model, TRACKED, km.Limits(-3, 3, du_max=1), 15, latency=2, **options)
    run = km.simulate(
        model.step_map(),
        mpc,
        x0=[0.5, 0],
        reference=[0, 0],
        steps=60,
        options=km.loop.LoopOptions(faults=(km.faults.ActuatorDelay(2),), plans=True),
    )
    for k in (0, 4, 10):
        np.testing.assert_allclose(run.plans.X[k][0], run.X[k + 2], atol=1e-6)
    np.testing.assert_allclose(run.X[-1], 0, atol=1e-3)


@pytest.mark.parametrize("kind", KINDS)
def test_an_update_is_a_new_controller(kind):
    old, new = pendulum(), pendulum(1.2, 0.01)
    limits = km.Limits(-3, 3, du_max=1)
    updated, fresh = (built(kind, model, TRACKED, limits, 15) for model in (old, new))
    updated([0.3, 0.1], [0.2, 0])
    updated.update(new)
    updated.reset()
    assert updated.model is new
    x = np.array([0.3, 0.1])
    for _ in range(5):
        a, b = updated(x, [0.2, 0]), fresh(x, [0.2, 0])
        assert a.status is b.status
        np.testing.assert_allclose(a.u, b.u, atol=1e-6)
        x = new.step_map()(x, a.u)


@pytest.mark.parametrize("kind", KINDS)
def test_an_update_keeps_the_plan_and_refuses_what_is_no_other_set_of_matrices(kind):
    mpc = built(kind, pendulum(), TRACKED, km.Limits(-3, 3), 15)
    for _ in range(3):
        mpc([0.3, 0.1], [0.2, 0])
    before = mpc.plan()
    mpc.update(pendulum(1.0 + 1e-9))
    assert np.array_equal(mpc.plan().U, before.U)
    with pytest.raises(km.errors.DataError, match="made for a BilinearPredictor, and got a LinearPredictor"):
        mpc.update(linear())
    other = km.BilinearPredictor(
        np.eye(2),
        np.zeros((2, 1)),
        np.zeros((1, 2, 2)),
        np.eye(2),
        km.State(),
        0.1,
        ("theta", "omega"),
        ("u",),
    )
    with pytest.raises(km.errors.DataError, match="another lifting than the controller's; make a new controller"):
        mpc.update(other)
    fixed = built(kind, pendulum().step_map(), TRACKED, km.Limits(-3, 3), 15)
    with pytest.raises(km.errors.DataError, match="a StepMap has no matrices that could be exchanged"):
        fixed.update(pendulum().step_map())


@pytest.mark.parametrize("kind", KINDS)
def test_a_copy_runs_as_its_original(kind):
    limits = km.Limits(**BOX, du_max=0.3, du_slack=(5.0, 1.0), x_max=[0.45, np.inf, 0.3])
    options = {"moves": 6, "latency": 1, "estimator": km.LiftedDisturbance(0.3)}
    original = built(kind, linear(disturbed=True), R_DELTA, limits, **options)
    inputs = []
    for mpc in (original, copy.deepcopy(original), pickle.loads(pickle.dumps(original))):
        mpc.reset()
        x = np.array([0.5, -0.4, 0.3])
        moves = [mpc(x - 0.02 * k, [0.1, 0, 0], w=[0.2]) for k in range(6)]
        inputs.append(np.array([move.u for move in moves]))
    assert np.array_equal(inputs[0], inputs[1])
    assert np.array_equal(inputs[0], inputs[2])


def test_a_step_without_time_says_so_and_the_next_ones_go_on():
    limits = km.Limits(-0.3, 0.3, du_max=0.2)
    mpc = km.BilinearMPC(pendulum(), TRACKED, limits, 20, time_limit=1e-7)
    for _ in range(4):
        move = mpc([0.5, 0.5], [0.0, 0])
        assert move.status is km.Status.TIME_LIMIT
        assert np.abs(move.u).max() <= 0.3
    late = km.NonlinearMPC(pendulum().step_map(), TRACKED, limits, 20, time_limit=1e-6)
    assert late([0.5, 0.5], [0.0, 0]).status is km.Status.TIME_LIMIT
    ready = km.BilinearMPC(pendulum(), TRACKED, limits, 20, time_limit=10.0)
    assert ready([0.5, 0.5], [0.0, 0]).status in GOOD


@cache
def shared(kind):
    model, limits = pendulum(), km.Limits(-0.8, 0.5, du_min=-0.2, du_max=0.3)
    if kind == "bilinear":
        return km.BilinearMPC(model, TRACKED, limits, 10)
    return km.NonlinearMPC(model.step_map(), TRACKED, limits, 10)


faulty = st.one_of(st.floats(-4, 4), st.sampled_from([np.nan, np.inf, -np.inf, 1e300, 1e31, 0.0]))
got = st.one_of(st.none(), st.floats(-3, 3), st.sampled_from([np.nan, np.inf]))


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=25, deadline=None)
@given(steps=st.lists(st.tuples(faulty, faulty, got, st.booleans()), min_size=1, max_size=5))
def test_inputs_and_rates_are_never_outside_their_limits(kind, steps):
    mpc = shared(kind)
    mpc.reset()
    last = np.zeros(1)
    for theta, omega, applied, fails in steps:
        mpc.solver_fails = fails
        acted = None if applied is None else [applied]
        move = mpc([theta, omega], [0.2, 0], acted)
        if applied is not None and np.isfinite(applied):
            last = np.array([applied])
        assert (move.u >= -0.8).all()
        assert (move.u <= 0.5).all()
        reach = np.clip([last - 0.2, last + 0.3], -0.8, 0.5)  # the box wins
        assert reach[0] - 1e-9 <= move.u <= reach[1] + 1e-9
        assert (move.status in GOOD) == (move.fallback is km.control.Fallback.NONE)
        last = move.u
    mpc.solver_fails = False


def test_half_an_actuator_is_told_by_applied():
    mpc = km.BilinearMPC(pendulum(), TRACKED, km.Limits(-2, 2, du_max=0.4), 15)
    run = km.simulate(
        pendulum().step_map(),
        mpc,
        x0=[0.4, 0],
        reference=[0, 0],
        steps=60,
        limits=km.Limits(-2, 2, du_max=0.4),
        options=km.loop.LoopOptions(
            faults=(
                km.faults.ActuatorLoss(0.5, begin=3),
                km.faults.NaNSensor(probability=0.1),
                km.faults.SolverFailure(0.2),
            ),
            rng=1,
        ),
    )
    assert np.abs(run.U).max() <= 2


def test_where_box_and_rate_exclude_each_other_the_box_wins():
    limits = km.Limits(-0.5, 0.5, du_max=0.1)
    for mpc in (
        km.BilinearMPC(pendulum(), TRACKED, limits, 10),
        km.NonlinearMPC(pendulum().step_map(), TRACKED, limits, 10),
    ):
        move = mpc([0.1, 0], [0, 0], applied=[2.0])
        assert move.status is km.Status.SOFTENED
        assert move.u[0] == pytest.approx(0.5, abs=1e-6)
        assert mpc([0.1, 0], [0, 0]).status is not km.Status.SOFTENED


def test_several_starts_with_rates_find_the_better_side():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    wall = x[1] + 0.1 * u + 0.2 * ca.sin(3 * x[0])
    plant = km.StepMap(ca.Function("F", [x, u], [ca.vertcat(x[0] + 0.1 * x[1], wall)]), 0.1)
    cost = km.Cost(Q=[1, 0.1], R=0.01, R_delta=0.02)
    limits = km.Limits(-3, 3, du_max=1.0)
    one, several = (km.NonlinearMPC(plant, cost, limits, 15, solver=km.control.NLP(starts=n)) for n in (1, 5))
    price = lambda plan: float((plan.X[1:] ** 2 @ [1, 0.1]).sum())  # noqa: E731
    for controller in (one, several):
        assert controller([2.0, 0.0], [0, 0]).status in GOOD
        assert np.abs(np.diff(controller.plan().U, axis=0)).max() <= 1.0 + 1e-6
    assert price(several.plan()) <= price(one.plan()) + 1e-3


CALLS = """
plant = km.discretize(km.load_problem("pendulum").dynamics, 0.05)
flat = km.LinearPredictor.local(plant, [0, 0], [0])
still = km.LinearPredictor(np.eye(2), np.zeros((2, 0)), np.eye(2), km.State(), 0.1, ("a", "b"), ())
cost, limits = km.Cost(1, 0.1), km.Limits(-1, 1)
"""
REFUSALS = {
    "KoopmanMPC(plant, cost)": "DataError predictor is a StepMap, expected a LinearPredictor; fit one with edmd, or use",
    "KoopmanMPC(flat, limits, cost)": "DataError cost is a Limits; pass a Cost, and the Limits after it",
    "KoopmanMPC(flat, cost, cost)": "DataError limits is a Cost; pass Limits, or None",
    "KoopmanMPC(flat, cost)(None, [0, 0])": "DataError y is not an array of numbers: got NoneType",
    'KoopmanMPC(flat, cost)("fast", [0, 0])': "DataError y is not an array of numbers: got str",
    'KoopmanMPC(flat, cost)([0, 0], "up")': "DataError reference is not an array of numbers: got str",
    'BilinearMPC("model", cost)': "DataError model is a str, expected a BilinearPredictor or a LinearPredictor or a",
    'NonlinearMPC("flat", cost)': "DataError model is a str, expected a BilinearPredictor or a LinearPredictor or a",
    "BilinearMPC(still, cost)": "DataError the model has no inputs",
    "BilinearMPC(plant, limits, cost)": "DataError cost is a Limits; pass a Cost, and the Limits after it",
    "BilinearMPC(flat, cost, cost)": "DataError limits is a Cost; pass Limits, or None",
    "BilinearMPC(plant, cost, horizon=0)": "DataError horizon is 0; it must be at least 1",
    "NonlinearMPC(plant, cost, horizon=0)": "DataError horizon is 0; it must be at least 1",
    "BilinearMPC(plant, cost, sqp_iterations=0)": "DataError sqp_iterations is 0; it must be at least 1",
    "NonlinearMPC(plant, cost, solver=km.control.NLP(starts=0))": "DataError starts is 0; it must be at least 1",
    'NonlinearMPC(plant, cost, solver="acados")': 'DataError solver is \'acados\'; pass "ipopt", "fatrop" or',
    'NonlinearMPC(plant, cost, solver=km.control.NLP(settings={"tol": 1}))': "DataError ipopt was not built with settings {'tol': 1}",
    "NonlinearMPC(plant, km.Cost([1, 1, 1], 1))": "ShapeError Q has shape (3,), expected (2, 2) or its diagonal",
    "NonlinearMPC(plant, km.Cost(1, 1, Q_N=np.eye(3)))": "ShapeError Q_N has shape (3, 3), expected (2, 2)",
    "BilinearMPC(plant, km.Cost(1, 1, Q_N=np.eye(2), of=km.Constant()))": "ShapeError Q_N weighs x_N − r_N, but the",
    "BilinearMPC(plant, cost, km.Limits(x_max=[1, 1, 1]))": "ShapeError x_max has shape (3,), expected (2,) or a",
    'BilinearMPC(flat, cost, estimator=km.LiftedKalman("theta"))': "DataError LiftedKalman filters the lifted state of a linear predictor,",
    'NonlinearMPC(flat, cost, estimator=km.LiftedKalman("theta"))': "DataError LiftedKalman filters the lifted state of a linear predictor,",
    "BilinearMPC(flat, cost)([0, 0], [0, 0], w=[1.0])": "DataError w was passed, but the predictor has no E",
    "NonlinearMPC(plant, cost)([0, 0], [0, 0], w=[1.0])": "DataError w was passed, but the predictor has no E",
    'BilinearMPC(flat, cost)("now", [0, 0])': "DataError y is not an array of numbers: got str",
    "BilinearMPC(plant, cost)([0] * 3, [0, 0])": "ShapeError y has shape (3,), expected (2,), one value a state",
    "NonlinearMPC(plant, cost)([0, 0], [0, 0, 0])": "ShapeError reference has shape (3,), expected (2,), or rows of 2",
}


def test_messages():
    said = shown(CALLS + "".join(f"show(lambda: km.{call})\n" for call in REFUSALS))
    assert len(said) == len(REFUSALS)
    for line, start in zip(said, REFUSALS.values(), strict=True):
        assert line.startswith(start), line
