"""Limits of a plan, step by step: those that hold, and those that rows in time, or a call, bring."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc.base.checks import HUGE
from koopmpc.base.values import Interval, Value
from koopmpc.control.ask.bounds import refuse_crossed_rows
from koopmpc.control.ask.limits import Limits, preview_margin
from koopmpc.control.ask.preview import check_bounds_alone, require_movable, require_preview
from koopmpc.control.ask.terminal import EndReach, EndRows, measure_reach, read_end, require_inside
from koopmpc.control.plan.condensed_program import BoundsProgram, CondensedPlan, StepBounds, find_reach
from koopmpc.control.plan.task import ControlTask
from koopmpc.control.plan.tracking import LiftedTracking
from koopmpc.control.target import ROUNDING, Targets

_SHARE = 1e-5  # a rate that gives way by more than this share of its allowance is reported


@dataclass(frozen=True, eq=False)
class PlanShape(Value):
    """What of a plan its limits depend on.

    Attributes
    ----------
    track, targets
        What is tracked and limited, and the equilibria.
    blocks, held, tied
        Lengths of the blocks of held inputs; moves that keep the value of the one before, and those without limits.
    end, end_box
        The rows of a terminal set, and their limits, which do not move.
    aims_inside, checked
        Whether limits move the targets of a plan; the limits of targets that a plan is tested by.
    states, inputs
        Names of the model.
    """

    track: LiftedTracking
    targets: Targets
    blocks: tuple[int, ...]
    held: Bool[np.ndarray, "moves nu"]
    tied: Bool[np.ndarray, " all_moves"]
    end: EndRows | None
    end_box: Interval
    aims_inside: bool
    checked: Bool[np.ndarray, " nl"]
    states: tuple[str, ...]
    inputs: tuple[str, ...]


def describe_bounds(shape: PlanShape) -> BoundsProgram:
    """Return how rows of limits become the limits of a plan."""
    track, held, blocks = shape.track, shape.held, np.array(shape.blocks)
    start = np.cumsum([0, *blocks[:-1]])
    origin = np.maximum.accumulate(np.where(held, 0, np.arange(len(blocks))[:, None]), axis=0)
    count = np.array([np.bincount(own, blocks, len(blocks))[own] for own in origin.T], dtype=np.intp).T
    return BoundsProgram(
        first=start[origin],
        count=count,
        start=start,
        held=held,
        tied=shape.tied,
        margin=preview_margin(track.margin, sum(shape.blocks)),
        values=shape.targets.values,
        checked=np.flatnonzero(shape.checked),
        hard=np.isinf(track.rate_softness.linear),
        allowance=track.rate_softness.allowance,
        outputs=track.movable.outputs,
    )


def find_shape(task: ControlTask, targets: Targets, plan: CondensedPlan) -> PlanShape:
    """Return what the limits of a plan depend on."""
    track, held, planned = task.track, task.moves.held, len(plan.offset)
    wanted = track.limits.terminal
    end = None if wanted is None else read_end(wanted, task.predictor)
    last = slice(planned - (0 if end is None else len(end.F)), planned)
    return PlanShape(
        track=track,
        targets=targets,
        blocks=task.moves.lengths,
        held=held,
        tied=held.ravel() & ~np.isin(np.arange(held.size), plan.qp.source),
        end=end,
        end_box=Interval(plan.low[last], plan.high[last]),
        aims_inside=plan.aimed and not plan.is_driven,
        checked=plan.checked,
        states=task.predictor.states,
        inputs=task.predictor.inputs,
    )


class BoundRows:
    """Reads rows of limits for the plans of a controller: where each limit of a plan stands in a table of these rows.

    The table has a row for each step: inputs, their changes, outputs, a column without limits, the terminal set, and
    inputs over each length of a block.

    Parameters
    ----------
    shape
        What of a plan its limits depend on.
    latency
        Steps until the first input of a plan acts.
    """

    def __init__(self, shape: PlanShape, latency: int) -> None:
        self.shape, self.latency, self.N = shape, latency, sum(shape.blocks)
        track, targets = shape.track, shape.targets
        self.program = rows = describe_bounds(shape)
        self.nu, self.rated, outs = len(track.inputs.low), track.rates is not None, len(track.outputs.low)
        self.names = [*shape.states, *(() if track.limits.of is None else track.limits.of.bind(shape.states).names)]
        movable = track.movable
        read = np.concatenate([np.ones(self.nu, np.bool_), np.full(self.nu, self.rated), movable.outputs])
        self.read_columns, self.targeted = np.flatnonzero(read), np.flatnonzero(np.delete(read, self._changes))
        self.targeted[self.nu :] += self.nu
        self.fixed = np.flatnonzero(~np.concatenate(movable))
        self.kept = np.flatnonzero(movable.outputs)
        self.shown = [self.names[i] for i in self.kept]
        lengths = sorted({1, *rows.count.ravel().tolist()})
        self.used = {b: (rows.count == b).any(axis=0) | (b == 1) for b in lengths}  # the first one is 1
        nu, ends = self.nu, len(shape.end_box.low)
        change, output = nu, nu * (1 + self.rated)
        self.free = output + outs
        end, self.blocked = self.free + 1, self.free + 1 + ends
        self.width = W = self.blocked + nu * (len(lengths) - 1)
        column = dict(zip(lengths, (0, *range(self.blocked, W, nu)), strict=True))
        moves = rows.first * W + np.vectorize(column.__getitem__, otypes=[np.intp])(rows.count) + np.arange(nu)
        places: list[np.ndarray] = [np.where(shape.tied, self.free, moves.ravel())]
        if self.rated:
            changes: Int[np.ndarray, "moves nu"] = rows.start[:, None] * W + change + np.arange(nu)
            changes[shape.held] = self.free
            places.append(changes.ravel())
        places.append((np.arange(1, self.N + 1)[:, None] * W + output + np.arange(outs)).ravel())
        places.append(end + np.arange(ends))
        self.places, self.moves = np.concatenate(places).astype(np.intp), moves.ravel()
        stop = len(self.places) - ends
        self.outputs = slice(stop - self.N * outs, stop)
        self.margin = rows.margin.ravel() if track.margin.any() else None
        self.most = track.margin.max(axis=0, initial=0.0)
        self.limited = np.concatenate([movable.inputs, np.ones(outs, np.bool_)])
        self.rounding = ROUNDING * targets.size[self.limited]
        self.size = np.abs(targets.rows[self.limited] @ targets.from_reference).sum(axis=1)
        self.shift = targets.rows[self.limited] @ targets.offset
        self.checked = np.flatnonzero(shape.checked[self.limited])
        self.reach: EndReach | None = None  # the extremes on the terminal set, once they are asked for

    @property
    def _changes(self) -> slice:
        """Where changes of inputs stand in rows of all limits: inputs, their changes, states and observables."""
        return slice(self.nu, 2 * self.nu)

    def read(self, limits: Limits, *, at_call: bool) -> "BoundsInTime":
        """Return the limits of each step; `at_call` says that row 0 is that of the present step, and the only one.

        Raises
        ------
        DataError
            A limit has no row in the plan; limits cross in some step; the terminal set leaves limits of later rows.
        ShapeError
            A bound has too few rows for the plan, or as many signals as it should not.
        """
        nu, nx = self.nu, len(self.shape.states)
        if at_call:
            require_preview(limits, self.N + self.latency)
        steps = 1 if at_call else max(limits.count_rows().values(), default=1)
        every = np.empty((2, steps + self.latency + self.N, 2 * nu + len(self.names)))
        box, change, outputs = every[:, :, :nu], every[:, :, self._changes], every[:, :, 2 * nu :]
        limits.write_rows("u", box, 0)
        limits.write_rows("du", change, 0)
        limits.write_rows("x", outputs[:, :, :nx], 0)
        if len(self.names) > nx:
            limits.write_rows("y", outputs[:, :, nx:], 0)
        if len(self.fixed) and np.isfinite(every[:, :, self.fixed]).any():
            groups = Interval(*box), Interval(*change), Interval(*outputs)
            require_movable(self.shape.track.movable, groups, self.shape.inputs, self.names, nx)
        table = np.empty((*every.shape[:2], self.width))
        table[:, :, : self.free] = every[:, :, self.read_columns]
        table[:, :, self.free] = [[-HUGE], [HUGE]]
        for end, known in zip(table, self.shape.end_box, strict=True):
            end[:, self.free + 1 : self.blocked] = known
        for i, (b, used) in enumerate(self.used.items()):
            swept = Interval(*box) if b == 1 else sweep_rows(_hold_last(box, b - 1), b)
            if b > 1:
                first = self.blocked + (i - 1) * nu
                table[:, :, first : first + nu] = swept
            self._require_inputs(swept, used, f" within a block of {b} held steps" if b > 1 else "")
        refuse_crossed_rows(*Interval(*change), "rate", self.shape.inputs)
        why, kept = " once tightened by the margin" if self.most.any() else "", outputs[:, :, self.kept]
        tight = Interval(kept[0] + self.most, kept[1] - self.most)
        refuse_crossed_rows(*tight, "state and output", self.shown, why=why)
        if self.shape.end is not None:
            self._require_end(self.shape.end, limits, (Interval(*box), Interval(*change), tight), self.shown)
        return BoundsInTime(self, steps, every, table)

    def _require_inputs(self, box: Interval, used: Bool[np.ndarray, " nu"], why: str) -> None:
        """Raise where limits of inputs cross, or an input on levels has none between them, of the inputs in use."""
        limits, inputs = self.shape.track.limits, self.shape.inputs
        levels = None if limits.levels is None else limits.base.input_levels(len(inputs))
        low, high = box if used.all() else (np.where(used, box.low, -np.inf), np.where(used, box.high, np.inf))
        if levels is not None:
            levels.refuse_missing(Interval(low, high), inputs, why)
        refuse_crossed_rows(low, high, "input", inputs, why=why)

    def _require_end(
        self, end: EndRows, limits: Limits, rows: tuple[Interval, Interval, Interval], shown: Sequence[str]
    ) -> None:
        """Raise where the terminal set leaves limits of the inputs, their changes or the outputs after a plan's end."""
        (box, change, outputs), inputs, first = rows, self.shape.inputs, self.N + self.latency
        if self.reach is None:
            self.reach = measure_reach(end.of, end.places, self.shape.track.limited, end.constant)
        require_inside("state and output", self.reach.outputs, outputs, first + 1, shown, moved=True)
        for what, reach, field, bounds in (
            ("input", self.reach.inputs, "u_", box),
            ("rate", self.reach.rates, "du_", change),
        ):
            moved = any(name.startswith(field) for name in limits.count_rows())
            require_inside(what, reach, bounds, first, inputs, moved=moved)


class BoundsInTime:
    """Limits that move: each step takes them from a table of checked rows; see `PlanBounds` and `BoundRows`."""

    def __init__(
        self, rows: BoundRows, steps: int, every: Float[np.ndarray, "2 count n"], table: Float[np.ndarray, "2 count W"]
    ) -> None:
        self._rows, self._last, self._every, self._width = rows, steps - 1, every, rows.width
        np.maximum(table, -HUGE, out=table)
        np.minimum(table, HUGE, out=table)
        self._low, self._high = table.reshape(2, -1)
        self._reaches: list[float] | None = None
        shape, self._targets = rows.shape, every[:, :, rows.targeted] - rows.shape.targets.values
        if shape.aims_inside or len(rows.checked):
            first = slice(rows.latency, rows.latency + steps + rows.N)
            swept = sweep_rows(self._targets[:, first, rows.limited], rows.N + 1)
            self._tight = Interval(swept.low - rows.rounding, swept.high + rows.rounding)
            if shape.aims_inside:
                tight = (end - rows.shift for end in self._tight)
                self._reaches = find_reach(rows.size, *tight).tolist()

    def place(self, k: int) -> int:
        """Return the row of the table that step k begins with."""
        return min(k, self._last) + self._rows.latency

    def at(self, k: int) -> StepBounds:
        """Return the limits of step k."""
        k, rows = min(k, self._last), self._rows
        places = rows.places + (k + rows.latency) * self._width
        low, high = self._low.take(places), self._high.take(places)
        if rows.margin is not None:
            low[rows.outputs] += rows.margin
            high[rows.outputs] -= rows.margin
        if len(rows.checked):
            free = np.full(len(rows.checked), HUGE)
            low = np.concatenate([low, np.maximum(self._tight.low[k, rows.checked], -HUGE), -free])
            high = np.concatenate([high, free, np.minimum(self._tight.high[k, rows.checked], HUGE)])
        return StepBounds(low, high, HUGE if self._reaches is None else self._reaches[k])

    def first(self, k: int) -> tuple[Interval, Interval | None]:
        """Return the box of the input that acts first in step k, and that of its change."""
        (low, high), nu = self._every[:, self.place(k)], self._rows.nu
        change = Interval(low[nu : 2 * nu], high[nu : 2 * nu]) if self._rows.rated else None
        return Interval(low[:nu], high[:nu]), change

    def hard_rates(self, k: int) -> Interval | None:
        """Return the hard limits of the first change in step k, ±inf in place of the others; None without any."""
        hard, rates = self._rows.program.hard, self.first(k)[1]
        if rates is None or not hard.any():
            return None
        return Interval(np.where(hard, rates.low, -np.inf), np.where(hard, rates.high, np.inf))

    def moves(self, k: int) -> Interval:
        """Return the limits of all moves of step k, one after the other."""
        places = self._rows.moves + self.place(k) * self._width
        return Interval(self._low.take(places), self._high.take(places))

    def targets(self, k: int) -> Interval:
        """Return the (N+1, nl) limits of the targets of the preview of step k."""
        return Interval(*self._targets[:, self.place(k) : self.place(k) + self._rows.N + 1])

    def open_rates(self, k: int, u_prev: Float[np.ndarray, " nu"]) -> tuple[Interval, float]:
        """Return the limits of a plan after u_prev, and by how much rates ahead are wider than theirs.

        Where the limits of an input move by more than its hard rate, they win. The inputs that can be reached inside
        all limits are followed from move to move; the rates of the first move are left as they are.
        """
        (low, high, _), rows, program = self.at(k), self._rows, self._rows.program
        planned, hard, held = Interval(low, high), program.hard, program.held
        if not (rows.rated and hard.any()):
            return planned, 0.0
        n = held.size
        below, above = (end.reshape(held.shape) for end in self.moves(k))
        falls, rises = low[n : 2 * n].reshape(held.shape), high[n : 2 * n].reshape(held.shape)
        fits = (below[1:] - below[:-1] <= rises[1:]) & (above[1:] - above[:-1] >= falls[1:])
        if (fits | held[1:] | ~hard).all():
            return planned, 0.0
        least, most = (np.clip(u_prev + change[0], below[0], above[0]) for change in (falls, rises))
        conflict = np.zeros(held.shape[1])
        for j in range(1, len(held)):
            least, most = least + np.where(held[j], 0.0, falls[j]), most + np.where(held[j], 0.0, rises[j])
            short, long = hard & (most < below[j]), hard & (least > above[j])
            missing = np.where(short, below[j] - most, 0.0) + np.where(long, least - above[j], 0.0)
            rises[j] += np.where(short, missing, 0.0)
            falls[j] -= np.where(long, missing, 0.0)
            conflict = np.maximum(conflict, missing)
            least, most = np.clip(least, below[j], above[j]), np.clip(most, below[j], above[j])
        return planned, float(conflict[conflict > _SHARE * program.allowance].max(initial=0.0))


class CallBounds:
    """Reads the limits of calls: those that `with_bounds` of the controller's own made by their numbers alone.

    Parameters
    ----------
    rows
        Reads rows of limits for the controller.
    """

    def __init__(self, rows: BoundRows) -> None:
        self._rows, self._limits = rows, rows.shape.track.limits
        self._last: tuple[Limits, BoundsInTime] | None = None

    def read(self, limits: Limits) -> BoundsInTime:
        """Return the limits of a call.

        Raises
        ------
        DataError
            They differ from the controller's own in more than bounds, cross, or have no row in the plan.
        ShapeError
            A bound has too few rows for the plan.
        """
        if self._last is None or self._last[0] is not limits:
            shape = self._rows.shape
            known = check_bounds_alone(limits, self._limits, shape.states, shape.inputs)
            self._last = limits, self._rows.read(known, at_call=True)
        return self._last[1]


def sweep_rows(rows: Float[np.ndarray, "2 T n"], steps: int) -> Interval:
    """Return the tightest limits over so many rows from each one on, as far as there are so many."""
    (low, high), length = rows, 1
    while length < steps:  # over twice as many rows each time
        by = min(length, steps - length)
        low, high = np.maximum(low[:-by], low[by:]), np.minimum(high[:-by], high[by:])
        length += by
    return Interval(low, high)


def _hold_last(rows: Float[np.ndarray, "2 T n"], count: int) -> Float[np.ndarray, "2 T_count n"]:
    """Return rows with the last one repeated so many times."""
    return np.concatenate([rows, np.repeat(rows[:, -1:], count, axis=1)], axis=1)
