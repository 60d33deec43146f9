"""One step of the real-time iteration solves its quadratic program, and enters the plan as far as F is near it."""

from functools import cache, partial

import numpy as np
import pytest

import koopmpc as km
from koopmpc.control.ask.limits import SOFTENED
from koopmpc.control.nonlinear import iteration
from koopmpc.control.nonlinear.condensed_stages import StageStep
from koopmpc.control.nonlinear.iteration import RealTimeIteration
from koopmpc.control.nonlinear.stages import StagedProblem, StageTargets
from koopmpc.control.nonlinear.stagewise import linearisation, list_sides, plan_cost, simulation
from tests.control.test_stagewise import PROBLEMS, R_DELTA, Q, R, each_kind, flat, problem_of


def slope(function, at: np.ndarray) -> np.ndarray:
    """Return the Jacobian by central differences."""
    steps = 1e-5 * np.eye(len(at))
    return np.array([(function(at + h) - function(at - h)) / 2e-5 for h in steps]).T


class Plan:
    """A random plan of a problem with its targets, as the arguments of its functions."""

    def __init__(self, problem: StagedProblem, seed: int) -> None:
        rng, self.problem = np.random.default_rng(seed), problem
        self.N, nx, nr = len(problem.free), problem.nx, len(problem.Q)
        self.X, self.U = 0.5 * rng.standard_normal((self.N + 1, nx)), 0.5 * rng.standard_normal((self.N, 2))
        self.R, self.U_r = rng.standard_normal((self.N, nr)), rng.standard_normal((self.N, 2))
        self.M, self.L = rng.standard_normal((nx + nr, nr)), rng.standard_normal((nx + nr, nx))
        self.m = rng.standard_normal(nx + nr)

    @property
    def targets(self) -> list[np.ndarray]:
        return [self.R.T, self.U_r.T, self.M, self.L, self.m]

    def F(self, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return flat(self.problem.F(x, u, np.zeros(0)))

    def of(self, x: np.ndarray) -> np.ndarray:
        return flat(self.problem.tracked(x))

    def g(self, x: np.ndarray) -> np.ndarray:
        return flat(self.problem.limited(x))

    def missed(self, k: int, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what is weighed of x_{k+1}, and the weight."""
        return self.aimed(k, x), np.eye(len(self.m)) if k == self.N - 1 else self.problem.Q

    def aimed(self, k: int, x: np.ndarray) -> np.ndarray:
        return self.M @ self.of(x) + self.L @ x - self.m if k == self.N - 1 else self.of(x) - self.R[k]


@each_kind
def test_a_linearisation_holds_the_jacobians_of_each_stage_and_its_gauss_newton_terms(kind):
    plan, problem = Plan(PROBLEMS[kind], 0), PROBLEMS[kind]
    found = linearisation(problem)(plan.X.T, plan.U.T, *plan.targets, np.zeros(0))
    nx, ng = problem.nx, len(problem.box.low)
    A, B, F, H, q, r, g, G = (
        value.full().T.reshape(plan.N, columns, -1).transpose(0, 2, 1)
        for value, columns in zip(found, (nx, 2, 1, nx, 1, 1, 1, nx), strict=True)
    )
    for k in range(plan.N):
        x, u, x_next = plan.X[k], plan.U[k], plan.X[k + 1]
        np.testing.assert_allclose(A[k], slope(partial(plan.F, u=u), x), atol=1e-8)
        np.testing.assert_allclose(B[k], slope(partial(plan.F, x), u) * problem.free[k], atol=1e-8)
        np.testing.assert_allclose(F[k].ravel(), plan.F(x, u), atol=1e-12)
        missed, weight = plan.missed(k, x_next)
        J = slope(partial(plan.aimed, k), x_next)
        np.testing.assert_allclose(H[k], J.T @ weight @ J, atol=1e-7)
        np.testing.assert_allclose(q[k].ravel(), J.T @ weight @ missed, atol=1e-7)
        np.testing.assert_allclose(r[k].ravel(), problem.R @ (u - plan.U_r[k]), atol=1e-12)
        if ng:
            np.testing.assert_allclose(g[k].ravel(), plan.g(x_next), atol=1e-12)
            np.testing.assert_allclose(G[k], slope(plan.g, x_next), atol=1e-8)


@each_kind
def test_a_plan_costs_the_sum_of_its_stages_and_what_breaks_soft_limits(kind):
    problem = PROBLEMS[kind]
    for seed in range(5):
        plan, total = Plan(problem, seed), 0.0
        for k in range(plan.N):
            missed, weight = plan.missed(k, plan.X[k + 1])
            moved, g = plan.U[k] - plan.U_r[k], plan.g(plan.X[k + 1])
            total += missed @ weight @ missed + moved @ problem.R @ moved
            for i, (low, high) in enumerate(zip(*problem.box, strict=True)):
                into = i - len(g) + problem.margin.shape[1]
                margin = problem.margin[k, into] if into >= 0 else 0.0
                over = max(low + margin - g[i], g[i] - (high - margin), 0.0)
                if np.isfinite(problem.softness.linear[i]):
                    total += problem.softness.linear[i] * over + problem.softness.quadratic[i] * over**2
        ends = (end.T for end in problem.stage_limits)
        said = plan_cost(problem)(plan.X.T, plan.U.T, *plan.targets, *ends)
        assert float(said) == pytest.approx(total, rel=1e-12)


@each_kind
def test_a_simulation_is_a_step_from_each_stage(kind):
    plan = Plan(PROBLEMS[kind], 0)
    found = simulation(plan.problem)(plan.X[:-1].T, plan.U.T, np.zeros(0)).full().T
    steps = [plan.F(x, u) for x, u in zip(plan.X[:-1], plan.U, strict=True)]
    np.testing.assert_allclose(found, steps, atol=1e-12)


def test_stages_with_rates_hold_the_last_input_and_soft_changes_and_are_weighed_and_limited_so():
    plain, rated, rng = problem_of("plain"), PROBLEMS["rated"], np.random.default_rng(0)
    x, last, v = rng.standard_normal(2), rng.standard_normal(2), rng.standard_normal(2)
    s = np.concatenate([x, last, [0.7]])
    assert rated.nx == len(s)
    assert rated.soft_rates.tolist() == [1]
    u = last + v
    after = np.concatenate([flat(plain.F(x, u, np.zeros(0))), u, v[1:]])
    np.testing.assert_allclose(flat(rated.F(s, v, np.zeros(0))), after, atol=1e-12)
    np.testing.assert_allclose(flat(rated.tracked(s)), [np.sin(x[0]), np.cos(x[0]), x[1], *last], atol=1e-12)
    np.testing.assert_allclose(flat(rated.limited(s)), [*last, 0.7, *x, np.sin(x[0])], atol=1e-12)
    np.testing.assert_array_equal(rated.Q[:3, :3], Q)
    np.testing.assert_array_equal(rated.Q[3:, 3:], R)
    assert not rated.Q[:3, 3:].any()
    np.testing.assert_array_equal(rated.R, R_DELTA)
    np.testing.assert_array_equal(rated.inputs.high, [0.3, np.inf])
    np.testing.assert_array_equal(rated.inputs.low, [-0.3, -np.inf])
    np.testing.assert_array_equal(rated.box.low, [-1, -2, -0.4, -np.inf, -0.6, -0.95])
    np.testing.assert_array_equal(rated.box.high, [1.5, np.inf, 0.4, 1.2, 0.8, 0.9])
    np.testing.assert_array_equal(rated.softness.linear, [np.inf, np.inf, 2, 5, np.inf, 7])
    np.testing.assert_array_equal(rated.softness.quadratic, [0, 0, 3, 2, 0, 0])
    np.testing.assert_array_equal(rated.margin, [[0.01, 0.02, 0]] + 3 * [[0.03, 0.04, 0]])
    assert rated.free.tolist() == [True, True, False, True]
    assert rated.held_from.tolist() == [[0, 0], [1, 1], [1, 1], [3, 3]]
    assert rated.input_sizes[0] == 1.25  # half the width of its limits
    np.testing.assert_array_equal(rated.sizes, [*plain.sizes, *rated.input_sizes, rated.input_sizes[1]])
    np.testing.assert_allclose(rated.softness.allowance[:2], SOFTENED * rated.input_sizes)


@each_kind
def test_the_sides_are_the_finite_ends_and_cost_half_of_what_the_limits_cost(kind):
    problem = PROBLEMS[kind]
    found = list_sides(problem)
    low, high = (np.concatenate([problem.inputs[i], problem.box[i]]) for i in (0, 1))
    linear, quadratic = (np.concatenate([np.full(2, first), problem.softness[i]]) for i, first in ((0, np.inf), (1, 0)))
    size = np.concatenate([problem.input_sizes, problem.softness.allowance / SOFTENED])
    ends = {(i, 1.0) for i in np.flatnonzero(np.isfinite(low))} | {(i, -1.0) for i in np.flatnonzero(np.isfinite(high))}
    assert set(zip(found.row.tolist(), found.sign.tolist(), strict=True)) == ends
    assert len(found.row) == len(ends)
    soft = np.isfinite(linear[found.row])
    assert found.soft == np.count_nonzero(soft)
    assert (np.sort(soft) == soft).all()  # the hard ones come first
    for i, span in zip(found.row, found.span, strict=True):
        assert span == (high[i] - low[i] if np.isfinite(high[i] - low[i]) else 2 * size[i])
    over = 0.37
    for i, price, growth, span in zip(found.row[soft], found.linear, found.quadratic, found.span[soft], strict=True):
        eps = over / span
        half = 0.5 * (linear[i] * over + quadratic[i] * over**2)
        assert price * eps + 0.5 * growth * eps**2 == pytest.approx(half)


with pytest.MonkeyPatch.context() as no_compiler:
    no_compiler.delenv("CC", raising=False)
    no_compiler.setenv("PATH", "")
    SOLVED = {kind: RealTimeIteration(problem, compiles_model=False) for kind, problem in PROBLEMS.items()}


def begun(kind: str, seed: int, pull: float = 1.0) -> tuple[RealTimeIteration, Plan, StageTargets, np.ndarray]:
    """Return an iteration at a random plan, that plan, its targets, and a measured state beside its first one."""
    plan, problem, rng = Plan(PROBLEMS[kind], seed), PROBLEMS[kind], np.random.default_rng(seed)
    each = SOLVED[kind]
    plan.X, plan.U = 0.2 * plan.X, 0.1 * plan.U * problem.free[:, None]
    if kind == "rated":
        plan.X[:, -1] = 0.0
    plan.R, plan.U_r, plan.m = pull * plan.R, plan.U_r * (kind != "rated"), pull * plan.m
    x = plan.X[0] + 0.05 * rng.standard_normal(problem.nx)
    each.X[:], each.U[:], each.multipliers = plan.X, plan.U, None
    each.e[:] = 0.02 * rng.standard_normal(each.e.shape)
    return each, plan, StageTargets(plan.R, plan.U_r, plan.M, plan.L, plan.m), x


def linearisation_at(plan: Plan, k: int) -> tuple[np.ndarray, np.ndarray]:
    return slope(partial(plan.F, u=plan.U[k]), plan.X[k]), slope(partial(plan.F, plan.X[k]), plan.U[k])


@cache
def solved(kind: str, seed: int, pull: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Return (δX, δU) of the quadratic program as CVXPY finds it, None where no step meets the hard limits."""
    import cvxpy as cp

    each, plan, _, x = begun(kind, seed, pull)
    problem, N, nx = plan.problem, plan.N, plan.problem.nx
    found = linearisation(problem)(plan.X.T, plan.U.T, *plan.targets, np.zeros(0))
    A, B, F, H, q, r, g, G = (
        value.full().T.reshape(N, columns, -1).transpose(0, 2, 1)
        for value, columns in zip(found, (nx, 2, 1, nx, 1, 1, 1, nx), strict=True)
    )
    X, U = cp.Variable((N, nx)), cp.Variable((N, 2))
    cost, held = 0, []
    linear, quadratic, _ = problem.softness
    for k in range(N):
        before = X[k - 1] if k else x - plan.X[0]
        held.append(X[k] == A[k] @ before + B[k] @ U[k] + F[k].ravel() + each.e[k] - plan.X[k + 1])
        cost += cp.quad_form(X[k], cp.psd_wrap(H[k])) / 2 + q[k].ravel() @ X[k]
        cost += cp.quad_form(U[k], problem.R) / 2 + r[k].ravel() @ U[k]
        if not problem.free[k]:
            held.append(U[k] == 0)
            continue
        low, high = problem.inputs
        held += [plan.U[k, i] + U[k, i] >= low[i] for i in range(2) if np.isfinite(low[i])]
        held += [plan.U[k, i] + U[k, i] <= high[i] for i in range(2) if np.isfinite(high[i])]
    for k in range(N):
        into = len(linear) - problem.margin.shape[1]
        for i, (low, high) in enumerate(zip(*problem.box, strict=True)):
            margin, value, slack = problem.margin[k, i - into] if i >= into else 0.0, g[k, i, 0] + G[k, i] @ X[k], 0
            if np.isfinite(linear[i]):
                slack = cp.Variable(nonneg=True)
                cost += (linear[i] * slack + quadratic[i] * cp.square(slack)) / 2
            held += [value + slack >= low + margin] if np.isfinite(low) else []
            held += [value - slack <= high - margin] if np.isfinite(high) else []
    program = cp.Problem(cp.Minimize(cost), held)
    program.solve(cp.CLARABEL, tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11)
    return None if X.value is None else (X.value, U.value)


@pytest.mark.parametrize("most", [iteration.MOST, 0])
@pytest.mark.parametrize("kind", ["plain", "rated"])
def test_a_step_is_the_solution_of_its_quadratic_program(kind, most, monkeypatch):
    """By interior points, which need few steps and leave nothing to do, and by the active-set method alone."""
    monkeypatch.setattr(iteration, "MOST", most)
    statuses = []
    for seed, pull in enumerate((0.1, 1.0, 3.0, 2.0)):
        each, plan, targets, x = begun(kind, seed, pull)
        wanted = solved(kind, seed, pull)
        found = each.step(x, targets, np.inf)
        statuses.append(found.status)
        if wanted is None:
            assert found.status is km.Status.INFEASIBLE
            continue
        np.testing.assert_allclose(found.X, wanted[0], atol=1e-5)
        np.testing.assert_allclose(found.U[plan.problem.free], wanted[1][plan.problem.free], atol=1e-5)
        if most and found.status is km.Status.OPTIMAL:
            assert each.multipliers is None
            assert 1 <= found.iterations <= 25
    assert statuses.count(km.Status.OPTIMAL) >= 2


@pytest.mark.parametrize("kind", ["plain", "rated"])
def test_a_plan_takes_the_longest_halving_of_a_step_at_which_f_is_near_its_linearisation(kind):
    """Over the length α the defects become (1 − α) c; a fifth of the largest change of a state may be missing."""
    lengths = set()
    for seed, size in enumerate((0.01, 0.3, 1.0, 3.0, 10.0, 30.0, 300.0)):
        each, plan, targets, x = begun(kind, seed)
        each.step(x, targets, np.inf)  # it has the linearisation
        A = [linearisation_at(plan, k) for k in range(plan.N)]
        dU = size * np.random.default_rng(seed).standard_normal(each.U.shape) * plan.problem.free[:, None]
        defects = np.array([plan.F(plan.X[k], plan.U[k]) for k in range(plan.N)]) + each.e - plan.X[1:]
        dX = [x - plan.X[0]]
        for k in range(plan.N):
            dX.append(A[k][0] @ dX[k] + A[k][1] @ dU[k] + defects[k])
        dX = np.array(dX[1:])
        left = defects.copy()
        left[0] += A[0][0] @ (x - plan.X[0])
        change = np.maximum(np.abs(dX).max(axis=0), np.abs(left).max(axis=0))

        length = 1.0
        while length >= 0.001:
            X, U = plan.X[1:] + length * dX, plan.U + length * dU
            before = np.vstack([x, X[:-1]])
            defect = np.array([plan.F(*at) for at in zip(before, U, strict=True)]) + each.e - X
            if (np.abs(defect - (1 - length) * left).max(axis=0) <= length * 0.2 * change + 1e-12).all():
                break
            length /= 2
        slacks = np.array([[0.0, 0.5 * each._allowance.min(), 2 * each._allowance.max()]])
        each.take(x, StageStep(dX, dU, np.resize(slacks, each._eps.shape), km.Status.OPTIMAL, 1))
        lengths.add(each.length)
        assert each.slack == 2 * each._allowance.max()
        if length < 0.001:
            assert each.length == 0.0
            X, U, defect = plan.X[1:], plan.U, left
        else:
            assert each.length == length
            assert (each.X[0] == x).all()
        np.testing.assert_allclose(each.X[1:], X, atol=1e-12)
        np.testing.assert_allclose(each.U, U, atol=1e-12)
        ranges = np.ptp(each.X, axis=0) + 1e-9 * (plan.problem.sizes + np.abs(each.X[0]))
        assert each.gap == pytest.approx((np.abs(defect).max(axis=0) / ranges).max(), rel=1e-6)
    assert len(lengths) >= 3
    assert {0.0, 1.0} <= lengths


def test_a_plan_rests_where_no_input_and_no_state_moves_by_more_than_a_share_of_its_size_and_the_plans():
    each, plan, _, _ = begun("plain", 0)
    sizes, input_sizes = plan.problem.sizes, plan.problem.input_sizes
    none = StageStep(np.zeros((plan.N, 2)), np.zeros((plan.N, 2)), np.zeros((plan.N, 0)), km.Status.OPTIMAL, 0)
    assert each.rests(none, 1e-6)
    for share, rests in ((0.99e-3, True), (1.01e-3, False)):
        for k, i in ((0, 1), (3, 0)):
            U = np.zeros((plan.N, 2))
            U[k, i] = -share * input_sizes[i] * (1 + np.abs(each.U / input_sizes).max())
            assert each.rests(none._replace(U=U), 1e-3) == rests
            X = np.zeros((plan.N, 2))
            X[k, i] = share * sizes[i] * (1 + np.abs(each.X / sizes).max())
            assert each.rests(none._replace(X=X), 1e-3) == rests


def test_a_step_without_time_is_late_and_one_without_limits_is_not_asked():
    each, _, targets, x = begun("plain", 3, 10.0)
    late = each.step(x, targets, -np.inf)
    assert late.status is km.Status.TIME_LIMIT
    assert late.iterations == 0
    free, _, targets, x = begun("free", 3, 10.0)
    assert free.step(x, targets, -np.inf).status is km.Status.UNCONSTRAINED


def test_other_targets_count_from_the_step_at_which_they_are_given():
    each, _, targets, x = begun("free", 0)
    first = each.step(x, targets, np.inf).U.copy()
    each.step(x, targets._replace(R=targets.R + 1, U=targets.U - 1, m=targets.m + 1), np.inf)
    np.testing.assert_allclose(each.step(x, targets, np.inf).U, first, atol=1e-12)
    changed = targets._replace(R=targets.R.copy())
    changed.R[0] += 0.5
    assert np.abs(each.step(x, changed, np.inf).U - first).max() > 1e-3


def test_a_disturbance_that_is_no_number_is_a_failure():
    each, _, targets, x = begun("plain", 0)
    each.e[2, 0] = np.nan
    assert each.step(x, targets, np.inf).status is km.Status.FAILED


@pytest.mark.parametrize(("kind", "mean"), [("plain", 11.0), ("rated", 9.5)])
def test_interior_points_need_about_ten_steps_and_no_help(kind, mean):
    """On 48 programs from few active limits to most of them: so many on average, none more than 14."""
    taken = []
    for seed in range(12):
        for pull in (0.1, 1.0, 3.0, 10.0):
            each, _, targets, x = begun(kind, seed, pull)
            found = each.step(x, targets, np.inf)
            assert found.status in (km.Status.UNCONSTRAINED, km.Status.OPTIMAL)
            assert each.multipliers is None
            taken += [found.iterations] if found.status is km.Status.OPTIMAL else []
    assert max(taken) <= 14
    assert np.mean(taken) <= mean
