"""Boxes of limits, how soft each row is, and the checks that `Limits` makes of what a user passes."""

from typing import NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import Interval as Interval
from koopmpc.control.in_time.bounds import BoundByName

SOFTENED = 1e-4  # a slack above this share of the size of its limit is reported
Slack = tuple[ArrayLike, ArrayLike]
Bound = ArrayLike | BoundByName | None  # of a limit, as a user writes it


class Softness(NamedTuple):
    """linear ε + quadratic ε² is what a row's violation ε costs; linear = inf is a hard row.

    A violation above its `allowance`, 1e-4 of the limit's size, is reported.
    """

    linear: Float[np.ndarray, " n"]
    quadratic: Float[np.ndarray, " n"]
    allowance: Float[np.ndarray, " n"]


class Movable(NamedTuple):
    """Which inputs, rates and limited outputs [x; of(x)] have a limit, or may get one in time."""

    inputs: Bool[np.ndarray, " nu"]
    rates: Bool[np.ndarray, " nu"]
    outputs: Bool[np.ndarray, " n"]


class LimitRows(NamedTuple):
    """The limited outputs [x; y] that have a limit: which they are, their limits, how soft each is, and its margins."""

    kept: Bool[np.ndarray, " n"]
    box: Interval
    softness: Softness
    margin: Float[np.ndarray, "K n"]


class SizedLimits(NamedTuple):
    """Limits in the sizes of a model: of its inputs, of their changes, and of the limited outputs [x; y] in `rows`.

    `rates` exist only with limits of changes. `hard_rates` are the rate limits that are hard, with ±inf in place
    of the others; None if there are none.
    """

    inputs: Interval
    rates: Interval | None
    hard_rates: Interval | None
    rate_softness: Softness
    rows: LimitRows


def preview_margin(margin: Float[np.ndarray, "K n"], N: int) -> Float[np.ndarray, "N n"]:
    """Return the margins of the steps 1 … N."""
    return margin[np.minimum(np.arange(N), len(margin) - 1)]


def is_finite(box: Interval) -> Bool[np.ndarray, " n"]:
    """Return which rows have a limit."""
    return np.isfinite(box.low) | np.isfinite(box.high)


def half_width(box: Interval) -> Float[np.ndarray, " n"]:
    """Return half the width of limits with two finite ends, NaN where there are fewer, or no width."""
    low, high = box
    both = np.isfinite(low) & np.isfinite(high)
    width = np.where(both, high, 0.0) - np.where(both, low, 0.0)
    return np.where(width > 0, width / 2, np.nan)


def magnitude(box: Interval) -> Float[np.ndarray, " n"]:
    """Return the absolute value of the finite end that is farther from 0; 0 where there is none."""
    low, high = (np.where(np.isfinite(end), np.abs(end), 0.0) for end in box)
    return np.maximum(low, high)


def measure_violation(value: Float[np.ndarray, " n"], box: Interval) -> float:
    """Return how far the value that is farthest outside its limits is outside; 0 where all are inside."""
    return float(np.maximum(box.low - value, value - box.high).max(initial=0.0))


def clip_input(
    u: Float[np.ndarray, " nu"], inputs: Interval, rates: Interval | None, last: Float[np.ndarray, " nu"]
) -> Float[np.ndarray, " nu"]:
    """Return the input inside its limits, and as far as they allow within a change inside `rates` from the last."""
    if rates is not None:
        u = np.clip(u, last + rates.low, last + rates.high)
    return np.clip(u, *inputs)


def check_prices(slack: Slack, name: str) -> Slack:
    """Return checked (linear, quadratic), each a float or a vector."""
    if not isinstance(cast(object, slack), tuple | list | np.ndarray) or len(slack) != 2:
        known = ' "auto",' if name != "du_slack" else ""
        raise ShapeError(f"{name} is {slack!r}; pass (linear, quadratic),{known} or None for hard limits")
    linear = checks.array(slack[0], f"the linear weight of {name}", infinite=True)
    quadratic = checks.array(slack[1], f"the quadratic weight of {name}")
    if linear.ndim > 1 or quadratic.ndim > 1:
        raise ShapeError(f"{name} has weights of {linear.ndim} and {quadratic.ndim} dimensions; pass vectors")
    if (linear < 0).any() or (quadratic < 0).any() or not (linear.any() or quadratic.any()):
        raise DataError(f"{name} is {slack}; pass weights (linear, quadratic) ≥ 0, one above zero, or None")
    return (linear if linear.ndim else float(linear)), (quadratic if quadratic.ndim else float(quadratic))
