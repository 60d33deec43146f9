"""Extended dynamic mode decomposition: z⁺ = A z + B u on z = ψ(x)."""

from typing import Unpack

import numpy as np
from jaxtyping import Float

from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.identify.fit import Method, Regression, fit
from koopmpc.identify.moments import How, Moments, moments
from koopmpc.identify.rank import Rank
from koopmpc.identify.ridge import Ridge
from koopmpc.identify.solve import solve
from koopmpc.identify.total import complete
from koopmpc.lifting.base import Lifting
from koopmpc.predict.linear import LinearPredictor


def edmd(
    episodes: Episodes | Source,
    lifting: Lifting,
    *,
    embedding: Delay | None = None,
    ridge: Ridge = 0.0,
    rank: Rank = None,
    method: Method = "ls",
    **how: Unpack[How],
) -> LinearPredictor:
    """Fit ψ(x⁺) = A ψ(x) + B u + E w by least squares on M snapshot pairs, with u and w where the data have them.

    Nothing is added to the lifting: no state, no constant. C picks the states where the lifting holds them,
    by name, else it is the least-squares fit of x by ψ(x), its residual in ``report.state_residual``.

    Parameters
    ----------
    episodes
        No pair spans two of them. A Source, ``Files("logs")`` say, is read in parts that memory need not hold.
    lifting
        ψ: R^nx → R^nz.
    embedding
        ψ acts on the state and its past, ``Delay(2)`` say; C still returns x alone.
    ridge
        Tikhonov weight on unit-norm columns. With 0, singular values below eps · max(M, nz + nu) of the
        largest, on unit-norm columns, are cut; the report's route says so. "gcv" chooses by generalised
        cross-validation, each observable counted relative to its size; the report says what.
    rank
        With rank=r the columns are unscaled, and the predictor is reduced to z = U_rᵀ ψ(x), A = Ã (r, r),
        C = C U_r, with the exact modes X′ V Σ⁻¹ W. A truncated SVD depends on the units of the data. A share
        in (0, 1) keeps the fewest directions with that part of the energy Σσ²; "hard-threshold" keeps those
        above the optimal threshold for white noise of unknown size (Gavish & Donoho 2014).
    method
        "ls", least squares: noise in ψ(x) shrinks A. "tls", total least squares, takes ψ(x) and ψ(x⁺) as noisy
        alike, relative to each observable's size; inputs and a Constant as exact. "fb", forward and backward,
        supposes no sizes, but that the motion can be run backward. Both suppose that noise in x adds to ψ(x).
    **how
        ``weights``, ``workers``, ``scheduler`` and ``progress`` of `moments`: w of each pair, and who reads.

    Raises
    ------
    DataError
        ridge is negative or given with "tls" or "fb", rank too large, an observable not finite on the data, or
        too few pairs for "tls", or a motion that "fb" cannot run backward.

    Warns
    -----
    FitWarning
        Rank-deficient, ill-conditioned, or inputs that are functions of ψ(x); each is also in the report.

    References
    ----------
    Williams, Kevrekidis & Rowley, "A data-driven approximation of the Koopman operator", J. Nonlinear Sci.
    25, 2015; with inputs: Korda & Mezić, Automatica 93, 2018; noise: Dawson et al., Exp. Fluids 57, 2016.
    """
    source = source_of(episodes)
    sized = None if embedding is None else embedding.fitted(source.states, source.inputs)
    total = moments(source.driven(), lifting, embedding=sized, **how)
    task = regression(total, "edmd", noisy=method != "ls")
    fitted = fit(task, ridge=ridge, rank=rank, method=method)
    if not source.nw:
        return fitted
    B, E = np.split(fitted.B, [source.nu], axis=1)
    return LinearPredictor(
        fitted.A,
        B,
        fitted.C,
        fitted.lifting,
        fitted.dt,
        fitted.states,
        source.inputs,
        fitted.report,
        fitted.exact_modes,
        E,
        source.disturbances,
        fitted.embedding,
    )


def regression(total: Moments, method: str, *, noisy: bool = False) -> Regression:
    """Return the regression of ψ(x⁺) on [ψ(x) u] that these moments hold, C included; `noisy` keeps all of T."""
    states = total.states
    place = {name: i for i, name in enumerate(total.full.names)}
    where = np.array([place[name] for name in states])
    C, residual = _decoder(total, where)
    regressors = total.regressors
    return Regression(
        method=method,
        route=total.route,
        rows=complete(total, regressors) if noisy else total.rows(regressors, total.targets),
        x_next=where,
        lifting=total.lifting,
        states=states,
        inputs=total.inputs,
        dt=total.dt,
        C=C,
        state_residual=residual,
        embedding=total.embedding,
    )


def _decoder(
    total: Moments, where: np.ndarray
) -> tuple[Float[np.ndarray, "nx nz"], Float[np.ndarray, " nx"]]:
    """Return C = argmin Σ ‖x − C ψ(x)‖² and its root-mean-square residual; a row that ψ holds is picked."""
    nz = total.nz
    C = np.zeros((len(where), nz))
    residual = np.zeros(len(where))
    held = where < nz
    C[held, where[held]] = 1.0
    if not held.all():
        rows = total.rows(np.arange(nz), where[~held])
        K = solve(rows).K
        C[~held] = K.T
        residual[~held] = rows.residual(np.arange(len(rows.rest)), K)
    return C, residual
