# pyright: basic
"""plot_error: the error of a prediction against how far ahead it looks, of one model or of several."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from koopmpc.errors import DataError, ShapeError
from koopmpc.figures.series import _chosen
from koopmpc.figures.style import Width, band, figure, line, styled
from koopmpc.lifting.base import Chosen
from koopmpc.validate.scoring import Score

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FAR = 8.0  # times the errors of the best model that are shown of the others


@styled
def plot_error(
    scores: Score | Mapping[str, Score], *, states: Chosen | None = None, width: Width = "one column"
) -> "Figure":
    """Draw the root-mean-square error and the 5 to 95 % band of the errors against the steps ahead, a panel a state.

    A model whose errors are more than eight times those of the best leaves the picture.

    Parameters
    ----------
    scores
        One, or several by the names of their models; all of the same states.
    states
        Which to draw, by index or name; all by default.
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
    chosen = _chosen(states, first.states)
    columns = 1 if width == "one column" or len(chosen) == 1 else 2
    rows = -(-len(chosen) // columns)
    made, axes = figure(rows, columns, width=width, height=0.7 + 1.35 * rows, sharex=True)
    for panel, i in zip(axes.flat, chosen, strict=False):
        for j, (name, score) in enumerate(named.items()):
            _draw(panel, score, i, j, name)
        panel.set(ylabel=f"error of {first.states[i]}", xlim=(1, max(s.horizon for s in named.values())))
        panel.set_ylim(*_room([_extent(score, i) for score in named.values()]))
    for empty in axes.flat[len(chosen) :]:
        empty.remove()
    for panel in axes.flat[max(len(chosen) - columns, 0) : len(chosen)]:
        panel.set_xlabel("steps ahead")
        panel.xaxis.set_major_locator(MaxNLocator(integer=True))
        panel.tick_params(labelbottom=True)
    most = 2 if width == "one column" else 4  # models beside one another, each a column of its own
    handles, labels = axes.flat[0].get_legend_handles_labels()
    made.legend(handles, labels, loc="outside upper center", ncols=2 if len(named) == 1 else min(len(named), most))
    return made


def _extent(score: Score, i: int) -> tuple[float, float]:
    """Return how far below and above 0 the finite errors of a state reach."""
    rows = np.concatenate([score.low[:, i], score.high[:, i], score.rmse[:, i]])
    finite = rows[np.isfinite(rows)]
    return float(finite.min(initial=0.0)), float(finite.max(initial=0.0))


def _room(extents: list[tuple[float, float]]) -> tuple[float, float]:
    """Return an axis for all of the best model and for others not far beyond it."""
    best = min(high - low for low, high in extents)
    widest = _FAR * best if best > 0 else np.inf
    low, high = min(low for low, _ in extents), max(high for _, high in extents)
    low, high = max(low, -widest / 2), min(high, widest / 2)
    margin = 0.05 * ((high - low) or 1.0)
    return low - margin, high + margin


def _draw(axes: Any, score: Score, i: int, j: int, name: str) -> None:
    ahead = np.arange(1, score.horizon + 1)
    low, high = (np.where(np.isfinite(end[:, i]), end[:, i], np.nan) for end in (score.low, score.high))
    band(axes, ahead, low, high, j, f"{name} 5 to 95 %".strip())
    rmse = np.where(np.isfinite(score.rmse[:, i]), score.rmse[:, i], np.nan)
    axes.plot(ahead, rmse, **line(j, score.horizon), label=f"{name} RMSE".strip())
