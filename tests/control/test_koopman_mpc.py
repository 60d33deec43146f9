import warnings
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from tests.control.kkt import CheckedDAQP, CheckedOSQP
from tests.control.models import PRECISE, dense_plan, equilibrium, linear, random_pair, step_map
from tests.control.oracle import oracle
from tests.tiers import few, slow

SEEDS = st.integers(0, 2**32 - 1)
UNSTABLE = np.array([[1.05, 0.1], [0.08, 1.0]]), np.array([[0.005], [0.1]])


def lifted_model():
    """A pendulum about upright, learned on angles and their products: 2 states, 8 observables."""
    import casadi as ca

    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    f = ca.vertcat(x[0] + 0.05 * x[1], x[1] + 0.05 * (4.9 * ca.sin(x[0]) + 0.25 * u))
    plant = km.StepMap(ca.Function("F", [x, u], [f]), 0.05, states=("theta", "omega"))
    data = km.collect(plant, km.Uniform([-1.5, -2], [1.5, 2]), km.Noise(-15, 15), episodes=60, steps=20)
    lifting = km.State() + km.Fourier(1, states="theta") + km.Constant()
    return plant, km.edmd(data, lifting)


@given(seed=SEEDS, nx=st.integers(1, 4), nu=st.integers(1, 2), constant=st.booleans())
def test_loose_limits_give_the_feedback_law(seed, nx, nu, constant):
    """A held reference, the stationary P at the end: u = u_r − K (z − z_r)."""
    rng = np.random.default_rng(seed)
    A, B = random_pair(rng, nx, nu)
    model = linear(A, B, constant=rng.normal(size=nx) if constant else None)
    cost = km.Cost(Q=rng.uniform(0.5, 2, nx), R=rng.uniform(0.5, 2, nu))
    Q, R = model.C.T @ np.diag(cost.Q) @ model.C, np.diag(cost.R)
    P = Q
    for _ in range(600):
        K = np.linalg.solve(R + model.B.T @ P @ model.B, model.B.T @ P @ model.A)
        P = Q + model.A.T @ P @ (model.A - model.B @ K)
    r, x = rng.normal(size=nx), rng.normal(size=nx)
    z_r, u_r = equilibrium(model.A, model.B, model.C, np.diag(cost.Q), r, nx if constant else None, R)
    mpc = km.KoopmanMPC(model, cost, km.Limits(-1e9, 1e9, -1e9, 1e9), horizon=40)
    move = mpc(x, z_r[:nx])  # where the reference is an equilibrium, the stages and the end agree on it
    assert move.status is km.Status.UNCONSTRAINED
    expected = u_r - K @ (model.lift(x) - z_r)
    np.testing.assert_allclose(move.u, expected, atol=1e-5 * (1 + np.abs(expected).max()))


CASES = {
    "inputs": km.Limits(-0.6, 0.6),
    "one side": km.Limits(u_max=0.3),
    "soft": km.Limits(-1, 1, x_min=[-np.inf, -0.4], x_max=[0.5, 0.4], slack=(1e4, 1e2)),
    "cheap": km.Limits(-1, 1, x_min=-0.4, x_max=0.4, slack=(0.4, 0.3)),
    "quadratic": km.Limits(-1, 1, x_max=0.3, slack=(0.0, 2.0)),
    "hard": km.Limits(-1.5, 1.5, x_max=[1.0, 0.1], slack=None),
}


@pytest.mark.parametrize("name", few(CASES, "inputs", "one side", "soft", "hard"))
@pytest.mark.parametrize("nu", [*slow([1]), 2])
def test_it_equals_cvxpy_along_a_closed_loop(name, nu):
    limits = CASES[name]
    rng = np.random.default_rng(5)
    A, B = UNSTABLE
    B = np.hstack([B, [[0.05], [-0.04]]])[:, :nu]
    model, N = linear(A, B), 10
    cost = km.Cost(Q=[[2, 0.3], [0.3, 0.5]], R=[0.1, 0.2][:nu])
    mpc = km.KoopmanMPC(model, cost, limits, N, settings=PRECISE)
    x, statuses = np.array([0.9, -0.5]), []
    t = np.arange(60)
    signal = np.column_stack([0.5 * np.sign(np.sin(0.5 * t)), 0.3 * np.cos(0.3 * t)])
    for k in range(6):
        rows = signal[k : k + N + 1]
        move = mpc(x, rows)
        found = oracle(model, cost, limits, x, rows)
        if found is None:
            assert move.status is km.Status.INFEASIBLE
        else:
            np.testing.assert_allclose(move.u, found[0][0], atol=1e-5)
        statuses.append(move.status)
        x = A @ x + B @ move.u + 0.01 * rng.normal(size=2)
    solved = {km.Status.OPTIMAL, km.Status.SOFTENED}
    assert solved & set(statuses)
    if name in ("cheap", "quadratic"):
        assert km.Status.SOFTENED in statuses


def test_limits_on_observables_equal_cvxpy():
    plant, model = lifted_model()
    of = km.Fourier(1, states="theta")
    H = np.eye(model.nz)[[model.lifting.names.index(name) for name in of.bind(model.states).names]]
    cost = km.Cost(Q=[5, 1], R=0.05, tail=10)
    limits = km.Limits(-15, 15, of=of, y_min=[-0.5, -np.inf], y_max=[0.5, np.inf], slack=(1e4, 1e2))
    mpc = km.KoopmanMPC(model, cost, limits, 10, settings=PRECISE)
    x, reference, seen = np.array([0.3, 0.9]), np.zeros(2), set()
    for _ in range(8):
        move = mpc(x, reference)
        seen.add(move.status)
        U, _ = oracle(model, cost, limits, model.lift(x), np.zeros((11, 2)), of=H)
        np.testing.assert_allclose(move.u, U[0], atol=1e-5)
        x = plant(x, move.u)
    assert seen & {km.Status.OPTIMAL, km.Status.SOFTENED}


def test_a_terminal_weight_on_a_state_that_is_not_lifted_tracks_the_reference():
    """Q_N (nx, nx) is ‖x_N − r_N‖² for State() alone too, where nz = nx; r need not be an equilibrium."""
    A, B = UNSTABLE
    rows = np.tile([0.5, 0.7], (7, 1))
    plans = []
    for model in (linear(A, B), linear(A, B, constant=[0.0, 0.0])):
        mpc = km.KoopmanMPC(model, km.Cost(Q=1, R=0.1, Q_N=[3, 2], u_target="zero"), horizon=6)
        mpc([0.1, 0.2], rows)
        plans.append(mpc.plan().U)
    np.testing.assert_allclose(plans[0], plans[1], atol=1e-9)


ANY = st.one_of(
    st.floats(-2, 2),
    st.sampled_from([np.nan, np.inf, -np.inf, 1e6, -1e6, 1e19, 1e31, 1e150, 1e308, -1e308, 0.0]),
)


@given(
    seed=SEEDS,
    ys=st.lists(st.tuples(ANY, ANY), min_size=1, max_size=5),
    references=st.lists(st.tuples(ANY, ANY), min_size=1, max_size=3),
    low=st.sampled_from([-np.inf, -3.0, -0.5, 0.2, 0.5]),
    width=st.sampled_from([0.0, 0.3, 3.0, np.inf]),
    room=st.sampled_from([None, 0.0, 0.5]),
    slack=st.sampled_from([None, (1e4, 1e2), (0.5, 0.0)]),
    constant=st.booleans(),
)
def test_whatever_comes_in_a_sane_input_comes_out(seed, ys, references, low, width, room, slack, constant):
    rng = np.random.default_rng(seed)
    A, B = random_pair(rng, 2, 2, radius=1.1)
    u_max = width if np.isinf(low) else low + width
    limits = km.Limits(low, u_max, x_min=None if room is None else [-room, -np.inf], x_max=room, slack=slack)
    model = linear(A, B, constant=rng.normal(size=2) if constant else None)
    mpc = km.KoopmanMPC(model, km.Cost(Q=1, R=0.1), limits, horizon=4, settings={"max_iter": 200})
    lqr = km.LQR(model, km.Cost(Q=1, R=0.1), limits)
    for y in ys:
        for reference in references:
            for controller in (mpc, lqr):
                move = controller(np.array(y), np.array(reference))
                assert isinstance(move.status, km.Status)
                assert isinstance(move.fallback, km.control.Fallback)
                assert move.u.shape == (2,)
                assert np.isfinite(move.u).all()
                assert (move.u >= low).all()
                assert (move.u <= u_max).all()
                assert move.solve_time >= 0
                finite = np.isfinite(y).all() and np.isfinite(reference).all()
                if not finite:
                    assert move.status is km.Status.BAD_MEASUREMENT
                failed = move.status.value >= km.Status.MAX_ITERATIONS.value
                assert failed == (move.fallback is not km.control.Fallback.NONE)


@pytest.mark.parametrize("active", [False, True])
def test_u_is_a_fresh_array(active):
    A, B = UNSTABLE
    make = lambda: km.KoopmanMPC(linear(A, B), km.Cost(1, 0.1), km.Limits(-0.5, 0.5), 8)  # noqa: E731
    spoilt, clean = make(), make()
    for k in range(6):
        x = np.array([1.0, 0.4]) / (1 if active else 40) / (k + 1)
        if k == 4:
            x = np.full(2, np.nan)  # the fallback reads the plan that is kept
        a, b = spoilt(x, [0, 0]), clean(x, [0, 0])
        np.testing.assert_array_equal(a.u, b.u)
        assert a.status is b.status
        a.u[:] = 99.0
        if spoilt.plan() is not None:
            spoilt.plan().U[:] = 99.0
            spoilt.plan().X[:] = 99.0


def hard():
    A, B = UNSTABLE
    return km.KoopmanMPC(linear(A, B), km.Cost(1, 0.1), km.Limits(-2, 2, x_max=[0.5, 2.0], slack=None), 8)


def test_infeasible_hard_limits_fall_back_and_the_next_step_recovers():
    mpc = hard()
    before = mpc([3.0, 0.0], [0, 0])
    assert (before.status, before.fallback) == (km.Status.INFEASIBLE, km.control.Fallback.CLIPPED_LQR)
    np.testing.assert_array_equal(before.u, [-2.0])
    assert mpc.plan() is None
    good = mpc([0.35, 0.3], [0, 0])
    assert good.status is km.Status.OPTIMAL
    plan = mpc.plan().U
    failed = mpc([3.0, 0.0], [0, 0])
    assert (failed.status, failed.fallback) == (km.Status.INFEASIBLE, km.control.Fallback.SHIFTED_PLAN)
    np.testing.assert_array_equal(failed.u, plan[1])
    again = mpc([0.35, 0.3], [0, 0])
    assert again.status is km.Status.OPTIMAL
    np.testing.assert_allclose(again.u, good.u, atol=1e-4)


def test_a_bad_measurement_uses_the_plan_up_and_then_holds():
    mpc = hard()
    first = mpc([0.35, 0.3], [0, 0])
    plan = mpc.plan().U
    np.testing.assert_array_equal(first.u, plan[0])
    for k in range(1, 8):
        move = mpc([np.nan, 0.0], [0, 0])
        assert (move.status, move.fallback) == (km.Status.BAD_MEASUREMENT, km.control.Fallback.SHIFTED_PLAN)
        np.testing.assert_array_equal(move.u, plan[k])
    for _ in range(3):
        move = mpc([0.0, np.inf], [0, 0])
        assert (move.status, move.fallback) == (km.Status.BAD_MEASUREMENT, km.control.Fallback.HOLD)
        np.testing.assert_array_equal(move.u, plan[-1])
    move = mpc([0.0, np.inf], [0, 0], applied=[0.25])
    np.testing.assert_array_equal(move.u, [0.25])
    move = mpc([0.0, np.inf], [0, 0], applied=[np.nan])
    np.testing.assert_array_equal(move.u, [0.25])
    assert mpc([0.1, 0.0], [0, 0]).fallback is km.control.Fallback.NONE


def test_a_bad_first_measurement_holds_what_reset_says():
    mpc = hard()
    for u_prev, held in ((None, 0.0), (0.3, 0.3), (7.0, 2.0)):
        mpc.reset(u_prev=None if u_prev is None else [u_prev])
        move = mpc([np.nan, 0.0], [0, 0])
        assert (move.status, move.fallback) == (km.Status.BAD_MEASUREMENT, km.control.Fallback.HOLD)
        np.testing.assert_array_equal(move.u, [held])
    move = mpc([0.1, 0.0], [np.nan, 0])
    assert move.status is km.Status.BAD_MEASUREMENT
    assert mpc([0.1, 0.0], [0, 0]).status is km.Status.UNCONSTRAINED


@pytest.mark.parametrize(
    ("solver", "few"), [("osqp", {"max_iter": 1, "check_termination": 1}), ("daqp", {"iter_limit": 1})]
)
def test_where_a_solver_has_too_few_iterations_daqp_finishes_the_step(solver, few):
    A, B = UNSTABLE
    make = lambda **options: km.KoopmanMPC(linear(A, B), km.Cost(1, 0.1), km.Limits(-0.2, 0.2), 8, **options)  # noqa: E731
    move, alone = make(solver=solver, settings=few)([0.9, 0.5], [0, 0]), make(solver="daqp")([0.9, 0.5], [0, 0])
    assert (move.status, move.fallback, move.solver) == (km.Status.OPTIMAL, km.control.Fallback.NONE, "daqp")
    assert move.iterations > 1
    np.testing.assert_allclose(move.u, alone.u, atol=1e-4)


def test_a_limit_gives_way_only_where_it_must():
    A, B = UNSTABLE
    mpc = km.KoopmanMPC(linear(A, B), km.Cost(1, 0.1), km.Limits(-2, 2, x_max=[np.inf, 0.2]), 8)
    assert mpc([0.0, 1.5], [0, 0]).status is km.Status.SOFTENED
    assert mpc([0.0, 0.05], [0.0, 0.0]).status is km.Status.UNCONSTRAINED
    kept = mpc([-1.0, 0.1], [0, 0])
    assert kept.status is km.Status.OPTIMAL
    assert mpc.plan().X[1:, 1].max() <= 0.2 + 1e-3


def test_reset_forgets_to_the_bit():
    A, B = UNSTABLE
    mpc = km.KoopmanMPC(linear(A, B), km.Cost(1, 0.1), km.Limits(-0.5, 0.5, x_max=0.6), 10)

    def drive():
        mpc.reset()
        x, us, n = np.array([0.8, -0.9]), [], []
        for k in range(15):
            move = mpc(x if k != 7 else x * np.nan, [0.3, 0])
            us.append(move.u)
            n.append(move.iterations)
            x = A @ x + B @ move.u
        return np.array(us), n

    first, second = drive(), drive()
    np.testing.assert_array_equal(first[0], second[0])
    assert first[1] == second[1]
    assert sum(first[1]) > 0


def test_a_reference_that_is_held_is_its_rows_repeated():
    A, B = UNSTABLE
    mpc = km.KoopmanMPC(linear(A, B), km.Cost(1, 0.1), horizon=5)
    rows = np.array([[0.1, 0], [0.4, 0.2], [-0.3, 0.1]])
    u = lambda reference: mpc([0.2, 0.1], reference).u  # noqa: E731
    same = partial(
        np.testing.assert_allclose, rtol=1e-14
    )  # a row that moves enters by another product than one at rest
    same(u([0.3, 0]), u([[0.3, 0]] * 6))
    same(u(rows), u(np.vstack([rows, rows[-1:], rows[-1:], rows[-1:]])))
    same(u(np.tile(rows, (4, 1))), u(np.tile(rows, (4, 1))[:6]))
    assert (u(rows) != u(rows[0])).all()


def test_many_observables():
    rng = np.random.default_rng(2)
    centers = rng.uniform(-1, 1, (60, 2))
    lifting = km.State() + km.Gaussian(centers, 0.7)
    A = np.diag(rng.uniform(0.3, 0.9, 62)) + 0.01 * rng.normal(size=(62, 62))
    model = km.LinearPredictor(A, rng.normal(size=(62, 1)), np.eye(2, 62), lifting, 0.1, ("a", "b"), ("u",))
    cost = km.Cost(Q=1, R=0.5)
    mpc = km.KoopmanMPC(model, cost, horizon=6)
    x, rows = np.array([0.4, -0.3]), rng.normal(size=(7, 2))
    mpc(x, rows)
    targets = [equilibrium(A, model.B, model.C, np.eye(2), row) for row in rows]
    np.testing.assert_allclose(mpc.plan().U, dense_plan(model, cost, model.lift(x), rows, targets), atol=1e-6)


def test_linear_mpc_is_koopman_mpc_on_the_linearisation():
    A, B = UNSTABLE
    plant = step_map(A, B, constant=[0.1, -0.05])
    cost, limits = km.Cost(1, 0.1), km.Limits(-0.5, 0.5)
    one = km.LinearMPC(plant, [0.4, 0.1], [0.2], cost, limits, 9)
    other = km.KoopmanMPC(km.LinearPredictor.local(plant, [0.4, 0.1], [0.2]), cost, limits, 9)
    third = km.KoopmanMPC(linear(A, B, constant=[0.1, -0.05]), cost, limits, 9)
    for x in ([0.5, 0.2], [0.05, 0.0]):
        u = one(x, [0.1, 0]).u
        np.testing.assert_array_equal(u, other(x, [0.1, 0]).u)
        np.testing.assert_allclose(u, third(x, [0.1, 0]).u, atol=1e-4)
    assert (one.dt, one.nu, one.horizon) == (0.1, 1, 9)


def test_a_constant_whose_own_row_is_blurred_is_still_one():
    """A fit elsewhere may move the Constant's own row; the targets pin it to 1 all the same."""
    plant, _ = lifted_model()
    data = km.collect(plant, km.Uniform([-1.5, -2], [1.5, 2]), km.Noise(-15, 15), episodes=60, steps=20)
    fit = km.edmd(data, km.State() + km.Constant(), ridge=1e-3)
    assert np.array_equal(fit.lifting.names[-1:], ["1"])
    A = fit.A + np.array([[0.0], [0.0], [1.0]]) * [1e-5, -1e-5, -1e-4]
    model = km.LinearPredictor(A, fit.B, fit.C, fit.lifting, fit.dt, fit.states, fit.inputs)
    mpc = km.KoopmanMPC(model, km.Cost(Q=[5, 1], R=0.05), horizon=10)
    assert np.abs(mpc([0.4, 0], [0.4, 0]).u - mpc([0.4, 0], [-0.4, 0]).u) > 0.5


@pytest.mark.parametrize(("solver", "kind"), [("auto", CheckedDAQP), ("osqp", CheckedOSQP)])
def test_every_qp_was_checked(solver, kind):
    before = kind.checked
    A, B = UNSTABLE
    mpc = km.KoopmanMPC(linear(A, B), km.Cost(1, 0.1), km.Limits(-0.2, 0.2), 8, solver=solver)
    with warnings.catch_warnings():
        mpc([0.9, 0.5], [0, 0])
    assert kind.checked == before + 1


def test_the_solver_asked_first_is_named_by_the_user_by_its_settings_or_by_the_rule():
    A, B = UNSTABLE
    make = lambda **o: km.KoopmanMPC(linear(A, B), km.Cost(1, 0.1), km.Limits(-0.2, 0.2), 8, **o)  # noqa: E731
    for options, name in (
        ({}, "daqp"),
        ({"solver": "osqp"}, "osqp"),
        ({"settings": {"max_iter": 200}}, "osqp"),
        ({"settings": {"iter_limit": 200}}, "daqp"),
        ({"settings": {"time_limit": 1.0}}, "daqp"),
    ):
        mpc = make(**options)
        assert mpc.solver == name
        assert mpc([0.9, 0.5], [0, 0]).solver == name
