"""Dynamic mode decomposition on the states themselves, without and with inputs."""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.errors import DataError
from koopmpc.identify.fit import Regression, fit
from koopmpc.identify.moments import moments
from koopmpc.identify.solve import Rows
from koopmpc.lifting.state import State
from koopmpc.predict.linear import LinearPredictor


def dmd(episodes: Episodes, *, rank: int | None = None) -> LinearPredictor:
    """Fit x⁺ = A x, A = X′X⁺ by truncated SVD of the unscaled snapshots; inputs in the data are left out.

    With fewer snapshots than states it works on the small side, and with `rank` it forms no (nx, nx) array.

    Parameters
    ----------
    episodes
        Snapshots; no pair spans two episodes.
    rank
        Keep r singular vectors: z = U_rᵀ x, A = Ã (r, r), C = U_r, exact modes X′ V Σ⁻¹ W. By default
        singular values below eps · max(M, nx) of the largest are cut, and A is (nx, nx).

    Raises
    ------
    DataError
        rank is above nx.

    Warns
    -----
    FitWarning
        Rank-deficient or ill-conditioned data.

    References
    ----------
    Tu et al., "On dynamic mode decomposition: theory and applications", J. Comput. Dyn. 1, 2014.
    """
    return fit(_regression(episodes, "dmd", inputs=()), rank=rank)


def dmdc(episodes: Episodes, *, rank: int | None = None, B: ArrayLike | None = None) -> LinearPredictor:
    """Fit x⁺ = A x + B u by truncated SVD of the unscaled snapshots [X; U], or of X alone where B is known.

    Parameters
    ----------
    episodes
        Snapshots with inputs.
    rank
        Keep r singular vectors of X, as in `dmd`; the cut without it is also that of `dmd`.
    B
        (nx, nu), known; identified by default.

    Raises
    ------
    DataError
        The data have no inputs, or rank is above nx.

    Warns
    -----
    FitWarning
        Rank-deficient data, or a feedback u = −K x that makes A and B inseparable.

    References
    ----------
    Proctor, Brunton & Kutz, "Dynamic mode decomposition with control", SIAM J. Appl. Dyn. Syst. 15, 2016.
    """
    if episodes_of(episodes).nu == 0:
        raise DataError("the episodes have no inputs; pass them to dmd, or give each Episode its U")
    if episodes.nw:
        raise DataError(
            "the episodes hold measured disturbances, which dmdc does not fit; use edmd on State()"
        )
    known = None if B is None else checks.array(B, "B", (episodes.nx, episodes.nu))
    return fit(_regression(episodes, "dmdc", inputs=episodes.inputs, B=known), rank=rank)


def _regression(
    episodes: Episodes, method: str, *, inputs: tuple[str, ...], B: Float[np.ndarray, "nx nu"] | None = None
) -> Regression:
    """Return the regression of x⁺ on [x u], or on x alone where no inputs are named."""
    lifting = State().bind(episodes_of(episodes).states)
    nx, nu = episodes.nx, len(inputs)
    pairs = sum(len(e) for e in episodes)
    if pairs < nx + nu:  # the snapshots themselves are the few rows
        data = episodes.snapshots()
        rows = Rows(np.hstack([data.X, data.U[:, :nu]]), data.X_next, np.zeros(nx), pairs)
    else:
        total = moments(episodes, lifting, route="qr")
        rows = total.rows(total.regressors[: nx + nu], total.targets)
    return Regression(
        method=method,
        route="svd",
        rows=rows,
        x_next=np.arange(nx),
        lifting=lifting,
        states=episodes.states,
        inputs=inputs,
        dt=episodes.dt,
        C=None,
        state_residual=np.zeros(nx),
        B=B,
        scaled=False,
    )
