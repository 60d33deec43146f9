"""Faults in single values: numbers that repeat or stand still while the plant moves, spikes and jumps.

A live sensor has noise and never repeats a number; a faulty sensor does.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from koopmpc.base.text import to_percent
from koopmpc.lifting.base import strip_unit
from koopmpc.validate.logs.log import ALONE, Log, LogFault, Place, Repair, find_stretches, list_places, name_episodes


@dataclass(frozen=True)
class _Limits:
    """Limits of the checks of single values, found on the corpus of tests/validate/logs."""

    grid_share: float = 0.95  # a sensor has a grid if at least this share of its values are multiples of one step
    coarse: float = 0.3  # a grid is coarse if its step exceeds this share of a usual change from row to row
    stuck_rows: int = 12  # a sensor is stuck if it repeats a number for this many rows
    limit_rows: int = 8  # a sensor is at its limit if at least this many rows have the same extreme value
    rest: float = 0.1  # a constant state is at rest if the one-step law predicts it to this share of a usual change
    overlap: int = 10  # two episodes repeat one another if they share this many successive rows
    near_steps: int = 3  # rows that change by at most so many steps of a display say how many repeat by chance
    far: float = 3.0  # a spike is larger than this many times the largest usual change
    jump: float = 1.5  # a jump is larger than this many times the largest usual change from row to row
    off: float = 10.0  # at a jump the residual is larger than this many times the largest usual residual


_LIMITS = _Limits()


def find_repeated_columns(log: Log) -> Iterator[LogFault]:
    """Find states that equal another state times a constant: one signal under two names."""
    Z = log.X - log.X.mean(axis=0)
    norm = np.linalg.norm(Z, axis=0)
    moves = norm > 1e-12 * (1 + np.abs(log.X).max(axis=0)) * np.sqrt(len(Z))
    for j in range(1, log.data.nx):
        for i in range(j):
            if moves[i] and moves[j]:
                unit = Z[:, j] / norm[j] - np.sign(Z[:, i] @ Z[:, j]) * Z[:, i] / norm[i]
                if np.abs(unit).max() * np.sqrt(len(Z)) < 1e-7:
                    first, second = strip_unit(log.data.states[i]), strip_unit(log.data.states[j])
                    factor = norm[j] / norm[i] * np.sign(Z[:, i] @ Z[:, j])
                    yield LogFault(
                        "repeated column",
                        f"{second} is {factor:.6g} times {first}, up to a constant: one signal under two names",
                        f"leave {second} out: load_episodes(…, states=[…])",
                        (log.data.states[j],),
                        repair=Repair.COLUMN,
                    )
                    break


def find_repeated_episodes(log: Log) -> Iterator[LogFault]:
    """Find rows that two episodes share: a model would be fitted to them and judged by them."""
    seen: dict[bytes, tuple[int, int]] = {}
    places: list[Place] = []
    originals: set[int] = set()
    for e, episode in enumerate(log.data):
        rows = np.ascontiguousarray(np.hstack([episode.X[:-1], episode.U]))
        moves = np.concatenate([np.ptp(episode.X, axis=0) > 0, np.ptp(episode.U, axis=0) > 0])
        if len(rows) < _LIMITS.overlap or not moves.any():
            continue
        keys = [row.tobytes() for row in rows]
        repeated = np.array([key in seen and seen[key][0] != e for key in keys])
        for a, b in find_stretches(repeated):
            if b - a >= _LIMITS.overlap and (np.ptp(rows[a:b], axis=0) > 0).any():
                places.append(Place(e, a, b + 1))
                originals.add(seen[keys[a]][0])
        for k, key in enumerate(keys):
            seen.setdefault(key, (e, k))
    if places:
        yield LogFault(
            "repeated episode",
            f"{name_episodes(tuple(places))} repeat rows of episode {min(originals)}"
            + ("" if len(originals) == 1 else " and others"),
            "keep one of them: a model would be judged by rows that it was fitted to",
            places=tuple(places),
            repair=Repair.LEAVE_OUT,
        )


def find_grid_step(column: Float[np.ndarray, " M"]) -> float:
    """Return the step of the grid of a sensor's values, or 0 if they have no grid."""
    values = np.unique(column)
    if len(values) < 3 or len(values) > max(len(column) / 3, 3):
        return 0.0
    gaps = np.diff(values)
    gaps = gaps[gaps > 1e-9 * np.ptp(values)]
    if not len(gaps):
        return 0.0
    step = float(np.quantile(gaps, 0.02))
    multiples = gaps / step
    off = np.abs(multiples - np.round(multiples))
    return step if np.mean(off < 0.01) >= _LIMITS.grid_share else 0.0


def find_coarse_sensors(log: Log) -> Iterator[LogFault]:
    """Find sensors whose resolution is coarse in comparison with a usual change."""
    for i, step in find_coarse_states(log).items():
        name, usual = strip_unit(log.data.states[i]), np.median(np.abs(log.changes[:, i]))
        small = f"are below {usual:.3g}" if usual else "are zero"
        yield LogFault(
            "quantised",
            f"{name} moves in steps of {step:.3g}, and half of its changes from row to row {small}: "
            "its resolution hides what a model should learn",
            "log it with more digits, or sample more slowly; else let the model see more rows: embedding=km.Delay(2)",
            (log.data.states[i],),
        )


def find_coarse_states(log: Log) -> dict[int, float]:
    """Return the grid step of each state whose sensor is too coarse."""
    steps: dict[int, float] = {}
    for i in range(log.data.nx):
        step = find_grid_step(log.X[:, i])
        if step > 0:
            changes = np.abs(log.changes[:, i])
            if step > _LIMITS.coarse * float(np.quantile(changes, 0.75)) or np.mean(changes == 0) > 0.2:
                steps[i] = step
    return steps


def find_slow_sensors(log: Log) -> Iterator[LogFault]:
    """Find sensors that show a new value in every second row or less often."""
    for i in find_slow_states(log):
        zero = log.changes[:, i] == 0
        every = round(1 / max(1 - float(zero.mean()), 1e-3))
        name = strip_unit(log.data.states[i])
        yield LogFault(
            "slow sensor",
            f"{name} shows a new value every {every} rows only and repeats it in between",
            f"log every {every}th row, or pass embedding=km.Delay({every - 1})",
            (log.data.states[i],),
        )


def find_slow_states(log: Log) -> list[int]:
    """Return the states that repeat their value at regular rows throughout."""
    states: list[int] = []
    rough = find_coarse_states(log)
    for i in range(log.data.nx):
        gaps: list[int] = []
        for e in log.data:
            gaps += np.diff(np.flatnonzero(np.diff(e.X[:, i]) != 0)).tolist()
        if i in rough or len(gaps) < 10:
            continue
        usual, count = Counter(gaps).most_common(1)[0]
        if usual > 1 and count > 0.6 * len(gaps):
            states.append(i)
    return states


def find_stuck_sensors(log: Log) -> Iterator[LogFault]:
    """Find sensors that stand still for a while although other signals move."""
    rough, lazy = find_coarse_states(log), find_slow_states(log)
    places: dict[int, list[Place]] = {}
    at_end: dict[int, list[Place]] = {}
    low, high = log.X.min(axis=0), log.X.max(axis=0)
    moving = [i for i in range(log.data.nx) if i not in lazy and low[i] != high[i]]
    longest = {
        i: max(_LIMITS.stuck_rows, 6 * _usual_stay(log, i)) if i in rough else _LIMITS.stuck_rows for i in moving
    }
    for i, place in _list_stays(log, longest):
        stays = at_end if log.data[place.episode].X[place.first, i] in (low[i], high[i]) else places
        stays.setdefault(i, []).append(place)
    for i, stays in at_end.items():
        values = {float(log.data[p.episode].X[p.first, i]) for p in stays}
        alone = len(stays) == 1 or any(p.last - p.first == len(log.data[p.episode].X) for p in stays)
        if i in places or (alone and len(values) == 1 and i not in find_sensor_limits(log)):
            places.setdefault(i, []).extend(stays)
    for i, stays in places.items():
        name = strip_unit(log.data.states[i])
        yield LogFault(
            "stuck sensor",
            f"{name} stands still while other signals move: {list_places(tuple(stays))}",
            "leave these rows out",
            (log.data.states[i],),
            tuple(stays),
        )


def _list_stays(log: Log, longest: dict[int, int]) -> Iterator[tuple[int, Place]]:
    """Yield where these states stand still for as many steps or more, although other signals move."""
    for e, episode in enumerate(log.data):
        for i, least in longest.items():
            others = np.delete(episode.X, i, axis=1) / np.delete(log.size, i)
            others = np.hstack([others, np.vstack([episode.U, episode.U[-1:]]) / log.input_size])
            for a, b in find_stretches(np.diff(episode.X[:, i]) == 0):
                if b - a < least or not others.shape[1]:
                    continue
                moved = np.mean(np.diff(others[a : b + 1], axis=0) != 0, axis=0) > 0.5
                if np.ptp(others[a : b + 1], axis=0)[moved].max(initial=0.0) > 0.05:
                    yield i, Place(e, a, b + 1)


def _usual_stay(log: Log, i: int) -> int:
    """Return the 90 % quantile of the number of steps for which state i repeats its value."""
    lengths = [b - a for e in log.data for a, b in find_stretches(np.diff(e.X[:, i]) == 0)]
    return int(np.quantile(lengths, 0.9)) if lengths else 0


def find_sensor_limits(log: Log) -> dict[int, tuple[float, ...]]:
    """Return for each state the extreme values at which its sensor stays although the state moves on."""
    ends: dict[int, tuple[float, ...]] = {}
    repeating = {*find_coarse_states(log), *find_slow_states(log)}  # their numbers repeat in any case
    for i in range(log.data.nx):
        low, high = float(log.X[:, i].min()), float(log.X[:, i].max())
        if low == high or i in repeating:
            continue
        for end in (low, high):
            stays = [b - a for e in log.data for a, b in find_stretches(e.X[:, i] == end)]
            often = sum(stays) >= max(_LIMITS.limit_rows, 0.002 * len(log.X)) and len(stays) > 1
            if often and np.mean(np.array(stays) > 1) > 0.2 and not _is_at_rest(log, i, end):
                ends[i] = (*ends.get(i, ()), end)
    return ends


def _is_at_rest(log: Log, i: int, end: float) -> bool:
    """Return True if the one-step law predicts that this state stays at this value: then the plant rests there."""
    stays = [(e.X[1:, i] == end) & (e.X[:-1, i] == end) for e in log.data]
    residuals = np.concatenate([E[stay, i] for E, stay in zip(log.residuals, stays, strict=True)])
    changes = log.changes[:, i] / log.size[i]
    return bool((residuals**2).sum() < _LIMITS.rest**2 * len(residuals) * (changes**2).mean())


def find_saturated_sensors(log: Log) -> Iterator[LogFault]:
    """Find sensors that stay at the same extreme value again and again."""
    for i, ends in find_sensor_limits(log).items():
        places = tuple(
            Place(e, a, b)
            for e, episode in enumerate(log.data)
            for a, b in find_stretches(np.isin(episode.X[:, i], ends))
            if b - a > 1
        )
        share = np.mean(np.isin(log.X[:, i], ends))
        name, values = strip_unit(log.data.states[i]), " and ".join(f"{end:.4g}" for end in ends)
        yield LogFault(
            "sensor at its limit",
            f"{name} stays at {values} in {to_percent(float(share))} of the rows: the sensor goes no further",
            "leave these rows out, and hold the controller inside: "
            + " and ".join(f"x_{'min' if end == log.X[:, i].min() else 'max'} of {name} {end:.4g}" for end in ends),
            (log.data.states[i],),
            places,
        )


def find_held_samples(log: Log) -> Iterator[LogFault]:
    """Find rows in which no sensor moves although the plant did: held samples, or rows written twice."""
    rough = find_coarse_states(log)
    live = [i for i in range(log.data.nx) if i not in rough and np.ptp(log.X[:, i]) > 0]
    if not live or len(find_slow_states(log)) == len(live):
        return
    holds = list(_list_holds(log, live))
    places, lengths = tuple(place for place, *_ in holds), [place.last - place.first for place, *_ in holds]
    if not places or (len(places) < 3 and max(lengths) < 3):
        return
    rows, longest, where = sum(lengths), max(lengths), list_places(places)
    again, travels = sum(repeated for _, repeated, _ in holds), [far for *_, far in holds if np.isfinite(far)]
    if longest > 2 or not travels or float(np.median(travels)) > 0.72 or 2 * again < len(places):
        yield LogFault(
            "held samples",
            f"no sensor moves in {rows} rows, up to {longest} in sequence, though the plant does: {where}",
            "leave these rows out: the logger held its last values",
            places=places,
        )
    else:
        yield LogFault(
            "rows twice",
            f"{rows} rows repeat the row before them, and the plant goes on from there: {where}",
            "drop the second of each pair",
            places=places,
        )


def _list_holds(log: Log, live: list[int]) -> Iterator[tuple[Place, bool, float]]:
    """Yield rows in which no sensor moves, whether the inputs repeat too, and the step after in shares of usual ones.

    That step is of the smoothest state, for each row that it may have missed; NaN where the state rests.
    """
    limits, by_chance = find_sensor_limits(log), _repeat_by_chance(log, live)
    smooth = _find_smoothest_state(log, live)
    for e, episode in enumerate(log.data):
        X, U, steps = episode.X, episode.U, np.abs(np.diff(episode.X[:, smooth]))
        for a, b in find_stretches((np.diff(X[:, live], axis=0) == 0).all(axis=1)):
            at_limits = all(X[a, i] in limits.get(i, ()) for i in live)
            if b >= len(U) or a == 0 or at_limits or (by_chance and b - a == 1):
                continue
            again = np.array_equal(U[b - 1], U[b])
            if again or (np.ptp(U[a:b], axis=0) > 0).any() or not U.shape[1] or b - a == 1:
                usual = float(np.mean(np.append(steps[a - 1], steps[b + 1 : b + 2])))
                yield Place(e, a + 1, b + 1), again, steps[b] / usual / (b - a + 1) if usual > 0 else np.nan


def _repeat_by_chance(log: Log, live: list[int]) -> bool:
    """Return True if about as many rows repeat the row before them as change by any other few steps of the display.

    The step is that of the decimals in which the repeated values are written, after an interpolation too.
    """
    changes = log.changes[:, live]
    same = (changes == 0).all(axis=1)
    repeated = np.concatenate([e.X[1:, live] for e in log.data])[same]
    steps = np.array([_find_decimal_step(column) for column in repeated.T])
    near = int((np.abs(changes) < (_LIMITS.near_steps + 0.5) * steps).all(axis=1).sum() - same.sum())
    expected = near / ((2 * _LIMITS.near_steps + 1) ** len(live) - 1)
    return bool(same.sum() <= expected + 3 * np.sqrt(expected))


def _find_decimal_step(values: np.ndarray) -> float:
    """Return the power of ten of which all values are multiples, at least 1e-12."""
    rounding = 4e-16 * np.abs(values).max(initial=0.0)
    for digits in range(12):
        if np.abs(np.round(values, digits) - values).max(initial=0.0) < 1e-9 * 10.0**-digits + rounding:
            return 10.0**-digits
    return 1e-12


def _find_smoothest_state(log: Log, among: list[int]) -> int:
    """Return the state whose changes have the largest correlation with the change before."""
    correlations: list[float] = []
    for i in among:
        steps = [np.diff(e.X[:, i]) for e in log.data if len(e) > 2]
        products = [float(d[1:] @ d[:-1]) for d in steps]
        squares = [float(d @ d) for d in steps]
        correlations.append(sum(products) / max(sum(squares), 1e-300))
    return among[int(np.argmax(correlations))]


def find_outliers(log: Log) -> Iterator[LogFault]:
    """Find single rows far from both neighbours: one number that marks lost samples, or spikes."""
    rough = find_coarse_states(log)
    for i in range(log.data.nx):
        name = strip_unit(log.data.states[i])
        changes = np.abs(log.changes[:, i])
        if i in rough and np.mean(changes == 0) > 0.9:
            continue
        mark = _find_loss_mark(log, i, changes)
        if mark is not None:
            value, places = mark
            yield LogFault(
                "lost samples",
                f"{name} jumps to {value:.6g} and back {len(places)} times: {list_places(places)}",
                f"{value:.6g} marks a lost sample: leave these rows out",
                (log.data.states[i],),
                places,
                repair=Repair.BRIDGE,
            )
            continue
        places = tuple(_find_spikes(log, i, changes))
        if places and sum(p.last - p.first for p in places) < 0.05 * len(log.X):
            yield LogFault(
                "spikes",
                f"{name} leaves its path and returns, {_say_times(len(places))}: {list_places(places)}",
                "leave these rows out",
                (log.data.states[i],),
                places,
                repair=Repair.BRIDGE,
            )


def _say_times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"


def _find_loss_mark(log: Log, i: int, changes: np.ndarray) -> tuple[float, tuple[Place, ...]] | None:
    """Return a value to which state i jumps three times or more, and the rows; None if there is no such value."""
    values, counts = np.unique(log.X[:, i], return_counts=True)
    usual = np.quantile(changes, 0.9)
    for value in values[np.argsort(-counts)][:4]:
        places: list[Place] = []
        sizes: list[float] = []
        for e, episode in enumerate(log.data):
            column = episode.X[:, i]
            for a, b in find_stretches(column == value):
                before = column[a - 1] if a else column[min(b, len(column) - 1)]
                after = column[b] if b < len(column) else column[a - 1]
                places.append(Place(e, a, b))
                sizes.append(min(abs(value - before), abs(value - after)))
        rows = sum(p.last - p.first for p in places)
        if len(places) >= 3 and rows < 0.2 * len(log.X) and np.median(sizes) > 2 * _LIMITS.far * usual:
            return float(value), tuple(places)
    return None


def _find_spikes(log: Log, i: int, changes: np.ndarray) -> Iterator[Place]:
    """Yield the rows in which state i leaves its path and returns, against the one-step law."""
    heights: list[np.ndarray] = []
    for e in log.data:
        d = np.diff(e.X[:, i])
        opposite = d[1:] * d[:-1] < 0
        heights.append(np.where(opposite, np.minimum(np.abs(d[1:]), np.abs(d[:-1])), 0.0))
    all_heights = np.concatenate(heights)
    if not len(all_heights):
        return
    far = max(_LIMITS.far * float(np.quantile(changes, 0.97)), 5 * float(np.quantile(all_heights, 0.97)))
    if far <= 0:
        return
    other_steps = [np.abs(np.diff(e.X[:, i])) for e in log.data]
    for d, sizes in zip(other_steps, heights, strict=True):
        for k in np.flatnonzero(sizes > far):
            d[k : k + 2] = 0.0  # leave out the jumps away and back: the other steps show how far the state can move
    far = max(far, 1.2 * max(float(d.max(initial=0.0)) for d in other_steps))
    usual = 4 * float(np.quantile(np.concatenate([np.abs(E[:, i]) for E in log.residuals]), 0.97))
    for e, sizes in enumerate(heights):
        off = np.abs(log.residuals[e][:, i])
        for k in np.flatnonzero((sizes > far) & (off[:-1] > usual) & (off[:-1] * log.size[i] > 0.5 * sizes)):
            around = np.concatenate([off[max(k - 4, 0) : max(k - 1, 0)], off[k + 3 : k + 6]])
            predictable = log.leverage[e][max(k - 1, 0) : k + 1].max() < ALONE
            if k >= 2 and predictable and np.max(around, initial=0.0) < 0.3 * off[k]:
                yield Place(e, int(k) + 1, int(k) + 2)


def find_whole_turns(log: Log) -> dict[int, float]:
    """Return the whole turn, 2π or 360, of each angle that jumps by it."""
    whole_turns: dict[int, float] = {}
    for i in range(log.data.nx):
        changes = np.abs(log.changes[:, i])
        for turn in (2 * np.pi, 360.0):
            wrapped = np.abs(changes - turn) < 0.25 * turn
            small = np.median(changes) < 0.15 * turn and np.mean(changes[~wrapped] > 0.5 * turn) < 0.001
            if wrapped.any() and small and 0.8 * turn < np.ptp(log.X[:, i]) < 1.02 * turn:
                whole_turns[i] = turn
    return whole_turns


def find_wrapped_angles(log: Log) -> Iterator[LogFault]:
    """Find angles that jump by a whole turn."""
    for i, turn in find_whole_turns(log).items():
        changes = np.abs(log.changes[:, i])
        count = int((np.abs(changes - turn) < 0.25 * turn).sum())
        yield LogFault(
            "wrapped angle",
            f"{strip_unit(log.data.states[i])} jumps by {'360' if turn == 360 else '2π'} {count} times: it is wrapped",
            f"unwrap it along each episode (koopmpc fit does), or lift it by km.Fourier(2, states=[{i}]) alone",
            (log.data.states[i],),
            repair=Repair.COLUMN,
        )


def find_jumps(log: Log) -> Iterator[LogFault]:
    """Find places where the states jump because rows are missing or an episode contains two runs."""
    E = np.concatenate(log.residuals)
    usual = np.maximum(np.quantile(np.abs(E), 0.97, axis=0), 1e-9)
    widest = np.quantile(np.abs(log.changes), 0.99, axis=0)
    places: list[Place] = []
    for e, episode in enumerate(log.data):
        d = np.diff(episode.X, axis=0)
        off = np.where(log.leverage[e] < ALONE, (np.abs(log.residuals[e]) / usual).max(axis=1), 0.0)
        wide = (np.abs(d) > _LIMITS.jump * widest) & (widest > 0)
        for k in 1 + np.flatnonzero(((off > _LIMITS.off) & wide.any(axis=1))[1:]):
            if not (np.abs(log.residuals[e][k]) * log.size > 0.5 * np.abs(d[k]))[wide[k]].any():
                continue
            i = int(np.argmax(np.abs(d[k]) / np.where(widest > 0, widest, np.inf)))
            back = k + 1 < len(d) and d[k + 1, i] * d[k, i] < 0 and abs(d[k + 1, i]) > 0.5 * abs(d[k, i])
            returned = d[k - 1, i] * d[k, i] < 0 and abs(d[k - 1, i]) > 0.5 * abs(d[k, i])
            alone = (k + 1 >= len(d) or off[k + 1] < 0.5 * off[k]) and off[k - 1] < 0.5 * off[k]
            if not back and not returned and alone and log.leverage[e][k - 1] < ALONE:
                places.append(Place(e, int(k), int(k) + 2, jump=True))
    if places and len(places) < 0.02 * log.steps:
        yield LogFault(
            "jump",
            f"the states go on from elsewhere {len(places)} times: {list_places(tuple(places))}",
            "rows are missing there, or a new run begins: cut the episode in two",
            places=tuple(places),
            repair=Repair.LEAVE_OUT,
        )
