# pyright: basic
"""The door to CVXPY: fits of [A B] under priors, and of a stable A, as convex programs.

CVXPY has no types, and is imported when a program is solved.
"""

import warnings

import numpy as np
from jaxtyping import Float, Int

from koopmpc.errors import DataError
from koopmpc.identify.constrained.prior import Combination, Dissipation, Entries, Prior
from koopmpc.identify.solve import RegressionRows, norms

_LEAST = 1e-3  # least eigenvalue of P, as a share of the mean one


def optimum(
    rows: RegressionRows, entries: Entries, which: Int[np.ndarray, " r"], ridge: float, prior: Prior | None
) -> tuple[Float[np.ndarray, "n r"], str]:
    """Return K = argmin Σᵢ ‖tᵢ − P kᵢ‖² / ‖tᵢ‖² (+ ridge) over the targets `which`, and the solver's status.

    Columns of P and targets have unit norm in the program, so units of the data mean nothing. `prior` brings what
    couples the rows of [A B]; the targets are then all observables.

    Raises
    ------
    DataError
        No A and B meet the priors, or the solver gives up.
    """
    import cvxpy as cp
    from scipy.sparse import csc_array

    n, nz = rows.P.shape[1], len(which)
    size = _ones(norms(rows.P))
    energy = np.sum(rows.T[:, which] ** 2, axis=0) + rows.rest[which]
    unit = _ones(np.sqrt(energy))
    scale = unit / size[:, None]  # K = X · scale
    known = entries.known[which].T
    free = np.isnan(known)
    count = int(free.sum())
    x = cp.Variable(count)
    place = np.flatnonzero(free.ravel(order="F"))
    select = csc_array((np.ones(count), (place, np.arange(count))), shape=(n * nz, count))
    fixed = np.where(free, 0.0, known / scale).ravel(order="F")
    X = cp.reshape(select @ x + fixed, (n, nz), order="F")
    misfit = cp.sum_squares((rows.P / size) @ X - rows.T[:, which] / unit)
    bounds = []
    for limit, sign in ((entries.low, -1.0), (entries.high, 1.0)):
        values = (limit[which].T / scale).ravel(order="F")[place]
        held = np.flatnonzero(np.isfinite(values))
        if held.size:
            bounds.append(sign * x[held] <= sign * values[held])
    if prior is not None:
        bounds += _coupling(cp, prior, X, scale, size / np.sqrt(rows.samples))
    weight = np.ones((n, nz))  # where a target's intercept is free, the ridge weighs deviations from the mean
    if rows.constant is not None:
        weight[:, free[rows.constant]] = (norms(rows.centred().P) / size)[:, None]
    problem = cp.Problem(cp.Minimize(misfit + ridge * cp.sum_squares(cp.multiply(weight, X))), bounds)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the report tells of an inaccurate solution
        try:
            problem.solve(solver=cp.CLARABEL, tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11, max_iter=200)
        except cp.SolverError as error:
            raise DataError(f"the priors could not be met: Clarabel says {error}; loosen them") from error
    status = str(problem.status)
    if status in (cp.INFEASIBLE, cp.INFEASIBLE_INACCURATE):
        raise DataError(f"no A and B meet all priors: Clarabel says {status!r}; loosen or drop one of them")
    if X.value is None:
        raise DataError(f"the fit under priors stopped: Clarabel says {status!r}; loosen the priors")
    return np.asarray(X.value) * scale, status


def violation(
    prior: Prior, A: Float[np.ndarray, "nz nz"], B: Float[np.ndarray, "nz nu"], size: Float[np.ndarray, " n"]
) -> float:
    """Return the largest violation of the coupling priors, in units of the regressors' sizes; 0 where all hold."""
    nz = len(A)
    worst = 0.0
    if prior.symmetric:
        worst = float(np.abs(A - A.T).max()) / max(float(np.abs(A).max()), 1e-300)
    for each in prior.combinations:
        value = sum(
            float(np.sum(w * m)) for w, m in ((each.A, A), (each.B, B)) if w is not None
        )  # the sum of weighted entries
        worst = max(worst, each.low - value, value - each.high)
    if prior.dissipation is not None:
        M = _dissipation(prior.dissipation, A, B, size[:nz], size[nz:], np.block)
        worst = max(worst, -float(np.linalg.eigvalsh(M)[0]))
    return worst


def _coupling(cp, prior: Prior, X, scale, size) -> list:
    """Return the constraints that couple rows of [A B]: symmetry, combinations, dissipation."""
    nz = scale.shape[1]
    K = cp.multiply(scale, X)
    A, B = K[:nz].T, K[nz:].T
    constraints = []
    if prior.symmetric:
        W = scale[:nz].T
        balance = np.sqrt(W / W.T)
        S = cp.multiply(balance, X[:nz].T)
        constraints.append(cp.upper_tri(S) == cp.upper_tri(S.T))
    for each in prior.combinations:
        constraints += _limits(cp, each, A, B)
    if prior.dissipation is not None:
        M = _dissipation(prior.dissipation, A, B, size[:nz], size[nz:], cp.bmat)
        constraints.append(0.5 * (M + M.T) >> 0)
    return constraints


def _limits(cp, each: Combination, A, B) -> list:
    """Return the constraints low ≤ Σ Fᵢⱼ Aᵢⱼ + Σ Gᵢⱼ Bᵢⱼ ≤ high."""
    total = 0
    for weights, matrix in ((each.A, A), (each.B, B)):
        if weights is not None and weights.size:
            total = total + cp.sum(cp.multiply(weights, matrix))
    if each.low == each.high:
        return [total == each.low]
    ends = []
    if np.isfinite(each.low):
        ends.append(total >= each.low)
    if np.isfinite(each.high):
        ends.append(total <= each.high)
    return ends


def _dissipation(dissipation: Dissipation, A, B, size, force, block):
    """Return M ⪰ 0 ⇔ V(A z + B u) ≤ decay² V(z) + uᵀ(C z + D u): a Schur complement, P = LᵀL.

    z and u are taken in units of their sizes, V in units of its largest diagonal entry there.
    """
    values, vectors = np.linalg.eigh(dissipation.P)
    held = values > 1e-12 * values[-1]
    L = np.sqrt(values[held])[:, None] * vectors[:, held].T
    unit = max(float((dissipation.P.diagonal() * size**2).max()), 1e-300) ** -0.5
    z, u = np.diag(size * unit), np.diag(force * unit)
    P = dissipation.decay**2 * z @ dissipation.P @ z
    LA = (L @ A) @ z
    if dissipation.C is None:
        return block([[P, LA.T], [LA, np.eye(len(L))]])
    D = np.zeros((len(force), len(force))) if dissipation.D is None else dissipation.D
    C, LB = u @ dissipation.C @ z, (L @ B) @ u
    return block([[P, C.T, LA.T], [C, u @ (D + D.T) @ u, LB.T], [LA, LB, np.eye(len(L))]])


def _ones(size: np.ndarray) -> np.ndarray:
    """Return the sizes, 1 in place of 0."""
    return np.where(size > 0, size, 1.0)


def lyapunov_fit(
    A0: Float[np.ndarray, "n n"], G: Float[np.ndarray, "n n"], radius: float
) -> Float[np.ndarray, "n n"] | None:
    """Return A = H Y P⁻¹ H⁻¹, H = G^½, of min ‖H (Y − H⁻¹A₀H P)‖_F with [[ρ² P, Y], [Yᵀ, P]] ⪰ 0, tr P = n.

    The inequality is Y P⁻¹ Yᵀ ⪯ ρ² P: H P H is a Lyapunov matrix of A, so |λ(A)| ≤ ρ. Objective and constraints are
    convex in (Y, P), so the optimum is global. The squared norm is the misfit tr (A − A₀) G (A − A₀)ᵀ where P = I;
    elsewhere it weighs the observables' whitened directions by P² instead of I. P ⪰ 10⁻³ I bounds that ratio.
    Returns None where the solver stops without an answer.

    References
    ----------
    Lacy & Bernstein, "Subspace identification with guaranteed stability using constrained optimization", IEEE
    Trans. Automat. Contr. 48, 2003.
    """
    import cvxpy as cp

    n = len(A0)
    values, vectors = np.linalg.eigh(G)
    root = np.sqrt(np.maximum(values, 1e-8 * values[-1]))
    H, inverse = (vectors * root) @ vectors.T, (vectors / root) @ vectors.T
    Y, P = cp.Variable((n, n)), cp.Variable((n, n), symmetric=True)
    M = cp.bmat([[radius**2 * P, Y], [Y.T, P]])
    constraints = [0.5 * (M + M.T) >> 0, P - _LEAST * np.eye(n) >> 0, cp.trace(P) == n]
    misfit = cp.norm((H / root[-1]) @ (Y - inverse @ A0 @ H @ P), "fro")
    problem = cp.Problem(cp.Minimize(misfit), constraints)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an inaccurate solution is a start like any other
        try:
            problem.solve(solver=cp.CLARABEL)
        except cp.SolverError:
            return None
    if Y.value is None or P.value is None:
        return None
    return H @ np.linalg.solve(np.asarray(P.value), np.asarray(Y.value).T).T @ inverse
