"""What moves in time: the limits of each step from a table of rows, and a plan for each preview of weights."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc.base.checks import HUGE
from koopmpc.base.errors import DefinitenessError
from koopmpc.base.values import Interval
from koopmpc.control.ask.bounds import refuse_crossed_rows
from koopmpc.control.ask.limits import Limits, preview_margin
from koopmpc.control.ask.preview import check_bounds_alone, require_movable, require_preview
from koopmpc.control.ask.terminal import EndReach, measure_reach, require_inside
from koopmpc.control.horizon import WeightRows
from koopmpc.control.plan.condensed_program import BoundsProgram, CondensedPlan, StepBounds, find_reach
from koopmpc.control.plan.task import ControlTask
from koopmpc.control.plan.tracking import EndRows, LiftedTracking, read_end
from koopmpc.control.target import ROUNDING, Targets

_SHARE = 1e-5  # a rate that gives way by more than this share of its allowance is reported


def describe_bounds(task: ControlTask, targets: Targets, plan: CondensedPlan) -> BoundsProgram:
    """Return how rows of limits become the limits of a plan."""
    track, held, lengths = task.track, task.moves.held, np.array(task.moves.lengths)
    start, origin = np.cumsum([0, *lengths[:-1]]), task.moves.origins()
    count = np.array([np.bincount(own, lengths, len(lengths))[own] for own in origin.T], dtype=np.intp).T
    return BoundsProgram(
        first=start[origin],
        count=count,
        start=start,
        held=held,
        tied=held.ravel() & ~np.isin(np.arange(held.size), plan.qp.source),
        margin=preview_margin(track.margin, task.N),
        values=targets.values,
        checked=np.flatnonzero(plan.checked),
        hard=np.isinf(track.rate_softness.linear),
        allowance=track.rate_softness.allowance,
        outputs=track.movable.outputs,
    )


class BoundRows:
    """Reads rows of limits for the plans of a controller: where each limit of a plan stands in a table of these rows.

    The table has a row for each step: inputs, their changes, outputs, a column without limits, the terminal set, and
    inputs over each length of a block.
    """

    def __init__(self, task: ControlTask, targets: Targets, plan: CondensedPlan) -> None:
        self.track, self.targets, self.latency, self.N = task.track, targets, task.latency, task.N
        self.states, self.inputs = task.predictor.states, task.predictor.inputs
        self.aims_inside = plan.aimed and not plan.disturbance.size
        self.program = rows = describe_bounds(task, targets, plan)
        track, wanted = self.track, self.track.limits.terminal
        self.end = None if wanted is None else read_end(wanted, task.predictor)
        self.nu, self.rated, outs = len(track.inputs.low), track.rates is not None, len(track.outputs.low)
        nu, ends, planned = self.nu, 0 if self.end is None else len(self.end.F), len(plan.offset)
        self.end_box = Interval(plan.low[planned - ends : planned], plan.high[planned - ends : planned])
        self.names = [*self.states, *(() if track.limits.of is None else track.limits.of.bind(self.states).names)]
        movable = track.movable
        read = np.concatenate([np.ones(nu, np.bool_), np.full(nu, self.rated), movable.outputs])
        self.read_columns, self.targeted = np.flatnonzero(read), np.flatnonzero(np.delete(read, self._changes))
        self.targeted[nu:] += nu
        self.fixed = np.flatnonzero(~np.concatenate(movable))
        self.kept = np.flatnonzero(movable.outputs)
        self.shown = [self.names[i] for i in self.kept]
        lengths = sorted({1, *rows.count.ravel().tolist()})
        self.used = {b: (rows.count == b).any(axis=0) | (b == 1) for b in lengths}  # the first one is 1
        output = nu * (1 + self.rated)
        self.free = output + outs
        end, self.blocked = self.free + 1, self.free + 1 + ends
        self.width = W = self.blocked + nu * (len(lengths) - 1)
        column = dict(zip(lengths, (0, *range(self.blocked, W, nu)), strict=True))
        moves = rows.first * W + np.vectorize(column.__getitem__, otypes=[np.intp])(rows.count) + np.arange(nu)
        places: list[np.ndarray] = [np.where(rows.tied, self.free, moves.ravel())]
        if self.rated:
            changes: Int[np.ndarray, "moves nu"] = rows.start[:, None] * W + nu + np.arange(nu)
            places.append(np.where(rows.held, self.free, changes).ravel())
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
        self.checked = np.flatnonzero(plan.checked[self.limited])
        self.reach: EndReach | None = None  # the extremes on the terminal set, once they are asked for

    @property
    def _changes(self) -> slice:
        """Where changes of inputs stand in rows of all limits: inputs, their changes, states and observables."""
        return slice(self.nu, 2 * self.nu)

    def read(self, limits: Limits, *, at_call: bool) -> "BoundsInTime":
        """Return the limits of each step; `at_call` says that row 0 is that of the present step, and the only one."""
        nu, nx = self.nu, len(self.states)
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
            require_movable(self.track.movable, groups, self.inputs, self.names, nx)
        table = np.empty((*every.shape[:2], self.width))
        table[:, :, : self.free] = every[:, :, self.read_columns]
        table[:, :, self.free] = [[-HUGE], [HUGE]]
        for end, known in zip(table, self.end_box, strict=True):
            end[:, self.free + 1 : self.blocked] = known
        for i, (b, used) in enumerate(self.used.items()):
            swept = Interval(*box) if b == 1 else sweep_rows(_hold_last(box, b - 1), b)
            if b > 1:
                first = self.blocked + (i - 1) * nu
                table[:, :, first : first + nu] = swept
            self._require_inputs(swept, used, f" within a block of {b} held steps" if b > 1 else "")
        refuse_crossed_rows(*Interval(*change), "rate", self.inputs)
        why, kept = " once tightened by the margin" if self.most.any() else "", outputs[:, :, self.kept]
        tight = Interval(kept[0] + self.most, kept[1] - self.most)
        refuse_crossed_rows(*tight, "state and output", self.shown, why=why)
        if self.end is not None:
            self._require_end(self.end, limits, (Interval(*box), Interval(*change), tight), self.shown)
        return BoundsInTime(self, steps, every, table)

    def _require_inputs(self, box: Interval, used: Bool[np.ndarray, " nu"], why: str) -> None:
        """Raise where limits of inputs cross, or an input on levels has none between them, of the inputs in use."""
        limits, inputs = self.track.limits, self.inputs
        levels = None if limits.levels is None else limits.base.input_levels(len(inputs))
        low, high = box if used.all() else (np.where(used, box.low, -np.inf), np.where(used, box.high, np.inf))
        if levels is not None:
            levels.refuse_missing(Interval(low, high), inputs, why)
        refuse_crossed_rows(low, high, "input", inputs, why=why)

    def _require_end(
        self, end: EndRows, limits: Limits, rows: tuple[Interval, Interval, Interval], shown: Sequence[str]
    ) -> None:
        """Raise where the terminal set leaves limits of the inputs, their changes or the outputs after a plan's end."""
        (box, change, outputs), inputs, first = rows, self.inputs, self.N + self.latency
        if self.reach is None:
            self.reach = measure_reach(end.of, end.places, self.track.limited, end.constant)
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
        self._targets = every[:, :, rows.targeted] - rows.targets.values
        if rows.aims_inside or len(rows.checked):
            first = slice(rows.latency, rows.latency + steps + rows.N)
            swept = sweep_rows(self._targets[:, first, rows.limited], rows.N + 1)
            self._tight = Interval(swept.low - rows.rounding, swept.high + rows.rounding)
            if rows.aims_inside:
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
    """Reads the limits of calls, which differ from the controller's own in bounds alone, by the rows of its plans."""

    def __init__(self, rows: BoundRows) -> None:
        self._rows = rows
        self._last: tuple[Limits, BoundsInTime] | None = None

    def read(self, limits: Limits) -> BoundsInTime:
        """Return the limits of a call."""
        if self._last is None or self._last[0] is not limits:
            rows = self._rows
            known = check_bounds_alone(limits, rows.track.limits, rows.states, rows.inputs)
            self._last = limits, rows.read(known, at_call=True)
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


_KEPT = 64  # plans that are kept; with weights of a day in hours all are found again after the first day


class PlansInTime:
    """Finds the plan of each step: made when its weights are met first, kept for steps with the same ones.

    A plan depends on the weights of all of its steps, through the Riccati recursion. What the set points and the end
    of the horizon are does not: these follow Q and R.

    Parameters
    ----------
    track, N, latency
        The cost with weights in time; steps of a plan; steps until its first input acts.
    base
        The plan of Q and R, for previews that hold nothing else.
    make
        Makes the plan of other weights.
    """

    def __init__(
        self,
        track: LiftedTracking,
        N: int,
        latency: int,
        base: CondensedPlan,
        make: Callable[[WeightRows], CondensedPlan],
    ) -> None:
        self._track, self._N, self._latency, self._make = track, N, latency, make
        Q, R = (np.tile(weight.diagonal(), (N, 1)) for weight in (track.Q, track.R))
        self._base = self._key(Q, R)
        self._plans = {self._base: base}

    @staticmethod
    def _key(Q: Float[np.ndarray, "N nr"], R: Float[np.ndarray, "N nu"]) -> bytes:
        return Q[1:].tobytes() + R.tobytes()  # the weight of the present state changes no plan

    def check_free_inputs(self) -> None:
        """Raise where a plan of some later step cannot be made: only rows of R that hold a zero may do that."""
        cost = self._track.cost
        steps = max(len(np.asarray(rows)) for rows in (cost.Q_rows, cost.R_rows) if rows is not None)
        Q, R = cost.weight_rows(len(self._track.Q), len(self._track.R), 0, steps + self._N)
        tried = set[bytes]()
        for k in range(steps):
            ahead = slice(k, k + self._N)
            key = self._key(Q[ahead], R[ahead])
            if R[ahead].min() <= 0 and key not in tried:
                tried.add(key)
                try:
                    self._find(k)
                except DefinitenessError as error:
                    raise DefinitenessError(
                        f"in the plan that begins at row {k} of Q_rows and R_rows {error}"
                    ) from None

    def at(self, k: int) -> CondensedPlan:
        """Return the plan of step k."""
        return self._find(k + self._latency)

    def _find(self, row: int) -> CondensedPlan:
        """Return the plan whose first input acts at this row of the weights."""
        track = self._track
        Q, R = track.cost.weight_rows(len(track.Q), len(track.R), row, self._N)
        key = self._key(Q, R)
        plan = self._plans.pop(key, None)
        if plan is None:
            plan = self._make(WeightRows(Q, R))
            while len(self._plans) >= _KEPT:
                oldest = next(key for key in self._plans if key != self._base)
                del self._plans[oldest]
        self._plans[key] = plan
        return plan
