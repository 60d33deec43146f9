"""A few rows [P T] that stand for all snapshots, the products of T with itself included."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.identify.moments import Moments
from koopmpc.identify.solve import norms, unit


class BothSides(NamedTuple):
    """Rows with PᵀP = Σ pᵀp, PᵀT and TᵀT of the M snapshots, p = [ψ(x) u] and t = ψ(x⁺).

    Attributes
    ----------
    P
        (m, n) the observables, the inputs, and for a bilinear model their products.
    T
        (m, nz) the observables one step later.
    cut
        Singular values below this part of the largest are rounding, on columns of unit norm.
    """

    P: Float[np.ndarray, "m n"]
    T: Float[np.ndarray, "m nz"]
    cut: float


def both_sides(total: Moments) -> BothSides:
    """Return these rows, and where rounding begins: with Gram sums at half the digits."""
    rows = total.complete(total.regressors, total.targets[: total.nz])
    rounding = float(np.finfo(float).eps * max(total.samples, len(total.regressors) + total.nz))
    return BothSides(rows.P, rows.T, rounding if total.route == "qr" else float(np.sqrt(rounding)))


def orthonormal(columns: Float[np.ndarray, "m n"], cut: float) -> Float[np.ndarray, "m r"]:
    """Return an orthonormal basis of the span of these columns, those of norm 0 left out."""
    live = unit(columns[:, norms(columns) > 0])
    U, s, _ = np.linalg.svd(live, full_matrices=False)
    return U[:, s > cut * s.max(initial=0.0)]
