"""Bounds: what a limit is, a box or a row a step; how soft its rows are; the checks of what a user passes."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import Interval as Interval

BoundByName = Mapping[str, ArrayLike]  # of each signal a number, or one a step


def open_end(end: str) -> float:
    """Return the value of a bound of this name that does not limit."""
    return np.inf if end.endswith("max") else -np.inf


def is_rows(bound: Any) -> bool:
    """Return whether a checked bound, or one of a bound by name, is a row a step."""
    if isinstance(bound, Mapping):
        return any(np.ndim(cast("Any", value)) for value in cast("BoundByName", bound).values())
    return np.ndim(bound) == 2


def list_bound(bound: Any) -> list[Any]:
    """Return the values of a checked bound, those of each name where it is by name."""
    return list(cast("BoundByName", bound).values()) if isinstance(bound, Mapping) else [bound]


def check_bound(bound: Any, end: str) -> Any:
    """Return a bound as a float64 array of at most two dimensions, or as numbers and columns by name."""
    if not isinstance(bound, Mapping):
        value = checks.array(bound, end, infinite=True)
        if value.ndim > 2 or (value.ndim == 2 and not value.size):
            raise ShapeError(f"{end} has shape {value.shape}; pass a scalar, a vector, or rows (steps, n)")
        return value
    named = cast("BoundByName", bound)
    columns = {name: value for name, value in named.items() if np.ndim(value)}
    checked: dict[str, Any] = dict(
        checks.check_named({n: 0.0 if n in columns else v for n, v in named.items()}, end, infinite=True)
    )
    for name, value in columns.items():
        checked[name] = checks.array(value, f"{end}[{name!r}]", (None,), infinite=True)
    lengths = sorted({len(checked[name]) for name in columns})
    if len(lengths) > 1 or 0 in lengths:
        raise ShapeError(f"{end} has columns of {lengths} steps; pass one of the same length for each name")
    return checked


def check_limit(bound: Any, end: str) -> Any:
    """Return a bound as `check_bound` does; DataError where a finite number is beyond 1e100, whose square overflows."""
    checked = check_bound(bound, end)
    for values in list_bound(checked):
        sizes = np.abs(np.asarray(values))
        if ((sizes > checks.LARGEST) & np.isfinite(sizes)).any():
            raise DataError(f"{end} holds a number beyond 1e100; pass ±inf where there is no limit")
    return checked


def order_bound(bound: BoundByName, end: str, names: Sequence[str], omitted: float) -> Float[np.ndarray, "..."]:
    """Return a bound by name as a vector, or as rows (T, n) where a name has one a step."""
    steps = max((len(np.asarray(value)) for value in bound.values() if np.ndim(value)), default=0)
    values = [omitted if value is None else value for value in checks.order_entries(bound, end, names)]
    columns = [np.broadcast_to(np.asarray(value, dtype=np.float64), max(steps, 1)) for value in values]
    rows = np.column_stack(columns) if columns else np.empty((max(steps, 1), 0))
    return rows if steps else rows[0].copy()


def hold_rows(
    bound: ArrayLike | None, end: str, n: int, first: int, count: int, omitted: float
) -> Float[np.ndarray, "count n"]:
    """Return rows first … first + count − 1 of a bound of n signals; a vector is held, as the last row is."""
    rows = np.empty((count, n))
    write_rows(rows, bound, end, first, omitted)
    return rows


def write_rows(to: Float[np.ndarray, "count n"], bound: ArrayLike | None, end: str, first: int, omitted: float) -> None:
    """Write the rows of a bound from row `first` on as `hold_rows` returns them."""
    count, n = to.shape
    if bound is None:
        to[:] = omitted
        return
    value: np.ndarray = cast("Any", bound) if isinstance(bound, np.ndarray) else checks.array(bound, end, infinite=True)
    if value.ndim < 2:
        to[:] = value if value.shape in ((), (n,)) else checks.vector(value, end, n, infinite=True)
        return
    if value.shape[1] not in (1, n):
        raise ShapeError(f"{end} has shape {value.shape}; pass rows of {n}, one value each, or one for all")
    rows = value[first : first + count]
    to[: len(rows)], to[len(rows) :] = rows, value[-1]


def narrow(bound: Float[np.ndarray, " n"]) -> Float[np.ndarray, "..."]:
    """Return a vector of one entry as a scalar, which holds for all signals as the column that it is of does."""
    return bound.reshape(()) if bound.size == 1 else bound


def find_widest(bound: Float[np.ndarray, "T n"], omitted: float) -> Float[np.ndarray, "..."]:
    """Return the widest finite value of each column, `omitted`, which is ±inf, where a column has none."""
    known = np.isfinite(bound)
    widest = np.where(known, bound, -omitted)
    ends = widest.max(axis=0) if omitted > 0 else widest.min(axis=0)
    return narrow(np.where(known.any(axis=0), ends, omitted))


def require_room(low: Any, high: Any, low_name: str, high_name: str, name: str, signals: Sequence[str] = ()) -> None:
    """Raise where no number is between the limits, in any row; `signals` name them, where names are known."""
    lower = np.atleast_1d(-np.inf if low is None else low)
    upper = np.atleast_1d(np.inf if high is None else high)
    steps = max([len(end) for end in (lower, upper) if end.ndim == 2], default=0)
    if not steps:
        if lower.shape != upper.shape and 1 not in (lower.size, upper.size):
            raise ShapeError(
                f"{low_name} has shape {lower.shape} and {high_name} {upper.shape}; pass one limit a row, or scalars"
            )
        a, b = np.broadcast_arrays(lower, upper)
        checks.refuse_crossed(a, b, name, signals)
    else:
        widths = {end.shape[-1] for end in (lower, upper)} - {1}
        if len(widths) > 1:
            raise ShapeError(f"{low_name} has shape {lower.shape} and {high_name} {upper.shape}; pass rows as wide")
        width = max(widths, default=1)
        lower, upper = (end.reshape(()) if end.shape == (1,) else end for end in (lower, upper))
        a = hold_rows(lower, low_name, width, 0, steps, -np.inf)
        b = hold_rows(upper, high_name, width, 0, steps, np.inf)
        refuse_crossed_rows(a, b, name, signals)
    if (lower == np.inf).any() or (upper == -np.inf).any():
        raise DataError(f"{low_name} is +inf or {high_name} is −inf somewhere; use −inf, +inf where there is no limit")


def refuse_crossed_rows(
    low: Float[np.ndarray, "T n"],
    high: Float[np.ndarray, "T n"],
    name: str,
    signals: Sequence[str] = (),
    first: int = 0,
    why: str = "",
) -> None:
    """Raise where a lower limit is above its upper one, and name the signal and the step; row 0 is step `first`."""
    crossed = low > high
    if crossed.any():
        k, i = (int(v) for v in np.argwhere(crossed)[0])
        signal = signals[i] if signals else f"index {i}"
        raise DataError(
            f"{name} limits cross for {signal} at step {first + k}: lower {low[k, i]:g} is above upper "
            f"{high[k, i]:g}{why}; swap or widen them"
        )


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


def spread_prices(
    slack: Slack | None, name: str, n: int, what: str
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the linear and quadratic price of n rows."""
    if slack is None:
        return np.full(n, np.inf), np.zeros(n)
    parts = [checks.array(weight, name, infinite=True) for weight in slack]
    for part in parts:
        if part.ndim and part.shape != (n,):
            raise ShapeError(f"{name} has a weight of shape {part.shape}, expected ({n},), {what}, or a scalar")
    linear, quadratic = (np.broadcast_to(part, (n,)).copy() for part in parts)
    free = np.flatnonzero(linear + quadratic == 0)
    if free.size:
        raise DataError(
            f"{name} has both weights zero at index {int(free[0])}; give one above zero, or remove the limit"
        )
    return linear, quadratic
