"""EDMD under priors: known entries by plain linear algebra, bounds and couplings by a convex program in CVXPY."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from typing import Any, Unpack

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_array

from koopmpc.base.errors import DataError
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.lifting.base import Lifting
from koopmpc.models.fits.prior import Combination, Dissipation, Entries, Prior, build_entries
from koopmpc.models.moments.doubts import find_doubts
from koopmpc.models.moments.read import ReadOptions
from koopmpc.models.moments.solve import RegressionRows, Ridge, check_ridge, column_norms, describe_solve, solve
from koopmpc.models.predictors import LinearPredictor
from koopmpc.models.shared.regression import build_predictor, describe_misfit, read_regression

_AT_BOUND = 1e-8  # an entry is at its bound within this distance, the solver's accuracy on columns of unit norm
_MET = 1e-10  # the plain fit meets the prior if it violates it by at most this, in units of the data


def constrained_edmd(
    episodes: Episodes | Source,
    lifting: Lifting,
    *,
    embedding: Delay | None = None,
    prior: Prior,
    ridge: Ridge = 0.0,
    **options: Unpack[ReadOptions],
) -> LinearPredictor:
    """Fit ψ(x⁺) = A ψ(x) + B u + E w by least squares over the A, B, E that meet the prior.

    The misfit is Σᵢ ‖ψᵢ(x⁺) − …‖² / ‖ψᵢ(x⁺)‖², each observable in units of its own size; this matters only if the
    prior couples the rows of A. Known entries and rows need linear algebra alone, bounds one QP a row. Symmetry,
    combinations and dissipation need one convex program for all rows. If the plain fit meets the prior, it is the
    result.

    Parameters
    ----------
    episodes
        Episodes or a Source; no pair spans two of them.
    lifting
        ψ: R^nx → R^nz.
    embedding
        ψ acts on the state and its past, for example ``Delay(2)``.
    prior
        The known entries, bounds and couplings of A and B, in the order of the lifting's observables and the inputs.
    ridge
        Tikhonov weight as in `edmd`, on the free entries. In a row whose entry for the Constant is known, it does not
        act on deviations from the mean. "gcv" chooses the ridge for the fit without the prior.
    **options
        ``weights``, ``workers``, ``scheduler`` and ``progress``, as in `km.moments.second_moments`.

    Raises
    ------
    ShapeError, DataError
        The prior does not fit the lifting, contradicts itself, or cannot be met; the message has the solver's status.

    Warns
    -----
    FitWarning
        The free columns are dependent or ill-conditioned, or the solver met its tolerance only roughly.
    """
    ridge = check_ridge(ridge)
    regression = read_regression(episodes, lifting, embedding, "constrained_edmd", **options)
    nz, names = regression.lifting.nz, regression.lifting.names
    entries = build_entries(prior, names, regression.inputs)
    rows = regression.rows.keep_targets(nz)
    sentences = _find_doubts(rows, entries, names, regression.inputs, regular=ridge != 0)
    plain = solve(rows, ridge=ridge)
    K, statuses = _solve_within_bounds(
        rows, entries, solve_free_entries(rows, entries, plain.ridge), plain.ridge, prior
    )
    sentences += [
        f"the solver met its tolerance only roughly (status {status!r}); check the priors and the scales of the data"
        for status in sorted(statuses - {"optimal"})
    ]
    free = np.isnan(entries.known)
    size = column_norms(rows.P)
    near = _AT_BOUND * np.outer(column_norms(rows.T), 1 / np.where(size > 0, size, np.inf))
    active = free & ((entries.low >= K.T - near) | (entries.high <= K.T + near))
    changes = [f"{int((~free).sum())} of {free.size} entries of [A B] are known"] * bool((~free).any())
    changes += [f"{int(active.sum())} entries stand at a bound"] * bool(active.any())
    changes += [sentence for sentence, field in _COUPLINGS.items() if getattr(prior, field)]
    changes.append(describe_misfit(rows, K, plain.K))
    rule = f"{'Clarabel' if statuses else 'linear algebra'} under priors, {describe_solve(rows, ridge, plain.ridge)}"
    return build_predictor(regression, K, rule=rule, ridge=plain.ridge, doubts=sentences, changes=changes)


_COUPLINGS = {
    "A is symmetric": "symmetric",
    "combinations of entries are limited": "combinations",
    "energy that is stored is dissipated as the prior says": "dissipation",
}


def _find_doubts(
    rows: RegressionRows, entries: Entries, names: tuple[str, ...], inputs: tuple[str, ...], *, regular: bool
) -> list[str]:
    """Return doubts about the columns that are free in at least one row of [A B]."""
    free, nz = np.isnan(entries.known).any(axis=0), len(names)
    which = np.flatnonzero(free)
    part = rows.keep_regressors(which)
    observables = [names[int(j)] for j in which if j < nz]
    forces = [inputs[int(j) - nz] for j in which if j >= nz]
    return find_doubts(part, observables, forces, regular=regular)[0] if which.size else []


def solve_free_entries(rows: RegressionRows, entries: Entries, ridge: float) -> Float[np.ndarray, "n nz"]:
    """Return K of least squares over the free entries; rows of [A B] with the same free entries are solved together."""
    known = entries.known
    K = np.where(np.isnan(known), 0.0, known).T
    patterns: dict[bytes, list[int]] = {}
    for i, row in enumerate(np.isnan(known)):
        patterns.setdefault(row.tobytes(), []).append(i)
    for targets in patterns.values():
        free = np.isnan(known[targets[0]])
        if free.any():
            rest = rows.T[:, targets] - rows.P @ K[:, targets]
            regression = replace(rows.keep_regressors(np.flatnonzero(free)), T=rest, rest=rows.rest[targets])
            K[np.ix_(free, targets)] = solve(regression, ridge=ridge).K
    return K


def _solve_within_bounds(
    rows: RegressionRows, entries: Entries, plain: Float[np.ndarray, "n nz"], ridge: float, prior: Prior
) -> tuple[Float[np.ndarray, "n nz"], set[str]]:
    """Return K that meets bounds and couplings, and the solver's statuses."""
    nz = len(plain.T)
    limits = entries.low.T, entries.high.T
    inside = np.asarray(((plain >= limits[0]) & (plain <= limits[1])).all(axis=0))
    size = column_norms(rows.P) / np.sqrt(rows.samples)
    if prior.couples_rows:
        if inside.all() and largest_violation(prior, plain[:nz].T, plain[nz:].T, size) <= _MET:
            return plain, set()
        K, status = solve_convex_program(rows, entries, np.arange(nz), ridge, prior)
        statuses = {status}
        if prior.symmetric:
            K[:nz] = 0.5 * (K[:nz] + K[:nz].T)
    else:
        K, statuses = plain.copy(), set[str]()
        for i in np.flatnonzero(~inside):
            K[:, i : i + 1], status = solve_convex_program(rows, entries, np.array([i]), ridge, None)
            statuses.add(status)
    K = np.clip(K, *limits)  # the solver may miss a bound by its tolerance
    return np.where(np.isnan(entries.known.T), K, entries.known.T), statuses


def solve_convex_program(
    rows: RegressionRows, entries: Entries, which: Int[np.ndarray, " r"], ridge: float, prior: Prior | None
) -> tuple[Float[np.ndarray, "n r"], str]:
    """Return K = argmin Σᵢ ‖tᵢ − P kᵢ‖² / ‖tᵢ‖² (+ ridge) over the targets `which`, and the solver's status.

    Columns of P and targets have unit norm in the program, so the units of the data do not matter. `prior` adds the
    constraints that couple rows of [A B]; the targets must then be all observables.
    """
    cp: Any = import_module("cvxpy")  # without types, and slow to import
    n, nz = rows.P.shape[1], len(which)
    size = _replace_zeros(column_norms(rows.P))
    energy = np.sum(rows.T[:, which] ** 2, axis=0) + rows.rest[which]
    unit = _replace_zeros(np.sqrt(energy))
    scale = unit / size[:, None]  # K = X · scale
    known = entries.known[which].T
    free = np.isnan(known)
    count = int(free.sum())
    x = cp.Variable(count)
    place = np.flatnonzero(free.ravel(order="F"))
    select: Any = csc_array((np.ones(count), (place, np.arange(count))), shape=(n * nz, count))
    fixed = np.where(free, 0.0, known / scale).ravel(order="F")
    X = cp.reshape(select @ x + fixed, (n, nz), order="F")
    misfit = cp.sum_squares((rows.P / size) @ X - rows.T[:, which] / unit)
    bounds: list[Any] = []
    for limit, sign in ((entries.low, -1.0), (entries.high, 1.0)):
        values = (limit[which].T / scale).ravel(order="F")[place]
        finite = np.flatnonzero(np.isfinite(values))
        if finite.size:
            bounds.append(sign * x[finite] <= sign * values[finite])
    if prior is not None:
        bounds += _build_couplings(cp, prior, X, scale, size / np.sqrt(rows.samples))
    weight = np.ones((n, nz))  # if a target's intercept is free, the ridge acts on deviations from the mean
    if rows.constant is not None:
        weight[:, free[rows.constant]] = (column_norms(rows.subtract_means().P) / size)[:, None]
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


def largest_violation(
    prior: Prior, A: Float[np.ndarray, "nz nz"], B: Float[np.ndarray, "nz nu"], size: Float[np.ndarray, " n"]
) -> float:
    """Return the largest violation of the coupling priors, in units of the regressors' sizes; 0 if all hold."""
    nz = len(A)
    worst = 0.0
    if prior.symmetric:
        worst = float(np.abs(A - A.T).max()) / max(float(np.abs(A).max()), 1e-300)
    for combination in prior.combinations:
        pairs = ((combination.A, A), (combination.B, B))
        value = sum(float(np.sum(np.asarray(weights) * matrix)) for weights, matrix in pairs if weights is not None)
        worst = max(worst, combination.low - value, value - combination.high)
    if prior.dissipation is not None:
        M = _dissipation_matrix(prior.dissipation, A, B, size[:nz], size[nz:], np.block)
        worst = max(worst, -float(np.linalg.eigvalsh(M)[0]))
    return worst


def _build_couplings(
    cp: Any, prior: Prior, X: Any, scale: Float[np.ndarray, "n nz"], size: Float[np.ndarray, " n"]
) -> list[Any]:
    """Return the constraints that couple rows of [A B]: symmetry, combinations, dissipation."""
    nz = scale.shape[1]
    K = cp.multiply(scale, X)
    A, B = K[:nz].T, K[nz:].T
    constraints: list[Any] = []
    if prior.symmetric:
        W = scale[:nz].T
        S = cp.multiply(np.sqrt(W / W.T), X[:nz].T)  # A / √(W Wᵀ) entry by entry: symmetric if A is
        constraints.append(cp.upper_tri(S) == cp.upper_tri(S.T))
    for combination in prior.combinations:
        constraints += _build_limits(cp, combination, A, B)
    if prior.dissipation is not None:
        M = _dissipation_matrix(prior.dissipation, A, B, size[:nz], size[nz:], cp.bmat)
        constraints.append(0.5 * (M + M.T) >> 0)
    return constraints


def _build_limits(cp: Any, combination: Combination, A: Any, B: Any) -> list[Any]:
    """Return the constraints low ≤ Σ Fᵢⱼ Aᵢⱼ + Σ Gᵢⱼ Bᵢⱼ ≤ high."""
    total: Any = 0
    for weights, matrix in ((combination.A, A), (combination.B, B)):
        if weights is not None and np.size(weights):
            total = total + cp.sum(cp.multiply(weights, matrix))
    if combination.low == combination.high:
        return [total == combination.low]
    constraints: list[Any] = []
    if np.isfinite(combination.low):
        constraints.append(total >= combination.low)
    if np.isfinite(combination.high):
        constraints.append(total <= combination.high)
    return constraints


def _dissipation_matrix(
    dissipation: Dissipation,
    A: Any,
    B: Any,
    size: Float[np.ndarray, " nz"],
    force: Float[np.ndarray, " nu"],
    block: Callable[[list[list[Any]]], Any],
) -> Any:
    """Return M ⪰ 0 ⇔ V(A z + B u) ≤ decay² V(z) + uᵀ(C z + D u): a Schur complement, P = LᵀL.

    z and u are scaled by their sizes, and V by the largest diagonal entry of the scaled P.
    """
    stored = np.asarray(dissipation.P, dtype=np.float64)
    values, vectors = np.linalg.eigh(stored)
    positive = values > 1e-12 * values[-1]
    L = np.sqrt(values[positive])[:, None] * vectors[:, positive].T
    unit = max(float((stored.diagonal() * size**2).max()), 1e-300) ** -0.5
    z, u = np.diag(size * unit), np.diag(force * unit)
    P = dissipation.decay**2 * z @ stored @ z
    LA = (L @ A) @ z
    if dissipation.C is None:
        return block([[P, LA.T], [LA, np.eye(len(L))]])
    D = np.zeros((len(force), len(force))) if dissipation.D is None else np.asarray(dissipation.D)
    C, LB = u @ np.asarray(dissipation.C) @ z, (L @ B) @ u
    return block([[P, C.T, LA.T], [C, u @ (D + D.T) @ u, LB.T], [LA, LB, np.eye(len(L))]])


def _replace_zeros(size: np.ndarray) -> np.ndarray:
    """Return the sizes, with 1 in place of 0."""
    return np.where(size > 0, size, 1.0)
