"""audit: all checks of logs in one call, and their report."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from koopmpc.data.episodes import Episode, Episodes, episodes_of
from koopmpc.errors import DataError
from koopmpc.validate.logs.alignment import ending, jumps, late
from koopmpc.validate.logs.changes import midway
from koopmpc.validate.logs.clocks import clock_faults
from koopmpc.validate.logs.inputs import constant, excitation, feedback, together, without_effect
from koopmpc.validate.logs.log import Log, LogFault, Place, runs
from koopmpc.validate.logs.values import (
    coarse,
    held,
    outliers,
    quantised,
    repeated_columns,
    repeated_episodes,
    saturated,
    slow,
    slow_states,
    stuck,
    turns,
    wrapped,
)
from koopmpc.validate.text import labelled, written
from koopmpc.values import Value

Check = Callable[[Log], Iterator[LogFault]]
_VALUES: tuple[Check, ...] = (
    repeated_columns,
    repeated_episodes,
    quantised,
    slow,
    wrapped,
    stuck,
    saturated,
    held,
    outliers,
)
_INPUTS: tuple[Check, ...] = (constant, together, excitation, feedback)
_MOST = 200_000  # steps that are looked at


@dataclass(frozen=True, eq=False)
class AuditReport(Value):
    """The faults of logs; `print` shows each with what to do about it.

    Attributes
    ----------
    faults
        The faults that were found.
    episodes, steps
        How many episodes and steps were looked at.
    """

    faults: tuple[LogFault, ...]
    episodes: int
    steps: int

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of the faults, in the order of the report."""
        return tuple(dict.fromkeys(fault.name for fault in self.faults))

    @property
    def delay(self) -> int:
        """Steps of the past that a model needs for the signals that are late; 0 where none is."""
        return max((fault.steps for fault in self.faults), default=0)

    def without_faults(self, data: Episodes) -> Episodes:
        """Return the data without the rows at fault: episodes are cut there, and pieces of one row are dropped.

        Raises
        ------
        DataError
            Nothing would be left.
        """
        rest = Remainder.of(data).without([place for fault in self.faults for place in fault.places])
        if rest is None:
            raise DataError("every row of the data is at fault; see the report for what to do")
        return rest.data

    def __str__(self) -> str:
        """Return the report: a verdict, then each fault with what to do."""
        looked = f"{self.episodes} episode{'s' * (self.episodes > 1)}, {self.steps} steps"
        if not self.faults:
            return f"no fault found in {looked}"
        count = len(self.faults)
        pairs = [(fault.name, f"{fault.says}. {fault.do[0].upper()}{fault.do[1:]}.") for fault in self.faults]
        return written(f"{count} fault{'s' * (count > 1)} found in {looked}", labelled(pairs))


def audit(data: Episodes, *, times: Sequence[ArrayLike] | None = None) -> AuditReport:
    """Look for faults of recorders, sensors and actuators in logs, before a model is fitted to them.

    Values: a live sensor never repeats a number. Repeated numbers show a sensor that is stuck, at its limit, coarse or
    slow; samples that were held or lost; rows or episodes that stand twice. Inputs: some do not move, move together,
    have no effect, excite too little, or follow from the state. Alignment: a one-step regression on the present row
    predicts better once a late input or sensor is put where it belongs, or an input is clipped where its actuator
    ends. Changes: an episode follows the law of the others once a sign, unit, offset, order of columns or sample time
    is corrected. Rows that single values show to be at fault are cut out before the regressions.

    Parameters
    ----------
    data
        The episodes; of more than 200,000 steps the first 200,000 are looked at.
    times
        (T+1,) time stamps [s] of the rows of each episode, for jitter and resets of the clock; without them the clock
        is not looked at. `load_episodes` cuts at resets, and refuses steps that differ by more than 2 %.

    Raises
    ------
    DataError
        The data are no Episodes, or the times do not fit them.
    """
    data = _first(episodes_of(data))
    faults = [] if times is None else list(clock_faults(data, times))
    log = Log(data)
    for check in (*_VALUES, *(_INPUTS if data.nu else ())):
        faults += check(log)
    kinds = {fault.name for fault in faults}
    whole = Remainder.of(_unwrapped(data, turns(log)))
    rest = whole.without([p for fault in faults for p in fault.places])
    for check in (without_effect, midway, jumps):
        if rest is None or (check is without_effect and kinds & {"feedback", "inputs together"}):
            continue
        found = [rest.original(fault) for fault in check(Log(rest.data))]
        faults += found
        rest = whole.without([p for fault in faults for p in fault.places]) if found else rest
    rough = bool(coarse(log) or slow_states(log))
    if rest is not None and not rough and "inputs together" not in kinds:
        lags = list(late(Log(rest.data)))
        faults += lags or list(ending(Log(rest.data)))
    return AuditReport(tuple(faults), len(data), sum(map(len, data)))


def _first(data: Episodes) -> Episodes:
    """Return the first episodes, up to the steps that are looked at."""
    ends = np.cumsum([len(episode) for episode in data])
    return data[: max(int(np.searchsorted(ends, _MOST, side="right")), 1)]


def _unwrapped(data: Episodes, whole_turns: dict[int, float]) -> Episodes:
    """Return the episodes with these states continued beyond each turn."""
    if not whole_turns:
        return data
    made: list[Episode] = []
    for episode in data:
        X = episode.X.copy()
        for i, turn in whole_turns.items():
            X[:, i] = np.unwrap(X[:, i], period=turn)
        made.append(Episode(X=X, U=episode.U, W=episode.W))
    return data.with_episodes(made)


@dataclass(frozen=True, eq=False)
class Remainder:
    """The pieces that are left of episodes once rows are cut out, and where each piece was."""

    data: Episodes
    origins: tuple[Place, ...]

    @classmethod
    def of(cls, data: Episodes) -> "Remainder":
        """Return the data as they are, nothing cut out."""
        return cls(data, tuple(Place(e, 0, len(episode) + 1) for e, episode in enumerate(data)))

    def without(self, places: Sequence[Place]) -> "Remainder | None":
        """Return the pieces of two rows or more that are left without these rows; None where there is none."""
        pieces: list[Episode] = []
        origins: list[Place] = []
        for e, episode in enumerate(self.data):
            good = np.ones(len(episode) + 1, dtype=np.bool_)
            joined = np.ones(len(episode), dtype=np.bool_)
            for place in places:
                if place.episode != e:
                    continue
                if place.jump:
                    joined[place.first] = False
                else:
                    good[place.first : place.last] = False
            for a, b in _pieces(good, joined):
                pieces.append(Episode(X=episode.X[a:b], U=episode.U[a : b - 1], W=episode.W[a : b - 1]))
                origins.append(Place(e, a, b))
        return Remainder(self.data.with_episodes(pieces), tuple(origins)) if pieces else None

    def original(self, fault: LogFault) -> LogFault:
        """Return the fault with its places in the original data."""
        moved = [
            Place(self.origins[p.episode].episode, p.first + first, p.last + first, p.jump)
            for p in fault.places
            for first in (self.origins[p.episode].first,)
        ]
        return replace(fault, places=tuple(moved))


def _pieces(good: np.ndarray, joined: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield [first, last) of the stretches of good rows that are joined, of two rows or more."""
    linked = good[:-1] & good[1:] & joined
    for a, b in runs(linked):
        yield int(a), int(b) + 1
