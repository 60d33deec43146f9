# pyright: basic
"""plot_reconstruction: trajectories that models tell from the first state, over the truth, and their errors."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError, ShapeError
from koopmpc.figures.style import TRUTH, figure, line, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_BEYOND = 0.5  # spans of the truth that a curve may leave it by and stay in the picture
_LEAST = 1e-13  # errors below it are rounding
_HIGHEST = 1e3  # errors above it are all the same
_TICKS = 5  # at most, of the error
_PANEL = 0.92  # height [in]
_BENEATH: dict[str, Any] = TRUTH | {"linewidth": 2.4}  # seen on both sides of a curve that lies on it


@styled
def plot_reconstruction(
    cases: Mapping[str, tuple[ArrayLike, Mapping[str, ArrayLike]]],
    dt: float,
    states: Sequence[str],
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
    rows, nx = len(states) + 1, len(states)
    wide = len(cases) > 1
    made, grid = figure(
        rows,
        len(cases),
        width="two columns" if wide else "one column",
        height=0.75 + _PANEL * rows,
        sharex="col",
    )
    names = list(dict.fromkeys(name for _, curves in cases.values() for name in curves))
    for column, (title, (given, curves)) in enumerate(cases.items()):
        truth = checks.array(given, f"the truth of {title!r}", (None, nx))
        t = np.arange(len(truth)) * dt
        _column(grid[:, column], t, truth, {name: _fitting(curves[name], name, truth) for name in curves}, names)
        grid[0, column].set_title(title)
        grid[-1, column].set(xlabel="time [s]", xlim=(0.0, t[-1]))
    for row, label in enumerate([*states, "relative error"]):
        grid[row, 0].set_ylabel(label)
    made.align_ylabels(list(grid[:, 0]))
    handles: dict[str, Any] = {}
    for panel in grid[0]:
        found, labels = panel.get_legend_handles_labels()
        handles |= dict(zip(labels, found, strict=True))
    across = min(len(handles), 4 if wide else 2 if len(handles) > 3 else 3)
    made.legend(list(handles.values()), list(handles), loc="outside upper center", ncols=across)
    return made


def _column(
    panels: Any, t: np.ndarray, truth: np.ndarray, curves: Mapping[str, np.ndarray], names: Sequence[str]
) -> None:
    from matplotlib.ticker import LogLocator, NullLocator

    size = float(np.linalg.norm(truth, axis=1).max())
    errors: list[np.ndarray] = []
    for panel, i in zip(panels[:-1], range(truth.shape[1]), strict=True):
        panel.plot(t, truth[:, i], **_BENEATH, label="truth")
        for name, curve in curves.items():
            panel.plot(t, curve[:, i], **line(names.index(name), len(t)), label=name)
        low, high = float(truth[:, i].min()), float(truth[:, i].max())
        room = _BEYOND * ((high - low) or 1.0)
        panel.set_ylim(low - room, high + room)
    for name, curve in curves.items():
        with np.errstate(over="ignore"):
            error = np.nan_to_num(np.linalg.norm(curve - truth, axis=1) / size, nan=np.inf)
        panels[-1].semilogy(t, np.clip(error, _LEAST, 10 * _HIGHEST), **line(names.index(name), len(t)))
        errors.append(error[1:])
    if errors:
        usual = min(float(np.quantile(error, 0.02)) for error in errors)  # it starts at rounding, and passes through 0
        highest = max(float(error.max()) for error in errors)
        low, high = (float(np.log10(np.clip(v, _LEAST, _HIGHEST))) for v in (usual, highest))
        panels[-1].set_ylim(10.0 ** np.floor(low), 10.0 ** max(np.ceil(high), np.floor(low) + 2))
    panels[-1].yaxis.set_major_locator(LogLocator(numticks=_TICKS))
    panels[-1].yaxis.set_minor_locator(NullLocator())


def _fitting(curve: ArrayLike, name: str, truth: np.ndarray) -> np.ndarray:
    X = checks.array(curve, name, finite=False)
    if X.shape != truth.shape:
        raise ShapeError(f"{name} has shape {X.shape}, the truth {truth.shape}; pass the same steps and states")
    return X
