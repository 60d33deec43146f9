"""plot_error: the error of a prediction against how far ahead it looks, of one model or of several."""
# pyright: basic

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from koopmpc.errors import DataError, ShapeError
from koopmpc.figures.series import _chosen
from koopmpc.figures.style import Width, band, figure, line, styled
from koopmpc.lifting.chosen import Chosen
from koopmpc.predict.score import Score

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@styled
def plot_error(
    scores: Score | Mapping[str, Score], *, states: Chosen | None = None, width: Width = "one column"
) -> "Figure":
    """Draw the root-mean-square error and the 5 to 95 % band of the errors against the steps ahead, a panel a state.

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
    for empty in axes.flat[len(chosen) :]:
        empty.remove()
    for panel in axes.flat[max(len(chosen) - columns, 0) : len(chosen)]:
        panel.set_xlabel("steps ahead")
        panel.tick_params(labelbottom=True)
    handles, labels = axes.flat[0].get_legend_handles_labels()
    made.legend(handles, labels, loc="outside upper center", ncols=2)
    return made


def _draw(axes: Any, score: Score, i: int, j: int, name: str) -> None:
    ahead = np.arange(1, score.horizon + 1)
    low, high = (np.where(np.isfinite(end[:, i]), end[:, i], np.nan) for end in (score.low, score.high))
    band(axes, ahead, low, high, j, f"{name} 5 to 95 %".strip())
    rmse = np.where(np.isfinite(score.rmse[:, i]), score.rmse[:, i], np.nan)
    axes.plot(ahead, rmse, **line(j, score.horizon), label=f"{name} RMSE".strip())
