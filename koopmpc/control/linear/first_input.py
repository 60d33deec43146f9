"""FirstInput: the first input of a long preview alone, where a bound shows that its plan meets all limits."""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg.blas import ddot, idamax

from koopmpc.checks import HUGE
from koopmpc.control.limits import Interval
from koopmpc.control.linear.moving import GivenShares
from koopmpc.control.linear.plan import PlanMap
from koopmpc.control.linear.windows import LimitWindows
from koopmpc.values import Viewing

_PAGE = 512  # steps whose room is found at once, which takes 0.05 ms
_WAIT = 1023  # most steps until the bound is tried again
_MANY = 63  # steps until then, from which on limits and c are taken again, which takes 0.1 ms
_FAR = 4.0  # a row with one limit gets the other one so many times as far from its value
_MARGIN = 1e-12  # share of the room that is left for rounding
_WHOLE = 1 - _MARGIN
_NEAR = 0.1  # rows that take less of the room are measured from 0
_WORTH = 0.7  # and so are those that are nearer to no other row by this factor
_subtract = np.subtract


class FirstInput(Viewing):
    """The first input of t = M [z; …; 1] + F r for rows r of a preview, where all of t meets its limits.

    For a held row c, t = M [z; …; 1] + F c + F (r − c), and entry i of the last part is at most ‖F_i‖₁ max|r − c|.
    Entries are measured from the middle of their limits, in half of the distance between these. With q for the plan of
    c, and s for the largest ‖F_i‖₁, no |t_i| is above max|q| + s max|r − c|. Where that is below the room of the step,
    which is 1 for the limits that were measured, all limits are met. Then F is multiplied for the first input alone,
    and the plan is computed when it is asked for.

    Where the bound fails, it is tried again later, each time twice as late. At first and at last it takes the limits
    and c of that step.
    """

    _VIEWS = ("known", "start", "flat", "raw", "kept_raw", "firsts", "first")

    def __init__(self, plan: PlanMap, nu: int, *, in_time: bool) -> None:
        moving = plan.moving
        assert moving is not None, "else it is not asked for"
        (count, width), (steps, nr) = moving.rows_of_plan.shape, moving.shape
        self._first, self._nu, self._moving = plan.matrix.shape[1], nu, moving
        self._plan, self._in_time = plan, in_time
        shares = self._get_shares()
        self._held = shares.reshape(count, steps, nr).sum(axis=1)
        self._sizes = np.abs(shares).sum(axis=1)
        self._matrix = np.zeros((count, self._first), order="F")
        self._q, self.inputs = np.zeros(count), np.zeros(nu)
        self._centre, self._apart, self._kept = np.zeros(steps * nr), np.zeros(steps * nr), np.zeros(width)
        self._kept_given = 0
        self._rooms: list[float] = []
        self._taken: list[float] = []
        self._of_first: Float[np.ndarray, "steps nu"] = np.zeros((0, nu))
        self._first_room = self._first_taken = self._at = 0
        self._is_first = False
        self._see()
        self.forget()

    def _see(self) -> None:
        """Make the views; see `Viewing`."""
        moving = self._moving
        self.known, self.start, self.flat = moving.known, moving.start, moving.flat
        self.raw, self.kept_raw = self.known.data.cast("B"), self._kept.data.cast("B")
        self.firsts, self.first = moving.rows_of_plan[: self._nu], moving.rows_of_plan[0]

    def _get_shares(self) -> Float[np.ndarray, "nv nR"]:
        steps, nr = self._moving.shape
        return self._moving.rows_of_plan[:, self._first : self._first + steps * nr]

    def forget(self) -> None:
        """Go on from limits and c as they were taken first, as every run does."""
        self._waits = self._wait = 0
        if self._is_first:
            self._aimed = True  # a miss of the last run may have ended it
            return
        (low, high), (_, nr) = np.split(self._plan.limits, 2), self._moving.shape
        self._aimed = self._is_first = self._measure(Interval(low, high), 0 * low)
        self._centred = False
        if self._aimed:
            self._write(np.zeros(nr))

    def find(
        self, peak: float, window: LimitWindows | None, step: int, given_row: int
    ) -> Float[np.ndarray, " nu"] | None:
        """Return `inputs`, the first input of the plan for the rows in the buffer; None where the bound fails.

        Parameters
        ----------
        peak
            The largest |r|.
        window, step
            Limits in time, and the row of this step; None where limits hold.
        given_row
            The row of a given u_target that belongs to the plan's first input.
        """
        if self._waits or not self._aimed:
            self._waits -= 1
            if self._waits >= 0:
                return None
            self._waits = 0
            if not self._aimed and not self._aim(peak, window, step):
                return self._miss(_WAIT)
        room, given = _WHOLE, self._plan.given
        if window is not None:
            k = step - self._first_room
            room = self._rooms[k] if 0 <= k < len(self._rooms) else self._fill_rooms(window, step)
        if given is not None:
            room -= self._take_given(given, given_row)
        if self._centred:
            apart = _subtract(self.flat, self._centre, self._apart)
            peak = abs(apart.item(idamax(apart)))
        q, inputs = self._q, self.inputs
        self._matrix.dot(self.start, q)
        if not abs(q.item(idamax(q))) + self._share * peak < room:
            return self._miss(2 * self._wait + 1)
        if self._nu == 1:
            value = ddot(self.first, self.known)
            if not abs(value - self._middle_of_first) * self._inverse_of_first < room:  # NaN is not
                return None
            inputs[0] = value if given is None else value + self._of_first.item(self._at)
        else:
            values = self.firsts.dot(self.known)
            if not (np.abs(values - self._middle[: self._nu]) * self._inverse[: self._nu] < room).all():
                return None
            inputs[:] = values if given is None else values + self._of_first[self._at]
        self._wait = 0
        self.kept_raw[:], self._kept_given = self.raw, given_row
        return inputs

    def _take_given(self, given: GivenShares, row: int) -> float:
        """Return how much of the room the shares of a given u_target take, and note where they stand."""
        if row > given.last:
            row = given.last
        k = row - self._first_taken
        taken = self._taken[k] if 0 <= k < len(self._taken) else self._fill_taken(given, row)
        self._at = row - self._first_taken
        return taken

    def write_plan(self, plan: Float[np.ndarray, " nv"]) -> None:
        """Write the plan of the last input that was found."""
        self._moving.rows_of_plan.dot(self._kept, plan)
        if self._plan.given is not None:
            plan += self._plan.given.at(self._kept_given)
        plan[: self._nu] = self.inputs

    def _miss(self, wait: int) -> None:
        """Let some steps pass until the bound is tried again."""
        self._waits = self._wait = min(wait, _WAIT)
        self._aimed = self._aimed and not self._is_first and wait < _MANY

    def _aim(self, peak: float, window: LimitWindows | None, step: int) -> bool:
        """Take limits and c of this step; return whether there is room between the limits."""
        self._is_first, plan = False, self._plan
        if window is not None:
            window.plan_pages.turn(plan, step)
        if not self._measure(Interval(plan.low, plan.high), self._moving.rows_of_plan.dot(self.known)):
            return False
        rows = self.flat.reshape(self._moving.shape)
        c = (rows.max(axis=0) + rows.min(axis=0)) / 2
        self._centred = bool(self._share * peak > _NEAR and np.abs(rows - c).max() < _WORTH * peak)
        self._write(c if self._centred else 0.0 * c)
        self._aimed = True
        return True

    def _measure(self, box: Interval, t: Float[np.ndarray, " nv"]) -> bool:
        """Measure the room between the limits, where one is open by a plan t; return whether there is some."""
        low, high = _tighten(self._plan, box, self._nu) if self._in_time else box
        below, above = low > -HUGE, high < HUGE
        limited, end = below | above, np.where(below, low, high)
        reach = _FAR * np.maximum(np.abs(end), np.abs(t - end))
        low, high = np.where(below, low, end - reach), np.where(above, high, end + reach)
        half = np.where(limited, (high - low) / 2, 1.0)
        if not (half > 0).all():
            return False
        self._limited, self._middle = limited, np.where(limited, (low + high) / 2, 0.0)
        self._inverse = np.where(limited, 1 / half, 0.0)
        self._share = float((self._sizes * self._inverse).max())
        self._rooms, self._taken = [], []
        return True

    def _write(self, c: Float[np.ndarray, " nr"]) -> None:
        """Write the matrices that measure a plan near that of the held row c."""
        middle, inverse = self._middle, self._inverse
        self._centre[:] = np.tile(c, self._moving.shape[0])
        matrix = self._moving.rows_of_plan[:, : self._first] * inverse[:, None]
        matrix[:, -1] += (self._held @ c - middle) * inverse
        self._matrix[:] = matrix
        self._middle_of_first, self._inverse_of_first = float(middle[0]), float(inverse[0])

    def _fill_rooms(self, window: LimitWindows, k: int) -> float:
        """Find the room of steps from k on, and return that of step k."""
        steps = min(_PAGE, window.last + 1 - k)
        low, high = window.find_rows(k, steps)
        which = _first_of_each(window.plan, self._nu)
        middle, inverse, limited = self._middle[which], self._inverse[which], self._limited[which]
        room = np.minimum(high - middle, middle - low) * inverse
        free: Bool[np.ndarray, "rows n"] = (low <= -HUGE) & (high >= HUGE)
        least = np.where(limited, room, np.where(free, 1.0, -1.0)).min(axis=1)
        length, ahead = 1, len(least) - steps + 1
        while length < ahead:  # the least over twice as many rows
            by = min(length, ahead - length)
            least, length = np.minimum(least[: len(least) - by], least[by:]), length + by
        self._rooms, self._first_room = (np.minimum(least, 1.0) - _MARGIN).tolist(), k
        return self._rooms[0]

    def _fill_taken(self, given: GivenShares, k: int) -> float:
        """Find how much of the room the shares of a given u_target take from row k on, and return that of row k."""
        assert given.table is not None, "else it is not asked for"
        rows = given.table[k : k + _PAGE]
        self._taken = (np.abs(rows) * self._inverse).max(axis=1).tolist()
        self._of_first = rows[:, : self._nu].copy()
        self._first_taken = k
        return self._taken[0]


def _first_of_each(plan: PlanMap, nu: int) -> Int[np.ndarray, " n"]:
    """Return where each input, rate and output first stands in a plan."""
    moves, rated = plan.moves, plan.track.rates is not None
    first = np.arange(nu * (1 + rated))
    first[nu:] += moves - nu
    start = moves * (1 + rated)
    return np.concatenate([first, start + np.arange(len(plan.track.outputs.low))])


def _tighten(plan: PlanMap, box: Interval, nu: int) -> Interval:
    """Return the tightest limits of each signal over the plan, for all of its steps."""
    low, high, outs = box.low.copy(), box.high.copy(), len(plan.track.outputs.low)
    moves, start = plan.moves, plan.moves * (1 + (plan.track.rates is not None))
    parts = [(slice(0, moves), nu), (slice(moves, start), nu), (slice(start, start + sum(plan.blocks) * outs), outs)]
    for part, width in parts:
        if part.stop > part.start:
            for end, tightest in ((low, np.max), (high, np.min)):
                rows = end[part].reshape(-1, width)
                rows[:] = tightest(rows, axis=0)
    return Interval(low, high)
