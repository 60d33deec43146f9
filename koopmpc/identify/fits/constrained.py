"""EDMD under priors: known entries by plain linear algebra, bounds and couplings by a convex program in CVXPY."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from typing import Any, Unpack

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csc_array

from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.errors import DataError
from koopmpc.identify.fits.prior import Combination, Dissipation, Entries, Prior, entries_of
from koopmpc.identify.moments.read import ReadOptions
from koopmpc.identify.regression import growth, linear_predictor, read, unreduced
from koopmpc.identify.solve import RegressionRows, Ridge, doubts, norms, ridge_of, rule, solve
from koopmpc.lifting.base import Lifting
from koopmpc.predict.predictors import LinearPredictor

_AT_BOUND = 1e-8  # distance of an entry from a bound that counts as none, on columns of unit norm: the solver's
_MET = 1e-10  # violation of a prior that counts as none, in units of the data


def constrained_edmd(
    episodes: Episodes | Source,
    lifting: Lifting,
    *,
    embedding: Delay | None = None,
    prior: Prior,
    ridge: Ridge = 0.0,
    **options: Unpack[ReadOptions],
) -> LinearPredictor:
    """Fit ψ(x⁺) = A ψ(x) + B u + E w by least squares among those A, B, E that meet the prior.

    The misfit is Σᵢ ‖ψᵢ(x⁺) − …‖² / ‖ψᵢ(x⁺)‖², each observable in units of its own size; this matters only where
    the prior couples the rows of A. Known entries and rows are solved by linear algebra, bounds by one QP a row,
    symmetry, combinations and dissipation by one program of all rows. A prior that the plain fit meets already does
    not change the fit.

    Parameters
    ----------
    episodes
        Episodes or a Source; no pair spans two of them.
    lifting
        ψ: R^nx → R^nz.
    embedding
        ψ acts on the state and its past, ``Delay(2)`` say.
    prior
        The known entries, bounds and couplings of A and B, in the order of the lifting's observables and the inputs.
    ridge
        Tikhonov weight as in `edmd`, on the free entries. In a row whose entry for the Constant is known, columns are
        not taken as deviations from their mean. "gcv" chooses the ridge for the fit without the prior.
    **options
        ``weights``, ``workers``, ``scheduler`` and ``progress``, as in `km.moments.second_moments`.

    Raises
    ------
    ShapeError, DataError
        The prior does not fit the lifting, contradicts itself, or cannot be met (with the solver's status).

    Warns
    -----
    FitWarning
        The free columns are dependent or ill-conditioned, or the solver met its tolerance only roughly.
    """
    asked = ridge_of(ridge)
    regression = read(episodes, lifting, embedding, "constrained_edmd", **options)
    nz, names = regression.lifting.nz, regression.lifting.names
    entries = entries_of(prior, names, regression.inputs)
    rows = regression.rows.leading(nz)
    sentences = _doubts(rows, entries, names, regression.inputs, regular=asked != 0)
    without = solve(rows, ridge=asked)
    K, statuses = _bounded(rows, entries, linear(rows, entries, without.ridge), without.ridge, prior)
    sentences += [
        f"the solver met its tolerance only roughly (status {status!r}); check the priors and the scales of the data"
        for status in sorted(statuses - {"optimal"})
    ]
    free = np.isnan(entries.known)
    size = norms(rows.P)
    near = _AT_BOUND * np.outer(norms(rows.T), 1 / np.where(size > 0, size, np.inf))
    active = free & ((entries.low >= K.T - near) | (entries.high <= K.T + near))
    changes = [f"{int((~free).sum())} of {free.size} entries of [A B] are known"] * bool((~free).any())
    changes += [f"{int(active.sum())} entries stand at a bound"] * bool(active.any())
    changes += [word for word, held in _COUPLINGS.items() if getattr(prior, held)]
    changes.append(growth(rows, K, without.K))
    said = f"{'Clarabel' if statuses else 'linear algebra'} under priors, {rule(rows, asked, without.ridge)}"
    return linear_predictor(
        regression, unreduced(regression, K, rule=said, ridge=without.ridge, doubts=sentences, changes=changes)
    )


_COUPLINGS = {
    "A is symmetric": "symmetric",
    "combinations of entries are limited": "combinations",
    "energy that is stored is dissipated as the prior says": "dissipation",
}


def _doubts(
    rows: RegressionRows, entries: Entries, names: tuple[str, ...], inputs: tuple[str, ...], *, regular: bool
) -> list[str]:
    """Return doubts about the columns that are free in at least one row of [A B]."""
    free, nz = np.isnan(entries.known).any(axis=0), len(names)
    which = np.flatnonzero(free)
    part = rows.part(which)
    observables = [names[int(j)] for j in which if j < nz]
    forces = [inputs[int(j) - nz] for j in which if j >= nz]
    return doubts(part, observables, forces, regular=regular)[0] if which.size else []


def linear(rows: RegressionRows, entries: Entries, ridge: float) -> Float[np.ndarray, "n nz"]:
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
            regression = replace(rows.part(np.flatnonzero(free)), T=rest, rest=rows.rest[targets])
            K[np.ix_(free, targets)] = solve(regression, ridge=ridge).K
    return K


def _bounded(
    rows: RegressionRows, entries: Entries, plain: Float[np.ndarray, "n nz"], ridge: float, prior: Prior
) -> tuple[Float[np.ndarray, "n nz"], set[str]]:
    """Return K within bounds and couplings, and the statuses of the programs that were solved."""
    nz = len(plain.T)
    limits = entries.low.T, entries.high.T
    inside = np.asarray(((plain >= limits[0]) & (plain <= limits[1])).all(axis=0))
    size = norms(rows.P) / np.sqrt(rows.samples)
    if prior.coupled:
        if inside.all() and violation(prior, plain[:nz].T, plain[nz:].T, size) <= _MET:
            return plain, set()
        K, status = optimum(rows, entries, np.arange(nz), ridge, prior)
        statuses = {status}
        if prior.symmetric:
            K[:nz] = 0.5 * (K[:nz] + K[:nz].T)
    else:
        K, statuses = plain.copy(), set[str]()
        for i in np.flatnonzero(~inside):
            K[:, i : i + 1], status = optimum(rows, entries, np.array([i]), ridge, None)
            statuses.add(status)
    K = np.clip(K, *limits)  # bounds hold to the last bit
    return np.where(np.isnan(entries.known.T), K, entries.known.T), statuses


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
    cp: Any = import_module("cvxpy")  # without types, and slow to import
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
    select: Any = csc_array((np.ones(count), (place, np.arange(count))), shape=(n * nz, count))
    fixed = np.where(free, 0.0, known / scale).ravel(order="F")
    X = cp.reshape(select @ x + fixed, (n, nz), order="F")
    misfit = cp.sum_squares((rows.P / size) @ X - rows.T[:, which] / unit)
    bounds: list[Any] = []
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
        value = sum(float(np.sum(w * m)) for w, m in ((each.A, A), (each.B, B)) if w is not None)
        worst = max(worst, each.low - value, value - each.high)
    if prior.dissipation is not None:
        M = _dissipation(prior.dissipation, A, B, size[:nz], size[nz:], np.block)
        worst = max(worst, -float(np.linalg.eigvalsh(M)[0]))
    return worst


def _coupling(
    cp: Any, prior: Prior, X: Any, scale: Float[np.ndarray, "n nz"], size: Float[np.ndarray, " n"]
) -> list[Any]:
    """Return the constraints that couple rows of [A B]: symmetry, combinations, dissipation."""
    nz = scale.shape[1]
    K = cp.multiply(scale, X)
    A, B = K[:nz].T, K[nz:].T
    constraints: list[Any] = []
    if prior.symmetric:
        W = scale[:nz].T
        S = cp.multiply(np.sqrt(W / W.T), X[:nz].T)  # A / √(W Wᵀ) entry by entry: symmetric where A is
        constraints.append(cp.upper_tri(S) == cp.upper_tri(S.T))
    for each in prior.combinations:
        constraints += _limits(cp, each, A, B)
    if prior.dissipation is not None:
        M = _dissipation(prior.dissipation, A, B, size[:nz], size[nz:], cp.bmat)
        constraints.append(0.5 * (M + M.T) >> 0)
    return constraints


def _limits(cp: Any, each: Combination, A: Any, B: Any) -> list[Any]:
    """Return the constraints low ≤ Σ Fᵢⱼ Aᵢⱼ + Σ Gᵢⱼ Bᵢⱼ ≤ high."""
    total: Any = 0
    for weights, matrix in ((each.A, A), (each.B, B)):
        if weights is not None and weights.size:
            total = total + cp.sum(cp.multiply(weights, matrix))
    if each.low == each.high:
        return [total == each.low]
    ends: list[Any] = []
    if np.isfinite(each.low):
        ends.append(total >= each.low)
    if np.isfinite(each.high):
        ends.append(total <= each.high)
    return ends


def _dissipation(
    dissipation: Dissipation,
    A: Any,
    B: Any,
    size: Float[np.ndarray, " nz"],
    force: Float[np.ndarray, " nu"],
    block: Callable[[list[list[Any]]], Any],
) -> Any:
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
