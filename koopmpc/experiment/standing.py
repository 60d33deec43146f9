"""Set points for a controller that stands: candidates, their simulation, and whether the logs were made under it."""

from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.limits import Interval
from koopmpc.data.episodes import Episodes
from koopmpc.errors import DataError
from koopmpc.experiment.candidates import draw_sines, draw_steps, spread_levels
from koopmpc.experiment.ensemble import Ensemble
from koopmpc.lifting.state import Constant, State
from koopmpc.synthesis.asked import DesignTask
from koopmpc.text import to_percent
from koopmpc.validate.sufficiency import feedback_share

_MEMBERS = 6  # bootstrap models that a controller is simulated on, for it is called step by step
_SCALES = (1.0, 0.6, 0.3, 0.1, 0.0)  # shares of the range of set points
_SLOW = (8, 16, 32, 64)  # steps for which a set point is held
_UNEXPLAINED = 0.1  # a controller that explains less of the inputs than this share did not make the logs
_MEMBERS_NEEDED = ("dt", "nu", "horizon", "reset", "__call__")


def check_standing(controller: Any, data: Episodes) -> tuple[str, ...]:
    """Return a sentence if the inputs of the logs do not follow from the states, as under a controller they would.

    Raises
    ------
    DataError
        The controller lacks a member, or has another dt or number of inputs.
    """
    advice = "pass the controller under which the plant stands, as a Controller; see km.control.Controller"
    checks.members(controller, "controller", _MEMBERS_NEEDED, advice)
    if controller.nu != data.nu or abs(controller.dt - data.dt) > 1e-9 * data.dt:
        raise DataError(
            f"controller has {controller.nu} inputs and dt = {controller.dt:g} s, the data {data.nu} and {data.dt:g} s;"
            " pass the one under which the logs were made"
        )
    shares = feedback_share(data, State() + Constant())
    j = int(np.argmin(shares[: data.nu]))
    if shares[j] >= _UNEXPLAINED:
        return ()
    return (
        f"the standing controller is not in the logs: the states explain {to_percent(float(shares[j]))} of "
        f"{data.inputs[j]}, so it was not acting; the plan assumes that it acts from the first step on",
    )


def draw_set_points(
    asked: DesignTask,
    x0: Float[np.ndarray, " nx"],
    states: tuple[str, ...],
    steps: int,
    horizon: int,
    rng: np.random.Generator,
) -> list[tuple[str, Float[np.ndarray, "rows nr"]]]:
    """Return candidates: name, and rows of set points for the steps and the preview of the controller.

    They move around the reference, and around the start x0.
    """
    of, rows = asked.cost.of.bind(states), steps + 1 + horizon
    ends = of(np.array([asked.low, asked.high]))
    found: list[tuple[str, np.ndarray]] = []
    for middle, scale in product((asked.reference[0], of(x0)), _SCALES):
        box = Interval(np.minimum(ends.min(axis=0), middle), np.maximum(ends.max(axis=0), middle))
        steps_of = draw_steps(rows, len(middle), rng, _SLOW)
        found.append(("set points in random steps", spread_levels(steps_of, middle, box, scale)))
        if scale > 0:
            waves = draw_sines(rows, len(middle), rng)
            found.append(("set points as a sum of sines", spread_levels(waves, middle, box, scale)))
    return found


def simulate_standing(
    ensemble: Ensemble,
    controller: Any,
    start: Float[np.ndarray, " n"],
    rows: Float[np.ndarray, "rows nr"],
    steps: int,
    box: Interval,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "T1 members one n"], Float[np.ndarray, "T members one nu"]]:
    """Return points and inputs of the controller on the model, and on bootstrap models with residuals of the data."""
    own = 1 + min(_MEMBERS, len(ensemble.theta) - 1)
    chosen = [*range(own), *range(len(ensemble.theta), ensemble.members)]
    residuals = ensemble.draw_residuals(rng, steps, len(chosen))
    points, inputs = list[np.ndarray](), list[np.ndarray]()
    for place, member in enumerate(chosen):
        one, E = ensemble.pick(member), residuals[:, place] * (0 < place < own)
        controller.reset(start[: ensemble.nx].copy())
        point = start[None, None]
        path, moves = [point[0]], list[np.ndarray]()
        for k in range(steps):
            u = np.asarray(controller(point[0, 0, : ensemble.nx], rows[k : k + controller.horizon + 1]).u)
            u = np.clip(u, box.low, box.high)
            point = one.step(point, u[None, None], E[k][None, None])
            path.append(point[0])
            moves.append(u[None])
        points.append(np.array(path))
        inputs.append(np.array(moves))
    return np.array(points).transpose(1, 0, 2, 3), np.array(inputs).transpose(1, 0, 2, 3)
