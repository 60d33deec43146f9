"""Extended dynamic mode decomposition z⁺ = A z + B u, z = ψ(x), with reduced rank and for noisy states."""

from dataclasses import replace
from typing import Literal, Unpack

import numpy as np
from jaxtyping import Complex, Float
from scipy.linalg import sqrtm

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.composed import Projected
from koopmpc.models.base import sorted_eigen
from koopmpc.models.fits.rank import Rank, leading_directions, truncation_loss
from koopmpc.models.moments.doubts import find_doubts
from koopmpc.models.moments.read import ReadOptions
from koopmpc.models.moments.solve import (
    RegressionRows,
    Ridge,
    Solution,
    check_ridge,
    describe_solve,
    orthonormal_basis,
    solve,
)
from koopmpc.models.predictors import LinearPredictor
from koopmpc.models.shared.regression import Regression, build_predictor, read_regression

Method = Literal["ls", "tls", "fb"]
Towards = Literal["zero", "affine"]
_DEFECTIVE = 1e7  # take the principal square root if the condition number of the eigenvectors is above this
_REAL = 1e-6  # an imaginary part below this share of the size of A is a rounding error
_WORDS = {"ls": "", "tls": "total least squares, ", "fb": "forward and backward, "}


def fit_regression(
    regression: Regression, *, ridge: Ridge = 0.0, rank: Rank = None, method: Method = "ls", towards: Towards = "zero"
) -> LinearPredictor:
    """Return the model of min Σ ‖ψ(x⁺) − A ψ(x) − B u‖² + ridge ‖[A B] S‖², with what was done in its report.

    S holds the column norms of the regressors on its diagonal; it is the identity without a rank where the regression
    is not `scaled`. `ridge`, `rank`, `method` and `towards` are those of `edmd`: a rank gives z = U_rᵀ ψ(x), and a
    method other than "ls" needs a regression that was read with ``noisy=True``, so that the rows hold all of T.
    """
    _check_method(rank, method, towards)
    ridge = check_ridge(ridge)
    if method != "ls" and ridge != 0:
        raise DataError(f'a ridge shrinks A, and method="{method}" undoes what noise shrank; pass one of the two')
    rows, nz = regression.rows, regression.lifting.nz
    if regression.B is not None:  # B is known: subtract B u from the targets, and fit A alone
        known = rows.P[:, nz:] @ regression.B.T
        rows = replace(rows.keep_regressors(np.arange(nz)), T=rows.T - known)
    free = regression.inputs if regression.B is None else ()
    sentences, condition = find_doubts(rows, regression.lifting.names, free, regular=ridge != 0 or rank is not None)
    if rank is not None:
        return _fit_reduced(regression, rows, ridge, rank, method, condition, sentences)
    fit_rows = rows.keep_targets(nz)
    light = [i for i in regression.affine_columns if i < rows.P.shape[1]] if towards == "affine" else []
    if method == "tls":
        fit_rows = _remove_noise(regression, fit_rows, nz)
    scaled = regression.scaled
    if method == "fb":
        solution = _fit_forward_backward(fit_rows, nz)
    else:
        solution = solve(fit_rows, ridge=ridge, scaled=scaled, light=light)
    K = solution.K if regression.B is None else np.vstack([solution.K, regression.B.T])
    return build_predictor(
        regression,
        K,
        rule=_WORDS[method] + describe_solve(rows, ridge, solution.ridge, scaled=scaled, light=light),
        rank=solution.rank,
        condition=condition,
        ridge=solution.ridge,
        doubts=sentences,
    )


def _check_method(rank: Rank, method: Method, towards: Towards) -> None:
    """Raise DataError where two options do not go together, or one has no such value."""
    if not checks.among(towards, ("zero", "affine")):
        raise DataError(f'towards is {towards!r}; pass "zero" or "affine"')
    if towards == "affine" and rank is not None:
        raise DataError('towards="affine" treats columns differently, and rank mixes them; pass one of the two')
    if not checks.among(method, _WORDS):
        raise DataError(f"method is {method!r}; pass one of {', '.join(map(repr, _WORDS))}")


def _fit_reduced(
    regression: Regression,
    rows: RegressionRows,
    ridge: Ridge,
    rank: Rank,
    method: Method,
    condition: float,
    sentences: list[str],
) -> LinearPredictor:
    """Return the fit on [U_rᵀψ(x) u]. Without inputs that is Ã = U_rᵀ X′ V_r Σ_r⁻¹ (Tu et al. 2014)."""
    nz = regression.lifting.nz
    basis, words = leading_directions(rows, nz, rank, sentences)
    r = len(basis.T)
    fit_rows = rows.keep_targets(nz)
    if method == "tls":
        fit_rows = _remove_noise(regression, fit_rows, r)
        basis = leading_directions(fit_rows, nz, r, [])[0]
    P = np.hstack([fit_rows.P[:, :nz] @ basis, fit_rows.P[:, nz:]])
    if method == "fb":
        solution = _fit_forward_backward(RegressionRows(P, fit_rows.T @ basis, np.zeros(r), rows.samples), r)
        forward, drive = basis @ solution.K[:r].T, basis @ solution.K[r:].T
    else:
        solution = solve(RegressionRows(P, fit_rows.T, fit_rows.rest, rows.samples), ridge=ridge)
        forward, drive = solution.K[:r].T, solution.K[r:].T  # forward = X′ V_r Σ_r⁻¹, (nz, r)
    A = basis.T @ forward
    B = basis.T @ (drive if regression.B is None else regression.B)
    C = basis if regression.C is None else regression.C @ basis
    Z = rows.P[:, :nz]
    seen = RegressionRows(np.hstack([Z @ basis, regression.rows.P[:, nz:]]), regression.rows.T, rows.rest, rows.samples)
    reduced = replace(
        regression,
        rows=seen,
        lifting=Projected(regression.lifting, basis).bind(regression.lifting.bound_states),
        C=C,
        B=None,
        state_residual=np.hypot(regression.state_residual, truncation_loss(Z, basis, regression.C, rows.samples)),
    )
    return build_predictor(
        reduced,
        np.vstack([A.T, B.T]),
        modes=forward @ sorted_eigen(A)[1],
        rule=_WORDS[method] + (words if ridge == 0 else f"{words}, {describe_solve(seen, ridge, solution.ridge)}"),
        rank=r,
        condition=condition,
        columns=regression.columns,
        ridge=solution.ridge,
        doubts=sentences,
    )


def _remove_noise(regression: Regression, rows: RegressionRows, directions: int) -> RegressionRows:
    """Return the projection of the rows on the leading directions of [ψ(x) ψ(x⁺)].

    Least squares on the result is the total least squares solution. E is a basis of the exact columns, which are the
    inputs and the Constant; D = [ψ(x) ψ(x⁺)] less its projection on E. With D ≈ L Σ Rᵀ and its r first singular vectors
    L_r, the rows are multiplied by [E, L_r]ᵀ. All other columns are assumed to hold white noise of one size: relative
    to each observable's size if the regression is `scaled`, else in the units of the data.

    References
    ----------
    Hemati, Rowley, Deem & Cattafesta, "De-biasing the dynamic mode decomposition for applied Koopman spectral
    analysis of noisy datasets", Theor. Comput. Fluid Dyn. 31, 2017; exact columns: Van Huffel & Vandewalle, "The
    total least squares problem", SIAM 1991.
    """
    nz, one = regression.lifting.nz, regression.lifting.constant_index
    constants = [] if one is None else [one]
    exact = np.array([*constants, *range(nz, rows.P.shape[1])], dtype=np.intp)
    directions, most = directions - len(constants), rows.samples - len(exact)
    if directions >= most:
        raise DataError(
            f'method "tls" with {rows.samples} snapshot pairs cannot tell noise from {directions} directions of '
            f"signal; pass a rank below {max(most, 1)}, or collect more"
        )
    noisy = np.setdiff1d(np.arange(nz), exact)
    E = orthonormal_basis(rows.P[:, exact], float(np.finfo(float).eps * len(rows.P)))
    D = np.hstack([rows.P[:, noisy], rows.T[:, noisy]])
    if regression.scaled:
        size = np.sqrt(np.sum(D.reshape(len(D), 2, -1) ** 2, axis=(0, 1)))
        D = D / np.tile(np.where(size > 0, size, 1.0), 2)
    L = np.linalg.svd(D - E @ (E.T @ D), full_matrices=False)[0][:, :directions]
    onto = np.hstack([E, L]).T
    return RegressionRows(onto @ rows.P, onto @ rows.T, rows.rest, rows.samples)


def _fit_forward_backward(rows: RegressionRows, nz: int) -> Solution:
    """Return K = [Aᵀ; Bᵀ] of z⁺ = A z + B u, where the bias of A by noise cancels to first order.

    A_f is the fit of z⁺ by [z u], A_b that of z by [z⁺ u]. Without noise they are A and A⁻¹. Noise shrinks both, and in
    A_f A_b⁻¹ ≈ A² the shrinking cancels to first order. A is the square root of it that is nearest to A_f. B is the
    least squares fit of z⁺ − A z by u.

    References
    ----------
    Dawson, Hemati, Williams & Rowley, "Characterizing and correcting for the effect of sensor noise in the
    dynamic mode decomposition", Exp. Fluids 57, 2016.
    """
    now, U, ahead = rows.P[:, :nz], rows.P[:, nz:], rows.T
    forward = solve(rows)
    backward = solve(RegressionRows(np.hstack([ahead, U]), now, rows.rest, rows.samples))
    A = _nearest_root(forward.K[:nz].T, backward.K[:nz].T)
    B = solve(RegressionRows(U, ahead - now @ A.T, rows.rest, rows.samples)).K
    return Solution(np.vstack([A.T, B]), forward.rank, 0.0)


def _nearest_root(forward: Float[np.ndarray, "r r"], backward: Float[np.ndarray, "r r"]) -> Float[np.ndarray, "r r"]:
    """Return (A_f A_b⁻¹)^½ with the sign of each eigenvalue that A_f has along its eigenvector."""
    if np.linalg.cond(backward) > 1 / np.finfo(float).eps:
        raise DataError(
            'method "fb" needs a motion that can be reversed, and on these data a direction of ψ(x) decays to 0 in '
            'one step; pass a rank, or method="tls"'
        )
    square = np.linalg.solve(backward.T, forward.T).T
    squares, V = sorted_eigen(square)
    A: Complex[np.ndarray, "r r"]
    if np.linalg.cond(V) > _DEFECTIVE:
        A = np.asarray(sqrtm(square), dtype=np.complex128)
    else:
        W = np.linalg.inv(V)
        roots = np.sqrt(squares)
        along = np.einsum("ij,jk,ki->i", W, forward, V)
        A = (V * np.where(np.real(np.conj(roots) * along) < 0, -roots, roots)) @ W
    real = np.real(A)
    if not np.abs(A - real).max() <= _REAL * np.abs(A).max():
        raise DataError(
            'method "fb" has no real square root of A_f A_b⁻¹ on these data: an eigenvalue near 0 changed its sign '
            'in the noise; pass a smaller rank, or method="tls"'
        )
    return np.ascontiguousarray(real)


def edmd(
    episodes: Episodes | Source,
    lifting: Lifting,
    *,
    embedding: Delay | None = None,
    ridge: Ridge = 0.0,
    rank: Rank = None,
    method: Method = "ls",
    towards: Towards = "zero",
    **options: Unpack[ReadOptions],
) -> LinearPredictor:
    """Fit ψ(x⁺) = A ψ(x) + B u + E w by least squares on M snapshot pairs, with u and w where the data have them.

    Nothing is added to the lifting: no state, no constant. C picks by name the states that the lifting holds. The
    other states it fits by ψ(x) in least squares, with the residual in ``report.state_residual``.

    Parameters
    ----------
    episodes
        No snapshot pair crosses from one episode to the next. A Source, e.g. ``Files("logs")``, is read in parts, so
        the data need not fit in memory.
    lifting
        ψ: R^nx → R^nz.
    embedding
        Delays, e.g. ``Delay(2)``: ψ then acts on the state and its past. C still returns x alone.
    ridge
        Tikhonov weight on the coefficients of unit-norm columns. Where the lifting holds a `Constant`, the ridge acts
        on deviations from the columns' means and leaves the constant term alone: another origin of the data gives the
        same model. With 0, singular values of the unit-norm columns below eps · max(M, nz + nu) times the largest are
        cut; ``report.route`` gives the cut. "gcv" chooses the weight by generalised cross-validation, with each
        observable's error relative to its size; the report holds the chosen value.
    rank
        With rank=r the predictor is reduced to z = U_rᵀ ψ(x), with A = Ã (r, r), C U_r in place of C, and the exact
        DMD modes X′ V Σ⁻¹ W, W the eigenvectors of Ã. The columns are not scaled, so the truncated SVD depends on
        the units of the data. A share in (0, 1) keeps the fewest directions with that part of the energy Σσ²;
        "hard-threshold" keeps those above the optimal threshold for white noise of unknown size (Gavish & Donoho
        2014).
    method
        "ls", least squares: noise in ψ(x) shrinks A. "tls", total least squares, assumes equal noise in ψ(x) and
        ψ(x⁺), relative to each observable's size, and none in the inputs and the Constant. "fb", forward and
        backward, assumes nothing about the size of the noise, but the motion must be reversible in time. Both treat
        the noise as added to ψ(x).
    towards
        The model that a large ridge leads to. "affine" is x⁺ = A x + B u + c on the states, the Constant and the inputs
        of the regression: a ridge counts a million times less on those than on all others. With "zero" a ridge also
        makes an unstable plant look tame, and controllers that believe it lose such plants.
    **options
        ``weights``, ``workers``, ``scheduler``, ``progress`` of `km.moments.second_moments`: who reads the data, and
        the weight of each pair.

    Raises
    ------
    DataError
        ridge is negative, or is given with "tls" or "fb"; rank is too large, or is given with towards="affine"; an
        observable is not finite on the data; "tls" has too few pairs; "fb" meets a motion that cannot be run backward.

    Warns
    -----
    FitWarning
        Rank-deficient, ill-conditioned, or inputs that are functions of ψ(x); each is also in the report.

    References
    ----------
    Williams, Kevrekidis & Rowley, "A data-driven approximation of the Koopman operator", J. Nonlinear Sci.
    25, 2015; with inputs: Korda & Mezić, Automatica 93, 2018; noise: Dawson et al., Exp. Fluids 57, 2016.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=60, steps=30)
    >>> model = km.edmd(data, km.State() + km.Fourier(1, states="theta"))
    >>> model.A.shape, model.B.shape
    ((4, 4), (4, 1))
    >>> model.rollout([0.5, 0.0], [[0.0], [1.0]]).shape  # x_0 … x_2
    (3, 2)
    """
    regression = read_regression(
        episodes, lifting, embedding, "edmd", noisy=not checks.among(method, ("ls",)), **options
    )
    return fit_regression(regression, ridge=ridge, rank=rank, method=method, towards=towards)
