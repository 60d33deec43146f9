# pyright: basic
"""What the viewer shows of a run: the look of its curves and eigenvalues, and the blueprint, which lays them out."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from koopmpc.base.scene import Color
from koopmpc.control.move import Fallback, Status
from koopmpc.loop.run import About, limits_of
from koopmpc.models.base import Predictor
from koopmpc.views.recording.description import drawable, status_words
from koopmpc.views.recording.eigenvalues import eigenvalue_views
from koopmpc.views.recording.rrd import times
from koopmpc.views.recording.scenes import BACKGROUND, Extent

if TYPE_CHECKING:
    pass

PALETTE: tuple[Color, ...] = (
    (88, 166, 255), (255, 166, 87), (86, 211, 160), (240, 120, 170),
    (188, 150, 255), (235, 203, 100), (110, 205, 220), (190, 190, 190),
)  # fmt: skip
LIMIT: Color = (232, 84, 84)
REFERENCE: Color = (165, 170, 180)
_PREDICTION: Color = (250, 250, 250)
_MEASURED: Color = (120, 126, 138)
_STEP_TIME = "Time of a step, logarithm to base 10 of seconds: -6 is 1 µs, -3 is 1 ms"
_FASTEST = -6.2
_TICKS = 5.0, 8.0  # as many as have numbers, in a low plot and in a high one
_AHEAD = 16  # at most so many stages of a plan are drawn into the plots
SEPARATE = 4  # up to so many states have a plot each
VIEW = "koopmpc.View"  # components that plots alone show, beside the numbers of an entity, in single precision
LOG_TIME = "log10_seconds"  # the one of them that solver/time_ms and solver/deadline_ms have

_STATUS_COLORS: dict[Status, Color] = {
    Status.UNCONSTRAINED: (46, 160, 120),
    Status.OPTIMAL: (70, 125, 200),
    Status.SATURATED: (150, 120, 200),
    Status.SOFTENED: (215, 165, 60),
}


def ahead(horizon: int) -> list[int]:
    """Return the stages of a plan that the plots show, at most 16 at equal steps, the last one among them."""
    return sorted({round(i * horizon / min(horizon, _AHEAD)) for i in range(1, min(horizon, _AHEAD) + 1)})


_Limit = tuple[str, float]  # name, value


@dataclass(frozen=True)
class Panel:
    """One plot of states: its entity, its title, and which states, references and measurements it shows, by index.

    `limits` are the finite limits of these states: name and value of each.
    """

    entity: str
    title: str
    states: list[int]
    references: list[int]
    measured: list[int]
    limits: list[_Limit]

    def label(self, what: str, names: Sequence[str]) -> list[str]:
        """Return the names of curves that say `what` of these states; where there is one state it goes without."""
        return [what if len(self.states) == 1 else f"{name}, {what}" for name in names]


def panels(about: About, nr: int) -> list[Panel]:
    """Return a plot a state, or one plot for all of many states."""
    tracked, places, limits = about.name_references(nr), range(len(about.states)), state_limits(about)
    if len(about.states) > SEPARATE:
        return [Panel("plots/states", "States", [*places], [*range(nr)], [*range(len(about.outputs))], limits)]
    return [
        Panel(
            f"plots/{i}",
            name,
            [i],
            [j for j, other in enumerate(tracked) if other == name],
            [j for j, other in enumerate(about.outputs) if other == name],
            [limit for limit in limits if limit[0] == name],
        )
        for i, name in enumerate(about.states)
    ]


def styles(about: About, nr: int, horizon: int) -> dict[str, Any]:
    """Return the static archetypes by entity that name and colour the curves of a run, `horizon` 0 without plans."""
    stages = ahead(horizon)
    found = {
        "state": _lines(about.states, [color(i) for i in range(len(about.states))], 2.0),
        "reference": _lines([f"{name}, reference" for name in about.name_references(nr)], REFERENCE, 1.5),
        "measurement": _points([f"{name}, measured" for name in about.outputs], _MEASURED, 1.5),
        "control/u": _lines(
            about.inputs, [color(i) for i in range(len(about.inputs))], 2.0, interpolation_mode="StepAfter"
        ),
        "control/limits": _lines(["limits"] * len(input_limits(about)), LIMIT, 1.0, **_step_style(about)),
        "solver/time_ms": _lines(["solve time [ms]"], color(2), 1.5),
        "solver/deadline_ms": _lines(["deadline [ms]"], LIMIT, 1.0),
        "solver/status": _statuses(),
    }
    found |= {f"plots/u/ahead/{j}": _points(["prediction"] * len(about.inputs), _PREDICTION, 1.6) for j in stages}
    for panel in panels(about, nr):
        limits = panel.label("limits", [name for name, _ in panel.limits])
        found[f"{panel.entity}/limits"] = _lines(limits, LIMIT, 1.0, **_step_style(about))
        predicted = panel.label("prediction", [about.states[i] for i in panel.states])
        points = _points(predicted, _PREDICTION, 1.6)
        found |= {f"{panel.entity}/ahead/{j}": points for j in stages}
    return found


def input_limits(about: About) -> list[_Limit]:
    """Return the finite input limits, lower ones first: name and value of each, of limits in time the widest."""
    return [] if about.limits is None else _finite(about.inputs, about.limits.base.inputs(len(about.inputs)))


def state_limits(about: About) -> list[_Limit]:
    """Return the finite limits of states, lower ones first: name and value of each, of limits in time the widest."""
    return [] if about.limits is None else _finite(about.states, about.limits.base.states(len(about.states)))


def limit_lines(about: About, kind: str, names: Sequence[str], k: np.ndarray) -> np.ndarray:
    """Return the limits of `names` among the "states" or "inputs" at steps k, a column each; NaN where there is none.

    The columns are those of `state_limits` or `input_limits`.
    """
    if about.limits is None:
        return np.empty((len(k), 0))
    own = list(getattr(about, kind))
    ends = limits_of(about, kind, k)
    widest = getattr(about.limits.base, kind)(len(own))
    places = [
        (end, own.index(name))
        for end in (0, 1)
        for name in own
        if name in names and np.isfinite(widest[end][own.index(name)])
    ]
    lines = np.column_stack([ends[end][:, i] for end, i in places]) if places else np.empty((len(k), 0))
    return np.where(np.isfinite(lines), lines, np.nan)


def _step_style(about: About) -> dict[str, Any]:
    """Return how limits in time are drawn: from row to row."""
    return {"interpolation_mode": "StepAfter"} if about.limits is not None and about.limits.in_time else {}


def _finite(names: Sequence[str], ends: Any) -> list[_Limit]:
    return [(name, float(v)) for row in ends for name, v in zip(names, row, strict=True) if np.isfinite(v)]


def _statuses() -> Any:
    """Return how the viewer words and colours each way in which a step can end; red where a fallback took over."""
    import rerun as rr

    pairs = [(status, fallback) for status in Status for fallback in Fallback]
    return rr.StateConfiguration(
        values=[status_value(*pair) for pair in pairs],
        labels=[status_words(*pair) for pair in pairs],
        colors=[_STATUS_COLORS.get(s, LIMIT) if f is Fallback.NONE else LIMIT for s, f in pairs],
    )


def status_value(status: Status, fallback: Fallback) -> str:
    """Return "STATUS" or "STATUS → FALLBACK", as the log holds it."""
    return status.name if fallback is Fallback.NONE else f"{status.name} → {fallback.name}"


def color(i: int) -> Color:
    """Return the colour of the i-th state or input."""
    return PALETTE[i % len(PALETTE)]


def _lines(names: Sequence[str], colors: Color | list[Color], width: float, **more: Any) -> Any:
    """Return lines of one colour, or of a colour each."""
    import rerun as rr

    each = colors if isinstance(colors, list) else [colors] * len(names)
    return rr.SeriesLines(names=[drawable(name) for name in names], colors=each, widths=[width] * len(names), **more)


def _points(names: Sequence[str], shade: Color, size: float) -> Any:
    """Return points of one colour and size."""
    import rerun as rr

    drawn = [drawable(name) for name in names]
    return rr.SeriesPoints(names=drawn, colors=[shade] * len(drawn), marker_sizes=[size] * len(drawn))


def write_page(rec: Any, entity: str, text: str, *more: Any) -> None:
    """Write Markdown as a page that does not change, and `more` of the same entity."""
    import rerun as rr

    rec.log(entity, rr.TextDocument(drawable(text), media_type=rr.MediaType.MARKDOWN), *more, static=True)


def draw_line(
    rec: Any, entity: str, name: str, shade: Color, width: float, values: np.ndarray, dt: float, **style: Any
) -> None:
    """Write the finite values of one curve over the steps 0, 1, …; nothing where there is none."""
    import rerun as rr

    k = np.flatnonzero(np.isfinite(values))
    if len(k):  # the viewer crashes on a timeline without rows
        rec.log(entity, rr.SeriesLines(names=drawable(name), colors=shade, widths=width, **style), static=True)
        rec.send_columns(entity, times(k, dt), rr.Scalars.columns(scalars=values[k]))


def _alone(style: Any, component: str) -> Any:
    """Return what draws this component of an entity in place of the vector that it belongs to."""
    from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

    source = f"{VIEW}:{component}"
    to = VisualizerComponentMapping("Scalars:scalars", ComponentSourceKind.SourceComponent, source_component=source)
    return style.visualizer(mappings=[to])


def _draw_panel(panel: Panel) -> dict[str, list[Any]]:
    """Return what the plot of a panel draws of the state, the reference and the measurement, by entity."""
    lines = {
        "/state": [(i, _lines([panel.title], color(i), 2.0)) for i in panel.states],
        "/reference": [(i, _lines(["reference"], REFERENCE, 1.5)) for i in panel.references],
        "/measurement": [(i, _points(["measured"], _MEASURED, 1.5)) for i in panel.measured],
    }
    whole = len(panel.states) > SEPARATE  # then the vectors, as they are
    return {
        entity: [] if whole else [_alone(style, str(i)) for i, style in parts]
        for entity, parts in lines.items()
        if parts
    }


def blueprint(
    about: About,
    nr: int,
    *,
    extent: Extent | None,
    model: Predictor | None,
    horizon: int,
    spans: Mapping[str, Sequence[float]],
    length: float | None,
) -> Any:
    """Return the layout of one run with `nr` references; there is no view without data.

    `extent` is what the animation shows, None where there is no scene; `horizon` the length of the plans, 0 if none;
    `spans` the values, by the entity of a `Panel`, that its axis has to hold, as far as they are known; `length` the
    length of the run [s], None of a running one.
    """
    import rerun.blueprint as rrb

    def plot(entity: str, name: str, drawn: Mapping[str, list[Any]], axis_y: Any) -> Any:
        """Return the plot of an entity and of others, those in `drawn` with the style that it gives them."""
        told = {other: looks for other, looks in drawn.items() if looks}
        return rrb.TimeSeriesView(
            titlebar=roomy,
            contents=[f"/{entity}/**", *drawn],
            name=drawable(name),
            axis_x=shared_time(length),
            axis_y=axis_y,
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=True),
            overrides=cast("Any", _now(entity, horizon, about.dt) | told),
        )

    rows = panels(about, nr)
    # plots of states from which on their titles are left out
    roomy = len(rows) < 3  # else the legends alone name the states, and the plots get the room of the titles
    axes = [readable(spans.get(row.entity, []), _TICKS[roomy]) for row in rows]
    parts = [_draw_panel(row) for row in rows]
    shown = [plot(row.entity, row.title, part, axis) for row, axis, part in zip(rows, axes, parts, strict=True)]
    inputs = f"Input: {about.inputs[0]}" if len(about.inputs) == 1 else "Inputs"
    bounds = readable([v for _, v in input_limits(about)], _TICKS[roomy])
    shown.append(plot("plots/u", inputs, {"/control/u": [], "/control/limits": []}, bounds))
    slowest = rrb.ScalarAxis(range=[_FASTEST, max(float(np.log10(about.dt)), -2.0) + 0.4])
    time = {"/solver/time_ms": [_alone(_lines(["log10 of the time of a step in s"], color(2), 1.5), LOG_TIME)]}
    time["/solver/deadline_ms"] = [_alone(_lines(["sample time, its deadline"], LIMIT, 1.0), LOG_TIME)]
    shown.append(plot("solver/log", _STEP_TIME, time, slowest))
    status = rrb.StateTimelineView(origin="solver/status", name="How each step ended")
    left = rrb.Vertical(*shown, status, row_shares=[1.0] * len(shown) + [max(0.5, 0.12 * len(shown))])
    circle = [] if model is None else [eigenvalue_views(model)[0]]
    texts = rrb.Tabs(
        rrb.TextDocumentView(origin="metrics", name="Metrics"),
        rrb.TextDocumentView(origin="description", name="Description"),
        rrb.TextLogView(origin="log", name="Log"),
        *(circle if extent is None else []),  # without an animation the plots get the room
    )
    right, shares = texts, [2.6, 1.0]
    if extent is not None:
        below = rrb.Horizontal(*circle, texts) if circle else texts
        right, shares = rrb.Vertical(_animation(extent), below, row_shares=[3.0, 2.0]), [1.0, 1.0]
    title = rrb.TextDocumentView(origin="title", name="Run", titlebar=False)
    return frame_views(rrb.Vertical(title, rrb.Horizontal(left, right, column_shares=shares), row_shares=[1.0, 18.0]))


def frame_views(views: Any) -> Any:
    """Return the layout of a log: `views` over the timeline sim_time, all other panels out of the way."""
    import rerun.blueprint as rrb

    return rrb.Blueprint(
        views,
        rrb.TimePanel(timeline="sim_time", state="collapsed", play_state="paused"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )


def shared_time(length: float | None) -> Any:
    """Return a time axis that is moved with those of all other plots; for a long run the whole of it, not moved along.

    Of axes that move together, and of a running loop, the viewer shows a minute about the cursor.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    # length of a run whose plots are moved together [s]
    if length is None or length <= 50.0:
        return rrb.TimeAxis(link="LinkToGlobal")
    begin, end = (rrb.TimeRangeBoundary.absolute(seconds=t) for t in (0.0, length))
    return rrb.TimeAxis(view_range=rr.TimeRange(start=begin, end=end))


def _now(entity: str, horizon: int, dt: float) -> dict[str, Any]:
    """Return for each stage j what shows of it: the one point at j dt after the cursor, which is the current plan's."""
    import rerun as rr
    import rerun.blueprint as rrb

    found: dict[str, Any] = {}
    for j in ahead(horizon):
        begin, end = (rrb.TimeRangeBoundary.cursor_relative(seconds=(j + d) * dt) for d in (-0.5, 0.49))
        ranges = rrb.VisibleTimeRanges([rrb.VisibleTimeRange("sim_time", start=begin, end=end)])
        found[f"/{entity}/ahead/{j}"] = [rr.SeriesPoints.from_fields(), ranges]
    return found


def _animation(extent: Extent) -> Any:
    import rerun.blueprint as rrb

    ranges, name = extent.ranges(), "Animation; fainter: the plan, grey: the reference"
    if ranges is not None and extent.in_space:
        from koopmpc.views.figures.animation import project

        low, high = np.array(ranges).T
        # of the eye from the middle of a scene in space, in its diagonals
        middle, away = (low + high) / 2, 0.75 * float(np.linalg.norm(high - low))
        eye = rrb.EyeControls3D(position=middle + away * project(np.eye(3))[:, 2], look_target=middle, eye_up=(0, 0, 1))
        return rrb.Spatial3DView(
            origin="world", name=name, background=list(BACKGROUND), line_grid=False, eye_controls=eye
        )
    fixed = None if ranges is None else rrb.VisualBounds2D(x_range=ranges[0], y_range=ranges[1])
    return rrb.Spatial2DView(origin="world", name=name, background=list(BACKGROUND), visual_bounds=fixed)


def readable(values: Sequence[float], ticks: float) -> Any:
    """Return an axis a little wider than `values` that holds two ticks with numbers; None where they span nothing.

    The viewer numbers multiples of 1, 10, 100, … and leaves them out where more than `ticks` would stand close.
    """
    import rerun.blueprint as rrb

    low, high = min(values, default=0.0), max(values, default=0.0)
    # a span that no axis shows
    if not 1e-9 * max(abs(low), abs(high), 1e-9) < high - low < 1e100:
        return None
    tick = 10.0 ** math.floor(math.log10(high - low))
    if high - low > ticks * tick:
        below, above = 10 * tick * math.floor(low / (10 * tick)), 10 * tick * math.ceil(high / (10 * tick))
        if above - below < 15 * tick:
            low, high = below, above
        elif low - below < above - high:
            low = below
        else:
            high = above
    elif math.floor(high / tick) - math.ceil(low / tick) < 1:  # one tick: the nearer of its neighbours comes in
        below, above = tick * math.floor(low / tick), tick * math.ceil(high / tick)
        low, high = (below, high) if low - below < above - high else (low, above)
    margin = 0.08 * (high - low)
    return rrb.ScalarAxis(range=[low - margin, high + margin])
