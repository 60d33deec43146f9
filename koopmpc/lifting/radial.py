"""Gaussian, ThinPlate and PolynomialKernel: functions of the state and of fixed centres."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, cast

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import freeze
from koopmpc.lifting.base import Lifting

_CANCELS = 1e-3  # sum ‖x − c‖² again if it is below this share of ‖x‖² + ‖c‖²: it has then lost three digits


def check_centers(centers: ArrayLike) -> Float[np.ndarray, "nc nx"]:
    """Return the centres as rows; raise if there are none, or if they are not rows."""
    rows = checks.array(centers, "centers", (None, None))
    if rows.size == 0:
        raise DataError(f"centers has shape {rows.shape}; pass at least one row, one row for each centre")
    return rows


def format_centers(centers: Float[np.ndarray, "nc nx"], states: tuple[str, ...]) -> list[str]:
    """Return each centre as text such as ``"0.5, -1"``, with all digits, so that a name fixes the function."""
    if centers.shape[1] != len(states):
        raise ShapeError(
            f"centers has {centers.shape[1]} columns and there are {len(states)} states "
            f"({', '.join(states)}); pass a centre as one row of {len(states)} numbers"
        )
    return [", ".join(repr(value).removesuffix(".0") for value in row) for row in centers.tolist()]


def write_squared_distances(
    x: Float[np.ndarray, "nx M"], centers: Float[np.ndarray, "nc nx"], out: Float[np.ndarray, "M nc"]
) -> None:
    """Write ‖x − c‖² for each column of x and each centre to `out`.

    The distances come from one matrix product, ‖x‖² − 2 xᵀc + ‖c‖² about the mean of the centres. For x near c the
    terms cancel; these distances are summed again from the differences. The relative error is below 1e-12 everywhere.
    """
    mean = centers.mean(axis=0)
    x_shifted, c_shifted = x - mean[:, None], centers - mean
    x_squares = np.einsum("ij,ij->j", x_shifted, x_shifted)
    c_squares = np.einsum("ij,ij->i", c_shifted, c_shifted)
    left = np.vstack([x_shifted, x_squares, np.ones(len(x_squares))])
    np.matmul(left.T, np.vstack([-2.0 * c_shifted.T, np.ones(len(c_squares)), c_squares]), out=out)
    rows, which = divmod(np.flatnonzero(out < (_CANCELS * (x_squares + c_squares.max()))[:, None]), len(centers))
    difference = x[:, rows] - centers[which].T
    out[rows, which] = np.einsum("ij,ij->j", difference, difference)


def symbolic_squared_distances(x: ca.SX, centers: "Float[np.ndarray, 'nc nx'] | ca.SX") -> list[ca.SX]:
    """Return ‖x − c‖² for each centre; the centres are numbers or symbols, and the sums run in one order."""
    rows, totals = ca.SX(centers), list[ca.SX]()
    for j in range(rows.shape[0]):
        total = ca.SX(0)
        for i in range(rows.shape[1]):
            total += (x[i] - rows[j, i]) ** 2
        totals.append(total)
    return totals


@dataclass(frozen=True, eq=False, init=False)
class Gaussian(Lifting):
    """ψ(x) = exp(−‖x − c‖² / (2 width²)) for each centre c.

    Parameters
    ----------
    centers
        (nc, nx), one centre a row.
    width
        Standard deviation of the bell, in the unit of the states: one number, or (nc,) with one for each centre. Scale
        states of very different sizes, by `Standardized`.

    Raises
    ------
    DataError
        There is no centre, or a width is not above zero.
    ShapeError
        The centres are not rows, or there are more or fewer widths than centres. When the lifting is bound: the
        centres have more or fewer columns than there are states.
    """

    tunable: ClassVar[Mapping[str, str]] = {"centers": "real", "width": "positive"}
    centers: Float[np.ndarray, "nc nx"]
    width: float | Float[np.ndarray, " nc"]

    def __init__(self, centers: ArrayLike, width: ArrayLike, *, bound: tuple[str, ...] | None = None) -> None:
        rows = check_centers(centers)
        if checks.array(width, "width").ndim == 0:
            freeze(self, centers=rows, width=checks.positive(cast("float", width), "width"), bound=bound)
            return
        widths = checks.array(width, "width", (len(rows),))
        if not (widths > 0).all():
            raise DataError(f"width holds {widths.min():g}; every width must be above zero")
        freeze(self, centers=rows, width=widths, bound=bound)

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"gaussian(0.5, -1; 0.3)"``, which hold the centre and the width."""
        centers, widths = format_centers(self.centers, states), np.broadcast_to(self.width, len(self.centers)).tolist()
        return tuple(f"gaussian({c}; {width!r})" for c, width in zip(centers, widths, strict=True))

    def formula(self, x: ca.SX) -> ca.SX:
        """Return exp(−‖x − c‖² / (2 width²)) for each centre."""
        distances = ca.vertcat(*symbolic_squared_distances(x, self.centers))
        return ca.exp(ca.SX(-0.5 / self.width**2) * distances)

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        write_squared_distances(x, self.centers, Z)
        np.multiply(Z, -0.5 / self.width**2, out=Z)
        np.exp(Z, out=Z)


_TINY = 1e-100  # added to r²: keeps ln r² and its first two derivatives finite at the centre, is rounded off elsewhere


@dataclass(frozen=True, eq=False, init=False)
class ThinPlate(Lifting):
    """ψ(x) = r² ln r with r = ‖x − c‖ for each centre c; 0 at the centre.

    Parameters
    ----------
    centers
        (nc, nx), one centre a row.

    Raises
    ------
    DataError
        There is no centre.
    ShapeError
        The centres are not rows. When the lifting is bound: they are made for another number of states.
    """

    tunable: ClassVar[Mapping[str, str]] = {"centers": "real"}
    centers: Float[np.ndarray, "nc nx"]

    def __init__(self, centers: ArrayLike, *, bound: tuple[str, ...] | None = None) -> None:
        freeze(self, centers=check_centers(centers), bound=bound)

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"thinplate(0.5, -1)"``, which hold the centre."""
        return tuple(f"thinplate({c})" for c in format_centers(self.centers, states))

    def formula(self, x: ca.SX) -> ca.SX:
        """Return ½ r² ln r²."""
        return ca.vertcat(*(0.5 * r2 * ca.log(r2 + _TINY) for r2 in symbolic_squared_distances(x, self.centers)))

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        write_squared_distances(x, self.centers, Z)
        logarithm = np.log(Z + _TINY)
        np.multiply(Z, 0.5, out=Z)
        np.multiply(Z, logarithm, out=Z)


@dataclass(frozen=True, eq=False, init=False)
class PolynomialKernel(Lifting):
    """ψ(x) = (1 + xᵀc)^degree for each centre c; with enough centres they span all monomials up to the degree."""

    tunable: ClassVar[Mapping[str, str]] = {"centers": "real"}
    centers: Float[np.ndarray, "nc nx"]
    degree: int

    def __init__(self, centers: ArrayLike, degree: int, *, bound: tuple[str, ...] | None = None) -> None:
        checks.count(degree, "degree")
        freeze(self, centers=check_centers(centers), degree=int(degree), bound=bound)

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return names such as ``"polynomial(0.5, -1; 3)"``, which hold the centre and the degree."""
        return tuple(f"polynomial({c}; {self.degree})" for c in format_centers(self.centers, states))

    def formula(self, x: ca.SX) -> ca.SX:
        """Return (1 + xᵀc)^degree for each centre."""
        return (1 + ca.SX(self.centers) @ x) ** self.degree

    def _fill(self, x: Float[np.ndarray, "nx M"], Z: Float[np.ndarray, "M nz"]) -> None:
        np.matmul(x.T, self.centers.T, out=Z)
        np.add(Z, 1.0, out=Z)
        np.power(Z, self.degree, out=Z)
