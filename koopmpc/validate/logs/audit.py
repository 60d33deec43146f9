"""`audit` runs all checks of logs, checks the time stamps of their rows, and reports the faults."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.base.terminal import label_lines, render_text
from koopmpc.base.text import to_percent
from koopmpc.base.values import Value
from koopmpc.data.episodes import Episode, Episodes, episodes_of
from koopmpc.data.files.sampling import GAP, JITTER
from koopmpc.lifting.base import strip_unit
from koopmpc.validate.closed_loop import find_feedback
from koopmpc.validate.drift import DriftReport, find_drift
from koopmpc.validate.logs import values
from koopmpc.validate.logs.alignment import (
    find_dependent_inputs,
    find_inputs_without_effect,
    find_late_signals,
    find_saturated_actuators,
)
from koopmpc.validate.logs.changes import find_changes
from koopmpc.validate.logs.log import (
    CHECKS,
    Check,
    Log,
    LogFault,
    Place,
    Repair,
    find_stretches,
    list_places,
    register_check,
)
from koopmpc.validate.logs.timing import InputTiming, Timing, find_same_row_inputs, measure_timing
from koopmpc.validate.memory import Memory, find_hidden_state
from koopmpc.validate.sufficiency import persistency


def find_constant_inputs(log: Log) -> Iterator[LogFault]:
    """Find inputs that never move."""
    for j in np.flatnonzero(np.ptp(log.U, axis=0) == 0):
        name = strip_unit(log.data.inputs[j])
        yield LogFault(
            "constant input",
            f"{name} is {log.U[0, j]:.4g} throughout: its effect cannot be learned",
            f"excite {name}, with km.Noise or km.data.PRBS, or leave it out",
            (log.data.inputs[j],),
            repair=Repair.COLUMN,
        )


def find_low_excitation(log: Log) -> Iterator[LogFault]:
    """Find inputs that are exciting of a lower order than the plant has states."""
    order = log.data.nx + 1
    for j in np.flatnonzero(np.ptp(log.U, axis=0) > 0):
        long = [e for e in log.data if len(e) > order + 1]
        if not long:
            continue
        # use differences: a constant level would raise the order by one without exciting the plant
        differences = Episodes([Episode(X=e.X[1:], U=np.diff(e.U[:, [j]], axis=0)) for e in long], log.data.dt)
        good = int((persistency(differences, order).conditions < 1e7).sum())
        if good < min(order, 3):
            name = strip_unit(log.data.inputs[j])
            yield LogFault(
                "little excitation",
                f"{name} excites to order {good} only, and {log.data.nx} states ask for {order}: a sine, or rare steps",
                f"excite {name} with km.Noise, km.data.PRBS or km.data.Multisine",
                (log.data.inputs[j],),
            )


DELAYS = "Fit with delays (embedding=km.Delay(2)) or with a hidden state (km.identify.subspace), or measure that state"
_DEPENDENT = "inputs together"  # after it nothing can be said of a single input
for _find in (
    values.find_repeated_columns,
    values.find_repeated_episodes,
    values.find_coarse_sensors,
    values.find_slow_sensors,
    values.find_wrapped_angles,
    values.find_stuck_sensors,
    values.find_saturated_sensors,
    values.find_held_samples,
    values.find_outliers,
):
    register_check(_find)
for _find in (find_constant_inputs, find_dependent_inputs, find_low_excitation, find_feedback):
    register_check(_find, of_inputs=True)
register_check(find_inputs_without_effect, of_rest=True, unless=["feedback", _DEPENDENT])
register_check(find_changes, of_rest=True)
register_check(values.find_jumps, of_rest=True)
for _find, _too in ((find_late_signals, ()), (find_saturated_actuators, ("input delay", "late sensor"))):
    register_check(_find, of_rest=True, unless=["quantised", "slow sensor", _DEPENDENT, *_too])
_HIDDEN = "rows at the sensor's limit are missing, and it is the output that chose them"


@dataclass(frozen=True, eq=False)
class AuditReport(Value):
    """The faults of logs; `print` shows each fault with its remedy.

    Attributes
    ----------
    faults
        The faults.
    episodes, steps
        Number of episodes and steps that were checked.
    timing
        For each input, whether it acts on the row after its own or within its own row.
    drift
        What changed since the data `against`; None without them.
    memory
        What past rows tell beyond the present one, which shows a hidden state; None where faults stand in the way.
    """

    faults: tuple[LogFault, ...]
    episodes: int
    steps: int
    timing: tuple[InputTiming, ...] = ()
    memory: Memory | None = None
    drift: DriftReport | None = None

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of the faults, in the order of the report."""
        return tuple(dict.fromkeys(fault.name for fault in self.faults))

    @property
    def delay(self) -> int:
        """Number of past steps that a model needs because signals are late; 0 if every signal is in time."""
        return max((fault.steps for fault in self.faults), default=0)

    @property
    def same_row(self) -> tuple[str, ...]:
        """Names of the inputs that act within their own row."""
        return tuple(one.input for one in self.timing if one.timing is Timing.SAME_ROW)

    @property
    def doubts(self) -> tuple[str, ...]:
        """A sentence for each input of which feedback hides whether it acts within its own row."""
        advice = "record it once without the controller, or with a test signal of your own added to it"
        return tuple(f"{one}; {advice}" for one in self.timing if one.feedback)

    def without_faults(self, data: Episodes) -> Episodes:
        """Return the data without the faulty rows: episodes are cut there, and pieces of one row are dropped.

        Raises
        ------
        DataError
            Every row is faulty.
        """
        rest = Remainder.of(data).without_faults(self.faults)
        if rest is None:
            raise DataError("every row of the data is at fault; see the report for what to do")
        return rest.data

    def __str__(self) -> str:
        """Return the report: a summary, then each fault with its remedy."""
        checked = f"{self.episodes} episode{'s' * (self.episodes > 1)}, {self.steps} steps"
        doubts = [("input timing", f"{doubt}.") for doubt in self.doubts]
        if self.memory is not None and self.memory.shows_hidden_state:
            doubts.append(("hidden state", f"{self.memory}. {DELAYS}."))
        if self.drift is not None:
            doubts.append(("drift", f"{self.drift.verdict}: {'; '.join(self.drift.sentences)}."))
        if not self.faults and not doubts:
            return f"no fault found in {checked}"
        count = len(self.faults)
        pairs = [(fault.name, f"{fault.says}. {fault.do[0].upper()}{fault.do[1:]}.") for fault in self.faults]
        summary = f"{count} fault{'s' * (count > 1)}" if count else "no fault"
        return render_text(f"{summary} found in {checked}", label_lines([*pairs, *doubts]))


def audit(data: Episodes, *, times: Sequence[ArrayLike] | None = None, against: Episodes | None = None) -> AuditReport:
    """Look for faults of recorders, sensors and actuators in logs, before a model is fitted to them.

    - Values: a live sensor never repeats a number. Repeated numbers show a sensor that is stuck, at its limit, coarse
      or slow. They also show held or lost samples, and rows or episodes that were recorded twice.
    - Inputs: some do not move, move together, have no effect, excite too little, or follow from the state.
    - Alignment: a one-step regression on the present row predicts better after a late signal is shifted to its true
      row, or after an input is clipped at the limit of its actuator.
    - Timing: an input acts within its own row: a feedthrough, or a log whose input column is one row late. Under
      feedback one log cannot tell, and the report says so.
    - Memory: in logs without a fault, past rows tell of the next one what the present row does not, so that a state is
      hidden (`find_hidden_state`).
    - Changes: an episode follows the law of the others after a sign, unit, offset, order of columns or sample time is
      corrected.

    The regressions leave out the rows that the checks of single values report.

    Parameters
    ----------
    data
        The episodes; if there are more than 200,000 steps, the audit checks the first 200,000.
    times
        (T+1,) time stamps [s] of the rows of each episode, to find jitter and resets of the clock; without them the
        audit does not check the clock. `load_episodes` cuts at resets, and refuses steps that differ by more than 2 %.
    against
        The data of a design, to compare these new logs with, see `find_drift`.

    Raises
    ------
    DataError
        The data are not Episodes, or the times do not match them.
    """
    data = _take_first(episodes_of(data), 200_000)
    if times is not None:
        checks.kind(times, "times", (tuple, list), "pass one array of times an episode")
    faults = [] if times is None else list(find_clock_faults(data, times))
    log = Log(data)
    whole = Remainder.of(_unwrap_angles(data, values.find_whole_turns(log)))
    for check in sorted(CHECKS.values(), key=lambda check: check.of_rest):
        if data.nu or not check.of_inputs:
            faults += _run_check(check, log, whole, faults)
    kinds, rest = {fault.name for fault in faults}, whole.without_faults(faults)
    timing = measure_timing(Log(rest.data)) if rest is not None and _DEPENDENT not in kinds else ()
    if "sensor at its limit" in kinds:  # rows that y chose are gone: y seems to predict any input
        timing = tuple(replace(one, why=_HIDDEN, feedback=False) if one.feedback else one for one in timing)
    faults += find_same_row_inputs(timing)
    memory = None if faults else find_hidden_state(data)
    drift = None if against is None else find_drift(against, data)
    return AuditReport(tuple(faults), len(data), sum(map(len, data)), timing, memory, drift)


def _run_check(check: Check, log: Log, whole: "Remainder", faults: Sequence[LogFault]) -> list[LogFault]:
    """Return what a check finds after these faults."""
    if check.unless.intersection(fault.name for fault in faults):
        return []
    if not check.of_rest:
        return list(check.find(log))
    rest = whole.without_faults(faults)
    return [] if rest is None else [rest.locate_fault(fault) for fault in check.find(Log(rest.data))]


def _take_first(data: Episodes, most: int) -> Episodes:
    """Return the first episodes, with at most so many steps."""
    ends = np.cumsum([len(episode) for episode in data])
    return data[: max(int(np.searchsorted(ends, most, side="right")), 1)]


def _unwrap_angles(data: Episodes, whole_turns: dict[int, float]) -> Episodes:
    """Return the episodes with these angles unwrapped along time."""
    if not whole_turns:
        return data
    unwrapped: list[Episode] = []
    for episode in data:
        X = episode.X.copy()
        for i, turn in whole_turns.items():
            X[:, i] = np.unwrap(X[:, i], period=turn)
        unwrapped.append(episode.with_states(X))
    return data.with_episodes(unwrapped)


@dataclass(frozen=True, eq=False)
class Remainder:
    """The pieces of episodes that remain after rows are cut out, and the original place of each piece."""

    data: Episodes
    origins: tuple[Place, ...]

    @classmethod
    def of(cls, data: Episodes) -> "Remainder":
        """Return the complete data."""
        return cls(data, tuple(Place(e, 0, len(episode) + 1) for e, episode in enumerate(data)))

    def without(self, places: Sequence[Place]) -> "Remainder | None":
        """Return the pieces of two rows or more that remain without these rows, or None if nothing remains."""
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
            for a, b in find_stretches(good[:-1] & good[1:] & joined):
                pieces.append(episode.cut(a, b))
                origins.append(Place(e, a, b + 1))
        return Remainder(self.data.with_episodes(pieces), tuple(origins)) if pieces else None

    def without_faults(self, faults: Sequence[LogFault]) -> "Remainder | None":
        """Return the pieces that remain without the rows of these faults."""
        return self.without([place for fault in faults for place in fault.places])

    def locate_fault(self, fault: LogFault) -> LogFault:
        """Return the fault with its places in the original data."""
        places: list[Place] = []
        for place in fault.places:
            piece = self.origins[place.episode]
            places.append(Place(piece.episode, place.first + piece.first, place.last + piece.first, place.jump))
        says = fault.says.replace(list_places(fault.places), list_places(tuple(places)))
        return replace(fault, says=says, places=tuple(places))


def find_clock_faults(data: Episodes, times: Sequence[ArrayLike], other_rate: float = 0.1) -> Iterator[LogFault]:
    """Find faults in the time stamps of the rows; an episode has another rate if its median step is so far from dt."""
    if len(times) != len(data):
        raise DataError(f"times are given for {len(times)} episodes, the data have {len(data)}; pass one array each")
    steps = [
        np.diff(checks.vector(stamps, f"times of episode {e}", len(episode) + 1))
        for e, (stamps, episode) in enumerate(zip(times, data, strict=True))
    ]
    all_steps = np.concatenate(steps)
    forward = all_steps[all_steps > 0]
    if not len(forward):
        raise DataError("the times never advance; pass the time of each row in seconds")
    dt = float(np.median(forward))
    resets = _find_steps(steps, lambda d: d <= 0)
    if resets:
        yield LogFault(
            "clock reset",
            f"the clock goes back or stands still {len(resets)} times: {list_places(resets)}",
            "cut the episodes there: load_episodes does where it goes back",
            places=resets,
            repair=Repair.LEAVE_OUT,
        )
    gaps = _find_steps(steps, lambda d: d > GAP * dt)
    other = [e for e, d in enumerate(steps) if abs(np.median(d) - dt) > other_rate * dt]
    if other:
        shown = ", ".join(f"episode {e} {np.median(steps[e]):.4g} s" for e in other[:3])
        yield LogFault(
            "mixed sampling",
            f"{len(other)} of {len(data)} episodes have another step than {dt:.4g} s: {shown}",
            f"bring them to one step: load_episodes(…, resample={dt:.4g})",
            places=tuple(Place(e, 0, len(steps[e]) + 1) for e in other),
            repair=Repair.LEAVE_OUT,
        )
    gaps = tuple(p for p in gaps if p.episode not in other)
    if gaps:
        yield LogFault(
            "jump",
            f"rows are missing {len(gaps)} times, by the clock: {list_places(gaps)}",
            "cut the episodes there: load_episodes does",
            places=gaps,
            repair=Repair.LEAVE_OUT,
        )
    usual = [d for e, d in enumerate(steps) if e not in other]
    usual = np.concatenate(usual) if usual else np.zeros(0)
    usual = usual[(usual > 0) & (usual <= GAP * dt)]
    uneven = np.abs(usual - dt) > JITTER * dt
    if uneven.any():
        yield LogFault(
            "jitter",
            f"{to_percent(float(uneven.mean()))} of the steps differ from {dt:.4g} s by more than 2 %, from "
            f"{usual.min():.4g} to {usual.max():.4g} s",
            f"interpolate to equal steps: load_episodes(…, resample={dt:.4g})",
        )


def _find_steps(steps: list[Float[np.ndarray, " T"]], test: Callable[[np.ndarray], np.ndarray]) -> tuple[Place, ...]:
    return tuple(Place(e, k, k + 2, jump=True) for e, d in enumerate(steps) for k in np.flatnonzero(test(d)).tolist())
