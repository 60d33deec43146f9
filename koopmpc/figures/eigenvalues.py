# pyright: basic
"""The eigenvalues of A over the unit circle, and how far each can be trusted."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from koopmpc.figures.style import SEQUENTIAL, figure, styled
from koopmpc.validate.residuals import ResidualDMD, eigenpairs
from koopmpc.validate.scoring import AnyPredictor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LEAST, _MOST = 1e-12, 1e3  # residuals below are rounding; those above are drawn as if they were the second
_CROWDED = 0.35  # share of the picture below which the eigenvalues get a closer picture


@styled
def spectrum(predictor: AnyPredictor, residuals: ResidualDMD | ArrayLike | None = None) -> "Figure":
    """Draw the eigenvalues λ of A in the complex plane with |λ| = 1, and the residual of each eigenpair.

    The darker and larger a point the smaller its residual; an eigenvalue with a residual above the tolerance is a
    cross: it may be spurious.

    Parameters
    ----------
    predictor
        The model whose `eigenvalues` are drawn.
    residuals
        A `ResidualDMD`, as `trust` and `residual_dmd` return, with its tolerance; or (nz,) in the order of
        ``predictor.eigenvalues``, with a tolerance of 0.05. Without them all points look alike.

    Raises
    ------
    ShapeError
        There is not one residual for each eigenvalue.
    DataError
        A residual is negative or NaN.
    """
    from matplotlib.lines import Line2D

    known = None if residuals is None else eigenpairs(predictor, residuals)
    values: Any = predictor.eigenvalues if known is None else known.eigenvalues
    whole = 1.12 * max(1.0, float(np.abs(values).max(initial=0.0)))
    views = [(0.0, 0.0, whole)]
    middle, half = _box(values)
    if half < _CROWDED * whole:
        views.append((middle.real, middle.imag, 1.4 * half + 1e-3))
    made, grid = figure(1, len(views), width="one column" if len(views) == 1 else "two columns", height=3.1)
    turn = np.linspace(0, 2 * np.pi, 721)
    points: Any = None
    for axes, (x, y, size) in zip(grid[0], views, strict=True):
        axes.plot(np.cos(turn), np.sin(turn), color="#555555", linewidth=0.9, gid="unit circle")
        if known is None:
            axes.plot(values.real, values.imag, "o", color="#0072b2", markeredgecolor="black", gid="eigenvalues")
        else:
            points = _with_residuals(axes, values, known)
        axes.set(xlim=(x - size, x + size), ylim=(y - size, y + size), aspect="equal")
        axes.set(xlabel="Re λ", ylabel="Im λ", title="closer" if size < whole else "")
    if known is not None:
        made.colorbar(points, ax=grid[0, -1], label="residual of the eigenpair", shrink=0.85)
        fine: dict[str, Any] = {"marker": "o", "color": "#404040", "label": f"residual ≤ {known.tolerance:g}"}
        bad: dict[str, Any] = {
            "marker": "x",
            "color": "black",
            "label": f"above: may be spurious ({np.sum(known.spurious)} of {len(values)})",
        }
        handles = [Line2D([], [], linestyle="none", **look) for look in (fine, bad)]
        made.legend(handles=handles, loc="outside lower center", ncols=2, handlelength=1.0)
    return made


def _box(values: Any) -> tuple[complex, float]:
    """Return the middle of the eigenvalues and half the side of a square that holds them."""
    low, high = values.real.min() + 1j * values.imag.min(), values.real.max() + 1j * values.imag.max()
    return (low + high) / 2, max((high - low).real, (high - low).imag) / 2


def _with_residuals(axes: Any, values: Any, known: ResidualDMD) -> Any:
    """Draw the points and return them: the smaller the residual the darker and larger."""
    import matplotlib as mpl
    from matplotlib.colors import ListedColormap, LogNorm

    shown = np.clip(known.residuals, _LEAST, _MOST)
    low, high = min(float(shown.min()), known.tolerance / 10), max(float(shown.max()), known.tolerance * 10)
    norm = LogNorm(10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high)))
    sizes = 12.0 + 40.0 * (1.0 - np.asarray(norm(shown)))
    darker = np.linspace(0, 0.85, 256)  # the light end of the scale is too light for points
    shades = ListedColormap(mpl.colormaps[SEQUENTIAL](darker))
    points = None
    for chosen, marker in ((~known.spurious, "o"), (known.spurious, "x")):
        look: dict[str, Any] = {"edgecolors": "black"} if marker == "o" else {}
        points = axes.scatter(
            values.real[chosen],
            values.imag[chosen],
            c=shown[chosen],
            s=sizes[chosen],
            marker=marker,
            cmap=shades,
            norm=norm,
            linewidths=0.5 if marker == "o" else 1.3,
            zorder=3,
            gid="eigenvalues" if marker == "o" else "spurious eigenvalues",
            **look,
        )
    return points
