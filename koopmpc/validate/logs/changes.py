"""Faults that begin midway: a part of the log follows the law of the rest once a sign, a unit or an order is corrected.

The log is cut into segments. A consensus of them, found by least trimmed squares, gives a one-step law. Each segment
that does not follow it is tried under every change that a recorder may have suffered; one that brings the segment back
to the law is the fault. A segment that no change explains is another regime of the plant, and no fault of the log.

References
----------
Rousseeuw & Van Driessen, "Computing LTS regression for large data sets", Data Min. Knowl. Discov. 12, 2006.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import combinations, pairwise

import numpy as np
from jaxtyping import Float

from koopmpc.lifting.base import short
from koopmpc.validate.logs.log import Log, LogFault, Place, episodes_of_places, solved

_SEGMENTS = 40
_SHORTEST = 30  # rows of a segment
_SHARE = 0.6  # of the segments that agree on a law
_RESTARTS = 12
_TRIED = 4  # segments by which an offset is found
_GAIN = 0.5  # nats a row and state that a change must win
_SHIFTED = 0.8  # the same for an offset, which is fitted: a misfit far away may win 0.75 by one
_MOST = 0.5  # share of what a segment is off that undoing must win
_NOTHING, _TURN = 0.05, 0.3  # rad by which the offset of an angle may miss 0, and whole turns: then it is no fault
_REFINED = 9  # rounds in which an offset is narrowed down, each by a factor of six
_SURE = 40.0  # nats in all
_BACK = 0.7  # nats a row and state by which a segment may stay behind the consensus
_FLOOR = 1e-8  # share of a state's size below which a residual counts as rounding
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

Pair = tuple[np.ndarray, np.ndarray]  # X (T+1, nx) and U (T, nu) of a segment


@dataclass(frozen=True, eq=False)
class OneStepLaw:
    """The one-step law x⁺ − x = size · W' φ(x, u) of the consensus, and its errors."""

    log: Log
    W: Float[np.ndarray, "p nx"]
    level: Float[np.ndarray, " nx"]

    def step(self, X: Float[np.ndarray, "M nx"], U: Float[np.ndarray, "M nu"]) -> Float[np.ndarray, "M nx"]:
        """Return the next rows."""
        return X + self.log.stacked(X, U) @ self.W * self.log.size

    def errors(self, X: Float[np.ndarray, "T1 nx"], U: Float[np.ndarray, "T nu"]) -> Float[np.ndarray, " nx"]:
        """Return log of the root-mean-square error of each state, in nats above that of the consensus."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self.above(X[1:] - self.step(X[:-1], U))

    def above(self, E: Float[np.ndarray, "T nx"]) -> Float[np.ndarray, " nx"]:
        """Return the same of these residuals of the next rows."""
        E = np.nan_to_num(E / self.log.size, nan=1e6, posinf=1e6, neginf=-1e6)
        return 0.5 * np.log((E**2).mean(axis=0) + _FLOOR**2) - self.level


@dataclass(frozen=True, eq=False)
class Change:
    """A hypothesis: what the recorder did to a segment, and the errors of the segment once that is undone.

    These errors may be larger than those of the consensus by `charged` nats, which is what undoing adds by itself. With
    `chosen` a number was fitted or taken from a table, so that one segment can agree with it by accident: two must.
    """

    kind: str
    columns: tuple[str, ...]
    says: str
    errors: Callable[[OneStepLaw, np.ndarray, np.ndarray], np.ndarray]
    charged: float = 0.0
    chosen: bool = True


def midway(log: Log) -> Iterator[LogFault]:
    """Find the change under which a part of the log follows the law of the rest."""
    segments = _segments(log)
    law, agreed = _consensus(log, segments)
    if law is None:
        return
    pairs: list[Pair] = [_pair(log, place) for place in segments]
    errors = np.array([law.errors(*pair) for pair in pairs])
    spread = np.quantile(errors[sorted(agreed)].max(axis=1), 0.9)
    most = (np.clip(errors, spread, None) - spread).mean(axis=1)  # what a change can win at most
    apart = [s for s in range(len(pairs)) if s not in agreed and most[s] > _GAIN]
    if not apart:
        return
    apart = sorted(sorted(apart, key=lambda s: -errors[s].max())[:12])
    best: tuple[float, Change, list[int]] | None = None
    for change in _hypotheses(log, law, [pairs[s] for s in apart]):
        won, which = 0.0, list[int]()
        for s in apart:
            undone = change.errors(law, *pairs[s])
            gain = float((np.clip(errors[s], spread, None) - np.clip(undone, spread, None)).mean())
            back = undone.max() < spread + _BACK + change.charged and gain > _MOST * most[s]
            least = _SHIFTED if change.kind == "offset change" else _GAIN
            if gain > least and back and gain * len(pairs[s][1]) > _SURE:
                won += gain * len(pairs[s][1])
                which.append(s)
        if len(which) == 1 and change.chosen:
            continue
        if which and len(log.data) == 1 and len(agreed.intersection(range(which[0], which[-1]))) > 0.2 * len(which):
            continue  # within an episode a recorder changes once, and not back
        if which and (best is None or won > 1.02 * best[0]):
            best = (won, change, which)
    if best is None:
        return
    _, change, which = best
    places = tuple(segments[s] for s in which)
    where = episodes_of_places(places) if len(log.data) > 1 else f"from row {places[0].first} on"
    yield LogFault(
        change.kind,
        f"{change.says} in {where}: undone, these rows follow the law of the others",
        "undo it there, or leave these episodes out",
        change.columns,
        places,
    )


def _segments(log: Log) -> list[Place]:
    longest = max(_SHORTEST, log.steps // _SEGMENTS)
    made: list[Place] = []
    for e, episode in enumerate(log.data):
        count = max(len(episode) // longest, 1)
        edges = np.linspace(0, len(episode), count + 1).astype(int)
        made += [Place(e, int(a), int(b)) for a, b in pairwise(edges)]
    return [place for place in made if place.last - place.first >= _SHORTEST]


def _pair(log: Log, place: Place) -> Pair:
    episode = log.data[place.episode]
    return episode.X[place.first : place.last + 1], episode.U[place.first : place.last]


def _consensus(log: Log, segments: list[Place]) -> tuple[OneStepLaw | None, set[int]]:
    """Return the law of the 60 % of the segments that agree best, and the indices of these."""
    if len(segments) < 5:
        return None, set()
    moments: list[tuple[np.ndarray, np.ndarray, np.ndarray, int]] = []
    for place in segments:
        X, U = _pair(log, place)
        P, Y = log.stacked(X[:-1], U), np.diff(X, axis=0) / log.size
        moments.append((P.T @ P, P.T @ Y, (Y**2).sum(axis=0), len(Y)))
    grams, crosses = np.array([m[0] for m in moments]), np.array([m[1] for m in moments])
    squares, counts = np.array([m[2] for m in moments]), np.array([m[3] for m in moments])
    kept = max(round(_SHARE * len(segments)), 3)
    if counts.sum() * _SHARE < 3 * grams.shape[1]:
        return None, set()
    rng = np.random.default_rng(0)
    every = np.arange(len(segments))
    starts = [every[:kept], every[-kept:], *(rng.permutation(every)[:kept] for _ in range(_RESTARTS))]
    best: tuple[float, np.ndarray, np.ndarray] | None = None
    for which in starts:
        W, level = np.zeros_like(crosses[0]), np.zeros(len(segments))
        for _ in range(8):
            W = solved(grams[which].sum(axis=0), crosses[which].sum(axis=0))
            missed = squares - 2 * (crosses * W).sum(axis=1) + np.einsum("pi,spq,qi->si", W, grams, W)
            level = 0.5 * np.log(np.maximum(missed, 0) / counts[:, None] + _FLOOR**2).mean(axis=1)
            again = np.sort(np.argsort(level)[:kept])
            if np.array_equal(again, which):
                break
            which = again
        total = float(np.sum(level[which]))
        if best is None or total < best[0]:
            best = (total, which, W)
    assert best is not None
    law = OneStepLaw(log, best[2], np.zeros(log.data.nx))
    level = np.median([law.errors(*_pair(log, segments[int(s)])) for s in best[1]], axis=0)
    return OneStepLaw(log, best[2], level), {int(s) for s in best[1]}


def _hypotheses(log: Log, law: OneStepLaw, pairs: list[Pair]) -> Iterator[Change]:
    data = log.data
    flipped = "has the other sign"
    for i, name in enumerate(data.states):
        yield Change("sensor sign", (name,), f"{short(name)} {flipped}", partial(_scaled_state, i, -1.0), chosen=False)
    for j, name in enumerate(data.inputs):
        yield Change("input sign", (name,), f"{short(name)} {flipped}", partial(_scaled_input, j, -1.0), chosen=False)
    if data.nu > 1:
        undone = partial(_scaled_input, slice(None), -1.0)
        yield Change("input sign", data.inputs, f"every input {flipped}", undone, chosen=False)
    for kind, names, swapped in (
        ("swapped sensors", data.states, _swapped_states),
        ("swapped inputs", data.inputs, _swapped_inputs),
    ):
        for i, j in combinations(range(len(names)), 2):
            says = f"{short(names[i])} and {short(names[j])} are swapped"
            yield Change(kind, (names[i], names[j]), says, partial(swapped, i, j), chosen=False)
    for said, factor in _FACTORS.items():
        for up, text in ((factor, f"{said} times as large"), (1 / factor, f"{said} times as small")):
            for i, name in enumerate(data.states):
                charged = max(float(np.log(up)), 0.0)
                yield Change(
                    "unit change", (name,), f"{short(name)} is {text}", partial(_scaled_state, i, 1 / up), charged
                )
            for j, name in enumerate(data.inputs):
                yield Change("unit change", (name,), f"{short(name)} is {text}", partial(_scaled_input, j, 1 / up))
    for i, name in enumerate(data.states):
        b = _best_offset(log, law, pairs[:_TRIED], i)
        turns = round(b / (2 * np.pi))
        if i in log.angles and abs(b - 2 * np.pi * turns) < (_TURN if turns else _NOTHING):
            continue
        yield Change("offset change", (name,), f"{short(name)} is {b:+.3g} off", partial(_moved, i, -b))
    for r in (2, 3, 4):  # in r steps a push has moved a speed r times as far, and a position r² times
        apart, close = f"as far apart ({r * data.dt:.3g} s)", f"as close ({data.dt / r:.3g} s)"
        charged = 2 * float(np.log(r))
        yield Change("mixed sampling", (), f"rows are {r} times {apart}", partial(_slower, r), charged)
        yield Change("mixed sampling", (), f"rows are {r} times {close}", partial(_faster, r))


def _scaled_state(i: int, factor: float, law: OneStepLaw, X: np.ndarray, U: np.ndarray) -> np.ndarray:
    X = X.copy()
    X[:, i] *= factor
    found = law.errors(X, U)
    found[i] -= min(float(np.log(abs(factor))), 0.0)  # a state that is scaled down has small errors in any case
    return found


def _scaled_input(j: int | slice, factor: float, law: OneStepLaw, X: np.ndarray, U: np.ndarray) -> np.ndarray:
    U = U.copy()
    U[:, j] *= factor
    return law.errors(X, U)


def _swapped_states(i: int, j: int, law: OneStepLaw, X: np.ndarray, U: np.ndarray) -> np.ndarray:
    X = X.copy()
    X[:, [i, j]] = X[:, [j, i]]
    return law.errors(X, U)


def _swapped_inputs(i: int, j: int, law: OneStepLaw, X: np.ndarray, U: np.ndarray) -> np.ndarray:
    U = U.copy()
    U[:, [i, j]] = U[:, [j, i]]
    return law.errors(X, U)


def _moved(i: int, by: float, law: OneStepLaw, X: np.ndarray, U: np.ndarray) -> np.ndarray:
    X = X.copy()
    X[:, i] += by
    return law.errors(X, U)


def _slower(r: int, law: OneStepLaw, X: np.ndarray, U: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):
        ahead = X[:-1]
        for _ in range(r):
            ahead = law.step(ahead, U)
        return law.above(X[1:] - ahead)


def _faster(r: int, law: OneStepLaw, X: np.ndarray, U: np.ndarray) -> np.ndarray:
    T = len(U) - r + 1
    mean = np.mean([U[s : s + T] for s in range(r)], axis=0)
    with np.errstate(over="ignore", invalid="ignore"):
        return law.above(X[r:] - law.step(X[:T], mean))


def _best_offset(log: Log, law: OneStepLaw, pairs: list[Pair], i: int) -> float:
    """Return the offset of state i under which the segments follow the law best."""
    now, after = (np.concatenate([X[part] for X, _ in pairs]) for part in (slice(-1), slice(1, None)))
    inputs, ends = np.concatenate([U for _, U in pairs]), np.cumsum([len(U) for _, U in pairs])[:-1]

    def total(b: float) -> float:
        X, X_next = now.copy(), after.copy()
        X[:, i] -= b
        X_next[:, i] -= b
        with np.errstate(over="ignore", invalid="ignore"):
            missed = np.split(X_next - law.step(X, inputs), ends)
            return float(np.median([law.above(part).mean() for part in missed]))

    width = 4.0 * float(log.size[i])
    low, high = -width, width
    for _ in range(_REFINED):
        tries = np.linspace(low, high, 13)
        best = int(np.argmin([total(float(b)) for b in tries]))
        step = float(tries[1] - tries[0])
        low, high = float(tries[best]) - step, float(tries[best]) + step
    return (low + high) / 2
