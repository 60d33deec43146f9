"""plot_spectrum: the eigenvalues of A over the unit circle, and how far each can be trusted."""
# pyright: basic

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError
from koopmpc.figures.style import SEQUENTIAL, figure, styled
from koopmpc.predict.bilinear import BilinearPredictor
from koopmpc.predict.linear import LinearPredictor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LEAST = 1e-12  # residuals below it are rounding


@styled
def plot_spectrum(
    predictor: LinearPredictor | BilinearPredictor,
    residuals: ArrayLike | None = None,
    *,
    tolerance: float = 0.1,
) -> "Figure":
    """Draw the eigenvalues λ of A in the complex plane with |λ| = 1, and the residual of each eigenpair.

    The darker and larger a point the smaller its residual; an eigenvalue with a residual above the tolerance is a
    cross: it may be spurious.

    Parameters
    ----------
    predictor
        Its `eigenvalues` are drawn.
    residuals
        (nz,) in the order of ``predictor.eigenvalues``; without them all points look alike.
    tolerance
        The largest residual of an eigenvalue that is not marked.

    Raises
    ------
    ShapeError
        There is not one residual for each eigenvalue.
    DataError
        A residual is negative or NaN.
    """
    from matplotlib.lines import Line2D

    values: Any = predictor.eigenvalues
    known = None if residuals is None else checked_residuals(residuals, len(values))
    limit = checks.positive(tolerance, "tolerance")
    made, grid = figure(height=3.1)
    axes = grid[0, 0]
    turn = np.linspace(0, 2 * np.pi, 361)
    axes.plot(np.cos(turn), np.sin(turn), color="#555555", linewidth=0.9, gid="unit circle")
    if known is None:
        axes.plot(values.real, values.imag, "o", color="#0072b2", markeredgecolor="black", gid="eigenvalues")
    else:
        _with_residuals(made, axes, values, known, limit)
        fine: dict[str, Any] = {"marker": "o", "color": "#404040", "label": f"residual ≤ {limit:g}"}
        bad: dict[str, Any] = {
            "marker": "x",
            "color": "black",
            "label": f"above: may be spurious ({np.sum(known > limit)})",
        }
        handles = [Line2D([], [], linestyle="none", **look) for look in (fine, bad)]
        made.legend(handles=handles, loc="outside lower center", ncols=2, handlelength=1.0)
    size = 1.12 * max(1.0, float(np.abs(values).max(initial=0.0)))
    axes.set(xlim=(-size, size), ylim=(-size, size), aspect="equal", xlabel="Re λ", ylabel="Im λ")
    return made


def checked_residuals(residuals: ArrayLike, nz: int) -> np.ndarray:
    """Return the residuals as (nz,) numbers from 0 on."""
    known = checks.array(residuals, "residuals", (nz,))
    if (known < 0).any():
        raise DataError(f"residuals holds {known.min():g}; they are norms, from 0 on")
    return known


def _with_residuals(made: Any, axes: Any, values: Any, residuals: np.ndarray, limit: float) -> None:
    from matplotlib.colors import LogNorm

    shown = np.maximum(residuals, _LEAST)
    low, high = min(float(shown.min()), limit / 10), max(float(shown.max()), limit * 10)
    norm = LogNorm(10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high)))
    sizes = 12.0 + 40.0 * (1.0 - np.asarray(norm(shown)))
    points = None
    for chosen, marker in ((residuals <= limit, "o"), (residuals > limit, "x")):
        look = {"edgecolors": "black"} if marker == "o" else {}
        points = axes.scatter(
            values.real[chosen],
            values.imag[chosen],
            c=shown[chosen],
            s=sizes[chosen],
            marker=marker,
            cmap=SEQUENTIAL,
            norm=norm,
            linewidths=0.5 if marker == "o" else 1.3,
            zorder=3,
            gid="eigenvalues" if marker == "o" else "spurious eigenvalues",
            **look,
        )
    made.colorbar(points, ax=axes, label="residual of the eigenpair", shrink=0.85)
