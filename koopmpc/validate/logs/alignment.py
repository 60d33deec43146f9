"""Faults between signals: one is late, has no effect or follows from others, or an actuator ends before its input.

A signal that is late, and an actuator that ends, are found by hypotheses: each undoes its fault in the log, and
predicts the next row from the present one. It is judged by the information on all states together, −½ log det of the
residuals in nats a sample: a signal that is put where it belongs raises it, and moving what one sensor knows to another
does not.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float

from koopmpc.lifting.base import short
from koopmpc.validate.logs.log import Log, LogFault, fitted, information
from koopmpc.validate.text import percent

_LATEST = 8  # steps by which a signal is looked for
_ENOUGH = 200  # rows without which no lag and no effect is looked for
_ROWS = 5_000  # rows that are looked at
_GAIN = 0.02  # nats a sample that a hypothesis must win
_SURE = 30.0  # nats in all
_PEAK = 0.95  # share of the gain of a late input that a step more or less may win: a smooth input wins by any delay
_PREFERRED = 1.15  # of the gain of an input that is late, over that of a sensor: the commoner fault
_SENSOR = 0.2  # nats a sample that all states must win by putting a sensor right, in a log of noise alone
_OWN = 0.3  # nats a sample that a late sensor must win of its own residual; of 600 clean logs the most was 0.18
_OWN_ONE_ROW = 0.5  # the same by a law that reads no earlier row
_EVEN = 0.25  # share of these gains that each part of the log must show; clean logs win in a few parts only
_ONE_ROW_LATEST = 5  # steps by which that law looks; by 8, the smooth log of a clean plant won 0.75
_CLEAR, _CLEAR_OWN = 0.75, 0.5  # shares of the gain of a late sensor that moving another signal may win
_BLOCKS = 8  # parts of the log of which nearly all must agree


@dataclass(frozen=True)
class Shift:
    """State or input `column` (inputs after the states) is read `steps` rows later, or earlier where negative.

    A sensor is never ahead of the plant, so a state is only read later: the future of the other states would predict an
    earlier reading all too well.
    """

    column: int
    steps: int


@dataclass(frozen=True, eq=False)
class Rows:
    """Present rows, their inputs, the rows before and the next ones."""

    X: Float[np.ndarray, "M nx"]
    U: Float[np.ndarray, "M nu"]
    before: Float[np.ndarray, "M nx"]
    after: Float[np.ndarray, "M nx"]

    def regressors(self, log: Log) -> Float[np.ndarray, "M p"]:
        """Return the regressors of the next rows."""
        return np.hstack([log.stacked(self.X, self.U), (self.before - log.center) / log.size])

    def residuals(self, log: Log, more: Float[np.ndarray, "M q"] | None = None) -> Float[np.ndarray, "M nx"]:
        """Return the residuals of the next rows in sizes of the states; `more` are further regressors."""
        P = self.regressors(log)
        P = P if more is None else np.hstack([P, more])
        return fitted(P, (self.after - self.X) / log.size)

    def one_row_residuals(self, log: Log) -> Float[np.ndarray, "M nx"]:
        """Return the residuals of the next rows by a law that does not read the rows before."""
        return fitted(log.stacked(self.X, self.U), (self.after - self.X) / log.size)


def rows(log: Log, shifts: tuple[Shift, ...] = (), margin: int = _LATEST) -> Rows:
    """Return the rows of all episodes `margin` away from both ends, every signal moved by its shifts."""
    nx, nu = log.data.nx, log.data.nu
    states, inputs, moved = np.arange(nx), np.arange(nu), np.zeros(nx + nu, dtype=np.intp)
    for shift in shifts:
        moved[shift.column] += shift.steps
    none = np.zeros((0, nx))
    parts, count = [(none, np.zeros((0, nu)), none, none)], 0
    for episode in log.data:
        T = len(episode)
        if 2 * margin + 3 > T:
            continue
        at = np.arange(margin + 1, T - margin)[:, None] + moved
        X, U = np.hsplit(at, [nx])
        parts.append((episode.X[X, states], episode.U[U, inputs], episode.X[X - 1, states], episode.X[X + 1, states]))
        count += len(at)
        if count > _ROWS:
            break
    return Rows(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def won(log: Log, E: Float[np.ndarray, "M nx"], other: Float[np.ndarray, "M nx"]) -> float:
    """Return by how much `other` predicts better than `E`, in nats a sample, by the stricter of both counts."""
    return float((information(other, log.fine) - information(E, log.fine)).min())


def better(log: Log, E: Float[np.ndarray, "M nx"], other: Float[np.ndarray, "M nx"], least: float = _GAIN) -> bool:
    """Return True where `other` predicts better than `E` by more than chance, and in nearly all parts of the log."""
    parts = zip(np.array_split(E, _BLOCKS), np.array_split(other, _BLOCKS), strict=True)
    agree = sum(won(log, a, b) > 0 for a, b in parts)
    return won(log, E, other) > max(least, _SURE / len(E)) and agree >= _BLOCKS - 1


def late(log: Log) -> Iterator[LogFault]:
    """Find inputs that act late, and sensors that are late against the others."""
    data, nx = log.data, log.data.nx
    if not data.nu and nx < 2:
        return
    plain = rows(log)
    if len(plain.X) < max(_ENOUGH, 8 * plain.regressors(log).shape[1]):
        return
    found: tuple[Shift, ...] = ()
    E = plain.residuals(log)
    for _ in range(2):
        following = _surest(log, found, E)
        one = None if found or (following and following[0][0].column >= nx) else _by_one_row(log)
        if following is None:
            if one is not None:
                yield _said(log, (one,), [])
            return
        best, E, alike = following
        if one is not None and one.column == best[0].column and one.steps != best[0].steps:
            best = (one,)  # with the row before, one step more may predict as well
            E = rows(log, best).residuals(log)
        found = (*found, *best)
        yield _said(log, best, alike)


def _surest(
    log: Log, found: tuple[Shift, ...], E: Float[np.ndarray, "M nx"]
) -> tuple[tuple[Shift, ...], Float[np.ndarray, "M nx"], list[int]] | None:
    """Return the shift that predicts best, its residuals, and the sensors that explain it as well; None if unsure."""
    nx = log.data.nx
    if won(log, E, 0 * E) < _GAIN:
        return None
    errors = {shift: rows(log, (*found, *shift)).residuals(log) for shift in _shifts(log, found)}
    scores = {shift: _score(log, shift[0], E, other) for shift, other in errors.items()}
    best = max(scores, key=lambda shift: scores[shift] * (_PREFERRED if shift[0].column >= nx else 1.0))
    rivals = {shift: score for shift, score in scores.items() if shift[0].column != best[0].column}
    if best[0].column >= nx and not _alone(log, found, best, errors[best]):
        sensors = {shift: score for shift, score in scores.items() if shift[0].column < nx}
        if not sensors:
            return None
        best = max(sensors, key=sensors.__getitem__)  # the input seems late only because a sensor is
        rivals = {shift: score for shift, score in sensors.items() if shift[0].column != best[0].column}
    if best[0].column < nx:
        rival = max(rivals.values(), default=0.0), max((won(log, E, errors[shift]) for shift in rivals), default=0.0)
        sure = _behind(log, best[0], E, errors[best], *rival)
    else:
        near = [tuple(Shift(one.column, one.steps + step) for one in best) for step in (-1, 1)]
        beside = [scores[shift] for shift in near if shift in scores]
        sure = better(log, E, errors[best]) and max(beside, default=0.0) < _PEAK * scores[best]
    alike = {shift[0].column for shift, score in rivals.items() if score > _CLEAR * scores[best]}
    return (best, errors[best], sorted(i for i in alike if i < nx)) if sure else None


def _score(log: Log, shift: Shift, E: Float[np.ndarray, "M nx"], other: Float[np.ndarray, "M nx"]) -> float:
    """Return the gain of a shift; of a sensor's, the gain of its own residual where that is less.

    The other states may follow better from the future of a sensor that is in time, but this sensor follows worse from
    their past.
    """
    gain = won(log, E, other)
    return min(gain, _own(log, shift, E, other)) if shift.column < log.data.nx else gain


def _own(log: Log, shift: Shift, E: Float[np.ndarray, "M nx"], other: Float[np.ndarray, "M nx"]) -> float:
    """Return by how much `other` predicts the shifted state better than `E`, in nats a sample."""
    of, floor = slice(shift.column, shift.column + 1), log.fine[shift.column : shift.column + 1]
    return float((information(other[:, of], floor) - information(E[:, of], floor)).min())


def _behind(
    log: Log,
    shift: Shift,
    E: Float[np.ndarray, "M nx"],
    other: Float[np.ndarray, "M nx"],
    rival: float,
    rival_of_all: float,
) -> bool:
    """Return True where a sensor is late; the rivals are the score and the gain of the best shifts of other signals.

    Either all states together win much, the more the less noise the log holds, whose errors are then the smooth misfit
    of the regression and depend on the row that it is read from. Or the sensor itself wins a little, in every part of
    the log, and no other shift half of it; a misfit may do so by one step.
    """
    misfit = float(np.subtract(*information(E, log.fine)))
    gain = _score(log, shift, E, other)
    if gain <= 0 or rival > _CLEAR * gain:
        return False
    if rival_of_all <= _CLEAR * won(log, E, other) and better(log, E, other, _SENSOR * (1 + misfit)):
        return True
    if gain < _OWN or rival > _CLEAR_OWN * gain or (shift.steps == 1 and misfit > 1):
        return False
    parts = zip(np.array_split(E, _BLOCKS), np.array_split(other, _BLOCKS), strict=True)
    return all(_own(log, shift, a, b) > _EVEN * gain for a, b in parts)


def _by_one_row(log: Log) -> Shift | None:
    """Return the shift of a late sensor that a law of the present row shows, or None.

    A state that moves slowly against its noise follows so well from its last two rows that no other signal adds to
    them: late or not, its residual is the same. Without the row before, it must follow from the others. Nothing is said
    where the inputs tell nothing: a motion that repeats itself follows from any of its rows.
    """
    if log.data.nx < 2:
        return None
    plain = rows(log)
    E = plain.one_row_residuals(log)
    if won(log, fitted(log.regressors(plain.X), (plain.after - plain.X) / log.size), E) < _GAIN:
        return None
    best, most = None, _OWN_ONE_ROW
    for i, steps in product(range(log.data.nx), range(1, _ONE_ROW_LATEST + 1)):
        other = rows(log, (Shift(i, steps),)).one_row_residuals(log)
        pairs = zip(np.array_split(E[:, i], _BLOCKS), np.array_split(other[:, i], _BLOCKS), strict=True)
        gains = [0.5 * float(np.log((np.mean(a**2) + 1e-20) / (np.mean(b**2) + 1e-20))) for a, b in pairs]
        if np.median(gains) > most and min(gains) > _EVEN * np.median(gains):
            best, most = Shift(i, steps), float(np.median(gains))
    return best


def _shifts(log: Log, found: tuple[Shift, ...]) -> Iterator[tuple[Shift, ...]]:
    nx, nu = log.data.nx, log.data.nu
    taken = {shift.column for shift in found}
    for steps in range(1, _LATEST + 1):
        if nu > 1 and not taken.intersection(range(nx, nx + nu)):
            yield tuple(Shift(nx + j, -steps) for j in range(nu))
        for j in range(nu):
            if nx + j not in taken:
                yield (Shift(nx + j, -steps),)
        for i in range(nx if nx > 1 else 0):
            if i not in taken:
                yield (Shift(i, steps),)


def _alone(log: Log, found: tuple[Shift, ...], shift: tuple[Shift, ...], E: Float[np.ndarray, "M nx"]) -> bool:
    """Return True where the input of the present row adds next to nothing to the late one."""
    now, moved = rows(log, found), rows(log, (*found, *shift))
    both = moved.residuals(log, log.scaled(now.X, now.U)[1])
    return won(log, E, both) < 0.1 * won(log, now.residuals(log), both)


def _said(log: Log, shift: tuple[Shift, ...], alike: list[int]) -> LogFault:
    """Return the fault; the sensors `alike` explain a late input as well, if they are late instead."""
    steps = abs(shift[0].steps)
    names = tuple(log.names[one.column] for one in shift)
    said = " and ".join(short(name) for name in names)
    count = f"{steps} step{'s' * (steps > 1)}"
    past = f"let the model see the past: embedding=km.Delay({steps})"
    if shift[0].column >= log.data.nx:
        acts = "acts" if len(names) == 1 else "act"
        others = " or ".join(short(log.names[i]) for i in alike)
        instead = f", unless the sensor of {others} is {count} behind" if alike else ""
        return LogFault("input delay", f"{said} {acts} {count} late{instead}", past, names, steps=steps)
    behind = f"{said} is {count} behind the other signals"
    return LogFault("late sensor", behind, f"move its column by {count}, or {past}", names, steps=steps)


_QUANTILES = (0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)  # of an input, at which an actuator may end
_BENT = (2, 3, 4, 5)  # powers of an input that a clipped one must beat
_SHARPER = 3.0  # nats in all by which it must; where inputs act through tanh, the polynomial wins by 50 and more
_LEFT = 0.1  # share of the gain of a clipped input that what is clipped may add


def ending(log: Log) -> Iterator[LogFault]:
    """Find inputs that have no more effect beyond some value, where the actuator ends."""
    plain = rows(log, margin=1)
    if not log.data.nu or len(plain.X) < max(_ENOUGH, 8 * plain.regressors(log).shape[1]):
        return
    E = plain.residuals(log)
    for j in range(log.data.nu):
        column = plain.U[:, j]
        ends = list(_ends(column))
        if not ends:
            continue
        scores = [won(log, E, _clipped(plain, j, *pair).residuals(log)) for pair in ends]
        low, high = ends[int(np.argmax(scores))]
        if not better(log, E, _clipped(plain, j, low, high).residuals(log)):
            continue
        low, high = _refined(log, plain, j, low, high)
        clipped = _clipped(plain, j, low, high)
        rest = (column - clipped.U[:, j])[:, None] / log.input_size[j]
        inside = clipped.residuals(log)
        if won(log, inside, clipped.residuals(log, rest)) > _LEFT * won(log, E, inside):
            continue
        v = (plain.U[:, [j]] - log.input_center[j]) / log.input_size[j]
        bent = plain.residuals(log, np.hstack([v**power for power in _BENT]))
        if won(log, bent, inside) < _SHARPER / len(bent):  # a smooth curve says as much: no end, but a plant that bends
            continue
        name = short(log.data.inputs[j])
        said = [f"below {low:.3g}"] * bool(low > column.min()) + [f"above {high:.3g}"] * bool(high < column.max())
        call = [f"u_min={low:.3g}"] * bool(low > column.min()) + [f"u_max={high:.3g}"] * bool(high < column.max())
        yield LogFault(
            "actuator at its limit",
            f"{name} has no more effect {' and '.join(said)}: the actuator ends there, and the log holds the command",
            f"clip {name} in the log to what was applied, and tell the controller: km.Limits({', '.join(call)})",
            (log.data.inputs[j],),
        )


def _ends(column: Float[np.ndarray, " M"]) -> Iterator[tuple[float, float]]:
    """Yield low and high ends at quantiles of the input, of both sides or one."""
    for side, q in product(("both", "high", "low"), _QUANTILES):
        low = float(np.quantile(column, q)) if side != "high" else float(column.min())
        high = float(np.quantile(column, 1 - q)) if side != "low" else float(column.max())
        if low < high and (low > column.min() or high < column.max()):
            yield low, high


def _clipped(of: Rows, j: int, low: float, high: float) -> Rows:
    U = of.U.copy()
    U[:, j] = np.clip(U[:, j], low, high)
    return Rows(of.X, U, of.before, of.after)


def _refined(log: Log, of: Rows, j: int, low: float, high: float) -> tuple[float, float]:
    """Return the ends that predict best, by steps around the quantiles that were best, halved five times."""
    bottom, top = float(of.U[:, j].min()), float(of.U[:, j].max())
    width = 0.1 * (top - bottom)
    for _ in range(6):
        tries = [(a, b) for a in (low - width, low, low + width) for b in (high - width, high, high + width)]
        tries = [
            (a if low > bottom else bottom, b if high < top else top)
            for a, b in tries
            if bottom <= a < b <= top or low == bottom or high == top
        ]
        scores = [float(information(_clipped(of, j, a, b).residuals(log), log.fine).sum()) for a, b in tries]
        low, high = tries[int(np.argmax(scores))]
        width /= 2
    return low, high


_PAST = 10  # inputs of the past that may tell the next one
_EXPLAINED = 0.8  # share of an input that the state of the same row explains: feedback
_NEWS = 0.02  # share of what is new in an input that this state must explain then
_FREE = 1e-4  # share of an input that its own past must leave open


def together(log: Log) -> Iterator[LogFault]:
    """Find inputs of which one follows from the others."""
    U = log.U
    moving = [j for j in range(log.data.nu) if np.ptp(U[:, j]) > 0]
    V = (U[:, moving] - U[:, moving].mean(axis=0)) / np.maximum(U[:, moving].std(axis=0), 1e-300)
    for n, j in enumerate(moving):
        if n and float((fitted(V[:, :n], V[:, [n]]) ** 2).mean()) < 1e-4:
            others = ", ".join(short(log.data.inputs[i]) for i in moving[:n])
            yield LogFault(
                "inputs together",
                f"{short(log.data.inputs[j])} follows from {others}: their effects cannot be told apart",
                "excite each input by its own noise",
                (log.data.inputs[j],),
            )


def without_effect(log: Log) -> Iterator[LogFault]:
    """Find inputs that move and change no state within a few steps."""
    nu = log.data.nu
    near = rows(log, margin=6)
    if not nu or len(near.X) < max(_ENOUGH, 4 * near.regressors(log).shape[1]):
        return
    V = np.concatenate([_past(e.U, 6, len(e) - 6, 6) for e in log.data if len(e) >= 15])[: len(near.X)]
    base = [log.regressors(near.X), (near.before - log.center) / log.size]
    Y = (near.after - near.X) / log.size
    for j in range(nu):
        own = V[:, j::nu] / log.input_size[j]
        if np.ptp(own) == 0:
            continue
        kept = np.hstack([*base, *(V[:, i::nu] / log.input_size[i] for i in range(nu) if i != j)])
        E, other = fitted(kept, Y), fitted(np.hstack([kept, own]), Y)
        chance = own.shape[1] * Y.shape[1] / (2 * len(Y))
        gain = information(other, log.fine)[0] - information(E, log.fine)[0]
        if gain < 4 * chance + 2e-4 and not better(log, E, other, 1e-3):
            name = short(log.data.inputs[j])
            yield LogFault(
                "input without effect",
                f"{name} moves, and no state follows within 6 steps",
                f"check that {name} was applied and is in the right column; excite it more strongly; else leave it out",
                (log.data.inputs[j],),
            )


def _past(U: np.ndarray, first: int, last: int, count: int) -> np.ndarray:
    """Return rows [u_k, u_{k−1}, …, u_{k−count+1}] for k = first + 1 … last − 1."""
    k = np.arange(first + 1, last)
    return np.hstack([U[k - lag] for lag in range(count)])


def feedback(log: Log) -> Iterator[LogFault]:
    """Find inputs u_k that follow from the state x_k of the same row.

    An input that was chosen freely may be told by the state as well, where the plant is much faster than the input is
    changed. Two signs tell a feedback u = K x from that: x_k knows more of u_k than of u_{k−1}, although that one has
    acted already, and it tells a part of u_k that earlier inputs do not.
    """
    long, nu = [e for e in log.data if len(e) > 2 * _PAST], log.data.nu
    if not long or not nu:
        return
    now = np.concatenate([e.U[_PAST + 1 :] for e in long])
    past = np.concatenate([_past(e.U, _PAST, len(e), _PAST + 1)[:, nu:] for e in long])
    state = np.concatenate([e.X[_PAST + 1 : -1] for e in long])
    if len(now) < max(_ENOUGH, 4 * (past.shape[1] + state.shape[1])):
        return
    V = (now - log.input_center) / log.input_size
    own = (past - np.tile(log.input_center, _PAST)) / np.tile(log.input_size, _PAST)
    one, Z = np.ones((len(V), 1)), (state - log.center) / log.size
    left = (fitted(np.hstack([one, own]), V) ** 2).mean(axis=0)
    after = (fitted(np.hstack([one, own, Z]), V) ** 2).mean(axis=0)
    alone, acted = np.split((fitted(np.hstack([one, Z]), np.hstack([V, own[:, :nu]])) ** 2).mean(axis=0), 2)
    around = np.maximum((V**2).mean(axis=0) - V.mean(axis=0) ** 2, 1e-300)
    for j in np.flatnonzero(around > 1e-12):
        told = 1 - after[j] / max(left[j], 1e-300)
        exact = alone[j] < 1e-8 * around[j]
        known = alone[j] < (1 - _EXPLAINED) * around[j] and alone[j] < acted[j]
        if exact or (known and told > _NEWS and left[j] > _FREE * around[j]):
            name = short(log.data.inputs[j])
            yield LogFault(
                "feedback",
                f"the states tell {percent(1 - alone[j] / around[j])} of {name}: it was a feedback, so that A and B "
                "cannot be told apart",
                f"add noise to {name} while logging: km.Feedback(K, km.Noise(…))",
                (log.data.inputs[j],),
            )
