# pyright: basic
"""Curves over time, a panel for each state and input: a forecast, closed loops, reconstructions, errors by horizon."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.move import Fallback
from koopmpc.data.episodes import Episode
from koopmpc.errors import DataError, ShapeError
from koopmpc.figures.style import (
    LIMIT,
    REFERENCE,
    TRUTH,
    Width,
    band,
    chosen_states,
    figure,
    followed,
    interval,
    legend,
    line,
    styled,
)
from koopmpc.lifting.base import Chosen
from koopmpc.loop.run import Run
from koopmpc.validate.bands import Bands, forecast
from koopmpc.validate.scoring import AnyPredictor, Score

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STATE, _INPUT = 1.05, 0.75  # heights of a panel [in]
_NEAR = 1.0  # how far the axis follows a prediction beyond the truth, in spans of the truth
_BEYOND = 3.5  # how far the axis follows other models beyond the best one's errors, in spans of those
_LEAVES = 0.5  # how far the axis follows a curve beyond the truth or the median run, in spans of those
_LEAST, _HIGHEST = 1e-13, 1e3  # relative errors below the first are rounding, and those above the second look alike
_TICKS = 5  # ticks of the relative error, at most
_BENEATH: dict[str, Any] = TRUTH | {"linewidth": 2.4}  # wide enough to show on both sides of a curve that lies on it


@styled
def rollout(
    predictor: AnyPredictor,
    episode: Episode,
    horizon: int | None = None,
    bands: Bands | None = None,
    *,
    start: int = 0,
    relift: bool = False,
    states: Chosen | None = None,
    width: Width = "one column",
) -> "Figure":
    """Draw x_{k+h} of the episode, its prediction from x_k and the inputs, and a band around that.

    Parameters
    ----------
    predictor, episode, horizon, bands, start, relift
        As in `koopmpc.validate.forecast`: bands are a conformal band, a score, or half-widths (horizon, nx) in the
        state's unit.
    states
        States to draw, by index or name; all by default.
    width
        "one column" or "two columns".

    Raises
    ------
    ShapeError
        The episode, or the bands, do not fit the predictor.
    DataError
        The episode ends before the horizon; there are too many states for one figure.
    """
    ahead = forecast(predictor, episode, horizon, bands=bands, start=start, relift=relift)
    chosen, nu, t = chosen_states(states, ahead.states), len(ahead.inputs), ahead.time
    made, axes = _panels(len(chosen), nu, 0, width)
    for panel, i in zip(axes, chosen, strict=False):
        if ahead.band:
            band(panel, t, *_within(ahead.low[:, i], ahead.high[:, i]), 0, ahead.band)
        panel.plot(t, ahead.truth[:, i], **TRUTH, label="truth")
        panel.plot(t, ahead.predicted[:, i], **line(0, len(t)), label="prediction")
        shown = followed(ahead.truth[:, i], [ahead.predicted[:, i]], _NEAR)
        panel.set(ylabel=ahead.states[i], ylim=shown)
    for panel, name, u in zip(axes[len(chosen) :], ahead.inputs, ahead.U.T, strict=True):
        panel.stairs(u, t, baseline=None, **TRUTH)
        panel.set_ylabel(name)
    axes[-1].set(xlabel="time ahead [s]", xlim=(0, t[-1]))
    legend(made, axes[:1], 3)
    return made


@styled
def run(run: Run, *, states: Chosen | None = None, width: Width = "one column") -> "Figure":
    """Draw a closed loop: states with reference and limits, inputs with limits, and how each step ended.

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
    chosen, nu, t = chosen_states(states, run.states), len(run.inputs), run.time
    made, axes = _panels(len(chosen), nu, 1, width)
    tracked = run.tracked(run.reference.shape[1])
    for panel, i in zip(axes, chosen, strict=False):
        if run.states[i] in tracked:
            panel.plot(t, run.reference[:, tracked.index(run.states[i])], **REFERENCE, label="reference")
        panel.plot(t, run.X[:, i], **TRUTH, label="state")
        _limits(panel, run, "states", i)
        panel.set_ylabel(run.states[i])
    for j, panel in enumerate(axes[len(chosen) : -1]):
        panel.stairs(run.U[:, j], t, baseline=None, **TRUTH)
        _limits(panel, run, "inputs", j)
        panel.set_ylabel(run.inputs[j])
    _statuses(axes[-1], run)
    axes[-1].set(xlabel="time [s]", xlim=(0, t[-1]))
    legend(made, axes[:-1], 3)
    return made


def _panels(nx: int, nu: int, more: int, width: Width) -> "tuple[Figure, list[Any]]":
    heights = [_STATE] * nx + [_INPUT] * nu + [0.6 * _INPUT] * more
    made, axes = figure(len(heights), width=width, height=0.7 + sum(heights), sharex=True, height_ratios=heights)
    made.align_ylabels(list(axes[:, 0]))
    return made, list(axes[:, 0])


def _within(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the band where it is finite, NaN elsewhere."""
    finite = np.isfinite(low) & np.isfinite(high)
    return np.where(finite, low, np.nan), np.where(finite, high, np.nan)


def _limits(axes: Any, run: Run, what: str, i: int) -> list[float]:
    """Draw the finite limits of the i-th of the "states" or "inputs", and return them."""
    if run.limits is None:
        return []
    ends = getattr(run.limits, what)(len(getattr(run, what)))
    finite = [float(end[i]) for end in ends if np.isfinite(end[i])]
    for value in finite:
        axes.axhline(value, **LIMIT, label="limit")
    return finite


def _statuses(axes: Any, run: Run) -> None:
    """Draw one row for each status that occurs, a tick for each step, and a cross where a fallback was applied."""
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
    scores: Score | Mapping[str, Score], *, states: Chosen | None = None, width: Width = "one column"
) -> "Figure":
    """Draw the root-mean-square error and the 5 to 95 % band of the errors against the steps ahead, a panel a state.

    The axis spans at most eight times the errors of the best model; worse models leave the picture.

    Parameters
    ----------
    scores
        One score, or several by the names of their models; all of the same states.
    states
        States to draw, by index or name; all by default.
    width
        "one column" or "two columns".

    Raises
    ------
    ShapeError
        The scores are of different states.
    DataError
        There is no score; there are too many states for one figure.
    """
    from matplotlib.ticker import MaxNLocator

    named = {"": scores} if isinstance(scores, Score) else dict(scores)
    if not named:
        raise DataError("there is no score; pass one, or several by name")
    first, *others = named.values()
    for other in others:
        if other.states != first.states:
            raise ShapeError(
                f"one score is of ({', '.join(first.states)}), another of ({', '.join(other.states)}); "
                "compare models of the same states"
            )
    chosen = chosen_states(states, first.states)
    columns = 1 if width == "one column" or len(chosen) == 1 else 2
    rows = -(-len(chosen) // columns)
    made, axes = figure(rows, columns, width=width, height=0.7 + 1.35 * rows, sharex=True)
    for panel, i in zip(axes.flat, chosen, strict=False):
        for j, (name, score) in enumerate(named.items()):
            ahead = np.arange(1, score.horizon + 1)
            low, high, rmse = (
                np.where(np.isfinite(v[:, i]), v[:, i], np.nan) for v in (score.low, score.high, score.rmse)
            )
            band(panel, ahead, low, high, j, f"{name} 5 to 95 %".strip())
            panel.plot(ahead, rmse, **line(j, score.horizon), label=f"{name} RMSE".strip())
        panel.set(ylabel=f"error of\n{first.states[i]}", xlim=(1, max(s.horizon for s in named.values())))
        panel.set_ylim(*_error_interval([_extent(score, i) for score in named.values()]))
    for empty in axes.flat[len(chosen) :]:
        empty.remove()
    for panel in axes.flat[max(len(chosen) - columns, 0) : len(chosen)]:
        panel.set_xlabel("steps ahead")
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
        panel.tick_params(labelbottom=True)
    most = 2 if width == "one column" else 4  # models stand beside one another in the legend
    legend(made, axes.flat[:1], 2 if len(named) == 1 else min(len(named), most))
    return made


def _extent(score: Score, i: int) -> tuple[float, float]:
    """Return the least and the largest finite error of state i."""
    rows = np.concatenate([score.low[:, i], score.high[:, i], score.rmse[:, i]])
    finite = rows[np.isfinite(rows)]
    return float(finite.min(initial=0.0)), float(finite.max(initial=0.0))


def _error_interval(extents: list[tuple[float, float]]) -> tuple[float, float]:
    """Return an axis for all errors of the best model, and for those of others that are not far beyond them."""
    low, high = min(extents, key=lambda extent: extent[1] - extent[0])
    lowest, highest = min(low for low, _ in extents), max(high for _, high in extents)
    if low == high:  # a model without errors sets no scale
        return interval(lowest, highest, lowest, highest, 0.0)
    return interval(low, high, lowest, highest, _BEYOND)


@styled
def runs(tasks: Mapping[str, Mapping[str, Run]]) -> "Figure":
    """Draw each state and input over time, a curve for each run, with the reference and the input limits.

    Parameters
    ----------
    tasks
        A column each: its title, and its runs by the name of the controller. All of one plant.

    Raises
    ------
    DataError
        There is no run, or the runs are of different plants.
    """
    every = [run for each in tasks.values() for run in each.values()]
    if not every or not all(tasks.values()):
        raise DataError("there is no run to draw; pass at least one a column")
    states, inputs = every[0].states, every[0].inputs
    if any((run.states, run.inputs) != (states, inputs) for run in every):
        raise DataError("the runs have different states or inputs; draw one plant a figure")
    made, grid = _columns([*states, *inputs], list(tasks), 0.95)
    names = list(dict.fromkeys(name for each in tasks.values() for name in each))
    for column, each in zip(grid.T, tasks.values(), strict=True):
        _loops(column, each, names)
    legend(made, grid.flat, 4)
    return made


def _loops(panels: Any, runs: Mapping[str, Run], names: list[str]) -> None:
    """Draw the runs of one task in a column of panels, states first."""
    first = next(iter(runs.values()))
    nx = len(first.states)
    tracked = first.tracked(first.reference.shape[1]) == first.states
    for i, panel in enumerate(panels):
        drawn = [run.X[:, i] if i < nx else run.U[:, i - nx] for run in runs.values()]
        for name, run, values in zip(runs, runs.values(), drawn, strict=True):
            panel.plot(run.time[: len(values)], values, **line(names.index(name), len(values)), label=name)
        asked: list[float] = []  # what the axis has to show besides the runs
        if i < nx and tracked:
            panel.plot(first.time, first.reference[:, i], **REFERENCE, label="reference")
            asked = first.reference[:, i].tolist()
        elif i >= nx:
            asked = _limits(panel, first, "inputs", i - nx)
        lows, highs = [float(v.min()) for v in drawn], [float(v.max()) for v in drawn]
        low, high = min([float(np.median(lows)), *asked]), max([float(np.median(highs)), *asked])
        panel.set_ylim(*interval(low, high, min(lows), max(highs), _LEAVES))
        panel.set_xlim(0.0, first.time[-1])


@styled
def reconstruction(
    cases: Mapping[str, tuple[ArrayLike, Mapping[str, ArrayLike]]], dt: float, states: Sequence[str]
) -> "Figure":
    """Draw each state over time with its reconstructions, and below ‖x̂_k − x_k‖ / max ‖x‖ on a logarithmic axis.

    Parameters
    ----------
    cases
        A column each: its title, the truth (T+1, nx), and the reconstructions (T+1, nx) by name. What leaves the
        truth by far leaves the picture; the error shows how far.
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
    if not cases:
        raise DataError("there is no case to draw; pass at least one")
    made, grid = _columns([*states, "relative error"], list(cases), 0.92)
    names = list(dict.fromkeys(name for _, curves in cases.values() for name in curves))
    for column, (title, (given, curves)) in zip(grid.T, cases.items(), strict=True):
        truth = checks.array(given, f"the truth of {title!r}", (None, len(states)))
        told = {name: checks.array(curve, name, finite=False) for name, curve in curves.items()}
        for name, curve in told.items():
            if curve.shape != truth.shape:
                raise ShapeError(
                    f"{name} has shape {curve.shape}, the truth {truth.shape}; pass the same steps and states"
                )
        t = np.arange(len(truth)) * dt
        _trajectories(column[:-1], t, truth, told, names)
        _relative_errors(column[-1], t, truth, told, names)
        column[-1].set_xlim(0.0, t[-1])
    legend(made, grid[0], 4 if len(cases) > 1 else 3)
    return made


def _trajectories(
    panels: Any, t: np.ndarray, truth: np.ndarray, curves: Mapping[str, np.ndarray], names: Sequence[str]
) -> None:
    for panel, i in zip(panels, range(truth.shape[1]), strict=True):
        panel.plot(t, truth[:, i], **_BENEATH, label="truth")
        for name, curve in curves.items():
            panel.plot(t, curve[:, i], **line(names.index(name), len(t)), label=name)
        panel.set_ylim(*followed(truth[:, i], [curve[:, i] for curve in curves.values()], _LEAVES))


def _relative_errors(
    panel: Any, t: np.ndarray, truth: np.ndarray, curves: Mapping[str, np.ndarray], names: Sequence[str]
) -> None:
    from matplotlib.ticker import LogLocator, NullLocator

    size = float(np.linalg.norm(truth, axis=1).max())
    errors: list[np.ndarray] = []
    for name, curve in curves.items():
        with np.errstate(over="ignore"):
            relative = np.nan_to_num(np.linalg.norm(curve - truth, axis=1) / size, nan=np.inf)
        panel.semilogy(t, np.clip(relative, _LEAST, 10 * _HIGHEST), **line(names.index(name), len(t)))
        errors.append(relative[1:])
    if not errors:  # nothing to scale an axis by
        return
    # errors start at rounding and may pass through 0, so the axis starts at their 2 % quantile
    usual = min(float(np.quantile(relative, 0.02)) for relative in errors)
    highest = max(float(relative.max()) for relative in errors)
    low, high = (float(np.log10(np.clip(v, _LEAST, _HIGHEST))) for v in (usual, highest))
    panel.set_ylim(10.0 ** np.floor(low), 10.0 ** max(np.ceil(high), np.floor(low) + 2))
    panel.yaxis.set_major_locator(LogLocator(numticks=_TICKS))
    panel.yaxis.set_minor_locator(NullLocator())


def _columns(labels: Sequence[str], titles: Sequence[str], height: float) -> "tuple[Figure, np.ndarray]":
    """Return a figure with a column of panels for each title, a row for each label, and time below."""
    width: Width = "two columns" if len(titles) > 1 else "one column"
    made, grid = figure(len(labels), len(titles), width=width, height=0.8 + height * len(labels), sharex="col")
    for panel, title in zip(grid[0], titles, strict=True):
        panel.set_title(title)
    for panel, label in zip(grid[:, 0], labels, strict=True):
        panel.set_ylabel(label)
    for panel in grid[-1]:
        panel.set_xlabel("time [s]")
    made.align_ylabels(list(grid[:, 0]))
    return made, grid
