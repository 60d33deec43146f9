"""EDMD with all eigenvalues of A inside a circle about zero."""

import warnings
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any, Unpack

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import solve_discrete_lyapunov

from koopmpc.base import checks
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.lifting.base import Lifting
from koopmpc.models.moments.doubts import find_doubts
from koopmpc.models.moments.read import ReadOptions
from koopmpc.models.moments.solve import (
    RegressionRows,
    Ridge,
    check_ridge,
    column_norms,
    describe_solve,
    project_onto,
    solve,
)
from koopmpc.models.predictors import LinearPredictor
from koopmpc.models.shared.regression import (
    Regression,
    build_predictor,
    describe_misfit,
    read_regression,
    relative_misfit,
)


@dataclass(frozen=True)
class _Limits:
    """Settings of the search for a stable model."""

    small: int = 20  # solve the matrix inequality too for at most so many observables
    least: float = 1e-3  # smallest eigenvalue of P in that inequality, as a share of the mean eigenvalue
    help: float = 1e-10  # second ridge to try if columns are nearly dependent: the descent then converges
    much: float = 0.5  # warn if the relative misfit of the stable model is above this: it hardly describes the data
    rounding: float = 1e-9  # a plain fit is stable if its spectral radius exceeds the radius by at most this
    # margins of a start's metric, shares of the radius: the first well conditioned one
    margins: tuple[float, ...] = (1e-3, 1e-2, 1e-1)
    trial: int = 60  # descent steps from each start
    steps: int = 600  # further descent steps from the best of these runs
    stall: int = 30  # stop the descent if so many steps …
    gain: float = 1e-3  # … reduce the misfit by less than this share


_LIMITS = _Limits()


@dataclass(frozen=True, eq=False)
class Misfit:
    """The misfit f(A) = tr (A − A₀) G (A − A₀)ᵀ."""

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

    The misfit is Σᵢ ‖ψᵢ(x⁺) − …‖² / ‖ψᵢ(x)‖². If the plain fit is stable, it is the result. Otherwise B, E and the
    column of the Constant are eliminated, so that they are optimal for the chosen A. A is then the best of these
    candidates: the plain fit with clipped eigenvalues; for up to 20 observables, the solution of a linear matrix
    inequality in (A P, P); and the results of descent over A = S⁻¹ X S, ‖X‖₂ ≤ radius, from both. The problem is not
    convex, so a closer stable A may exist. If columns are nearly dependent and the ridge is below 1e-10, the same is
    done with a ridge of 1e-10, and the closer result is used.

    A Constant keeps its own row 1⁺ = 1 and its eigenvalue 1; the radius limits the other eigenvalues.

    Parameters
    ----------
    episodes
        Episodes or a Source; no pair spans two of them.
    lifting
        ψ: R^nx → R^nz.
    embedding
        ψ acts on the state and its past, for example ``Delay(2)``.
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
        As `edmd`, and if stability costs much accuracy. ``report.changes`` gives the spectral radius, the misfit and
        the residual of each state before and after. A small residual may grow by a large factor, because each
        observable counts relative to its own size.
    """
    rho, ridge = checks.positive(radius, "radius"), check_ridge(ridge)
    regression = read_regression(episodes, lifting, embedding, "stable_edmd", **options)
    nz, names = regression.lifting.nz, regression.lifting.names
    rows = regression.rows.keep_targets(nz)
    sentences = find_doubts(rows, names, regression.inputs, regular=ridge != 0)[0]
    plain = solve(rows, ridge=ridge)
    K, weight = plain.K, plain.ridge
    constant = regression.lifting.constant_index
    moving = np.array([i for i in range(nz) if i != constant], dtype=np.intp)
    if constant is not None:
        K[:, constant] = np.eye(len(K))[constant]
    before = spectral_radius(K[np.ix_(moving, moving)].T)
    changes = [f"spectral radius {before:.6g}, not above {rho:g}: the plain fit stays"]
    rule = describe_solve(rows, ridge, weight)
    if before > rho + _LIMITS.rounding:
        stable = _stabilise(rows, K, moving, rho, weight)
        after = spectral_radius(stable[np.ix_(moving, moving)].T)
        rule = f"|λ| ≤ {rho:g} by descent over A = S⁻¹ X S, {rule}"
        changes = [f"spectral radius {before:.6g} before, {after:.6g} after", describe_misfit(rows, stable, K)]
        changes += _compare_residuals(regression, K, stable)
        sentences += _doubt_misfit(relative_misfit(rows, K), relative_misfit(rows, stable))
        K = stable
    return build_predictor(regression, K, rule=rule, ridge=weight, doubts=sentences, changes=changes)


def _doubt_misfit(before: float, after: float) -> list[str]:
    """Return a warning if the stable model misses the data much more than the plain fit does, else an empty list."""
    if after < max(_LIMITS.much, 2 * before):
        return []
    return [
        f"stability costs much: the stable model misses {after:.0%} of the observables a step, the plain fit "
        f"{before:.2%}; pass a ridge such as 1e-6, fewer observables or a larger radius"
    ]


def _compare_residuals(
    regression: Regression, plain: Float[np.ndarray, "n nz"], stable: Float[np.ndarray, "n nz"]
) -> list[str]:
    """Return a sentence for each state: its one-step residual in the plain and in the stable model."""
    losses = (regression.rows.residual(regression.x_next, regression.decode(K)) for K in (plain, stable))
    return [
        f"one-step residual of {name!r}: {before:.3g} before, {after:.3g} after"
        for name, before, after in zip(regression.states, *losses, strict=True)
    ]


def _stabilise(
    rows: RegressionRows, K: Float[np.ndarray, "n nz"], moving: Int[np.ndarray, " m"], rho: float, ridge: float
) -> Float[np.ndarray, "n nz"]:
    """Return K with a stable block of the `moving` observables; all other coefficients are fitted to this block."""
    n = len(K)
    size, spread = column_norms(rows.P), column_norms(rows.subtract_means().P)
    size[size == 0] = 1.0
    others = np.setdiff1d(np.arange(n), moving)
    scale = size[moving] / size[moving, None]  # A in units of the observables' sizes

    def misfit(K: Float[np.ndarray, "n nz"], ridge: float) -> Misfit:
        P = np.vstack([rows.P / size, np.sqrt(ridge) * np.diag(spread / size)])
        free = P[:, moving] - project_onto(P[:, others], P[:, moving])
        return Misfit(K[np.ix_(moving, moving)].T * scale, free.T @ free)

    plain = misfit(K, ridge)
    candidates = [_find_nearest(plain, rho)]
    if (
        ridge < _LIMITS.help and np.linalg.cond(plain.G) > 1 / _LIMITS.help
    ):  # the descent converges slowly in a narrow valley
        candidates.append(_find_nearest(misfit(solve(rows, ridge=_LIMITS.help).K, _LIMITS.help), rho))
    choices = [_refit(rows, K, moving, A / scale, rho, ridge) for A in candidates]
    return min(choices, key=lambda K: relative_misfit(rows, K))


def _find_nearest(misfit: Misfit, rho: float) -> Float[np.ndarray, "m m"]:
    """Return the stable A with the smallest misfit among those that the descent finds from its starts."""
    starts = [clip_eigenvalues(misfit.A0, rho)]
    if len(misfit.A0) <= _LIMITS.small:
        start = fit_lyapunov(misfit.A0, misfit.G, rho)
        starts += [] if start is None else [scale_inside(start, rho)]
    return find_nearest_stable(misfit, rho, starts)


def fit_lyapunov(
    A0: Float[np.ndarray, "n n"], G: Float[np.ndarray, "n n"], radius: float
) -> Float[np.ndarray, "n n"] | None:
    """Return A = H Y P⁻¹ H⁻¹, H = G^½, of min ‖H (Y − H⁻¹A₀H P)‖_F with [[ρ² P, Y], [Yᵀ, P]] ⪰ 0, tr P = n.

    The inequality is Y P⁻¹ Yᵀ ⪯ ρ² P: H P H is a Lyapunov matrix of A, so |λ(A)| ≤ ρ. Objective and constraints are
    convex in (Y, P), so the optimum is global. For P = I the squared norm is the misfit tr (A − A₀) G (A − A₀)ᵀ; any
    other P weighs the whitened directions of the observables by P². P ⪰ 10⁻³ I bounds these weights. The result is
    None if the solver fails.

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
    constraints = [0.5 * (M + M.T) >> 0, P - _LIMITS.least * np.eye(n) >> 0, cp.trace(P) == n]
    misfit = cp.norm((H / root[-1]) @ (Y - inverse @ A0 @ H @ P), "fro")
    problem = cp.Problem(cp.Minimize(misfit), constraints)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # an inaccurate solution is good enough as a start
        try:
            problem.solve(solver=cp.CLARABEL)
        except cp.SolverError:
            return None
    if Y.value is None or P.value is None:
        return None
    return H @ np.linalg.solve(np.asarray(P.value), np.asarray(Y.value).T).T @ inverse


def _refit(
    rows: RegressionRows,
    K: Float[np.ndarray, "n nz"],
    moving: Int[np.ndarray, " m"],
    A: Float[np.ndarray, "m m"],
    rho: float,
    ridge: float,
) -> Float[np.ndarray, "n nz"]:
    """Return K with A as the block of the `moving` observables; the coefficients of the others are fitted to it."""
    others = np.setdiff1d(np.arange(len(K)), moving)
    refit = K.copy()
    refit[np.ix_(moving, moving)] = scale_inside(A, rho).T
    if len(others):
        known = rows.P[:, moving] @ refit[np.ix_(moving, moving)]
        rest = replace(rows.keep_regressors(others), T=rows.T[:, moving] - known, rest=rows.rest[moving])
        refit[np.ix_(others, moving)] = solve(rest, ridge=ridge).K
    return refit


def spectral_radius(A: Float[np.ndarray, "n n"]) -> float:
    """Return the spectral radius, 0 for an empty matrix."""
    return float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))


def clip_eigenvalues(A: Float[np.ndarray, "n n"], radius: float) -> Float[np.ndarray, "n n"]:
    """Return A with its eigenvalues outside the circle moved onto it; if A is nearly defective, return A ρ / |λ|max."""
    result = np.linalg.eig(A)
    values, V = np.asarray(result.eigenvalues), np.asarray(result.eigenvectors)
    size = np.abs(values)
    if np.linalg.cond(V) < 1e8:
        clipped = np.where(size > radius, values * radius / np.where(size > 0, size, 1.0), values)
        return np.ascontiguousarray(((V * clipped) @ np.linalg.inv(V)).real)
    return A * (radius / size.max())


def find_nearest_stable(
    misfit: Misfit, radius: float, starts: list[Float[np.ndarray, "n n"]]
) -> Float[np.ndarray, "n n"]:
    """Return A with |λ(A)| ≤ radius and f(A) no larger than at any start.

    A has |λ(A)| ≤ radius if some S gives X = S A S⁻¹ with ‖X‖₂ ≤ radius. Projected gradient steps with momentum move S
    and X, and clip the singular values of X; the momentum restarts if f would rise. The problem is not convex: the
    result is a local optimum, the best of several starts.

    References
    ----------
    Gillis, Karow & Sharma, "Approximating the nearest stable discrete-time system", Linear Algebra Appl. 573, 2019;
    with data: Mamakoukas, Xherija & Murphey, "Memory-efficient learning of stable linear dynamical systems for
    prediction and control", NeurIPS 2020.
    """
    n = len(misfit.A0)
    runs = [_Descent(misfit, radius, np.eye(n), misfit.A0)]
    for start in starts:
        S = _find_metric(start, radius)
        runs.append(_Descent(misfit, radius, S, S @ start @ np.linalg.inv(S)))
    for run in runs:
        run.go(_LIMITS.trial)
    best = min(runs, key=lambda run: run.value)
    best.go(_LIMITS.steps)
    candidates = [scale_inside(A, radius) for A in (best.A, *starts)]
    return min(candidates, key=misfit)


def scale_inside(A: Float[np.ndarray, "n n"], radius: float) -> Float[np.ndarray, "n n"]:
    """Return A, scaled down until no eigenvalue lies outside the circle, not even by rounding."""
    for _ in range(5):
        size = spectral_radius(A)
        if size <= radius:
            break
        A = A * (radius / size * (1 - 1e-15))
    return A


class _Descent:
    """Projected gradient descent with momentum on (S, X); the misfit `value` never rises."""

    def __init__(self, misfit: Misfit, radius: float, S: Float[np.ndarray, "n n"], X: Float[np.ndarray, "n n"]) -> None:
        self._misfit, self._radius = misfit, radius
        self._S, self._X = S, _project_on_ball(X, radius)
        self._old = self._S, self._X
        self._momentum = 1.0
        self.A = np.linalg.solve(S, self._X @ S)
        self.value = misfit(self.A)
        largest = float(np.linalg.eigvalsh(misfit.G)[-1])
        self._step = 0.5 / max(largest * float(np.linalg.cond(S)) ** 2, 1e-300)

    def go(self, steps: int) -> None:
        """Take at most `steps` steps; stop earlier if the misfit stalls."""
        history = [self.value]
        for _ in range(steps):
            if not self._advance():
                return
            history.append(self.value)
            if len(history) > _LIMITS.stall and history[-_LIMITS.stall] - self.value <= _LIMITS.gain * self.value:
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
        """Take a step from (S, X); keep it and return True if f falls, else return False."""
        inverse = np.linalg.inv(S)
        A = inverse @ X @ S
        slope = inverse.T @ (2 * (A - self._misfit.A0) @ self._misfit.G)
        S_new = S - self._step * (X.T @ slope - slope @ A.T)
        X_new = _project_on_ball(X - self._step * slope @ S.T, self._radius)
        A_new = np.linalg.solve(S_new, X_new @ S_new)
        value = self._misfit(A_new)
        if not value < self.value:
            return False
        self._old = self._S, self._X
        self._S, self._X, self.A, self.value = S_new, X_new, A_new, value
        return True


def _project_on_ball(X: Float[np.ndarray, "n n"], radius: float) -> Float[np.ndarray, "n n"]:
    """Return the nearest matrix with ‖X‖₂ ≤ radius: it clips the singular values above the radius."""
    values, V = np.linalg.eigh(X.T @ X)
    large = values > radius**2
    W = V[:, large]
    return X - (X @ W) * (1 - radius / np.sqrt(values[large])) @ W.T


def _find_metric(A: Float[np.ndarray, "n n"], radius: float) -> Float[np.ndarray, "n n"]:
    """Return S = P^½ with AᵀP A ⪯ (ρ (1 + margin))² P, for the smallest margin that gives a well conditioned P."""
    S = np.eye(len(A))
    for margin in _LIMITS.margins:
        P = solve_discrete_lyapunov((A / (radius * (1 + margin))).T, np.eye(len(A)))
        values, vectors = np.linalg.eigh(0.5 * (P + P.T))
        if values[0] > 0 and values[-1] < 1e6 * values[0]:
            return (vectors * np.sqrt(values / values[0])) @ vectors.T
    return S
