# pyright: basic
"""Figures of the spectrum of a model: eigenvalues in the complex plane, eigenfunctions over a plane of two states."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.values import Value
from koopmpc.data.episodes import Episodes
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.validate.residuals import ResidualDMD, check_residuals
from koopmpc.validate.scoring import AnyPredictor
from koopmpc.views.figures.style import CYCLIC, SEQUENTIAL, Width, find_plane, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_CUT = 0.8 * np.pi  # [rad] lines of equal phase end here, because the phase jumps at ±π
_LABEL_BOX: dict[str, Any] = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 0.8}
_QUARTERS = {-np.pi / 2: "−π/2", 0.0: "0", np.pi / 2: "π/2"}
Axes = tuple[int | str, int | str]
Over = Episodes | Sequence[tuple[float, float]]


@styled
def spectrum(predictor: AnyPredictor, residuals: ResidualDMD | ArrayLike | None = None) -> "Figure":
    """Draw the eigenvalues λ of A in the complex plane with |λ| = 1, and the residual of each eigenpair.

    A point with a smaller residual is darker and larger. A cross marks an eigenvalue with a residual above the
    tolerance, which may be spurious.

    Parameters
    ----------
    predictor
        The model whose `eigenvalues` are drawn.
    residuals
        A `ResidualDMD` with its tolerance, as `trust` and `residual_dmd` return it; or an array (nz,) in the order of
        ``predictor.eigenvalues``, with a tolerance of 0.05. Without residuals all points look alike.

    Raises
    ------
    ShapeError
        The number of residuals differs from the number of eigenvalues.
    DataError
        A residual is negative or NaN.
    """
    from matplotlib.lines import Line2D

    checks.kind(predictor, "predictor", (LinearPredictor, BilinearPredictor), "pass a model, as edmd returns")
    checked = None if residuals is None else check_residuals(predictor, residuals)
    values: Any = predictor.eigenvalues if checked is None else checked.eigenvalues
    whole = 1.12 * max(1.0, float(np.abs(values).max(initial=0.0)))
    views = [(0.0, 0.0, whole)]
    middle, half = _find_square(values)
    # draw a second, closer panel if the eigenvalues fill less than this share of the first
    if half < 0.35 * whole:
        views.append((middle.real, middle.imag, 1.4 * half + 1e-3))
    drawing, grid = make_figure(1, len(views), width="one column" if len(views) == 1 else "two columns", height=3.1)
    turn = np.linspace(0, 2 * np.pi, 721)
    points: Any = None
    for axes, (x, y, size) in zip(grid[0], views, strict=True):
        axes.plot(np.cos(turn), np.sin(turn), color="#555555", linewidth=0.9, gid="unit circle")
        if checked is None:
            axes.plot(values.real, values.imag, "o", color="#0072b2", markeredgecolor="black", gid="eigenvalues")
        else:
            points = _draw_residuals(axes, values, checked)
        axes.set(xlim=(x - size, x + size), ylim=(y - size, y + size), aspect="equal")
        axes.set(xlabel="Re λ", ylabel="Im λ", title="closer" if size < whole else "")
    if checked is not None:
        drawing.colorbar(points, ax=grid[0, -1], label="residual of the eigenpair", shrink=0.85)
        good: dict[str, Any] = {"marker": "o", "color": "#404040", "label": f"residual ≤ {checked.tolerance:g}"}
        bad: dict[str, Any] = {
            "marker": "x",
            "color": "black",
            "label": f"above: may be spurious ({np.sum(checked.spurious)} of {len(values)})",
        }
        handles = [Line2D([], [], linestyle="none", **look) for look in (good, bad)]
        drawing.legend(handles=handles, loc="outside lower center", ncols=2, handlelength=1.0)
    return drawing


def _find_square(values: Any) -> tuple[complex, float]:
    """Return the middle and half the side of a square that contains the eigenvalues."""
    low, high = values.real.min() + 1j * values.imag.min(), values.real.max() + 1j * values.imag.max()
    return (low + high) / 2, max((high - low).real, (high - low).imag) / 2


def _draw_residuals(axes: Any, values: Any, checked: ResidualDMD) -> Any:
    """Draw the eigenvalues, darker and larger for smaller residuals, and return the points."""
    import matplotlib as mpl
    from matplotlib.colors import ListedColormap, LogNorm

    # smaller residuals are rounding, and are drawn with this value
    shown = np.clip(checked.residuals, 1e-12, 1e3)  # larger residuals are drawn with this value
    low, high = min(float(shown.min()), checked.tolerance / 10), max(float(shown.max()), checked.tolerance * 10)
    norm = LogNorm(10.0 ** np.floor(np.log10(low)), 10.0 ** np.ceil(np.log10(high)))
    sizes = 12.0 + 40.0 * (1.0 - np.asarray(norm(shown)))
    darker = np.linspace(0, 0.85, 256)  # the light end of the scale is too light for points
    map_colors = ListedColormap(mpl.colormaps[SEQUENTIAL](darker))
    points = None
    for chosen, marker in ((~checked.spurious, "o"), (checked.spurious, "x")):
        look: dict[str, Any] = {"edgecolors": "black"} if marker == "o" else {}
        points = axes.scatter(
            values.real[chosen],
            values.imag[chosen],
            c=shown[chosen],
            s=sizes[chosen],
            marker=marker,
            cmap=map_colors,
            norm=norm,
            linewidths=0.5 if marker == "o" else 1.3,
            zorder=3,
            gid="eigenvalues" if marker == "o" else "spurious eigenvalues",
            **look,
        )
    return points


@dataclass(frozen=True, eq=False)
class Plane(Value):
    """A grid over two states, with all other states fixed.

    Attributes
    ----------
    axes
        Indices of the two states.
    names
        Their names with units.
    across, up
        Grid lines of the first and of the second state.
    at
        (nx,) a state in the plane; it fixes the other states.
    """

    axes: tuple[int, int]
    names: tuple[str, str]
    across: Float[np.ndarray, " nc"]
    up: Float[np.ndarray, " nr"]
    at: Float[np.ndarray, " nx"]

    @property
    def points(self) -> Float[np.ndarray, "M nx"]:
        """States of the grid, one a row; `up` is the slow index."""
        X = np.tile(self.at, (len(self.up) * len(self.across), 1))
        X[:, self.axes[0]] = np.tile(self.across, len(self.up))
        X[:, self.axes[1]] = np.repeat(self.up, len(self.across))
        return X


def make_plane(states: Sequence[str], axes: Axes, over: Over, at: ArrayLike | None = None, points: int = 121) -> Plane:
    """Return the plane over the two states `axes`.

    Parameters
    ----------
    states
        Names of all states.
    axes
        The two states of the plane, by index or name.
    over
        Two ranges (low, high), or episodes: then the ranges of their states.
    at
        (nx,) values at which the other states are fixed; by default the median of the episodes, or 0 without them.
    points
        Grid lines along each axis.

    Raises
    ------
    DataError
        There is no such state, both axes are the same state, or a range is empty.
    """
    first, second = find_plane(axes, states, "the plane")
    if isinstance(over, Episodes):
        X = np.concatenate([episode.X for episode in over])
        ranges = np.column_stack([X.min(axis=0), X.max(axis=0)])[[first, second]]
        fixed = np.median(X, axis=0)
    else:
        ranges, fixed = checks.array(cast(ArrayLike, over), "over", (2, 2)), np.zeros(len(states))
    for name, (low, high) in zip((states[first], states[second]), ranges, strict=True):
        if not low < high:
            raise DataError(f"the range of {name} is {low:g} to {high:g}; pass (low, high) with low < high")
    lines = checks.count(points, "points", least=2)
    return Plane(
        (first, second),
        (states[first], states[second]),
        np.linspace(float(ranges[0, 0]), float(ranges[0, 1]), lines),
        np.linspace(float(ranges[1, 0]), float(ranges[1, 1]), lines),
        fixed if at is None else checks.array(at, "at", (len(states),)),
    )


def evaluate_eigenfunctions(
    predictor: LinearPredictor, which: int | Sequence[int], plane: Plane
) -> Complex[np.ndarray, "k nr nc"]:
    """Return φ_j on the grid for each j of `which`, scaled so that the largest |φ_j| on the grid is 1.

    An eigenfunction is unique up to a factor, so the phase of a complex one has an arbitrary offset.

    Raises
    ------
    DataError
        There is no such eigenvalue, φ_j is 0 on the whole plane, or A is defective.
    """
    chosen = [which] if isinstance(which, int | np.integer) else list(which)
    for j in chosen:
        if not 0 <= j < predictor.nz:
            raise DataError(f"there is no eigenfunction {j}; the predictor has 0 … {predictor.nz - 1}")
    if not chosen:
        raise DataError("which is empty; pass the index of an eigenfunction, or several")
    left, X = predictor.left_eigenvectors[chosen].T, plane.points
    rows = 4096  # states that are lifted in one block
    parts = [predictor.lift(X[i : i + rows]) @ left for i in range(0, len(X), rows)]
    phi = np.concatenate(parts).T.reshape(len(chosen), len(plane.up), len(plane.across))
    largest = np.abs(phi).max(axis=(1, 2))
    if (largest == 0).any():
        j = chosen[int(np.argmin(largest))]
        raise DataError(f"eigenfunction {j} is 0 on the whole plane; fix the other states at other values (at=…)")
    return phi / largest[:, None, None]


@styled
def eigenfunction_maps(
    predictor: LinearPredictor,
    which: int | Sequence[int],
    plane: Axes,
    over: Over,
    *,
    at: ArrayLike | None = None,
    points: int = 121,
) -> "Figure":
    """Draw φ_j(x) = ξ_jᴴ ψ(x) over two states: |φ_j| and its phase, or φ_j itself if its eigenvalue is real.

    The largest |φ_j| of the plane is 1. Without inputs, all states on one line of equal |φ_j| move to one other such
    line; the same holds for lines of equal phase.

    Parameters
    ----------
    predictor
        Linear.
    which
        Indices j in the order of ``predictor.eigenvalues``.
    plane
        The states of the horizontal and of the vertical axis, by index or name.
    over
        Two ranges ((low, high), (low, high)), or episodes: then the ranges of their states.
    at
        (nx,) values at which the other states are fixed; by default the median of the episodes, or 0 without them.
    points
        Grid lines along each axis.

    Raises
    ------
    DataError
        There is no such eigenfunction or state, a range is empty, A is defective, or φ_j is 0 on the plane.
    """
    checks.kind(predictor, "predictor", (LinearPredictor, BilinearPredictor), "pass a model, as edmd returns")
    embedded = predictor.embed(over) if isinstance(over, Episodes) else over
    grid = make_plane(predictor.point_names, plane, embedded, at, points)
    phi = evaluate_eigenfunctions(predictor, which, grid)
    chosen = [which] if isinstance(which, int | np.integer) else list(which)
    values: Any = predictor.eigenvalues[chosen]
    real = values.imag == 0
    cells: list[tuple[int, str]] = []
    for k, is_real in enumerate(real):
        if not is_real and len(cells) % 2:
            cells.append((k, "empty"))  # magnitude and phase are drawn side by side
        cells += [(k, "real")] if is_real else [(k, "magnitude"), (k, "phase")]
    columns = min(len(cells), 2)
    rows = -(-len(cells) // columns)
    width: Width = "one column" if columns == 1 else "two columns"
    drawing, axes = make_figure(rows, columns, width=width, height=0.4 + 2.4 * rows)
    panels = axes.flat[: len(cells)]
    for panel, (k, kind) in zip(panels, cells, strict=True):
        _draw_cell(drawing, panel, grid, phi[k], values[k], f"φ{_format_subscript(chosen[k])}", kind)
    unused = [panel for panel, (_, kind) in zip(panels, cells, strict=True) if kind == "empty"]
    for panel in (*axes.flat[len(cells) :], *unused):
        panel.remove()
    return drawing


def _draw_cell(drawing: Any, axes: Any, plane: Plane, phi: Any, value: complex, name: str, kind: str) -> None:
    match kind:
        case "real":
            _draw_surface(drawing, axes, plane, phi.real, name)
        case "magnitude":
            _draw_surface(drawing, axes, plane, np.abs(phi), f"|{name}|")
        case "phase":
            _draw_phase(drawing, axes, plane, np.angle(phi), f"phase of {name} [rad]")
        case _:
            return
    imaginary = "" if value.imag == 0 else f" {'+' if value.imag > 0 else '−'} {abs(value.imag):.4g}i"
    axes.set(title=f"λ = {value.real:.4g}{imaginary}", xlabel=plane.names[0], ylabel=plane.names[1])
    axes.grid(visible=False)


def _format_subscript(j: int) -> str:
    return str(j).translate(str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉"))


def _draw_surface(drawing: Any, axes: Any, plane: Plane, values: np.ndarray, label: str) -> None:
    """Draw the values as colours, with labelled lines of equal value; lines below zero are dashed."""
    mesh = axes.pcolormesh(plane.across, plane.up, values, cmap=SEQUENTIAL, shading="gouraud", rasterized=True)
    drawing.colorbar(mesh, ax=axes, label=label)
    if np.ptp(values) > 1e-9:
        lines = axes.contour(plane.across, plane.up, values, levels=6, colors="white", linewidths=0.7)
        axes.clabel(lines, fontsize=6, fmt="%g")


def _draw_phase(drawing: Any, axes: Any, plane: Plane, phase: np.ndarray, label: str) -> None:
    """Draw the phase in cyclic colours, with lines at −π/2, 0 and π/2 that are readable in black and white."""
    from matplotlib.patheffects import withStroke

    mesh = axes.pcolormesh(
        plane.across, plane.up, phase, cmap=CYCLIC, vmin=-np.pi, vmax=np.pi, shading="nearest", rasterized=True
    )
    bar = drawing.colorbar(mesh, ax=axes, label=label)
    bar.set_ticks([-np.pi, *_QUARTERS, np.pi], labels=["−π", *_QUARTERS.values(), "π"])
    inner = np.where(np.abs(phase) < _CUT, phase, np.nan)
    inside = np.abs(inner[np.isfinite(inner)])
    if inside.size and np.ptp(phase) > 1e-9:
        look: dict[str, Any] = {
            "levels": list(_QUARTERS),
            "colors": "black",
            "linewidths": 0.8,
            "linestyles": ["--", "-", ":"],
        }
        lines = axes.contour(plane.across, plane.up, inner, **look)
        halo = withStroke(linewidth=2.0, foreground="white")  # the darkest colour is as dark as the line
        lines.set_path_effects([halo])
        across = np.quantile(plane.across, [0.08, 0.92])  # labels beyond would be cut
        texts: Any = axes.clabel(lines, fontsize=6, fmt=_QUARTERS, inline=False)
        for text in texts:
            text.set(x=np.clip(text.get_position()[0], *across), bbox=_LABEL_BOX)
