"""CallWindows: the windows of the limits of a call, where only numbers differ from those of the last call."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from koopmpc.checks import HUGE
from koopmpc.control.limits import BOUNDS, Limits
from koopmpc.control.linear.plan import PlanMap
from koopmpc.control.linear.windows import LimitWindows, make_windows
from koopmpc.control.target import ROUNDING

_FREE = {end: np.array(np.inf if end.endswith("max") else -np.inf) for end in BOUNDS}


class CallWindows:
    """Writes the limits of a call into a table like that of `limit_windows`, or says that this cannot be done.

    Bounds that are by name, that cross, that are too short, or that limit what has no row are left to
    `limit_windows`, which says what is wrong; so are blocks of moves, levels, margins and terminal sets.
    """

    def __init__(self, plan: PlanMap, latency: int) -> None:
        track, targets = plan.track, plan.targets
        self._plan, self._latency, self._steps = plan, latency, sum(plan.blocks)
        self._rated, self._nu = track.rates is not None, len(track.inputs.low)
        layout, movable, limited = plan.layout, track.movable, plan.limited_targets
        simple = layout is not None and set(layout.used) == {1} and plan.held.sum() == 0
        planned = len(plan.blocks) * self._nu * (1 + self._rated) + self._steps * len(track.outputs.low)
        self.fits = bool(
            simple
            and plan.planned == planned
            and not track.margin.any()
            and track.limits.levels is None
            and movable.inputs.all()
            and (movable.rates.all() if self._rated else not movable.rates.any())
        )
        self._kept, self._none = np.flatnonzero(movable.outputs), np.flatnonzero(~movable.outputs)
        count, W, n = self._steps + latency + 1, 0 if layout is None else layout.width, len(movable.outputs)
        self._sides = np.zeros((count, 2, W))  # of the last call, infinite where there is no limit
        self._every = np.zeros((count, 2, n))
        self._written: dict[str, Any] = {}  # bounds that stand there
        self._limited: Int[np.ndarray, " nl"] = np.flatnonzero(limited)
        self._reach = ROUNDING * targets.size[limited]
        self._shift = targets.rows[limited] @ targets.offset
        size = np.abs(targets.rows[limited] @ targets.from_reference).sum(axis=1)
        self._moved = np.flatnonzero(size > 0)
        self._size = size[self._moved]

    def _hold(self, limits: Limits, end: str, n: int) -> Float[np.ndarray, "..."] | None:
        """Return the rows of a bound that a plan reads, or a vector that holds; None where it does not fit."""
        value: Any = getattr(limits, end)
        if value is None:
            return _FREE[end]
        if isinstance(value, Mapping) or (value.ndim and value.shape[-1] not in (1, n)):
            return None
        needed = self._steps + self._latency + (end[0] in "xy")
        if value.ndim < 2:
            return value
        rows: Float[np.ndarray, "rows n"] = value[: needed + 1]
        return None if len(rows) < needed else rows

    def make(self, limits: Limits) -> LimitWindows | None:
        """Return the windows of limits that have the fields of the controller's own, all but bounds; None if unsure."""
        plan, layout, nu, written = self._plan, self._plan.layout, self._nu, self._written
        assert layout is not None, "asked only where it fits"
        changed = [end for end in BOUNDS if end not in written or getattr(limits, end) is not written[end]]
        if "du_max" in changed and "du_min" not in changed:
            changed.append("du_min")  # which may be −du_max
        self._written = {}  # until all are written
        if not all(self._write(limits, end) for end in changed):
            return None
        sides, raw, tight, values = self._sides, layout.raw.first, layout.tight, plan.targets.values
        out, first = nu * (1 + self._rated), raw + layout.raw.width
        sides[:, :, raw : raw + nu] = sides[:, :, :nu]
        if len(self._kept):
            sides[:, :, out:raw] = self._every if not len(self._none) else self._every[:, :, self._kept]
            sides[:, :, raw + nu : first] = sides[:, :, out:raw]
        sides[:, :, raw:first] -= values
        if (sides[:, 0, :raw] > sides[:, 1, :raw]).any():
            return None
        if len(self._none) and np.isfinite(self._every[:, :, self._none]).any():
            return None
        shown = sides[:, :, raw + self._limited]
        ahead = shown[self._latency : self._latency + self._steps + 1]
        low, high = ahead[:, 0].max(axis=0) - self._reach, ahead[:, 1].min(axis=0) + self._reach
        end = tight.first + tight.width
        sides[:, 0, first : tight.first] = shown[:, 0] - self._reach - self._shift
        sides[:, 1, first : tight.first] = shown[:, 1] + self._reach - self._shift
        sides[:, 0, tight.first : end], sides[:, 1, tight.first : end] = low, high
        sides[:, 0, end:], sides[:, 1, end:] = -HUGE, HUGE
        self._written = {name: getattr(limits, name) for name in BOUNDS}
        endless, table = not bool(np.isfinite(sides[:, :, :raw]).all()), sides.reshape(len(sides), -1)
        table = np.clip(table, -HUGE, HUGE) if endless else table.copy()
        reach = self._find_reach(low - self._shift, high - self._shift) if plan.aims_inside else plan.single.reach
        return make_windows(plan, table, self._latency, 1, endless=endless, reaches=[reach], margin=None)

    def _write(self, limits: Limits, end: str) -> bool:
        """Write a bound where it stands; return whether it fits."""
        j, nu = int(end.endswith("max")), self._nu
        nx = len(self._plan.track.sizes.states)
        if end[0] == "u":
            return _write(self._sides[:, j, :nu], self._hold(limits, end, nu))
        if end[0] in "xy":
            place = self._every[:, j, :nx] if end[0] == "x" else self._every[:, j, nx:]
            return not place.shape[1] or _write(place, self._hold(limits, end, place.shape[1]))
        if not self._rated:
            return getattr(limits, end) is None
        rows = self._hold(limits, end, nu)
        if limits.du_min is None and rows is not None:
            mirrored = self._hold(limits, "du_max", nu)
            rows = None if mirrored is None else mirrored if j else np.asarray(-mirrored)
        return _write(self._sides[:, j, nu : 2 * nu], rows)

    def _find_reach(self, low: Float[np.ndarray, " nl"], high: Float[np.ndarray, " nl"]) -> float:
        """Return the least |r| for which a limit may move a target, as `find_reach` does."""
        room = np.minimum(high, -low)
        if len(self._moved) < len(room):
            if np.delete(room, self._moved).min() < 0:
                return -1.0
            room = room[self._moved]
        return min(float((room / self._size).min(initial=HUGE)), HUGE)


def _write(to: Float[np.ndarray, "count n"], rows: Float[np.ndarray, "..."] | None) -> bool:
    """Write a bound into its columns, the last row held; return whether it fits."""
    if rows is None:
        return False
    if rows.ndim == 2 and len(rows) < len(to):
        to[: len(rows)], to[len(rows) :] = rows, rows[-1]
    else:
        to[:] = rows[: len(to)] if rows.ndim == 2 else rows
    return True


def has_fields_of(limits: object, own: Limits) -> bool:
    """Return whether limits were made by `with_bounds` of these, or of others like them: all but bounds is the same."""
    if not isinstance(limits, Limits):
        return False
    return all(value is own.__dict__[name] for name, value in limits.__dict__.items() if name not in _FREE)
