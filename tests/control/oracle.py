"""The whole problem of KoopmanMPC written again in CVXPY, its states, inputs and slacks as variables."""

import warnings

import numpy as np
import scipy.linalg

from tests.control.models import end_of

TIGHT = {"tol_gap_abs": 1e-11, "tol_gap_rel": 1e-11, "tol_feas": 1e-11}


def oracle(model, cost, limits, z0, R, *, u_prev=None, W=None, d=None, blocks=None, C=None, of=None, step=0):
    """U (N, nu) and the least cost, by CLARABEL; None where there is none.

    `of` is the matrix of limited observables. Row k of limits in time is that of u_k, u_k − u_{k−1}, x_k and y_k;
    row `step` + k of weights in time is that of x_k and u_k.
    """
    import cvxpy as cp

    C = model.C if C is None else C
    N, nu, nz = len(R) - 1, model.nu, model.nz
    e = np.zeros(nz) if W is None else model.E @ W[-1]
    e = e if d is None else e + d
    targets = targets_of(model, cost, limits, R, e, C, of)
    u_prev = np.zeros(nu) if u_prev is None else u_prev
    blocks = (1,) * N if blocks is None else blocks
    Q, Ru = ([weight] * N for weight in cost.matrices(len(C), nu))
    if cost.weighs_in_time:
        Q, Ru = ([np.diag(row) for row in rows] for rows in cost.weight_rows(len(C), nu, step, N))
    Z, U = cp.Variable((N + 1, nz)), cp.Variable((N, nu))
    held, objective = [Z[0] == z0], 0
    first = 0
    for b in blocks:
        held += [U[first + i] == U[first] for i in range(1, b)]
        first += b

    def limit(values, low, high, linear, quadratic):
        """Hold values (n,) between low and high, (n,) each, with slack where `linear` is finite."""
        nonlocal objective, held
        slack = 0
        if np.isfinite(linear):
            slack = cp.Variable(values.shape[0], nonneg=True)
            objective += linear * cp.sum(slack) + quadratic * cp.sum_squares(slack)
        lower, upper = np.flatnonzero(np.isfinite(low)), np.flatnonzero(np.isfinite(high))
        if len(lower):
            held += [(values + slack)[lower] >= low[lower]]
        if len(upper):
            held += [(values - slack)[upper] <= high[upper]]

    def weights(slack, n):
        if slack is None:
            return np.full(n, np.inf), np.zeros(n)
        return (np.broadcast_to(part, (n,)) for part in slack)

    push = np.zeros((N, nz)) if W is None else np.asarray(W)[:N] @ model.E.T
    held += [Z[1:] == Z[:-1] @ model.A.T + U @ model.B.T + (push if d is None else push + d)]
    objective += weighed(U - np.array([u for _, u in targets[:N]]), Ru[:N])
    if cost.R_delta is not None:
        before = u_prev[None] if N == 1 else cp.vstack([u_prev[None], U[:-1]])
        objective += weighed(U - before, [cost.rate(nu)])
    if N > 1:
        objective += weighed(Z[1:N] @ C.T - np.asarray(R)[1:N], Q[1:N])
    F, h = end_of(model, cost, targets, R, e, C)
    objective += cp.sum_squares(F @ (Z[N] if F.shape[1] == nz else cp.hstack([Z[N], U[N - 1]])) - h)

    box = limits.input_rows(nu, 0, N)
    for i in range(nu):
        limit(U[:, i], box.low[:, i], box.high[:, i], np.inf, 0.0)
    if limits.du_max is not None or limits.du_min is not None:
        low, high = limits.rate_rows(nu, 0, N)
        linear, quadratic = weights(limits.du_slack, nu)
        starts = np.cumsum([0, *blocks[:-1]])
        differ = np.eye(N)[starts] - np.eye(N, k=-1)[starts]
        for i in range(nu):
            changes = differ @ U[:, i] - np.eye(len(starts))[0] * u_prev[i]
            limit(changes, low[starts, i], high[starts, i], linear[i], quadratic[i])
    G, (low, high) = model.C, limits.output_rows(model.nx, 0 if of is None else len(of), 1, N)
    given = [limits.x_min is not None or limits.x_max is not None] * model.nx
    if of is not None:
        G = np.vstack([G, of])
        given += [True] * len(of)
    places = np.flatnonzero(given)
    for i, linear, quadratic in zip(places, *weights(limits.slack, len(places)), strict=True):
        limit(Z[1:] @ G[i], low[:, i], high[:, i], linear, quadratic)

    value = minimum(objective, held)
    return None if value is None else (U.value, value)


def weighed(rows, weights):
    """Return the sum of rowᵀ W row over the rows of an expression; weights that differ from row to row are diagonal."""
    import cvxpy as cp

    if all(np.array_equal(weight, weights[0]) for weight in weights):
        values, vectors = np.linalg.eigh(weights[0])
        return cp.sum_squares(rows @ (vectors * np.sqrt(np.maximum(values, 0.0))))
    return cp.sum_squares(cp.multiply(np.sqrt([np.diag(weight) for weight in weights]), rows))


def minimum(objective, held):
    """The least objective, by CLARABEL; None where there is none."""
    import cvxpy as cp

    problem = cp.Problem(cp.Minimize(objective), held)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Solution may be inaccurate", UserWarning)  # its status says so
            problem.solve(cp.CLARABEL, **TIGHT)
    except cp.error.SolverError:
        return None
    return problem.value if problem.status in ("optimal", "optimal_inaccurate") else None


def beyond(value, low, high):
    """Whether an entry is outside its limits."""
    return (value < low - 1e-9).any() or (value > high + 1e-9).any()


def targets_of(model, cost, limits, R, e, C, of=None):
    """(z_r, u_r) of each row r: the equilibrium z = A z + B u + e with the least ‖C z − r‖²_Q, and of these the least.

    Where it is outside the limits of u, C x and `of`, it is the one inside them of which C z is nearest in Q; where
    none is, the one inside those of u. A Constant's coordinate is 1.
    """
    import cvxpy as cp

    nz, nu, constant = model.nz, model.nu, model.lifting.constant_index
    keep = [i for i in range(nz) if i != constant]
    free = [*keep, *range(nz, nz + nu)]
    E = np.hstack([model.A - np.eye(nz), model.B])[keep]
    base = np.zeros(nz + nu)
    if constant is not None:
        base[constant] = 1.0
    base[free] = np.linalg.lstsq(E[:, free], -e[keep] - E @ base, rcond=1e-8)[0]
    basis = scipy.linalg.null_space(E[:, free], rcond=1e-8)
    span = np.zeros((nz + nu, basis.shape[1]))
    span[free] = basis
    S = scipy.linalg.sqrtm(cost.matrices(len(C), nu)[0]).real
    at = S @ C @ span[:nz]
    G = model.C if of is None else np.vstack([model.C, of])
    rows = np.hstack([np.zeros((nu, nz)), np.eye(nu)]), np.hstack([G, np.zeros((len(G), nu))])
    found = []
    for k, r in enumerate(R):
        now = limits.at(k)
        ends = now.inputs(nu), now.ends(model.nx, len(G) - model.nx)
        v = base + span @ np.linalg.lstsq(at, S @ (r - C @ base[:nz]), rcond=1e-8)[0]
        if any(beyond(M @ v, *end) for M, end in zip(rows, ends, strict=True)):
            beta, weight = cp.Variable(span.shape[1]), 1e-9 * np.trace(at.T @ at)
            moved = cp.sum_squares(at @ beta) + weight * cp.sum_squares(beta)
            for count in (2, 1):
                held = []
                for M, (least, most) in list(zip(rows, ends, strict=True))[:count]:
                    value, lower, upper = M @ v + (M @ span) @ beta, np.isfinite(least), np.isfinite(most)
                    held += [value[lower] >= least[lower], value[upper] <= most[upper]]
                if minimum(moved / np.trace(at.T @ at), held) is not None:
                    v = v + span @ beta.value
                    break
        u_r = v[nz:]
        if not isinstance(cost.u_target, str):
            given = cost.given_inputs(nu)
            u_r = given[min(k, len(given) - 1)]
        found.append((v[:nz], np.zeros(nu) if isinstance(cost.u_target, str) and cost.u_target == "zero" else u_r))
    return found
