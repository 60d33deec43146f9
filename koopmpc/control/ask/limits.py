"""Limits: the inequalities that every controller and every metric shares."""

from collections.abc import Collection, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import Value
from koopmpc.control.ask import bounds
from koopmpc.control.ask.bounds import SOFTENED as SOFTENED
from koopmpc.control.ask.bounds import Bound, LimitRows, Slack, spread_prices, write_rows
from koopmpc.control.ask.bounds import Interval as Interval
from koopmpc.control.ask.bounds import Movable as Movable
from koopmpc.control.ask.bounds import Softness as Softness
from koopmpc.control.ask.bounds import half_width as half_width
from koopmpc.control.ask.bounds import magnitude as magnitude
from koopmpc.control.ask.bounds import preview_margin as preview_margin
from koopmpc.control.ask.checks import BOUNDS as BOUNDS
from koopmpc.control.ask.checks import ENDS, LIMIT_CHECKS, REFUSALS, refuse_crossed_limits, refuse_margin
from koopmpc.control.ask.levels import DwellByInput, InputLevels, LevelsByInput, build_levels
from koopmpc.control.ask.terminal import HasTerminalSet, TerminalSet
from koopmpc.lifting.base import Lifting, strip_unit

LINEAR = 1e4  # default linear weight of a slack as a share of its limit's size, times the scale of the cost
QUADRATIC = 1e2  # the quadratic weight, in the same unit
TIGHTEST = 0.2  # share of the range by which a limit is tightened at most
_AHEAD = 5  # steps of an error band that tighten limits


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
        if self.levels is None and (self.dwell is not None or self.level_steps is not None):
            raise DataError("dwell and level_steps are of inputs on levels; pass levels, or leave them out")
        for name, check in LIMIT_CHECKS.items():
            value = getattr(self, name)
            if value is not None or name == "rows":
                object.__setattr__(self, name, check(value, name))
        refuse_crossed_limits(self, BOUNDS)
        refuse_margin(self)

    def resolve(self, states: Sequence[str], inputs: Sequence[str]) -> "Limits":
        """Return the limits with arrays in place of limits by name; an omitted name has no limit.

        Raises
        ------
        DataError
            A name is unknown or fits two, or limits cross.
        """
        named = [end for pair in ENDS for end in pair[:2] if isinstance(getattr(self, end), Mapping)]
        entries = {
            field: tuple(checks.order_entries(getattr(self, field), field, inputs))
            for field in ("levels", "dwell")
            if isinstance(getattr(self, field), Mapping)
        }
        if not named and not entries:
            return self
        outputs = () if self.of is None else self.of.bind(tuple(states)).names
        known = {"u": inputs, "d": inputs, "x": states, "y": outputs}
        ordered = {
            end: bounds.order_bound(getattr(self, end), end, known[end[0]], bounds.open_end(end)) for end in named
        }
        for low, high, name in ENDS:
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
        rows = {
            end: bounds.find_widest(value, bounds.open_end(end)) for end, value in ends.items() if np.ndim(value) == 2
        }
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
            object.__setattr__(other, end, None if value is None else bounds.check_limit(value, end))
        refuse_crossed_limits(other, tuple(ends))
        if "x_min" in ends or "x_max" in ends:
            refuse_margin(other)
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
        return _write_box(self, {"u": nu}, first, count)

    def rate_rows(self, nu: int, first: int, count: int) -> Interval:
        """Return the boxes (count, nu) of u_k − u_{k−1} from k = first on; the last row is held."""
        return _write_box(self, {"du": nu}, first, count)

    def output_rows(self, nx: int, ny: int, first: int, count: int) -> Interval:
        """Return the boxes (count, nx + ny) of [x_k; of(x_k)] from k = first on; ny is 0 without `of`."""
        return _write_box(self, {"x": nx, "y": ny}, first, count)

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

    def movable(self, nx: int, ny: int, nu: int) -> "Movable":
        """Return which inputs, rates and outputs [x; of(x)] have a row: those with a finite or a declared bound."""
        base = self.base
        inputs, changes = (np.isfinite(box).any(axis=0) for box in (base.inputs(nu), _change_box(base, nu)))
        inputs, changes = np.logical_or(inputs, _declares(self, "u")), np.logical_or(changes, _declares(self, "du"))
        return Movable(np.asarray(inputs), np.asarray(changes), base.find_rows(nx, ny).kept)

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
        hard = _change_box(self, nu) if self.du_slack is None else None
        box = _box(self.u_min, self.u_max, "u_min", "u_max", nu)
        return build_levels(self.levels, dwell, self.level_steps, *box, hard)

    def rates(self, nu: int) -> Interval | None:
        """Return the box of u_k − u_{k−1}; None where nothing limits it."""
        box = _change_box(self, nu)
        return box if _declares(self, "du") or np.isfinite(box).any() else None

    def rate_softness(self, nu: int) -> Softness:
        """Return how soft the rate limits of each input are."""
        linear, quadratic = spread_prices(self.du_slack, "du_slack", nu, "one an input")
        box = _change_box(self, nu)
        size = np.where(np.isnan(half_width(box)), magnitude(box), half_width(box))
        return Softness(linear, quadratic, SOFTENED * np.where(size > 0, size, 1.0))

    def states(self, nx: int) -> Interval:
        """Return the box of the states."""
        return _box(self.x_min, self.x_max, "x_min", "x_max", nx)

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
            asked = [
                _declares(self, what) or any(getattr(self, f"{what}_{end}") is not None for end in ("min", "max"))
                for what in "xy"
            ]
            mine = np.repeat(asked, [nx, ny])
            given = spread_prices(self.slack, "slack", int(mine.sum()), "one a state, then one an output")
            linear[mine], quadratic[mine] = given
        kept = np.isfinite(low) | np.isfinite(high) | np.repeat([_declares(self, what) for what in "xy"], [nx, ny])
        softness = Softness(linear[kept], quadratic[kept], SOFTENED * size[kept])
        margin = np.zeros((1, nx + ny))
        if self.margin is not None:
            given_margin = checks.array(self.margin, "margin", (None, nx))
            margin = np.hstack([given_margin, np.zeros((len(given_margin), ny))])
        return LimitRows(kept, Interval(low[kept], high[kept]), softness, margin[:, kept])

    def ends(self, nx: int, ny: int) -> Interval:
        """Return the box of [x; of(x)]; ny is 0 without `of`."""
        outputs = _box(self.y_min, self.y_max, "y_min", "y_max", ny) if ny else Interval(np.zeros(0), np.zeros(0))
        return Interval(*(np.concatenate(each) for each in zip(self.states(nx), outputs, strict=True)))


def _declares(limits: Limits, what: str) -> bool:
    """Return whether a bound of u, du, x or y may come with a step."""
    return f"{what}_min" in limits.rows or f"{what}_max" in limits.rows


def _write_box(limits: Limits, widths: Mapping[Any, int], first: int, count: int) -> Interval:
    """Return the boxes of so many u, du, x or y, one beside the other, from step `first` on."""
    box, at = np.empty((2, count, sum(widths.values()))), 0
    for what, n in widths.items():
        if n:
            limits.write_rows(what, box[:, :, at : at + n], first)
        at += n
    return Interval(*box)


def _change_box(limits: Limits, nu: int) -> Interval:
    low = limits.du_min
    if low is None and limits.du_max is not None:
        low = -checks.array(cast("ArrayLike", limits.du_max), "du_max", infinite=True)
    return _box(low, limits.du_max, "du_min", "du_max", nu)


def _box(low: Bound, high: Bound, low_name: str, high_name: str, n: int) -> Interval:
    for end, name in ((low, low_name), (high, high_name)):
        if np.ndim(cast("Any", end)) == 2:
            raise DataError(f"{name} has a row for each step, and one set of limits is read here; pass limits.at(step)")
    return Interval(
        checks.vector(-np.inf if low is None else cast("ArrayLike", low), low_name, n, infinite=True),
        checks.vector(np.inf if high is None else cast("ArrayLike", high), high_name, n, infinite=True),
    )


def require_known(limits: Limits, who: str, known: Collection[str]) -> None:
    """Raise where a field of `limits` is set that is not `known` to who asks, such as a field added since."""
    refusal = "the limits have {name}={value}, which {who} does not know; leave {name} out"
    for name, default in ((field.name, field.default) for field in fields(limits) if field.name not in known):
        value = getattr(limits, name)
        if not (isinstance(value, type(default)) and value == default):
            raise DataError(REFUSALS.get(name, refusal).format(name=name, value=value, who=who))
