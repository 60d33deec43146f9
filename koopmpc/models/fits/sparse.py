"""EDMD that keeps few observables, or few entries of A and B."""

from dataclasses import replace
from typing import Literal, Unpack

import numpy as np
from jaxtyping import Bool, Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.composed import Picked
from koopmpc.models.fits.constrained import solve_free_entries
from koopmpc.models.fits.prior import Entries
from koopmpc.models.moments.doubts import find_doubts
from koopmpc.models.moments.read import ReadOptions
from koopmpc.models.moments.solve import RegressionRows, column_norms, project_onto, solve
from koopmpc.models.predictors import LinearPredictor
from koopmpc.models.shared.regression import build_predictor, describe_misfit, read_regression

_STEPS = 20_000  # largest number of steps of the proximal gradient method


def lasso(
    G: Float[np.ndarray, "n n"],
    H: Float[np.ndarray, "n nt"],
    weights: Float[np.ndarray, "n nt"],
    *,
    grouped: bool,
    tolerance: float = 1e-10,
) -> tuple[Float[np.ndarray, "n nt"], float]:
    """Return argmin ½ tr KᵀGK − tr KᵀH + the penalty of K, by accelerated proximal gradient with restarts.

    G = PᵀP and H = PᵀT of regressors P and targets T. The penalty is the sum of `weights` ≥ 0 times |entries| of K; if
    `grouped`, it is that of the first column of `weights` times the Euclidean norms of K's rows, so that whole rows
    become zero. The second result is the largest violation of the optimality conditions, which is at most `tolerance`
    times the largest entry of H unless the steps ran out.

    References
    ----------
    Beck & Teboulle, "A fast iterative shrinkage-thresholding algorithm", SIAM J. Imaging Sci. 2, 2009; restart:
    O'Donoghue & Candès, Found. Comput. Math. 15, 2015; groups: Yuan & Lin, J. R. Stat. Soc. B 68, 2006.
    """
    K = np.zeros_like(H)
    step = 1.0 / max(float(np.linalg.eigvalsh(G)[-1]), 1e-300)
    enough = tolerance * max(float(np.abs(H).max()), 1e-300)
    ahead, momentum, missed = K, 1.0, np.inf
    for _ in range(_STEPS):
        new = _shrink(ahead - step * (G @ ahead - H), step * weights, grouped)
        missed = float(np.abs(new - ahead).max()) / step
        if missed <= enough:
            return new, missed
        if np.sum((ahead - new) * (new - K)) > 0:
            momentum = 1.0
        later = 0.5 * (1 + np.sqrt(1 + 4 * momentum**2))
        ahead = new + (momentum - 1) / later * (new - K)
        K, momentum = new, later
    return K, missed


def _shrink(K: Float[np.ndarray, "n nt"], by: Float[np.ndarray, "n nt"], grouped: bool) -> Float[np.ndarray, "n nt"]:
    """Return argmin ½ ‖X − K‖² + the penalty of X."""
    size = np.sqrt(np.sum(K**2, axis=1, keepdims=True)) if grouped else np.abs(K)
    least = by[:, :1] if grouped else by
    return K * np.maximum(1.0 - least / np.maximum(size, 1e-200), 0.0)


def sparse_edmd(
    episodes: Episodes | Source,
    lifting: Lifting,
    *,
    embedding: Delay | None = None,
    penalty: float = 1e-3,
    over: Literal["observables", "entries"] = "observables",
    adaptive: bool = True,
    **options: Unpack[ReadOptions],
) -> LinearPredictor:
    """Fit z⁺ = A z + B u + E w on those observables z of ψ that predict the states and each other.

    The set S of kept observables starts with the states and the Constant. On unit-norm columns and targets ½ ‖T_S − P
    K‖² + penalty Σⱼ wⱼ ‖kⱼ‖₂ is minimised over the coefficients K of ψ(x⁺)_S, where kⱼ are the coefficients of an
    observable j outside S. Observables with kⱼ ≠ 0 join S, and this repeats until none joins. A and B are then the
    plain least squares on S, without shrinkage. With over="entries" each entry has its own penalty, an observable joins
    S by any nonzero entry, and the least squares is over the nonzero entries.

    Parameters
    ----------
    episodes
        Episodes or a Source; no pair spans two of them.
    lifting
        ψ, the dictionary; it must hold the states.
    embedding
        ψ acts on the state and its past, for example ``Delay(2)``.
    penalty
        Above 0. With adaptive weights an observable stays out if it explains less than about this share of the
        targets' energy.
    over
        "observables" (group LASSO: few columns of A) or "entries" (LASSO: few numbers in A and B).
    adaptive
        Weigh each coefficient by 1 / |its value in a ridge fit|, where generalised cross-validation chooses the ridge.
        Large coefficients are then hardly shrunk, and with enough data the true set is found. If False, all weights
        are 1.
    **options
        ``weights``, ``workers``, ``scheduler`` and ``progress``, as in `km.moments.second_moments`.

    Raises
    ------
    DataError
        penalty is not above 0, or the lifting lacks a state.

    Warns
    -----
    FitWarning
        As `edmd`. ``report.changes`` names the dropped observables.

    References
    ----------
    Yuan & Lin, "Model selection and estimation in regression with grouped variables", J. R. Stat. Soc. B 68, 2006;
    Zou, "The adaptive lasso and its oracle properties", J. Am. Stat. Assoc. 101, 2006.
    """
    penalty = checks.positive(penalty, "penalty")
    if not checks.among(over, ("observables", "entries")):
        raise DataError(f'over is {over!r}; pass "observables" or "entries"')
    regression = read_regression(episodes, lifting, embedding, "sparse_edmd", **options)
    names, nz = regression.lifting.names, regression.lifting.nz
    missing = [state for state in regression.states if state not in names]
    if missing:
        raise DataError(f"the lifting lacks the state {missing[0]!r}; add State() to it")
    rows = regression.rows.keep_targets(nz)
    kept = np.array([name in regression.states for name in names])
    if regression.lifting.constant_index is not None:
        kept[regression.lifting.constant_index] = True
    used, missed = _grow_support(rows, kept, penalty, over == "entries", adaptive)
    stay = np.flatnonzero(kept)
    columns = np.concatenate([stay, np.arange(nz, len(used))])
    few = replace(rows.keep_regressors(columns), T=rows.T[:, stay], rest=rows.rest[stay])
    picked = Picked(regression.lifting, tuple(map(int, stay))).bind(regression.lifting.bound_states)
    sentences = find_doubts(few, picked.names, regression.inputs, regular=False)[0]
    if missed > 1e-6:
        sentences.append(
            f"the LASSO met its optimality conditions only to {missed:.1e}; raise the penalty, or drop observables "
            "that are almost functions of others"
        )
    known = np.where(used[np.ix_(columns, stay)], np.nan, 0.0).T
    K = solve_free_entries(few, Entries(known, np.full_like(known, -np.inf), np.full_like(known, np.inf)), 0.0)
    dropped = [names[int(i)] for i in np.flatnonzero(~kept)]
    plain = solve(rows).K[:, stay]
    whole = np.zeros((len(used), len(stay)))
    whole[columns] = K
    changes = [
        f"{len(dropped)} of {nz} observables dropped" + (f": {', '.join(dropped)}" if dropped else ""),
        f"{int(np.isnan(known).sum())} of {known.size} entries of [A B] are not zero",
        describe_misfit(RegressionRows(rows.P, few.T, few.rest, rows.samples), whole, plain),
    ]
    assert regression.C is not None, "an extended regression has its C"
    where = np.array([picked.names.index(state) for state in regression.states])
    part = replace(regression, rows=few, lifting=picked, C=regression.C[:, stay], x_next=where)
    rule = f"{'LASSO' if over == 'entries' else 'group LASSO'} with penalty {penalty:g}, then least squares"
    return build_predictor(part, K, rule=rule, doubts=sentences, changes=changes)


def _grow_support(
    rows: RegressionRows, kept: Bool[np.ndarray, " nz"], penalty: float, entries: bool, adaptive: bool
) -> tuple[Bool[np.ndarray, "n nz"], float]:
    """Grow `kept` in place until no observable joins; return the mask of nonzero coefficients and the worst violation.

    The violation is that of the optimality conditions of the LASSO.
    """
    nz, worst = len(kept), 0.0
    size, unit = column_norms(rows.P), np.sqrt(np.sum(rows.T**2, axis=0) + rows.rest)
    P, T = rows.P / np.where(size > 0, size, 1.0), rows.T / np.where(unit > 0, unit, 1.0)
    rest = rows.rest / np.where(unit > 0, unit, 1.0) ** 2
    while True:
        targets = np.flatnonzero(kept)
        penalized = np.ones(P.shape[1], dtype=bool)
        if not entries:
            penalized[nz:] = False
            penalized[targets] = False
        if not penalized.any():
            return np.ones((P.shape[1], nz), dtype=bool), worst
        regression = RegressionRows(P, T[:, targets], rest[targets], rows.samples, rows.constant)
        plain = np.abs(solve(regression, ridge="gcv").K[penalized])
        if not entries:
            plain = np.sqrt(np.sum(plain**2, axis=1, keepdims=True)) * np.ones_like(plain)
        weights = penalty / np.maximum(plain, 1e-12) if adaptive else np.full_like(plain, penalty)
        residual = P[:, penalized] - project_onto(P[:, ~penalized], P[:, penalized])
        K, missed = lasso(residual.T @ residual, residual.T @ T[:, targets], weights, grouped=not entries)
        worst = max(worst, missed)
        used = np.zeros((P.shape[1], nz), dtype=bool)
        used[np.ix_(~penalized, kept)] = True
        used[np.ix_(penalized, kept)] = K != 0
        joining = used[:nz].any(axis=1) & ~kept
        if not joining.any():
            return used, worst
        kept |= joining
