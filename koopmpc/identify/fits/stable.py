"""EDMD whose A has no eigenvalue outside a circle about zero."""

import warnings
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any, Unpack

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import solve_discrete_lyapunov

from koopmpc import checks
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.identify.moments.read import ReadOptions
from koopmpc.identify.regression import Regression, growth, linear_predictor, read, relative_misfit, unreduced
from koopmpc.identify.solve import RegressionRows, Ridge, doubts, norms, onto, ridge_of, rule, solve
from koopmpc.lifting.base import Lifting
from koopmpc.predict.predictors import LinearPredictor

_SMALL = 20  # observables up to which the matrix inequality is solved too
_LEAST = 1e-3  # least eigenvalue of P in that inequality, as a share of the mean one
_HELP = 1e-10  # ridge that helps the descent where columns are nearly dependent
_MUCH = 0.5  # relative misfit from which a stable model describes the data hardly at all
_ROUNDING = 1e-9  # an eigenvalue this close to the circle is on it
# Margins of the metric of a start, as shares of the radius: a small one is closer to the start, a large one gives a
# better conditioned metric.
_MARGINS = (1e-3, 1e-2, 1e-1)
_TRIAL, _STEPS = 60, 600  # descent steps from each start, and then from the best of them
_STALL, _GAIN = 30, 1e-3  # the descent stops where 30 steps reduce the misfit by less than this share


@dataclass(frozen=True, eq=False)
class Misfit:
    """f(A) = tr (A − A₀) G (A − A₀)ᵀ."""

    A0: Float[np.ndarray, "n n"]
    G: Float[np.ndarray, "n n"]

    def __call__(self, A: Float[np.ndarray, "n n"]) -> float:
        """Return the misfit f(A) of A, (n, n)."""
        error = A - self.A0
        return float(np.sum((error @ self.G) * error))


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

    The misfit is Σᵢ ‖ψᵢ(x⁺) − …‖² / ‖ψᵢ(x)‖². A plain fit that is stable is the answer. Otherwise B, E and the
    Constant's column are eliminated, so that they are optimal for the chosen A, and A is the best of three candidates:
    the plain fit with its eigenvalues clipped; for up to 20 observables, the solution of a linear matrix inequality in
    (A P, P); and the results of descent over A = S⁻¹ X S, ‖X‖₂ ≤ radius, from both. The problem is not convex: a closer
    stable A may exist. Where columns are nearly dependent and the ridge is below 1e-10, the answer for a ridge of 1e-10
    is computed too, and the closer of the two is taken.

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
        Tikhonov weight as in `edmd`; "gcv" chooses it for the plain fit.
    **options
        ``weights``, ``workers``, ``scheduler`` and ``progress``, as in `km.moments.second_moments`.

    Raises
    ------
    DataError
        radius is not above zero, ridge is negative, or an observable is not finite on the data.

    Warns
    -----
    FitWarning
        As `edmd`, and where stability costs much accuracy. ``report.changes`` tells the spectral radius, the misfit
        and the residual of each state before and after; a small residual may grow much, because each observable counts
        relative to its own size.
    """
    rho, asked = checks.positive(radius, "radius"), ridge_of(ridge)
    regression = read(episodes, lifting, embedding, "stable_edmd", **options)
    nz, names = regression.lifting.nz, regression.lifting.names
    rows = regression.rows.leading(nz)
    sentences = doubts(rows, names, regression.inputs, regular=asked != 0)[0]
    plain = solve(rows, ridge=asked)
    K, weight = plain.K, plain.ridge
    one = regression.lifting.constant_index
    moving = np.array([i for i in range(nz) if i != one], dtype=np.intp)
    if one is not None:
        K[:, one] = np.eye(len(K))[one]
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
    """Return a warning where the stable model misses much more than the plain fit does, else an empty list."""
    if after < max(_MUCH, 2 * before):
        return []
    return [
        f"stability costs much: the stable model misses {after:.0%} of the observables a step, the plain fit "
        f"{before:.2%}; pass a ridge, 1e-6 say, fewer observables or a larger radius"
    ]


def _losses(regression: Regression, plain: Float[np.ndarray, "n nz"], stable: Float[np.ndarray, "n nz"]) -> list[str]:
    """Return a sentence for each state: its one-step residual in the plain and in the stable model."""
    losses = (regression.rows.residual(regression.x_next, regression.decoded(K)) for K in (plain, stable))
    return [
        f"one-step residual of {name!r}: {before:.3g} before, {after:.3g} after"
        for name, before, after in zip(regression.states, *losses, strict=True)
    ]


def _stabilised(
    rows: RegressionRows, K: Float[np.ndarray, "n nz"], moving: Int[np.ndarray, " m"], rho: float, ridge: float
) -> Float[np.ndarray, "n nz"]:
    """Return K with a stable block of the `moving` observables; the coefficients of all other columns are refitted."""
    n = len(K)
    size, spread = norms(rows.P), norms(rows.centred().P)
    size[size == 0] = 1.0
    others = np.setdiff1d(np.arange(n), moving)
    scale = size[moving] / size[moving, None]  # A in units of the observables' sizes

    def misfit(K: Float[np.ndarray, "n nz"], ridge: float) -> Misfit:
        P = np.vstack([rows.P / size, np.sqrt(ridge) * np.diag(spread / size)])
        free = P[:, moving] - onto(P[:, others], P[:, moving])
        return Misfit(K[np.ix_(moving, moving)].T * scale, free.T @ free)

    asked = misfit(K, ridge)
    candidates = [_nearest(asked, rho)]
    if ridge < _HELP and np.linalg.cond(asked.G) > 1 / _HELP:  # the misfit is too steep a valley for the descent
        candidates.append(_nearest(misfit(solve(rows, ridge=_HELP).K, _HELP), rho))
    choices = [_refitted(rows, K, moving, A / scale, rho, ridge) for A in candidates]
    return min(choices, key=lambda K: relative_misfit(rows, K))


def _nearest(misfit: Misfit, rho: float) -> Float[np.ndarray, "m m"]:
    """Return the stable A with the smallest misfit that the descent finds from any of its starts."""
    starts = [clipped(misfit.A0, rho)]
    if len(misfit.A0) <= _SMALL:
        start = lyapunov_fit(misfit.A0, misfit.G, rho)
        starts += [] if start is None else [inside(start, rho)]
    return nearest(misfit, rho, starts)


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
    cp: Any = import_module("cvxpy")  # without types, and slow to import
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


def _refitted(
    rows: RegressionRows,
    K: Float[np.ndarray, "n nz"],
    moving: Int[np.ndarray, " m"],
    A: Float[np.ndarray, "m m"],
    rho: float,
    ridge: float,
) -> Float[np.ndarray, "n nz"]:
    """Return K with A as the block of the `moving` observables; the coefficients of the others are fitted to it."""
    others = np.setdiff1d(np.arange(len(K)), moving)
    fitted = K.copy()
    fitted[np.ix_(moving, moving)] = inside(A, rho).T
    if len(others):
        known = rows.P[:, moving] @ fitted[np.ix_(moving, moving)]
        rest = replace(rows.part(others), T=rows.T[:, moving] - known, rest=rows.rest[moving])
        fitted[np.ix_(others, moving)] = solve(rest, ridge=ridge).K
    return fitted


def radius_of(A: Float[np.ndarray, "n n"]) -> float:
    """Return the spectral radius, 0 for an empty matrix."""
    return float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))


def clipped(A: Float[np.ndarray, "n n"], radius: float) -> Float[np.ndarray, "n n"]:
    """Return A with its eigenvalues outside the circle moved onto it; A ρ / |λ|max where A is nearly defective."""
    result = np.linalg.eig(A)
    values, V = np.asarray(result.eigenvalues), np.asarray(result.eigenvectors)
    size = np.abs(values)
    if np.linalg.cond(V) < 1e8:
        kept = np.where(size > radius, values * radius / np.where(size > 0, size, 1.0), values)
        return np.ascontiguousarray(((V * kept) @ np.linalg.inv(V)).real)
    return A * (radius / size.max())


def nearest(misfit: Misfit, radius: float, starts: list[Float[np.ndarray, "n n"]]) -> Float[np.ndarray, "n n"]:
    """Return A with |λ(A)| ≤ radius and f(A) no larger than at any start.

    A matrix is stable exactly if some S makes S A S⁻¹ a contraction, so projected gradient steps with momentum
    (restarted where f would rise) move S and X = S A S⁻¹, X clipped to ‖X‖₂ ≤ radius by its singular values. The
    problem is not convex: the result is the best of several starts, and a local optimum.

    References
    ----------
    Gillis, Karow & Sharma, "Approximating the nearest stable discrete-time system", Linear Algebra Appl. 573, 2019;
    with data: Mamakoukas, Xherija & Murphey, "Memory-efficient learning of stable linear dynamical systems for
    prediction and control", NeurIPS 2020.
    """
    n = len(misfit.A0)
    runs = [_Descent(misfit, radius, np.eye(n), misfit.A0)]
    for start in starts:
        S = _metric(start, radius)
        runs.append(_Descent(misfit, radius, S, S @ start @ np.linalg.inv(S)))
    for run in runs:
        run.go(_TRIAL)
    best = min(runs, key=lambda run: run.value)
    best.go(_STEPS)
    candidates = [inside(A, radius) for A in (best.A, *starts)]
    return min(candidates, key=misfit)


def inside(A: Float[np.ndarray, "n n"], radius: float) -> Float[np.ndarray, "n n"]:
    """Return A, scaled down until no eigenvalue lies outside the circle, not even by rounding."""
    for _ in range(5):
        size = radius_of(A)
        if size <= radius:
            break
        A = A * (radius / size * (1 - 1e-15))
    return A


class _Descent:
    """Projected gradient descent with momentum on (S, X); the misfit `value` never rises."""

    def __init__(self, misfit: Misfit, radius: float, S: Float[np.ndarray, "n n"], X: Float[np.ndarray, "n n"]) -> None:
        self._misfit, self._radius = misfit, radius
        self._S, self._X = S, _ball(X, radius)
        self._old = self._S, self._X
        self._momentum = 1.0
        self.A = np.linalg.solve(S, self._X @ S)
        self.value = misfit(self.A)
        largest = float(np.linalg.eigvalsh(misfit.G)[-1])
        self._step = 0.5 / max(largest * float(np.linalg.cond(S)) ** 2, 1e-300)

    def go(self, steps: int) -> None:
        """Take at most `steps` steps; stop earlier where the misfit stalls."""
        history = [self.value]
        for _ in range(steps):
            if not self._advance():
                return
            history.append(self.value)
            if len(history) > _STALL and history[-_STALL] - self.value <= _GAIN * self.value:
                return

    def _advance(self) -> bool:
        ahead = 0.5 * (1 + np.sqrt(1 + 4 * self._momentum**2))
        beta = (self._momentum - 1) / ahead
        S, X = (now + beta * (now - old) for now, old in zip((self._S, self._X), self._old, strict=True))
        if self._try(S, X):
            self._momentum, self._step = ahead, 1.1 * self._step
            return True
        self._momentum = 1.0
        for _ in range(40):
            if self._try(self._S, self._X):
                return True
            self._step /= 2
        return False

    def _try(self, S: Float[np.ndarray, "n n"], X: Float[np.ndarray, "n n"]) -> bool:
        """Take a step from (S, X); keep it and return True where f falls, else return False."""
        inverse = np.linalg.inv(S)
        A = inverse @ X @ S
        slope = inverse.T @ (2 * (A - self._misfit.A0) @ self._misfit.G)
        S_new = S - self._step * (X.T @ slope - slope @ A.T)
        X_new = _ball(X - self._step * slope @ S.T, self._radius)
        A_new = np.linalg.solve(S_new, X_new @ S_new)
        value = self._misfit(A_new)
        if not value < self.value:
            return False
        self._old = self._S, self._X
        self._S, self._X, self.A, self.value = S_new, X_new, A_new, value
        return True


def _ball(X: Float[np.ndarray, "n n"], radius: float) -> Float[np.ndarray, "n n"]:
    """Return the nearest matrix with ‖X‖₂ ≤ radius; only singular values above it are needed."""
    values, V = np.linalg.eigh(X.T @ X)
    large = values > radius**2
    W = V[:, large]
    return X - (X @ W) * (1 - radius / np.sqrt(values[large])) @ W.T


def _metric(A: Float[np.ndarray, "n n"], radius: float) -> Float[np.ndarray, "n n"]:
    """Return S = P^½, AᵀP A ⪯ (ρ (1 + margin))² P, with the least margin that leaves P well conditioned."""
    S = np.eye(len(A))
    for margin in _MARGINS:
        P = solve_discrete_lyapunov((A / (radius * (1 + margin))).T, np.eye(len(A)))
        values, vectors = np.linalg.eigh(0.5 * (P + P.T))
        if values[0] > 0 and values[-1] < 1e6 * values[0]:
            return (vectors * np.sqrt(values / values[0])) @ vectors.T
    return S
