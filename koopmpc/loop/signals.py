"""What a loop is driven by, as rows or functions of the right size: references, held inputs, disturbances, noise."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import ShapeError

Signal = ArrayLike | Callable[[int, np.random.Generator], ArrayLike]


def reference_rows(reference: ArrayLike, steps: int, horizon: int) -> Float[np.ndarray, "T nr"]:
    """Return steps + horizon + 1 rows, the last one repeated."""
    rows = checks.array(reference, "reference")
    rows = np.atleast_1d(rows)
    if rows.ndim == 1:
        rows = np.broadcast_to(rows, (steps + 1, len(rows)))
    if rows.shape[0] != steps + 1:
        raise ShapeError(
            f"reference has shape {rows.shape}, expected (nr,) or (steps+1, nr) = ({steps + 1}, nr)"
        )
    return np.vstack([rows, np.broadcast_to(rows[-1], (horizon, rows.shape[1]))])


def held_inputs(u_reference: ArrayLike | None, steps: int, nu: int) -> Float[np.ndarray, "T nu"]:
    """Return one row a step of the inputs that hold the reference; zeros where there are none."""
    if u_reference is None:
        return np.zeros((steps, nu))
    values = checks.array(u_reference, "u_reference")
    if values.ndim < 2:
        return np.tile(checks.vector(values, "u_reference", nu), (steps, 1))
    return checks.array(values, "u_reference", (steps, nu))


def measured_rows(measured: ArrayLike, steps: int, horizon: int) -> Float[np.ndarray, "T nw"]:
    """Return steps + horizon rows of measured disturbances, the last one repeated."""
    rows = np.atleast_1d(checks.array(measured, "measured"))
    if rows.ndim == 1:
        rows = np.broadcast_to(rows, (steps, len(rows)))
    if rows.ndim != 2 or len(rows) != steps:
        raise ShapeError(f"measured has shape {rows.shape}, expected (nw,) or (steps, nw) = ({steps}, nw)")
    return np.vstack([rows, np.broadcast_to(rows[-1], (horizon, rows.shape[1]))])


def signal_of(
    signal: Signal | None, name: str, rows: int, n: int
) -> Callable[[int, np.random.Generator], Float[np.ndarray, " n"]] | None:
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


def noise_of(
    noise: Signal | None, steps: int, ny: int
) -> Callable[[int, np.random.Generator], Float[np.ndarray, " ny"]] | None:
    """Return the measurement noise as a function of (k, rng); a vector holds standard deviations."""
    if noise is None or callable(noise) or np.ndim(noise) == 2:
        return signal_of(noise, "noise", steps + 1, ny)
    deviation = checks.vector(noise, "noise", ny)
    return lambda k, rng: deviation * rng.standard_normal(ny)
