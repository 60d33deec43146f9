# pyright: basic
"""Figures in a plane of two states: the region of a certificate, and where a design has no data."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.text import to_percent
from koopmpc.data.episodes import Episodes
from koopmpc.guarantees.certificate import Certificate
from koopmpc.lifting.state import State
from koopmpc.loop.run import Run
from koopmpc.synthesis.designed import Design, Evidence
from koopmpc.synthesis.loops.neighbours import NeighbourMap, choose_starts_to_record, probe_range
from koopmpc.synthesis.task import DesignTask, goal_box
from koopmpc.views.figures.style import (
    TRUTH,
    draw_box,
    draw_legend,
    draw_points,
    find_plane,
    fit_label,
    line_style,
    make_figure,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BLIND = "#d55e00"  # colour of what has no data around it


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
    i, j = find_plane(axes, names, "the figure")
    drawing, grid = make_figure(1, width="one column", height=3.4)
    panel = grid[0, 0]
    low, high, count = certified.low, certified.high, 301  # points along each axis
    pad = 0.15 * (high - low)  # the axes show this share of the box beyond it
    x, y = (np.linspace(low[k] - pad[k], high[k] + pad[k], count) for k in (i, j))
    X = np.tile(certified.deviation.x, (count * count, 1))
    X[:, i], X[:, j] = np.repeat(x, count), np.tile(y, count)
    for k, other in enumerate(spread):
        if len(other.deviation.x) != len(names) or np.abs(other.deviation.x - certified.deviation.x).max() > 1e-9:
            raise DataError(
                f"spread[{k}] is a certificate of another set point; certify resampled data at the same one"
            )
        panel.contour(x, y, other.value(X).reshape(count, count).T, levels=[1.0], colors=["black"], linewidths=0.5)
    if len(spread):
        panel.plot([], [], color="black", linewidth=0.5, label="of resampled data")
    V = certified.value(X).reshape(count, count).T
    look = line_style(0)
    panel.contourf(x, y, V, levels=[-np.inf, 1.0], colors=[look["color"]], alpha=0.18)
    panel.contour(x, y, V, levels=[1.0], colors=[look["color"]], linewidths=1.3)
    panel.plot([], [], color=look["color"], label="certified: V ≤ 1")
    if certified.ball > 0:
        panel.contour(x, y, V, levels=[certified.ball], colors=[line_style(1)["color"]], linewidths=1.1)
        panel.plot([], [], color=line_style(1)["color"], label="ball that is reached")
    draw_box(panel, low[[i, j]], high[[i, j]], "box of the bound")
    if data is not None:
        draw_points(panel, np.vstack([episode.X[:-1] for episode in data.episodes])[:, [i, j]], 4000)
    for k, run in enumerate(runs):
        panel.plot(run.X[:, i], run.X[:, j], **TRUTH, label="closed loops" if k == 0 else None)
        panel.plot(*run.X[0, [i, j]], "o", color="black", markersize=2.5)
    panel.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]), xlabel=names[i], ylabel=names[j])
    draw_legend(drawing, [panel], 2)
    return drawing


def blindness(design: Design, axes: tuple[int | str, int | str] | None = None, record: int = 6) -> "Figure":
    """Draw where a design has no data: points of the goal's range, starts, the reference, and states of its loops.

    A point of the plane stands for a state with all its values, so known and unknown ones may lie over each other.

    Parameters
    ----------
    design
        Of `km.design`.
    axes
        The two states, by index or by name; by default the two in which the points without data lie farthest from it.
    record
        Number of states to draw from which to record episodes (`Design.starts_to_record`).

    Raises
    ------
    DataError
        The design has one state, or keeps no rows of its data; the two axes are the same.
    """
    checks.kind(design, "design", Design, "make one with km.design")
    return draw_blindness(design.evidence, axes, record)


@styled
def draw_blindness(
    evidence: Evidence,
    axes: tuple[int | str, int | str] | None = None,
    record: int = 6,
    loops: "Sequence[Float[np.ndarray, 'T nx']]" = (),
) -> "Figure":
    """Draw the figure of `blindness` from the evidence of a design, with the states of closed loops."""
    neighbours = evidence.neighbours
    if neighbours is None:
        raise DataError("the design keeps no rows of its data; make it again with this version")
    names, asked = neighbours.states, evidence.task
    if len(names) < 2:
        raise DataError(
            "a plane needs two states, and this design has one alone; design.advice says in words where data lack"
        )
    X, away = probe_range(asked, neighbours)
    i, j = _choose_axes(asked, neighbours, X[away]) if axes is None else find_plane(axes, names, "the figure")
    drawing, grid = make_figure(1, width="one column", height=3.6)
    panel = grid[0, 0]
    draw_points(panel, neighbours.points[:, [i, j]], 3000)
    panel.plot(*X[away][:, [i, j]].T, "x", color=BLIND, markersize=2.6, alpha=0.6, label="range without data")
    low, high = goal_box(asked)
    draw_box(panel, low[[i, j]], high[[i, j]], "range of the goal")
    fresh = evidence.expected.fresh
    if fresh is not None and len(fresh.outside_states):
        panel.plot(*fresh.outside_states[:, [i, j]].T, ".", color=BLIND, markersize=2, label="loops outside the data")
    starts = asked.starts
    unknown = neighbours.find_outside_states(starts)
    panel.plot(*starts[~unknown][:, [i, j]].T, "o", color=line_style(0)["color"], label="starts")
    panel.plot(*starts[unknown][:, [i, j]].T, "o", color=BLIND, mec="black", label="starts outside the data")
    of = asked.cost.of.bind(names)
    tracked = list(of.state_indices) if isinstance(of, State) else []
    missed = _find_missed_rows(asked, neighbours, tracked)
    if i in tracked and j in tracked:
        aims = asked.reference[:, [tracked.index(i), tracked.index(j)]]
        panel.plot(*aims[~missed].T, "*k", markersize=6, label="reference")
        panel.plot(*aims[missed].T, "*", color=BLIND, mec="black", markersize=8, label="reference outside the data")
    for k, X in enumerate(loops):
        panel.plot(X[:, i], X[:, j], color=line_style(0)["color"], linewidth=0.8, label="loops" if k == 0 else None)
    advised = choose_starts_to_record(asked, neighbours, checks.count(record, "record"))
    panel.plot(*advised[:, [i, j]].T, "D", mfc="none", mec="black", markersize=5, label="record from here")
    panel.set_xlabel(names[i].replace("$", r"\$"))
    panel.set_ylabel(**fit_label(names[j], 2.4))
    title = f"{to_percent(float(away.mean()))} of the goal's range has no data around it"
    if missed.any():
        title += ",\nand the reference lies outside the data: record episodes that rest near it"
    panel.set_title(title)
    draw_legend(drawing, [panel], 2)
    return drawing


def _find_missed_rows(asked: DesignTask, neighbours: NeighbourMap, tracked: Sequence[int]) -> Bool[np.ndarray, " T1"]:
    """Return which rows of the reference have no data around them, or values outside the range of their signals."""
    rows = asked.reference
    if not tracked:
        return np.zeros(len(rows), dtype=np.bool_)
    room = 0.01 * (asked.high - asked.low)[list(tracked)]
    low, high = asked.low[list(tracked)] - room, asked.high[list(tracked)] + room
    missed: Bool[np.ndarray, " T1"] = np.asarray(((rows < low) | (rows > high)).any(axis=1))
    if sorted(tracked) == list(range(len(asked.low))) and neighbours.embedding is None:
        return missed | neighbours.find_outside_states(rows[:, np.argsort(tracked)])
    return missed


def _choose_axes(asked: DesignTask, neighbours: NeighbourMap, blind: np.ndarray) -> tuple[int, int]:
    """Return the two states in which the points without data lie farthest from the nearest row, by the data's range."""
    if not len(blind):
        return 0, 1
    size = np.where(asked.high > asked.low, asked.high - asked.low, 1.0)
    _, nearest = neighbours.tree.query(neighbours.scale_states(blind))
    apart = (np.abs(neighbours.points[nearest] - blind) / size).mean(axis=0)
    first, second = sorted(np.argsort(-apart, kind="stable")[:2].tolist())
    return first, second
