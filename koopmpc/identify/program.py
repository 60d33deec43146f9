# pyright: basic
"""Least squares under priors as a convex program: the door to cvxpy and Clarabel for identification."""

import warnings

import numpy as np
from jaxtyping import Float, Int

from koopmpc.errors import DataError
from koopmpc.identify.entries import Entries
from koopmpc.identify.prior import Combination, Prior, Storage
from koopmpc.identify.solve import Rows, norms


def optimum(
    rows: Rows, entries: Entries, which: Int[np.ndarray, " r"], ridge: float, prior: Prior | None
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
    problem = cp.Problem(cp.Minimize(misfit + ridge * cp.sum_squares(X)), bounds)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an inaccurate solution is said in the report
        try:
            problem.solve(
                solver=cp.CLARABEL, tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11, max_iter=200
            )
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
    """Return by how much the coupling priors are missed, in units of the regressors' sizes; 0 if they hold."""
    nz = len(A)
    worst = 0.0
    if prior.symmetric:
        worst = float(np.abs(A - A.T).max()) / max(float(np.abs(A).max()), 1e-300)
    for each in prior.combinations:
        value = sum(
            float(np.sum(w * m)) for w, m in ((each.A, A), (each.B, B)) if w is not None
        )  # the sum of weighted entries
        worst = max(worst, each.low - value, value - each.high)
    if prior.storage is not None:
        M = _dissipation(prior.storage, A, B, size[:nz], size[nz:], np.block)
        worst = max(worst, -float(np.linalg.eigvalsh(M)[0]))
    return worst


def _coupling(cp, prior: Prior, X, scale, size) -> list:
    nz = scale.shape[1]
    K = cp.multiply(scale, X)
    A, B = K[:nz].T, K[nz:].T
    found = []
    if prior.symmetric:
        W = scale[:nz].T
        balance = np.sqrt(W / W.T)
        S = cp.multiply(balance, X[:nz].T)
        found.append(cp.upper_tri(S) == cp.upper_tri(S.T))
    for each in prior.combinations:
        found += _limits(cp, each, A, B)
    if prior.storage is not None:
        M = _dissipation(prior.storage, A, B, size[:nz], size[nz:], cp.bmat)
        found.append(0.5 * (M + M.T) >> 0)
    return found


def _limits(cp, each: Combination, A, B) -> list:
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


def _dissipation(storage: Storage, A, B, size, force, block):
    """Return M ⪰ 0 ⇔ V(A z + B u) ≤ decay² V(z) + uᵀ(C z + D u): a Schur complement, P = LᵀL.

    z and u are taken in units of their sizes, V in units of its largest diagonal entry there.
    """
    values, vectors = np.linalg.eigh(storage.P)
    held = values > 1e-12 * max(values[-1], 0.0)
    L = np.sqrt(values[held])[:, None] * vectors[:, held].T
    unit = max(float((storage.P.diagonal() * size**2).max()), 1e-300) ** -0.5
    z, u = np.diag(size * unit), np.diag(force * unit)
    P = storage.decay**2 * z @ storage.P @ z
    LA = (L @ A) @ z
    if storage.C is None:
        return block([[P, LA.T], [LA, np.eye(len(L))]])
    D = np.zeros((len(force), len(force))) if storage.D is None else storage.D
    C, LB = u @ storage.C @ z, (L @ B) @ u
    return block([[P, C.T, LA.T], [C, u @ (D + D.T) @ u, LB.T], [LA, LB, np.eye(len(L))]])


def _ones(size: np.ndarray) -> np.ndarray:
    return np.where(size > 0, size, 1.0)
