"""MovingMap: the plan of a reference that moves, by one product; GivenShares: the part of a given u_target in it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.lib.stride_tricks import sliding_window_view

from koopmpc.checks import HUGE
from koopmpc.control.limits import Interval
from koopmpc.control.target import ROUNDING, Targets
from koopmpc.values import LINE, Viewing

_TABLE = 2**20  # entries of a table of GivenShares: 8 MB
_LARGEST = 2**23  # entries of a MovingMap: 64 MB


class PlanParts(NamedTuple):
    """The unconstrained plan v = F [z; u_{−1}; g] + f + F_r r, and what limits it.

    `box` holds the limits of v. There are no `targets` where none enters the plan. `limited` says which of their
    limited values have limits, or may get some in time, and `drive` is what [z; u_{−1}; g] adds to these. `buffer`
    begins with [z; u_{−1}; g; 1] of a step, and has room for a reference. A plan is `driven` where a
    known disturbance moves targets, too.
    """

    fixed: Float[np.ndarray, "nv n"]
    offset: Float[np.ndarray, " nv"]
    from_reference: Float[np.ndarray, "nv nR"]
    box: Interval
    targets: Targets | None
    limited: Bool[np.ndarray, " nl"]
    drive: Float[np.ndarray, "nk n"]
    driven: bool
    buffer: Float[np.ndarray, " n"]


class MovingMap(Viewing):
    """t = M [z; u_{−1}; g; 1; r_0; …], and after it the limited values of each row's target, K r_k.

    One product serves a reference that moves, and a small one its targets. Where low ≤ t ≤ high, the plan is the
    optimum, and no limit moves a target. For one row that is held over the horizon, M has one r, and K is part of it.
    Where no |r| is above `reach`, no limit can move a target, and the plan alone is computed.

    Attributes
    ----------
    buffer, known
        What M is multiplied by, at the begin of an array that others use too: the part before the rows is theirs. The
        rows have the views `rows`, `flat`, one after the other, and `raw`, their bytes.
    t, planned
        The product and the values of targets, and of these the plan.
    shape
        That of `rows`.
    met
        A byte for each limit, as in `PlanMap`.
    rows_of_plan
        The rows of M that are the plan's.
    matrix
        M. For a preview it has columns of zeros behind its own, so that each row fills whole lines of the cache: a
        product takes a quarter less time then. What they are multiplied by is 0, too.
    """

    _VIEWS = (
        *("met", "met_low", "met_high", "low", "high", "known", "start", "flat", "raw", "rows", "plan"),
        *("planned", "tests", "rows_of_plan"),
    )

    def __init__(self, parts: PlanParts, nr: int, *, held: bool) -> None:
        fixed, shares, targets, limited = parts.fixed, parts.from_reference, parts.targets, parts.limited
        n = len(fixed)
        if held:
            shares = shares.reshape(n, -1, nr).sum(axis=1)
        steps = shares.shape[1] // nr
        wide = 0 if held else -(fixed.shape[1] + 1 + shares.shape[1]) % LINE
        matrix = np.column_stack([fixed, parts.offset, shares, np.zeros((n, wide))])
        low, high = [parts.box.low], [parts.box.high]
        self.from_row = np.zeros((nr, 0))  # K, transposed, where it is not part of M
        self.drive: Float[np.ndarray, "nt n"] | None = None  # what a known disturbance adds to K r
        self.reach = HUGE  # least |r| for which a limit may move a target
        if targets is not None:
            K, drive = targets.rows[limited] @ targets.from_reference, parts.drive
            shift, rounding = targets.rows[limited] @ targets.offset, ROUNDING * targets.size[limited]
            low_end = np.maximum(targets.low[limited] - rounding, -HUGE)
            high_end = np.minimum(targets.high[limited] + rounding, HUGE)
            found = find_reach(K, (low_end - shift)[None], (high_end - shift)[None])
            self.reach = -1.0 if parts.driven else float(found[0])
            if held:
                matrix, shift = np.vstack([matrix, np.column_stack([drive, shift, K])]), 0.0 * shift
            else:
                self.from_row = np.ascontiguousarray(K.T)
                self.drive = np.column_stack([drive, 0.0 * shift]) if drive.any() else None
            low.append(np.tile(low_end - shift, steps))
            high.append(np.tile(high_end - shift, steps))
        self.matrix, self.limits = np.ascontiguousarray(matrix), np.concatenate([*low, *high])
        self.t, self.buffer = np.zeros(len(self.limits) // 2), parts.buffer
        self._first, self.shape, self._n = fixed.shape[1] + 1, (steps, nr), n
        self._see()

    def _see(self) -> None:
        """Make the views; see `Viewing`."""
        first = self._first
        self.matrix = _align(self.matrix)
        count, rows = len(self.t), len(self.matrix)
        self.low, self.high = self.limits[:count], self.limits[count:]
        self.met = bytearray(2 * count)
        met = np.frombuffer(self.met, dtype=np.bool_)
        self.met_low, self.met_high = met[:count], met[count:]
        self.known = self.buffer[: self.matrix.shape[1]]
        self.start, self.flat = self.known[:first], self.known[first : first + self.shape[0] * self.shape[1]]
        self.raw = self.flat.data.cast("B")
        self.rows_of_plan = self.matrix[: self._n]
        self.rows, self.planned = self.flat.reshape(self.shape), self.t[: self._n]
        self.plan, self.tests = self.t[:rows], self.t[rows:].reshape(self.shape[0], -1)

    def multiply(self) -> Float[np.ndarray, " nt"]:
        """Return t of a step."""
        self.matrix.dot(self.known, self.plan)
        if self.tests.size:
            self.rows.dot(self.from_row, self.tests)
            if self.drive is not None:
                self.tests += self.drive.dot(self.start)
        return self.t

    @staticmethod
    def of(parts: PlanParts, nr: int) -> "tuple[MovingMap | None, MovingMap]":
        """Return the maps of a preview and of a row that is held; None for one that would be too large."""
        (n, start), reads = parts.fixed.shape, parts.from_reference.shape[1]
        large = n * (start + 1 + reads) > _LARGEST
        return None if large else MovingMap(parts, nr, held=False), MovingMap(parts, nr, held=True)


def _align(matrix: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
    """Return the matrix where it begins with a line of the cache, else a copy that does."""
    if matrix.ctypes.data % (8 * LINE) == 0:
        return matrix
    room = np.empty(matrix.size + LINE)
    first = -room.ctypes.data % (8 * LINE) // 8
    aligned = room[first : first + matrix.size].reshape(matrix.shape)
    aligned[:] = matrix
    return aligned


def find_reach(
    K: Float[np.ndarray, "nl nr"], low: Float[np.ndarray, "T nl"], high: Float[np.ndarray, "T nl"]
) -> Float[np.ndarray, " T"]:
    """Return the largest a for which low ≤ K r ≤ high wherever no |r_i| is above a; below 0 where there is none."""
    room, size = np.minimum(high, -low), np.abs(K).sum(axis=1)
    moved = size > 0
    reach = np.where(moved, room / np.where(moved, size, 1.0), np.where(room >= 0, HUGE, -1.0))
    return np.minimum(reach.min(axis=-1, initial=HUGE), HUGE)


class GivenShares:
    """The part of a plan that rows of a given u_target have, F (u_k, …, u_{k+N}), in step after step.

    Parameters
    ----------
    from_given
        F.
    rows
        The rows of u_target, the last one repeated N times.

    Attributes
    ----------
    table
        These parts, a row a step; None where they would take too much memory.
    last
        The row from which on all parts are the same.
    """

    def __init__(self, from_given: Float[np.ndarray, "nv Nnu"], rows: Float[np.ndarray, "T nu"]) -> None:
        N = from_given.shape[1] // rows.shape[1] - 1
        self._from_given, self._rows, self.last = from_given, rows, len(rows) - N - 1
        self.table: Float[np.ndarray, "T nv"] | None = None
        if (self.last + 1) * len(from_given) <= _TABLE:
            windows = sliding_window_view(rows, N + 1, axis=0).transpose(0, 2, 1)
            self.table = windows.reshape(self.last + 1, -1) @ from_given.T

    def at(self, k: int) -> Float[np.ndarray, " nv"]:
        """Return the share of the preview that begins with row k."""
        if k > self.last:
            k = self.last
        if self.table is not None:
            return self.table[k]
        N = len(self._rows) - self.last - 1
        return self._from_given @ self._rows[k : k + N + 1].reshape(-1)
