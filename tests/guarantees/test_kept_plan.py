"""Bilinear and nonlinear controllers with a terminal set and its feedback: plans stay feasible, and their cost falls."""

import copy

import numpy as np
import pytest

import koopmpc as km
from tests.searches import certify


def draw_task(seed):
    """Return a random bilinear model, its limits, a certificate of it, and a generator."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 4))
    nu = int(rng.integers(1, min(n, 2) + 1))
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.6, 1.1) / np.abs(np.linalg.eigvals(A)).max()
    B, N = rng.normal(size=(n, nu)), 0.4 * rng.normal(size=(nu, n, n))
    names = [f"x{i}" for i in range(n)], [f"u{i}" for i in range(nu)]
    model = km.BilinearPredictor(A, B, N, np.eye(n), km.State(), 0.1, *names)
    X, U = rng.uniform(-3, 3, (60, n)), rng.uniform(-1, 1, (60, nu))
    pairs = [km.Episode(X=np.stack([x, step(model, x, u)]), U=u[None]) for x, u in zip(X, U, strict=True)]
    data = km.Episodes(pairs, dt=0.1, states=model.states, inputs=model.inputs)
    box = {"u_min": -1.0, "u_max": rng.uniform(0.7, 1.3, nu), "x_max": rng.uniform(0.8, 2.5, n)}
    end = certify(model, data, km.Limits(**box), error=(0, 0), region=(-3, 3), decay=0.9)
    return model, box, end, rng


def step(model, x, u):
    return model.A @ x + model.B @ u + np.einsum("i,ijk,k->j", u, model.N, x)


def run_random_loops(seed, kind, starts, steps):
    """Return the counts of `run_loops` for a random task; zeros where it has no certificate."""
    try:
        task = draw_task(seed)
        return run_loops(task, kind, starts, steps)
    except km.errors.CertificateError:  # none is found, or its feedback has no bound of its inputs
        return 0, 0, 0, 0


def run_loops(task, kind, starts, steps):
    """Return the loops of a task, those feasible at first, later steps without a plan, and rises of J."""
    model, box, end, rng = task
    cost = km.Cost(Q=rng.uniform(0.1, 2, model.nx), R=rng.uniform(0.05, 1, model.nu), Q_N=end)
    limits = km.Limits(**box, slack=None, terminal=end, terminal_slack=None)
    mpc = kind(model, cost, limits, horizon=int(rng.integers(2, 9)))
    feasible = lost = rises = 0
    for _ in range(starts):
        x, before = rng.normal(size=model.nx) * rng.uniform(0.3, 2.0), None
        mpc.reset()
        for k in range(steps):
            move, plan = mpc(x, np.zeros(model.nx)), mpc.plan()
            if plan is None or move.status is km.Status.INFEASIBLE:
                lost += k > 0
                break
            feasible += k == 0
            assert (plan.X[1:] <= box["x_max"] * (1 + 1.1e-4)).all()
            assert end.value(plan.X[-1]) <= 1 + 2e-6
            J = np.sum(plan.X[:-1] ** 2 * cost.Q) + np.sum(plan.U**2 * cost.R) + plan.X[-1] @ cost.Q_N @ plan.X[-1]
            rises += before is not None and before + 1e-8 * (1 + before) < J
            before = J - x @ (cost.Q * x) - move.u @ (cost.R * move.u)
            x = step(model, x, move.u)
    return starts, feasible, lost, rises


@pytest.fixture(scope="module")
def task():
    """Return a task in whose loops J rises without kept plans."""
    return draw_task(6)


@pytest.mark.parametrize("kind", [km.BilinearMPC, km.NonlinearMPC])
def test_a_plan_that_is_feasible_once_stays_so_and_its_cost_falls_by_the_stage_cost(kind, task):
    loops, feasible, lost, rises = run_loops((*task[:3], np.random.default_rng(0)), kind, 5, 6)
    assert loops == 5
    assert feasible >= 4
    assert (lost, rises) == (0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [km.BilinearMPC, km.NonlinearMPC])
def test_many_loops_stay_feasible_and_their_cost_falls(kind):
    loops, feasible, lost, rises = np.sum([run_random_loops(seed, kind, 10, 30) for seed in range(60)], axis=0)
    assert loops >= 300
    assert feasible > loops // 2
    assert (lost, rises) == (0, 0)


@pytest.mark.parametrize("kind", [km.BilinearMPC, km.NonlinearMPC])
@pytest.mark.parametrize("horizon", [1, 3])
def test_a_solver_that_fails_is_replaced_by_the_kept_plan_to_the_end(kind, horizon, task):
    model, box, end, _ = task
    limits = km.Limits(**box, slack=None, terminal=end, terminal_slack=None)
    mpc = kind(model, km.Cost(Q=1, R=1, Q_N=end), limits, horizon)
    x = 0.9 * end.sample(1)[0]
    assert mpc(x, np.zeros(model.nx)).fallback.name == "NONE"
    plan, mpc.solver_fails = mpc.plan(), True
    for k in range(8):  # longer than the horizon: the feedback prolongs the plan
        x = step(model, x, plan.U[0])
        move, plan = mpc(x, np.zeros(model.nx)), mpc.plan()
        assert (move.status.name, move.fallback.name) == ("FAILED", "SHIFTED_PLAN")
        assert end.value(plan.X[-1]) <= 1
        if k > 3:
            assert move.u == pytest.approx(end.feedback(x))
    copied = copy.deepcopy(mpc)
    copied.solver_fails = True
    x = step(model, x, move.u)
    assert copied(x, np.zeros(model.nx)).u == pytest.approx(mpc(x, np.zeros(model.nx)).u)


def test_a_linear_model_in_a_bilinear_controller_keeps_its_plan_by_the_feedback_of_its_tail():
    model = km.BilinearPredictor(
        [[1.0, 0.3], [0.0, 1.0]], [[0.0], [0.3]], np.zeros((1, 2, 2)), np.eye(2), km.State(), 0.3, ["p", "v"], ["u"]
    )
    linear = km.LinearPredictor(model.A, model.B, model.C, km.State(), 0.3, ["p", "v"], ["u"])
    cost, box = km.Cost(Q=1, R=0.1), {"u_min": -1, "u_max": 1}
    for rates in ({}, {"du_max": 0.5}):
        end = km.guarantees.find_terminal_set(linear, cost, km.Limits(**box, **rates), [0.0, 0.0])
        hard = km.Limits(**box, **rates, slack=None, terminal=end, terminal_slack=None)
        mpc, x = km.BilinearMPC(model, cost, hard, 6), np.array([0.5, 0.0])
        assert mpc(x, [0.0, 0.0]).fallback.name == "NONE"
        mpc.solver_fails, last = True, None
        for _ in range(12):
            x = step(model, x, mpc.plan().U[0])
            assert mpc(x, [0.0, 0.0]).fallback.name == "SHIFTED_PLAN"
            u = mpc.plan().U
            assert (
                np.abs(np.diff(u if last is None else np.vstack([last, u]), axis=0)).max()
                <= rates.get("du_max", 2) + 1e-9
            )
            last = u[0]
        assert np.abs(x).max() < 0.2


def test_a_feedback_of_another_size_is_refused():
    feedback = km.guarantees.TerminalFeedback([0.0], [[1.0, 2.0]])
    with pytest.raises(km.errors.ShapeError, match="feedback of the terminal set has 2"):
        km.guarantees.TerminalSet([0.0], W=1.0, feedback=feedback)
    with pytest.raises(km.errors.ShapeError, match="K"):
        km.guarantees.TerminalFeedback([0.0, 0.0], [[1.0]])
