"""The default blueprint: plots on the left; animation, eigenvalues and text on the right."""
# pyright: basic

from typing import Any

from koopmpc.recording.description import About
from koopmpc.recording.eigenvalues import Model, eigenvalue_views
from koopmpc.recording.glyphs import drawable
from koopmpc.recording.scenes import BACKGROUND, Bounds
from koopmpc.recording.styles import input_limits

_SEPARATE = 4  # up to so many states have a plot each


def blueprint(about: About, *, bounds: Bounds | None, model: Model | None) -> Any:
    """Return the layout of one run: what the data cannot fill has no view.

    `bounds` is what the animation shows, None where there is no scene.
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
    pairs = (
        [states[i : i + 2] for i in range(0, len(states), 2)] if len(states) > 2 else [[s] for s in states]
    )
    plots = [pair[0] if len(pair) == 1 else rrb.Horizontal(*pair) for pair in pairs]
    left = rrb.Vertical(*plots, inputs, time, status, row_shares=[3.0] * len(plots) + [3.0, 2.0, 1.4])
    texts = rrb.Tabs(
        rrb.TextDocumentView(origin="metrics", name="Metrics"),
        rrb.TextDocumentView(origin="description", name="Description"),
        rrb.TextLogView(origin="log", name="Log"),
    )
    lower = texts if model is None else rrb.Horizontal(eigenvalue_views(model)[0], texts)
    right = lower if bounds is None else rrb.Vertical(_animation(bounds), lower, row_shares=[3.0, 2.0])
    return rrb.Blueprint(
        rrb.Horizontal(left, right, column_shares=[1.0, 1.0]),
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
                "/measurement": rr.SeriesPoints.from_fields(
                    visible_series=[s == name for s in about.outputs]
                ),
            },
        )
        for name in about.states
    ]


def _animation(bounds: Bounds) -> Any:
    import rerun.blueprint as rrb

    ranges = bounds.ranges()
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
