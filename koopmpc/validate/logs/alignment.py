"""Faults between signals: late signals, saturated actuators, and inputs without effect or dependent on other signals.

Late signals and saturated actuators are found by hypotheses. Each hypothesis undoes its fault in the log and predicts
the next row from the present one. Its score is the information on all states together, −½ log det of the residuals in
nats a sample. The score rises if a late signal is moved to its true row. It does not rise if the shift only moves
information from one sensor to another.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.lifting.base import strip_unit
from koopmpc.validate.closed_loop import stack_past_inputs
from koopmpc.validate.logs.log import Log, LogFault, compute_information, fit_residuals


@dataclass(frozen=True)
class _Limits:
    """Limits of the checks in this file, found on the corpus of tests/validate/logs; gains are in nats a sample."""

    latest: int = 8  # try shifts of a signal up to this many steps
    least_rows: int = 200  # look for lags and effects only if the log has at least this many rows
    most_rows: int = 5_000  # read at most about this many rows
    gain: float = 0.02  # nats a sample that a hypothesis must gain
    sure: float = 30.0  # nats over all rows that a hypothesis must gain
    # reject a late input if one step more or less gains this share too: a smooth input gains by any delay
    peak: float = 0.95
    preference: float = 1.15  # weight on the gain of a late input against that of a late sensor, which is rarer
    sensor: float = 0.2  # nats a sample that all states must gain by the shift of a sensor, in a log of noise only
    # nats a sample that a late sensor must gain in its own residual; 600 clean logs gained at most 0.18
    own: float = 0.3
    own_one_row: float = 0.5  # the same limit for the law that reads no earlier row
    even: float = 0.25  # share of this gain that every part of the log must show; clean logs gain in a few parts only
    one_row_latest: int = 5  # that law tries shifts up to this many steps; up to 8, a smooth clean log gained 0.75
    clear: float = 0.75  # another shift may reach at most this share of the gain of a late sensor
    clear_own: float = 0.5  # the same share if only the sensor's own residual gains
    blocks: int = 8  # all but one of this many parts of the log must agree
    # try these quantiles of an input as its limits
    limit_quantiles: tuple[float, ...] = (0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4)
    powers: tuple[int, ...] = (2, 3, 4, 5)  # a clipped input must predict better than these powers of the input
    # nats over all rows by which it must; if inputs act through tanh, the powers win by 50 or more
    sharper: float = 3.0
    left_over: float = 0.1  # reject a limit if the clipped part adds more than this share of the gain


_LIMITS = _Limits()


class Shift(NamedTuple):
    """State or input `column` (inputs follow the states) is read `steps` rows later, or earlier if negative.

    A sensor is never ahead of the plant, so a state is only read later. An earlier reading would be no evidence, since
    the future of the other states predicts it well in any case.
    """

    column: int
    steps: int


@dataclass(frozen=True, eq=False)
class AlignedRows:
    """Present rows, their inputs, the rows before and the next rows."""

    X: Float[np.ndarray, "M nx"]
    U: Float[np.ndarray, "M nu"]
    before: Float[np.ndarray, "M nx"]
    after: Float[np.ndarray, "M nx"]

    def regressors(self, log: Log) -> Float[np.ndarray, "M p"]:
        """Return the regressors of the next rows."""
        return np.hstack([log.stack_regressors(self.X, self.U), (self.before - log.center) / log.size])

    def residuals(self, log: Log, more: Float[np.ndarray, "M q"] | None = None) -> Float[np.ndarray, "M nx"]:
        """Return the residuals of the next rows, in sizes of the states; `more` are further regressors."""
        P = self.regressors(log)
        P = P if more is None else np.hstack([P, more])
        return fit_residuals(P, (self.after - self.X) / log.size)

    def one_row_residuals(self, log: Log) -> Float[np.ndarray, "M nx"]:
        """Return the residuals of the next rows under a law that does not read the rows before."""
        return fit_residuals(log.stack_regressors(self.X, self.U), (self.after - self.X) / log.size)


def align_rows(log: Log, shifts: tuple[Shift, ...] = (), margin: int = _LIMITS.latest) -> AlignedRows:
    """Return the rows of all episodes that are `margin` away from both ends, with every signal moved by its shifts."""
    nx, nu = log.data.nx, log.data.nu
    states, inputs, offsets = np.arange(nx), np.arange(nu), np.zeros(nx + nu, dtype=np.intp)
    for shift in shifts:
        offsets[shift.column] += shift.steps
    empty = np.zeros((0, nx))
    parts, count = [(empty, np.zeros((0, nu)), empty, empty)], 0
    for episode in log.data:
        T = len(episode)
        if 2 * margin + 3 > T:
            continue
        indices = np.arange(margin + 1, T - margin)[:, None] + offsets
        X, U = np.hsplit(indices, [nx])
        parts.append((episode.X[X, states], episode.U[U, inputs], episode.X[X - 1, states], episode.X[X + 1, states]))
        count += len(indices)
        if count > _LIMITS.most_rows:
            break
    return AlignedRows(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def compute_gain(log: Log, E: Float[np.ndarray, "M nx"], other: Float[np.ndarray, "M nx"]) -> float:
    """Return the information that the residuals `other` gain over `E`, in nats a sample: the smaller number."""
    return float((compute_information(other, log.fine) - compute_information(E, log.fine)).min())


def is_better(
    log: Log, E: Float[np.ndarray, "M nx"], other: Float[np.ndarray, "M nx"], least: float = _LIMITS.gain
) -> bool:
    """Return True if `other` predicts better than `E` by more than chance, and in nearly all parts of the log."""
    agree = sum(compute_gain(log, a, b) > 0 for a, b in _pair_parts(E, other))
    return compute_gain(log, E, other) > max(least, _LIMITS.sure / len(E)) and agree >= _LIMITS.blocks - 1


def _pair_parts(E: np.ndarray, other: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the parts of the log that have to agree: rows of both residuals."""
    return [*zip(*(np.array_split(rows, _LIMITS.blocks) for rows in (E, other)), strict=True)]


def find_late_signals(log: Log) -> Iterator[LogFault]:
    """Find inputs that act late, and sensors that are late in comparison with the others."""
    data, nx = log.data, log.data.nx
    if not data.nu and nx < 2:
        return
    aligned = align_rows(log)
    if len(aligned.X) < max(_LIMITS.least_rows, 8 * aligned.regressors(log).shape[1]):
        return
    accepted: tuple[Shift, ...] = ()
    E = aligned.residuals(log)
    for _ in range(2):
        candidate = _find_best_shift(log, accepted, E)
        is_input = candidate is not None and candidate[0][0].column >= nx
        by_one_row = None if accepted or is_input else _find_shift_by_one_row(log)
        if candidate is None:
            if by_one_row is not None:
                yield _describe_shift(log, (by_one_row,), [])
            return
        best, E, alike = candidate
        if by_one_row is not None and by_one_row.column == best[0].column and by_one_row.steps != best[0].steps:
            best = (by_one_row,)  # a law with the row before may predict as well from one step more
            E = align_rows(log, best).residuals(log)
        accepted = (*accepted, *best)
        yield _describe_shift(log, best, alike)


def _find_best_shift(
    log: Log, accepted: tuple[Shift, ...], E: Float[np.ndarray, "M nx"]
) -> tuple[tuple[Shift, ...], Float[np.ndarray, "M nx"], list[int]] | None:
    """Return the shift that predicts best, its residuals, and the sensors that explain it as well; None if unsure."""
    nx = log.data.nx
    if compute_gain(log, E, 0 * E) < _LIMITS.gain:
        return None
    errors = {shift: align_rows(log, (*accepted, *shift)).residuals(log) for shift in _list_shifts(log, accepted)}
    scores = {shift: _score_shift(log, shift[0], E, other) for shift, other in errors.items()}
    if not scores:  # the only signal that can be late has its shift
        return None
    best = max(scores, key=lambda shift: scores[shift] * (_LIMITS.preference if shift[0].column >= nx else 1.0))
    if best[0].column >= nx and not _replaces_present_input(log, accepted, best, errors[best]):
        scores = {shift: score for shift, score in scores.items() if shift[0].column < nx}
        if not scores:
            return None
        best = max(scores, key=scores.__getitem__)  # the input seems late only because a sensor is
    rivals = {shift: score for shift, score in scores.items() if shift[0].column != best[0].column}
    if best[0].column < nx:
        rival_gain = max((compute_gain(log, E, errors[shift]) for shift in rivals), default=0.0)
        sure = _is_sensor_late(log, best[0], E, errors[best], max(rivals.values(), default=0.0), rival_gain)
    else:
        near = max(scores.get(tuple(Shift(i, steps + more) for i, steps in best), 0.0) for more in (-1, 1))
        sure = is_better(log, E, errors[best]) and near < _LIMITS.peak * scores[best]
    alike = {shift[0].column for shift, score in rivals.items() if score > _LIMITS.clear * scores[best]}
    return (best, errors[best], sorted(i for i in alike if i < nx)) if sure else None


def _score_shift(log: Log, shift: Shift, E: Float[np.ndarray, "M nx"], other: Float[np.ndarray, "M nx"]) -> float:
    """Return the gain of a shift; for a sensor, at most the gain of its own residual.

    If a sensor is not late, a shift of it may still improve the prediction of other states. But it worsens the
    prediction of the sensor itself.
    """
    gain = compute_gain(log, E, other)
    return min(gain, _compute_own_gain(log, shift, E, other)) if shift.column < log.data.nx else gain


def _compute_own_gain(log: Log, shift: Shift, E: Float[np.ndarray, "M nx"], other: Float[np.ndarray, "M nx"]) -> float:
    """Return the information on the shifted state that the residuals `other` gain over `E`, in nats a sample."""
    own, floor = slice(shift.column, shift.column + 1), log.fine[shift.column : shift.column + 1]
    return float((compute_information(other[:, own], floor) - compute_information(E[:, own], floor)).min())


def _is_sensor_late(
    log: Log,
    shift: Shift,
    E: Float[np.ndarray, "M nx"],
    other: Float[np.ndarray, "M nx"],
    rival_score: float,
    rival_gain: float,
) -> bool:
    """Return True if a sensor is late; the rivals are the best score and the best gain of shifts of other signals.

    There are two criteria. First, all states together gain much. This limit is higher in a log with little noise: there
    the errors are a smooth misfit of the regression, which depends on the row that is read. Second, the sensor itself
    gains a little in every part of the log, and no other shift gains half of it. The second criterion does not hold for
    a shift by one step in a log with little noise.
    """
    misfit = float(np.subtract(*compute_information(E, log.fine)))
    gain = _score_shift(log, shift, E, other)
    if gain <= 0 or rival_score > _LIMITS.clear * gain:
        return False
    if rival_gain <= _LIMITS.clear * compute_gain(log, E, other) and is_better(
        log, E, other, _LIMITS.sensor * (1 + misfit)
    ):
        return True
    if gain < _LIMITS.own or rival_score > _LIMITS.clear_own * gain or (shift.steps == 1 and misfit > 1):
        return False
    return all(_compute_own_gain(log, shift, a, b) > _LIMITS.even * gain for a, b in _pair_parts(E, other))


def _find_shift_by_one_row(log: Log) -> Shift | None:
    """Return the shift of a late sensor that a law of the present row shows, or None.

    The last two rows of a slow state predict its next row so well that other signals add nothing; its residual is then
    the same whether the sensor is late or not. A law without the row before must predict this state from the other
    signals. The function returns None if the inputs do not improve the prediction: a periodic motion can be predicted
    from any of its rows.
    """
    if log.data.nx < 2:
        return None
    aligned = align_rows(log)
    E = aligned.one_row_residuals(log)
    without_inputs = fit_residuals(log.regressors(aligned.X), (aligned.after - aligned.X) / log.size)
    if compute_gain(log, without_inputs, E) < _LIMITS.gain:
        return None
    best, most = None, _LIMITS.own_one_row
    for i, steps in product(range(log.data.nx), range(1, _LIMITS.one_row_latest + 1)):
        other = align_rows(log, (Shift(i, steps),)).one_row_residuals(log)
        means = [[np.mean(part**2) + 1e-20 for part in pair] for pair in _pair_parts(E[:, i], other[:, i])]
        gains = [0.5 * float(np.log(a / b)) for a, b in means]
        if np.median(gains) > most and min(gains) > _LIMITS.even * np.median(gains):
            best, most = Shift(i, steps), float(np.median(gains))
    return best


def _list_shifts(log: Log, accepted: tuple[Shift, ...]) -> Iterator[tuple[Shift, ...]]:
    """Yield the shifts of one signal, or of all inputs together, for signals that have no accepted shift yet."""
    nx, nu = log.data.nx, log.data.nu
    taken = {shift.column for shift in accepted}
    for steps in range(1, _LIMITS.latest + 1):
        if nu > 1 and not taken.intersection(range(nx, nx + nu)):
            yield tuple(Shift(nx + j, -steps) for j in range(nu))
        for j in range(nu):
            if nx + j not in taken:
                yield (Shift(nx + j, -steps),)
        for i in range(nx if nx > 1 else 0):
            if i not in taken:
                yield (Shift(i, steps),)


def _replaces_present_input(
    log: Log, accepted: tuple[Shift, ...], shift: tuple[Shift, ...], E: Float[np.ndarray, "M nx"]
) -> bool:
    """Return True if the input of the present row adds almost nothing to the late input."""
    now, moved = align_rows(log, accepted), align_rows(log, (*accepted, *shift))
    both = moved.residuals(log, log.scale(now.X, now.U)[1])
    return compute_gain(log, E, both) < 0.1 * compute_gain(log, now.residuals(log), both)


def _describe_shift(log: Log, shift: tuple[Shift, ...], alike: list[int]) -> LogFault:
    """Return the fault of a late signal; a late input is explained as well by a delay of a sensor in `alike`."""
    steps = abs(shift[0].steps)
    names = tuple(log.names[part.column] for part in shift)
    signals = " and ".join(strip_unit(name) for name in names)
    count = f"{steps} step{'s' * (steps > 1)}"
    remedy = f"let the model see the past: embedding=km.Delay({steps})"
    if shift[0].column >= log.data.nx:
        acts = "acts" if len(names) == 1 else "act"
        others = " or ".join(strip_unit(log.names[i]) for i in alike)
        instead = f", unless the sensor of {others} is {count} behind" if alike else ""
        return LogFault("input delay", f"{signals} {acts} {count} late{instead}", remedy, names, steps=steps)
    says = f"{signals} is {count} behind the other signals"
    return LogFault("late sensor", says, f"move its column by {count}, or {remedy}", names, steps=steps)


def find_saturated_actuators(log: Log) -> Iterator[LogFault]:
    """Find inputs that have no further effect beyond some value, because the actuator is at its limit."""
    aligned = align_rows(log, margin=1)
    if not log.data.nu or len(aligned.X) < max(_LIMITS.least_rows, 8 * aligned.regressors(log).shape[1]):
        return
    E = aligned.residuals(log)
    for j in range(log.data.nu):
        column = aligned.U[:, j]
        candidates = list(_list_limits(column))
        if not candidates:
            continue
        gains = [compute_gain(log, E, _clip_input(aligned, j, *pair).residuals(log)) for pair in candidates]
        low, high = candidates[int(np.argmax(gains))]
        if not is_better(log, E, _clip_input(aligned, j, low, high).residuals(log)):
            continue
        low, high = _refine_limits(log, aligned, j, low, high)
        clipped = _clip_input(aligned, j, low, high)
        rest = (column - clipped.U[:, j])[:, None] / log.input_size[j]
        inside = clipped.residuals(log)
        if compute_gain(log, inside, clipped.residuals(log, rest)) > _LIMITS.left_over * compute_gain(log, E, inside):
            continue
        v = (aligned.U[:, [j]] - log.input_center[j]) / log.input_size[j]
        smooth = aligned.residuals(log, np.hstack([v**power for power in _LIMITS.powers]))
        if compute_gain(log, smooth, inside) < _LIMITS.sharper / len(smooth):
            continue  # a smooth curve predicts as well: the plant is nonlinear, and the actuator has no limit there
        name = strip_unit(log.data.inputs[j])
        ends = [f"below {low:.3g}"] * bool(low > column.min()) + [f"above {high:.3g}"] * bool(high < column.max())
        call = [f"u_min={low:.3g}"] * bool(low > column.min()) + [f"u_max={high:.3g}"] * bool(high < column.max())
        yield LogFault(
            "actuator at its limit",
            f"{name} has no more effect {' and '.join(ends)}: the actuator ends there, and the log holds the command",
            f"clip {name} in the log to what was applied, and tell the controller: km.Limits({', '.join(call)})",
            (log.data.inputs[j],),
        )


def _list_limits(column: Float[np.ndarray, " M"]) -> Iterator[tuple[float, float]]:
    """Yield low and high limits at quantiles of the input, on both sides or on one."""
    for side, q in product(("both", "high", "low"), _LIMITS.limit_quantiles):
        low = float(np.quantile(column, q)) if side != "high" else float(column.min())
        high = float(np.quantile(column, 1 - q)) if side != "low" else float(column.max())
        if low < high and (low > column.min() or high < column.max()):
            yield low, high


def _clip_input(aligned: AlignedRows, j: int, low: float, high: float) -> AlignedRows:
    U = aligned.U.copy()
    U[:, j] = np.clip(U[:, j], low, high)
    return AlignedRows(aligned.X, U, aligned.before, aligned.after)


def _refine_limits(log: Log, aligned: AlignedRows, j: int, low: float, high: float) -> tuple[float, float]:
    """Return the limits that predict best, by a search around the best quantiles with a step that halves five times."""
    bottom, top = float(aligned.U[:, j].min()), float(aligned.U[:, j].max())
    width = 0.1 * (top - bottom)
    for _ in range(6):
        tries = [(a, b) for a in (low - width, low, low + width) for b in (high - width, high, high + width)]
        tries = [
            (a if low > bottom else bottom, b if high < top else top)
            for a, b in tries
            if bottom <= a < b <= top or low == bottom or high == top
        ]
        clipped = [_clip_input(aligned, j, a, b) for a, b in tries]
        scores = [float(compute_information(part.residuals(log), log.fine).sum()) for part in clipped]
        low, high = tries[int(np.argmax(scores))]
        width /= 2
    return low, high


def find_dependent_inputs(log: Log) -> Iterator[LogFault]:
    """Find inputs that follow from the other inputs."""
    U = log.U
    moving = [j for j in range(log.data.nu) if np.ptp(U[:, j]) > 0]
    V = (U[:, moving] - U[:, moving].mean(axis=0)) / np.maximum(U[:, moving].std(axis=0), 1e-300)
    for n, j in enumerate(moving):
        if n and float((fit_residuals(V[:, :n], V[:, [n]]) ** 2).mean()) < 1e-4:
            others = ", ".join(strip_unit(log.data.inputs[i]) for i in moving[:n])
            yield LogFault(
                "inputs together",
                f"{strip_unit(log.data.inputs[j])} follows from {others}: their effects cannot be told apart",
                "excite each input by its own noise",
                (log.data.inputs[j],),
            )


def find_inputs_without_effect(log: Log) -> Iterator[LogFault]:
    """Find inputs that move and change no state within a few steps."""
    nu = log.data.nu
    aligned = align_rows(log, margin=6)
    if not nu or len(aligned.X) < max(_LIMITS.least_rows, 4 * aligned.regressors(log).shape[1]):
        return
    V = np.concatenate([stack_past_inputs(e.U, 6, len(e) - 6, 6) for e in log.data if len(e) >= 15])[: len(aligned.X)]
    base = [log.regressors(aligned.X), (aligned.before - log.center) / log.size]
    Y = (aligned.after - aligned.X) / log.size
    for j in range(nu):
        history = V[:, j::nu] / log.input_size[j]
        if np.ptp(history) == 0:
            continue
        others = np.hstack([*base, *(V[:, i::nu] / log.input_size[i] for i in range(nu) if i != j)])
        E, other = fit_residuals(others, Y), fit_residuals(np.hstack([others, history]), Y)
        chance = history.shape[1] * Y.shape[1] / (2 * len(Y))
        gain = compute_information(other, log.fine)[0] - compute_information(E, log.fine)[0]
        if gain < 4 * chance + 2e-4 and not is_better(log, E, other, 1e-3):
            name = strip_unit(log.data.inputs[j])
            yield LogFault(
                "input without effect",
                f"{name} moves, and no state follows within 6 steps",
                f"check that {name} was applied and is in the right column; excite it more strongly; else leave it out",
                (log.data.inputs[j],),
            )
