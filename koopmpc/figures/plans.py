# pyright: basic
"""The figure of a planned experiment: inputs, expected states with their band, limits, and logs beside them."""

from typing import TYPE_CHECKING

import numpy as np

from koopmpc import checks
from koopmpc.data.episodes import Episodes
from koopmpc.errors import ShapeError
from koopmpc.experiment.plan import ExperimentPlan
from koopmpc.figures.style import (
    LIMIT,
    REFERENCE,
    TRUTH,
    Width,
    choose_states,
    draw_band,
    draw_legend,
    fit_label,
    limit_axis,
    line_style,
    make_figure,
    styled,
)
from koopmpc.lifting.base import StateChoice

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STATE_HEIGHT = 1.1  # height of the panel of a state [in]
_INPUT_HEIGHT = 0.8  # height of the panel of an input [in]
_BEYOND = 0.5  # the axis shows a limit up to this many spans of the plan outside


@styled
def plan(
    plan: ExperimentPlan,
    episode: int = 0,
    *,
    log: Episodes | None = None,
    states: StateChoice | None = None,
    width: Width = "one column",
) -> "Figure":
    """Draw an episode of a planned experiment: expected states with their band and limits, and the inputs.

    Parameters
    ----------
    plan
        A plan of `next_experiment`.
    episode
        Number of the episode.
    log
        Episodes that were recorded under the plan, in its order; drawn as measured.
    states
        States to draw, by index or name; all by default.
    width
        "one column" or "two columns".

    Raises
    ------
    ShapeError
        The log has other states or fewer episodes.
    DataError
        There are too many states for one figure.
    """
    checks.kind(plan, "plan", ExperimentPlan, "pass what next_experiment returns")
    one, chosen = plan.choose_episode(episode), choose_states(states, plan.states)
    if log is not None and (log.nx != len(plan.states) or len(log) <= episode):
        raise ShapeError(
            f"the log has {len(log)} episodes of {log.nx} states, the plan {plan.episodes} of {len(plan.states)}; "
            "pass the logs of this plan, in its order"
        )
    points = one.set_points
    heights = [_STATE_HEIGHT] * len(chosen) + [_INPUT_HEIGHT] * (plan.nu + (points is not None))
    drawing, grid = make_figure(
        len(heights), width=width, height=0.5 + sum(heights), sharex=True, height_ratios=heights
    )
    axes, t = grid[:, 0], np.arange(plan.steps + 1) * plan.dt
    for panel, i in zip(axes, chosen, strict=False):
        low, high = one.low[0, :, i], one.high[0, :, i]
        draw_band(panel, t, low, high, 0, f"{100 * plan.level:g} % band")
        panel.plot(t, one.X[0, :, i], **line_style(0, len(t)), label="expected")
        bottom, top = float(low.min()), float(high.max())
        if log is not None:
            measured = log[episode].X[: len(t), i]
            panel.plot(t[: len(measured)], measured, **TRUTH, label="measured")
            bottom, top = min(bottom, float(measured.min())), max(top, float(measured.max()))
        ends = [float(end[i]) for end in (plan.x_low, plan.x_high) if np.isfinite(end[i])]
        for end in ends:
            panel.axhline(end, **LIMIT, label="limit")
        panel.set_ylim(limit_axis(bottom, top, min([bottom, *ends]), max([top, *ends]), _BEYOND))
        panel.set_ylabel(**fit_label(plan.states[i], _STATE_HEIGHT))
    rest = list(axes[len(chosen) :])
    if points is not None:
        rest.pop(0).plot(t, points[0], **REFERENCE, label="set point")
        axes[len(chosen)].set_ylabel("set points")
    for panel, name, j in zip(rest, plan.inputs, range(plan.nu), strict=True):
        panel.stairs(one.U[0, :, j], t, baseline=None, **TRUTH)
        for end in (plan.box.low[j], plan.box.high[j]):
            panel.axhline(end, **LIMIT)
        panel.set_ylabel(**fit_label(name, _INPUT_HEIGHT))
    axes[-1].set(xlabel="time [s]", xlim=(0, t[-1]))
    draw_legend(drawing, axes[: len(chosen) + 1], 4)
    return drawing
