"""The functions of a staged program do what their equations say: against differences, dense equations and plain sums."""

from functools import partial
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from koopmpc.control.ask.limits import SOFTENED
from koopmpc.control.nonlinear.learned_map import learned_map
from koopmpc.control.nonlinear.problem import StagedProblem, staged_problem
from koopmpc.control.nonlinear.stagewise import (
    RiccatiSweeps,
    interior_step,
    linearisation,
    list_sides,
    plan_cost,
    simulation,
    solve_unconstrained,
    weights,
)
from koopmpc.control.plan.task import find_move_blocks
from koopmpc.control.plan.tracking import state_tracking

OF = km.Fourier(1, "a") + km.State("b")
Q, R, R_DELTA = [[3, 1, 0], [1, 2, 0.5], [0, 0.5, 1]], [[0.4, 0.1], [0.1, 0.3]], [[0.7, 0.2], [0.2, 0.5]]
LIMITS = km.Limits(
    u_min=[-1, -2],
    u_max=[1.5, np.inf],
    du_max=[0.3, 0.4],
    du_slack=([np.inf, 2.0], [0, 3.0]),
    x_min=[-np.inf, -0.6],
    x_max=[1.2, 0.8],
    slack=([5.0, np.inf, 7.0, 4.0], [2.0, 0.0, 0.0, 1.0]),
    of=km.Fourier(1, "a"),
    y_max=[0.9, np.inf],
    y_min=[-0.95, -np.inf],
    margin=[[0.01, 0.02], [0.03, 0.04]],
)
BOXED = km.Limits([-1, -2], [1.5, np.inf], x_min=[-np.inf, -0.6], x_max=[1.2, 0.8])


def problem_of(kind: str) -> StagedProblem:
    """Return four stages of a plant with two states and two inputs: plain, with rates in blocks, or without limits."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 2)
    after = ca.vertcat(x[0] + 0.3 * ca.sin(x[1]) + 0.2 * u[0] * x[1], 1.1 * x[1] - 0.2 * x[0] ** 2 + u[1] + 0.1 * u[0])
    plant = km.StepMap(ca.Function("F", [x, u], [after]), 0.1, states=("a", "b"))
    cost = km.Cost(Q, R, of=OF, R_delta=R_DELTA if kind == "rated" else None)
    limits = {"rated": LIMITS, "plain": BOXED, "free": km.Limits()}[kind]
    given = learned_map(plant)
    moves = (1, 2, 1) if kind == "rated" else None
    return staged_problem(
        given, state_tracking(plant.states, plant.inputs, cost, limits), find_move_blocks(moves, 4, plant.inputs)
    )


PROBLEMS = {kind: problem_of(kind) for kind in ("plain", "rated", "free")}
each_kind = pytest.mark.parametrize("kind", list(PROBLEMS))


def slope(function, at: np.ndarray) -> np.ndarray:
    """Return the Jacobian by central differences."""
    steps = 1e-5 * np.eye(len(at))
    return np.array([(function(at + h) - function(at - h)) / 2e-5 for h in steps]).T


def flat(value: ca.DM) -> np.ndarray:
    return value.full().ravel(order="F")


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


class Dense:
    """A random program of four stages with limits, at a random interior point, as one system of equations."""

    def __init__(self, kind: str, seed: int) -> None:
        self.problem, rng = PROBLEMS[kind], np.random.default_rng(seed)
        problem = self.problem
        self.N, self.nx, self.ng, self.s = len(problem.free), problem.nx, len(problem.box.low), list_sides(problem)
        N, nx, ns, nsoft = self.N, self.nx, len(self.s.row), self.s.soft
        roots = rng.standard_normal((N, nx, nx))
        self.A, self.B = rng.standard_normal((N, nx, nx)), rng.standard_normal((N, nx, 2)) * problem.free[:, None, None]
        self.H, self.q = roots @ roots.transpose(0, 2, 1), rng.standard_normal((N, nx))
        self.c, self.r, self.x0 = rng.standard_normal((N, nx)), rng.standard_normal((N, 2)), rng.standard_normal(nx)
        self.G, self.d = rng.standard_normal((N, self.ng, nx)), rng.standard_normal((N, ns))
        self.X, self.U = rng.standard_normal((N, nx)), rng.standard_normal((N, 2)) * problem.free[:, None]
        self.t, self.lam = rng.uniform(0.5, 2, (2, N, ns))
        self.eps, self.nu = rng.uniform(0.5, 2, (2, N, nsoft))
        self.W = weights(problem).reshape(2, N, 2).transpose(1, 0, 2)
        self.sweeps = RiccatiSweeps(nx, 2, N)

    @property
    def stages(self) -> list[np.ndarray]:
        wide = [np.hstack(list(M)) for M in (self.A, self.B)]
        return [*wide, self.c.T, np.hstack(list(self.H)), self.q.T, self.r.T, self.x0]

    def equations(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows E and e of the dynamics of v = [x_1 … x_N, u_0 … u_{N−1}]: E v = e."""
        N, nx = self.N, self.nx
        E, e = np.zeros((N * nx, N * (nx + 2))), self.c.copy()
        e[0] += self.A[0] @ self.x0
        for k in range(N):
            rows = slice(k * nx, (k + 1) * nx)
            E[rows, rows] = np.eye(nx)
            if k:
                E[rows, (k - 1) * nx : k * nx] = -self.A[k]
            E[rows, N * nx + 2 * k : N * nx + 2 * k + 2] = -self.B[k]
        return E, e.ravel()

    def hessian(self) -> np.ndarray:
        n = self.N * self.nx
        H = np.zeros((n + 2 * self.N, n + 2 * self.N))
        for k in range(self.N):
            H[k * self.nx : (k + 1) * self.nx, k * self.nx : (k + 1) * self.nx] = self.H[k]
            H[n + 2 * k : n + 2 * k + 2, n + 2 * k : n + 2 * k + 2] = self.W[k]
        return H

    def distances(self) -> np.ndarray:
        """Return D with D v the distances d of all stages, stage after stage, but for what they are at v = 0."""
        N, nx, s = self.N, self.nx, self.s
        D = np.zeros((N, len(s.row), N * (nx + 2)))
        for k in range(N):
            for j, (i, sign, span) in enumerate(zip(s.row, s.sign, s.span, strict=True)):
                if i < 2:
                    D[k, j, N * nx + 2 * k + i] = sign / span
                else:
                    D[k, j, k * nx : (k + 1) * nx] = sign / span * self.G[k, i - 2]
        return D.reshape(N * len(s.row), -1)

    def newton(self, first: np.ndarray, second: np.ndarray) -> list[np.ndarray]:
        """Return the Newton step to t λ = `first` and ε ν = `second`, by all equations at once."""
        N, ns, nsoft, s = self.N, len(self.s.row), self.s.soft, self.s
        E, e, H, D = *self.equations(), self.hessian(), self.distances()
        n, m, rows, soft = len(H), len(E), N * ns, N * nsoft
        v = np.concatenate([self.X.ravel(), self.U.ravel()])
        gradient = np.concatenate([self.q.ravel(), self.r.ravel()])
        P = np.zeros((rows, soft))  # which slack belongs to which side
        for k in range(N):
            for j in range(nsoft):
                P[k * ns + ns - nsoft + j, k * nsoft + j] = 1.0
        t, lam, eps, nu = self.t.ravel(), self.lam.ravel(), self.eps.ravel(), self.nu.ravel()
        grow, price = np.tile(s.quadratic, N), np.tile(s.linear, N)
        size = [n, m, rows, rows, soft, soft]  # v, p, t, λ, ε, ν
        ends = np.cumsum([0, *size])
        at = [slice(a, b) for a, b in pairwise(ends)]
        K, b = np.zeros((ends[-1], ends[-1])), np.zeros(ends[-1])
        K[at[0], at[0]], K[at[0], at[1]], K[at[0], at[3]] = H, E.T, -D.T
        b[at[0]] = -(H @ v + gradient - D.T @ lam)
        K[at[1], at[0]], b[at[1]] = E, e - E @ v
        K[at[2], at[0]], K[at[2], at[2]], K[at[2], at[4]] = D, -np.eye(rows), P
        b[at[2]] = -(self.d.ravel() + D @ v + P @ eps - t)
        K[at[3], at[2]], K[at[3], at[3]], b[at[3]] = np.diag(lam), np.diag(t), first.ravel() - t * lam
        K[at[4], at[4]], K[at[4], at[3]], K[at[4], at[5]] = np.diag(grow), -P.T, -np.eye(soft)
        b[at[4]] = -(price + grow * eps - P.T @ lam - nu)
        K[at[5], at[4]], K[at[5], at[5]], b[at[5]] = np.diag(nu), np.diag(eps), second.ravel() - eps * nu
        step = np.linalg.solve(K, b)
        dv = step[at[0]]
        shapes = [(N, ns), (N, ns), (N, nsoft), (N, nsoft)]
        pairs = [step[at[i]].reshape(shape) for i, shape in zip((2, 3, 4, 5), shapes, strict=True)]
        return [dv[: N * self.nx].reshape(N, -1), dv[N * self.nx :].reshape(N, 2), *pairs]

    def longest(self, step: list[np.ndarray]) -> float:
        """Return 1 over the largest step at which no t, λ, ε or ν is negative."""
        pairs = zip(step[2:], (self.t, self.lam, self.eps, self.nu), strict=True)
        return max(float((-d / now).max(initial=-np.inf)) for d, now in pairs)

    def mean(self, t: np.ndarray, lam: np.ndarray, eps: np.ndarray, nu: np.ndarray) -> float:
        return float((t * lam).sum() + (eps * nu).sum()) / (t.size + eps.size)


@each_kind
def test_without_limits_the_sweeps_solve_the_equations_of_all_stages(kind):
    dense = Dense(kind, 1)
    E, e, H = *dense.equations(), dense.hessian()
    n, m = len(H), len(E)
    K = np.block([[H, E.T], [E, np.zeros((m, m))]])
    v = np.linalg.solve(K, np.concatenate([-dense.q.ravel(), -dense.r.ravel(), e]))[:n]
    X, U, curvature = solve_unconstrained(dense.sweeps, weights(dense.problem))(*dense.stages)
    np.testing.assert_allclose(flat(X), v[: dense.N * dense.nx], atol=1e-8)
    np.testing.assert_allclose(flat(U), v[dense.N * dense.nx :], atol=1e-8)
    # S_k is the curvature of the cost along u_k, with all later inputs at their best: a Schur complement
    Z = np.vstack([-np.linalg.solve(E[:, : dense.N * dense.nx], E[:, dense.N * dense.nx :]), np.eye(2 * dense.N)])
    whole = Z.T @ H @ Z
    S = [np.linalg.inv(np.linalg.inv(whole[2 * k :, 2 * k :])[:2, :2]).diagonal() for k in range(dense.N)]
    # as a row, the last stage first
    np.testing.assert_allclose(flat(curvature).reshape(dense.N, 2)[::-1], S, rtol=1e-8)


@pytest.mark.parametrize("kind", ["plain", "rated"])
@pytest.mark.parametrize("aim", [0.0, 0.3])
@pytest.mark.parametrize("seed", [1, 2])
def test_an_interior_step_is_newtons_on_all_equations_at_once(kind, aim, seed):
    """Mehrotra's predictor aims at no complementarity, and the corrector at what the predictor leads to."""
    dense = Dense(kind, seed)
    (E, e), n = dense.equations(), dense.N * dense.nx
    dense.X = np.linalg.solve(E[:, :n], e - E[:, n:] @ dense.U.ravel()).reshape(dense.N, -1)  # a plan of the dynamics
    pairs = dense.t, dense.lam, dense.eps, dense.nu
    mu = dense.mean(*pairs)
    affine = dense.newton(np.zeros_like(dense.t), np.zeros_like(dense.eps))
    a = 1 / max(dense.longest(affine), 1.0)
    reached = dense.mean(*(now + a * d for now, d in zip(pairs, affine[2:], strict=True)))
    centre, second = (aim * mu, 0.0) if aim else (mu * (reached / mu) ** 3, a * a)
    step = dense.newton(centre - second * affine[2] * affine[3], centre - second * affine[4] * affine[5])
    length = 1 / max(dense.longest(step) / 0.995, 1.0)
    function = interior_step(dense.sweeps, weights(dense.problem), dense.s, dense.ng)
    at = [dense.X, dense.U, *pairs]
    *after, said = function(
        *dense.stages, np.hstack(list(dense.G)) if dense.ng else np.zeros((0, 0)), dense.d.T, aim, *(v.T for v in at)
    )
    np.testing.assert_allclose(flat(said), [mu, length], rtol=1e-8)
    for found, now, change in zip(after, at, step, strict=True):
        np.testing.assert_allclose(found.full().T, now + length * change, rtol=1e-7, atol=1e-7)


@each_kind
def test_a_stage_without_an_input_has_a_weight_of_its_own(kind):
    problem = PROBLEMS[kind]
    W = weights(problem).reshape(2, -1, 2).transpose(1, 0, 2)
    for each, free in zip(W, problem.free, strict=True):
        if free:
            np.testing.assert_array_equal(each, problem.R)
        else:
            assert np.linalg.eigvalsh(each).min() >= max(np.trace(problem.R), np.trace(problem.Q)) / 2 - 1e-12
