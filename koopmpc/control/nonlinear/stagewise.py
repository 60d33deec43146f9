"""A quadratic program of N stages with their own dynamics, as CasADi functions: Riccati sweeps, interior points.

    min Σ ½ δx_{k+1}ᵀQ_{k+1}δx_{k+1} + q_{k+1}ᵀδx_{k+1} + ½ δu_kᵀRδu_k + r_kᵀδu_k,
    δx_{k+1} = A_k δx_k + B_k δu_k + c_k.

A barrier term adds a diagonal to R and GᵀwG to Q. Every Newton step is then one backward and one forward sweep: its
work grows with N, not with N³, and an unstable plant costs no digits.

Rao, Wright & Rawlings, "Application of interior-point methods to model predictive control", J. Optim. Theory
Appl. 99, 1998; Mehrotra, "On the implementation of a primal-dual interior point method", SIAM J. Optim. 2, 1992.
"""

from collections.abc import Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np
from jaxtyping import Float, Int

from koopmpc.base.values import Interval
from koopmpc.control.ask.bounds import SOFTENED, Softness, half_width
from koopmpc.control.nonlinear.stages import StagedProblem

_SHORT = 0.995  # share of the way to the nearest bound


class Sides(NamedTuple):
    """The finite ends of limits, hard ones first: distance d = sign (y − end) / span ≥ 0, y = [u_k; g(x_{k+1})].

    A soft side has d + ε ≥ 0, ε ≥ 0, at the price linear ε + ½ quadratic ε².
    """

    row: Int[np.ndarray, " ns"]
    sign: Float[np.ndarray, " ns"]
    span: Float[np.ndarray, " ns"]
    soft: int
    linear: Float[np.ndarray, " nsoft"]
    quadratic: Float[np.ndarray, " nsoft"]


def list_sides(problem: StagedProblem) -> Sides:
    """Return the finite ends of all limits, those that are hard first."""
    nu, inputs, box = len(problem.R), problem.inputs, problem.box
    low, high = np.concatenate([inputs.low, box.low]), np.concatenate([inputs.high, box.high])
    linear = np.concatenate([np.full(nu, np.inf), problem.softness.linear])
    quadratic = np.concatenate([np.zeros(nu), problem.softness.quadratic])
    sizes = np.concatenate([problem.input_sizes, problem.softness.allowance / SOFTENED])
    half = half_width(Interval(low, high))
    span = 2 * np.where(half > 0, half, sizes)
    ends = [
        (i, sign)
        for soft in (False, True)
        for sign, end in ((1.0, low), (-1.0, high))
        for i in range(len(low))
        if np.isfinite(end[i]) and np.isfinite(linear[i]) == soft
    ]
    row = np.array([i for i, _ in ends], dtype=np.intp)
    sign = np.array([s for _, s in ends], dtype=np.float64)
    given = row[np.isfinite(linear[row])]
    return Sides(
        row=row,
        sign=sign,
        span=span[row],
        soft=len(given),
        linear=0.5 * linear[given] * span[given],
        quadratic=quadratic[given] * span[given] ** 2,
    )


def list_prices(problem: StagedProblem) -> Softness:
    """Return half of the prices of [v_k; limited(s_{k+1})], as of the cost; inputs are hard."""
    linear, quadratic, allowance = problem.softness
    none = np.zeros(len(problem.R))
    prices = [none + np.inf, 0.5 * linear], [none, 0.5 * quadratic], [none, allowance]
    return Softness(*(np.concatenate(pair) for pair in prices))


def linearisation(problem: StagedProblem) -> ca.Function:
    """Return (X, U, R, U_r, M, L, m, θ) → (A, B, F, Q, q, r, g, G), stage beside stage.

    A, B, F at (X_k, U_k), k = 0 … N−1, B zero where a stage has no input; the rest at X_{k+1}: Q = JᵀQJ and
    q = JᵀQ(of(x) − r) with J = ∂of/∂x (Gauss–Newton), at the end those of ‖M of(x) + L x − m‖²; r = R (u − u_r);
    g the limited outputs, G = ∂g/∂x.
    """
    nx, nu, nr = problem.nx, problem.F.size1_in(1), len(problem.Q)
    ng, N = len(problem.box.low), len(problem.free)
    x, u, t = ca.MX.sym("x", nx), ca.MX.sym("u", nu), ca.MX.sym("t", problem.F.size1_in(2))
    x_next = problem.F(x, u, t)
    derivatives = [ca.densify(ca.jacobian(x_next, x)), ca.densify(ca.jacobian(x_next, u)), x_next]
    dynamics = ca.Function("dynamics", [x, u, t], derivatives)
    if problem.F.is_a("SXFunction"):
        dynamics = dynamics.expand("dynamics", {"cse": True})
    s, r = ca.SX.sym("x", nx), ca.SX.sym("r", nr)
    d = ca.SX.sym("d", nr * problem.timed)
    of, g = problem.tracked(s), problem.limited(s)
    J = ca.jacobian(of, s)
    weighted = J.T @ (ca.diag(d) if problem.timed else ca.DM(problem.Q))
    stage = ca.Function("stage", [s, r, d], [ca.densify(weighted @ J), ca.densify(weighted @ (of - r))], {"cse": True})
    limited = ca.Function("limits", [s], [ca.densify(g), ca.densify(ca.jacobian(g, s))], {"cse": True})
    M, L, m = (ca.SX.sym("goal", nx + nr, columns) for columns in (nr, nx, 1))
    E = M @ J + L
    end = ca.Function("end", [s, M, L, m], [ca.densify(E.T @ E), ca.densify(E.T @ (M @ of + L @ s - m))], {"cse": True})

    X, U = ca.MX.sym("X", nx, N + 1), ca.MX.sym("U", nu, N)
    R, U_r = ca.MX.sym("R", nr, N), ca.MX.sym("U_r", nu, N)
    goal = [ca.MX.sym("goal", nx + nr, columns) for columns in (nr, nx, 1)]
    # called stage by stage, for a map would copy θ for each of them
    every = t if not problem.scheduled else ca.MX.sym("t", problem.theta_size)
    stages = [dynamics(X[:, k], U[:, k], problem.stage_theta(every, k)) for k in range(N)]
    A = ca.horzcat(*(stage[0] for stage in stages))
    B = ca.horzcat(
        *(each[1] if free else ca.MX(ca.DM(nx, nu)) for each, free in zip(stages, problem.free, strict=True))
    )
    F = ca.horzcat(*(stage[2] for stage in stages))
    Q_d, R_d = weight_symbols(problem)
    Q, q = end(X[:, N], *goal)
    if N > 1:
        Q_k, q_k = stage.map(N - 1)(X[:, 1:N], R[:, : N - 1], Q_d[:, : N - 1])
        Q, q = ca.horzcat(Q_k, Q), ca.horzcat(q_k, q)
    g_k, G = limited.map(N)(X[:, 1:]) if ng else (ca.MX(0, N), ca.MX(0, N * nx))
    r = R_d * (U - U_r) if R_d.numel() else ca.DM(problem.R) @ (U - U_r)
    found = [A, ca.densify(B), F, Q, q, r, g_k, G]
    return ca.Function("linearisation", [X, U, R, U_r, *goal, every, *([Q_d, R_d] if problem.timed else [])], found)


def weight_symbols(problem: StagedProblem) -> tuple[ca.MX, ca.MX]:
    """Return the diagonals of all stages that weigh tracked outputs, and inputs without rates; none where none move."""
    N, nr, nu = len(problem.free), len(problem.Q), len(problem.R)
    timed = problem.timed
    return ca.MX.sym("Q_d", nr * timed, N), ca.MX.sym("R_d", nu * (timed and not problem.with_rates), N)


def list_hard_outputs(softness: Softness, inputs: int) -> Int[np.ndarray, " n"]:
    """Return which limited outputs of a stage are hard; its first ones are the inputs where their changes count."""
    hard = np.flatnonzero(np.isinf(softness.linear))
    return hard[hard >= inputs]


def sum_costs(
    problem: StagedProblem, X: ca.MX, U: ca.MX, targets: Sequence[ca.MX], diagonals: tuple[ca.MX, ca.MX]
) -> ca.MX:
    """Return the cost of states X (nx, N+1) and inputs U at targets R, U_r, M, L, m, without that of soft limits.

    `diagonals` are those of `weight_symbols`.
    """
    N, (R, U_r, M, L, m), (Q_d, R_d) = len(problem.free), targets, diagonals
    of, moved = problem.tracked.map(N)(X[:, 1:]), U - U_r
    missed = (of - R)[:, : N - 1]
    cost = ca.sumsqr(M @ of[:, N - 1] + L @ X[:, N] - m)
    cost += ca.dot(moved, R_d * moved if R_d.numel() else ca.DM(problem.R) @ moved)
    cost += ca.dot(missed, Q_d[:, : N - 1] * missed if problem.timed else ca.DM(problem.Q) @ missed)
    return cost if problem.stage is None else cost + ca.sum2(problem.stage.map(N)(X[:, :N], U))


def target_symbols(problem: StagedProblem) -> list[ca.MX]:
    """Return R, U_r, M, L, m of `StageTargets`, stage beside stage."""
    nx, nr, N = problem.nx, len(problem.Q), len(problem.free)
    ends = [ca.MX.sym("terminal", nx + nr, columns) for columns in (nr, nx, 1)]
    return [ca.MX.sym("R", nr, N), ca.MX.sym("U_r", len(problem.R), N), *ends]


def plan_cost(problem: StagedProblem) -> ca.Function:
    """Return (X, U, R, U_r, M, L, m, low, high) → the cost of a plan, with what it pays for breaking soft limits.

    The limits are those of [u_k; g(x_{k+1})], stage beside stage.
    """
    nx, nu, N = problem.nx, len(problem.R), len(problem.free)
    X, U, targets = ca.MX.sym("X", nx, N + 1), ca.MX.sym("U", nu, N), target_symbols(problem)
    low, high = (ca.MX.sym("end", nu + len(problem.box.low), N) for _ in range(2))
    diagonals = weight_symbols(problem)
    cost = sum_costs(problem, X, U, targets, diagonals)
    if len(problem.box.low):
        soft = np.isfinite(problem.softness.linear)
        linear, quadratic = (ca.DM(np.where(soft, weight, 0.0)) for weight in problem.softness[:2])
        g = problem.limited.map(N)(X[:, 1:])
        over = ca.fmax(ca.fmax(low[nu:, :] - g, g - high[nu:, :]), 0)
        if problem.ends:  # a terminal set limits the last stage alone
            counts = np.ones((len(soft), N))
            counts[-problem.ends :, :-1] = 0.0
            over = over * ca.DM(counts)
        cost += ca.dot(linear, ca.sum2(over)) + ca.dot(quadratic, ca.sum2(over**2))
    return ca.Function("plan_cost", [X, U, *targets, low, high, *(diagonals if problem.timed else [])], [cost])


def simulation(problem: StagedProblem) -> ca.Function:
    """Return (X, U, θ) → F(X_k, U_k), stage beside stage."""
    nx, nu, N = problem.nx, problem.F.size1_in(1), len(problem.free)
    X, U, t = ca.MX.sym("X", nx, N), ca.MX.sym("U", nu, N), ca.MX.sym("t", problem.theta_size)
    found = ca.horzcat(*(problem.F(X[:, k], U[:, k], problem.stage_theta(t, k)) for k in range(N)))
    return ca.Function("simulation", [X, U, t], [found])


def weights(problem: StagedProblem) -> Float[np.ndarray, "nu m"]:
    """Return R stage beside stage; a stage without an input has a weight of its own, so that it rests at zero."""
    nu = len(problem.R)
    held = max(float(np.trace(problem.R)), float(np.trace(problem.Q))) / nu * np.eye(nu)
    return np.hstack([problem.R if free else held for free in problem.free])


class RiccatiSweeps:
    """The backward and forward sweeps of the Riccati recursion, as functions of matrices stage beside stage."""

    def __init__(self, nx: int, nu: int, N: int) -> None:
        self.nx, self.nu, self.N = nx, nu, N
        P, A, B, c = (ca.SX.sym(name, nx, n) for name, n in zip("PABc", (nx, nx, nu, 1), strict=True))
        Q, R = ca.SX.sym("Q", nx, nx), ca.SX.sym("R", nu, nu)
        whole = P + Q
        BP = B.T @ whole
        S = R + BP @ B
        half = ca.chol(0.5 * (S + S.T))  # halfᵀ half = S
        K = ca.solve(half, ca.solve(half.T, BP @ A))
        closed = A - B @ K
        P_next = A.T @ (whole @ closed)
        self._factor = ca.Function(
            "factor",
            [P, A, B, c, Q, R],
            [ca.densify(v) for v in (0.5 * (P_next + P_next.T), K, half, closed, whole @ c)],
            {"cse": True},
        ).mapaccum("factors", N)
        p, Pc, q, r = (ca.SX.sym(name, n) for name, n in zip("pcqr", (nx, nx, nx, nu), strict=True))
        K_, half_, closed_ = ca.SX.sym("K", nu, nx), ca.SX.sym("h", nu, nu), ca.SX.sym("C", nx, nx)
        upper = ca.triu(half_)
        h = Pc + p + q
        k = -ca.solve(upper, ca.solve(upper.T, B.T @ h + r))
        p_next = closed_.T @ h - K_.T @ r
        self._costate = ca.Function(
            "costate",
            [p, B, K_, half_, closed_, Pc, q, r],
            [ca.densify(p_next), ca.densify(k)],
            {"cse": True},
        ).mapaccum("costates", N)
        x, k_ = ca.SX.sym("x", nx), ca.SX.sym("k", nu)
        step = [ca.densify(closed_ @ x + B @ k_ + c), ca.densify(k_ - K_ @ x)]
        self._forward = ca.Function("forward", [x, closed_, B, c, K_, k_], step, {"cse": True}).mapaccum("forwards", N)

    def reverse(self, M: ca.MX, columns: int) -> ca.MX:
        """Return the stages of M, `columns` wide, in the opposite order."""
        order = np.arange(self.N * columns).reshape(self.N, columns)[::-1].ravel()
        return M[:, order.tolist()]

    def factors(self, A: ca.MX, B: ca.MX, c: ca.MX, Q: ca.MX, R: ca.MX) -> list[ca.MX]:
        """Return what the sweeps for these matrices need, last stage first: B, K, L, A − B K, P c; LᵀL = R + BᵀPB."""
        nx, nu = self.nx, self.nu
        turned = [self.reverse(M, n) for M, n in ((A, nx), (B, nu), (c, 1), (Q, nx), (R, nu))]
        _, K, half, closed, Pc = self._factor(ca.DM(nx, nx), *turned)
        return [turned[1], K, half, closed, Pc]

    def solve(self, factors: list[ca.MX], B: ca.MX, c: ca.MX, q: ca.MX, r: ca.MX, x0: ca.MX) -> tuple[ca.MX, ca.MX]:
        """Return (δX, δU) for gradients q and r."""
        _, K, _, closed, _ = factors
        _, k = self._costate(ca.DM(self.nx, 1), *factors, self.reverse(q, 1), self.reverse(r, 1))
        nx = self.nx
        X, U = self._forward(x0, self.reverse(closed, nx), B, c, self.reverse(K, nx), self.reverse(k, 1))
        return X, U


def solve_unconstrained(sweeps: RiccatiSweeps, R: Float[np.ndarray, "nu m"] | None) -> ca.Function:
    """Return (A, B, c, Q, q, r, δx_0) → (δX, δU, diag S): the solution without limits, and the inputs' curvatures.

    Without R here, it is the last argument.
    """
    nx, nu, N = sweeps.nx, sweeps.nu, sweeps.N
    arguments = _problem(nx, nu, N, R)
    A, B, c, Q, q, r, x0 = arguments[:7]
    factors = sweeps.factors(A, B, c, Q, arguments[7] if R is None else ca.MX(ca.DM(R)))
    X, U = sweeps.solve(factors, B, c, q, r, x0)
    curvature = ca.sum1(factors[2] ** 2)  # column by column the diagonal of S
    return ca.Function("unconstrained", arguments, [X, U, curvature])


def interior_step(sweeps: RiccatiSweeps, R: Float[np.ndarray, "nu m"] | None, sides: Sides, ng: int) -> ca.Function:
    """Return one predictor–corrector step of the interior-point method.

    (A, B, c, Q, q, r, δx_0, G, d, σ; X, U, t, λ, ε, ν) → (X, U, t, λ, ε, ν, [μ, α]): d the plan's distances (ns, N), t
    ≥ 0 their slack variables, λ the multipliers, ε ≥ 0 and ν those of the soft sides, μ the mean complementarity before
    the step, α the step's length. (X, U) obeys the dynamics, and only the way from there is solved for: rounding is
    then a share of that way, though barriers weigh 1e11 times as much as the cost. σ is zero in a predictor–corrector
    step. A step with σ > 0 aims at the complementarity σ μ everywhere and leaves the corrector out: it returns to the
    central path. Without R here, it is the argument behind δx_0.
    """
    nx, nu, N = sweeps.nx, sweeps.nu, sweeps.N
    ns, nsoft = len(sides.row), sides.soft
    arguments = _problem(nx, nu, N, R)
    A, B, _, Q, q, r, _ = arguments[:7]
    G, d, sigma = ca.MX.sym("G", ng, N * nx), ca.MX.sym("d", ns, N), ca.MX.sym("sigma")
    X, U = ca.MX.sym("X", nx, N), ca.MX.sym("U", nu, N)
    t, lam = ca.MX.sym("t", ns, N), ca.MX.sym("lam", ns, N)
    eps, nu_ = ca.MX.sym("eps", nsoft, N), ca.MX.sym("nu", nsoft, N)
    S = np.zeros((ns, nu + ng))
    S[np.arange(ns), sides.row] = sides.sign / sides.span
    S = ca.DM(S)
    l1 = ca.repmat(ca.MX(ca.DM(sides.linear)), 1, N)
    l2 = ca.repmat(ca.MX(ca.DM(sides.quadratic)), 1, N)

    def pad(soft: ca.MX) -> ca.MX:
        return ca.vertcat(ca.MX(ns - nsoft, N), soft) if ns > nsoft else soft

    row, g = ca.SX.sym("G", ng, nx), ca.SX.sym("w", ng)
    gram = ca.Function("gram", [row, g], [ca.densify(row.T @ ca.diag(g) @ row)]).map(N)
    pulled = ca.Function("pulled", [row, g], [ca.densify(row.T @ g)]).map(N)
    x = ca.SX.sym("x", nx)
    seen = ca.Function("seen", [row, x], [ca.densify(row @ x)]).map(N)
    diagonal = ca.Function("diagonal", [v := ca.SX.sym("w", nu)], [ca.densify(ca.diag(v))]).map(N)
    weigh_x, weigh_u = (
        ca.Function("weighed", [M := ca.SX.sym("M", n, n), v := ca.SX.sym("v", n)], [M @ v]).map(N) for n in (nx, nu)
    )

    def distances(X: ca.MX, U: ca.MX) -> ca.MX:
        return S @ (ca.vertcat(U, seen(G, X)) if ng else U)

    w = lam / t
    kappa = 1 / (l2 + nu_ / eps)
    K = pad(kappa)
    eased = w / (1 + w * K)
    gap = d + distances(X, U) + pad(eps) - t
    weights = (S.T**2) @ eased
    own = arguments[7] if R is None else ca.MX(ca.DM(R))
    R_k = own + diagonal(weights[:nu, :])
    Q_k = Q + gram(G, weights[nu:, :]) if ng else Q
    rest = ca.MX(nx, N)
    factors = sweeps.factors(A, B, rest, Q_k, R_k)
    slope_x, slope_u = q + weigh_x(Q, X), r + weigh_u(own, U)  # of the cost, at this point

    def solve(c1: ca.MX | float, c2: ca.MX | float) -> tuple[ca.MX, ...]:
        rho = lam[ns - nsoft :, :] - l1 - l2 * eps + c2 / eps
        base = lam + (-w * (K * pad(rho) + gap) - lam + c1 / t) / (1 + w * K)
        gradient = -S.T @ base
        q_k = slope_x + pulled(G, gradient[nu:, :]) if ng else slope_x
        d_X, d_U = sweeps.solve(factors, B, rest, q_k, slope_u + gradient[:nu, :], ca.MX(nx, 1))
        reached = distances(d_X, d_U)
        d_lam = base - eased * reached - lam
        d_eps = kappa * (rho + d_lam[ns - nsoft :, :])
        d_t = reached + pad(d_eps) + gap
        d_nu = -(nu_ / eps) * d_eps - nu_ + c2 / eps
        return d_X, d_U, d_t, d_lam, d_eps, d_nu

    def longest(d_t: ca.MX, d_lam: ca.MX, d_eps: ca.MX, d_nu: ca.MX) -> ca.MX:
        pairs = [(d_t, t), (d_lam, lam)] + ([(d_eps, eps), (d_nu, nu_)] if nsoft else [])
        return ca.mmax(ca.vertcat(*(ca.vec(-step / at) for step, at in pairs)))

    count = (ns + nsoft) * N
    mu = (ca.dot(t, lam) + ca.dot(eps, nu_)) / count
    _, _, *affine = solve(0.0, 0.0)
    a = 1 / ca.fmax(longest(*affine), 1)
    a_t, a_lam, a_eps, a_nu = affine
    ahead = (ca.dot(t + a * a_t, lam + a * a_lam) + ca.dot(eps + a * a_eps, nu_ + a * a_nu)) / count
    centre = mu * ca.if_else(sigma > 0, sigma, (ahead / mu) ** 3)
    second = ca.if_else(sigma > 0, 0, a * a)
    step = solve(centre - second * a_t * a_lam, centre - second * a_eps * a_nu)
    length = 1 / ca.fmax(longest(*step[2:]) / _SHORT, 1)
    variables = [X, U, t, lam, eps, nu_]
    after = [v + length * dv for v, dv in zip(variables, step, strict=True)]
    return ca.Function("interior_step", [*arguments, G, d, sigma, *variables], [*after, ca.vertcat(mu, length)])


def _problem(nx: int, nu: int, N: int, R: Float[np.ndarray, "nu m"] | None) -> list[ca.MX]:
    shapes = {
        "A": (nx, N * nx),
        "B": (nx, N * nu),
        "c": (nx, N),
        "Q": (nx, N * nx),
        "q": (nx, N),
        "r": (nu, N),
    }
    whole = [ca.MX.sym(name, *shape) for name, shape in shapes.items()] + [ca.MX.sym("x0", nx)]
    return [*whole, ca.MX.sym("R", nu, N * nu)] if R is None else whole
