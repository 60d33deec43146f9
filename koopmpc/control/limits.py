"""Limits: the inequalities that every controller and every metric shares."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.terminal.sets import HasTerminalSet, TerminalSet, read_terminal_set
from koopmpc.errors import DataError, ShapeError
from koopmpc.lifting.base import Lifting, strip_unit
from koopmpc.values import Value

SOFTENED = 1e-4  # a slack above this share of the size of its limit is reported
LINEAR = 1e4  # default linear weight of a slack as a share of its limit's size, times the scale of the cost
QUADRATIC = 1e2  # the quadratic weight, in the same unit
TIGHTEST = 0.2  # share of the range by which a limit is tightened at most
_AHEAD = 5  # steps of an error band that tighten limits
Slack = tuple[ArrayLike, ArrayLike]
Bound = ArrayLike | checks.ByName | None  # of a limit, as a user writes it


_ENDS = (
    ("u_min", "u_max", "input"),
    ("du_min", "du_max", "rate"),
    ("x_min", "x_max", "state"),
    ("y_min", "y_max", "output"),
)  # fields of the lower and the upper limit, and what they limit


class Interval(NamedTuple):
    """low ≤ v ≤ high, entry by entry; ±inf where there is no limit."""

    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]


class Softness(NamedTuple):
    """linear ε + quadratic ε² is what a row's violation ε costs; linear = inf is a hard row.

    A violation above its `allowance`, 1e-4 of the limit's size, is reported.
    """

    linear: Float[np.ndarray, " n"]
    quadratic: Float[np.ndarray, " n"]
    allowance: Float[np.ndarray, " n"]


class LimitRows(NamedTuple):
    """The limited outputs [x; y] that have a limit: which they are, their limits, how soft each is, and its margins."""

    kept: Bool[np.ndarray, " n"]
    box: Interval
    softness: Softness
    margin: Float[np.ndarray, "K n"]


class SizedLimits(NamedTuple):
    """Limits in the sizes of a model: of its inputs, of their changes, and of the limited outputs [x; y] in `rows`.

    `rates` is None where nothing limits the changes. `hard_rates` are the rate limits that are hard, with ±inf in place
    of the others; None where none is.
    """

    inputs: Interval
    rates: Interval | None
    hard_rates: Interval | None
    rate_softness: Softness
    rows: LimitRows


@dataclass(frozen=True, eq=False)
class Limits(Value):
    """u_min ≤ u_k ≤ u_max and du_min ≤ u_k − u_{k−1} ≤ du_max, x_min ≤ x_k ≤ x_max and y_min ≤ of(x_k) ≤ y_max.

    Inputs (k = 0 … N−1) are always inside their limits. If no change inside its limits leads there from the last input,
    the limits of the inputs win, and the status says SOFTENED. States and outputs (k = 1 … N) are soft by default.

    Parameters
    ----------
    u_min, u_max, x_min, x_max, y_min, y_max
        Scalars or vectors; None or ±inf where there is no limit. Or by name, ``{"torque": 25}``, with or without the
        unit; an omitted name has no limit. The names are looked up when a controller is built.
    of
        Observables of the state that y_min and y_max limit. A controller on a lifted predictor finds them in its
        own lifting by name.
    slack
        (linear, quadratic) weight of the violation ε of state and output limits: linear ε + quadratic ε². A linear
        weight above the largest dual keeps a limit exactly wherever that is possible. Each is a scalar, or has an
        entry for every state where there are x limits, and then for every observable of `of`; a linear weight of
        inf makes its row hard, None makes all hard. "auto", the default, weighs ε/size by (1e4, 1e2) times the scale
        of the cost, so that units mean nothing; see `Sizes` for both.
    du_min, du_max
        Limits of the change of the inputs in one step; du_min is −du_max by default.
    du_slack
        (linear, quadratic) as in `slack`, a scalar or an entry an input; None, the default, keeps rates hard.
    margin
        (K, nx), by how much controllers move both limits of each state inwards: at step k of the horizon by row
        min(k, K). Metrics count from the limits themselves. `tightened` makes it of a model's errors.
    capped
        A sentence for each state for which `tightened` made less margin than the errors ask for.
    terminal
        Where predictive controllers end their plans: a Certificate, or a `TerminalSet` such as
        `km.guarantees.find_terminal_set` makes.
    terminal_slack
        (linear, quadratic) weight of leaving the terminal set by the share ε of its size; "auto" as in `slack`; None
        makes the set hard.

    Raises
    ------
    DataError
        Crossed limits; rate limits without zero between them; y limits without `of`; a negative slack weight; a
        negative margin, or one that makes limits cross.

    Examples
    --------
    >>> import koopmpc as km
    >>> limits = km.Limits(u_min=-25, u_max=25, x_min=[-1.2, -4], x_max=[1.2, 4])  # inputs hard, states soft
    >>> hard = km.Limits(u_min=-25, u_max=25, du_max=8, x_max=[1.2, 4], slack=None)
    """

    u_min: ArrayLike | checks.ByName | None = None
    u_max: ArrayLike | checks.ByName | None = None
    x_min: ArrayLike | checks.ByName | None = None
    x_max: ArrayLike | checks.ByName | None = None
    of: Lifting | None = None
    y_min: ArrayLike | checks.ByName | None = None
    y_max: ArrayLike | checks.ByName | None = None
    slack: Slack | Literal["auto"] | None = "auto"
    du_min: ArrayLike | checks.ByName | None = None
    du_max: ArrayLike | checks.ByName | None = None
    du_slack: Slack | None = None
    margin: ArrayLike | None = None
    capped: tuple[str, ...] = ()
    terminal: "TerminalSet | HasTerminalSet | None" = None
    terminal_slack: "Slack | Literal['auto'] | None" = "auto"

    def __post_init__(self) -> None:
        if self.terminal is not None:
            object.__setattr__(self, "terminal", read_terminal_set(self.terminal))
        for low, high, name in _ENDS:
            for end in (low, high):
                value = getattr(self, end)
                if isinstance(value, Mapping):
                    object.__setattr__(self, end, checks.check_named(value, end, infinite=True))
                elif value is not None:
                    object.__setattr__(self, end, checks.array(value, end, infinite=True))
            if not any(isinstance(getattr(self, end), Mapping) for end in (low, high)):
                _require_room(getattr(self, low), getattr(self, high), low, high, name)
        if (self.y_min is not None or self.y_max is not None) and self.of is None:
            raise DataError("y_min and y_max limit observables; say which with of=, for example of=km.Fourier(1)")
        if self.of is not None:
            checks.kind(self.of, "of", Lifting, 'for example km.Fourier(1, states="theta")')
        for end, sign in (("du_min", 1.0), ("du_max", -1.0)):
            value = getattr(self, end)
            if value is not None and (sign * np.array(checks.list_values(value)) > 0).any():
                raise DataError(f"{end} is {value}; an input must be free to stay, so keep 0 inside its rates")
        for name in ("slack", "du_slack", "terminal_slack"):
            value = getattr(self, name)
            if value is not None and not (name != "du_slack" and isinstance(value, str) and value == "auto"):
                object.__setattr__(self, name, _weights(cast("Slack", value), name))
        if self.margin is not None:
            object.__setattr__(self, "margin", self._margin(checks.array(self.margin, "margin", (None, None))))

    def resolve(self, states: Sequence[str], inputs: Sequence[str]) -> "Limits":
        """Return the limits with arrays in place of limits by name; an omitted name has no limit.

        Raises
        ------
        DataError
            A name is unknown or fits two, or limits cross.
        """
        named = [end for pair in _ENDS for end in pair[:2] if isinstance(getattr(self, end), Mapping)]
        if not named:
            return self
        outputs = () if self.of is None else self.of.bind(tuple(states)).names
        known = {"u": inputs, "d": inputs, "x": states, "y": outputs}
        return replace(
            self,
            **{
                end: checks.order_by_name(
                    getattr(self, end), end, known[end[0]], np.inf if end.endswith("max") else -np.inf
                )
                for end in named
            },
        )

    def _margin(self, margin: Float[np.ndarray, "K nx"]) -> Float[np.ndarray, "K nx"]:
        if (margin < 0).any() or not len(margin):
            raise DataError(f"margin is {margin.tolist()}; pass rows of numbers of 0 or above, one a step")
        low, high = self.states(margin.shape[1])
        most = margin.max(axis=0)
        crossed = np.flatnonzero(low + most > high - most)
        if crossed.size:
            i = crossed[0]
            raise DataError(
                f"the limits of state {i} cross once tightened: {low[i]:g} … {high[i]:g} with a margin of {most[i]:g}; "
                "pass a smaller margin, or a wider range"
            )
        return margin

    def tightened(self, band: ArrayLike, most: float = TIGHTEST, *, states: Sequence[str] = ()) -> "Limits":
        """Return the limits with margins: at step k of the horizon by the error band of min(k, 5) steps.

        A margin is at most `most` of the range between the two limits of its state, and `capped` of the result says
        where that was less than the errors ask for. Where a state has one limit alone there is no range, and nothing
        is capped. Observables `of` keep their limits.

        Parameters
        ----------
        band
            (h, nx) half-widths of the error of a forecast 1 … h steps ahead, in the state's unit, such as the `width`
            of a `km.validate.conformal` band. Rows beyond the fifth are not read: an error further ahead is met by
            the steps before it, which a controller chooses anew.
        most
            Share of the range, below a half.
        states
            Names for what `capped` says; without them it counts the states from 0.

        Raises
        ------
        DataError
            A band that is negative, NaN, or infinite where nothing caps it; a share that makes limits cross.
        """
        rows = checks.array(band, "band", infinite=True)[:_AHEAD]
        if rows.ndim != 2:
            raise ShapeError(f"band has shape {rows.shape}; pass (h, nx), a row for each of 1 … h steps ahead")
        share = checks.positive(most, "most")
        if share >= 0.5:
            raise DataError(f"most is {share:g}; limits cross once tightened by half of their range: pass less")
        low, high = self.states(rows.shape[1])
        limited = np.isfinite(low) | np.isfinite(high)
        rows = np.where(limited, rows, 0.0)
        cap = share * (high - low)
        capped = rows > cap
        said: list[str] = []
        for i in np.flatnonzero(capped.any(axis=0)).tolist():
            first = int(capped[:, i].argmax())
            name = strip_unit(states[i]) if len(states) == len(cap) else f"state {i}"
            said.append(
                f"{name}: from step {first + 1} on the margin is {cap[i]:.4g}, {100 * share:.3g} % of the range, "
                f"though the errors ask for up to {rows[:, i].max():.4g}"
            )
        rows = np.minimum(rows, cap)
        if not np.isfinite(rows).all():
            raise DataError("band is infinite for a state with one limit alone; pass a finite band")
        return replace(self, margin=rows, capped=tuple(said))

    def end_softness(self, count: int, scale: float = 1.0) -> Softness:
        """Return how soft the `count` rows of the terminal set are, of which 1 is the size of the set."""
        if isinstance(self.terminal_slack, str):
            linear, quadratic = np.full(count, LINEAR * scale), np.full(count, QUADRATIC * scale)
        else:
            linear, quadratic = _prices(self.terminal_slack, "terminal_slack", count, "one a row of the terminal set")
        return Softness(linear, quadratic, np.full(count, SOFTENED))

    def inputs(self, nu: int) -> Interval:
        """Return the box of the inputs."""
        return _box(self.u_min, self.u_max, "u_min", "u_max", nu)

    def rates(self, nu: int) -> Interval | None:
        """Return the box of u_k − u_{k−1}; None where nothing limits it."""
        box = self._rates(nu)
        return box if (np.isfinite(box.low) | np.isfinite(box.high)).any() else None

    def _rates(self, nu: int) -> Interval:
        low = (
            -checks.array(self.du_max, "du_max", infinite=True)
            if self.du_min is None and self.du_max is not None
            else self.du_min
        )
        return _box(low, self.du_max, "du_min", "du_max", nu)

    def rate_softness(self, nu: int) -> Softness:
        """Return how soft the rate limits of each input are."""
        linear, quadratic = _prices(self.du_slack, "du_slack", nu, "one an input")
        box = self._rates(nu)
        size = np.where(np.isnan(half_width(box)), magnitude(box), half_width(box))
        return Softness(linear, quadratic, SOFTENED * np.where(size > 0, size, 1.0))

    def find_sizes(self, nx: int, ny: int, nu: int, sizes: Float[np.ndarray, " n"], scale: float) -> SizedLimits:
        """Return all limits of a model with `nx` states, `ny` observables `of` (0 without one) and `nu` inputs.

        `sizes` are those of [x; of(x)], `scale` that of the cost, see `Sizes`.
        """
        rows, rates, rate_softness = self.rows(nx, ny, sizes, scale), self.rates(nu), self.rate_softness(nu)
        hard = np.isinf(rate_softness.linear)
        hard_rates = None
        if rates is not None and hard.any():
            hard_rates = Interval(np.where(hard, rates.low, -np.inf), np.where(hard, rates.high, np.inf))
        return SizedLimits(self.inputs(nu), rates, hard_rates, rate_softness, rows)

    def states(self, nx: int) -> Interval:
        """Return the box of the states."""
        return _box(self.x_min, self.x_max, "x_min", "x_max", nx)

    def outputs(self, ny: int) -> Interval:
        """Return the box of the observables `of`."""
        return _box(self.y_min, self.y_max, "y_min", "y_max", ny)

    def rows(self, nx: int, ny: int, sizes: Float[np.ndarray, " n"] | None = None, scale: float = 1.0) -> LimitRows:
        """Return the limits of [x; of(x)], the rows that have one; ny is 0 without `of`, `sizes` are 1 if None."""
        low, high = self.ends(nx, ny)
        size = np.ones(nx + ny) if sizes is None else sizes
        linear, quadratic = np.full(nx + ny, np.inf), np.zeros(nx + ny)
        if isinstance(self.slack, str):
            linear, quadratic = LINEAR * scale / size, QUADRATIC * scale / size**2
        else:
            mine = np.repeat([_is_set(self.x_min, self.x_max), _is_set(self.y_min, self.y_max)], [nx, ny])
            given = _prices(self.slack, "slack", int(mine.sum()), "one a state, then one an output")
            linear[mine], quadratic[mine] = given
        kept = np.isfinite(low) | np.isfinite(high)
        softness = Softness(linear[kept], quadratic[kept], SOFTENED * size[kept])
        margin = np.zeros((1, nx + ny))
        if self.margin is not None:
            given_margin = checks.array(self.margin, "margin", (None, nx))
            margin = np.hstack([given_margin, np.zeros((len(given_margin), ny))])
        return LimitRows(kept, Interval(low[kept], high[kept]), softness, margin[:, kept])

    def ends(self, nx: int, ny: int) -> Interval:
        """Return the box of [x; of(x)]; ny is 0 without `of`."""
        outputs = self.outputs(ny) if ny else Interval(np.zeros(0), np.zeros(0))
        return Interval(*(np.concatenate(each) for each in zip(self.states(nx), outputs, strict=True)))


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


def _is_set(low: Bound, high: Bound) -> bool:
    return low is not None or high is not None


def _weights(slack: Slack, name: str) -> Slack:
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


def _prices(
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


def _require_room(
    low: Float[np.ndarray, "..."] | None,
    high: Float[np.ndarray, "..."] | None,
    low_name: str,
    high_name: str,
    name: str,
) -> None:
    """Raise where no number is between the limits."""
    lower, upper = (
        np.atleast_1d(-np.inf if low is None else low),
        np.atleast_1d(np.inf if high is None else high),
    )
    if lower.shape != upper.shape and 1 not in (lower.size, upper.size):
        raise ShapeError(
            f"{low_name} has shape {lower.shape} and {high_name} {upper.shape}; pass one limit a row, or scalars"
        )
    a, b = np.broadcast_arrays(lower, upper)
    checks.refuse_crossed(a, b, name)
    if (lower == np.inf).any() or (upper == -np.inf).any():
        raise DataError(f"{low_name} is +inf or {high_name} is −inf somewhere; use −inf, +inf where there is no limit")


def _box(low: Bound, high: Bound, low_name: str, high_name: str, n: int) -> Interval:
    return Interval(
        checks.vector(-np.inf if low is None else low, low_name, n, infinite=True),
        checks.vector(np.inf if high is None else high, high_name, n, infinite=True),
    )
