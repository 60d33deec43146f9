# pyright: basic
"""EDMD whose A has no eigenvalue beyond a circle."""

import warnings
from typing import Unpack

import numpy as np
from jaxtyping import Float, Int

from koopmpc import checks
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.identify.fits.contraction import Misfit, clipped, inside, nearest, radius_of
from koopmpc.identify.moments.read import ReadOptions
from koopmpc.identify.regression import Regression, growth, linear_predictor, read, relative_misfit, unreduced
from koopmpc.identify.solve import RegressionRows, Ridge, doubts, norms, onto, ridge_of, rule, solve
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.state import Constant
from koopmpc.predict.predictors import LinearPredictor

_LEAST = 1e-3  # of the mean eigenvalue of P


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


_SMALL = 20  # observables up to which the matrix inequality is solved too
_HELP = 1e-10  # ridge that helps the descent where columns are nearly dependent
_MUCH = 0.5  # relative misfit of a stable model that is hardly one of the data
_ROUNDING = 1e-9  # an eigenvalue this close to the circle is on it


def stable_edmd(
    episodes: Episodes | Source,
    lifting: Lifting,
    *,
    embedding: Delay | None = None,
    radius: float = 1.0,
    ridge: Ridge = 0.0,
    **options: Unpack[ReadOptions],
) -> LinearPredictor:
    """Fit ψ(x⁺) = A ψ(x) + B u + E w by least squares with every eigenvalue |λ(A)| ≤ radius.

    The misfit is Σᵢ ‖ψᵢ(x⁺) − …‖² / ‖ψᵢ(x)‖². Where the plain fit is stable it is the answer. Else B, E and the
    Constant's column are eliminated, so they are the best for the A that is found, and A is the best of: the plain
    fit with its eigenvalues clipped; for up to 20 observables a linear matrix inequality in (A P, P); and descent
    over A = S⁻¹ X S, ‖X‖₂ ≤ radius, from each of them. So it is stable, and at least as close as all of these. The
    problem is not convex: a closer stable A may exist. Where columns are nearly dependent and the ridge is below 1e-10,
    the answer for a ridge of 1e-10 is tried too, and the closer one taken.

    A Constant keeps its own row 1⁺ = 1 and its eigenvalue 1; the radius holds for the others.

    Parameters
    ----------
    episodes
        Episodes or a Source; no pair spans two of them.
    lifting
        ψ: R^nx → R^nz.
    embedding
        ψ acts on the state and its past, ``Delay(2)`` say.
    radius
        ρ > 0; below 1 it asks for a rate of decay.
    ridge
        Tikhonov weight on unit-norm columns; "gcv" chooses it for the plain fit.
    **options
        ``weights``, ``workers``, ``scheduler``, ``progress`` of `km.moments.second_moments`: who reads, w of each pair.

    Raises
    ------
    DataError
        radius is not above zero, ridge is negative, or an observable is not finite on the data.

    Warns
    -----
    FitWarning
        As `edmd`, and where stability leaves little of the model. ``report.changes`` tells the spectral radius, the
        misfit and each state's residual before and after: small residuals may grow much, for each observable counts
        relative to its own size.
    """
    rho, asked = checks.positive(radius, "radius"), ridge_of(ridge)
    regression = read(episodes, lifting, embedding, "stable_edmd", **options)
    nz, names = regression.lifting.nz, regression.lifting.names
    rows = regression.rows.leading(nz)
    sentences = doubts(rows, names, regression.inputs, regular=asked != 0)[0]
    plain = solve(rows, ridge=asked)
    K, weight = plain.K, plain.ridge
    one = Constant().bind(regression.states).names[0]
    moving = np.array([i for i, name in enumerate(names) if name != one], dtype=np.intp)
    if one in names:
        K[:, names.index(one)] = np.eye(len(K))[names.index(one)]
    before = radius_of(K[np.ix_(moving, moving)].T)
    changes = [f"spectral radius {before:.6g}, not above {rho:g}: the plain fit stays"]
    said = rule(rows, asked, weight)
    if before > rho + _ROUNDING:
        stable = _stabilised(rows, K, moving, rho, weight)
        after = radius_of(stable[np.ix_(moving, moving)].T)
        said = f"|λ| ≤ {rho:g} by descent over A = S⁻¹ X S, {said}"
        changes = [f"spectral radius {before:.6g} before, {after:.6g} after", growth(rows, stable, K)]
        changes += _losses(regression, K, stable)
        sentences += _doubt(relative_misfit(rows, K), relative_misfit(rows, stable))
        K = stable
    return linear_predictor(
        regression, unreduced(regression, K, rule=said, ridge=weight, doubts=sentences, changes=changes)
    )


def _doubt(before: float, after: float) -> list[str]:
    """Return a sentence where the stable model has little left of what the plain fit knew."""
    if after < max(_MUCH, 2 * before):
        return []
    return [
        f"stability costs much: the stable model misses {after:.0%} of the observables a step, the plain fit "
        f"{before:.2%}; pass a ridge, 1e-6 say, fewer observables or a larger radius"
    ]


def _losses(regression: Regression, plain: Float[np.ndarray, "n nz"], stable: Float[np.ndarray, "n nz"]) -> list[str]:
    """Return for each state what stability costs its one-step residual, in words."""
    pairs = zip(
        *(regression.rows.residual(regression.x_next, regression.decoded(K)) for K in (plain, stable)), strict=True
    )
    return [
        f"one-step residual of {name!r}: {before:.3g} before, {after:.3g} after"
        for name, (before, after) in zip(regression.states, pairs, strict=True)
    ]


def _stabilised(
    rows: RegressionRows, K: Float[np.ndarray, "n nz"], moving: Int[np.ndarray, " m"], rho: float, ridge: float
) -> Float[np.ndarray, "n nz"]:
    """Return K with a stable block of the `moving` observables; what multiplies the other columns is refitted."""
    n = len(K)
    size = norms(rows.P)
    size[size == 0] = 1.0
    others = np.setdiff1d(np.arange(n), moving)
    scale = size[moving] / size[moving, None]  # A in units of the observables' sizes

    def misfit(K: Float[np.ndarray, "n nz"], ridge: float) -> Misfit:
        P = np.vstack([rows.P / size, np.sqrt(ridge) * np.eye(n)])
        free = P[:, moving] - onto(P[:, others], P[:, moving])
        return Misfit(K[np.ix_(moving, moving)].T * scale, free.T @ free)

    asked = misfit(K, ridge)
    found = [_nearest(asked, rho)]
    if ridge < _HELP and np.linalg.cond(asked.G) > 1 / _HELP:  # too steep a valley for the descent
        found.append(_nearest(misfit(solve(rows, ridge=_HELP).K, _HELP), rho))
    choices = [_refitted(rows, K, moving, A / scale, rho, ridge) for A in found]
    return min(choices, key=lambda K: relative_misfit(rows, K))


def _nearest(misfit: Misfit, rho: float) -> Float[np.ndarray, "m m"]:
    """Return the stable A of the least misfit that the descent finds from all starts."""
    starts = [clipped(misfit.A0, rho)]
    if len(misfit.A0) <= _SMALL:
        start = lyapunov_fit(misfit.A0, misfit.G, rho)
        starts += [] if start is None else [inside(start, rho)]
    return nearest(misfit, rho, starts)


def _refitted(
    rows: RegressionRows,
    K: Float[np.ndarray, "n nz"],
    moving: Int[np.ndarray, " m"],
    A: Float[np.ndarray, "m m"],
    rho: float,
    ridge: float,
) -> Float[np.ndarray, "n nz"]:
    """Return K with A as the block of the `moving` observables, and what multiplies the others fitted to it."""
    others = np.setdiff1d(np.arange(len(K)), moving)
    found = K.copy()
    found[np.ix_(moving, moving)] = inside(A, rho).T
    if len(others):
        known = rows.P[:, moving] @ found[np.ix_(moving, moving)]
        rest = RegressionRows(rows.P[:, others], rows.T[:, moving] - known, rows.rest[moving], rows.samples)
        found[np.ix_(others, moving)] = solve(rest, ridge=ridge).K
    return found
