"""Input timing in closed loop: logs whose input column is late, and plants whose inputs act on their outputs at once.

The measure is the optimum of the true plant, written by hand.
"""

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from tests.bare import shown
from tests.compiler import needs_compiler

A, B, C, D = np.array([[0.9, 0.2], [-0.1, 0.7]]), np.array([[0.3], [0.5]]), np.array([[1.0, 0.3]]), np.array([[0.4]])
N, Q, R, GOAL = 12, 2.0, 0.3, 1.0
COST = km.Cost(Q=Q, R=R, Q_N=Q, u_target="zero")
PLAIN = km.State() + km.Constant()


def log_of(direct, rng, steps=200):
    """Return a log of x⁺ = A x + B u, y_k = C x_k + D u_k; or of y_k = C x_k with each input one row too low."""
    x, U, Y = np.zeros(2), rng.uniform(-1, 1, (steps + 1, 1)), np.empty((steps + 1, 1))
    for k, u in enumerate(U):
        Y[k] = C @ x + direct * D @ u
        x = A @ x + B @ u
    rows = U[:-1] if direct else np.vstack([[[0.0]], U[:-2]])
    return km.Episodes([km.Episode(X=Y, U=rows)], 0.1, ["y"], ["u"])


def learn(direct, kind="linear"):
    """Return the exact model of a log whose inputs were moved one row up, as `select` moves them."""
    data = log_of(direct, np.random.default_rng(0)).with_inputs_advanced(1)
    model = km.edmd(data, PLAIN, embedding=km.Delay(1 + direct), route="qr")
    if kind == "linear":
        return model
    about = model.C, model.lifting, model.dt, model.states, model.inputs, model.report
    return km.BilinearPredictor(
        model.A, model.B, np.zeros((1, model.nz, model.nz)), *about, embedding=model.embedding, scale=model.scale
    )


def controller(kind, direct, horizon=N):
    model = learn(direct, kind)
    if kind == "linear":
        rule = km.LiftedKalman(model.C, feedthrough=bool(direct)) if direct else None
        return km.KoopmanMPC(model, COST, None, horizon, estimator=rule)
    return km.BilinearMPC(model, COST, None, horizon, estimator=km.ExtendedKalman(feedthrough=True) if direct else None)


def best_input(x, direct):
    """Return u_0 of the least Σ Q (y_j − r)² + R u_j², j = 0 … N−1 with feedthrough, else y_{j+1} beside u_j."""
    ahead = 0 if direct else 1
    powers = [np.linalg.matrix_power(A, j) for j in range(N + 1)]
    free = np.array([(C @ powers[j + ahead] @ x).item() for j in range(N)])
    T = np.zeros((N, N))
    for j in range(N):
        for i in range(j + ahead):
            T[j, i] = (C @ powers[j + ahead - 1 - i] @ B).item()
        T[j, j] += direct * D.item()
    return np.linalg.solve(Q * T.T @ T + R * np.eye(N), Q * T.T @ (GOAL - free))[0]


@pytest.mark.parametrize("kind", ["linear", "bilinear"])
@pytest.mark.parametrize("direct", [0, 1])
def test_an_exact_linear_plant_of_each_timing_is_driven_as_by_the_optimum_written_by_hand(kind, direct):
    mpc = controller(kind, direct)
    mpc.reset()
    x, u = np.zeros(2), np.zeros(1)
    for _ in range(30):
        best = best_input(x, direct)
        u = mpc(C @ x + direct * D @ u, [GOAL]).u  # a controller reads y before it chooses u
        assert abs(u[0] - best) < 1e-9
        x = A @ x + B @ u


def test_a_model_that_select_takes_with_feedthrough_drives_the_plant_as_its_optimum():
    found = km.select(
        log_of(1, np.random.default_rng(0)),
        horizon=5,
        options=km.SearchOptions(candidates=[PLAIN], delays=[2], smooth=False, feedthrough=True),
    )
    assert found.predictor.input_lead == 1
    assert "feedthrough=True" in str(found)
    e = found.predictor.align(log_of(1, np.random.default_rng(1)))[0]
    history = km.Episode(X=e.X[:3], U=e.U[:2])
    assert found.linear.rollout(e.X[2], e.U[2:60], history=history)[:, 0] == pytest.approx(e.X[2:61, 0], abs=1e-5)
    rule = km.LiftedKalman(found.linear.C, feedthrough=True)
    mpc = km.KoopmanMPC(found.linear, COST, None, N, estimator=rule)
    x, u = np.zeros(2), np.zeros(1)
    for _ in range(30):
        best = best_input(x, 1)
        u = mpc(C @ x + D @ u, [GOAL]).u
        assert abs(u[0] - best) < 1e-4
        x = A @ x + B @ u


def test_feedthrough_without_inputs_is_refused_in_a_sentence():
    data = log_of(1, np.random.default_rng(0))
    with pytest.raises(km.errors.DataError, match="feedthrough says how inputs act, and the data have none"):
        km.select(km.Episodes([km.Episode(X=data[0].X)], 0.1), options=km.SearchOptions(feedthrough=True))
    (said,) = shown("""
data = km.Episodes([km.Episode(X=np.zeros((9, 1)), U=np.ones((8, 1)))], 0.1)
show(lambda: km.select(data, options=km.SearchOptions(feedthrough=1)))
""")
    assert said.startswith("DataError feedthrough is an int")


def plant_with_feedthrough():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    F = ca.Function("F", [x, u], [ca.DM(A) @ x + ca.DM(B) @ u])
    return km.StepMap(F, 0.1, ca.Function("h", [x, u], [ca.DM(C) @ x + ca.DM(D) @ u]), inputs=["valve [%]"])


def test_a_plant_with_feedthrough_is_simulated_with_the_reading_before_each_input():
    plant = plant_with_feedthrough()
    assert plant.states == ("x0", "x1", "valve[k-1] [%]")
    run = km.simulate(plant, controller("linear", 1), x0=[0, 0, 0], reference=[GOAL], steps=30)
    x, before = np.zeros(2), np.zeros(1)
    for y, u in zip(run.Y, run.U, strict=False):
        assert y == pytest.approx(C @ x + D @ before, abs=1e-12)
        assert u[0] == pytest.approx(best_input(x, 1), abs=1e-9)
        x, before = A @ x + B @ u, u


def test_logs_of_such_readings_need_no_other_timing():
    plant = plant_with_feedthrough()
    data = km.collect(plant, km.Uniform([-1, -1, 0], [1, 1, 0]), km.Noise(-1, 1), episodes=6, steps=30)
    model = km.edmd(data, PLAIN, embedding=km.Delay(2), route="qr")
    assert model.report.residual.max() < 1e-9


def test_a_reading_that_is_taken_for_a_row_of_the_log_drives_the_plant_otherwise():
    mpc = km.KoopmanMPC(learn(1), COST, None, N)
    x, u, gap = np.zeros(2), np.zeros(1), 0.0
    for _ in range(30):
        best = best_input(x, 1)
        u = mpc(C @ x + D @ u, [GOAL]).u
        gap, x = max(gap, abs(u[0] - best)), A @ x + B @ u
    assert gap > 0.05


@pytest.mark.parametrize("kind", ["linear", "bilinear"])
def test_a_wrong_start_is_forgotten_and_a_load_leaves_no_offset(kind):
    model = learn(1, kind)
    cost, limits = km.Cost(Q=Q, R=R), km.Limits(u_min=-3, u_max=3)
    mpc = (
        km.KoopmanMPC(model, cost, limits, N, estimator=km.LiftedKalman(model.C, feedthrough=True))
        if kind == "linear"
        else km.BilinearMPC(model, cost, limits, N, estimator=km.ExtendedKalman(feedthrough=True))
    )
    x, u = np.array([1.0, -2.0]), np.zeros(1)
    for _ in range(150):
        u = mpc(C @ x + D @ u, [GOAL]).u
        x = A @ x + B @ (u + 0.3)
    assert abs(C @ x + D @ u - GOAL) < 1e-3


def test_a_bilinear_plant_with_feedthrough_is_driven_as_by_its_optimum():
    """x⁺ = 0.8 x + 0.3 u + 0.15 u x, y = x + 0.4 u: of y_{k−1} and u_{k−1} the row y_k is a polynomial, plus 0.4 u_k."""
    rng = np.random.default_rng(1)

    def step(x, u):
        return 0.8 * x + 0.3 * u + 0.15 * u * x

    x, U, Y = 0.0, rng.uniform(-1, 1, (301, 1)), np.empty((301, 1))
    for k, u in enumerate(U[:, 0]):
        Y[k] = x + 0.4 * u
        x = step(x, u)
    data = km.Episodes([km.Episode(X=Y, U=U[:-1])], 0.1, ["y"], ["u"]).with_inputs_advanced(1)
    model = km.bilinear_edmd(data, PLAIN + km.Monomials(2), embedding=km.Delay(1), route="qr")
    assert model.report.residual.max() < 1e-9
    steps = 8
    rule = km.ExtendedKalman(feedthrough=True)
    mpc = km.BilinearMPC(model, COST, None, steps, sqp_iterations=8, estimator=rule)
    start, plan = ca.SX.sym("x"), ca.SX.sym("u", steps)
    z, value = start, ca.SX(0)
    for j in range(steps):
        value += Q * (z + 0.4 * plan[j] - GOAL) ** 2 + R * plan[j] ** 2
        z = step(z, plan[j])
    quiet = {"ipopt.print_level": 0, "print_time": 0, "ipopt.tol": 1e-12, "ipopt.sb": "yes"}
    solve = ca.nlpsol("solve", "ipopt", {"x": plan, "p": start, "f": value}, quiet)
    x, u, gaps = 0.0, 0.0, list[float]()
    mpc.reset()
    for _ in range(12):
        best = float(solve(x0=0.5, p=x)["x"][0])
        u = float(mpc([x + 0.4 * u], [GOAL]).u[0])
        gaps.append(abs(u - best))
        x = step(x, u)
    assert max(gaps) < 1e-6


def test_a_filter_begins_where_the_first_reading_says_that_the_plant_rests():
    """A plant that rests under u = 0.7 is driven as by the optimum from the first step on."""
    mpc, u = controller("linear", 1), np.array([0.7])
    x = np.linalg.solve(np.eye(2) - A, B @ u)
    mpc.reset(u_prev=u)
    for _ in range(10):
        best = best_input(x, 1)
        u = mpc(C @ x + D @ u, [GOAL]).u
        assert abs(u[0] - best) < 1e-6
        x = A @ x + B @ u


@needs_compiler
@pytest.mark.parametrize("start", [[0.2], None])
def test_machine_code_reads_as_python_does(start):
    mpc = controller("linear", 1)
    fast = km.compiled(controller("linear", 1))
    rng = np.random.default_rng(3)
    for one in (mpc, fast):
        one.reset(x0=start, u_prev=[0.5])
    x, u = np.array([0.3, 0.1]), np.array([0.5])
    for k in range(40):
        y = C @ x + D @ u + 1e-3 * rng.standard_normal(1) if k % 7 or not k else np.array([np.nan])
        u = mpc(y, [GOAL]).u
        assert np.abs(fast(y, [GOAL]).u - u).max() < 1e-9
        x = A @ x + B @ u


def test_what_feedthrough_does_not_go_with_is_refused_in_a_sentence():
    model = learn(1)
    with pytest.raises(km.errors.DataError, match=r"feedthrough and a period"):
        km.LiftedKalman(model.C, feedthrough=True, period=1.0)
    plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    with pytest.raises(km.errors.DataError, match="give the StepMap an output"):
        km.NonlinearMPC(plant, km.Cost(Q=[1, 1], R=1), None, 5, estimator=km.ExtendedKalman(feedthrough=True))
    data = log_of(1, np.random.default_rng(0))
    watched = km.Episodes([km.Episode(X=e.X, U=e.U, W=0.1 * e.U[::-1]) for e in data], 0.1, ["y"], ["u"], ["w"])
    seen = km.edmd(watched, PLAIN, embedding=km.Delay(1))
    with pytest.raises(km.errors.DataError, match="fit the model without W"):
        km.KoopmanMPC(seen, COST, None, N, estimator=km.LiftedKalman(seen.C, feedthrough=True))
