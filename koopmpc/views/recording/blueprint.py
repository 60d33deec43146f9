# pyright: basic
"""What the viewer shows of a run: the look of its curves and eigenvalues, and the blueprint, which lays them out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from koopmpc.base.scene import Color
from koopmpc.control.move import Fallback, Status
from koopmpc.loop.run import About, limits_of
from koopmpc.models.base import Predictor
from koopmpc.views.figures.style import SEQUENTIAL, map_colors
from koopmpc.views.recording.description import drawable, status_value, status_words
from koopmpc.views.recording.plots import INK, color, frame_views, readable, shared_time
from koopmpc.views.recording.scenes import Extent

if TYPE_CHECKING:
    from koopmpc.validate.residuals import ResidualDMD

_STEP_TIME = "Time of a step, logarithm to base 10 of seconds: -6 is 1 µs, -3 is 1 ms"
SEPARATE = 4  # up to so many states have a plot each
VIEW = "koopmpc.View"  # components that plots alone show, beside the numbers of an entity, in single precision
LOG_TIME = "log10_seconds"  # the one of them that solver/time_ms and solver/deadline_ms have

_STATUS_COLORS: dict[Status, Color] = {
    Status.UNCONSTRAINED: (46, 160, 120),
    Status.OPTIMAL: (70, 125, 200),
    Status.SATURATED: (150, 120, 200),
    Status.SOFTENED: (215, 165, 60),
}


def ahead(horizon: int, most: int = 16) -> list[int]:
    """Return the stages of a plan that the plots show, at most so many at equal steps, the last one among them."""
    count = min(horizon, most)
    return [round(i * horizon / count) for i in range(1, count + 1)]


class LimitLine(NamedTuple):
    """A finite limit of the states or the inputs: of which, its value, of limits in time the widest, and which end."""

    name: str
    value: float
    end: int
    index: int


def find_limits(about: About, kind: str) -> list[LimitLine]:
    """Return the finite limits of the "states" or the "inputs", lower ones first."""
    names = getattr(about, kind)
    ends = () if about.limits is None else getattr(about.limits.base, kind)(len(names))
    lines = [LimitLine(names[i], float(v), end, i) for end, row in enumerate(ends) for i, v in enumerate(row)]
    return [line for line in lines if np.isfinite(line.value)]


@dataclass(frozen=True)
class Panel:
    """One plot of states: its entity, its title, and which states, references and measurements it shows, by index.

    `limits` are the finite limits of these states.
    """

    entity: str
    title: str
    states: list[int]
    references: list[int]
    measured: list[int]
    limits: list[LimitLine]

    def label(self, what: str, names: Sequence[str]) -> list[str]:
        """Return the names of curves that say `what` of these states; where there is one state it goes without."""
        return [what if len(self.states) == 1 else f"{name}, {what}" for name in names]


def panels(about: About, nr: int) -> list[Panel]:
    """Return a plot a state, or one plot for all of many states."""
    tracked, places, limits = about.name_references(nr), range(len(about.states)), find_limits(about, "states")
    if len(about.states) > SEPARATE:
        return [Panel("plots/states", "States", [*places], [*range(nr)], [*range(len(about.outputs))], limits)]
    return [
        Panel(
            f"plots/{i}",
            name,
            [i],
            [j for j, other in enumerate(tracked) if other == name],
            [j for j, other in enumerate(about.outputs) if other == name],
            [limit for limit in limits if limit.name == name],
        )
        for i, name in enumerate(about.states)
    ]


def styles(about: About, nr: int, horizon: int) -> dict[str, Any]:
    """Return the static archetypes by entity that name and colour the curves of a run, `horizon` 0 without plans."""
    stages = ahead(horizon)
    found = {
        "state": _lines(about.states, [color(i) for i in range(len(about.states))], 2.0),
        "reference": _lines([f"{name}, reference" for name in about.name_references(nr)], INK.reference, 1.5),
        "measurement": _points([f"{name}, measured" for name in about.outputs], INK.measured, 1.5),
        "control/u": _lines(
            about.inputs, [color(i) for i in range(len(about.inputs))], 2.0, interpolation_mode="StepAfter"
        ),
        "control/limits": _lines(["limits"] * len(find_limits(about, "inputs")), INK.limit, 1.0, **_step_style(about)),
        "solver/time_ms": _lines(["solve time [ms]"], color(2), 1.5),
        "solver/deadline_ms": _lines(["deadline [ms]"], INK.limit, 1.0),
        "solver/status": _statuses(),
    }
    found |= {f"plots/u/ahead/{j}": _points(["prediction"] * len(about.inputs), INK.prediction, 1.6) for j in stages}
    for panel in panels(about, nr):
        limits = panel.label("limits", [limit.name for limit in panel.limits])
        found[f"{panel.entity}/limits"] = _lines(limits, INK.limit, 1.0, **_step_style(about))
        predicted = panel.label("prediction", [about.states[i] for i in panel.states])
        points = _points(predicted, INK.prediction, 1.6)
        found |= {f"{panel.entity}/ahead/{j}": points for j in stages}
    return found


def limit_rows(about: About, kind: str, limits: Sequence[LimitLine], k: np.ndarray) -> np.ndarray:
    """Return these limits of "states" or "inputs" at steps k, a column each; NaN where there is none."""
    if not limits:
        return np.empty((len(k), 0))
    ends = limits_of(about, kind, k)
    rows = np.column_stack([ends[limit.end][:, limit.index] for limit in limits])
    return np.where(np.isfinite(rows), rows, np.nan)


def _step_style(about: About) -> dict[str, Any]:
    """Return how limits in time are drawn: from row to row."""
    return {"interpolation_mode": "StepAfter"} if about.limits is not None and about.limits.in_time else {}


def _statuses() -> Any:
    """Return how the viewer words and colours each way in which a step can end; red where a fallback took over."""
    import rerun as rr

    pairs = [(status, fallback) for status in Status for fallback in Fallback]
    return rr.StateConfiguration(
        values=[status_value(*pair) for pair in pairs],
        labels=[status_words(*pair) for pair in pairs],
        colors=[_STATUS_COLORS.get(s, INK.limit) if f is Fallback.NONE else INK.limit for s, f in pairs],
    )


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
        "/reference": [(i, _lines(["reference"], INK.reference, 1.5)) for i in panel.references],
        "/measurement": [(i, _points(["measured"], INK.measured, 1.5)) for i in panel.measured],
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
    ticks = 8.0 if roomy else 5.0  # as many as have numbers, in a high plot and in a low one
    axes = [readable(spans.get(row.entity, []), ticks) for row in rows]
    parts = [_draw_panel(row) for row in rows]
    shown = [plot(row.entity, row.title, part, axis) for row, axis, part in zip(rows, axes, parts, strict=True)]
    inputs = f"Input: {about.inputs[0]}" if len(about.inputs) == 1 else "Inputs"
    bounds = readable([limit.value for limit in find_limits(about, "inputs")], ticks)
    shown.append(plot("plots/u", inputs, {"/control/u": [], "/control/limits": []}, bounds))
    slowest = rrb.ScalarAxis(range=[-6.2, max(float(np.log10(about.dt)), -2.0) + 0.4])
    time = {"/solver/time_ms": [_alone(_lines(["log10 of the time of a step in s"], color(2), 1.5), LOG_TIME)]}
    time["/solver/deadline_ms"] = [_alone(_lines(["sample time, its deadline"], INK.limit, 1.0), LOG_TIME)]
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
            origin="world", name=name, background=list(INK.background), line_grid=False, eye_controls=eye
        )
    fixed = None if ranges is None else rrb.VisualBounds2D(x_range=ranges[0], y_range=ranges[1])
    return rrb.Spatial2DView(origin="world", name=name, background=list(INK.background), visual_bounds=fixed)


def plane_view(origin: str, name: str, x: Sequence[float], y: Sequence[float]) -> Any:
    """Return the view of what is drawn in the plane within these ranges of x and y, y down."""
    import rerun.blueprint as rrb

    bounds = rrb.VisualBounds2D(x_range=x, y_range=y)
    return rrb.Spatial2DView(origin=origin, name=name, background=list(INK.background), visual_bounds=bounds)


def draw_eigenvalues(model: Predictor, residuals: "ResidualDMD | None" = None) -> dict[str, Any]:
    """Return static archetypes by entity. Rerun's y points down.

    Without residuals eigenvalues outside the unit circle are red. With them a point is the darker the smaller its
    residual, and one that may be spurious is a ring.
    """
    import rerun as rr

    values = np.asarray(model.eigenvalues if residuals is None else residuals.eigenvalues)
    turn = np.linspace(0, 2 * np.pi, 721)
    size = _reach(model)
    axes = [[(-size, 0), (size, 0)], [(0, -size), (0, size)]]
    at = np.stack([np.real(values), -np.imag(values)], axis=1)
    labels = [f"λ = {v:.4f}, |λ| = {abs(v):.4f}" for v in values]
    if residuals is None:
        outside = np.abs(values) > 1 + 1e-9
        colors = np.where(outside[:, None], [214, 60, 60], [40, 110, 200]).astype(np.uint8)
    else:
        labels = [f"{label}, residual {r:.2g}" for label, r in zip(labels, residuals.residuals, strict=True)]
        darkest, lightest = 1e-2, 1e1  # residuals over the tolerance
        share = np.clip(residuals.residuals / residuals.tolerance, darkest, lightest)
        level = np.log(share / darkest) / np.log(lightest / darkest)
        # share of the colour scale in use; the rest is too light for points
        colors = map_colors(0.85 * level, SEQUENTIAL)
    drawn = {
        "model/axes": rr.LineStrips2D(axes, radii=rr.Radius.ui_points(0.5), colors=[205, 210, 216], draw_order=1),
        "model/circle": rr.LineStrips2D(
            [np.stack([np.cos(turn), np.sin(turn)], axis=1)],
            radii=rr.Radius.ui_points(1.0),
            colors=[120, 130, 145],
            draw_order=2,
        ),
        "model/eigenvalues": rr.Points2D(
            at, radii=rr.Radius.ui_points(5.0), colors=colors, labels=labels, show_labels=False, draw_order=30
        ),
    }
    if residuals is not None and residuals.spurious.any():
        drawn["model/spurious"] = rr.Points2D(
            at[residuals.spurious], radii=rr.Radius.ui_points(2.6), colors=INK.background, draw_order=31
        )
    return drawn


def _reach(model: Predictor) -> float:
    """Return the half width of the picture, which holds the unit circle and the eigenvalues up to |λ| = 2.6."""
    values = np.asarray(model.eigenvalues)
    # largest half width of the picture of eigenvalues
    return min(1.15 * max(1.0, float(np.abs(values).max(initial=0.0))), 3.0)


def eigenvalue_views(model: Predictor, *, residuals: bool = False) -> list[Any]:
    """Return the view of the unit circle, and a closer one where the eigenvalues crowd."""
    size, values = _reach(model), np.asarray(model.eigenvalues)
    views = [_around("Eigenvalues, unit circle", 0.0, size)]
    told = "Closer; rings may be spurious" if residuals else "Closer"
    re, im = np.real(values), np.imag(values)
    half = max(np.ptp(re), np.ptp(im)) / 2
    # share of the picture below which the eigenvalues get one of their own
    if half < 0.35 * size:
        views.append(_around(told, (re.min() + re.max()) / 2, 1.3 * half + 1e-3))
    return views


def _around(name: str, x: float, size: float) -> Any:
    """Return the view of the eigenvalues in the square of half width `size` about x on the real axis."""
    return plane_view("model", name, [x - size, x + size], [-size, size])
