"""What the radial families share: centres, distances to them, names."""

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError, ShapeError

_CANCELS = 1e-3  # share of ‖x‖² + ‖c‖² below which a distance squared has lost three digits


def checked_centers(centers: ArrayLike) -> Float[np.ndarray, "nc nx"]:
    """Return the centres as rows; raise where there are none, or not in rows."""
    rows = checks.array(centers, "centers", (None, None))
    if rows.size == 0:
        raise DataError(f"centers has shape {rows.shape}; pass at least one row, a row a centre")
    return rows


def center_names(
    family: str, centers: Float[np.ndarray, "nc nx"], states: tuple[str, ...], suffix: str = ""
) -> tuple[str, ...]:
    """Return ``"family(0.5, -1)"`` for each centre: one name is one function, to the last digit."""
    if centers.shape[1] != len(states):
        raise ShapeError(
            f"centers has {centers.shape[1]} columns and there are {len(states)} states "
            f"({', '.join(states)}); pass a centre as one row of {len(states)} numbers"
        )
    return tuple(f"{family}({', '.join(map(_number, row.tolist()))}{suffix})" for row in centers)


def squared_distances(
    x: Float[np.ndarray, "nx M"], centers: Float[np.ndarray, "nc nx"], out: Float[np.ndarray, "M nc"]
) -> None:
    """Write ‖x − c‖² for each column of x and each centre to `out`.

    It is one matrix product, ‖x‖² − 2 xᵀc + ‖c‖² about the mean of the centres. Where that cancels, for x near c, it is
    summed from the differences again, so that its relative error is below 1e-12 everywhere.
    """
    middle = centers.mean(axis=0)
    near, far = x - middle[:, None], centers - middle
    own, square = np.einsum("ij,ij->j", near, near), np.einsum("ij,ij->i", far, far)
    left = np.vstack([near, own, np.ones(len(own))])
    np.matmul(left.T, np.vstack([-2.0 * far.T, np.ones(len(square)), square]), out=out)
    rows, which = divmod(np.flatnonzero(out < (_CANCELS * (own + square.max()))[:, None]), len(centers))
    difference = x[:, rows] - centers[which].T
    out[rows, which] = np.einsum("ij,ij->j", difference, difference)


def symbolic_squared_distances(x: ca.SX, centers: Float[np.ndarray, "nc nx"]) -> list[ca.SX]:
    """Return ‖x − c‖² for each centre, summed in the same order."""
    totals: list[ca.SX] = []
    for center in centers.tolist():
        total = ca.SX(0)
        for i, coordinate in enumerate(center):
            total += (x[i] - coordinate) ** 2
        totals.append(total)
    return totals


def _number(value: float) -> str:
    return repr(value).removesuffix(".0")
