# pyright: basic
"""The common style of figures: one or two columns of a page, readable in black and white, reproducible to the byte.

Figures are made as `matplotlib.figure.Figure`, without pyplot. They need no display and no backend, and leave no global
state. matplotlib is imported only when a figure is drawn.
"""

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import BytesIO, StringIO
from os import PathLike
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, cast

import numpy as np
from jaxtyping import Float, UInt8

from koopmpc.base import checks, disk
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.lifting.base import StateChoice, find_state, find_states

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Width = Literal["one column", "two columns"]

WIDTHS: dict[str, float] = {"one column": 3.5, "two columns": 7.16}  # widths on a page in two columns [in]
TRUTH: dict[str, Any] = {"color": "#000000", "linestyle": "-", "linewidth": 1.4}
REFERENCE: dict[str, Any] = {"color": "#000000", "linestyle": ":", "linewidth": 1.1}
LIMIT: dict[str, Any] = {"color": "#8c1d18", "linestyle": (0, (6, 2)), "linewidth": 0.9}
SEQUENTIAL = "viridis"  # colour map for magnitudes; its lightness rises evenly, so it is readable in grey
CYCLIC = "twilight"  # colour map for phases; it ends with its first colour
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#7b3294", "#c28e00", "#5a5a5a")  # distinct for colour-blind readers
_DASHES = ((0, (5, 1.5)), "-", (0, (1, 1)), "-.", (0, (3, 1, 1, 1, 1, 1)), (0, (8, 2)))
_MARKERS = ("o", "s", "^", "D", "v", "x")
_LINES = 4  # lines of a label that keep its size
_MOST_STATES = 12  # largest number of states in one figure
_SUFFIXES = (".png", ".pdf", ".svg")
_RC: dict[str, Any] = {
    "font.size": 8.0,
    "axes.titlesize": 8.0,
    "axes.labelsize": 8.0,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "legend.fontsize": 7.0,
    "legend.frameon": False,
    "legend.handlelength": 2.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#dcdcdc",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.3,
    "lines.markersize": 3.6,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "figure.dpi": 200.0,
    "savefig.dpi": 200.0,
    "pdf.fonttype": 42,  # fonts are embedded, so that text can be selected
    "svg.fonttype": "path",
    "svg.hashsalt": "koopmpc",  # without it, ids are random
}
_METADATA: dict[str, dict[str, Any]] = {
    ".png": {"Software": None},
    ".pdf": {"Creator": None, "Producer": None, "CreationDate": None},
    ".svg": {"Creator": None, "Date": None},
}


@contextmanager
def _settings() -> Iterator[None]:
    import matplotlib as mpl

    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(cast("Any", _RC))
        yield


styled = _settings()
"""Decorator: the function draws in this style; the user's own matplotlib settings are restored afterwards."""


def make_figure(
    rows: int, columns: int = 1, *, width: Width, height: float, **more: Any
) -> "tuple[Figure, np.ndarray]":
    """Return a figure and its (rows, columns) axes, an array of objects.

    Parameters
    ----------
    rows, columns
        Number of axes.
    width
        "one column" or "two columns" of a page.
    height
        Height of the figure [in].
    more
        Further arguments of `Figure.subplots`: ``sharex``, ``height_ratios``, …

    Raises
    ------
    DataError
        The width has another value.
    """
    from matplotlib.figure import Figure

    if not checks.among(width, WIDTHS):
        raise DataError(f"width is {width!r}; pass one of {', '.join(WIDTHS)}")
    drawing = Figure(figsize=(WIDTHS[width], height), layout="constrained")
    return drawing, drawing.subplots(rows, columns, squeeze=False, **more)


def line_style(i: int, points: int = 0) -> dict[str, Any]:
    """Return the style of the i-th curve; curves differ in colour, dashes and marker.

    Parameters
    ----------
    i
        Number of the curve in the panel, from 0 on.
    points
        Number of points of the curve, about eight of which get a marker; 0 for no markers.
    """
    look: dict[str, Any] = {"color": _COLORS[i % len(_COLORS)], "linestyle": _DASHES[i % len(_DASHES)]}
    if points:
        every = max(1, points // 8)
        look |= {"marker": _MARKERS[i % len(_MARKERS)], "markevery": (i * every // 3 % every, every)}
    return look


def label_time(metadata: Mapping[str, Any]) -> str:
    """Return the label of a run's time axis; a run of a problem says the unit of its time if it is not the second."""
    return f"time [{metadata.get('time unit', 's')}]"


def fit_label(name: str, height: float, size: float = 8.0) -> dict[str, Any]:
    """Return the arguments of `set_ylabel` by which a name fits beside a panel of this height [in].

    Long names are broken at blanks and underscores, the unit first; what is still too long gets a smaller font. A $ is
    a letter of the name, and begins no formula.
    """
    room = max(int(height * 17.0 * 8.0 / size), 6)  # letters of 8 pt in an inch
    short, bracket, unit = name.partition(" [")
    lines = [name]
    if len(name) > room:
        # letters by which the lines of a broken name are shorter, since letters may be wide
        words = textwrap.wrap(short.replace("_", "_ "), max(room - 2, 6), break_long_words=False)
        lines = [line.replace("_ ", "_") for line in words] or [short]
        lines += [f"[{unit}"] * bool(bracket)
    longest = max(map(len, lines))
    smaller = min(1.0, room / longest, _LINES / len(lines))
    return {"ylabel": "\n".join(lines).replace("$", r"\$"), "fontsize": max(size * smaller, 4.5)}


def draw_band(axes: "Axes", x: Any, low: Any, high: Any, i: int, label: str | None = None) -> None:
    """Shade from `low` to `high` in the colour of the i-th curve, with thin edges in its dashes."""
    look = line_style(i)
    axes.fill_between(x, low, high, color=look["color"], alpha=0.18, linewidth=0.0, label=label)
    for edge in (low, high):
        axes.plot(x, edge, color=look["color"], linestyle=look["linestyle"], linewidth=0.6)


def map_colors(values: Float[np.ndarray, "..."], scale: str) -> UInt8[np.ndarray, "... 3"]:
    """Return the red, green and blue of values from 0 to 1 in a colour map, `SEQUENTIAL` or `CYCLIC`."""
    import matplotlib as mpl

    return np.asarray(mpl.colormaps[scale](np.clip(values, 0.0, 1.0), bytes=True))[..., :3]


def draw_legend(drawing: "Figure", axes: "Iterable[Axes]", columns: int) -> None:
    """Draw a legend above all panels, with each label of these axes once, in at most `columns` columns."""
    entries: dict[str, Any] = {}
    for panel in axes:
        handles, labels = panel.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    names = [label.replace("$", r"\$") for label in entries]  # a name begins no formula
    drawing.legend(list(entries.values()), names, loc="outside upper center", ncols=min(len(entries), columns))


def limit_axis(low: float, high: float, lowest: float, highest: float, beyond: float) -> tuple[float, float]:
    """Return the limits of an axis that shows low … high, and of lowest … highest at most `beyond` spans more.

    A span is high − low. The bound keeps the main curves readable if another curve diverges.
    """
    span = (high - low) or max(abs(high), 1.0)
    bottom, top = max(min(low, lowest), low - beyond * span), min(max(high, highest), high + beyond * span)
    margin = 0.06 * ((top - bottom) or span)
    return bottom - margin, top + margin


def follow_truth(truth: np.ndarray, curves: Iterable[np.ndarray], beyond: float) -> tuple[float, float]:
    """Return the limits of an axis that shows the truth, and the curves up to `beyond` spans of the truth outside."""
    low, high = float(truth.min()), float(truth.max())
    shown = np.concatenate([[low, high], *(curve[np.isfinite(curve)] for curve in curves)])
    return limit_axis(low, high, float(shown.min()), float(shown.max()), beyond)


def choose_states(states: StateChoice | None, names: Sequence[str]) -> list[int]:
    """Return the indices of the states to draw, by default all; raise if there are no states or too many."""
    chosen = find_states(states, names, "the figure")
    if not 1 <= len(chosen) <= _MOST_STATES:
        raise DataError(f"the figure is asked for {len(chosen)} states; choose 1 to {_MOST_STATES} with states=…")
    return chosen


def find_plane(axes: Sequence[int | str], names: Sequence[str], what: str) -> tuple[int, int]:
    """Return the indices of the two states of a plane; raise if they are not two."""
    checks.kind(axes, what, (tuple, list), "pass its two states by index or name")
    if len(axes) != 2:
        raise ShapeError(f"{what} has {len(axes)} states; pass two")
    i, j = (find_state(axis, names, what) for axis in axes)
    if i == j:
        raise DataError(f"both axes are {names[i]!r}; name two different states")
    return i, j


def draw_points(panel: "Axes", points: Float[np.ndarray, "n 2"], most: int) -> None:
    """Draw states of the data, at most about so many, below all curves."""
    panel.plot(*points[:: max(1, len(points) // most)].T, ".", color="#9a9a9a", markersize=1.2, zorder=0, label="data")


def draw_box(panel: "Axes", low: Float[np.ndarray, "2"], high: Float[np.ndarray, "2"], label: str) -> None:
    """Draw the edges of a box in the style of limits."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    panel.plot(*(low + corners * (high - low)).T, **LIMIT, label=label)


@styled
def save(drawing: "Figure", path: str | PathLike[str]) -> None:
    """Write the figure as .png, .pdf or .svg, by the path's suffix; equal figures give equal bytes.

    Parameters
    ----------
    drawing
        A figure of `km.plot`, or any `matplotlib.figure.Figure`.
    path
        The file to write; its folders are made.

    Raises
    ------
    DataError
        The path has another suffix.
    LogError
        The path cannot be written.
    """
    suffix = disk.path_of(path).suffix.lower()
    if suffix not in _SUFFIXES:
        raise DataError(f"{path} does not end like a picture; end it with one of {', '.join(_SUFFIXES)}")
    with disk.writing(path) as stream:
        if suffix == ".png":
            _save_png(drawing, stream)
        else:
            drawing.savefig(stream, format=suffix[1:], metadata=_METADATA[suffix])


@styled
def render_svg(drawing: "Figure") -> str:
    """Return the figure as an <svg> element of a page; it scales to the width of the page."""
    out = StringIO()
    drawing.savefig(out, format="svg", metadata=_METADATA[".svg"])
    text = out.getvalue()
    return text[text.index("<svg") :]


def _save_png(drawing: "Figure", stream: BinaryIO) -> None:
    """Write a .png; line drawings get 256 colours, which saves two thirds of the bytes without a visible change."""
    from PIL import Image

    buffer = BytesIO()
    drawing.savefig(buffer, format="png", metadata=_METADATA[".png"])
    picture = Image.open(buffer)
    resolution = picture.info["dpi"]
    shaded = any(part.get_array() is not None for axes in drawing.axes for part in axes.collections)
    if not shaded:
        picture = picture.convert("RGB").quantize(256, kmeans=1, dither=Image.Dither.NONE)
    picture.save(stream, "PNG", optimize=True, dpi=resolution)
