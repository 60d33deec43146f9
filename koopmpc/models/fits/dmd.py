"""Dynamic mode decomposition on the states themselves, without and with inputs."""

from typing import Unpack

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Held, Source, source_of
from koopmpc.lifting.state import State
from koopmpc.models.fits.edmd import Method, fit_regression
from koopmpc.models.fits.rank import Rank
from koopmpc.models.moments.read import ReadOptions, second_moments
from koopmpc.models.moments.rows import concatenate_parts
from koopmpc.models.moments.solve import RegressionRows
from koopmpc.models.predictors import LinearPredictor
from koopmpc.models.shared.regression import Regression


def dmd(
    episodes: Episodes | Source, *, rank: Rank = None, method: Method = "ls", **options: Unpack[ReadOptions]
) -> LinearPredictor:
    """Fit x⁺ = A x, A = X′X⁺ by truncated SVD of the unscaled snapshots; inputs in the data are left out.

    With fewer snapshots than states it works on the small side, and with `rank` it forms no (nx, nx) array.

    Parameters
    ----------
    episodes
        Snapshots, or a Source of them; no pair spans two episodes.
    rank
        Keep r singular vectors: z = U_rᵀ x, A = Ã (r, r), C = U_r, exact modes X′ V Σ⁻¹ W. By default
        singular values below eps · max(M, nx) of the largest are cut, and A is (nx, nx). A share in (0, 1)
        keeps the fewest directions with that part of the energy Σσ²; "hard-threshold" keeps those above the
        optimal threshold for white noise of unknown size (Gavish & Donoho 2014).
    method
        "ls", least squares: noise in x shrinks A, so that modes seem to decay faster. "tls", total least
        squares, assumes equal noise in x and x⁺. "fb" fits forward and backward, A = (A_f A_b⁻¹)^½; it assumes nothing
        about the size of the noise, but the motion must be reversible in time.
    **options
        ``weights``, ``workers``, ``scheduler`` and ``progress``, as in `km.moments.second_moments`.

    Raises
    ------
    DataError
        rank is above nx, there are too few pairs for "tls", or the motion cannot be reversed for "fb".

    Warns
    -----
    FitWarning
        The data are rank-deficient or ill-conditioned.

    References
    ----------
    Tu et al., "On dynamic mode decomposition: theory and applications", J. Comput. Dyn. 1, 2014; noise: Dawson,
    Hemati, Williams & Rowley, "Characterizing and correcting for the effect of sensor noise in the dynamic mode
    decomposition", Exp. Fluids 57, 2016.

    Examples
    --------
    >>> import koopmpc as km
    >>> import numpy as np
    >>> t = np.arange(0, 10, 0.1)
    >>> X = np.column_stack([np.cos(2 * t), np.sin(2 * t)])
    >>> model = km.dmd(km.Episodes([km.Episode(X=X, U=np.zeros((99, 0)))], dt=0.1))
    >>> abs(np.log(model.eigenvalues).imag / 0.1).round(6)  # rad/s
    array([2., 2.])
    """
    regression = _regression(
        source_of(episodes), "dmd", inputs=(), noisy=not checks.among(method, ("ls",)), options=options
    )
    return fit_regression(regression, rank=rank, method=method)


def dmdc(
    episodes: Episodes | Source,
    *,
    rank: Rank = None,
    B: ArrayLike | None = None,
    method: Method = "ls",
    **options: Unpack[ReadOptions],
) -> LinearPredictor:
    """Fit x⁺ = A x + B u by truncated SVD of the unscaled snapshots [X; U], or of X alone where B is known.

    Parameters
    ----------
    episodes
        Snapshots with inputs, or a Source of them.
    rank
        Keep r singular vectors of X, as in `dmd`; the cut without it is also that of `dmd`.
    B
        (nx, nu) if it is known; identified by default.
    method
        As in `dmd`; inputs are exact in "tls" and "fb".
    **options
        As in `dmd`.

    Raises
    ------
    DataError
        The data have no inputs, or one of the errors of `dmd`.

    Warns
    -----
    FitWarning
        The data are rank-deficient, or a feedback u = −K x makes A and B inseparable.

    References
    ----------
    Proctor, Brunton & Kutz, "Dynamic mode decomposition with control", SIAM J. Appl. Dyn. Syst. 15, 2016.
    """
    source = source_of(episodes)
    if source.nu == 0:
        raise DataError("the episodes have no inputs; pass them to dmd, or give each Episode its U")
    if source.nw:
        raise DataError("the episodes hold measured disturbances, which dmdc does not fit; use edmd on State()")
    known = None if B is None else checks.array(B, "B", (source.nx, source.nu))
    regression = _regression(
        source, "dmdc", inputs=source.inputs, B=known, noisy=not checks.among(method, ("ls",)), options=options
    )
    return fit_regression(regression, rank=rank, method=method)


def _regression(
    source: Source,
    method: str,
    *,
    inputs: tuple[str, ...],
    B: Float[np.ndarray, "nx nu"] | None = None,
    noisy: bool,
    options: ReadOptions,
) -> Regression:
    """Return the regression of x⁺ on [x u], or on x alone if `inputs` is empty."""
    lifting = State().bind(source.states)
    nx, nu = source.nx, len(inputs)
    episodes = source.episodes if isinstance(source, Held) and options.get("weights") is None else ()
    pairs = sum(len(e) for e in episodes)
    if 0 < pairs <= 2 * nx + nu:  # few snapshots: their moments would have as many rows
        X, X_next = concatenate_parts([e.X[:-1] for e in episodes]), concatenate_parts([e.X[1:] for e in episodes])
        P = np.hstack([X, concatenate_parts([e.U for e in episodes])]) if nu else X
        rows = RegressionRows(P, X_next, np.zeros(nx), pairs)
    else:
        total = second_moments(source, lifting, route="qr", **options)
        columns = total.columns.regressors[: nx + nu]
        rows = (total.complete_rows if noisy else total.rows)(columns, total.columns.targets)
    return Regression(
        method=method,
        route="svd",
        rows=rows,
        x_next=np.arange(nx),
        lifting=lifting,
        states=source.states,
        inputs=inputs,
        dt=source.dt,
        C=None,
        state_residual=np.zeros(nx),
        B=B,
        scaled=False,
    )
