"""EDMD under priors: known entries by plain linear algebra, bounds and couplings by a convex program."""

from dataclasses import replace
from typing import Unpack

import numpy as np
from jaxtyping import Float

from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.identify.constrained.convex import optimum, violation
from koopmpc.identify.constrained.prior import Entries, Prior, entries_of
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
