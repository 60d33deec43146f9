"""Input timing: whether an input acts on the row after its own, or within its own row.

The next row y_{k+1} is regressed on the past p_k = (y_k, y_{k−1}, …, u_k, u_{k−1}, …) and on u_{k+1}. If an input that
nobody computes from y acts on later rows only, the part of u_{k+1} that p_k does not predict is independent of all that
y_{k+1} holds, noise included: its coefficient is zero whatever the plant, its order and its noise. A coefficient that
differs from zero by more than chance says that u_{k+1} acts within its own row: a feedthrough, or a log whose input
column is one row late.

Under feedback u_{k+1} = −K y_{k+1} + … the coefficient differs from zero too, so that one log cannot tell the two
apart. Four tests look for feedback:

1. Past outputs predict an input better than its own past does (Granger), or a few of them do as well. Where no row
   shows its effect, the past holds how long the input has been held, which outputs of nonlinear plants tell.
2. The past p_k predicts an input only by K times its prediction of y_{k+1} (Sargan's test of p_k as instruments).
3. A later input u_{k+2} seems to act on y_{k+1}.
4. The law of a PD or PID controller predicts u_{k+1} as well as y_{k+1} and all the past do. The set points are white
   or constant, known up to an error, and the plant's gain does not tell that this controller would drive the output
   away.

In the first two, a feedback of one output that would drive it away does not count: no controller does that.

References
----------
Granger, "Investigating causal relations by econometric models", Econometrica 37, 1969. Sargan, "The estimation of
economic relationships using instrumental variables", Econometrica 26, 1958. White, "A heteroskedasticity-consistent
covariance matrix estimator", Econometrica 48, 1980.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import chdtrc, fdtrc

from koopmpc.base.values import Value
from koopmpc.lifting.base import strip_unit
from koopmpc.validate.logs.log import Log, LogFault


@dataclass(frozen=True)
class _Limits:
    """Limits of the test of timing, found on the corpus of tests/validate/logs."""

    lags: int = 8  # rows of states that the past holds at most
    input_lags: int = 24  # rows of inputs that the past holds at most
    each: int = 12  # rows of the log for each column of the past
    most_rows: int = 10_000  # read at most about this many rows
    sure: float = 7.0  # standard errors by which the coefficient of u_{k+1} must differ from zero
    later: float = 0.5  # reject if u_{k+2} has more than this share of the t value of u_{k+1}
    fresh: float = 1e-3  # share of an input's variance that its past must leave open
    blocks: int = 8  # in all but one of this many parts of the log the coefficient must have the same sign
    short: int = 3  # rows of the input beside which a few outputs must not predict it better
    state_rows: int = 4  # rows of these outputs
    # an input that keeps its exact value in this share of the rows does not follow a noisy output
    repeated: float = 0.3
    weak: float = 2.5  # below this t value the coefficient is taken for zero
    instruments: float = 1e-4  # significance at which a proportional feedback is rejected
    law: float = 1e-4  # significance at which the law of a controller is rejected, if
    missed: float = 0.08  # it leaves open this share more than all rows: set points are known up to an error
    exact: float = 1e-6  # share of an input's variance that an exact law leaves open, at most
    # standard errors by which the plant's gain must show that a controller would drive the output away
    tells: float = 0.5
    # squared partial correlation of u_{k+1} and y_{k+1} above which a feedback must be strong, thus seen
    strong: float = 0.1


_LIMITS = _Limits()


class _Strictness(NamedTuple):
    """Limits beyond which an input counts as a feedback."""

    significance: float  # of past outputs that predict an input beside its own past
    share: float  # of what all rows of the input predict, which a few outputs may predict as well
    gain: float  # standard errors by which the gain of a proportional feedback must differ from zero


_USUAL = _Strictness(significance=0.003, share=0.65, gain=5.0)
_STRICT = _Strictness(significance=0.05, share=0.4, gain=3.0)  # for weak effects, which a weak feedback could make


class Timing(Enum):
    """When an input acts, by its rows in the log."""

    NEXT_ROW = "acts on the next row"
    SAME_ROW = "acts within its own row"
    UNKNOWN = "cannot say"


@dataclass(frozen=True, eq=False)
class InputTiming(Value):
    """The timing of one input.

    Attributes
    ----------
    input
        Name of the input.
    timing
        `UNKNOWN` under feedback, and for an input that is too smooth.
    t
        t value of the coefficient of u_{k+1}, the largest of all states.
    why
        The reason, in words.
    feedback
        Whether the reason is a feedback, which one log cannot tell from an effect within the row.
    """

    input: str
    timing: Timing
    t: float
    why: str
    feedback: bool = False

    def __str__(self) -> str:
        """Return a sentence."""
        name = strip_unit(self.input)
        if self.timing is Timing.UNKNOWN:
            late = "if you know that its column is a row late, move it one row up"
            return f"cannot say whether {name} acts within its own row: {self.why}; {late}"
        return f"{name} {self.timing.value}: {self.why}"


@dataclass(frozen=True, eq=False)
class _Rows:
    """Rows k of all episodes: the past p_k in two parts, and what follows, all centred and of unit size."""

    states: Float[np.ndarray, "M p"]
    inputs: Float[np.ndarray, "M q"]
    products: Float[np.ndarray, "M r"]
    change: Float[np.ndarray, "M nx"]
    after: Float[np.ndarray, "M nx"]
    same: Float[np.ndarray, "M nu"]
    later: Float[np.ndarray, "M nu"]
    ages: Int[np.ndarray, "M nu"]
    repeated: Float[np.ndarray, " nu"]


def measure_timing(log: Log) -> tuple[InputTiming, ...]:
    """Return the timing of each input; `UNKNOWN` where the log is too short to tell."""
    nu, names = log.data.nu, log.data.inputs
    rows = _stack_rows(log) if nu else None
    if rows is None:
        return tuple(InputTiming(name, Timing.UNKNOWN, 0.0, "the log is too short") for name in names)
    past = _find_basis(np.hstack([rows.states, rows.inputs, rows.products]))
    fresh, left = _leave_out(past, rows.same), _leave_out(past, rows.change)
    share = (fresh**2).mean(axis=0) / np.maximum((rows.same**2).mean(axis=0), 1e-300)
    moving = share > _LIMITS.fresh
    t = np.zeros((nu, log.data.nx))
    later = np.zeros_like(t)
    if moving.any():
        t[moving], signs = _test_coefficients(fresh[:, moving], left)
        more = _find_basis(np.hstack([rows.states, rows.inputs, rows.products, rows.same]))
        beyond = _leave_out(more, rows.later)
        known = moving & ((beyond**2).mean(axis=0) > _LIMITS.fresh * (rows.same**2).mean(axis=0))
        if known.any():
            later[known], _ = _test_coefficients(beyond[:, known], _leave_out(more, rows.change))
    else:
        signs = np.zeros((0, log.data.nx))
    place = np.cumsum(moving) - 1  # of a moving input among them
    timings: list[InputTiming] = []
    for j, name in enumerate(names):
        i = int(np.argmax(np.abs(t[j])))
        value = float(t[j, i])
        judged: tuple[Timing, str, bool] = Timing.UNKNOWN, "its past predicts it, so no row shows its effect", False
        if moving[j]:
            judged = _judge_input(rows, j, value, bool(signs[place[j], i] >= _LIMITS.blocks - 1), later[j])
        timings.append(InputTiming(name, judged[0], value, *judged[1:]))
    return tuple(timings)


def _judge_input(
    rows: _Rows, j: int, t: float, agree: bool, later: Float[np.ndarray, " nx"]
) -> tuple[Timing, str, bool]:
    """Return the timing of input j, the reason, and whether that is a feedback; parts of the log may `agree` on t."""
    strong = t**2 > _LIMITS.strong * (len(rows.same) + t**2)
    limits = _USUAL if strong or abs(t) <= _LIMITS.weak else _STRICT
    if not (strong and _amplifies(rows, j, t)) and (why := _explain_feedback(rows, j, t, limits)):
        return Timing.UNKNOWN, why, True
    if abs(t) < _LIMITS.weak:
        return Timing.NEXT_ROW, "its own row does not hold its effect", False
    if abs(t) < _LIMITS.sure:
        return Timing.UNKNOWN, f"its own row may hold its effect (t = {t:.3g})", False
    if not agree or np.abs(later).max() > max(_LIMITS.later * abs(t), _LIMITS.weak):
        why = "rows before it seem to hold its effect too" if agree else "parts of the log disagree"
        return Timing.UNKNOWN, why, False
    if _follows_law(rows, j) and not _score_gain(rows, j, t) > _LIMITS.tells:
        return Timing.UNKNOWN, "a PID controller that answers to disturbances would move it in the same way", True
    return Timing.SAME_ROW, f"its own row holds its effect (t = {t:.3g})", False


def find_same_row_inputs(timings: tuple[InputTiming, ...]) -> Iterator[LogFault]:
    """Find inputs that act within their own row."""
    for one in timings:
        if one.timing is Timing.SAME_ROW:
            name = strip_unit(one.input)
            yield LogFault(
                "input in its own row",
                f"a row of {name} explains the states of the same row beyond all earlier rows (t = {one.t:.3g}): "
                f"{name} acts within its row, or its column is one row late",
                "move its column one row up before a fit; fits of records try that by themselves",
                (one.input,),
            )


def _stack_rows(log: Log) -> _Rows | None:
    """Return the rows of the test, or None if the log is too short."""
    nx, nu = log.data.nx, log.data.nu
    usual = sorted(len(e) for e in log.data)[len(log.data) // 2]
    total = min(log.steps, _LIMITS.most_rows)
    lags = int(np.clip(min((usual - 4) // 3, total // (_LIMITS.each * 3 * nx)), 1, _LIMITS.lags))
    input_lags = int(np.clip(min((usual - 4) // 2, total // (_LIMITS.each * 2 * nu)), 1, _LIMITS.input_lags))
    margin = max(lags, input_lags)
    parts: list[tuple[np.ndarray, ...]] = []
    count = 0
    for episode in log.data:
        T = len(episode)
        k = np.arange(margin, T - 2)
        if not len(k):
            continue
        Z, V = log.scale(episode.X[:-1], episode.U)
        parts.append(
            (
                np.hstack([Z[k - i] for i in range(lags + 1)]),
                np.hstack([V[k - i] for i in range(input_lags + 1)]),
                log.stack_regressors(episode.X[k], episode.U[k])[:, 1:],
                Z[k + 1] - Z[k],
                Z[k + 1],
                V[k + 1],
                V[k + 2],
                _count_held(V)[k],
            )
        )
        count += len(k)
        if count > _LIMITS.most_rows:
            break
    if not parts:
        return None
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    if len(columns[0]) < max(200, 4 * sum(column.shape[1] for column in columns[:3])):
        return None
    ages = columns.pop()
    repeated = np.mean(columns[5] == columns[1][:, :nu], axis=0)
    return _Rows(*(column - column.mean(axis=0) for column in columns), ages=ages, repeated=repeated)


def _count_held(V: Float[np.ndarray, "T nu"]) -> Int[np.ndarray, "T nu"]:
    """Return for how many rows before its own each input has had its exact value."""
    rows = np.arange(len(V))[:, None]
    changes = np.vstack([np.ones((1, V.shape[1]), bool), V[1:] != V[:-1]])
    return rows - np.maximum.accumulate(rows * changes, axis=0)


def _find_basis(P: Float[np.ndarray, "M p"]) -> Float[np.ndarray, "M rank"]:
    """Return orthonormal columns that span those of P; directions below 1e-9 of the largest are left out."""
    norms = np.linalg.norm(P, axis=0)
    Q, sizes, _ = np.linalg.svd(P[:, norms > 0] / norms[norms > 0], full_matrices=False)
    return Q[:, sizes > 1e-9 * sizes.max(initial=0.0)]


def _leave_out(Q: Float[np.ndarray, "M rank"], Y: Float[np.ndarray, "M n"]) -> Float[np.ndarray, "M n"]:
    """Return what orthonormal columns leave of Y."""
    return Y - Q @ (Q.T @ Y)


def _test_coefficients(
    W: Float[np.ndarray, "M nu"], E: Float[np.ndarray, "M nx"]
) -> tuple[Float[np.ndarray, "nu nx"], Float[np.ndarray, "nu nx"]]:
    """Return White's t values of E = W b + e, and in how many parts of the log the coefficients have b's sign."""
    inverse = np.linalg.pinv(W.T @ W)
    b = inverse @ W.T @ E
    e = E - W @ b
    weights = W @ inverse
    errors = np.sqrt(np.einsum("mj,mi->ji", weights**2, e**2))
    agree = np.zeros_like(b)
    for part, other in zip(np.array_split(W, _LIMITS.blocks), np.array_split(E, _LIMITS.blocks), strict=True):
        agree += np.sign(np.linalg.pinv(part) @ other) == np.sign(b)
    floor = 1e-12 * np.abs(b)
    return b / np.maximum(errors, np.maximum(floor, 1e-300)), agree


def _amplifies(rows: _Rows, j: int, t: float) -> bool:
    """Return whether input j, were it a feedback, would drive the one output away: no controller does that.

    y_{k+1} = Σ aᵢ y_{k−i} + Σ bᵢ u_{k−i} (+ b u_{k+1}) is fitted with and without the last term. The plant is stable,
    its past inputs act, and its gain Σ bᵢ / (1 − Σ aᵢ) has the sign of the feedback that t shows, with and without.
    """
    if rows.after.shape[1] > 1:
        return False
    lags, own = rows.states.shape[1], slice(rows.states.shape[1] + j, None, rows.same.shape[1])
    past = np.hstack([rows.states, rows.inputs])
    alone, both = (float(np.sum(_leave_out(_find_basis(P), rows.after) ** 2)) for P in (rows.states, past))
    more, free = rows.inputs.shape[1], len(past) - past.shape[1] - 1
    if fdtrc(more, free, (alone - both) / more / max(both / free, 1e-300)) > _LIMITS.instruments:
        return False
    without = np.linalg.lstsq(past, rows.after, rcond=1e-9)[0][:, 0]
    beside = np.linalg.lstsq(np.hstack([past, rows.same]), rows.after, rcond=1e-9)[0][: past.shape[1], 0]
    for k in (without, beside):
        poles = np.linalg.eigvals(np.vstack([k[:lags], np.eye(lags - 1, lags)]))
        if not (np.abs(poles) < 1).all() or k[own].sum() * t <= 0:
            return False
    return True


def _follows_law(rows: _Rows, j: int) -> bool:
    """Return whether the law of a PD or a PID controller predicts input j as well as all rows of the log do.

    PD: u_{k+1} = c₀ y_{k+1} + c₁ y_k + r_{k+1}.

    PID: u_{k+1} − u_k = c₀ y_{k+1} + c₁ y_k + c₂ y_{k−1} + r_{k+1}.

    The set points r are what y_{k+1} and the past leave open of this row of u and two before. Several outputs hold
    their slopes: laws of them have a row less.
    """
    u, nx = rows.same[:, [j]], rows.after.shape[1]
    slopes = int(nx == 1)
    every = np.hstack([rows.after, rows.states, rows.inputs])
    open_part = _leave_out(_find_basis(every), u)
    set_points = np.hstack([np.vstack([np.zeros((i, 1)), open_part[:-i]]) for i in (1, 2)])
    whole = _find_basis(np.hstack([every, set_points]))
    left = float((_leave_out(whole, u) ** 2).sum())
    for earlier, target in ((slopes, u), (slopes + 1, u - rows.inputs[:, [j]])):
        short = _find_basis(np.hstack([rows.after, rows.states[:, : nx * earlier], set_points[:, :earlier]]))
        rest = float((_leave_out(short, target) ** 2).sum())
        more, free = whole.shape[1] - short.shape[1], len(u) - whole.shape[1] - 1
        if rest < max(_LIMITS.exact * float((u**2).sum()), (1 + _LIMITS.missed) * left):
            return True
        if fdtrc(more, free, (rest - left) / more / (left / free)) > _LIMITS.law:
            return True
    return False


def _score_gain(rows: _Rows, j: int, t: float) -> float:
    """Return by how many standard errors the gain Σ bᵢ of input j on the output of t has the sign of t; 0 if unknown.

    Under feedback y_{k+1} = Σ aᵢ y_{k−i} + Σ bᵢ u_{k−i} + e holds without u_{k+1}; the controller has the other sign.
    """
    past = np.hstack([rows.states, rows.inputs])
    if rows.after.shape[1] > 1 or _find_basis(past).shape[1] < past.shape[1]:
        return 0.0
    inverse = np.linalg.pinv(past)
    weights = inverse[rows.states.shape[1] + j :: rows.same.shape[1]].sum(axis=0)
    left = _leave_out(_find_basis(past), rows.after)
    size = np.sqrt(float((left**2).sum()) / (len(past) - past.shape[1]) * float(weights @ weights))
    return float(weights @ rows.after[:, 0]) * np.sign(t) / max(size, 1e-300)


def _tells_more(
    outputs: Float[np.ndarray, "M p"], inputs: Float[np.ndarray, "M q"], u: Float[np.ndarray, "M 1"], limit: float
) -> bool:
    """Return whether past outputs predict an input beyond its past, by a test for equal variances and by White's.

    In White's each residual is without its own row: where an input moves rarely, a few rows hold most of what its past
    leaves open, and a test for equal variances finds past outputs in it by chance.
    """
    past = _find_basis(np.hstack([np.ones_like(u), inputs]))
    more = _find_basis(_leave_out(past, outputs))
    b: np.ndarray = more.T @ u[:, 0]
    e = _leave_out(more, _leave_out(past, u))[:, 0]
    free, rest = len(u) - past.shape[1] - len(b), float(e @ e)
    if not len(b) or free < 1 or rest < 1e-9 * float((u**2).sum()):
        return False
    if fdtrc(len(b), free, float(b @ b) / len(b) / (rest / free)) >= limit:
        return False
    e = e / np.maximum(1 - (past**2).sum(axis=1) - (more**2).sum(axis=1), 0.01)
    spread: np.ndarray = more.T @ (more * (e**2)[:, None])
    excess: np.ndarray = b * (np.linalg.pinv(spread) @ b)
    return bool(chdtrc(len(b), float(excess.sum())) < limit)


def _split_by_age(rows: _Rows, j: int) -> Float[np.ndarray, "M ages"]:
    """Return input j in a column for each age, zero elsewhere: one held for five rows changes after five equal ones.

    No sum of past rows tells that, but the outputs of a nonlinear plant do, so that they predict it without a feedback.
    """
    most = rows.inputs.shape[1] // rows.same.shape[1]
    ages, u = np.minimum(rows.ages[:, j], most), rows.inputs[:, j]
    return np.column_stack([u * (ages == age) for age in range(most + 1)])


def _explain_feedback(rows: _Rows, j: int, t: float, limits: _Strictness) -> str:
    """Return why input j may be a feedback of the states, or an empty text."""
    u, ones = rows.same[:, [j]], len(rows.same)
    past = rows.inputs if abs(t) > _LIMITS.sure else np.hstack([rows.inputs, _split_by_age(rows, j)])
    both = _find_basis(np.hstack([past, rows.states]))
    alone, joint = (float((_leave_out(Q, u) ** 2).sum()) for Q in (_find_basis(past), both))
    if joint < 1e-9 * float((u**2).sum()):
        return "the rows before determine it"
    if _tells_more(rows.states, past, u, limits.significance):
        return "past outputs predict it, so it may be a feedback"
    nx, nu = rows.after.shape[1], rows.same.shape[1]
    if rows.repeated[j] < _LIMITS.repeated:
        short = _find_basis(rows.inputs[:, : nu * _LIMITS.short])
        few = _find_basis(np.hstack([rows.inputs[:, : nu * _LIMITS.short], rows.states[:, : nx * _LIMITS.state_rows]]))
        base, proxy = (float((_leave_out(Q, u) ** 2).sum()) for Q in (short, few))
        more, free = few.shape[1] - short.shape[1], ones - few.shape[1] - 1
        explained = base - proxy > limits.share * (base - alone)
        if more > 0 and explained and fdtrc(more, free, (base - proxy) / more / (proxy / free)) < _LIMITS.instruments:
            return "outputs predict it as well as its own past does, so it may be a feedback"
    # two-stage least squares of u = −K y + r with the past as instruments: r must not follow from the past
    predicted = both @ (both.T @ rows.after)
    K, *_ = np.linalg.lstsq(predicted, u, rcond=1e-9)
    r = u - rows.after @ K
    rest = float((r**2).sum())
    errors = np.sqrt(np.diag(np.linalg.pinv(predicted.T @ predicted)) * rest / ones)
    if not (np.abs(K[:, 0]) > limits.gain * errors).any():
        return ""
    explained = float(((both.T @ r) ** 2).sum()) / max(rest / ones, 1e-300)
    if chdtrc(both.shape[1] - nx, explained) > _LIMITS.instruments:
        return "its past follows from the outputs as under a proportional feedback"
    return ""
