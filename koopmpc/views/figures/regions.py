# pyright: basic
"""Figures of certificates: the region {V ≤ 1} in a plane of two states, the data, the limits, and runs."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.data.episodes import Episodes
from koopmpc.guarantees.certificate import Certificate
from koopmpc.lifting.base import find_state
from koopmpc.loop.run import Run
from koopmpc.views.figures.style import LIMIT, TRUTH, draw_legend, line_style, make_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_GRID = 301  # points along each axis


@styled
def certificate(
    certified: Certificate,
    data: Episodes | None = None,
    runs: Sequence[Run] = (),
    axes: tuple[int | str, int | str] = (0, 1),
    spread: Sequence[Certificate] = (),
) -> "Figure":
    """Draw the region {V ≤ 1} of a certificate, the box of its bound, its ball, data and closed loops.

    Parameters
    ----------
    certified
        Of `km.certify`. Of more than two states the cut through the set point is drawn.
    data
        Episodes whose states are drawn as points.
    runs
        Closed loops whose paths are drawn.
    axes
        The two states, by index or by name.
    spread
        Certificates of the same set point from episodes drawn again with replacement (bootstrap). Their regions are
        thin lines: how far they differ shows what the data leave open, and proves nothing.

    Raises
    ------
    DataError
        The certificate has one state alone, the two axes are the same, or one of `spread` has another set point.
    """
    checks.kind(certified, "certified", Certificate, "make one with km.certify")
    names = certified.states
    if len(names) < 2:
        raise DataError("a plane needs two states, and the certificate has one; draw certified.value over it")
    i, j = (find_state(axis, names, "the figure") for axis in axes)
    if i == j:
        raise DataError(f"both axes are {names[i]!r}; choose two states")
    drawing, grid = make_figure(1, width="one column", height=3.4)
    panel = grid[0, 0]
    low, high = certified.low, certified.high
    pad = 0.15 * (high - low)  # the axes show this share of the box beyond it
    x, y = (np.linspace(low[k] - pad[k], high[k] + pad[k], _GRID) for k in (i, j))
    X = np.tile(certified.deviation.x, (_GRID * _GRID, 1))
    X[:, i], X[:, j] = np.repeat(x, _GRID), np.tile(y, _GRID)
    for k, other in enumerate(spread):
        if len(other.deviation.x) != len(names) or np.abs(other.deviation.x - certified.deviation.x).max() > 1e-9:
            raise DataError(
                f"spread[{k}] is a certificate of another set point; certify resampled data at the same one"
            )
        panel.contour(x, y, other.value(X).reshape(_GRID, _GRID).T, levels=[1.0], colors=["black"], linewidths=0.5)
    if len(spread):
        panel.plot([], [], color="black", linewidth=0.5, label="of resampled data")
    V = certified.value(X).reshape(_GRID, _GRID).T
    look = line_style(0)
    panel.contourf(x, y, V, levels=[-np.inf, 1.0], colors=[look["color"]], alpha=0.18)
    panel.contour(x, y, V, levels=[1.0], colors=[look["color"]], linewidths=1.3)
    panel.plot([], [], color=look["color"], label="certified: V ≤ 1")
    if certified.ball > 0:
        panel.contour(x, y, V, levels=[certified.ball], colors=[line_style(1)["color"]], linewidths=1.1)
        panel.plot([], [], color=line_style(1)["color"], label="ball that is reached")
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]])
    panel.plot(*(low[[i, j]] + corners * (high - low)[[i, j]]).T, **LIMIT, label="box of the bound")
    if data is not None:
        points = np.vstack([episode.X[:-1] for episode in data.episodes])[:, [i, j]]
        every = max(1, len(points) // 4000)  # states of the data that are drawn
        panel.plot(*points[::every].T, ".", color="#9a9a9a", markersize=1.2, zorder=0, label="data")
    for k, run in enumerate(runs):
        panel.plot(run.X[:, i], run.X[:, j], **TRUTH, label="closed loops" if k == 0 else None)
        panel.plot(*run.X[0, [i, j]], "o", color="black", markersize=2.5)
    panel.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]), xlabel=names[i], ylabel=names[j])
    draw_legend(drawing, [panel], 2)
    return drawing
