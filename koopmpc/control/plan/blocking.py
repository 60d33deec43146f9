"""Own blocks of each input: the condensed horizon with some of its moves tied to the move before."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import null_space

from koopmpc.control.horizon import Condensed


def tie_moves(maps: Condensed, held: Bool[np.ndarray, "moves nu"]) -> Condensed:
    """Return the maps of a plan whose inputs keep their value from the move before where they are `held`.

    In Riccati coordinates a plan costs unit · ‖w‖² above the one without ties, v + D w. The ties are T (v + D w) = 0,
    so the cheapest plan that keeps them has w = −(T D)⁺ T v, and every other one adds a w of the null space of T D.
    The null space is turned so that its first column moves the first free input and all later ones, and so on; the
    entries of w that are left over move nothing.
    """
    moves, nu = held.shape
    n, none = moves * nu, np.zeros(maps.deviation.shape)
    tied, free = np.flatnonzero(held.ravel()), np.flatnonzero(~held.ravel())
    D = maps.deviation
    T = np.zeros((len(tied), n))
    T[np.arange(len(tied)), tied], T[np.arange(len(tied)), tied - nu] = 1.0, -1.0
    TD = T @ D[:n]
    back = -D @ np.linalg.pinv(TD)
    basis = null_space(TD)
    basis = basis @ np.linalg.qr((D[free] @ basis).T)[0]
    none[:, free] = D @ basis

    def tie(rows: Float[np.ndarray, "nv m"]) -> Float[np.ndarray, "nv m"]:
        return rows + back @ (T @ rows[:n])

    def exact(rows: Float[np.ndarray, "nv m"]) -> Float[np.ndarray, "nv m"]:
        """Return rows in which a tied input is that of the move before, to the bit."""
        for i in tied:
            rows[i] = rows[i - nu]
        return rows

    return replace(
        maps,
        from_state=exact(tie(maps.from_state)),
        from_reference=exact(tie(maps.from_reference)),
        from_target=exact(tie(maps.from_target)),
        from_given=exact(tie(maps.from_given)),
        from_drive=exact(tie(maps.from_drive)),
        offset=exact(tie(maps.offset[:, None]))[:, 0],
        deviation=exact(none),
    )
