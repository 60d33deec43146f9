"""Bilinear extended dynamic mode decomposition: z⁺ = A z + B u + Σ uᵢ Nᵢ z on z = ψ(x)."""

import warnings

import numpy as np

from koopmpc import checks
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.errors import DataError, FitWarning
from koopmpc.identify.doubts import doubts
from koopmpc.identify.edmd import regression
from koopmpc.identify.fit import cut
from koopmpc.identify.moments import moments, product_names
from koopmpc.identify.solve import Rows, scaled_rank, solve
from koopmpc.lifting.base import Lifting
from koopmpc.predict.bilinear import BilinearPredictor
from koopmpc.predict.report import FitReport


def bilinear_edmd(
    episodes: Episodes, lifting: Lifting, *, ridge: float = 0.0, difference: bool = False
) -> BilinearPredictor:
    """Fit ψ(x⁺) = A ψ(x) + B u + Σ uᵢ Nᵢ ψ(x) by least squares on M snapshot pairs.

    Nothing is added to the lifting. Where it holds a Constant, its columns of Nᵢ are zero: uᵢ · 1 is what B is for.

    Parameters
    ----------
    episodes
        With inputs; no pair spans two of them.
    lifting
        ψ: R^nx → R^nz. C picks the states where it holds them, by name, else it is fitted.
    ridge
        Tikhonov weight on unit-norm columns of [ψ(x) u u⊗ψ(x)]. With 0, singular values below eps · max(M, n) of
        the largest are cut.
    difference
        Regress ψ(x⁺) − ψ(x), and A = I + what is found. Without a ridge and on independent columns it is the same
        model; a ridge, or a cut, then draws z⁺ towards z ("nothing changes") instead of towards zero, which is
        nearer the truth for a short dt.

    Raises
    ------
    DataError
        The data have no inputs, ridge is negative, or an observable is not finite on the data.

    Warns
    -----
    FitWarning
        Rank-deficient, ill-conditioned, or inputs that are functions of ψ(x); each is also in the report.

    References
    ----------
    Bruder, Fu & Vasudevan, "Advantages of bilinear Koopman realizations for the modeling and control of systems
    with unknown dynamics", IEEE Robot. Autom. Lett. 6, 2021.
    """
    if episodes_of(episodes).nu == 0:
        raise DataError("the episodes have no inputs; pass them to edmd, or give each Episode its U")
    if episodes.nw:
        raise DataError("the episodes hold measured disturbances, which a bilinear fit leaves out; use edmd")
    ridge = float(checks.array(ridge, "ridge", ()))
    if ridge < 0:
        raise DataError(f"ridge is {ridge:g}; it must be 0 or above")
    total = moments(episodes, lifting, bilinear=True)
    task = regression(total, "bilinear_edmd")
    given, bound, nz, nu = task.rows, task.lifting, total.nz, episodes.nu
    names = product_names(bound, total.inputs, total.products)
    sentences = doubts(given, bound.names, (*total.inputs, *names), regular=ridge > 0)
    start = np.eye(len(given.P[0]), nz) * difference  # what stands in K before anything is learned
    change = Rows(given.P, given.T[:, :nz] - given.P @ start, given.rest[:nz], given.samples)
    solution = solve(change, ridge=ridge)
    K = solution.K + start
    N = np.zeros((nu, nz, nz))
    N[:, :, total.products] = K[nz + nu :].reshape(nu, -1, nz).transpose(0, 2, 1)
    assert task.C is not None, "an extended regression has its C"
    report = FitReport(
        method="bilinear_edmd",
        route=f"{task.route}, {cut(task, given, ridge, None)}",
        samples=given.samples,
        condition=scaled_rank(given, given.P)[1],
        rank=solution.rank,
        columns=given.P.shape[1],
        ridge=ridge,
        residual=given.residual(task.x_next, K @ task.C.T),
        state_residual=task.state_residual,
        warnings=tuple(sentences),
    )
    for sentence in sentences:
        warnings.warn(sentence, FitWarning, stacklevel=2)
    return BilinearPredictor(
        K[:nz].T, K[nz : nz + nu].T, N, task.C, bound, task.dt, task.states, task.inputs, report
    )
