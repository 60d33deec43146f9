# pyright: basic
"""Curves in panels, for figures that no other function here draws: a panel each, any axis."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError, ShapeError
from koopmpc.figures.style import REFERENCE, figure, legend, line, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HEIGHT = 2.1  # of a row of panels [in]


@dataclass(frozen=True)
class Plot:
    """One panel.

    Attributes
    ----------
    x, y
        What the axes show, with units.
    curves
        Pairs of x and y by name, (T,) each; what is not finite is left out.
    title
        Above the panel.
    log
        The axes that are logarithmic: "x", "y" or "xy".
    points
        Draw points and no lines.
    ylim
        Lowest and highest y shown; by default all.
    at
        Values of y to mark by a line.
    """

    x: str
    y: str
    curves: Mapping[str, tuple[ArrayLike, ArrayLike]]
    title: str = ""
    log: Literal["", "x", "y", "xy"] = ""
    points: bool = False
    ylim: tuple[float, float] | None = None
    at: Sequence[float] = ()


@styled
def plots(given: Sequence[Plot], columns: int = 2) -> "Figure":
    """Draw panels row by row, so many in a row; a name has the same line in all of them.

    Raises
    ------
    DataError
        There is no panel.
    ShapeError
        A curve does not have one y for each x.
    """
    if not given:
        raise DataError("there is no panel to draw; pass at least one")
    columns = min(columns, len(given))
    rows = -(-len(given) // columns)
    made, grid = figure(
        rows, columns, width="two columns" if columns > 1 else "one column", height=0.5 + _HEIGHT * rows
    )
    names = list(dict.fromkeys(name for panel in given for name in panel.curves))
    for axes, panel in zip(grid.flat, given, strict=False):
        _draw(axes, panel, names)
    for axes in grid.flat[len(given) :]:
        axes.set_visible(False)
    legend(made, grid.flat[: len(given)], 4 if columns > 1 else 3)
    return made


def _draw(axes: Any, panel: Plot, names: list[str]) -> None:
    for value in panel.at:
        axes.axhline(value, **REFERENCE)
    for name, (x, y) in panel.curves.items():
        x = checks.array(x, f"x of {name!r}", (None,), finite=False)
        y = checks.array(y, f"y of {name!r}", (None,), finite=False)
        if len(x) != len(y):
            raise ShapeError(f"{name!r} has {len(x)} x and {len(y)} y; pass one y for each x")
        look = line(names.index(name), len(x))
        if panel.points:
            look |= {"linestyle": "none", "markevery": 1}
        axes.plot(x, y, **look, label=name)
    axes.set(xlabel=panel.x, ylabel=panel.y, title=panel.title)
    if "x" in panel.log:
        axes.set_xscale("log")
    if "y" in panel.log:
        axes.set_yscale("log")
    if panel.ylim is not None:
        axes.set_ylim(*panel.ylim)
