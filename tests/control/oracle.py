"""The whole problem of KoopmanMPC written again in CVXPY, its states, inputs and slacks as variables."""

import warnings

import numpy as np

TIGHT = {"tol_gap_abs": 1e-11, "tol_gap_rel": 1e-11, "tol_feas": 1e-11}


def oracle(model, cost, limits, z0, R, targets, *, end, u_prev, W=None, d=None, blocks=None, C=None, of=None):
    """U (N, nu) and the least cost, by CLARABEL; None where there is none.

    `targets` are (z_r, u_r) of each row of R; the end costs ‖F ξ_N − h‖², `end` being (F, h) and ξ_N = z_N or
    [z_N; u_{N−1}] by the size of F; `of` are the matrix of the limited observables.
    """
    import cvxpy as cp

    C = model.C if C is None else C
    N, nu, nz = len(R) - 1, model.nu, model.nz
    blocks = (1,) * N if blocks is None else blocks
    Q, Ru = cost.matrices(len(C), nu)
    psd = cp.psd_wrap
    Z, U = cp.Variable((N + 1, nz)), cp.Variable((N, nu))
    held, objective = [Z[0] == z0], 0
    first = 0
    for b in blocks:
        held += [U[first + i] == U[first] for i in range(1, b)]
        first += b

    def limit(values, low, high, linear, quadratic):
        """Hold values (n,) between the scalars low and high, with slack where `linear` is finite."""
        nonlocal objective, held
        slack = 0
        if np.isfinite(linear):
            slack = cp.Variable(values.shape[0], nonneg=True)
            objective += linear * cp.sum(slack) + quadratic * cp.sum_squares(slack)
        if np.isfinite(low):
            held += [values + slack >= low]
        if np.isfinite(high):
            held += [values - slack <= high]

    def weights(slack, n):
        if slack is None:
            return np.full(n, np.inf), np.zeros(n)
        return (np.broadcast_to(part, (n,)) for part in slack)

    for k in range(N):
        push = np.zeros(nz) if W is None else model.E @ W[k]
        push = push if d is None else push + d
        held += [Z[k + 1] == model.A @ Z[k] + model.B @ U[k] + push]
        objective += cp.quad_form(U[k] - targets[k][1], psd(Ru))
        if cost.R_delta is not None:
            before = u_prev if k == 0 else U[k - 1]
            objective += cp.quad_form(U[k] - before, psd(cost.rate(nu)))
        if k + 1 < N:
            objective += cp.quad_form(C @ Z[k + 1] - R[k + 1], psd(Q))
    F, h = end
    objective += cp.sum_squares(F @ (Z[N] if F.shape[1] == nz else cp.hstack([Z[N], U[N - 1]])) - h)

    box = limits.inputs(nu)
    for i in range(nu):
        limit(U[:, i], box.low[i], box.high[i], np.inf, 0.0)
    if limits.du_max is not None or limits.du_min is not None:
        high = np.broadcast_to(np.inf if limits.du_max is None else limits.du_max, (nu,))
        low = -high if limits.du_min is None else np.broadcast_to(limits.du_min, (nu,))
        linear, quadratic = weights(limits.du_slack, nu)
        starts = np.cumsum([0, *blocks[:-1]])
        for i in range(nu):
            changes = cp.hstack([U[k, i] - (u_prev[i] if k == 0 else U[k - 1, i]) for k in starts])
            limit(changes, low[i], high[i], linear[i], quadratic[i])
    G, low, high, given = model.C, *limits.states(model.nx), []
    given = [limits.x_min is not None or limits.x_max is not None] * model.nx
    if of is not None:
        y = limits.outputs(len(of))
        G, low, high = np.vstack([G, of]), np.append(low, y.low), np.append(high, y.high)
        given += [True] * len(of)
    places = np.flatnonzero(given)
    for i, linear, quadratic in zip(places, *weights(limits.slack, len(places)), strict=True):
        limit(Z[1:] @ G[i], low[i], high[i], linear, quadratic)

    problem = cp.Problem(cp.Minimize(objective), held)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Solution may be inaccurate", UserWarning)  # its status says so
            problem.solve(cp.CLARABEL, **TIGHT)
    except cp.error.SolverError:
        return None
    return (U.value, problem.value) if problem.status in ("optimal", "optimal_inaccurate") else None


def targets_of(mpc, R, e=None):
    """(z_r, u_r) of each row of R, as the controller finds them; the laws of a target have their own tests."""
    found = mpc._map.targets
    z_disturbance, u_disturbance = (0.0, 0.0) if e is None else (found.z_disturbance @ e, found.u_disturbance @ e)
    return [
        (found.z0 + z_disturbance + found.Z @ a, found.u0 + u_disturbance + found.W @ a)
        for a in found.coordinates(R, e)
    ]
