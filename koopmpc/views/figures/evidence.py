# pyright: basic
"""Small figures of a design's report, one signal each: logs with what was repaired, forecasts, loops, blind regions."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from koopmpc.validate.bands import Forecast
from koopmpc.validate.logs.summary import LogExcerpt
from koopmpc.views.figures.style import (
    LIMIT,
    REFERENCE,
    TRUTH,
    draw_band,
    draw_legend,
    fit_label,
    line_style,
    make_figure,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_HEIGHT = 2.2  # height of a figure [in]
_ROOM = 0.6  # the axis shows a value up to this share of the sound values' span outside of them
_OUT: dict[str, Any] = {"color": "#8c1d18", "alpha": 0.22, "linewidth": 0.0}
_DOUBT: dict[str, Any] = {"color": "#c28e00", "alpha": 0.22, "linewidth": 0.0}


@styled
def draw_log(excerpt: LogExcerpt, column: int) -> "Figure":
    """Draw one signal of the logs: rows that were left out are shaded, replaced values are crossed out.

    Values far outside of the sound ones stand at the edge of the axis as triangles.
    """
    drawing, axes = make_figure(1, width="one column", height=_HEIGHT)
    panel = axes[0, 0]
    t, values = excerpt.time, excerpt.values[:, column]
    cells = excerpt.replaced[excerpt.replaced[:, 1] == column]
    bad = np.isin(t, cells[:, 0])
    for begin, end in excerpt.left_out:
        bad |= (t >= begin) & (t <= end)
    sound = values[~bad & np.isfinite(values)]
    low, high = (float(sound.min()), float(sound.max())) if len(sound) else (0.0, 1.0)
    span = (high - low) or max(abs(high), 1.0)
    low, high = low - 0.08 * span, high + 0.08 * span
    if column < excerpt.nx:
        panel.plot(t, np.where(np.isin(t, cells[:, 0]), np.nan, values), color="#0072b2", linewidth=0.8)
    else:
        panel.step(t, values, where="post", color="#0072b2", linewidth=0.8)
    for spans, look, label in (
        (excerpt.left_out, _OUT, "left out"),
        (excerpt.doubtful, _DOUBT, "suspected, kept"),
    ):
        least = 0.004 * (t[-1] - t[0])  # a single row must be seen
        for i, (begin, end) in enumerate(spans):
            middle, half = (begin + end) / 2, max(end - begin, least) / 2
            panel.axvspan(middle - half, middle + half, **look, label=label if i == 0 else None)
    wild = bad & ((values > high) | (values < low)) & ~np.isin(t, cells[:, 0])
    _mark_beyond(panel, t[wild], values[wild], (low, high), "left out")
    if len(cells):
        inside = (cells[:, 2] >= low - _ROOM * span) & (cells[:, 2] <= high + _ROOM * span)
        _mark_beyond(panel, cells[~inside, 0], cells[~inside, 2], (low, high), "replaced")
        if inside.any():
            low, high = min(low, cells[inside, 2].min()), max(high, cells[inside, 2].max())
            panel.plot(cells[inside, 0], cells[inside, 2], "x", color="#8c1d18", markersize=5, label="replaced")
        panel.plot(cells[:, 0], cells[:, 3], "o", color="#000000", markersize=2.5, label="now")
    # starts of logs are drawn up to this number
    if 1 < len(excerpt.starts) <= 40:
        for start in excerpt.starts[1:]:
            panel.axvline(start, color="#999999", linewidth=0.5)
    panel.set(xlabel="time, one log after another [s]", xlim=(t[0], t[-1]), ylim=(low, high))
    panel.set_ylabel(**fit_label(excerpt.names[column], _HEIGHT - 0.6))
    if panel.get_legend_handles_labels()[0]:
        draw_legend(drawing, [panel], 2)
    return drawing


def _mark_beyond(panel: Any, t: np.ndarray, values: np.ndarray, ends: tuple[float, float], what: str) -> None:
    """Draw triangles at the edges of the axis for values beyond it, and name the first three in the legend."""
    for beyond, mark, edge in ((values > ends[1], "^", ends[1]), (values < ends[0], "v", ends[0])):
        if beyond.any():
            label = f"{what}: {', '.join(f'{value:.5g}' for value in values[beyond][:3])}"
            place = np.full(int(beyond.sum()), edge)
            panel.plot(t[beyond], place, mark, color="#8c1d18", markersize=5, clip_on=False, label=label)


@styled
def draw_forecast(forecast: Forecast, state: int) -> "Figure":
    """Draw what was measured of one state beside its forecast and the band around it."""
    drawing, axes = make_figure(1, width="one column", height=_HEIGHT)
    panel, t = axes[0, 0], forecast.time
    low, high = (np.where(np.isfinite(v[:, state]), v[:, state], np.nan) for v in (forecast.low, forecast.high))
    if forecast.band:
        draw_band(panel, t, low, high, 0, "band")
    panel.plot(t, forecast.truth[:, state], **TRUTH, label="measured")
    panel.plot(t, forecast.predicted[:, state], **line_style(0), label="forecast")
    panel.set(xlabel="time ahead [s]", xlim=(0, t[-1]))
    panel.set_ylabel(**fit_label(forecast.states[state], _HEIGHT - 0.6))
    draw_legend(drawing, [panel], 3)
    return drawing


TimedValues = tuple[Float[np.ndarray, " T"], Float[np.ndarray, " T"]]


@styled
def draw_loops(
    name: str,
    groups: "dict[str, list[TimedValues]]",
    limits: Sequence[float],
    reference: TimedValues | None = None,
    *,
    steps: bool = False,
) -> "Figure":
    """Draw one signal of several closed loops, in a colour for each group of them, with its limits.

    Parameters
    ----------
    name
        Name of the signal.
    groups
        By name, times and values of each loop.
    limits
        Finite limits of the signal.
    reference
        Times and values that it has to follow.
    steps
        The signal holds its value between rows.
    """
    drawing, axes = make_figure(1, width="one column", height=_HEIGHT)
    panel, end = axes[0, 0], 0.0
    shown: list[Float[np.ndarray, " T"]] = []
    for i, (group, curves) in enumerate(groups.items()):
        look = line_style(i) | {"linewidth": 1.0, "alpha": 0.9}
        for j, (t, values) in enumerate(curves):
            label = group if j == 0 else None
            if steps:
                panel.step(t, values, where="post", label=label, **look)
            else:
                panel.plot(t, values, label=label, **look)
            shown.append(values)
            end = max(end, float(t[-1]))
    if reference is not None:
        panel.plot(*reference, **REFERENCE, label="reference")
        shown.append(reference[1])
    every = np.concatenate(shown)
    low, high = float(every.min()), float(every.max())
    span = (high - low) or max(abs(high), 1.0)
    near = [value for value in limits if low - span <= value <= high + span]
    for i, value in enumerate(near):
        panel.axhline(value, **LIMIT, label="limit" if i == 0 else None)
    low, high = min([low, *near]), max([high, *near])
    margin = 0.06 * ((high - low) or 1.0)
    panel.set(xlabel="time [s]", xlim=(0, end or 1.0), ylim=(low - margin, high + margin))
    panel.set_ylabel(**fit_label(name, _HEIGHT - 0.6))
    draw_legend(drawing, [panel], 2)
    return drawing
