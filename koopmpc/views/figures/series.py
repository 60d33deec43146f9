# pyright: basic
"""Figures over time with a panel for each state and input: forecasts, closed loops, reconstructions, errors."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.control.move import Fallback
from koopmpc.data.episodes import Episode
from koopmpc.lifting.base import StateChoice
from koopmpc.loop.run import Run, limits_of
from koopmpc.validate.bands import Bands, forecast
from koopmpc.validate.scoring import AnyPredictor, Score
from koopmpc.views.figures.style import (
    LIMIT,
    REFERENCE,
    TRUTH,
    Width,
    choose_states,
    draw_band,
    draw_legend,
    fit_label,
    follow_truth,
    label_time,
    limit_axis,
    line_style,
    make_figure,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STATE_HEIGHT = 1.05  # height of the panel of a state [in]
_INPUT_HEIGHT = 0.75  # height of the panel of an input [in]
_BEYOND_MEDIAN = 0.5  # the axis shows a curve up to this many spans outside the truth or the median run
_LEAST_ERROR = 1e-13  # smaller relative errors are rounding, and are drawn with this value
_MOST_ERROR = 1e3  # the axis of the relative error ends here
_WIDE_TRUTH: dict[str, Any] = TRUTH | {"linewidth": 2.4}  # visible on both sides of a curve that covers it


@styled
def rollout(
    predictor: AnyPredictor,
    episode: Episode,
    horizon: int | None = None,
    bands: Bands | None = None,
    *,
    start: int = 0,
    relift: bool = False,
    states: StateChoice | None = None,
    width: Width = "one column",
) -> "Figure":
    """Draw x_{k+h} of the episode, its prediction from x_k and the inputs, and a band around the prediction.

    Parameters
    ----------
    predictor, episode, horizon, bands, start, relift
        Arguments of `koopmpc.validate.forecast`: bands are a conformal band, a score, or half-widths (horizon, nx) in
        the state's unit.
    states
        States to draw, by index or name; all by default.
    width
        "one column" or "two columns".

    Raises
    ------
    ShapeError
        The episode or the bands have other shapes than the predictor needs.
    DataError
        The episode ends before the horizon, or there are too many states for one figure.
    """
    ahead = forecast(predictor, episode, horizon, bands=bands, start=start, relift=relift)
    chosen, nu, t = choose_states(states, ahead.states), len(ahead.inputs), ahead.time
    drawing, axes = _stack_panels(len(chosen), nu, 0, width)
    for panel, i in zip(axes, chosen, strict=False):
        if ahead.band:
            draw_band(panel, t, *_mask_infinite(ahead.low[:, i], ahead.high[:, i]), 0, ahead.band)
        panel.plot(t, ahead.truth[:, i], **TRUTH, label="truth")
        panel.plot(t, ahead.predicted[:, i], **line_style(0, len(t)), label="prediction")
        # the axis shows a prediction up to this many spans of the truth outside the truth
        ylim = follow_truth(ahead.truth[:, i], [ahead.predicted[:, i]], 1.0)
        panel.set_ylim(ylim)
        panel.set_ylabel(**fit_label(ahead.states[i], _STATE_HEIGHT))
    for panel, name, u in zip(axes[len(chosen) :], ahead.inputs, ahead.U.T, strict=True):
        panel.stairs(u, t, baseline=None, **TRUTH)
        panel.set_ylabel(**fit_label(name, _INPUT_HEIGHT))
    axes[-1].set(xlabel="time ahead [s]", xlim=(0, t[-1]))
    draw_legend(drawing, axes[:1], 3)
    return drawing


@styled
def run(run: Run, *, states: StateChoice | None = None, width: Width = "one column") -> "Figure":
    """Draw a closed loop: states with reference and limits, inputs with limits, and the status of each step.

    Parameters
    ----------
    run
        A run of `simulate` or `load_run`.
    states
        States to draw, by index or name; all by default.
    width
        "one column" or "two columns".

    Raises
    ------
    DataError
        There are too many states for one figure.
    """
    checks.kind(run, "run", Run, "pass what simulate or load_run returns")
    chosen, nu, t = choose_states(states, run.states), len(run.inputs), run.time
    drawing, axes = _stack_panels(len(chosen), nu, 1, width)
    tracked = run.name_references(run.reference.shape[1])
    for panel, i in zip(axes, chosen, strict=False):
        if run.states[i] in tracked:
            panel.plot(t, run.reference[:, tracked.index(run.states[i])], **REFERENCE, label="reference")
        panel.plot(t, run.X[:, i], **TRUTH, label="state")
        draw_limits(panel, run, "states", i)
        panel.set_ylabel(**fit_label(run.states[i], _STATE_HEIGHT))
    for j, panel in enumerate(axes[len(chosen) : -1]):
        panel.stairs(run.U[:, j], t, baseline=None, **TRUTH)
        draw_limits(panel, run, "inputs", j)
        panel.set_ylabel(**fit_label(run.inputs[j], _INPUT_HEIGHT))
    _draw_statuses(axes[-1], run)
    axes[-1].set(xlabel=label_time(run.metadata), xlim=(0, t[-1]))
    draw_legend(drawing, axes[:-1], 3)
    return drawing


def _stack_panels(nx: int, nu: int, more: int, width: Width) -> "tuple[Figure, list[Any]]":
    """Return a figure and its panels: states, inputs, and `more` low panels."""
    heights = [_STATE_HEIGHT] * nx + [_INPUT_HEIGHT] * nu + [0.6 * _INPUT_HEIGHT] * more
    drawing, axes = make_figure(
        len(heights), width=width, height=0.7 + sum(heights), sharex=True, height_ratios=heights
    )
    drawing.align_ylabels(list(axes[:, 0]))
    return drawing, list(axes[:, 0])


def _mask_infinite(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the band with NaN where it is infinite."""
    finite = np.isfinite(low) & np.isfinite(high)
    return np.where(finite, low, np.nan), np.where(finite, high, np.nan)


def draw_limits(axes: Any, run: Run, kind: str, i: int) -> list[float]:
    """Draw the finite limits of the i-th of the "states" or "inputs", and return them."""
    if run.limits is None:
        return []
    ends = limits_of(run, kind, np.arange(run.steps + (kind == "states")))
    shown = [end[:, i] for end in ends if np.isfinite(end[:, i]).any()]
    for values in shown:
        if np.ptp(values) == 0:
            axes.axhline(float(values[0]), **LIMIT, label="limit")
        else:
            finite = np.where(np.isfinite(values), values, np.nan)
            axes.plot(run.time[: len(values)], finite, **LIMIT, drawstyle="steps-post", label="limit")
    return sorted({float(v) for values in shown for v in (values.min(), values.max()) if np.isfinite(v)})


def _draw_statuses(axes: Any, run: Run) -> None:
    """Draw a row for each status that occurs, with a tick for each step and a cross for each applied fallback."""
    kinds = sorted(set(run.status), key=lambda status: status.value)
    t, row = run.time[:-1], np.array([kinds.index(status) for status in run.status])
    failed = np.array([fallback is not Fallback.NONE for fallback in run.fallback], dtype=bool)
    axes.plot(t[~failed], row[~failed], "|", color="black", markersize=4)
    axes.plot(t[failed], row[failed], "x", color=LIMIT["color"], markersize=4)
    names = [kind.name.lower().replace("_", " ") for kind in kinds]
    axes.set_yticks(range(len(kinds)), labels=names, fontsize=6)
    axes.set_ylim(len(kinds) - 0.5, -0.5)


@styled
def error(
    scores: Score | Mapping[str, Score], *, states: StateChoice | None = None, width: Width = "one column"
) -> "Figure":
    """Draw the root-mean-square error and the 5 to 95 % band of the errors over the steps ahead, a panel a state.

    The axis spans at most eight times the errors of the best model; larger errors lie outside it.

    Parameters
    ----------
    scores
        One score, or several by the names of their models; all must have the same states.
    states
        States to draw, by index or name; all by default.
    width
        "one column" or "two columns".

    Raises
    ------
    ShapeError
        The scores have different states.
    DataError
        There is no score, or there are too many states for one figure.
    """
    from matplotlib.ticker import MaxNLocator

    checks.kind(scores, "scores", (Score, Mapping), "pass what score returns, or several by name")
    named = {"": scores} if isinstance(scores, Score) else dict(scores)
    for each in named.values():
        checks.kind(each, "a score", Score, "pass what score returns")
    if not named:
        raise DataError("there is no score; pass one, or several by name")
    first, *others = named.values()
    for other in others:
        if other.states != first.states:
            raise ShapeError(
                f"one score is of ({', '.join(first.states)}), another of ({', '.join(other.states)}); "
                "compare models of the same states"
            )
    chosen = choose_states(states, first.states)
    columns = 1 if width == "one column" or len(chosen) == 1 else 2
    rows = -(-len(chosen) // columns)
    drawing, axes = make_figure(rows, columns, width=width, height=0.7 + 1.35 * rows, sharex=True)
    for panel, i in zip(axes.flat, chosen, strict=False):
        _draw_scores(panel, named, i)
        label = fit_label(first.states[i], 1.35)
        panel.set_ylabel(f"error of\n{label['ylabel']}", fontsize=label["fontsize"])
        panel.set_ylim(*_choose_error_axis([_find_extent(score, i) for score in named.values()]))
    for unused in axes.flat[len(chosen) :]:
        unused.remove()
    for panel in axes.flat[max(len(chosen) - columns, 0) : len(chosen)]:
        panel.set_xlabel("steps ahead")
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
        panel.tick_params(labelbottom=True)
    most = 2 if width == "one column" else 4  # columns of the legend, one for each model
    draw_legend(drawing, axes.flat[:1], 2 if len(named) == 1 else min(len(named), most))
    return drawing


def _draw_scores(panel: Any, named: Mapping[str, Score], i: int) -> None:
    """Draw the errors of state i of each model over the steps ahead."""
    for j, (name, score) in enumerate(named.items()):
        ahead = np.arange(1, score.horizon + 1)
        low, high, rmse = (np.where(np.isfinite(v[:, i]), v[:, i], np.nan) for v in (score.low, score.high, score.rmse))
        draw_band(panel, ahead, low, high, j, f"{name} 5 to 95 %".strip())
        panel.plot(ahead, rmse, **line_style(j, score.horizon), label=f"{name} RMSE".strip())
    panel.set_xlim(1, max(s.horizon for s in named.values()))


def _find_extent(score: Score, i: int) -> tuple[float, float]:
    """Return the smallest and the largest finite error of state i."""
    rows = np.concatenate([score.low[:, i], score.high[:, i], score.rmse[:, i]])
    finite = rows[np.isfinite(rows)]
    return float(finite.min(initial=0.0)), float(finite.max(initial=0.0))


def _choose_error_axis(extents: list[tuple[float, float]]) -> tuple[float, float]:
    """Return the limits of an axis that shows all errors of the best model, and not too large ones of the others."""
    low, high = min(extents, key=lambda extent: extent[1] - extent[0])
    lowest, highest = min(low for low, _ in extents), max(high for _, high in extents)
    if low == high:  # a model without errors sets no scale
        return limit_axis(lowest, highest, lowest, highest, 0.0)
    # the axis shows errors of other models up to this many spans of the best model's errors outside
    return limit_axis(low, high, lowest, highest, 3.5)


@styled
def runs(tasks: Mapping[str, Mapping[str, Run]]) -> "Figure":
    """Draw each state and input over time, a curve for each run, with the reference and the input limits.

    Parameters
    ----------
    tasks
        For each column its title, and its runs by the names of the controllers. All runs have the same plant.

    Raises
    ------
    DataError
        There is no run, or the runs have different plants.
    """
    checks.kind(tasks, "tasks", Mapping, "pass {title: {name: run}}")
    for title, task in tasks.items():
        checks.kind(task, f"the runs of {title!r}", Mapping, "pass {name: run}")
        for name, run in task.items():
            checks.kind(run, repr(name), Run, "pass what km.simulate returned")
    all_runs = [run for task in tasks.values() for run in task.values()]
    if not all_runs or not all(tasks.values()):
        raise DataError("there is no run to draw; pass at least one a column")
    states, inputs = all_runs[0].states, all_runs[0].inputs
    if any((run.states, run.inputs) != (states, inputs) for run in all_runs):
        raise DataError("the runs have different states or inputs; draw one plant a figure")
    drawing, grid = _arrange_columns([*states, *inputs], list(tasks), 0.95, label_time(all_runs[0].metadata))
    names = list(dict.fromkeys(name for task in tasks.values() for name in task))
    for column, task in zip(grid.T, tasks.values(), strict=True):
        _draw_task(column, task, names)
    draw_legend(drawing, grid.flat, 4 if len(tasks) > 1 else 2)
    return drawing


def _draw_task(panels: Any, runs: Mapping[str, Run], names: list[str]) -> None:
    """Draw the runs of one task in a column of panels, states first."""
    first = next(iter(runs.values()))
    nx = len(first.states)
    tracked = first.name_references(first.reference.shape[1])
    for i, panel in enumerate(panels):
        curves = [run.X[:, i] if i < nx else run.U[:, i - nx] for run in runs.values()]
        for name, run, values in zip(runs, runs.values(), curves, strict=True):
            panel.plot(run.time[: len(values)], values, **line_style(names.index(name), len(values)), label=name)
        required: list[float] = []  # values that the axis must show in addition to the runs
        if i < nx and first.states[i] in tracked:
            rows = first.reference[:, tracked.index(first.states[i])]
            panel.plot(first.time, rows, **REFERENCE, label="reference")
            required = rows.tolist()
        elif i >= nx:
            required = draw_limits(panel, first, "inputs", i - nx)
        lows, highs = [float(v.min()) for v in curves], [float(v.max()) for v in curves]
        low, high = min([float(np.median(lows)), *required]), max([float(np.median(highs)), *required])
        panel.set_ylim(*limit_axis(low, high, min(lows), max(highs), _BEYOND_MEDIAN))
        panel.set_xlim(0.0, first.time[-1])


@styled
def reconstruction(
    cases: Mapping[str, tuple[ArrayLike, Mapping[str, ArrayLike]]], dt: float, states: Sequence[str]
) -> "Figure":
    """Draw each state over time with its reconstructions, and below ‖x̂_k − x_k‖ / max ‖x‖ on a logarithmic axis.

    Parameters
    ----------
    cases
        For each column its title, the truth (T+1, nx), and the reconstructions (T+1, nx) by name. Parts of a
        reconstruction far from the truth lie outside the axis; the relative error shows them.
    dt
        Sample time [s].
    states
        Names with units.

    Raises
    ------
    ShapeError
        A reconstruction has another shape than its truth.
    DataError
        There is no case, or dt is not above zero.
    """
    dt = checks.positive(dt, "dt", "s")
    checks.kind(cases, "cases", Mapping, "pass name → (true states, reconstructions)")
    states = checks.texts(states, "states")
    if not cases:
        raise DataError("there is no case to draw; pass at least one")
    drawing, grid = _arrange_columns([*states, "relative error"], list(cases), 0.92, "time [s]")
    names = list(dict.fromkeys(name for _, curves in cases.values() for name in curves))
    for column, (title, (true_states, reconstructions)) in zip(grid.T, cases.items(), strict=True):
        truth = checks.array(true_states, f"the truth of {title!r}", (None, len(states)))
        curves = {name: checks.array(curve, name, finite=False) for name, curve in reconstructions.items()}
        for name, curve in curves.items():
            if curve.shape != truth.shape:
                raise ShapeError(
                    f"{name} has shape {curve.shape}, the truth {truth.shape}; pass the same steps and states"
                )
        t = np.arange(len(truth)) * dt
        _draw_states(column[:-1], t, truth, curves, names)
        _draw_relative_errors(column[-1], t, truth, curves, names)
        column[-1].set_xlim(0.0, t[-1])
    draw_legend(drawing, grid[0], 4 if len(cases) > 1 else 3)
    return drawing


def _draw_states(
    panels: Any, t: np.ndarray, truth: np.ndarray, curves: Mapping[str, np.ndarray], names: Sequence[str]
) -> None:
    for panel, i in zip(panels, range(truth.shape[1]), strict=True):
        panel.plot(t, truth[:, i], **_WIDE_TRUTH, label="truth")
        for name, curve in curves.items():
            panel.plot(t, curve[:, i], **line_style(names.index(name), len(t)), label=name)
        panel.set_ylim(*follow_truth(truth[:, i], [curve[:, i] for curve in curves.values()], _BEYOND_MEDIAN))


def _draw_relative_errors(
    panel: Any, t: np.ndarray, truth: np.ndarray, curves: Mapping[str, np.ndarray], names: Sequence[str]
) -> None:
    from matplotlib.ticker import LogLocator, NullLocator

    size = float(np.linalg.norm(truth, axis=1).max())
    errors: list[np.ndarray] = []
    for name, curve in curves.items():
        with np.errstate(over="ignore"):
            relative = np.nan_to_num(np.linalg.norm(curve - truth, axis=1) / size, nan=np.inf)
        panel.semilogy(t, np.clip(relative, _LEAST_ERROR, 10 * _MOST_ERROR), **line_style(names.index(name), len(t)))
        errors.append(relative[1:])
    if not errors:
        return
    # errors start at rounding and may pass through 0, so the axis starts at their 2 % quantile
    usual = min(float(np.quantile(relative, 0.02)) for relative in errors)
    highest = max(float(relative.max()) for relative in errors)
    low, high = (float(np.log10(np.clip(v, _LEAST_ERROR, _MOST_ERROR))) for v in (usual, highest))
    panel.set_ylim(10.0 ** np.floor(low), 10.0 ** max(np.ceil(high), np.floor(low) + 2))
    panel.yaxis.set_major_locator(LogLocator(numticks=5))  # largest number of ticks of the relative error
    panel.yaxis.set_minor_locator(NullLocator())


def _arrange_columns(
    labels: Sequence[str], titles: Sequence[str], height: float, time: str
) -> "tuple[Figure, np.ndarray]":
    """Return a figure with a column of panels for each title, a row for each label, and the label of its time axis."""
    width: Width = "two columns" if len(titles) > 1 else "one column"
    drawing, grid = make_figure(len(labels), len(titles), width=width, height=0.8 + height * len(labels), sharex="col")
    for panel, title in zip(grid[0], titles, strict=True):
        panel.set_title(title)
    for panel, label in zip(grid[:, 0], labels, strict=True):
        panel.set_ylabel(**fit_label(label, height))
    for panel in grid[-1]:
        panel.set_xlabel(time)
    drawing.align_ylabels(list(grid[:, 0]))
    return drawing, grid
