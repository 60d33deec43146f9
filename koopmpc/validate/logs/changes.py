"""Faults that begin midway: a part of the log follows the law of the rest after a sign, unit or order is corrected.

The log is cut into segments. Least trimmed squares fits a one-step law to a consensus of them. For each segment that
does not follow this law, every possible change of the recording is undone in turn. If the segment then follows the law,
the change is the fault. If no change explains a segment, the plant was in another regime, which is not a fault.

References
----------
Rousseeuw & Van Driessen, "Computing LTS regression for large data sets", Data Min. Knowl. Discov. 12, 2006.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations, pairwise

import numpy as np
from jaxtyping import Float

from koopmpc.lifting.base import strip_unit
from koopmpc.validate.logs.log import Log, LogFault, Place, Repair, name_episodes, solve_weights


@dataclass(frozen=True)
class _Limits:
    """Limits of the search for changes, found on the corpus of tests/validate/logs."""

    segments: int = 40  # cut the log into about this many segments
    shortest: int = 30  # a segment has at least this many rows
    share: float = 0.6  # the consensus consists of this share of the segments
    restarts: int = 12  # random starts of the search for the consensus, beside two fixed ones
    offset_segments: int = 4  # fit the offset of a state to at most this many segments
    gain: float = 0.5  # nats a row and state that a segment must gain if a change is undone
    offset_gain: float = 0.8  # the same for an offset; it is fitted, and may gain 0.75 in a segment with a misfit
    gain_share: float = 0.5  # a segment must gain at least this share of the most that it can gain
    no_offset: float = 0.05  # [rad] a smaller offset of an angle is not a fault
    no_turn: float = 0.3  # [rad] an offset of an angle this close to whole turns is not a fault
    offset_rounds: int = 9  # rounds of the search for an offset; each narrows it by a factor of six
    sure: float = 40.0  # nats over all rows that a segment must gain
    # after a change is undone, a segment may be this many nats a row and state worse than the consensus
    back: float = 0.7
    floor: float = 1e-8  # a residual below this share of a state's size counts as rounding


_LIMITS = _Limits()
_FACTORS = {
    "180/π": 180 / np.pi,
    "1000": 1e3,
    "100": 100.0,
    "10": 10.0,
    "60": 60.0,
    "3.6": 3.6,
    "60/2π": 60 / (2 * np.pi),
    "25.4": 25.4,
    "9.81": 9.81,
    "2": 2.0,
}

Segment = tuple[np.ndarray, np.ndarray]  # X (T+1, nx) and U (T, nu)


@dataclass(frozen=True, eq=False)
class OneStepLaw:
    """The one-step law x⁺ − x = size · Wᵀ φ(x, u) of the consensus, and its errors."""

    log: Log
    W: Float[np.ndarray, "p nx"]
    level: Float[np.ndarray, " nx"]

    def step(self, X: Float[np.ndarray, "M nx"], U: Float[np.ndarray, "M nu"]) -> Float[np.ndarray, "M nx"]:
        """Return the next rows."""
        return X + self.log.stack_regressors(X, U) @ self.W * self.log.size

    def errors(self, X: Float[np.ndarray, "T1 nx"], U: Float[np.ndarray, "T nu"]) -> Float[np.ndarray, " nx"]:
        """Return the logarithm of the root-mean-square error of each state, in nats above that of the consensus."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self.rate_residuals(X[1:] - self.step(X[:-1], U))

    def rate_residuals(self, E: Float[np.ndarray, "T nx"]) -> Float[np.ndarray, " nx"]:
        """Return the result of `errors` from residuals of the next rows."""
        E = np.nan_to_num(E / self.log.size, nan=1e6, posinf=1e6, neginf=-1e6)
        return 0.5 * np.log((E**2).mean(axis=0) + _LIMITS.floor**2) - self.level


@dataclass(frozen=True, eq=False)
class Change:
    """A change of the recording: a hypothesis, with the errors of a segment after the change is undone.

    These errors may exceed those of the consensus by `allowance` nats, because undoing the change scales errors. If a
    number was fitted or taken from a table (`tuned`), one segment may agree by accident; then two must agree.
    """

    kind: str
    columns: tuple[str, ...]
    says: str
    errors: Callable[[OneStepLaw, np.ndarray, np.ndarray], np.ndarray]
    allowance: float = 0.0
    tuned: bool = True


def find_changes(log: Log) -> Iterator[LogFault]:
    """Find a change after which a part of the log no longer follows the law of the rest."""
    places = _cut_segments(log)
    law, agreeing = _fit_consensus(log, places)
    if law is None:
        return
    segments = [_read_segment(log, place) for place in places]
    errors = np.array([law.errors(*segment) for segment in segments])
    spread = np.quantile(errors[sorted(agreeing)].max(axis=1), 0.9)
    most = (np.clip(errors, spread, None) - spread).mean(axis=1)  # the most that a change can gain
    apart = [s for s in range(len(segments)) if s not in agreeing and most[s] > _LIMITS.gain]
    if not apart:
        return
    apart = sorted(sorted(apart, key=lambda s: -errors[s].max())[:12])
    best: tuple[float, Change, list[int]] | None = None
    for change in _list_changes(log, law, [segments[s] for s in apart]):
        gains = {s: _measure_gain(change, law, segments[s], errors[s], spread, most[s]) for s in apart}
        explained = [s for s, gain in gains.items() if gain > 0]
        total = sum(gains.values())
        if _is_credible(log, change, explained, agreeing) and (best is None or total > 1.02 * best[0]):
            best = (total, change, explained)
    if best is not None:
        yield _describe_change(log, best[1], tuple(places[s] for s in best[2]))


def _is_credible(log: Log, change: Change, explained: list[int], agreeing: set[int]) -> bool:
    """Return whether a recorder may have made this change: in one episode it changes once, and does not change back."""
    if len(explained) < 1 + change.tuned:
        return False
    between = agreeing.intersection(range(explained[0], explained[-1]))
    return len(log.data) > 1 or len(between) <= 0.2 * len(explained)


def _describe_change(log: Log, change: Change, places: tuple[Place, ...]) -> LogFault:
    where = name_episodes(places) if len(log.data) > 1 else f"from row {places[0].first} on"
    return LogFault(
        change.kind,
        f"{change.says} in {where}: undone, these rows follow the law of the others",
        "undo it there, or leave these episodes out",
        change.columns,
        places,
        repair=Repair.LEAVE_OUT if change.kind == "mixed sampling" else Repair.TRY_WITHOUT,
    )


def _measure_gain(
    change: Change, law: OneStepLaw, segment: Segment, errors: np.ndarray, spread: float, most: float
) -> float:
    """Return the nats that a segment gains if a change is undone; 0 where it does not follow the law then."""
    undone = change.errors(law, *segment)
    gain = float((np.clip(errors, spread, None) - np.clip(undone, spread, None)).mean())
    follows = undone.max() < spread + _LIMITS.back + change.allowance and gain > _LIMITS.gain_share * most
    least = _LIMITS.offset_gain if change.kind == "offset change" else _LIMITS.gain
    total = gain * len(segment[1])
    return total if gain > least and follows and total > _LIMITS.sure else 0.0


def _cut_segments(log: Log) -> list[Place]:
    longest = max(_LIMITS.shortest, log.steps // _LIMITS.segments)
    places: list[Place] = []
    for e, episode in enumerate(log.data):
        count = max(len(episode) // longest, 1)
        edges = np.linspace(0, len(episode), count + 1).astype(int)
        places += [Place(e, int(a), int(b)) for a, b in pairwise(edges)]
    return [place for place in places if place.last - place.first >= _LIMITS.shortest]


def _read_segment(log: Log, place: Place) -> Segment:
    episode = log.data[place.episode]
    return episode.X[place.first : place.last + 1], episode.U[place.first : place.last]


def _fit_consensus(log: Log, segments: list[Place]) -> tuple[OneStepLaw | None, set[int]]:
    """Return the law of the 60 % of the segments that agree best, and the indices of these segments."""
    if len(segments) < 5:
        return None, set()
    moments: list[tuple[np.ndarray, np.ndarray, np.ndarray, int]] = []
    for place in segments:
        X, U = _read_segment(log, place)
        P, Y = log.stack_regressors(X[:-1], U), np.diff(X, axis=0) / log.size
        moments.append((P.T @ P, P.T @ Y, (Y**2).sum(axis=0), len(Y)))
    grams, crosses = np.array([m[0] for m in moments]), np.array([m[1] for m in moments])
    squares, counts = np.array([m[2] for m in moments]), np.array([m[3] for m in moments])
    count = max(round(_LIMITS.share * len(segments)), 3)
    if counts.sum() * _LIMITS.share < 3 * grams.shape[1]:
        return None, set()
    rng = np.random.default_rng(0)
    indices = np.arange(len(segments))
    starts = [indices[:count], indices[-count:], *(rng.permutation(indices)[:count] for _ in range(_LIMITS.restarts))]
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for chosen in starts:
        W, level = np.zeros_like(crosses[0]), np.zeros(len(segments))
        for _ in range(8):
            W = solve_weights(grams[chosen].sum(axis=0), crosses[chosen].sum(axis=0))
            missed = squares - 2 * (crosses * W).sum(axis=1) + np.einsum("pi,spq,qi->si", W, grams, W)
            level = 0.5 * np.log(np.maximum(missed, 0) / counts[:, None] + _LIMITS.floor**2).mean(axis=1)
            closest = np.sort(np.argsort(level)[:count])
            if np.array_equal(closest, chosen):
                break
            chosen = closest
        total = float(np.sum(level[chosen]))
        if best is None or total < best[0]:
            best = (total, chosen, W)
    assert best is not None
    law = OneStepLaw(log, best[2], np.zeros(log.data.nx))
    level = np.median([law.errors(*_read_segment(log, segments[int(s)])) for s in best[1]], axis=0)
    return OneStepLaw(log, best[2], level), {int(s) for s in best[1]}


def _list_changes(log: Log, law: OneStepLaw, segments: list[Segment]) -> Iterator[Change]:
    """Yield the changes of sign, order, unit, offset and sample time that a recorder may make."""
    data, nx = log.data, log.data.nx
    signals = (*data.states, *data.inputs)
    names = [strip_unit(name) for name in signals]

    def edit(
        kind: str, says: str, columns: Sequence[int], sources: Sequence[int], factor: float = 1.0, by: float = 0.0
    ) -> Change:
        allowance = max(-float(np.log(abs(factor))), 0.0) if columns[0] < nx else 0.0
        undone = partial(_edit, list(columns), list(sources), factor, by)
        tuned = kind in ("unit change", "offset change")
        return Change(kind, tuple(signals[i] for i in columns), says, undone, allowance, tuned)

    for i, name in enumerate(names):
        yield edit("sensor sign" if i < nx else "input sign", f"{name} has the other sign", [i], [i], -1.0)
    inputs = range(nx, nx + data.nu)
    if data.nu > 1:
        yield edit("input sign", "every input has the other sign", inputs, inputs, -1.0)
    for i, j in (*combinations(range(nx), 2), *combinations(inputs, 2)):
        kind = "swapped sensors" if j < nx else "swapped inputs"
        yield edit(kind, f"{names[i]} and {names[j]} are swapped", [i, j], [j, i])
    for label, factor in _FACTORS.items():
        for up, text in ((factor, f"{label} times as large"), (1 / factor, f"{label} times as small")):
            for i, name in enumerate(names):
                yield edit("unit change", f"{name} is {text}", [i], [i], 1 / up)
    for i, name in enumerate(names[:nx]):
        b = _find_offset(log, law, segments[: _LIMITS.offset_segments], i)
        turns = round(b / (2 * np.pi))
        if i in log.angles and abs(b - 2 * np.pi * turns) < (_LIMITS.no_turn if turns else _LIMITS.no_offset):
            continue
        yield edit("offset change", f"{name} is {b:+.3g} off", [i], [i], by=-b)
    for r in (2, 3, 4):  # a disturbance moves a speed r times as far in r steps, and a position r² times
        apart, close = f"as far apart ({r * data.dt:.3g} s)", f"as close ({data.dt / r:.3g} s)"
        allowance = 2 * float(np.log(r))
        yield Change("mixed sampling", (), f"rows are {r} times {apart}", partial(_step_repeatedly, r), allowance)
        yield Change("mixed sampling", (), f"rows are {r} times {close}", partial(_step_average, r))


# Each function below returns the errors of a segment after one change is undone.


def _edit(
    columns: list[int], sources: list[int], factor: float, by: float, law: OneStepLaw, X: np.ndarray, U: np.ndarray
) -> np.ndarray:
    """Signals, of which inputs follow the states, are `factor` times the sources plus `by`."""
    nx = X.shape[1]
    signals = np.hstack([X, np.vstack([U, U[-1:]])])
    signals[:, columns] = factor * signals[:, sources] + by
    errors = law.errors(signals[:, :nx], signals[:-1, nx:])
    # a state that is scaled down has small errors in any case
    errors[[i for i in columns if i < nx]] -= min(float(np.log(abs(factor))), 0.0)
    return errors


def _step_repeatedly(r: int, law: OneStepLaw, X: np.ndarray, U: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):
        ahead = X[:-1]
        for _ in range(r):
            ahead = law.step(ahead, U)
        return law.rate_residuals(X[1:] - ahead)


def _step_average(r: int, law: OneStepLaw, X: np.ndarray, U: np.ndarray) -> np.ndarray:
    T = len(U) - r + 1
    mean = np.mean([U[s : s + T] for s in range(r)], axis=0)
    with np.errstate(over="ignore", invalid="ignore"):
        return law.rate_residuals(X[r:] - law.step(X[:T], mean))


def _find_offset(log: Log, law: OneStepLaw, segments: list[Segment], i: int) -> float:
    """Return the offset of state i under which the segments follow the law best."""
    now, after = (np.concatenate([X[part] for X, _ in segments]) for part in (slice(-1), slice(1, None)))
    inputs, ends = np.concatenate([U for _, U in segments]), np.cumsum([len(U) for _, U in segments])[:-1]

    def rate_offset(b: float) -> float:
        X, X_next = now.copy(), after.copy()
        X[:, i] -= b
        X_next[:, i] -= b
        with np.errstate(over="ignore", invalid="ignore"):
            residuals = np.split(X_next - law.step(X, inputs), ends)
            return float(np.median([law.rate_residuals(part).mean() for part in residuals]))

    width = 4.0 * float(log.size[i])
    low, high = -width, width
    for _ in range(_LIMITS.offset_rounds):
        tries = np.linspace(low, high, 13)
        best = int(np.argmin([rate_offset(float(b)) for b in tries]))
        step = float(tries[1] - tries[0])
        low, high = float(tries[best]) - step, float(tries[best]) + step
    return (low + high) / 2
