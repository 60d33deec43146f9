"""Extended dynamic mode decomposition: z⁺ = A z + B u on z = ψ(x)."""

from typing import Unpack

from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.identify.assemble import warned
from koopmpc.identify.fit import Method, fit
from koopmpc.identify.gather import How
from koopmpc.identify.rank import Rank
from koopmpc.identify.regression import read
from koopmpc.identify.ridge import Ridge
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
    task = read(episodes, lifting, embedding, "edmd", noisy=method != "ls", **how)
    return warned(fit(task, ridge=ridge, rank=rank, method=method))
