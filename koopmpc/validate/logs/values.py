"""Faults that the rows themselves show: numbers repeat or stand still where a live signal moves, or leave its path.

The noise of a live sensor never repeats a number, a faulty one does.
"""

from collections import Counter
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from koopmpc.data.episodes import Episode, Episodes
from koopmpc.lifting.base import short
from koopmpc.validate.logs.log import ALONE, Log, LogFault, Place, episodes_of_places, listed, runs
from koopmpc.validate.sufficiency import persistency
from koopmpc.validate.text import percent

_GRID = 0.95  # share of a sensor's different values that stand on a grid
_COARSE = 0.3  # of a usual change from row to row, from which on a grid is coarse
_LONG = 12  # rows without any change from which on a sensor is stuck
_AT_LIMIT = 8  # rows at the same extreme value from which on a sensor is at its limit
_RESTS = 0.1  # of a usual change: where the law misses less than this, a state that stands still is at rest
_OVERLAP = 10  # rows that two episodes share
_FAR = 3.0  # times the largest usual step: a jump


def repeated_columns(log: Log) -> Iterator[LogFault]:
    """Find states that equal another one times a constant: one signal under two names."""
    Z = log.X - log.X.mean(axis=0)
    norm = np.linalg.norm(Z, axis=0)
    moves = norm > 1e-12 * (1 + np.abs(log.X).max(axis=0)) * np.sqrt(len(Z))
    for j in range(1, log.data.nx):
        for i in range(j):
            if moves[i] and moves[j]:
                unit = Z[:, j] / norm[j] - np.sign(Z[:, i] @ Z[:, j]) * Z[:, i] / norm[i]
                if np.abs(unit).max() * np.sqrt(len(Z)) < 1e-7:
                    first, second = short(log.data.states[i]), short(log.data.states[j])
                    factor = norm[j] / norm[i] * np.sign(Z[:, i] @ Z[:, j])
                    yield LogFault(
                        "repeated column",
                        f"{second} is {factor:.6g} times {first}, up to a constant: one signal under two names",
                        f"leave {second} out: load_episodes(…, states=[…])",
                        (log.data.states[j],),
                    )
                    break


def repeated_episodes(log: Log) -> Iterator[LogFault]:
    """Find rows that stand in two episodes: they would train a model and judge it."""
    seen: dict[bytes, tuple[int, int]] = {}
    places: list[Place] = []
    first_of: set[int] = set()
    for e, episode in enumerate(log.data):
        rows = np.ascontiguousarray(np.hstack([episode.X[:-1], episode.U]))
        moves = np.concatenate([np.ptp(episode.X, axis=0) > 0, np.ptp(episode.U, axis=0) > 0])
        if len(rows) < _OVERLAP or not moves.any():
            continue
        keys = [row.tobytes() for row in rows]
        again = np.array([key in seen and seen[key][0] != e for key in keys])
        for a, b in runs(again):
            if b - a >= _OVERLAP and (np.ptp(rows[a:b], axis=0) > 0).any():
                places.append(Place(e, a, b + 1))
                first_of.add(seen[keys[a]][0])
        for k, key in enumerate(keys):
            seen.setdefault(key, (e, k))
    if places:
        yield LogFault(
            "repeated episode",
            f"{episodes_of_places(tuple(places))} repeat rows of episode {min(first_of)}"
            + ("" if len(first_of) == 1 else " and others"),
            "keep one of them: a model would be judged by rows that it was fitted to",
            places=tuple(places),
        )


def grid(column: Float[np.ndarray, " M"]) -> float:
    """Return the step of the grid on which the values of a sensor stand, 0 where they stand on none."""
    values = np.unique(column)
    if len(values) < 3 or len(values) > max(len(column) / 3, 3):
        return 0.0
    gaps = np.diff(values)
    whole = gaps[gaps > 1e-9 * np.ptp(values)]
    if not len(whole):
        return 0.0
    step = float(np.quantile(whole, 0.02))
    near = whole / step
    off = np.abs(near - np.round(near))
    return step if np.mean(off < 0.01) >= _GRID else 0.0


def quantised(log: Log) -> Iterator[LogFault]:
    """Find sensors whose resolution is coarse against their usual step."""
    for i, step in coarse(log).items():
        name, usual = short(log.data.states[i]), np.median(np.abs(log.changes[:, i]))
        yield LogFault(
            "quantised",
            f"{name} moves in steps of {step:.3g}, and half of its changes from row to row are below "
            f"{usual:.3g}: its resolution hides what a model is to learn",
            "log it with more digits, or sample more slowly; else let the model see more rows: embedding=km.Delay(2)",
            (log.data.states[i],),
        )


def coarse(log: Log) -> dict[int, float]:
    """Return the grid of each state whose sensor is too coarse."""
    found: dict[int, float] = {}
    for i in range(log.data.nx):
        step = grid(log.X[:, i])
        if step > 0:
            changes = np.abs(log.changes[:, i])
            if step > _COARSE * float(np.quantile(changes, 0.75)) or np.mean(changes == 0) > 0.2:
                found[i] = step
    return found


def slow(log: Log) -> Iterator[LogFault]:
    """Find sensors that show a new value every second row, or less often."""
    for i in slow_states(log):
        zero = log.changes[:, i] == 0
        every = round(1 / max(1 - float(zero.mean()), 1e-3))
        name = short(log.data.states[i])
        yield LogFault(
            "slow sensor",
            f"{name} shows a new value every {every} rows only and repeats it in between",
            f"log every {every}th row, or pass embedding=km.Delay({every - 1})",
            (log.data.states[i],),
        )


def slow_states(log: Log) -> list[int]:
    """Return the states that repeat their value at regular rows throughout."""
    found: list[int] = []
    rough = coarse(log)
    for i in range(log.data.nx):
        gaps: list[int] = []
        for e in log.data:
            gaps += np.diff(np.flatnonzero(np.diff(e.X[:, i]) != 0)).tolist()
        if i in rough or len(gaps) < 10:
            continue
        usual, count = Counter(gaps).most_common(1)[0]
        if usual > 1 and count > 0.6 * len(gaps):
            found.append(i)
    return found


def stuck(log: Log) -> Iterator[LogFault]:
    """Find sensors that stand still for a while though the other states move."""
    rough, lazy = coarse(log), slow_states(log)
    places: dict[int, list[Place]] = {}
    at_end: dict[int, list[Place]] = {}
    low, high = log.X.min(axis=0), log.X.max(axis=0)
    moving = [i for i in range(log.data.nx) if i not in lazy and low[i] != high[i]]
    longest = {i: max(_LONG, 6 * _longest_usual(log, i)) if i in rough else _LONG for i in moving}
    for e, episode in enumerate(log.data):
        for i in moving:
            others = np.delete(episode.X, i, axis=1) / np.delete(log.size, i)
            others = np.hstack([others, np.vstack([episode.U, episode.U[-1:]]) / log.input_size])
            for a, b in runs(np.diff(episode.X[:, i]) == 0):
                if b - a < longest[i] or not others.shape[1]:
                    continue
                moved = np.mean(np.diff(others[a : b + 1], axis=0) != 0, axis=0) > 0.5
                if np.ptp(others[a : b + 1], axis=0)[moved].max(initial=0.0) > 0.05:
                    where = at_end if episode.X[a, i] in (low[i], high[i]) else places
                    where.setdefault(i, []).append(Place(e, a, b + 1))
    for i, found in at_end.items():
        values = {float(log.data[p.episode].X[p.first, i]) for p in found}
        alone = len(found) == 1 or any(p.last - p.first == len(log.data[p.episode].X) for p in found)
        if i in places or (alone and len(values) == 1 and i not in limits(log)):
            places.setdefault(i, []).extend(found)
    for i, found in places.items():
        name = short(log.data.states[i])
        yield LogFault(
            "stuck sensor",
            f"{name} stands still while other signals move: {listed(tuple(found))}",
            "leave these rows out",
            (log.data.states[i],),
            tuple(found),
        )


def _longest_usual(log: Log, i: int) -> int:
    lengths = [b - a for e in log.data for a, b in runs(np.diff(e.X[:, i]) == 0)]
    return int(np.quantile(lengths, 0.9)) if lengths else 0


def limits(log: Log) -> dict[int, tuple[float, ...]]:
    """Return for each state the extreme values at which its sensor stays, though the others tell that it moves on."""
    found: dict[int, tuple[float, ...]] = {}
    known = {*coarse(log), *slow_states(log)}  # their numbers repeat in any case
    for i in range(log.data.nx):
        low, high = float(log.X[:, i].min()), float(log.X[:, i].max())
        if low == high or i in known:
            continue
        for end in (low, high):
            stays = [b - a for e in log.data for a, b in runs(e.X[:, i] == end)]
            often = sum(stays) >= max(_AT_LIMIT, 0.002 * len(log.X)) and len(stays) > 1
            if often and np.mean(np.array(stays) > 1) > 0.2 and not _at_rest(log, i, end):
                found[i] = (*found.get(i, ()), end)
    return found


def _at_rest(log: Log, i: int, end: float) -> bool:
    """Return True where the one-step law has this state stand still at this value: the plant rests there."""
    stays = [(e.X[1:, i] == end) & (e.X[:-1, i] == end) for e in log.data]
    missed = np.concatenate([E[own, i] for E, own in zip(log.residuals, stays, strict=True)])
    changes = log.changes[:, i] / log.size[i]
    return bool((missed**2).sum() < _RESTS**2 * len(missed) * (changes**2).mean())


def saturated(log: Log) -> Iterator[LogFault]:
    """Find sensors that stay at the same extreme value again and again."""
    for i, ends in limits(log).items():
        places = tuple(
            Place(e, a, b)
            for e, episode in enumerate(log.data)
            for a, b in runs(np.isin(episode.X[:, i], ends))
            if b - a > 1
        )
        share = np.mean(np.isin(log.X[:, i], ends))
        name, said = short(log.data.states[i]), " and ".join(f"{end:.4g}" for end in ends)
        yield LogFault(
            "sensor at its limit",
            f"{name} stays at {said} in {percent(float(share))} of the rows: the sensor goes no further",
            "leave these rows out, and hold the controller inside: "
            + " and ".join(f"x_{'min' if end == log.X[:, i].min() else 'max'} of {name} {end:.4g}" for end in ends),
            (log.data.states[i],),
            places,
        )


def held(log: Log) -> Iterator[LogFault]:
    """Find rows in which no sensor moves though the plant did: held samples, or rows written twice."""
    rough = coarse(log)
    whole = [i for i in range(log.data.nx) if i not in rough and np.ptp(log.X[:, i]) > 0]
    if not whole or len(slow_states(log)) == len(whole):
        return
    places: list[Place] = []
    travels: list[float] = []
    smooth = _smoothest(log, whole)
    for e, episode in enumerate(log.data):
        X, U = episode.X, episode.U
        same = (np.diff(X[:, whole], axis=0) == 0).all(axis=1)
        for a, b in runs(same):
            if b >= len(U) or a == 0:
                continue
            contradiction = np.array_equal(U[b - 1], U[b]) or (np.ptp(U[a:b], axis=0) > 0).any()
            if contradiction or not episode.U.shape[1] or b - a == 1:
                places.append(Place(e, a + 1, b + 1))
                around = [abs(X[a, smooth] - X[a - 1, smooth])]
                if b + 2 < len(X):
                    around.append(abs(X[b + 2, smooth] - X[b + 1, smooth]))
                step = float(np.mean(around))
                if step > 0:
                    travels.append(abs(X[b + 1, smooth] - X[b, smooth]) / step / (b - a + 1))
    lengths = [p.last - p.first for p in places]
    if not places or (len(places) < 3 and max(lengths) < 3):
        return
    found, rows, longest = tuple(places), sum(lengths), max(lengths)
    if longest > 2 or not travels or float(np.median(travels)) > 0.72:
        yield LogFault(
            "held samples",
            f"no sensor moves in {rows} rows, up to {longest} in sequence, though the plant does: {listed(found)}",
            "leave these rows out: the logger held its last values",
            places=found,
        )
    else:
        yield LogFault(
            "rows twice",
            f"{rows} rows repeat the row before them, and the plant goes on from there: {listed(found)}",
            "drop the second of each pair",
            places=found,
        )


def _smoothest(log: Log, among: list[int]) -> int:
    """Return the state whose steps are most like the step before."""
    likeness: list[float] = []
    for i in among:
        steps = [np.diff(e.X[:, i]) for e in log.data if len(e) > 2]
        both = [float(d[1:] @ d[:-1]) for d in steps]
        own = [float(d @ d) for d in steps]
        likeness.append(sum(both) / max(sum(own), 1e-300))
    return among[int(np.argmax(likeness))]


def outliers(log: Log) -> Iterator[LogFault]:
    """Find single rows far off both neighbours: the same number each time, a mark of loss, or spikes."""
    rough = coarse(log)
    for i in range(log.data.nx):
        name = short(log.data.states[i])
        changes = np.abs(log.changes[:, i])
        if i in rough and np.mean(changes == 0) > 0.9:
            continue
        marks = _marked(log, i, changes)
        if marks is not None:
            value, places = marks
            yield LogFault(
                "lost samples",
                f"{name} jumps to {value:.6g} and back {len(places)} times: {listed(places)}",
                f"{value:.6g} marks a lost sample: leave these rows out",
                (log.data.states[i],),
                places,
            )
            continue
        places = tuple(_spikes(log, i, changes))
        if places and sum(p.last - p.first for p in places) < 0.05 * len(log.X):
            yield LogFault(
                "spikes",
                f"{name} leaves its path for single rows {len(places)} times: {listed(places)}",
                "leave these rows out",
                (log.data.states[i],),
                places,
            )


def _marked(log: Log, i: int, changes: np.ndarray) -> tuple[float, tuple[Place, ...]] | None:
    values, counts = np.unique(log.X[:, i], return_counts=True)
    usual = np.quantile(changes, 0.9)
    for value in values[np.argsort(-counts)][:4]:
        places: list[Place] = []
        sizes: list[float] = []
        for e, episode in enumerate(log.data):
            column = episode.X[:, i]
            for a, b in runs(column == value):
                before = column[a - 1] if a else column[min(b, len(column) - 1)]
                after = column[b] if b < len(column) else column[a - 1]
                places.append(Place(e, a, b))
                sizes.append(min(abs(value - before), abs(value - after)))
        rows = sum(p.last - p.first for p in places)
        if len(places) >= 3 and rows < 0.2 * len(log.X) and np.median(sizes) > 2 * _FAR * usual:
            return float(value), tuple(places)
    return None


def _spikes(log: Log, i: int, changes: np.ndarray) -> Iterator[Place]:
    there: list[np.ndarray] = []
    for e in log.data:
        d = np.diff(e.X[:, i])
        opposite = d[1:] * d[:-1] < 0
        there.append(np.where(opposite, np.minimum(np.abs(d[1:]), np.abs(d[:-1])), 0.0))
    every = np.concatenate(there)
    if not len(every):
        return
    far = max(_FAR * float(np.quantile(changes, 0.97)), 5 * float(np.quantile(every, 0.97)))
    if far <= 0:
        return
    calm = [np.abs(np.diff(e.X[:, i])) for e in log.data]
    for d, sizes in zip(calm, there, strict=True):
        for k in np.flatnonzero(sizes > far):
            d[k : k + 2] = 0.0  # the jumps away and back; all other steps tell how far a state can move
    far = max(far, 1.2 * max(float(d.max(initial=0.0)) for d in calm))
    usual = 4 * float(np.quantile(np.concatenate([np.abs(E[:, i]) for E in log.residuals]), 0.97))
    for e, sizes in enumerate(there):
        off = np.abs(log.residuals[e][:, i])
        for k in np.flatnonzero((sizes > far) & (off[:-1] > usual) & (off[:-1] * log.size[i] > 0.5 * sizes)):
            around = np.concatenate([off[max(k - 4, 0) : max(k - 1, 0)], off[k + 3 : k + 6]])
            known = log.leverage[e][max(k - 1, 0) : k + 1].max() < ALONE
            if k >= 2 and known and np.max(around, initial=0.0) < 0.3 * off[k]:
                yield Place(e, int(k) + 1, int(k) + 2)


def turns(log: Log) -> dict[int, float]:
    """Return the whole turn, 2π or 360, of each angle that jumps by it."""
    found: dict[int, float] = {}
    for i in range(log.data.nx):
        changes = np.abs(log.changes[:, i])
        for turn in (2 * np.pi, 360.0):
            jumps = np.abs(changes - turn) < 0.25 * turn
            small = np.median(changes) < 0.15 * turn and np.mean(changes[~jumps] > 0.5 * turn) < 0.001
            if jumps.any() and small and 0.8 * turn < np.ptp(log.X[:, i]) < 1.02 * turn:
                found[i] = turn
    return found


def wrapped(log: Log) -> Iterator[LogFault]:
    """Find angles that jump by a whole turn."""
    for i, turn in turns(log).items():
        changes = np.abs(log.changes[:, i])
        count = int((np.abs(changes - turn) < 0.25 * turn).sum())
        yield LogFault(
            "wrapped angle",
            f"{short(log.data.states[i])} jumps by {'360' if turn == 360 else '2π'} {count} times: it is wrapped",
            f"unwrap it along each episode (koopmpc fit does), or lift it by km.Fourier(2, states=[{i}]) alone",
            (log.data.states[i],),
        )


_JUMP = 1.5  # times the largest usual change from row to row
_OFF = 10.0  # times the largest usual residual


def jumps(log: Log) -> Iterator[LogFault]:
    """Find places where the states jump, for rows are missing or an episode holds two runs."""
    E = np.concatenate(log.residuals)
    usual = np.maximum(np.quantile(np.abs(E), 0.97, axis=0), 1e-9)
    widest = np.quantile(np.abs(log.changes), 0.99, axis=0)
    places: list[Place] = []
    for e, episode in enumerate(log.data):
        d = np.diff(episode.X, axis=0)
        off = np.where(log.leverage[e] < ALONE, (np.abs(log.residuals[e]) / usual).max(axis=1), 0.0)
        wide = (np.abs(d) > _JUMP * widest) & (widest > 0)
        for k in 1 + np.flatnonzero(((off > _OFF) & wide.any(axis=1))[1:]):
            if not (np.abs(log.residuals[e][k]) * log.size > 0.5 * np.abs(d[k]))[wide[k]].any():
                continue
            i = int(np.argmax(np.abs(d[k]) / np.where(widest > 0, widest, np.inf)))
            back = k + 1 < len(d) and d[k + 1, i] * d[k, i] < 0 and abs(d[k + 1, i]) > 0.5 * abs(d[k, i])
            since = d[k - 1, i] * d[k, i] < 0 and abs(d[k - 1, i]) > 0.5 * abs(d[k, i])
            alone = (k + 1 >= len(d) or off[k + 1] < 0.5 * off[k]) and off[k - 1] < 0.5 * off[k]
            if not back and not since and alone and log.leverage[e][k - 1] < ALONE:
                places.append(Place(e, int(k), int(k) + 2, jump=True))
    if places and len(places) < 0.02 * log.steps:
        yield LogFault(
            "jump",
            f"the states go on from elsewhere {len(places)} times: {listed(tuple(places))}",
            "rows are missing there, or a new run begins: cut the episode in two",
            places=tuple(places),
        )


def constant(log: Log) -> Iterator[LogFault]:
    """Find inputs that never move."""
    for j in np.flatnonzero(np.ptp(log.U, axis=0) == 0):
        name = short(log.data.inputs[j])
        yield LogFault(
            "constant input",
            f"{name} is {log.U[0, j]:.4g} throughout: what it does cannot be learned",
            f"excite {name}, with km.Noise or km.PRBS, or leave it out",
            (log.data.inputs[j],),
        )


def excitation(log: Log) -> Iterator[LogFault]:
    """Find inputs that excite to a lower order than the plant has states."""
    order = log.data.nx + 1
    for j in np.flatnonzero(np.ptp(log.U, axis=0) > 0):
        long = [e for e in log.data if len(e) > order + 1]
        if not long:
            continue
        # differences, for a constant level raises the order by one and excites nothing
        alone = Episodes([Episode(X=e.X[1:], U=np.diff(e.U[:, [j]], axis=0)) for e in long], log.data.dt)
        found = persistency(alone, order)
        good = int((found.conditions < 1e7).sum())
        if good < min(order, 3):
            name = short(log.data.inputs[j])
            yield LogFault(
                "little excitation",
                f"{name} excites to order {good} only, and {log.data.nx} states ask for {order}: a sine, or steps "
                "that hardly ever come",
                f"excite {name} with km.Noise, km.PRBS or km.Multisine",
                (log.data.inputs[j],),
            )
