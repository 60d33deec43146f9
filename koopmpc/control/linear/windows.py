"""LimitWindows: limits in time as the right-hand sides of a PlanMap; matrices, sizes and slack weights stay."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.lib.stride_tricks import sliding_window_view

from koopmpc.checks import HUGE
from koopmpc.control.in_time.bounds import refuse_crossed_rows
from koopmpc.control.in_time.preview import require_movable, require_preview
from koopmpc.control.limits import Interval, Limits, preview_margin
from koopmpc.control.linear.condensed_program import BoundsProgram
from koopmpc.control.linear.layout import TableColumns, WindowLayout
from koopmpc.control.linear.moving import MovingMap, find_reach
from koopmpc.control.linear.plan import PlanMap
from koopmpc.control.target import ROUNDING
from koopmpc.control.terminal.inclusion import measure_reach, require_inside
from koopmpc.control.terminal.sets import EndRows
from koopmpc.values import Viewing

_Row = tuple[Float[np.ndarray, " nt"], Float[np.ndarray, " nt"]]  # lower and upper limits of a step
_PAGE = 2**14  # entries of limits that are made at once: more cost a step more than 0.1 ms
_SHARE = 1e-5  # a rate that gives way by more of its allowance than this is reported


@dataclass(eq=False)
class _Pages(Viewing):
    """The limits of a map of the plan in consecutive steps, a page of them at a time: a step takes one row.

    A row holds until the next page is made.

    Attributes
    ----------
    table, entries
        The table of `LimitWindows`, and where the limits of the map stand in it, from the first row of a step on.
    latency, last
        The row of step 0, and the last step with a window of its own.
    outputs, margin
        Where the outputs of all stages stand among the limits, and what moves them inwards.
    """

    _VIEWS = ("rows", "views", "low", "high")

    table: Float[np.ndarray, "rows W2"]
    entries: Int[np.ndarray, " n"]
    latency: int
    last: int
    outputs: slice
    margin: Float[np.ndarray, " outputs"] | None

    def __post_init__(self) -> None:
        self._see()

    def _see(self) -> None:
        """Begin without a page; see `Viewing`."""
        self.rows: dict[int, _Row] = {}
        self.views: list[_Row] = []
        self.low: Float[np.ndarray, "steps nt"] = self.table[:0]
        self.high: Float[np.ndarray, "steps nt"] = self.low

    def turn(self, target: PlanMap | MovingMap | None, k: int) -> None:
        """Put the limits of step k into a map."""
        assert target is not None, "a map that is not there is never asked"
        target.low, target.high = self.rows.get(k) or self.fill(k)

    def fill(self, k: int) -> _Row:
        """Make the page that begins with step k, and return its first row."""
        steps = min(max(1, _PAGE // max(len(self.entries), 1)), self.last + 1 - k)
        half, span, (stride, _) = len(self.entries) // 2, int(self.entries.max(initial=0)) + 1, self.table.strides
        ahead = np.ndarray((steps, span), np.float64, self.table, (k + self.latency) * stride, (stride, 8))
        if len(self.views) != steps:  # else the arrays of the last page are filled again
            self.low, self.high = np.empty((2, steps, half))
            self.views = list(zip(self.low, self.high, strict=True))  # quick to take
        self.low[:], self.high[:] = ahead[:, self.entries[:half]], ahead[:, self.entries[half:]]
        if self.margin is not None:
            self.low[:, self.outputs] += self.margin
            self.high[:, self.outputs] -= self.margin
        self.rows = dict(zip(range(k, k + steps), self.views, strict=True))
        return self.views[0]


@dataclass(frozen=True, eq=False)
class LimitWindows:
    """The limits of each step of a run, taken from one table with a row for each step.

    Attributes
    ----------
    last
        The step from which on all windows are the same.
    table
        (rows, 2 W) lower limits, then upper ones: of the inputs over each length of a block, of their changes, of the
        outputs, of targets, of targets with their rounding, and the tightest of these over a preview.
    endless
        Whether an entry has no limit somewhere.
    targets, swept
        Where targets stand in the table, and the tightest limits of targets.
    hard
        Which rates are hard; None where none is.
    reaches
        For each step the largest |r| of a preview for which no limit moves a target.
    moves
        Where the limits of all moves stand, those that an input keeps included.
    plan_pages, moving_pages, single_pages
        The limits of the plan, and of its maps of a reference that moves.
    """

    plan: PlanMap
    last: int
    latency: int
    table: Float[np.ndarray, "rows W2"]
    endless: bool
    targets: TableColumns
    swept: TableColumns
    hard: Bool[np.ndarray, " nu"] | None
    reaches: list[float]
    moves: Int[np.ndarray, " moves"]
    plan_pages: _Pages
    moving_pages: _Pages
    single_pages: _Pages

    def _row(self, k: int) -> int:
        return min(k, self.last) + self.latency

    def target_box(self, k: int) -> Interval:
        """Return the (N+1, nl) limits of the targets of the preview of step k."""
        first, count = self.targets
        rows, W = slice(self._row(k), self._row(k) + sum(self.plan.blocks) + 1), self.table.shape[1] // 2
        return Interval(self.table[rows, first : first + count], self.table[rows, W + first : W + first + count])

    def find_free_steps(self, values: Float[np.ndarray, "N1 nl"]) -> Bool[np.ndarray, " T"]:
        """Return in which steps no target with these limited values is outside its limits anywhere in the preview."""
        first, count = self.swept
        W, rows = self.table.shape[1] // 2, slice(self.latency, self.latency + self.last + 1)
        limited = values[:, self.plan.limited_targets]
        low, high = self.table[rows, first : first + count], self.table[rows, W + first : W + first + count]
        return ((limited.min(axis=0) >= low) & (limited.max(axis=0) <= high)).all(axis=1)

    def find_rows(self, k: int, steps: int) -> Interval:
        """Return the limits of inputs, rates and outputs, less the largest margin, that plans of so many steps read."""
        W, n, most = self.table.shape[1] // 2, self.targets.first, self.plan.track.margin.max(axis=0, initial=0.0)
        rows = slice(self._row(k), self._row(k) + steps + sum(self.plan.blocks))
        low, high = self.table[rows, :n].copy(), self.table[rows, W : W + n].copy()
        if self.plan_pages.margin is not None:
            low[:, n - len(most) :] += most
            high[:, n - len(most) :] -= most
        return Interval(low, high)

    def leaves_targets(self, values: Float[np.ndarray, "N1 nl"]) -> bool:
        """Return whether the limits of a call move no target with these limited values."""
        return bool(self.find_free_steps(values)[0])

    def first_inputs(self, k: int) -> tuple[Interval, Interval | None]:
        """Return the box of the input that acts first in step k, and that of its change."""
        W, nu, row = self.table.shape[1] // 2, len(self.plan.track.inputs.low), self.table[self._row(k)]
        box = Interval(row[:nu], row[W : W + nu])
        rates = None if self.plan.track.rates is None else Interval(row[nu : 2 * nu], row[W + nu : W + 2 * nu])
        return box, rates

    def input_box(self, k: int) -> Interval:
        """Return the limits of all moves of step k, one after the other."""
        rows = self.table.reshape(-1)[self._row(k) * self.table.shape[1] :]
        return Interval(rows[self.moves], rows[self.moves + self.table.shape[1] // 2])

    def hard_rates(self, k: int) -> Interval:
        """Return the hard limits of the first change in step k, ±inf in place of the others."""
        _, rates = self.first_inputs(k)
        assert rates is not None, "only asked where there are hard rates"
        assert self.hard is not None, "only asked where there are hard rates"
        return Interval(np.where(self.hard, rates.low, -np.inf), np.where(self.hard, rates.high, np.inf))

    def find_bounds(self, k: int, u_prev: Float[np.ndarray, " nu"]) -> tuple[Interval, float]:
        """Return the limits of the QP as they stand in the plan, and by how much rates ahead are wider than theirs."""
        plan, conflict = self.plan, 0.0
        low, high = plan.low[: plan.planned], plan.high[: plan.planned]
        if self.hard is not None:
            low, high = low.copy(), high.copy()
            conflict = self._open_rates(low, high, self.input_box(k), u_prev)
        source, size = plan.qp.source, plan.row_size
        low, high = low[source], high[source]
        if self.endless:
            low, high = np.where(low > -HUGE, low, -np.inf), np.where(high < HUGE, high, np.inf)
        return Interval(low / size, high / size), conflict

    def _open_rates(
        self,
        low: Float[np.ndarray, " nv"],
        high: Float[np.ndarray, " nv"],
        box: Interval,
        u_prev: Float[np.ndarray, " nu"],
    ) -> float:
        """Widen hard rates of later moves as far as the limits of the inputs need, and return by how much at most.

        Where the limits of an input move by more than its rate, they win. The inputs that can be reached inside all
        limits are followed from move to move; the rates of the first move are left as they are.
        """
        nu, moves, hard = len(self.plan.track.inputs.low), len(self.plan.blocks), self.hard
        shape, n = (moves, nu), moves * nu
        below, above = (end.reshape(shape) for end in box)
        falls, rises = low[n : 2 * n].reshape(shape), high[n : 2 * n].reshape(shape)
        held = self.plan.held
        fits = (below[1:] - below[:-1] <= rises[1:]) & (above[1:] - above[:-1] >= falls[1:])
        assert hard is not None, "only asked where there are hard rates"
        if (fits | held[1:] | ~hard).all():
            return 0.0
        least, most = (np.clip(u_prev + change[0], below[0], above[0]) for change in (falls, rises))
        conflict = np.zeros(nu)
        for j in range(1, moves):
            least, most = least + np.where(held[j], 0.0, falls[j]), most + np.where(held[j], 0.0, rises[j])
            short, long = hard & (most < below[j]), hard & (least > above[j])
            missing = np.where(short, below[j] - most, 0.0) + np.where(long, least - above[j], 0.0)
            rises[j] += np.where(short, missing, 0.0)
            falls[j] -= np.where(long, missing, 0.0)
            conflict = np.maximum(conflict, missing)
            least, most = np.clip(least, below[j], above[j]), np.clip(most, below[j], above[j])
        allowed = _SHARE * self.plan.track.rate_softness.allowance
        return float(conflict[conflict > allowed].max(initial=0.0))


def limit_windows(
    plan: PlanMap, limits: Limits, states: Sequence[str], inputs: Sequence[str], latency: int, *, at_call: bool
) -> LimitWindows:
    """Return the windows of limits with rows for a plan.

    Parameters
    ----------
    states, inputs
        Names of the model.
    at_call
        Whether row 0 is that of the present step, and there is no other step.

    Raises
    ------
    DataError
        A limit has no row in the plan; limits cross in some step; the terminal set leaves limits of later rows.
    ShapeError
        A bound has too few rows for the plan, or as many signals as it should not.
    """
    track, targets = plan.track, plan.targets
    N, nu, nx = sum(plan.blocks), len(inputs), len(states)
    names = [*states, *(() if limits.of is None else limits.of.bind(tuple(states)).names)]
    if at_call:
        require_preview(limits, N + latency)
    steps = 1 if at_call else max(limits.count_rows().values(), default=1)
    count = steps + latency + N
    box, change = limits.input_rows(nu, 0, count), limits.rate_rows(nu, 0, count)
    every = limits.output_rows(nx, len(names) - nx, 0, count)
    require_movable(track.movable, (box, change, every), inputs, names, nx)
    kept = track.movable.outputs
    outputs, shown = (
        Interval(every.low[:, kept], every.high[:, kept]),
        [n for n, k in zip(names, kept, strict=True) if k],
    )
    layout = plan.layout = plan.layout or _lay_out(plan)
    blocks = {b: _sweep(box, b) for b in layout.used}
    for b, swept in blocks.items():
        used = layout.used[b]
        _require_inputs(plan, swept, inputs, used, f" within a block of {b} held steps" if b > 1 else "")
    refuse_crossed_rows(*change, "rate", inputs)
    most = track.margin.max(axis=0, initial=0.0)
    why = " once tightened by the margin" if most.any() else ""
    refuse_crossed_rows(outputs.low + most, outputs.high - most, "state and output", shown, why=why)

    if plan.end is not None:
        _require_end(plan, plan.end, limits, (box, change, outputs), N + latency, inputs, shown)
    raw = Interval(*(np.hstack([a, b]) - targets.values for a, b in zip(box, outputs, strict=True)))
    limited, reach = plan.limited_targets, ROUNDING * targets.size[plan.limited_targets]
    shift = targets.rows[limited] @ targets.offset  # the tests of a MovingMap are of K r alone
    test = Interval(raw.low[:, limited] - reach - shift, raw.high[:, limited] + reach - shift)
    swept_raw = _sweep(Interval(raw.low[:, limited], raw.high[:, limited]), N + 1)
    tightest = Interval(swept_raw.low - reach, swept_raw.high + reach)
    free = Interval(np.full((count, 1), -HUGE), np.full((count, 1), HUGE))
    parts = [box, *([] if track.rates is None else [change]), outputs, raw, test, tightest, free]
    parts += [swept for b, swept in blocks.items() if b > 1]
    start = plan.planned - plan.ends  # a terminal set has the same limits in every row
    low, high = (np.tile(end[start : plan.planned], (count, 1)) for end in np.split(plan.limits, 2))
    parts.append(Interval(low, high))
    table = np.concatenate([part[i] for i in (0, 1) for part in parts], axis=1)
    margin = preview_margin(track.margin, N).ravel() if track.margin.any() else None
    W, raw_at = layout.width, layout.raw.first
    planned = table[:, :raw_at], table[:, W : W + raw_at]
    table = np.ascontiguousarray(np.clip(table, -HUGE, HUGE))  # else each page would copy the limits of the whole run
    reaches = [plan.single.reach] * steps  # where nothing aims at a target, or a disturbance moves it
    if plan.aims_inside:
        first = [part[latency : latency + steps] - shift for part in tightest]
        reaches = find_reach(targets.rows[limited] @ targets.from_reference, *first).tolist()
    endless = plan.ends > 0 or not all(np.isfinite(part).all() for part in planned)
    return make_windows(plan, table, latency, steps, endless=endless, reaches=reaches, margin=margin)


def _require_end(
    plan: PlanMap,
    end: EndRows,
    limits: Limits,
    rows: tuple[Interval, Interval, Interval],
    first: int,
    inputs: Sequence[str],
    shown: Sequence[str],
) -> None:
    """Raise where the terminal set leaves limits of the inputs, their changes or the outputs after a plan's end."""
    track, (box, change, outputs) = plan.track, rows
    if plan.reach is None:
        plan.reach = measure_reach(end.of, end.places, track.limited, end.constant)
    most, moving = track.margin.max(axis=0, initial=0.0), limits.count_rows()
    within = Interval(outputs.low + most, outputs.high - most)
    require_inside("state and output", plan.reach.outputs, within, first + 1, shown, moved=True)
    for what, reach, asked, bounds in (
        ("input", plan.reach.inputs, "u_", box),
        ("rate", plan.reach.rates, "du_", change),
    ):
        moved = any(name.startswith(asked) for name in moving)
        require_inside(what, reach, bounds, first, inputs, moved=moved)


def make_windows(
    plan: PlanMap,
    table: Float[np.ndarray, "rows W2"],
    latency: int,
    steps: int,
    *,
    endless: bool,
    reaches: list[float],
    margin: Float[np.ndarray, " outputs"] | None,
) -> LimitWindows:
    """Return the windows of a table whose limits were checked; see `LimitWindows`."""
    layout, track = plan.layout, plan.track
    assert layout is not None, "a plan with a table has a layout"
    pages = [_Pages(table, entries, latency, steps - 1, layout.outputs, margin) for entries in layout.entries]
    return LimitWindows(
        plan=plan,
        last=steps - 1,
        latency=latency,
        table=table,
        endless=endless,
        targets=layout.raw,
        swept=layout.tight,
        hard=None if track.hard_rates is None else np.isinf(track.rate_softness.linear),
        reaches=reaches,
        moves=layout.moves,
        plan_pages=pages[0],
        moving_pages=pages[1],
        single_pages=pages[2],
    )


def _lay_out(plan: PlanMap) -> WindowLayout:
    """Return where the limits of a plan stand in a table of rows of limits."""
    track, N, nu = plan.track, sum(plan.blocks), len(plan.track.inputs.low)
    start, length = _find_holds(plan, nu)
    used = {b: (length == b).any(axis=0) | (b == 1) for b in sorted({1, *length.ravel().tolist()})}
    outs, limited, rated = len(track.outputs.low), int(plan.limited_targets.sum()), track.rates is not None
    widths = [nu, *([nu] if rated else []), outs, nu + outs, limited, limited, 1, *([nu] * (len(used) - 1)), plan.ends]
    starts = np.cumsum([0, *widths]).tolist()
    at = iter(starts)
    u_at, du_at = next(at), next(at) if rated else 0
    out_at, raw_at, test_at, tight_at, free_at = (next(at) for _ in range(5))
    block_at = {b: next(at) for b in used if b > 1} | {1: u_at}
    end_at = next(at)
    W = starts[-1]

    first = np.cumsum([0, *plan.blocks[:-1]])
    columns = np.vectorize(block_at.__getitem__, otypes=[np.intp])(length)
    moves = (start * 2 * W + columns + np.arange(nu)).ravel()
    places: list[Int[np.ndarray, " n"]] = [np.where(plan.tied, free_at, moves)]
    if rated:
        changes = (first[:, None] * 2 * W + du_at + np.arange(nu)).ravel()
        changes[plan.held.ravel()] = free_at
        places.append(changes)
    places += [(k + 1) * 2 * W + out_at + np.arange(outs) for k in range(N)]
    places.append(end_at + np.arange(plan.ends))
    mine = np.concatenate(places).astype(np.intp)
    low_places, high_places = [mine], [mine + W]
    if len(plan.low) > plan.planned:
        checked = tight_at + np.flatnonzero(plan.checked[plan.limited_targets])
        low_places += [checked, np.full(len(checked), free_at)]
        high_places += [np.full(len(checked), W + free_at), W + checked]
    tests = (np.arange(N + 1)[:, None] * 2 * W + test_at + np.arange(limited)).ravel() if plan.aimed else mine[:0]
    tight = tight_at + np.arange(limited) if plan.aimed else mine[:0]
    entries = (
        np.concatenate([*low_places, *high_places]).astype(np.intp),
        np.concatenate([mine, tests, mine + W, tests + W]).astype(np.intp),
        np.concatenate([mine, tight, mine + W, tight + W]).astype(np.intp),
    )
    return WindowLayout(
        used=used,
        width=W,
        raw=TableColumns(raw_at, nu + outs),
        tight=TableColumns(tight_at, limited),
        moves=moves,
        outputs=slice(len(mine) - plan.ends - N * outs, len(mine) - plan.ends),
        entries=entries,
    )


def describe_bounds(plan: PlanMap) -> BoundsProgram:
    """Return how rows of limits become the limits of this plan."""
    track, nu = plan.track, len(plan.track.inputs.low)
    first, count = _find_holds(plan, nu)
    return BoundsProgram(
        first=first,
        count=count,
        start=np.cumsum([0, *plan.blocks[:-1]]),
        held=plan.held,
        tied=plan.tied,
        margin=preview_margin(track.margin, sum(plan.blocks)),
        values=plan.targets.values,
        checked=np.flatnonzero(plan.checked),
        hard=np.isinf(track.rate_softness.linear),
        allowance=track.rate_softness.allowance,
        outputs=track.movable.outputs,
    )


def _find_holds(plan: PlanMap, nu: int) -> tuple[Int[np.ndarray, "moves nu"], Int[np.ndarray, "moves nu"]]:
    """Return the first step of what holds the value of each move and input, and for how many steps it is held."""
    blocks = np.array(plan.blocks)
    origin = np.maximum.accumulate(np.where(plan.held, 0, np.arange(len(blocks))[:, None]), axis=0)
    length = np.array([[blocks[origin[:, i] == origin[j, i]].sum() for i in range(nu)] for j in range(len(blocks))])
    return np.cumsum([0, *plan.blocks[:-1]])[origin], length


def _require_inputs(
    plan: PlanMap, box: Interval, inputs: Sequence[str], used: Bool[np.ndarray, " nu"], why: str
) -> None:
    """Raise where limits of inputs cross, or an input on levels has none between them, of the inputs in use."""
    limits = plan.track.limits
    levels = None if limits.levels is None else limits.base.input_levels(len(inputs))
    low, high = np.where(used, box.low, -np.inf), np.where(used, box.high, np.inf)
    if levels is not None:
        levels.refuse_missing(Interval(low, high), inputs, why)
    refuse_crossed_rows(low, high, "input", inputs, why=why)


def _sweep(rows: Interval, steps: int) -> Interval:
    """Return the tightest limits over so many steps from each one on; the last row is held."""
    if steps == 1:
        return rows
    low, high = (np.vstack([end, np.broadcast_to(end[-1], (steps - 1, end.shape[1]))]) for end in rows)
    return Interval(
        sliding_window_view(low, steps, axis=0).max(axis=-1), sliding_window_view(high, steps, axis=0).min(axis=-1)
    )
