"""The sweeps over stages, and a step of the interior point, solve the dense equations of all stages."""

from itertools import pairwise

import casadi as ca
import numpy as np
import pytest

import koopmpc as km
from koopmpc.control.nonlinear.stages import StagedProblem, learned_map
from koopmpc.control.nonlinear.stagewise import (
    RiccatiSweeps,
    interior_step,
    list_sides,
    solve_unconstrained,
    weights,
)
from koopmpc.control.nonlinear.task import staged_problem
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


def flat(value: ca.DM) -> np.ndarray:
    return value.full().ravel(order="F")


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
