"""The levels of on/off and stepped inputs, their dwell times, and how long each input has held its level."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.values import Value
from koopmpc.control.ask.bounds import Interval

LevelsByInput = Mapping[str, ArrayLike] | Sequence[ArrayLike | None]
DwellByInput = Mapping[str, Any] | Sequence[Any]

NEAR = 1e-6  # an input is on a level if it is nearer to it than this share of the spacing
_EVEN = 1e-9  # levels are evenly spaced if they differ by less than this share of the spacing
FREE = 1_000_000_000  # steps that an input is taken to have held its level at the start of a run


@dataclass(frozen=True, eq=False)
class InputLevels(Value):
    """u_i ∈ {first_i, first_i + spacing_i, …, first_i + (count_i − 1) spacing_i} for the inputs `which`.

    Attributes
    ----------
    which
        (n,) the inputs that have levels, from 0.
    first, spacing, count
        (n,) the lowest level, the distance to the next one, and how many there are.
    dwell
        (n, 2) least steps at the lowest level, and at each other one; 1 where an input may change in every step.
    steps
        Steps of the horizon in which the levels count; None for all.
    """

    which: Int[np.ndarray, " leveled"]
    first: Float[np.ndarray, " leveled"]
    spacing: Float[np.ndarray, " leveled"]
    count: Int[np.ndarray, " leveled"]
    dwell: Int[np.ndarray, "leveled 2"]
    steps: int | None

    def indices(self, u: Float[np.ndarray, "*rows nu"]) -> Float[np.ndarray, "*rows leveled"]:
        """Return where the inputs are between the levels: 0 for the lowest, 1 for the next, with fractions."""
        return (u[..., self.which] - self.first) / self.spacing

    def nearest(self, u: Float[np.ndarray, "*rows nu"]) -> Int[np.ndarray, "*rows leveled"]:
        """Return the index of the nearest level of each input."""
        return np.clip(np.rint(self.indices(u)), 0, self.count - 1).astype(np.intp)

    def values(self, index: Int[np.ndarray, "*rows leveled"]) -> Float[np.ndarray, "*rows leveled"]:
        """Return the levels of these indices."""
        return self.first + self.spacing * index

    def inside(self, box: Interval) -> "LevelBox":
        """Return the lowest and highest index of the levels inside limits of all inputs; crossed where none is."""
        return self.between(*(np.asarray(end)[..., self.which] for end in box))

    def between(self, low: Float[np.ndarray, "*rows leveled"], high: Float[np.ndarray, "*rows leveled"]) -> "LevelBox":
        """Return what `inside` does for limits of those inputs alone that have levels."""
        low, high = (np.clip((end - self.first) / self.spacing, -1.0, self.count) for end in (low, high))
        least, most = np.ceil(low - NEAR), np.floor(high + NEAR)
        return LevelBox(np.maximum(least, 0).astype(np.intp), np.minimum(most, self.count - 1).astype(np.intp))

    def refuse_missing(self, box: Interval, inputs: Sequence[str], why: str = "") -> None:
        """Raise where no level of an input is between its limits (steps, nu), and name the input and the step."""
        inside = self.inside(box)
        none = np.argwhere(inside.low > inside.high)
        if len(none):
            k, j = (int(v) for v in none[0])
            i = int(self.which[j])
            raise DataError(
                f"no level of {inputs[i]} is between its limits {box.low[k, i]:g} … {box.high[k, i]:g} at step {k}"
                f"{why}; pass wider limits, or other levels"
            )

    def least(self, index: Int[np.ndarray, "*rows leveled"]) -> Int[np.ndarray, "*rows leveled"]:
        """Return for how many steps each input has to hold the level of this index."""
        return np.where(index == 0, self.dwell[:, 0], self.dwell[:, 1])

    def count_broken(self, U: Float[np.ndarray, "T nu"]) -> tuple[int, int]:
        """Return how many values of a run are on no level, and how many changes came before their dwell time."""
        at, index = self.indices(U), self.nearest(U)
        off = int((np.abs(at - index) > NEAR).sum())
        early = 0
        for i in range(len(self.which)):
            changes = np.flatnonzero(np.diff(index[:, i])) + 1
            for begin, end in itertools.pairwise(changes):
                early += int(end - begin < self.dwell[i, int(index[begin, i] != 0)])
        return off, early


class HeldLevels:
    """Which level each input is at, and for how many steps: what dwell times count from."""

    def __init__(self, levels: InputLevels) -> None:
        self.levels = levels
        self.index = np.zeros(len(levels.which), np.intp)
        self.steps = np.full(len(levels.which), FREE)
        self._begins = True

    def reset(self, u: Float[np.ndarray, " nu"]) -> None:
        """Start at the input u, from which every input may change at once."""
        self.index, self._begins = self.levels.nearest(u), True
        self.steps = np.full(len(self.index), FREE)

    def take(self, u: Float[np.ndarray, " nu"]) -> None:
        """Count one step of the input u that acted."""
        index = self.levels.nearest(u)
        changed = (index != self.index) & (not self._begins)
        self.steps = np.where(changed, 1, np.minimum(self.steps + 1, FREE))
        self.index, self._begins = index, False

    def round(
        self,
        u: Float[np.ndarray, " nu"],
        reach: Interval | None = None,
        box: Interval | None = None,
    ) -> Float[np.ndarray, " nu"]:
        """Return the input with the nearest levels that dwell times, and the `reach` of rates, allow.

        Where the `box` of the inputs moves in time, it wins over dwell times and rates.
        """
        levels, index = self.levels, self.levels.nearest(u)
        if reach is not None:  # no change beyond a rate because of rounding
            least = np.ceil(levels.indices(reach.low) - NEAR)
            most = np.floor(levels.indices(reach.high) + NEAR)
            inside = (least <= most) & (least < levels.count) & (most >= 0)
            index = np.where(inside, np.clip(index, least, most), index).astype(np.intp)
        held = self.steps < levels.least(self.index)
        rounded, index = u.copy(), np.where(held, self.index, index)
        if box is not None:
            inside = levels.inside(box)
            index = np.clip(index, inside.low, inside.high)
        rounded[levels.which] = levels.values(index)
        return rounded

    def tighten(self, box: "LevelBox", blocks: Sequence[int]) -> bool:
        """Narrow the box of a plan's indices by the dwell times; return False where nothing is left."""
        levels = self.levels
        for i in range(len(levels.which)):
            if levels.dwell[i].max() < 2:
                continue
            level, steps, low, high = int(self.index[i]), int(self.steps[i]), box.low[:, i], box.high[:, i]
            for k in range(len(low)):
                if steps < levels.dwell[i, int(level != 0)]:
                    if not low[k] <= level <= high[k]:
                        return False
                    low[k] = high[k] = level
                if low[k] != high[k]:
                    break
                if low[k] != level:
                    level, steps = int(low[k]), 0
                steps += blocks[k]
        return True


class LevelBox(NamedTuple):
    """The lowest and the highest index of a level that each move of a plan may have."""

    low: Int[np.ndarray, "moves leveled"]
    high: Int[np.ndarray, "moves leveled"]


def _starts(blocks: Sequence[int]) -> Int[np.ndarray, " moves"]:
    """Return the first step of each block of moves."""
    return np.cumsum([0, *blocks[:-1]])


def leveled_moves(levels: InputLevels, blocks: Sequence[int]) -> int:
    """Return how many moves of a plan have levels."""
    return len(blocks) if levels.steps is None else int(np.searchsorted(_starts(blocks), levels.steps))


def _check_each(given: Any, what: str, advice: str, check: Callable[[Any, str], Any]) -> Any:
    """Return what is given by the name of an input, or for each input, every entry checked; None has no entry."""
    if isinstance(given, Mapping):
        return {str(name): check(entry, str(name)) for name, entry in cast("Mapping[str, Any]", given).items()}
    if not isinstance(given, Sequence) or isinstance(given, str):
        raise DataError(f"{what} is {given!r}; pass {advice}")
    entries = enumerate(cast("Sequence[Any]", given))
    return tuple(None if entry is None else check(entry, f"input {i}") for i, entry in entries)


def check_levels(levels: Any) -> Any:
    """Return levels with an array for each input, None where one has none: two, or evenly spaced ones in order."""
    if isinstance(levels, Mapping) and not levels:
        raise DataError('levels is {}; pass levels by the name of an input, for example {"pump": [0, 1]}')
    rows = cast("Sequence[Any]", levels) if isinstance(levels, Sequence) else ()
    if rows and all(isinstance(row, int | float) for row in rows):
        raise DataError(f"levels is {levels!r}; pass one list for each input, for example [[0, 1]]")
    advice = 'them by name, {"pump": [0, 1]}, or for each input, [[0, 1], None]'
    return _check_each(levels, "levels", advice, _check_values)


def _check_values(values: Any, name: str) -> Float[np.ndarray, " count"]:
    row = checks.array(values, f"levels of {name}", (None,))
    if len(row) < 2:
        raise DataError(f"the levels of {name} are {row.tolist()}; pass two or more, or limits for one fixed value")
    gaps = np.diff(row)
    if (gaps <= 0).any() or np.ptp(gaps) > _EVEN * float(gaps.max()):
        raise DataError(
            f"the levels of {name} are {row.tolist()}; pass two, or evenly spaced ones from the lowest to the highest"
        )
    return row


def check_dwell(dwell: Any) -> Any:
    """Return dwell times as (least steps at the lowest level, least steps at another) of each input."""
    return _check_each(dwell, "dwell", 'steps by name, {"pump": (3, 5)}: at least 3 on and 5 off', _check_pair)


def _check_pair(pair: Any, name: str) -> tuple[int, int]:
    """Return (on, off) of one input."""
    what = f"the dwell time of {name}"
    if isinstance(pair, Sequence | np.ndarray) and not isinstance(pair, str):
        parts = cast("Sequence[Any]", pair)
        if len(parts) != 2:
            raise ShapeError(f"{what} is {pair!r}; pass one number of steps, or (on, off)")
        return checks.count(parts[0], what), checks.count(parts[1], what)
    steps = checks.count(cast("Any", pair), what)
    return steps, steps


def build_levels(
    levels: Sequence[Any],
    dwell: Sequence[Any] | None,
    steps: int | None,
    low: Float[np.ndarray, " nu"],
    high: Float[np.ndarray, " nu"],
    rates: tuple[Float[np.ndarray, " nu"], Float[np.ndarray, " nu"]] | None,
) -> InputLevels | None:
    """Return the levels of nu inputs that are inside their limits; None where no input has any."""
    nu, times = len(low), [None] * len(low) if dwell is None else list(dwell)
    if len(levels) != nu or len(times) != nu:
        came = len(levels) if len(levels) != nu else len(times)
        raise ShapeError(f"levels and dwell have {came} entries, the plant {nu} inputs; pass one for each, or None")
    reach = np.full(nu, np.inf) if rates is None else np.minimum(rates[1], -rates[0])
    which = [i for i in range(nu) if levels[i] is not None]
    bare = next((i for i in range(nu) if levels[i] is None and times[i] is not None), None)
    if bare is not None:
        raise DataError(f"input {bare} has a dwell time and no levels; give it levels, for example [0, 1]")
    parts = [_allow_levels(i, np.asarray(levels[i]), times[i] or (1, 1), (low[i], high[i]), reach[i]) for i in which]
    if not parts:
        return None
    first, gaps, count, pairs = zip(*parts, strict=True)
    return InputLevels(np.array(which), np.array(first), np.array(gaps), np.array(count), np.array(pairs), steps)


def _allow_levels(
    i: int, row: Float[np.ndarray, " count"], dwell: tuple[int, int], ends: tuple[float, float], change: float
) -> tuple[float, float, int, tuple[int, int]]:
    """Return the lowest level of input i inside its limits, their spacing and number, and least steps (off, on)."""
    (low, high), (on, off), spacing = ends, dwell, float(row[1] - row[0])
    near = _EVEN * spacing
    allowed = row[(row >= low - near) & (row <= high + near)]
    if not len(allowed):
        raise DataError(
            f"no level of input {i}, {row.tolist()}, is between its limits {low:g} … {high:g};"
            " pass wider limits, or other levels"
        )
    if len(allowed) > 1 and spacing > change + near:
        raise DataError(
            f"a level of input {i} is {spacing:g} from the next one, and it may change by"
            f" {change:g} in a step; pass a du_max of the spacing or more"
        )
    if on != off and len(row) > 2:
        raise DataError(f"input {i} has {len(row)} levels and dwell times for on and off; pass one time for all")
    return float(allowed[0]), spacing, len(allowed), (off if allowed[0] == row[0] else on, on)
