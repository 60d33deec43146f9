# pyright: basic
"""One forecast or one closed loop over time: a panel for each state and each input, the time below."""

from typing import TYPE_CHECKING, Any

import numpy as np

from koopmpc.control.move import Fallback
from koopmpc.data.episodes import Episode
from koopmpc.figures.style import (
    LIMIT,
    REFERENCE,
    TRUTH,
    Width,
    band,
    chosen_states,
    figure,
    followed,
    legend,
    line,
    styled,
)
from koopmpc.lifting.base import Chosen
from koopmpc.loop.run import Run
from koopmpc.validate.bands import Bands, forecast
from koopmpc.validate.scoring import AnyPredictor

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BEYOND = 1.0  # how far the axis follows a prediction beyond the truth, in spans of the truth
_STATE, _INPUT = 1.05, 0.75  # heights of a panel [in]


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
        shown = followed(ahead.truth[:, i], [ahead.predicted[:, i]], _BEYOND)
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
    tracked = run.states if run.cost is None else run.cost.of.bind(run.states).names
    low, high = _box(run, "states", len(run.states))
    for panel, i in zip(axes, chosen, strict=False):
        if run.states[i] in tracked and len(tracked) == run.reference.shape[1]:
            panel.plot(t, run.reference[:, tracked.index(run.states[i])], **REFERENCE, label="reference")
        panel.plot(t, run.X[:, i], **TRUTH, label="state")
        _limits(panel, low[i], high[i])
        panel.set_ylabel(run.states[i])
    low, high = _box(run, "inputs", nu)
    for j, panel in enumerate(axes[len(chosen) : -1]):
        panel.stairs(run.U[:, j], t, baseline=None, **TRUTH)
        _limits(panel, low[j], high[j])
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


def _box(run: Run, what: str, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the limits of "states" or "inputs", infinite where there are none."""
    if run.limits is None:
        return np.full(n, -np.inf), np.full(n, np.inf)
    return getattr(run.limits, what)(n)


def _limits(axes: Any, low: float, high: float) -> None:
    for value in (low, high):
        if np.isfinite(value):
            axes.axhline(value, **LIMIT, label="limit")


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
