"""Whole controllers of a seeded generator, and their problem written down by brute force, for KKT checks.

Minimise Σ_{k=1}^{N−1} ‖x_k − r_k‖²_Q + ‖x_N − r_N‖²_{Q_N} + Σ ‖u_k‖²_R + ‖u_k − u_{k−1}‖²_{R_delta} + the price of
slacks.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.optimize

import koopmpc as km

KINDS = ("inputs", "rates", "soft", "exact", "hard", "corridor", "mixed", "degenerate", "scaled")


@dataclass
class Rows:
    """low ≤ base(x_0, u_{−1}) + M U ≤ high, each row hard or at the price linear ε + quadratic ε²."""

    M: np.ndarray
    low: np.ndarray
    high: np.ndarray
    linear: np.ndarray
    quadratic: np.ndarray


@dataclass
class Case:
    """A controller, its plant, the scale of its states, and its problem in matrices of U = [u_0; …; u_{N−1}]."""

    kind: str
    mpc: km.KoopmanMPC
    A: np.ndarray
    B: np.ndarray
    scale: np.ndarray
    N: int
    H: np.ndarray
    half: np.ndarray
    free: np.ndarray
    forced: np.ndarray
    weights: np.ndarray
    R_delta: np.ndarray
    rows: Rows
    rates: np.ndarray | None
    box: tuple[np.ndarray, np.ndarray]

    def gradient(self, x, r, u_prev, U):
        """H U + f."""
        error = self.free @ x - r.ravel()
        f = 2 * self.forced.T @ (self.weights @ error)
        f[: len(u_prev)] -= 2 * self.R_delta @ u_prev
        return self.H @ U + f

    def values(self, x, u_prev, U):
        """The limited values: inputs, their changes, the states."""
        base = np.zeros(len(self.rows.M))
        n, nu = len(U), len(u_prev)
        base[n : n + nu] = -u_prev
        base[2 * n :] = self.free @ x
        return base + self.rows.M @ U


def random_case(rng, kind, solver):
    """Return a Case; `kind` says what is special about it."""
    nx, nu, N = int(rng.integers(1, 4)), int(rng.integers(1, 3)), int(rng.integers(1, 9))
    A, B = rng.normal(size=(nx, nx)), rng.normal(size=(nx, nu))
    A *= rng.uniform(0.3, 1.2) / max(np.abs(np.linalg.eigvals(A)).max(), 0.1)
    if kind == "degenerate" and nx > 1:
        A[:, -1], A[-1], B[-1] = 0.0, A[0], B[0]  # two states that are the same, with the same limits
    root = rng.normal(size=(nx, nx))
    Q, Q_N = np.diag(10.0 ** rng.uniform(-2, 1, nx)), root @ root.T + 0.1 * np.eye(nx)
    R, R_delta = 10.0 ** rng.uniform(-3, 1, nu), np.zeros(nu)
    if rng.random() < 0.3:
        R_delta = 10.0 ** rng.uniform(-2, 0, nu)
    sx, su, price = np.ones(nx), np.ones(nu), 1.0
    if kind == "scaled":
        sx, su, price = (
            10.0 ** rng.uniform(-4, 4, nx),
            10.0 ** rng.uniform(-4, 4, nu),
            10.0 ** rng.uniform(-5, 5),
        )
    A, B = A * sx[:, None] / sx, B * sx[:, None] / su
    Q, Q_N = price * Q / np.outer(sx, sx), price * Q_N / np.outer(sx, sx)
    R, R_delta = price * R / su**2, price * R_delta / su**2

    u_max = su * 10.0 ** rng.uniform(-2, 0.5, nu)
    u_min = -su * 10.0 ** rng.uniform(-2, 0.5, nu)
    if rng.random() < 0.1:
        u_min = np.minimum(u_max, 0.5 * su * rng.random(nu))  # zero is outside, or no room at all
    rated = kind in ("rates", "mixed", "degenerate") or rng.random() < 0.2
    rates = su * 10.0 ** rng.uniform(-2, 0.5, nu) if rated else None
    if kind == "degenerate" and rated:
        rates = u_max - u_min
    rate_price = None
    if kind == "mixed" and rng.random() < 0.5:
        rate_price = (
            price * 10.0 ** rng.uniform(-1, 3, nu) / su,
            price * 10.0 ** rng.uniform(-1, 2, nu) / su**2,
        )
    bounded = kind not in ("inputs", "rates")
    x_max, slack = sx * 10.0 ** rng.uniform(-2, 1, nx), None
    x_min = -x_max if rng.random() < 0.5 else -sx * 10.0 ** rng.uniform(-2, 1, nx)
    if kind == "corridor":
        x_min[0] = x_max[0] - 10.0 ** rng.uniform(-6, -1) * sx[0]
    if kind == "degenerate":
        x_min[-1], x_max[-1] = x_min[0], x_max[0]
    if kind in ("soft", "mixed", "exact") or (kind == "scaled" and rng.random() < 0.7):
        quadratic = np.zeros(nx) if kind == "exact" else price * 10.0 ** rng.uniform(-2, 3, nx) / sx**2
        slack = (price * 10.0 ** rng.uniform(-1, 4, nx) / sx, quadratic)
        if kind == "mixed":
            slack[0][rng.random(nx) < 0.3] = np.inf
    limits = km.Limits(
        u_min,
        u_max,
        x_min=x_min if bounded else None,
        x_max=x_max if bounded else None,
        slack=slack,
        du_max=rates,
        du_slack=rate_price,
    )
    names = tuple(f"x{i}" for i in range(nx)), tuple(f"u{i}" for i in range(nu))
    model = km.LinearPredictor(A, B, np.eye(nx), km.State(), 0.1, *names)
    cost = km.Cost(Q, np.diag(R), Q_N=Q_N, R_delta=np.diag(R_delta) if R_delta.any() else None, u_target="zero")
    mpc = km.KoopmanMPC(model, cost, limits, N, solver=solver)
    return _written_down(
        kind,
        mpc,
        limits,
        (A, B),
        (Q, Q_N, np.diag(R), np.diag(R_delta)),
        sx,
        rates if rate_price is None else None,
    )


def _written_down(kind, mpc, limits, pair, weights, scale, hard_rates):
    (A, B), (Q, Q_N, R, R_delta), N = pair, weights, mpc.horizon
    nx, nu = B.shape
    free, forced = np.zeros((N * nx, nx)), np.zeros((N * nx, N * nu))
    X, D = np.eye(nx), np.zeros((nx, N * nu))
    for k in range(N):
        X, D = A @ X, A @ D
        D[:, k * nu : (k + 1) * nu] += B
        free[k * nx : (k + 1) * nx], forced[k * nx : (k + 1) * nx] = X, D
    stages = scipy.linalg.block_diag(*[Q] * (N - 1), Q_N)
    change = np.eye(N * nu) - np.eye(N * nu, k=-nu)
    H = 2 * (forced.T @ stages @ forced + np.kron(np.eye(N), R) + change.T @ np.kron(np.eye(N), R_delta) @ change)
    box, rates, states = limits.inputs(nu), limits.rates(nu), limits.states(nx)
    no = np.full(nu, np.inf)
    ends = [
        np.concatenate([np.tile(part, N) for part in (box[i], (sign * no if rates is None else rates[i]), states[i])])
        for i, sign in ((0, -1.0), (1, 1.0))
    ]
    soft_rates, price = limits.rate_softness(nu), limits.find_rows(nx, 0)
    prices = [np.full(nx, fill) for fill in (np.inf, 0.0)]
    for whole, part in zip(prices, price.softness[:2], strict=True):
        whole[price.kept] = part
    linear, quadratic = (
        np.concatenate([np.full(N * nu, fill), np.tile(rate, N), np.tile(state, N)])
        for fill, rate, state in zip((np.inf, 0.0), soft_rates[:2], prices, strict=True)
    )
    rows = Rows(np.vstack([np.eye(N * nu), change, forced]), *ends, linear, quadratic)
    half = np.linalg.cholesky(H)
    return Case(kind, mpc, A, B, scale, N, H, half, free, forced, stages, R_delta, rows, hard_rates, tuple(box))


def optimality(case, x, r, u_prev, U, tolerance):
    """Return (violation of hard rows, distance from stationarity) of the plan U, both relative.

    Measured in the norm of H, as shares of the distance to the unconstrained optimum and of the largest force: that
    of a row, or the price of a slack. A row within `tolerance`
    of its end may push with any multiplier; that of a soft row stays below its price, and is its price beyond.
    """
    rows, L = case.rows, case.half
    solve = lambda M: scipy.linalg.solve_triangular(L, M, lower=True)  # noqa: E731
    g, f = solve(case.gradient(x, r, u_prev, U)), solve(case.gradient(x, r, u_prev, 0 * U))
    pull = solve(rows.M.T)
    unit = np.linalg.norm(L.T @ U) + np.linalg.norm(f)
    values, reach = case.values(x, u_prev, U), np.linalg.norm(pull, axis=0)
    scale = reach * unit + np.abs(values) + 1e-300
    over = np.maximum(values - rows.high, rows.low - values)
    hard = np.isinf(rows.linear)
    unit_of_force = unit + float((rows.linear * reach)[~hard].max(initial=0.0))
    violation = float((over / scale)[hard].max(initial=0.0))
    columns, caps = [], []
    pushed = np.zeros(len(U))
    for sign, distance in ((1.0, values - rows.high), (-1.0, rows.low - values)):
        near = np.abs(distance) <= tolerance * scale
        near |= hard & (distance > 0)
        for i in np.flatnonzero(near & (reach > 0)):
            columns.append(sign * pull[:, i])
            slope = rows.linear[i] + 2 * rows.quadratic[i] * max(distance[i], tolerance * scale[i])
            caps.append(np.inf if hard[i] else slope)
        for i in np.flatnonzero(~near & ~hard & (distance > 0)):
            push = sign * (rows.linear[i] + 2 * rows.quadratic[i] * distance[i]) * pull[:, i]
            pushed += push
            unit_of_force += np.linalg.norm(push)
    right = -(g + pushed)
    if not columns:
        return violation, float(np.linalg.norm(right) / (unit_of_force + 1e-300))
    J = np.stack(columns, axis=1)
    size = np.linalg.norm(J, axis=0)
    J, caps = J / size, np.array(caps) * size
    if np.isinf(caps).all():
        y, rest = scipy.optimize.nnls(J, right, maxiter=50 * len(caps))
    else:
        found = scipy.optimize.lsq_linear(J, right, (0.0, np.maximum(caps, 1e-300)), method="bvls", tol=1e-14)
        y, rest = found.x, np.linalg.norm(J @ found.x - right)
    return violation, float(rest / (unit_of_force + np.abs(y).sum() + 1e-300))


def feasible(case, x, u_prev):
    """Tell by a linear program whether the hard rows have a point in common."""
    rows = case.rows
    hard, base = np.isinf(rows.linear), case.values(x, u_prev, np.zeros(rows.M.shape[1]))
    M, size = rows.M[hard], np.linalg.norm(rows.M[hard], axis=1)
    units = 1 / np.sqrt(np.diag(case.H))
    M = M * units
    size = np.maximum(np.linalg.norm(M, axis=1), 1e-12 * np.abs(base[hard]) + 1e-300)
    ends = [(rows.high - base)[hard] / size, -(rows.low - base)[hard] / size]
    G = np.vstack([M / size[:, None], -M / size[:, None]])
    right = np.concatenate(ends)
    keep = np.isfinite(right)
    n = G.shape[1]
    gap = scipy.optimize.linprog(
        np.append(np.zeros(n), 1.0),
        A_ub=np.column_stack([G[keep], -np.ones(keep.sum())]),
        b_ub=right[keep],
        bounds=[(None, None)] * n + [(0, None)],
    )
    return gap.status == 0 and gap.fun <= 1e-9 * (1 + np.abs(right[keep]).max(initial=0.0))
