"""Identifiability of A and B from the inputs of the data: persistency of excitation, and feedback."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.errors import DataError
from koopmpc.identify.moments.moments import Moments, both_sides
from koopmpc.identify.solve import norms, orthonormal, unit
from koopmpc.lifting.base import Lifting
from koopmpc.validate.residuals import moments_of
from koopmpc.validate.scoring import AnyPredictor
from koopmpc.values import Value

_WINDOWS = 4096  # windows of the inputs that are held at once


@dataclass(frozen=True, eq=False)
class Persistency(Value):
    """The order to which the inputs are persistently exciting.

    Attributes
    ----------
    order
        The largest L ≤ `asked` for which the windows (u_k, …, u_{k+L−1}) of all episodes span R^(nu L).
    asked
        The largest order that was looked at.
    conditions
        (asked,) condition number of the windows of each order 1 … asked, on inputs of unit norm; infinite beyond
        `order`.
    windows
        Number of windows of `asked` steps.
    """

    order: int
    asked: int
    conditions: Float[np.ndarray, " asked"]
    windows: int


def persistency(episodes: Episodes, order: int) -> Persistency:
    """Return up to which order L ≤ `order` the block-Hankel matrix of the inputs has full row rank nu L.

    Inputs of order n + 1 make [x; u] of a controllable linear system of n states full rank, so that its A and B
    can be found. A sum of m sines is of order 2m, a constant of order 1, white noise of any order that the data
    are long enough for. Windows never span two episodes.

    Parameters
    ----------
    episodes
        Episodes with inputs.
    order
        The largest L to look at.

    Raises
    ------
    DataError
        There are no inputs, or no episode is as long as `order`.

    References
    ----------
    Willems et al., "A note on persistency of excitation", Syst. Control Lett. 54, 2005; for several episodes van
    Waarde et al., "Willems' fundamental lemma for state-space systems and its extension to multiple datasets",
    IEEE Control Syst. Lett. 4, 2020.
    """
    order = checks.count(order, "order")
    if episodes.nu == 0:
        raise DataError("the episodes have no inputs, so there is no excitation to look at")
    longest = max(len(episode) for episode in episodes)
    if longest < order:
        raise DataError(f"order is {order}, the longest episode has {longest} steps; pass {longest} or less")
    width = episodes.nu * order
    R, windows = np.zeros((0, width)), 0
    waiting: list[np.ndarray] = []
    held = 0
    for episode in episodes:
        for first in range(0, len(episode) - order + 1, _WINDOWS):
            piece = episode.U[first : first + _WINDOWS + order - 1]
            table = np.lib.stride_tricks.sliding_window_view(piece, order, axis=0)
            waiting.append(table.transpose(0, 2, 1).reshape(len(table), width))
            held += len(table)
            if held >= _WINDOWS:
                R, windows = np.linalg.qr(np.concatenate([R, *waiting]), mode="r"), windows + held
                waiting, held = [], 0
    R, windows = np.linalg.qr(np.concatenate([R, *waiting]), mode="r"), windows + held
    R = unit(np.asarray(R, dtype=np.float64))
    cut = np.finfo(float).eps * max(windows, width)
    conditions = np.full(order, np.inf)
    for L in range(1, order + 1):
        s = np.linalg.svd(R[:, : episodes.nu * L], compute_uv=False)
        if len(s) < episodes.nu * L or s[-1] <= cut * s[0]:
            break
        conditions[L - 1] = s[0] / s[-1]
    return Persistency(int(np.isfinite(conditions).sum()), order, conditions, windows)


def feedback_share(
    episodes: Episodes | Source, lifting: Lifting | AnyPredictor, *, embedding: Delay | None = None
) -> Float[np.ndarray, " nu"]:
    """Return for each input the share R² of its energy that is a linear function of ψ(x), 0 … 1.

    At 1 the input was a feedback u = K ψ(x), and A and B cannot be told apart. Where ψ holds a Constant, the energy
    is that around the mean.

    Parameters
    ----------
    episodes
        Episodes with inputs, or a source of them; measured disturbances count as inputs behind u.
    lifting
        ψ; or a predictor, for its lifting and embedding.
    embedding
        What a lifting of the state and its past acts on.

    Raises
    ------
    ShapeError, DataError
        The episodes and the predictor differ in states, inputs, disturbances or dt.
    """
    return explained_inputs(moments_of(episodes, lifting, embedding=embedding))


def explained_inputs(total: Moments) -> Float[np.ndarray, " nu"]:
    """Return the shares of `feedback_share` from the moments, in the order of their inputs."""
    P, _, cut = both_sides(total)
    nz, nu = total.nz, len(total.inputs)
    one = total.lifting.constant_index
    constant = [] if one is None else [one]
    U = P[:, nz : nz + nu]
    around = _outside(U, P[:, constant], cut)
    left = _outside(U, P[:, :nz], cut)
    varies = around > cut * norms(U)
    return 1.0 - np.divide(left**2, around**2, out=np.zeros(nu), where=varies)


def _outside(U: Float[np.ndarray, "m nu"], columns: Float[np.ndarray, "m n"], cut: float) -> Float[np.ndarray, " nu"]:
    """Return the norm of what each column of U has outside the span of `columns`."""
    if columns.shape[1] == 0:
        return norms(U)
    basis = orthonormal(columns, cut)
    return norms(U - basis @ (basis.T @ U))
