"""audit: all checks of logs in one call, what the time stamps of rows show, and the report."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.episodes import Episode, Episodes, episodes_of
from koopmpc.errors import DataError
from koopmpc.validate.logs import values
from koopmpc.validate.logs.alignment import ending, feedback, late, together, without_effect
from koopmpc.validate.logs.changes import midway
from koopmpc.validate.logs.log import Log, LogFault, Place, listed, runs
from koopmpc.validate.text import labelled, percent, written
from koopmpc.values import Value

Check = Callable[[Log], Iterator[LogFault]]
_VALUES: tuple[Check, ...] = (
    values.repeated_columns,
    values.repeated_episodes,
    values.quantised,
    values.slow,
    values.wrapped,
    values.stuck,
    values.saturated,
    values.held,
    values.outliers,
)
_INPUTS: tuple[Check, ...] = (values.constant, together, values.excitation, feedback)
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
    whole = Remainder.of(_unwrapped(data, values.turns(log)))
    rest = whole.without([p for fault in faults for p in fault.places])
    for check in (without_effect, midway, values.jumps):
        if rest is None or (check is without_effect and kinds & {"feedback", "inputs together"}):
            continue
        found = [rest.original(fault) for fault in check(Log(rest.data))]
        faults += found
        rest = whole.without([p for fault in faults for p in fault.places]) if found else rest
    rough = bool(values.coarse(log) or values.slow_states(log))
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
            for a, b in runs(good[:-1] & good[1:] & joined):
                pieces.append(Episode(X=episode.X[a : b + 1], U=episode.U[a:b], W=episode.W[a:b]))
                origins.append(Place(e, a, b + 1))
        return Remainder(self.data.with_episodes(pieces), tuple(origins)) if pieces else None

    def original(self, fault: LogFault) -> LogFault:
        """Return the fault with its places in the original data."""
        moved: list[Place] = []
        for place in fault.places:
            piece = self.origins[place.episode]
            moved.append(Place(piece.episode, place.first + piece.first, place.last + piece.first, place.jump))
        return replace(fault, places=tuple(moved))


_JITTER = 0.02  # share of dt by which a step may differ, as in load_episodes
_GAP = 1.5  # a step longer than 1.5 dt is a gap
_OTHER = 0.1  # share of dt by which the median step of an episode must differ to be another rate


def clock_faults(data: Episodes, times: Sequence[ArrayLike]) -> Iterator[LogFault]:
    """Find the faults that the time stamps of the rows show.

    Raises
    ------
    DataError
        There are not as many time stamps as rows.
    """
    if len(times) != len(data):
        raise DataError(f"times are given for {len(times)} episodes, the data have {len(data)}; pass one array each")
    steps = [
        np.diff(checks.vector(own, f"times of episode {e}", len(episode) + 1))
        for e, (own, episode) in enumerate(zip(times, data, strict=True))
    ]
    every = np.concatenate(steps)
    forward = every[every > 0]
    if not len(forward):
        raise DataError("the times never advance; pass the time of each row in seconds")
    dt = float(np.median(forward))
    resets = _places(steps, lambda d: d <= 0)
    if resets:
        yield LogFault(
            "clock reset",
            f"the clock goes back or stands still {len(resets)} times: {listed(resets)}",
            "cut the episodes there: load_episodes does where it goes back",
            places=resets,
        )
    gaps = _places(steps, lambda d: d > _GAP * dt)
    other = [e for e, d in enumerate(steps) if abs(np.median(d) - dt) > _OTHER * dt]
    if other:
        shown = ", ".join(f"episode {e} {np.median(steps[e]):.4g} s" for e in other[:3])
        yield LogFault(
            "mixed sampling",
            f"{len(other)} of {len(data)} episodes have another step than {dt:.4g} s: {shown}",
            f"bring them to one step: load_episodes(…, resample={dt:.4g})",
            places=tuple(Place(e, 0, len(steps[e]) + 1) for e in other),
        )
    gaps = tuple(p for p in gaps if p.episode not in other)
    if gaps:
        yield LogFault(
            "jump",
            f"rows are missing {len(gaps)} times, by the clock: {listed(gaps)}",
            "cut the episodes there: load_episodes does",
            places=gaps,
        )
    usual = [d for e, d in enumerate(steps) if e not in other]
    usual = np.concatenate(usual) if usual else np.zeros(0)
    usual = usual[(usual > 0) & (usual <= _GAP * dt)]
    uneven = np.abs(usual - dt) > _JITTER * dt
    if uneven.any():
        yield LogFault(
            "jitter",
            f"{percent(float(uneven.mean()))} of the steps differ from {dt:.4g} s by more than 2 %, from "
            f"{usual.min():.4g} to {usual.max():.4g} s",
            f"interpolate to equal steps: load_episodes(…, resample={dt:.4g})",
        )


def _places(steps: list[Float[np.ndarray, " T"]], found: Callable[[np.ndarray], np.ndarray]) -> tuple[Place, ...]:
    return tuple(Place(e, k, k + 2, jump=True) for e, d in enumerate(steps) for k in np.flatnonzero(found(d)).tolist())
