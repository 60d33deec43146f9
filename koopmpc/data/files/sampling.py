"""Rows of a table as uniformly sampled episodes, cut at gaps in time and at missing values."""

import warnings
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc.base.errors import DataError, FitWarning
from koopmpc.data.episodes import Episode, Origin, find_lines
from koopmpc.data.files.columns import ColumnRoles
from koopmpc.data.files.notes import ResampledWarning

JITTER = 0.02  # a step of time may differ by this share from the sample time; beyond, sampling is unequal
GAP = 1.5  # a step of more than this many sample times is a gap, where an episode ends


class UnevenSamplingError(DataError):
    """Steps of time differ; `dt` is the sample time [s] to interpolate to."""

    def __init__(self, message: str, dt: float) -> None:
        super().__init__(message)
        self.dt = dt


@dataclass(frozen=True, eq=False)
class Signals:
    """Rows of one episode: time [s] or None, states, inputs, disturbances; `rows` are their numbers in the file.

    `states` are names, of a table alone; `origin` is where the rows of a resampled part come from.
    """

    time: Float[np.ndarray, " M"] | None
    X: Float[np.ndarray, "M nx"]
    U: Float[np.ndarray, "M nu"]
    W: Float[np.ndarray, "M nw"]
    rows: Int[np.ndarray, " M"]
    states: tuple[str, ...] = ()
    origin: Origin | None = None

    def at(self, which: slice | Bool[np.ndarray, " M"]) -> "Signals":
        """Return these rows."""
        time = None if self.time is None else self.time[which]
        return Signals(time, self.X[which], self.U[which], self.W[which], self.rows[which], self.states)


def read_clock(
    column: Float[np.ndarray, " M"],
    roles: ColumnRoles,
    where: str,
    years: tuple[float, float] = (946_684_800.0, 4_102_444_800.0),
) -> Float[np.ndarray, " M"]:
    """Return a column of time in seconds.

    Seconds whose size says that they are milli-, micro- or nanoseconds since 1970 are read in that unit, and a warning
    says so; `years` are the first and the last second of such logs since 1970 [s], 2000 to 2100.
    """
    known = np.abs(column[np.isfinite(column)])
    if roles.scale == 1.0 and len(known):
        for unit, per_second in (("ms", 1e3), ("us", 1e6), ("ns", 1e9)):
            if years[0] * per_second <= known.min() and known.max() < years[1] * per_second:
                warnings.warn(
                    f"{where}: {roles.time!r} is read in {unit} since 1970, which its size says; to say it, name the "
                    f"column 'time [{unit}]'",
                    FitWarning,
                    stacklevel=3,
                )
                return column / per_second
    return column * roles.scale


def sample_time(times: list[np.ndarray], where: str) -> float:
    """Return the median step of a time column, given part by part, to six digits."""
    steps = np.concatenate([np.zeros(0), *map(np.diff, times)])
    steps = steps[np.isfinite(steps) & (steps > 0)]
    if not len(steps):
        raise DataError(f"{where}: time does not advance in any two rows; sort the rows by time, or check that column")
    return float(f"{np.median(steps):.6g}")


def restarts(signals: Signals, where: str) -> list[Signals]:
    """Return the parts between steps back in time, where a recorder was restarted.

    A warning tells where the clock went back to another time than that of the first row: it was set, not started.
    """
    if signals.time is None:
        return [signals]
    steps = np.diff(signals.time)
    at = _edges(steps < 0)
    usual = np.median(np.abs(steps)) if len(steps) else 0.0
    set_back = [signals.rows[k] for k in at[1:-1] if abs(signals.time[k] - signals.time[0]) > 2 * usual]
    if set_back:
        shown = ", ".join(str(row) for row in set_back[:3]) + (", …" if len(set_back) > 3 else "")
        warnings.warn(
            f"{where}: the clock is set back {len(set_back)} times, before row {shown}; an episode ends there",
            FitWarning,
            stacklevel=2,
        )
    return [signals.at(slice(a, b)) for a, b in pairwise(at)]


def resample(parts: list[Signals], dt: float, where: str) -> list[Signals]:
    """Return the parts on the grid t₀, t₀ + dt, …: states are interpolated, inputs and disturbances held.

    Rows with a missing value are left out first. A step of more than 1.5 times both dt and the median step is a gap,
    where the signals are cut. A warning counts the gaps and the rows left out.
    """
    found: list[Signals] = []
    gaps: list[int] = []
    rows = kept = 0
    for part in parts:
        assert part.time is not None, "only a table with a time column is resampled"
        whole = part.at(np.isfinite(part.X).all(axis=1) & np.isfinite(part.time))
        assert whole.time is not None
        ahead = np.diff(whole.time)
        longest = GAP * max(dt, float(np.median(ahead))) if len(ahead) else dt
        at = _edges(ahead > longest)
        pieces = [_advancing(whole.at(slice(a, b))) for a, b in pairwise(at) if b - a > 1]
        gaps += [int(whole.rows[k - 1]) for k in at[1:-1]]
        rows += len(part.X)
        kept += sum(len(piece.X) for piece in pieces)
        found += [_on_grid(piece, dt, where) for piece in pieces]
    _warn_of_uneven(parts, dt, where)
    if gaps:
        why = "a gap is a step between complete rows of more than 1.5 times the usual one"
        _warn_of_gaps(where, gaps, len(parts), len(found), f"{rows - kept} of {rows} rows are lost; {why}")
    elif rows > kept:
        warnings.warn(
            f"{where}: {rows - kept} of {rows} rows have an empty cell or repeat a time; they were left out before "
            "resampling",
            FitWarning,
            stacklevel=2,
        )
    return found


def _warn_of_uneven(parts: list[Signals], dt: float, where: str) -> None:
    """Warn if steps differ from the median one, unless another step is wanted than that of the log.

    Gaps, and rows that are left out, have sentences of their own.
    """
    whole = [part.at(np.asarray(np.isfinite(part.X).all(axis=1), dtype=np.bool_)) for part in parts]
    steps = [np.diff(part.time) for part in whole if part.time is not None]
    known = np.concatenate([np.zeros(0), *steps])
    known = known[np.isfinite(known) & (known > 0)]
    if not len(known):
        return
    usual, uneven, first = float(f"{np.median(known):.6g}"), 0, ("", 0.0)
    if not usual / GAP <= dt <= GAP * usual:
        return
    for part, ahead in zip(whole, steps, strict=True):
        off = np.flatnonzero((ahead > 0) & (ahead <= GAP * usual) & (np.abs(ahead - usual) > JITTER * usual))
        if len(off) and not uneven:
            k = int(off[0])
            unit, (line,) = find_lines(where, [int(part.rows[k + 1])])
            first = f"{unit} {line}", float(f"{ahead[k]:.6g}")
        uneven += len(off)
    if uneven:
        counts = uneven, len(known)
        warnings.warn(ResampledWarning(where, counts, first, usual, dt), stacklevel=3)


def _warn_of_gaps(where: str, gaps: list[int], before: int, after: int, rest: str) -> None:
    unit, lines = find_lines(where, gaps[:3])
    shown = ", ".join(map(str, lines)) + (", …" if len(gaps) > 3 else "")
    count = f"{len(gaps)} gap{'s' * (len(gaps) != 1)}"
    at = f" (after {unit} {shown})" if gaps else ""
    warnings.warn(
        f"{where}: {count}{at} cut {before} episode{'s' * (before != 1)} into {after}; {rest}", FitWarning, stacklevel=3
    )


def _advancing(part: Signals) -> Signals:
    """Return the rows whose time is later than that of the row before."""
    assert part.time is not None
    return part.at(np.concatenate([[True], np.diff(part.time) > 0]))


def _on_grid(part: Signals, dt: float, where: str) -> Signals:
    t = part.time
    assert t is not None
    count = int(np.floor((t[-1] - t[0]) / dt * (1 + 1e-9))) + 1
    grid = t[0] + dt * np.arange(count)
    before = np.asarray(np.searchsorted(t, grid + 1e-9 * dt, side="right"), dtype=np.intp)
    held = np.clip(before - 1, 0, len(t) - 1)
    states, read = np.empty((count, part.X.shape[1])), held.copy()
    for i in range(part.X.shape[1]):
        wild = _single_readings(t, part.X[:, i])
        states[:, i] = np.interp(grid, t[~wild], part.X[~wild, i])
        k = np.flatnonzero(wild)
        at = np.searchsorted(grid[:-1] + 0.5 * dt, t[k])  # the nearest row
        kept = (t[k - 1] < grid[at]) & (grid[at] < t[k + 1])  # of many readings between rows, most are in none
        states[at[kept], i], read[at[kept]] = part.X[k[kept], i], k[kept]
    origin = Origin(where, part.states, part.rows, part.X, read, resampled=True) if part.states else None
    return Signals(grid, states, part.U[held], part.W[held], part.rows[held], part.states, origin)


def _single_readings(
    t: Float[np.ndarray, " m"], x: Float[np.ndarray, " m"], few: int = 10, far: float = 8.0
) -> Bool[np.ndarray, " m"]:
    """Return which readings would leak into rows of a grid; of fewer than `few` rows none.

    They are `far` times the usual distance from the line between their neighbours, half of the range, and alone there.
    """
    wild = np.zeros(len(x), dtype=bool)
    if len(x) < few:
        return wild
    line = x[:-2] + (x[2:] - x[:-2]) * (t[1:-1] - t[:-2]) / (t[2:] - t[:-2])
    off = np.abs(x[1:-1] - line)
    low, high = np.quantile(x, [0.05, 0.95])
    wide = (off > 0.5 * (high - low)) & (off > far * np.median(off)) & (high > low)
    beside = np.maximum(np.append(off[1:], 0.0), np.insert(off[:-1], 0, 0.0))
    wild[1:-1] = wide & (off > 1.5 * beside)
    return wild


def episodes_from(parts: list[Signals], dt: float, where: str) -> list[Episode]:
    """Return the episodes between gaps; a warning counts the gaps and the lost rows.

    A gap is a missing value, a step of time of more than 1.5 dt, or a row without a neighbour.
    """
    found: list[Episode] = []
    rows = kept = 0
    gaps: list[int] = []
    for part in parts:
        rows += len(part.X)
        origin = part.origin
        if origin is None and part.states:
            origin = Origin(where, part.states, part.rows, part.X, np.arange(len(part.X)), resampled=False)
        for first, last in _runs(part, dt, where, gaps):
            if last - first < 2:
                continue
            kept += last - first
            X, U, W = (values[first:last] for values in (part.X, part.U, part.W))
            found.append(Episode(X=X, U=U[:-1], W=W[:-1], origin=origin and origin.cut(first, last)))
    lost = rows - kept
    if not found:
        raise DataError(
            f"{where}: no two rows in sequence hold all states and inputs; a column may be empty, or named as an "
            "input by mistake"
        )
    if gaps or lost:
        _warn_of_gaps(where, gaps, len(parts), len(found), f"{lost} of {rows} rows are lost")
    return found


def _runs(part: Signals, dt: float, where: str, gaps: list[int]) -> list[tuple[int, int]]:
    """Return [first, last) of each stretch without a gap; append the file's rows before the gaps to `gaps`."""
    known = np.asarray(np.isfinite(part.X).all(axis=1), dtype=np.bool_)
    driven = np.asarray(np.isfinite(np.hstack([part.U, part.W])).all(axis=1), dtype=np.bool_)
    joined = known[:-1] & known[1:] & driven[:-1]  # row k leads to row k + 1
    if part.time is not None:
        steps = np.diff(part.time)
        joined = joined & np.isfinite(steps) & (steps <= GAP * dt)
        uneven = np.flatnonzero(joined & (np.abs(steps - dt) > JITTER * dt))
        if len(uneven):
            k = int(uneven[0])
            raise UnevenSamplingError(
                f"{where}: sampling is unequal: {len(uneven)} of {len(steps)} steps differ from dt = {dt:g} s by "
                f"more than 2 %, the first at row {part.rows[k]}, where it is {steps[k]:g} s; pass resample={dt:g} to "
                "interpolate",
                dt,
            )
    breaks = np.flatnonzero(~joined)
    first_of_each = breaks[np.diff(breaks, prepend=-2) > 1]
    gaps.extend(int(part.rows[k]) for k in first_of_each)
    return list(pairwise(_edges(~joined)))


def _edges(broken: Bool[np.ndarray, " steps"]) -> list[int]:
    """Return 0, the rows that do not follow the one before them, and the number of rows."""
    return [0, *(int(k) + 1 for k in np.flatnonzero(broken)), len(broken) + 1]
