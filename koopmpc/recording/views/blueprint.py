# pyright: basic
"""The default blueprint: plots on the left; animation, eigenvalues and text on the right."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from koopmpc.loop.run import About
from koopmpc.predict.base import Predictor
from koopmpc.recording.description import drawable
from koopmpc.recording.format.rrd import LogBlock
from koopmpc.recording.views.eigenvalues import eigenvalue_views
from koopmpc.recording.views.scenes import BACKGROUND, Extent
from koopmpc.scene import Color

PALETTE: tuple[Color, ...] = (
    (88, 166, 255),
    (255, 166, 87),
    (86, 211, 160),
    (240, 120, 170),
    (188, 150, 255),
    (235, 203, 100),
    (110, 205, 220),
    (190, 190, 190),
)
_LIMIT: Color = (232, 84, 84)
_QUIET: Color = (140, 148, 160)


def styles(about: About, rows: LogBlock) -> dict[str, Any]:
    """Return the static archetypes by entity that name and colour what `rows` hold."""
    import rerun as rr

    tracked = about.tracked(rows.reference.shape[1])
    found = {
        "state": _lines(about.states, [color(i) for i in range(len(about.states))], 2.0),
        "reference": _lines([f"{n} reference" for n in tracked], [_matching(n, about) for n in tracked], 1.0),
        "measurement": rr.SeriesPoints(
            names=[drawable(f"{n} measured") for n in about.outputs],
            colors=[_matching(n, about) for n in about.outputs],
            marker_sizes=[1.5] * len(about.outputs),
        ),
        "control/u": _lines(
            about.inputs, [color(i) for i in range(len(about.inputs))], 2.0, interpolation_mode="StepAfter"
        ),
        "solver/time_ms": _lines(["solve time [ms]"], [color(2)], 1.5),
        "solver/deadline_ms": _lines(["deadline [ms]"], [_LIMIT], 1.0),
    }
    limits = [name for name, _ in input_limits(about)]
    if limits:
        found["control/limits"] = _lines(limits, [_LIMIT] * len(limits), 1.0)
    return found


def input_limits(about: About) -> list[tuple[str, float]]:
    """Return the finite input limits with their names."""
    if about.limits is None:
        return []
    low, high = about.limits.inputs(len(about.inputs))
    pairs = [(f"{n} min", v) for n, v in zip(about.inputs, low, strict=True)]
    pairs += [(f"{n} max", v) for n, v in zip(about.inputs, high, strict=True)]
    return [(n, float(v)) for n, v in pairs if np.isfinite(v)]


def color(i: int) -> Color:
    """Return the colour of the i-th state or input."""
    return PALETTE[i % len(PALETTE)]


def _matching(name: str, about: About) -> Color:
    """Return a quieter shade of the state's colour, grey for what is no state."""
    if name not in about.states:
        return _QUIET
    r, g, b = (round(0.6 * c + 0.4 * 128) for c in color(about.states.index(name)))
    return r, g, b


def _lines(names: Sequence[str], colors: Sequence[Color], width: float, **more: Any) -> Any:
    import rerun as rr

    return rr.SeriesLines(
        names=[drawable(name) for name in names], colors=list(colors), widths=[width] * len(names), **more
    )


_SEPARATE = 4  # up to so many states have a plot each


def blueprint(about: About, *, extent: Extent | None, model: Predictor | None) -> Any:
    """Return the layout of one run; there is no view without data.

    `extent` is what the animation shows, None where there is no scene.
    """
    import rerun.blueprint as rrb

    status = rrb.StateTimelineView(origin="solver/status", name="Solver status")
    time = rrb.TimeSeriesView(
        contents=["/solver/time_ms", "/solver/deadline_ms"],
        name="Solve time and deadline [ms]",
        plot_legend=_legend(visible=False),
    )
    inputs = rrb.TimeSeriesView(
        contents=["/control/u", "/control/limits"],
        name=drawable(_title("Input", about.inputs)),
        axis_y=_padded([v for _, v in input_limits(about)]),
        plot_legend=_legend(visible=len(about.inputs) > 1),
    )
    states = _states(about)
    pairs = [states[i : i + 2] for i in range(0, len(states), 2)] if len(states) > 2 else [[s] for s in states]
    plots = [pair[0] if len(pair) == 1 else rrb.Horizontal(*pair) for pair in pairs]
    left = rrb.Vertical(*plots, inputs, time, status, row_shares=[3.0] * len(plots) + [3.0, 2.0, 1.4])
    texts = rrb.Tabs(
        rrb.TextDocumentView(origin="metrics", name="Metrics"),
        rrb.TextDocumentView(origin="description", name="Description"),
        rrb.TextLogView(origin="log", name="Log"),
    )
    lower = texts if model is None else rrb.Horizontal(eigenvalue_views(model)[0], texts)
    right = lower if extent is None else rrb.Vertical(_animation(extent), lower, row_shares=[3.0, 2.0])
    return framed(rrb.Horizontal(left, right, column_shares=[1.0, 1.0]))


def framed(views: Any) -> Any:
    """Return the layout of a log: `views` over the timeline sim_time, all other panels out of the way."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        views,
        rrb.TimePanel(timeline="sim_time", state="collapsed"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )


def _states(about: About) -> list[Any]:
    """Return one plot a state with its reference, or one plot for all of many states."""
    import rerun as rr
    import rerun.blueprint as rrb

    contents = ["/state", "/reference", "/measurement"]
    nx = len(about.states)
    if nx > _SEPARATE:
        return [rrb.TimeSeriesView(contents=contents, name="States", plot_legend=_legend(visible=nx <= 8))]
    tracked = about.states if about.cost is None else about.cost.of.bind(about.states).names
    return [
        rrb.TimeSeriesView(
            contents=contents,
            name=drawable(name),
            plot_legend=_legend(visible=False),
            overrides={
                "/state": rr.SeriesLines.from_fields(visible_series=[s == name for s in about.states]),
                "/reference": rr.SeriesLines.from_fields(visible_series=[s == name for s in tracked]),
                "/measurement": rr.SeriesPoints.from_fields(visible_series=[s == name for s in about.outputs]),
            },
        )
        for name in about.states
    ]


def _animation(extent: Extent) -> Any:
    import rerun.blueprint as rrb

    ranges = extent.ranges()
    fixed = None if ranges is None else rrb.VisualBounds2D(x_range=ranges[0], y_range=ranges[1])
    return rrb.Spatial2DView(
        origin="world",
        name="Animation, with the predicted horizon",
        background=list(BACKGROUND),
        visual_bounds=fixed,
    )


def _padded(values: list[float]) -> Any:
    """Return an axis a little wider than `values`, None where they do not span one."""
    import rerun.blueprint as rrb

    if not values or max(values) <= min(values):
        return None
    margin = 0.08 * (max(values) - min(values))
    return rrb.ScalarAxis(range=[min(values) - margin, max(values) + margin])


def _title(what: str, names: tuple[str, ...]) -> str:
    return f"{what}: {names[0]}" if len(names) == 1 else f"{what}s"


def _legend(visible: bool) -> Any:
    import rerun.blueprint as rrb

    return rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=visible)
