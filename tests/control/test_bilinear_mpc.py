"""BilinearMPC: KoopmanMPC on a linear plant, NonlinearMPC where it has converged, safe wherever it is sent."""

import copy
import pickle
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from tests.compiler import avoid_compiling, needs_compiler
from tests.tiers import slow

PRECISE = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 100_000}
GOOD = (km.Status.UNCONSTRAINED, km.Status.OPTIMAL, km.Status.SOFTENED)


def linear(nu: int = 1) -> km.LinearPredictor:
    """Return an unstable plant of three states."""
    A = np.array([[1.05, 0.1, 0], [0, 1.02, 0.1], [0.05, 0, 0.9]])
    B = np.array([[0.02, 0.1], [0.1, 0], [0, 0.2]])[:, :nu]
    return km.LinearPredictor(A, B, np.eye(3), km.State(), 0.1, ("a", "b", "c"), ("u", "v")[:nu])


def pendulum() -> km.BilinearPredictor:
    """Return θ⁺ = θ + 0.1 ω, ω⁺ = ω + 0.05 sin θ + 0.1 u cos θ, bilinear on [θ ω sin θ cos θ]."""
    A = np.eye(4)
    A[0, 1], A[1, 2] = 0.1, 0.05
    N = np.zeros((1, 4, 4))
    N[0, 1, 3] = 0.1
    lifting = km.State() + km.Fourier(1, states="theta")
    return km.BilinearPredictor(A, np.zeros((4, 1)), N, np.eye(2, 4), lifting, 0.1, ("theta", "omega"), ("u",))


UPRIGHT = km.Expressions(lambda x: [ca.sin(x[0]), ca.cos(x[0]), x[1]], ["sin(theta)", "cos(theta)", "omega"]).bind(
    ("theta", "omega")
)
CIRCLE = km.Cost(Q=[2, 2, 0.2], R=0.1, of=UPRIGHT)


LIMITS = [
    km.Limits(),
    km.Limits(u_min=-0.5, u_max=0.3),
    km.Limits(u_max=0.1),
    km.Limits(u_min=-1, u_max=1, x_max=[0.25, np.inf, 0.3], slack=(50.0, 10.0)),
    km.Limits(u_min=-1, u_max=1, x_min=-0.6, x_max=0.6, slack=(1.0, 5.0)),
    km.Limits(u_min=-3, u_max=3, x_max=[0.9, np.inf, np.inf], slack=None),
]


@pytest.mark.parametrize("nu", [*slow([1]), 2])
@pytest.mark.parametrize("limits", LIMITS)
def test_on_a_linear_plant_it_is_koopman_mpc(nu: int, limits: km.Limits) -> None:
    model, cost = linear(nu), km.Cost(Q=[1, 2, 1], R=0.3, Q_N=[[9, 1, 2], [1, 8, 3], [2, 3, 6]])
    ours = km.BilinearMPC(model, cost, limits, 15)
    theirs = km.KoopmanMPC(model, cost, limits, 15, settings=PRECISE)
    assert isinstance(ours, km.control.Controller)
    x = np.array([0.5, -0.4, 0.3])
    for k in range(12):
        ahead = np.tile([0.1 if k > 5 else 0.0, 0, 0], (16, 1))
        a, b = ours(x, ahead), theirs(x, ahead)
        assert a.status is b.status
        assert np.allclose(a.u, b.u, atol=1e-5)
        assert np.allclose(ours.plan().U, theirs.plan().U, atol=1e-4)
        assert np.allclose(ours.plan().X, theirs.plan().X, atol=1e-4)
        x = model.A @ x + model.B @ a.u


@pytest.mark.parametrize("limits", [km.Limits(-4, 4), km.Limits(-0.8, 0.5), km.Limits(-0.8, 0.8, x_max=[np.inf, 0.15])])
@pytest.mark.parametrize("cost", [CIRCLE, km.Cost(Q=[1, 0.1], R=0.1)])
def test_converged_passes_are_nonlinear_mpc_on_the_same_map(cost: km.Cost, limits: km.Limits) -> None:
    model = pendulum()
    reference = [0, 1, 0] if cost is CIRCLE else [0, 0]
    ours = km.BilinearMPC(model, cost, limits, 15, sqp_iterations=60)
    theirs = km.NonlinearMPC(model.step_map(), cost, limits, 15, solver=km.control.NLP(settings={"ipopt.tol": 1e-10}))
    x = np.array([0.7, -0.3])
    for _ in range(5):
        a, b = ours(x, reference), theirs(x, reference)
        assert a.status in GOOD
        assert b.status in GOOD
        assert np.allclose(ours.plan().U, theirs.plan().U, atol=2e-4)
        x = model.step_map()(x, a.u)


def test_its_plan_follows_the_model_once_it_has_converged() -> None:
    model = pendulum()
    mpc = km.BilinearMPC(model, CIRCLE, km.Limits(-1, 1), 20, sqp_iterations=60)
    move = mpc([2.0, 0.5], [0, 1, 0])
    plan = mpc.plan()
    assert np.array_equal(plan.X[0], [2.0, 0.5])
    assert np.array_equal(plan.U[0], move.u)
    assert np.allclose(model.step_map().rollout(plan.X[0], plan.U), plan.X, atol=1e-6)


def test_every_turn_of_the_angle_counts_the_same() -> None:
    mpc = km.BilinearMPC(pendulum(), CIRCLE, km.Limits(-1, 1), 20)
    u = mpc([0.6, -0.2], [0, 1, 0]).u
    mpc.reset()
    assert np.allclose(mpc([0.6 + 2 * np.pi, -0.2], [0, 1, 0]).u, u, atol=1e-8)


@needs_compiler
def test_machine_code_and_interpreter_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = km.Limits(-0.8, 0.5, x_max=[np.inf, 0.15])
    fast = km.BilinearMPC(pendulum(), CIRCLE, limits, 20)
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", "")
    slow = km.BilinearMPC(pendulum(), CIRCLE, limits, 20)
    assert fast._iteration.compiled
    assert not slow._iteration.compiled
    x = np.array([2.5, 0.3])
    for _ in range(15):
        a, b = fast(x, [0, 1, 0]), slow(x, [0, 1, 0])
        assert (a.status, a.iterations) == (b.status, b.iterations)
        assert np.allclose(a.u, b.u, rtol=1e-12, atol=1e-12)
        x = pendulum().step_map()(x, a.u)


@cache
def shared() -> km.BilinearMPC:
    return km.BilinearMPC(pendulum(), CIRCLE, km.Limits(-0.8, 0.5, x_min=[-9, -1], x_max=[9, 1]), 10)


measured = st.one_of(st.floats(-20, 20), st.sampled_from([np.nan, np.inf, -np.inf, 1e300, 1e31, 0.0]))


@settings(max_examples=50)
@given(st.lists(st.tuples(measured, measured), min_size=1, max_size=6), st.booleans())
def test_whatever_it_measures_its_input_is_inside_the_limits(states: list, fresh: bool) -> None:
    if fresh:
        shared().reset()
    for x in states:
        move = shared()(x, [0, 1, 0])
        assert (move.u >= -0.8).all()
        assert (move.u <= 0.5).all()
        assert (move.status in GOOD) == (move.fallback is km.control.Fallback.NONE)
        bad = not np.abs(x).max() < 1e30
        assert (move.status is km.Status.BAD_MEASUREMENT) == bad
        assert (shared().plan() is None) == (move.status not in GOOD)


def test_hard_limits_that_nothing_meets_are_found() -> None:
    limits = km.Limits(-1, 1, x_max=[0.5, np.inf], slack=None)
    mpc = km.BilinearMPC(pendulum(), km.Cost(1, 0.1), limits, 10)
    plan = [mpc([0.4, -0.1], [0, 0]), mpc.plan().U][1]
    move = mpc([0.45, 3.0], [0, 0])
    assert (move.status, move.fallback) == (km.Status.INFEASIBLE, km.control.Fallback.SHIFTED_PLAN)
    assert np.array_equal(move.u, plan[1])
    assert mpc.plan() is None
    assert mpc([0.4, -0.1], [0, 0]).status in GOOD


def test_a_soft_limit_that_gives_way_is_reported() -> None:
    mpc = km.BilinearMPC(pendulum(), CIRCLE, km.Limits(-1, 1, x_max=[np.inf, 0.2]), 10)
    assert mpc([0.1, 0.9], [0, 1, 0]).status is km.Status.SOFTENED
    assert mpc([0.1, 0.0], [0, 1, 0]).status in (km.Status.UNCONSTRAINED, km.Status.OPTIMAL)


def test_a_run_repeats_to_the_bit_after_reset_and_in_a_copy() -> None:
    mpc = km.BilinearMPC(pendulum(), CIRCLE, km.Limits(-0.8, 0.5), 15, sqp_iterations=2)

    def run(controller: km.BilinearMPC) -> list[np.ndarray]:
        controller.reset()
        return [controller([3.0 - 0.1 * k, 0.2], [0, 1, 0]).u for k in range(6)]

    first = run(mpc)
    for other in (mpc, copy.deepcopy(mpc), pickle.loads(pickle.dumps(mpc))):
        assert np.array_equal(first, run(other))


def test_copies_go_on_to_the_bit_where_w_multiplies_and_a_disturbance_is_estimated(monkeypatch) -> None:
    avoid_compiling(monkeypatch)
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u", 1), ca.SX.sym("w", 1)
    first = 0.9 * x[0] + 0.2 * x[1] + 0.1 * u[0] * x[1] + 0.2 * w[0] * x[0] + 0.1 * w[0]
    F = ca.vertcat(first, 0.8 * x[1] + 0.4 * u[0] + 0.3 * w[0] * u[0])
    plant = km.StepMap(ca.Function("F", [x, u, w], [F]), 0.1)
    cost, estimator = km.Cost(Q=[1, 0.5], R=0.3), km.LiftedDisturbance()
    mpc = km.BilinearMPC(plant, cost, km.Limits(u_min=-1, u_max=1), 4, estimator=estimator)
    rng, y = np.random.default_rng(0), np.array([0.4, -0.3])
    rows = 0.5 * rng.standard_normal((4, 2))
    for k in range(12):
        W, r = np.array([0.5 * np.sin(k // 3)]), rows[k // 2 % 4]
        twins = [copy.copy(mpc), pickle.loads(pickle.dumps(mpc))] if k % 4 == 1 else []
        u_k = mpc(y, r, w=W).u
        for twin in twins:
            assert np.array_equal(twin(y, r, w=W).u, u_k)
        y = np.asarray(plant(y, u_k, W)).ravel() + 0.03 * rng.standard_normal(2)


def test_copies_follow_a_disturbance_to_the_bit_with_the_factors_of_an_earlier_step(monkeypatch) -> None:
    avoid_compiling(monkeypatch)
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    F = ca.vertcat(0.9 * x[0] + 0.2 * x[1] + 0.1 * u[0] * x[1], 0.8 * x[1] + 0.3 * ca.sin(x[0]) + 0.4 * u[0])
    plant = km.StepMap(ca.Function("F", [x, u], [F]), 0.1)
    mpc = km.BilinearMPC(plant, km.Cost(Q=[1, 0.5], R=0.3), None, 4, estimator=km.LiftedDisturbance())
    y = np.array([0.8, -0.3])
    for k in range(7):
        twins = [copy.copy(mpc)] if k == 6 else []
        u_k = mpc(y, [0.3, 0.0]).u
        for twin in twins:
            assert np.array_equal(twin(y, [0.3, 0.0]).u, u_k)
        y = np.asarray(plant(y, u_k)).ravel() + np.array([0.02, 0.1])


def test_two_in_two_threads_do_not_disturb_each_other() -> None:
    limits, plant = km.Limits(-0.8, 0.5, x_max=[np.inf, 0.5]), pendulum().step_map()

    def run(job: tuple[km.BilinearMPC, float]) -> list[np.ndarray]:
        (controller, load), x, found = job, np.array([0.9, 0.2]), []
        for _ in range(60):
            found.append(controller(x, [0.3, 0]).u)
            x = plant(x, found[-1]) + np.array([0, load])
        return found

    def made() -> km.BilinearMPC:
        return km.BilinearMPC(pendulum(), km.Cost(Q=[1, 0.1], R=0.1), limits, 15, estimator=km.LiftedDisturbance(0.3))

    loads = (0.005, -0.005)
    alone = [run((made(), load)) for load in loads]
    controller = made()
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(run, zip((controller, copy.deepcopy(controller)), loads, strict=True)))
    for a, b in zip(alone, together, strict=True):
        assert np.array_equal(a, b)


def test_a_solver_that_is_made_to_fail_leaves_the_last_plan() -> None:
    mpc = km.BilinearMPC(pendulum(), CIRCLE, km.Limits(-0.8, 0.5), 15)
    mpc([1.0, 0.2], [0, 1, 0])
    plan = mpc.plan().U
    mpc.solver_fails = True
    move = mpc([1.0, 0.2], [0, 1, 0])
    assert (move.status, move.fallback) == (km.Status.FAILED, km.control.Fallback.SHIFTED_PLAN)
    assert np.array_equal(move.u, plan[1])
    mpc.solver_fails = False
    assert mpc([1.0, 0.2], [0, 1, 0]).status in GOOD


def test_a_reference_that_is_not_finite_is_a_bad_measurement() -> None:
    mpc = km.BilinearMPC(pendulum(), CIRCLE, km.Limits(-0.8, 0.5), 15)
    assert mpc([1.0, 0.2], [0, np.nan, 0]).status is km.Status.BAD_MEASUREMENT
    assert mpc([1.0, 0.2], [0, 1, 0]).status in GOOD


def test_it_takes_a_step_map_of_one_state() -> None:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    plant = km.StepMap(ca.Function("F", [x, u], [x + 0.1 * ca.sin(x) + 0.1 * u]), 0.1)
    for N in (1, 5):
        mpc = km.BilinearMPC(plant, km.Cost(1, 0.01), km.Limits(-1, 1), N)
        state = np.array([0.8])
        for _ in range(60):
            state = plant(state, mpc(state, [0]).u)
        assert abs(state[0]) < 1e-3


def test_the_constant_of_an_affine_model_does_no_harm() -> None:
    model = km.LinearPredictor.local(pendulum().step_map(), [0.3, 0.1], [0.2])
    assert km.Constant().bind(model.states).names[0] in model.lifting.names
    assert km.BilinearMPC(model, km.Cost(1, 0.1), None, 5)([0.3, 0.1], [0, 0]).status is km.Status.UNCONSTRAINED


def test_a_step_that_fails_without_a_plan_takes_the_clipped_optimum() -> None:
    """A hard limit that nothing meets: the loop goes on as a feedback law, and comes back inside."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    x_next = ca.vertcat(x[0] + 0.1 * x[1], x[1] + 0.3 * ca.sin(x[0]) + 0.1 * u)
    plant = km.StepMap(ca.Function("F", [x, u], [x_next]), 0.1, states=("theta", "omega"), inputs=("u",))
    for rate in (None, 2.0):
        mpc = km.BilinearMPC(
            plant, km.Cost([2, 0.2], 0.1), km.Limits(-9, 9, x_max=[0.1, np.inf], slack=None, du_max=rate), 15
        )
        state = np.array([0.5, 0.0])
        first = mpc(state, [0, 0])
        assert (first.status, first.fallback) == (km.Status.INFEASIBLE, km.control.Fallback.CLIPPED_LQR)
        assert -9 <= first.u[0] < -1
        assert rate is None or first.u[0] == -rate
        for _ in range(60):
            move = mpc(state, [0, 0])
            state = plant(state, move.u)
        assert move.fallback is km.control.Fallback.NONE
        assert np.abs(state).max() < 0.01


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("tracked", [km.State(["x1"]), None])
def test_of_the_states_that_hold_a_reference_the_one_near_the_data_is_taken(side, tracked):
    """x1⁺ = x1 + 0.1 (x2² − x1), x2⁺ = x2 + 0.1 (u − x2) rests at x1 = 1 with x2 = u = 1, and with −1."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    step = ca.vertcat(x[0] + 0.1 * (x[1] ** 2 - x[0]), x[1] + 0.1 * (u - x[1]))
    plant = km.StepMap(ca.Function("F", [x, u], [step]), 0.1, states=["x1", "x2"], inputs=["u"])
    starts = km.Uniform(*np.sort([[0.5, 0.6 * side], [1.5, 1.4 * side]], axis=0))
    data = km.collect(plant, starts, km.Noise(*np.sort([0.6 * side, 1.4 * side])), episodes=20, steps=20)
    model = km.bilinear_edmd(data, km.State() + km.Constant() + km.Monomials(2), ridge=1e-9)
    cost = km.Cost(Q=[1] if tracked else [1, 0], R=0.1, of=tracked or km.State())
    mpc = km.BilinearMPC(model, cost, km.Limits(u_min=-3, u_max=3), 10)
    run = km.simulate(plant, mpc, x0=[1.2, 1.1 * side], reference=[1] if tracked else [1, 0], steps=80, cost=cost)
    np.testing.assert_allclose(run.X[-1], [1, side], atol=1e-3)


def strongly_bilinear(seed):
    """Return a random bilinear model with a large product of state and input, a controller with hard limits, and its g(X) ≤ 0.5."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(2, 2))
    A *= rng.uniform(0.8, 1.15) / np.abs(np.linalg.eigvals(A)).max()
    B = rng.normal(size=(2, 1))
    N = rng.uniform(0.3, 1.2) * rng.normal(size=(2, 2))
    model = km.BilinearPredictor(A, B, N[None], np.eye(2), km.State(), 0.1, ["p", "v"], ["u"])
    if seed % 2:
        squares = km.Monomials(2, states=[0, 1]).bind(("p", "v"))
        limits = km.Limits(u_min=-1, u_max=1, of=squares, y_max=[0.5] * squares.nz, slack=None)
        limited = squares
    else:
        limits = km.Limits(u_min=-1, u_max=1, x_min=-0.5, x_max=0.5, slack=None)
        limited = np.abs
    mpc = km.BilinearMPC(model, km.Cost(Q=[1, 0.2], R=0.3), limits, 12)
    return rng, mpc, lambda x, u: A @ x + B @ u + u[0] * N @ x, limited


def count_broken_plans(seeds, twins=()):
    """Return how many solved plans there were, and how many of them break a hard limit on the model."""
    solved = broken = 0
    for seed in seeds:
        rng, mpc, ahead, limited = strongly_bilinear(seed)
        twin = km.compiled(mpc) if seed in twins else None
        for _ in range(12):
            x, reference = rng.uniform(-1, 1, 2), rng.uniform(-0.8, 0.8, 2)
            for each in filter(None, (mpc, twin)):
                each.reset()
            for _ in range(4):
                move = mpc(x, reference)
                if twin is not None:
                    same = twin(x, reference)
                    assert same.status is move.status
                    assert same.u == pytest.approx(move.u, abs=1e-5)
                if move.status not in GOOD:
                    break
                X = [x]
                for u in mpc.plan().U:
                    X.append(ahead(X[-1], u))
                most = max(limited(np.array(X[1:])).max(), limited(mpc.plan().X[1:]).max())
                solved, broken = solved + 1, broken + (most > 0.5 * (1 + 1.01e-4))
                x = X[1]
    return solved, broken


def test_a_plan_that_counts_as_solved_keeps_its_hard_limits_on_the_model():
    solved, broken = count_broken_plans([0, 18, 25, 55], twins=[0])
    assert solved > 100
    assert broken == 0


@pytest.mark.slow
def test_plans_of_sixty_models_keep_their_hard_limits():
    solved, broken = count_broken_plans(range(60), twins=[18, 25, 51])
    assert solved > 1500
    assert broken == 0


def test_an_affine_problem_is_solved_by_one_linearisation(monkeypatch):
    """All starts lead to the plan of KoopmanMPC."""
    A, B = np.array([[1.1, 0.1], [0.0, 1.05]]), np.array([[0.0], [0.1]])
    model = km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ("x", "v"), ("u",))
    cost, limits = km.Cost(Q=[1, 1], R=1e-3), km.Limits(-1, 1, x_max=[0.3, 0.1])
    one, other = km.BilinearMPC(model, cost, limits, 15), km.KoopmanMPC(model, cost, limits, 15)
    step, taken = one._iteration.step, []
    monkeypatch.setattr(one._iteration, "step", lambda *rest: taken.append(1) or step(*rest))
    x = [0.2, 0.1]
    np.testing.assert_allclose(one(x, [0, 0]).u, other(x, [0, 0]).u, atol=1e-6)
    assert len(taken) == 1
