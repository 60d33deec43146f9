# pyright: basic
"""The style of every figure: for one column or two of a page, readable in black and white, the same bytes each time.

A figure is a `matplotlib.figure.Figure` of its own: nothing of pyplot, so no display, no backend, and nothing that
stays when it is let go. matplotlib is imported where it is used.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO, StringIO
from os import PathLike
from typing import TYPE_CHECKING, Any, BinaryIO, Literal, cast

import numpy as np
from jaxtyping import Float, UInt8

from koopmpc import disk
from koopmpc.errors import DataError
from koopmpc.lifting.base import Chosen, indices

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Width = Literal["one column", "two columns"]

WIDTHS: dict[str, float] = {"one column": 3.5, "two columns": 7.16}  # widths on a page in two columns [in]
TRUTH: dict[str, Any] = {"color": "#000000", "linestyle": "-", "linewidth": 1.4}
REFERENCE: dict[str, Any] = {"color": "#000000", "linestyle": ":", "linewidth": 1.1}
LIMIT: dict[str, Any] = {"color": "#8c1d18", "linestyle": (0, (6, 2)), "linewidth": 0.9}
SEQUENTIAL = "viridis"  # its lightness grows evenly, so it reads in grey
CYCLIC = "twilight"  # it ends with its first colour, light; its middle is dark
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#7b3294", "#c28e00", "#5a5a5a")  # colour-blind readers can tell them
_DASHES = ((0, (5, 1.5)), "-", (0, (1, 1)), "-.", (0, (3, 1, 1, 1, 1, 1)), (0, (8, 2)))
_MARKERS = ("o", "s", "^", "D", "v", "x")
_MOST = 12  # states in one figure, at most
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
"""Decorator: what a function draws is in this style whatever the user's own settings are; those come back after it."""


def figure(rows: int, columns: int = 1, *, width: Width, height: float, **more: Any) -> "tuple[Figure, np.ndarray]":
    """Return a figure and its (rows, columns) axes, an array of objects.

    Parameters
    ----------
    rows, columns
        How many axes.
    width
        "one column" or "two columns" of a page.
    height
        Height of the figure [in].
    more
        For `Figure.subplots`: ``sharex``, ``height_ratios``, …

    Raises
    ------
    DataError
        The width is another word.
    """
    from matplotlib.figure import Figure

    if width not in WIDTHS:
        raise DataError(f"width is {width!r}; pass one of {', '.join(WIDTHS)}")
    made = Figure(figsize=(WIDTHS[width], height), layout="constrained")
    return made, made.subplots(rows, columns, squeeze=False, **more)


def line(i: int, points: int = 0) -> dict[str, Any]:
    """Return the look of the i-th of several curves: colour, dashes and marker all differ.

    Parameters
    ----------
    i
        Number of the curve in the panel, from 0 on.
    points
        How many points the curve has: about eight of them get the marker; 0 for no markers.
    """
    look: dict[str, Any] = {"color": _COLORS[i % len(_COLORS)], "linestyle": _DASHES[i % len(_DASHES)]}
    if points:
        every = max(1, points // 8)
        look |= {"marker": _MARKERS[i % len(_MARKERS)], "markevery": (i * every // 3 % every, every)}
    return look


def band(axes: "Axes", x: Any, low: Any, high: Any, i: int, label: str | None = None) -> None:
    """Shade from `low` to `high` in the colour of the i-th curve, with thin edges in its dashes that print in grey."""
    look = line(i)
    axes.fill_between(x, low, high, color=look["color"], alpha=0.18, linewidth=0.0, label=label)
    for edge in (low, high):
        axes.plot(x, edge, color=look["color"], linestyle=look["linestyle"], linewidth=0.6)


def shades(values: Float[np.ndarray, "..."], scale: str) -> UInt8[np.ndarray, "... 3"]:
    """Return the red, green and blue of values from 0 to 1 on a scale, `SEQUENTIAL` or `CYCLIC`."""
    import matplotlib as mpl

    return np.asarray(mpl.colormaps[scale](np.clip(values, 0.0, 1.0), bytes=True))[..., :3]


def legend(made: "Figure", axes: "Iterable[Axes]", columns: int) -> None:
    """Write every label of these axes once, above all panels, in at most so many columns."""
    found: dict[str, Any] = {}
    for panel in axes:
        handles, labels = panel.get_legend_handles_labels()
        found |= dict(zip(labels, handles, strict=True))
    made.legend(list(found.values()), list(found), loc="outside upper center", ncols=min(len(found), columns))


def interval(low: float, high: float, lowest: float, highest: float, beyond: float) -> tuple[float, float]:
    """Return an axis for all of low … high, and for lowest … highest up to `beyond` such spans outside of it.

    So a curve that runs away cannot flatten those that the picture is about.
    """
    span = (high - low) or max(abs(high), 1.0)
    bottom, top = max(min(low, lowest), low - beyond * span), min(max(high, highest), high + beyond * span)
    margin = 0.06 * ((top - bottom) or span)
    return bottom - margin, top + margin


def followed(truth: np.ndarray, curves: Iterable[np.ndarray], beyond: float) -> tuple[float, float]:
    """Return an axis for the truth, and for curves that do not run away from it by more than `beyond` of its spans."""
    low, high = float(truth.min()), float(truth.max())
    shown = np.concatenate([[low, high], *(curve[np.isfinite(curve)] for curve in curves)])
    return interval(low, high, float(shown.min()), float(shown.max()), beyond)


def chosen_states(states: Chosen | None, names: Sequence[str]) -> list[int]:
    """Return the indices of the states to draw, all by default; raise where they are none or too many."""
    chosen = indices(states, names, "the figure")
    if not 1 <= len(chosen) <= _MOST:
        raise DataError(f"the figure is asked for {len(chosen)} states; choose 1 to {_MOST} with states=…")
    return chosen


@styled
def save(made: "Figure", path: str | PathLike[str]) -> None:
    """Write the figure as .png, .pdf or .svg, by the path's ending: the same figure, the same bytes.

    Parameters
    ----------
    made
        A figure of `km.plot`, or any `matplotlib.figure.Figure`.
    path
        The file to write; its folders are made.

    Raises
    ------
    DataError
        The path ends otherwise.
    LogError
        The path cannot be written.
    """
    suffix = disk.path_of(path).suffix.lower()
    if suffix not in _SUFFIXES:
        raise DataError(f"{path} is no picture by its name; end it with one of {', '.join(_SUFFIXES)}")
    with disk.writing(path) as stream:
        if suffix == ".png":
            _save_png(made, stream)
        else:
            made.savefig(stream, format=suffix[1:], metadata=_METADATA[suffix])


@styled
def svg(made: "Figure") -> str:
    """Return the figure as an <svg> element, to stand in a page; it scales with the width that it has."""
    out = StringIO()
    made.savefig(out, format="svg", metadata=_METADATA[".svg"])
    text = out.getvalue()
    return text[text.index("<svg") :]


def _save_png(made: "Figure", stream: BinaryIO) -> None:
    """Write a .png: lines in 256 colours, a third of the bytes and no change to the eye; shades in all of theirs."""
    from PIL import Image

    drawn = BytesIO()
    made.savefig(drawn, format="png", metadata=_METADATA[".png"])
    picture = Image.open(drawn)
    resolution = picture.info["dpi"]
    shaded = any(part.get_array() is not None for axes in made.axes for part in axes.collections)
    if not shaded:
        picture = picture.convert("RGB").quantize(256, kmeans=1, dither=Image.Dither.NONE)
    picture.save(stream, "PNG", optimize=True, dpi=resolution)
