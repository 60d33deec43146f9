"""Signals of a loop as rows, or as functions of the step: references, what holds them, disturbances and noise."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import ShapeError
from koopmpc.control.ask.cost import Cost
from koopmpc.loop.run import bind_outputs
from koopmpc.plants.plant import Plant
from koopmpc.plants.step_map import StepMap

Signal = ArrayLike | Callable[[int, np.random.Generator], ArrayLike]


Draw = Callable[[int, np.random.Generator], Float[np.ndarray, " n"]]  # (k, rng) → a signal at step k


def tracked_rows(
    reference: ArrayLike, cost: Cost | None, plant: StepMap | Plant, steps: int, horizon: int
) -> Float[np.ndarray, "rows nr"]:
    """Return the rows of the reference, one column for each output that the cost tracks."""
    rows = rows_ahead(reference, "reference", "nr", steps + 1, horizon, "steps+1")
    if cost is not None:
        checks.kind(cost, "cost", Cost, "pass km.Cost(Q=…, R=…)")
        states, outputs = list(plant.states), list(plant.outputs)
        tracked = bind_outputs(cost.of, states)
        names, given = states if tracked is None else list(tracked.names), rows.shape[1]
        if given != len(names):
            likely = outputs if len(outputs) == given and set(outputs) <= set(states) else states[:given]
            chosen = ", ".join(repr(name.split(" [")[0]) for name in likely)
            chosen = chosen if len(likely) == 1 else f"[{chosen}]"
            fewer = f", or track fewer by Cost(of=km.State({chosen}), …)" if given < len(names) else ""
            raise ShapeError(
                f"reference has {given} column{'s' * (given != 1)}, and the cost tracks {len(names)}: "
                f"{', '.join(names)}; pass a column for each{fewer}"
            )
    return rows


def rows_ahead(
    values: ArrayLike, name: str, columns: str, count: int, horizon: int, counted: str
) -> Float[np.ndarray, "T n"]:
    """Return `count` rows of a signal that is previewed, and `horizon` rows after them: given ones, or the last one."""
    rows = np.atleast_1d(checks.array(values, name))
    if rows.ndim == 1:
        rows = np.broadcast_to(rows, (count, len(rows)))
    if rows.ndim == 2 and len(rows) == count + horizon:
        return rows.copy()
    if rows.ndim != 2 or len(rows) != count:
        expected = f"({columns},) or ({counted}, {columns}) = ({count}, {columns})"
        raise ShapeError(f"{name} has shape {rows.shape}, expected {expected}")
    return np.vstack([rows, np.broadcast_to(rows[-1], (horizon, rows.shape[1]))])


def find_reference_inputs(
    u_reference: ArrayLike | None, cost: Cost | None, steps: int, nu: int
) -> Float[np.ndarray, "T nu"]:
    """Return the reference input of each step, for the metrics.

    It is `u_reference` if given, else the cost's u_target if that is given as numbers, else zero.
    """
    if u_reference is None:
        given = None if cost is None or isinstance(cost.u_target, str) else cost.given_inputs(nu)
        if given is None:
            return np.zeros((steps, nu))
        if 1 < len(given) < steps:
            raise ShapeError(f"u_target has {len(given)} rows, the run {steps} steps; pass one row, or one a step")
        return np.array(np.broadcast_to(given, (steps, nu)) if len(given) == 1 else given[:steps])
    values = checks.array(u_reference, "u_reference")
    if values.ndim < 2:
        return np.tile(checks.vector(values, "u_reference", nu), (steps, 1))
    return checks.array(values, "u_reference", (steps, nu))


def make_signal(signal: Signal | None, name: str, rows: int, n: int) -> Draw | None:
    """Return the signal as a function of (k, rng); None where there is none."""
    if signal is None:
        return None
    if callable(signal):
        return lambda k, rng: checks.array(signal(k, rng), name, (n,))
    values = checks.array(signal, name)
    if values.ndim < 2:
        constant = checks.vector(values, name, n)
        return lambda k, rng: constant
    values = checks.array(values, name, (rows, n))
    return lambda k, rng: values[k]


def make_noise(noise: Signal, steps: int, ny: int) -> Draw | None:
    """Return the measurement noise as a function of (k, rng); a vector holds standard deviations."""
    if callable(noise) or np.ndim(noise) == 2:
        return make_signal(noise, "noise", steps + 1, ny)
    deviation = checks.vector(noise, "noise", ny)
    return lambda k, rng: deviation * rng.standard_normal(ny)
