"""Limits: the inequalities that every controller and every metric shares."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import Value
from koopmpc.control.ask import bounds
from koopmpc.control.ask.bounds import SOFTENED as SOFTENED
from koopmpc.control.ask.bounds import Bound as Bound
from koopmpc.control.ask.bounds import Interval as Interval
from koopmpc.control.ask.bounds import LimitRows as LimitRows
from koopmpc.control.ask.bounds import Movable as Movable
from koopmpc.control.ask.bounds import SizedLimits as SizedLimits
from koopmpc.control.ask.bounds import Slack as Slack
from koopmpc.control.ask.bounds import Softness as Softness
from koopmpc.control.ask.bounds import check_prices, is_finite, write_rows
from koopmpc.control.ask.bounds import clip_input as clip_input
from koopmpc.control.ask.bounds import half_width as half_width
from koopmpc.control.ask.bounds import magnitude as magnitude
from koopmpc.control.ask.bounds import measure_violation as measure_violation
from koopmpc.control.ask.bounds import preview_margin as preview_margin
from koopmpc.control.ask.levels import (
    DwellByInput,
    InputLevels,
    LevelsByInput,
    build_levels,
    check_dwell,
    check_levels,
)
from koopmpc.control.ask.terminal import HasTerminalSet, TerminalSet, read_terminal_set
from koopmpc.lifting.base import Lifting, strip_unit

LINEAR = 1e4  # default linear weight of a slack as a share of its limit's size, times the scale of the cost
QUADRATIC = 1e2  # the quadratic weight, in the same unit
TIGHTEST = 0.2  # share of the range by which a limit is tightened at most
_AHEAD = 5  # steps of an error band that tighten limits

_ENDS = (
    ("u_min", "u_max", "input"),
    ("du_min", "du_max", "rate"),
    ("x_min", "x_max", "state"),
    ("y_min", "y_max", "output"),
)  # fields of the lower and the upper limit, and what they limit


BOUNDS = tuple(end for pair in _ENDS for end in pair[:2])
"""Names of the bounds of `Limits`."""


@dataclass(frozen=True, eq=False)
class Limits(Value):
    """u_min ≤ u_k ≤ u_max and du_min ≤ u_k − u_{k−1} ≤ du_max, x_min ≤ x_k ≤ x_max and y_min ≤ of(x_k) ≤ y_max.

    Inputs (k = 0 … N−1) are always inside their limits. If no change inside its limits leads there from the last input,
    the limits of the inputs win, and the status says SOFTENED. States and outputs (k = 1 … N) are soft by default.

    Parameters
    ----------
    u_min, u_max, x_min, x_max, y_min, y_max
        Scalars or vectors; None or ±inf where there is no limit. Or by name, ``{"torque": 25}``, with or without the
        unit; an omitted name has no limit. The names are looked up when a controller is built. Or limits in time: rows
        (T, n), by name a value a step. Row k is that of u_k, u_k − u_{k−1}, x_k and y_k; the last one is held.
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
    levels
        On/off and stepped inputs: ``{"pump": [0, 1]}``, or an entry for each input, None for a continuous one. Two
        levels, or evenly spaced ones, from the lowest to the highest. Plans and fallbacks are on these levels.
    dwell
        Steps that an input stays at a level once it went there: ``{"pump": (3, 5)}``, at least 3 on and 5 off; one
        number for inputs of more levels. The lowest level is off.
    level_steps
        Steps of the horizon in which levels and dwell times count; later inputs may be between them. None for all.
    priority
        Which soft limits are kept longest, ``{"pressure": 2, "level": 1}``, or an entry for every state and then for
        every observable of `of`; others have 0. A limit gives way only as far as no limit of a lower priority can
        spare it that, whatever the weights are. In BilinearMPC and NonlinearMPC, beside `levels`, and in C a limit
        weighs 1,000 times one of the priority below instead, for at most 3 different priorities.
    rows
        Bounds that limit nothing now, and that a step may bring, such as ``("x_max",)``; see `with_bounds`.

    Raises
    ------
    DataError
        Crossed limits; rate limits without zero between them; y limits without `of`; a negative slack weight; a
        negative margin, or one that makes limits cross; levels that are not evenly spaced, outside the input's
        limits, or farther apart than du_max.

    Examples
    --------
    >>> import koopmpc as km
    >>> limits = km.Limits(u_min=-25, u_max=25, x_min=[-1.2, -4], x_max=[1.2, 4])  # inputs hard, states soft
    >>> hard = km.Limits(u_min=-25, u_max=25, du_max=8, x_max=[1.2, 4], slack=None)
    """

    u_min: "Bound" = None
    u_max: "Bound" = None
    x_min: "Bound" = None
    x_max: "Bound" = None
    of: Lifting | None = None
    y_min: "Bound" = None
    y_max: "Bound" = None
    slack: Slack | Literal["auto"] | None = "auto"
    du_min: "Bound" = None
    du_max: "Bound" = None
    du_slack: Slack | None = None
    margin: ArrayLike | None = None
    capped: tuple[str, ...] = ()
    terminal: "TerminalSet | HasTerminalSet | None" = None
    terminal_slack: "Slack | Literal['auto'] | None" = "auto"
    levels: LevelsByInput | None = None
    dwell: DwellByInput | None = None
    level_steps: int | None = None
    rows: tuple[str, ...] = ()
    priority: "Mapping[str, int] | ArrayLike | None" = None

    def __post_init__(self) -> None:
        if self.terminal is not None:
            object.__setattr__(self, "terminal", read_terminal_set(self.terminal))
        self._check_ends(BOUNDS)
        if not all(checks.among(name, BOUNDS) for name in checks.texts(self.rows, "rows")):
            raise DataError(f"rows is {self.rows!r}; pass a tuple of {', '.join(BOUNDS)}")
        object.__setattr__(self, "rows", tuple(self.rows))
        if self.of is not None:
            checks.kind(self.of, "of", Lifting, 'for example km.Fourier(1, states="theta")')
        for name in ("slack", "du_slack", "terminal_slack"):
            value = getattr(self, name)
            if value is not None and not (name != "du_slack" and isinstance(value, str) and value == "auto"):
                object.__setattr__(self, name, check_prices(cast("Slack", value), name))
        if self.margin is not None:
            object.__setattr__(self, "margin", self._margin(checks.array(self.margin, "margin", (None, None))))
        if self.priority is not None and not isinstance(self.priority, Mapping):
            object.__setattr__(self, "priority", checks.array(self.priority, "priority", (None,)))
        self._check_levels()

    def _check_ends(self, ends: Sequence[str]) -> None:
        """Check these bounds, each against the other end of its pair."""
        for end in ends:
            value = getattr(self, end)
            if value is not None:
                object.__setattr__(self, end, bounds.check_limit(value, end))
        for low, high, name in _ENDS:
            pair = getattr(self, low), getattr(self, high)
            if (low in ends or high in ends) and not any(isinstance(value, Mapping) for value in pair):
                bounds.require_room(*pair, low, high, name)
        if (self.y_min is not None or self.y_max is not None) and self.of is None:
            raise DataError("y_min and y_max limit observables; say which with of=, for example of=km.Fourier(1)")
        for end, sign in (("du_min", 1.0), ("du_max", -1.0)):
            value = getattr(self, end) if end in ends else None
            if value is not None and any((sign * np.asarray(v) > 0).any() for v in bounds.list_bound(value)):
                raise DataError(f"{end} is {value}; an input must be free to stay, so keep 0 inside its rates")

    def _check_levels(self) -> None:
        """Check the levels, their dwell times, and the steps in which they count."""
        if self.levels is None:
            if self.dwell is not None or self.level_steps is not None:
                raise DataError("dwell and level_steps are of inputs on levels; pass levels, or leave them out")
            return
        object.__setattr__(self, "levels", check_levels(self.levels))
        if self.dwell is not None:
            object.__setattr__(self, "dwell", check_dwell(self.dwell))
        if self.level_steps is not None:
            object.__setattr__(self, "level_steps", checks.count(self.level_steps, "level_steps"))

    def resolve(self, states: Sequence[str], inputs: Sequence[str]) -> "Limits":
        """Return the limits with arrays in place of limits by name; an omitted name has no limit.

        Raises
        ------
        DataError
            A name is unknown or fits two, or limits cross.
        """
        named = [end for pair in _ENDS for end in pair[:2] if isinstance(getattr(self, end), Mapping)]
        entries = {
            field: tuple(checks.order_entries(getattr(self, field), field, inputs))
            for field in ("levels", "dwell")
            if isinstance(getattr(self, field), Mapping)
        }
        if not named and not entries:
            return self
        outputs = () if self.of is None else self.of.bind(tuple(states)).names
        known = {"u": inputs, "d": inputs, "x": states, "y": outputs}
        ordered = {end: bounds.order_bound(getattr(self, end), end, known[end[0]], _free(end)) for end in named}
        for low, high, name in _ENDS:
            if low in ordered or high in ordered:
                lower, upper = (ordered.get(end, getattr(self, end)) for end in (low, high))
                bounds.require_room(lower, upper, low, high, name, known[low[0]])
        return replace(self, **ordered, **entries)

    @property
    def in_time(self) -> bool:
        """Whether a bound has a row for each step."""
        return any(bounds.is_rows(getattr(self, end)) for end in BOUNDS)

    @property
    def base(self) -> "Limits":
        """The same limits without rows: of each bound its widest finite value, by which sizes and slacks count."""
        ends = {end: getattr(self, end) for end in BOUNDS}
        rows = {end: bounds.find_widest(value, _free(end)) for end, value in ends.items() if np.ndim(value) == 2}
        return replace(self, **rows) if rows else self

    def with_bounds(self, **ends: Bound) -> "Limits":
        """Return the limits with other bounds, scalars, vectors or rows; all else stays, and bounds that are not named.

        Raises
        ------
        DataError
            A name is that of no bound; limits cross.
        """
        unknown = [name for name in ends if name not in BOUNDS]
        if unknown:
            raise DataError(f"Limits has no bound {unknown[0]}; it has {', '.join(BOUNDS)}")
        other = copy(self)
        for end, value in ends.items():
            object.__setattr__(other, end, value)
        other._check_ends(tuple(ends))
        if self.margin is not None and ("x_min" in ends or "x_max" in ends):
            other._margin(cast("Float[np.ndarray, 'K nx']", self.margin))
        return other

    def at(self, step: int) -> "Limits":
        """Return the limits of one step, without rows; past their end the last row holds."""
        k, ends = checks.count(step, "step", 0), {end: getattr(self, end) for end in BOUNDS}
        rows = {end: bounds.narrow(value[min(k, len(value) - 1)]) for end, value in ends.items() if np.ndim(value) == 2}
        return replace(self, **rows) if rows else self

    def count_rows(self) -> dict[str, int]:
        """Return the number of rows of each bound that has some."""
        given: list[tuple[str, Any]] = [(end, getattr(self, end)) for end in BOUNDS]
        return {end: len(value) for end, value in given if type(value) is np.ndarray and value.ndim == 2}

    def input_rows(self, nu: int, first: int, count: int) -> Interval:
        """Return the boxes (count, nu) of the inputs u_first …, from level to level where they have some."""
        box = np.empty((2, count, nu))
        self.write_rows("u", box, first)
        return Interval(*box)

    def rate_rows(self, nu: int, first: int, count: int) -> Interval:
        """Return the boxes (count, nu) of u_k − u_{k−1} from k = first on; the last row is held."""
        box = np.empty((2, count, nu))
        self.write_rows("du", box, first)
        return Interval(*box)

    def output_rows(self, nx: int, ny: int, first: int, count: int) -> Interval:
        """Return the boxes (count, nx + ny) of [x_k; of(x_k)] from k = first on; ny is 0 without `of`."""
        box = np.empty((2, count, nx + ny))
        self.write_rows("x", box[:, :, :nx], first)
        if ny:
            self.write_rows("y", box[:, :, nx:], first)
        return Interval(*box)

    def write_rows(self, what: Literal["u", "du", "x", "y"], to: Float[np.ndarray, "2 count n"], first: int) -> None:
        """Write the lower and the upper limits of u, Δu, x or y from step `first` on; the last row is held."""
        for rows, end, omitted in ((to[0], f"{what}_min", -np.inf), (to[1], f"{what}_max", np.inf)):
            write_rows(rows, getattr(self, end), end, first, omitted)
        if what == "du" and self.du_min is None and self.du_max is not None:
            np.negative(to[1], out=to[0])
        levels = None if what != "u" or self.levels is None else self.base.input_levels(to.shape[2])
        if levels is not None:
            inside = levels.inside(Interval(*to))
            for end, index in zip(to, inside, strict=True):
                end[:, levels.which] = np.where(inside.low <= inside.high, levels.values(index), end[:, levels.which])

    def _declares(self, what: str) -> bool:
        return f"{what}_min" in self.rows or f"{what}_max" in self.rows

    def movable(self, nx: int, ny: int, nu: int) -> "Movable":
        """Return which inputs, rates and outputs [x; of(x)] have a row: those with a finite or a declared bound."""
        base = self.base
        inputs = is_finite(base.inputs(nu)) | self._declares("u")
        return Movable(inputs, is_finite(base._rates(nu)) | self._declares("du"), base.find_rows(nx, ny).kept)

    def _margin(self, margin: Float[np.ndarray, "K nx"]) -> Float[np.ndarray, "K nx"]:
        if (margin < 0).any() or not len(margin):
            raise DataError(f"margin is {margin.tolist()}; pass rows of numbers of 0 or above, one a step")
        low, high = self.base.states(margin.shape[1])
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
            linear, quadratic = _spread_prices(
                self.terminal_slack, "terminal_slack", count, "one a row of the terminal set"
            )
        return Softness(linear, quadratic, np.full(count, SOFTENED))

    def inputs(self, nu: int) -> Interval:
        """Return the box of the inputs; that of an input on levels is from its lowest to its highest one."""
        box = _box(self.u_min, self.u_max, "u_min", "u_max", nu)
        if self.levels is not None and not isinstance(self.levels, Mapping):
            at = self.input_levels(nu)
            if at is not None:
                box.low[at.which], box.high[at.which] = at.first, at.values(at.count - 1)
        return box

    def input_levels(self, nu: int) -> InputLevels | None:
        """Return the levels of nu inputs that are between their limits; None where none has any.

        Raises
        ------
        DataError
            No level is between the limits of its input, or two are farther apart than du_max.
        """
        if self.levels is None or isinstance(self.levels, Mapping):
            return None
        dwell = None if self.dwell is None or isinstance(self.dwell, Mapping) else self.dwell
        hard = self._rates(nu) if self.du_slack is None else None
        box = _box(self.u_min, self.u_max, "u_min", "u_max", nu)
        return build_levels(self.levels, dwell, self.level_steps, *box, hard)

    def rates(self, nu: int) -> Interval | None:
        """Return the box of u_k − u_{k−1}; None where nothing limits it."""
        box = self._rates(nu)
        return box if self._declares("du") or is_finite(box).any() else None

    def _rates(self, nu: int) -> Interval:
        low = (
            -checks.array(cast("ArrayLike", self.du_max), "du_max", infinite=True)
            if self.du_min is None and self.du_max is not None
            else self.du_min
        )
        return _box(low, self.du_max, "du_min", "du_max", nu)

    def rate_softness(self, nu: int) -> Softness:
        """Return how soft the rate limits of each input are."""
        linear, quadratic = _spread_prices(self.du_slack, "du_slack", nu, "one an input")
        box = self._rates(nu)
        size = np.where(np.isnan(half_width(box)), magnitude(box), half_width(box))
        return Softness(linear, quadratic, SOFTENED * np.where(size > 0, size, 1.0))

    def find_sizes(self, nx: int, ny: int, nu: int, sizes: Float[np.ndarray, " n"], scale: float) -> SizedLimits:
        """Return all limits of a model with `nx` states, `ny` observables `of` (0 without one) and `nu` inputs.

        `sizes` are those of [x; of(x)], `scale` that of the cost, see `Sizes`.
        """
        rows, rates, rate_softness = self.find_rows(nx, ny, sizes, scale), self.rates(nu), self.rate_softness(nu)
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

    def find_rows(
        self, nx: int, ny: int, sizes: Float[np.ndarray, " n"] | None = None, scale: float = 1.0
    ) -> LimitRows:
        """Return the limits of [x; of(x)], the rows that have one; ny is 0 without `of`, `sizes` are 1 if None."""
        low, high = self.ends(nx, ny)
        size = np.ones(nx + ny) if sizes is None else sizes
        linear, quadratic = np.full(nx + ny, np.inf), np.zeros(nx + ny)
        if isinstance(self.slack, str):
            linear, quadratic = LINEAR * scale / size, QUADRATIC * scale / size**2
        else:
            x, y = self._declares("x"), self._declares("y")
            mine = np.repeat([x or _is_set(self.x_min, self.x_max), y or _is_set(self.y_min, self.y_max)], [nx, ny])
            given = _spread_prices(self.slack, "slack", int(mine.sum()), "one a state, then one an output")
            linear[mine], quadratic[mine] = given
        kept = is_finite(Interval(low, high)) | np.repeat([self._declares("x"), self._declares("y")], [nx, ny])
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


def refuse_priority(limits: Limits | None, who: str) -> None:
    """Raise where soft limits have priorities, for a choice that compares controllers by weights alone.

    Raises
    ------
    DataError
        The limits have priorities.
    """
    if limits is not None and limits.priority is not None:
        raise DataError(
            f"the limits have a priority, which {who} does not know; weigh the limits with slack=, and make the"
            " controller anew with the priority"
        )


def refuse_levels(limits: Limits | None, who: str) -> None:
    """Raise where inputs are on levels, for a law that does not search over them.

    Raises
    ------
    DataError
        The limits have levels.
    """
    if limits is not None and limits.levels is not None:
        raise DataError(
            f"the limits have levels={limits.levels}, which {who} does not keep;"
            " take a KoopmanMPC, a LinearMPC, a BilinearMPC or a NonlinearMPC, or pass limits without levels"
        )


def _free(end: str) -> float:
    """Return the value of a bound that does not limit."""
    return np.inf if end.endswith("max") else -np.inf


def _is_set(low: Bound, high: Bound) -> bool:
    return low is not None or high is not None


def _spread_prices(
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


def _box(low: Bound, high: Bound, low_name: str, high_name: str, n: int) -> Interval:
    for end, name in ((low, low_name), (high, high_name)):
        if np.ndim(cast("Any", end)) == 2:
            raise DataError(f"{name} has a row for each step, and one set of limits is read here; pass limits.at(step)")
    return Interval(
        checks.vector(-np.inf if low is None else cast("ArrayLike", low), low_name, n, infinite=True),
        checks.vector(np.inf if high is None else cast("ArrayLike", high), high_name, n, infinite=True),
    )
