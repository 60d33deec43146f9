"""Terminal sets and costs: a plan that ends in its set stays feasible, its cost falls, and an ellipsoid is met."""

import warnings

import numpy as np
import pytest
import scipy.linalg
import scipy.signal

import koopmpc as km
from tests.searches import certify


def draw_model(rng, n=None, nu=None):
    """Return a random controllable linear model, some of them unstable."""
    n = int(rng.integers(1, 4)) if n is None else n
    nu = int(rng.integers(1, min(n, 2) + 1)) if nu is None else nu
    A = rng.normal(size=(n, n))
    A *= rng.uniform(0.5, 1.1) / np.abs(np.linalg.eigvals(A)).max()
    B = rng.normal(size=(n, nu))
    system = scipy.signal.dlti(A, B, np.eye(n), np.zeros((n, nu)), dt=0.1)
    return km.LinearPredictor.from_state_space(system)


def make_cart():
    """Return a double integrator."""
    system = scipy.signal.dlti([[1.0, 0.3], [0.0, 1.0]], [[0.0], [0.3]], np.eye(2), np.zeros((2, 1)), dt=0.3)
    return km.LinearPredictor.from_state_space(system)


def draw_task(rng):
    """Return a model, a cost, limits, a set point and the weight of its stationary tail on [x; u_prev]."""
    model = draw_model(rng)
    n, nu = model.nx, model.nu
    Q, R = rng.uniform(0.1, 2, n), rng.uniform(0.05, 1, nu)
    R_delta = rng.uniform(0.05, 1, nu) if rng.uniform() < 0.3 else None
    rates = rng.uniform(0.4, 1.0) if rng.uniform() < 0.4 else None
    box = {"u_min": -1, "u_max": rng.uniform(0.7, 1.3, nu), "x_max": rng.uniform(1, 3, n), "du_max": rates}
    u_r = rng.uniform(-0.1, 0.1, nu)
    x_r = np.linalg.solve(np.eye(n) - model.A, model.B @ u_r)
    if not (x_r < 0.5 * box["x_max"]).all():
        x_r, u_r = np.zeros(n), np.zeros(nu)
    cost = km.Cost(Q=Q, R=R, R_delta=R_delta)
    if nu > 1 or R_delta is not None or rates is not None:  # the input that holds a reference need not be unique
        x_r = np.zeros(n)
    A, B, weights, S = model.A, model.B, np.diag(Q), None
    if R_delta is not None:
        A = scipy.linalg.block_diag(A, np.zeros((nu, nu)))
        B = np.vstack([model.B, np.eye(nu)])
        weights = scipy.linalg.block_diag(np.diag(Q), np.diag(R_delta))
        S = np.vstack([np.zeros((n, nu)), -np.diag(R_delta)])
    R_all = np.diag(R) + (0 if R_delta is None else np.diag(R_delta))
    P = scipy.linalg.solve_discrete_are(A, B, weights, R_all, s=S)
    return model, cost, box, x_r, P


def stage_cost(cost, x, u, last):
    """Return what a step costs, from deviations."""
    spent = x @ (cost.Q * x) + u @ (cost.R * u)
    return spent + (0 if cost.R_delta is None else (u - last) @ (cost.R_delta * (u - last)))


def plan_cost(cost, P, plan, x_r, u_r, last):
    """Return what a plan costs, its first state included."""
    X, U, total = plan.X - x_r, plan.U - u_r, 0.0
    before = last - u_r
    for x, u in zip(X[:-1], U, strict=True):
        total += stage_cost(cost, x, u, before)
        before = u
    end = X[-1] if cost.R_delta is None else np.concatenate([X[-1], before])
    return total + end @ P @ end


def run_loops(seed, starts, steps=100):
    """Return the loops of one random task, of these those feasible at first, later INFEASIBLE ones, and rises of J."""
    rng = np.random.default_rng(seed)
    model, cost, box, x_r, P = draw_task(rng)
    try:
        found = km.guarantees.find_terminal_set(model, cost, km.Limits(**box), x_r)
    except km.errors.CertificateError:  # a slow loop whose polytope does not end
        return 0, 0, 0, 0
    limits = km.Limits(**box, slack=None, terminal=found, terminal_slack=None)
    mpc = km.KoopmanMPC(model, cost, limits, horizon=int(rng.integers(2, 9)))
    u_r = np.linalg.lstsq(model.B, x_r - model.A @ x_r, rcond=None)[0]
    feasible = lost = rises = 0
    for _ in range(starts):
        x, last = x_r + rng.normal(size=model.nx) * rng.uniform(0.2, 1.5), np.clip(np.zeros(model.nu), -1, box["u_max"])
        mpc.reset(u_prev=last)
        before = None
        for k in range(steps):
            move = mpc(x, x_r)
            if move.status is km.Status.INFEASIBLE:
                lost += k > 0
                break
            if move.status not in (km.Status.OPTIMAL, km.Status.UNCONSTRAINED):
                lost += 1
                break
            feasible += k == 0
            J = plan_cost(cost, P, mpc.plan(), x_r, u_r, last)
            if before is not None:
                rises += before + 1e-8 * (1 + before) < J
            before = J - stage_cost(cost, x - x_r, move.u - u_r, last - u_r)
            x, last = model.A @ x + model.B @ move.u, move.u
    return starts, feasible, lost, rises


def count_loops(plants, starts, steps=100):
    return np.sum([run_loops(seed, starts, steps) for seed in range(plants)], axis=0)


def test_a_loop_that_is_feasible_once_stays_so_and_its_cost_falls_by_the_stage_cost():
    loops, feasible, lost, rises = count_loops(7, 7, 40)
    assert loops >= 42
    assert feasible > loops // 4
    assert (lost, rises) == (0, 0)


@pytest.mark.slow
def test_ten_thousand_loops_stay_feasible_and_their_cost_falls():
    loops, feasible, lost, rises = count_loops(220, 50)
    assert loops >= 10_000
    assert feasible > loops // 4
    assert (lost, rises) == (0, 0)


def has_optimum(problem):
    """Return whether Clarabel solves a program, False if it is infeasible."""
    import cvxpy as cp

    for digits in (11, 9, 8, 7):
        tolerance = 10.0**-digits
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of an inaccurate answer, which is not taken
            problem.solve(solver=cp.CLARABEL, tol_gap_abs=tolerance, tol_gap_rel=tolerance, tol_feas=tolerance)
        if problem.status in ("optimal", "infeasible"):
            return problem.status == "optimal"
    raise AssertionError(problem.status)


def draw_ellipsoid(rng, sizes, horizons, stretch, least):
    """Return a model, a cost with an end of its own, a horizon and an ellipsoid; the last two say how thin this is."""
    model = draw_model(rng, n=int(rng.integers(*sizes)))
    n, N = model.nx, int(rng.integers(*horizons))
    root = rng.normal(size=(n, n)) + 0.3 * np.eye(n)
    W = root.T @ root * 10 ** rng.uniform(0, stretch) + least * np.eye(n)
    Q_N = np.diag(rng.uniform(0.1, 1, n))
    cost = km.Cost(Q=rng.uniform(0.1, 2, n), R=rng.uniform(0.05, 1, model.nu), Q_N=Q_N)
    return model, cost, N, km.guarantees.TerminalSet(np.zeros(n), of=km.State(), W=W)


def solve_cone_program(mpc, x0, prices=None):
    """Return a plan's inputs and how far it ends outside its ellipsoid, by Clarabel; None where there is no plan.

    The `prices` are those of leaving the limits of states and the ellipsoid; without them both are hard.
    """
    import cvxpy as cp

    model, cost, limits, N = mpc.predictor, mpc.cost, mpc.limits, mpc.horizon
    X, U = cp.Variable((N + 1, model.nx)), cp.Variable((N, model.nu))
    root, end = np.linalg.cholesky(limits.terminal.W).T, np.linalg.cholesky(cost.Q_N).T
    spent = cp.sum_squares(X[1:N] @ np.diag(np.sqrt(cost.Q))) + cp.sum_squares(end @ X[N])
    spent += cp.sum_squares(U @ np.diag(np.sqrt(cost.R)))
    over, past = np.zeros((N, model.nx)), cp.Constant(0)
    if prices is not None:
        over, past = cp.Variable((N, model.nx), nonneg=True), cp.Variable(nonneg=True)
        spent += prices[0] * cp.sum(over) + prices[1] * cp.sum_squares(over) + prices[2] * past + prices[3] * past**2
    keeps = [X[0] == x0, limits.u_min <= U, limits.u_max >= U, cp.norm(root @ X[N]) <= 1 + past]
    keeps += [X[1:] == X[:-1] @ model.A.T + U @ model.B.T, X[1:] <= np.tile(limits.x_max, (N, 1)) + over]
    return (U.value, float(past.value)) if has_optimum(cp.Problem(cp.Minimize(spent), keeps)) else None


def compare_with_cone_program(seeds):
    """Return how many plans agreed with Clarabel's, of these those with an active ellipsoid, and infeasible ones."""
    agreed = active = infeasible = 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        model, cost, N, end = draw_ellipsoid(rng, (2, 6), (2, 9), stretch=4, least=1e-3)
        n = model.nx
        limits = km.Limits(-1, 1, x_max=rng.uniform(1, 3, n), slack=None, terminal=end, terminal_slack=None)
        mpc = km.KoopmanMPC(model, cost, limits, horizon=N)
        x0 = rng.normal(size=n) * rng.uniform(0.2, 1.5)
        move, oracle = mpc(x0, np.zeros(n)), solve_cone_program(mpc, x0)
        if oracle is None:
            assert move.status is km.Status.INFEASIBLE, (seed, move.status)
            infeasible += 1
            continue
        assert move.status in (km.Status.OPTIMAL, km.Status.UNCONSTRAINED), (seed, move.status)
        plan = mpc.plan()
        gauge = float(end.measure(plan.X[-1]))
        assert gauge <= 1 + 1.1e-8, (seed, gauge)
        missed = np.abs(plan.U - oracle[0]).max()
        assert missed < 1e-4, (seed, missed)
        agreed, active = agreed + 1, active + (gauge > 1 - 1e-6)
    return agreed, active, infeasible


def test_an_ellipsoid_is_that_of_a_cone_program():
    agreed, active, infeasible = compare_with_cone_program(range(25))
    assert agreed >= 10
    assert active >= 3
    assert infeasible >= 1


@pytest.mark.slow
def test_five_hundred_ellipsoids_are_those_of_a_cone_program():
    agreed, active, _ = compare_with_cone_program(range(1000, 1500))
    assert agreed >= 250
    assert active >= 80


def compare_with_priced_program(seeds):
    """Return how many plans agreed with Clarabel's, of these those that leave the ellipsoid, and break limits, too."""
    left = broken = 0
    for seed in seeds:
        rng = np.random.default_rng(seed)
        model, cost, N, end = draw_ellipsoid(rng, (1, 5), (2, 7), stretch=2, least=1e-2)
        n, prices = model.nx, rng.uniform([1, 0.1, 1, 0.1], [10, 3, 10, 3])
        x_max, slack, terminal_slack = rng.uniform(0.5, 2, n), tuple(prices[:2]), tuple(prices[2:])
        limits = km.Limits(-1, 1, x_max=x_max, slack=slack, terminal=end, terminal_slack=terminal_slack)
        mpc = km.KoopmanMPC(model, cost, limits, horizon=N)
        x = rng.normal(size=n) * rng.uniform(0.5, 2)
        for _ in range(3):  # the second and the third step begin at the active rows of the one before
            move = mpc(x, np.zeros(n))
            U, past = solve_cone_program(mpc, x, prices)
            plan = mpc.plan()
            assert move.status in (km.Status.OPTIMAL, km.Status.UNCONSTRAINED, km.Status.SOFTENED), (seed, move.status)
            assert np.abs(plan.U - U).max() < 2e-4, (seed, plan.U - U)
            gauge = float(end.measure(plan.X[-1])) - 1
            assert abs(max(gauge, 0) - past) < 1e-4, seed
            left += past > 1e-4
            broken += past > 1e-4 and (plan.X[1:] > x_max + 1e-4).any()
            x = model.A @ x + model.B @ move.u
    return left, broken


def test_a_soft_ellipsoid_and_soft_limits_weigh_as_in_a_cone_program():
    left, broken = compare_with_priced_program(range(24))
    assert left >= 3
    assert broken >= 1


@pytest.mark.slow
def test_three_hundred_soft_ellipsoids_are_those_of_a_cone_program():
    left, broken = compare_with_priced_program(range(100, 400))
    assert left >= 40
    assert broken >= 20


def test_a_soft_set_gives_way_where_a_hard_one_is_infeasible_and_agrees_with_it_elsewhere():
    rng, model = np.random.default_rng(3), make_cart()
    cost, box = km.Cost(Q=1, R=0.1), {"u_min": -1, "u_max": 1}
    for kind in ("polytope", "ellipsoid"):
        end = km.guarantees.find_terminal_set(model, cost, km.Limits(**box), [0.0, 0.0], kind=kind)
        soft = km.KoopmanMPC(model, cost, km.Limits(**box, terminal=end), horizon=4)
        hard = km.KoopmanMPC(model, cost, km.Limits(**box, terminal=end, terminal_slack=None), horizon=4)
        seen = set()
        for _ in range(40):
            x = rng.normal(size=2) * rng.uniform(0.1, 2)
            soft.reset()
            hard.reset()
            gave, kept = soft(x, [0, 0]), hard(x, [0, 0])
            seen.add(kept.status.name)
            if kept.status is km.Status.INFEASIBLE:
                assert gave.status is km.Status.SOFTENED
                assert gave.slack > 0
            else:
                assert gave.status is kept.status
                assert gave.u == pytest.approx(kept.u, abs=1e-6)
        assert "INFEASIBLE" in seen
        assert len(seen) > 1


def test_a_polytope_tightened_by_errors_is_invariant_under_them():
    rng = np.random.default_rng(0)
    A, H, error = np.array([[0.8, 0.3], [-0.2, 0.7]]), np.vstack([np.eye(2), -np.eye(2)]), np.array([0.05, 0.02])
    found = km.guarantees.find_invariant_set(A, H, np.ones(4), error=error)
    plain = km.guarantees.find_invariant_set(A, H, np.ones(4))
    Z = rng.uniform(-1, 1, (4000, 2))
    Z = Z[found.contains(Z)]
    assert len(Z) > 100
    assert plain.contains(Z).all()
    worst = error * rng.choice([-1, 1], Z.shape)
    assert found.contains(Z @ A.T + worst).all()
    with pytest.raises(km.errors.CertificateError, match="use up a limit whole"):
        km.guarantees.find_invariant_set(A, H, np.ones(4), error=[0.5, 0.5])


def test_an_ellipsoid_is_refused_in_c_and_a_polytope_acts_there_as_in_python(tmp_path):
    model = make_cart()
    cost, box = km.Cost(Q=1, R=0.1), {"u_min": -1, "u_max": 1}
    ends = {
        kind: km.guarantees.find_terminal_set(model, cost, km.Limits(**box), [0.0, 0.0], kind=kind)
        for kind in ("polytope", "ellipsoid")
    }
    refused = km.KoopmanMPC(model, cost, km.Limits(**box, terminal=ends["ellipsoid"]), horizon=3)
    with pytest.raises(km.errors.DataError, match="terminal ellipsoid"):
        km.export(refused, tmp_path / "refused", reference=[0.0, 0.0])
    mpc = km.KoopmanMPC(model, cost, km.Limits(**box, terminal=ends["polytope"]), horizon=3)
    same = km.compiled(mpc)
    rng, ended = np.random.default_rng(1), set()
    for _ in range(30):
        x = rng.normal(size=2) * rng.uniform(0.1, 2)
        mpc.reset()
        same.reset()
        a, b = mpc(x, [0, 0]), same(x, [0, 0])
        ended.add(a.status.name)
        assert a.u == pytest.approx(b.u, abs=1e-7)
        assert a.status is b.status
    assert {"OPTIMAL", "SOFTENED"} <= ended


def test_a_controller_with_a_terminal_set_is_saved_and_copied(tmp_path):
    model = draw_model(np.random.default_rng(3), n=2, nu=1)
    cost, box = km.Cost(Q=1, R=0.1), {"u_min": -1, "u_max": 1}
    end = km.guarantees.find_terminal_set(model, cost, km.Limits(**box), [0.0, 0.0], kind="ellipsoid")
    mpc = km.KoopmanMPC(model, cost, km.Limits(**box, terminal=end, terminal_slack=None), horizon=4)
    mpc.save(tmp_path / "mpc.npz")
    again = km.load_controller(tmp_path / "mpc.npz")
    assert again.limits == mpc.limits
    x = 0.9 * np.linalg.solve(model.A, [1.0, 1.0])
    assert again(x, [0, 0]).u.tolist() == mpc(x, [0, 0]).u.tolist()


def test_bad_input_is_an_error_that_says_what_to_do():
    model = draw_model(np.random.default_rng(3), n=2, nu=1)
    cost, limits = km.Cost(Q=1, R=0.1), km.Limits(u_min=-1, u_max=1)
    find, make = km.guarantees.find_terminal_set, km.guarantees.TerminalSet
    with pytest.raises(km.errors.DataError, match="no limits"):
        find(model, cost, km.Limits(), [0, 0])
    with pytest.raises(km.errors.DataError, match="strictly inside"):
        find(model, cost, km.Limits(x_min=0.0, x_max=1.0, u_min=-1, u_max=1), [0, 0])
    with pytest.raises((km.errors.DataError, TypeError), match="terminal"):
        km.Limits(terminal=[1.0])
    with pytest.raises(km.errors.DataError, match="pass one of the two"):
        make([0.0])
    with pytest.raises(km.errors.ShapeError, match="3 coordinates"):
        km.KoopmanMPC(model, cost, km.Limits(terminal=make(np.zeros(3), W=1.0)))
    with pytest.raises(km.errors.CertificateError, match="up to 12"):
        find(draw_model(np.random.default_rng(1), n=13, nu=1), cost, limits, np.zeros(13))
    still = km.LinearPredictor.from_state_space(
        scipy.signal.dlti(np.diag([1.0, 0.5]), [[0.0], [1.0]], np.eye(2), np.zeros((2, 1)), dt=1.0)
    )
    with pytest.raises(km.errors.DataError, match="spectral radius 1"):
        find(still, cost, limits, [0, 0])


@pytest.fixture(scope="module")
def mixed():
    """Return an unstable bilinear model of two states, limits, and a certificate of it."""
    A, B, N = [[1.05, 0.2], [0.0, 0.9]], [[0.0], [0.3]], [[[0.05, 0.0], [0.0, 0.1]]]
    model = km.BilinearPredictor(A, B, N, np.eye(2), km.State(), 0.1, ["p", "v"], ["u"])
    rng, limits = np.random.default_rng(0), km.Limits(u_min=-1, u_max=1)
    X, U = rng.uniform(-2, 2, (400, 2)), rng.uniform(-1, 1, (400, 1))
    X_next = X @ np.transpose(A) + U @ np.transpose(B) + U * (X @ np.transpose(N[0]))
    pairs = [km.Episode(X=np.stack(pair), U=u[None]) for *pair, u in zip(X, X_next, U, strict=True)]
    data = km.Episodes(pairs, dt=0.1, states=model.states, inputs=model.inputs)
    return model, limits, certify(model, data, limits, decay=0.9)


def test_a_certificate_as_terminal_cost_falls_by_the_stage_cost(mixed):
    model, limits, certificate = mixed
    cost = km.Cost(Q=[1, 0.2], R=0.3)
    whole = km.Cost(Q=[1, 0.2], R=0.3, Q_N=certificate)
    X = certificate.sample(2000)
    U = certificate.feedback(X)
    X_next = X @ model.A.T + U @ model.B.T + U * (X @ model.N[0].T)
    before, after = (np.einsum("ij,jk,ik->i", x, whole.Q_N, x) for x in (X, X_next))
    stage = (X**2) @ cost.Q + 0.3 * U[:, 0] ** 2
    assert (after <= before - stage + 1e-9).all()
    assert np.abs(whole.Q_N - certificate.weigh_end(cost)).max() == 0
    with pytest.raises(km.errors.DataError, match="R_delta"):
        km.Cost(Q=1, R=1, R_delta=1, Q_N=certificate)
    for kind in (km.BilinearMPC, km.NonlinearMPC):
        move = kind(model, whole, limits, 8)(0.5 * X[0], [0, 0])
        assert move.status in (km.Status.OPTIMAL, km.Status.UNCONSTRAINED)
    with pytest.raises(km.errors.ShapeError, match="Q_N"):
        km.BilinearMPC(model, km.Cost(Q=1, R=1, Q_N=np.eye(3)), limits, 8)


def test_bilinear_and_nonlinear_plans_end_in_the_region_of_a_certificate(mixed, tmp_path):
    model, box, certificate = mixed
    cost = km.Cost(Q=[1, 0.2], R=0.3, tail=0)
    limits = km.Limits(u_min=box.u_min, u_max=box.u_max, terminal=certificate, terminal_slack=None)
    soft = km.Limits(u_min=box.u_min, u_max=box.u_max, terminal=certificate)
    bilinear, nonlinear = (kind(model, cost, limits, 4) for kind in (km.BilinearMPC, km.NonlinearMPC))
    gives_way = km.BilinearMPC(model, cost, soft, 4)
    without_plan = (km.Status.INFEASIBLE, km.Status.MAX_ITERATIONS)
    rng, seen, active, missed = np.random.default_rng(1), set(), 0, 0
    for X in certificate.sample(24):
        x = X * rng.uniform(0.5, 3.0)
        for mpc in (bilinear, nonlinear, gives_way):
            mpc.reset()
        a, b, c = (mpc(x, [0, 0]) for mpc in (bilinear, nonlinear, gives_way))
        seen.add(b.status.name)
        if a.status in without_plan and b.status is km.Status.OPTIMAL:
            missed += 1  # at the edge of what is feasible its linearisation has no plan
            continue
        if b.status is km.Status.INFEASIBLE:
            assert a.status in without_plan
            assert c.status is km.Status.SOFTENED
            assert c.slack > 0
            continue
        for mpc in (bilinear, nonlinear):
            assert certificate.value(mpc.plan().X[-1]) <= 1 + 1e-6
        assert a.u == pytest.approx(b.u, abs=1e-4)
        active += certificate.value(bilinear.plan().X[-1]) > 0.99
    assert "INFEASIBLE" in seen
    assert len(seen) > 1
    assert active > 0
    assert missed <= 1
    with pytest.raises(km.errors.DataError, match="terminal set"):
        km.export(bilinear, tmp_path, reference=[0, 0])
