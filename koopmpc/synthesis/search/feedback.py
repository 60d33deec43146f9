"""Logs of closed loops before a choice of models: noise is projected out by the set points where unseen rows gain."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, KoopmpcError, hide_fit_warnings
from koopmpc.base.text import to_percent
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.smoother import Mender
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.composed import Standardized
from koopmpc.lifting.radial import ThinPlate
from koopmpc.lifting.state import Constant, State
from koopmpc.models.fits.edmd import edmd
from koopmpc.models.innovations import RESTS, filter_states, fit_with_gain
from koopmpc.models.instruments import check_instruments, instrumental_edmd
from koopmpc.validate.closed_loop import feedback_share, measure_feedback
from koopmpc.validate.scoring import score


@dataclass(frozen=True)
class FeedbackSettings:
    """What counts as feedback, which logs are looked at, and what a way to take out its noise has to gain."""

    share: float = (
        0.05  # logs hold feedback where the states explain this share of an input, and of what its past leaves
    )
    gain: float = 0.98  # the error on unseen rows must fall to this share
    fewest: int = 200  # rows of logs without instruments from which on their noise is looked for,
    most: int = 20_000  # and up to which,
    work: int = 200_000  # with rows times states squared at most, above which a filter takes too long
    lags: int = 40  # rows of the set point that the projection sees: a loop should settle within them
    rows_per_lag: int = 4  # of the data, at least
    settles: int = 60  # rows of an episode in which a filter settles
    iterations: int = 12  # Levenberg-Marquardt steps of a filter's fit
    parts: int = 4  # parts of the rows,
    judged: int = 2  # of which so many are left out in turn
    ahead: int = 20  # steps of the forecasts that judge
    plates: int = 20  # thin plates of the model that tells noise from curvature
    ridge: float = 1e-8  # of the models that judge


SETTINGS = FeedbackSettings()
_UNUSED = "the set points are not used, and models are fitted by plain least squares"
_PLAIN = State() + Constant()
_Rows = Float[np.ndarray, "_ nr"] | None
_Size = Float[np.ndarray, " nx"]


@dataclass(frozen=True, eq=False)
class FeedbackData:
    """The data that models are to be fitted to, the (nx,) noise that was taken out of them, and a sentence."""

    episodes: Episodes
    noise: _Size
    sentence: str


@dataclass(frozen=True, eq=False)
class _Way:
    """A way to take the noise out of logs; it needs so many rows of an episode to settle."""

    settles: int
    says: str
    apply: Callable[[Episodes, Sequence[_Rows]], tuple[Episodes, _Size]]


def remove_feedback(episodes: Episodes, instruments: Sequence[ArrayLike] | None) -> FeedbackData:
    """Return logs of closed loops without the noise that feedback carries from sensors to inputs, if unseen rows gain.

    Two ways are tried where the logs hold feedback: the states as the filter of `prediction_error` sees them, and,
    with instruments, `project_on_instruments`, if the test of Hausman finds least squares biased. The linear model of
    the data must have an error in forecasts of unseen, measured rows that is 2 % below that of least squares, and
    a model with thin plates must not lose: else what looks like noise is a curvature of the plant.
    """
    if instruments is not None:
        checks.kind(instruments, "instruments", Sequence, "pass a list with the set point of each episode")
    signals = [None] * len(episodes) if instruments is None else check_instruments(episodes, instruments)
    kept = FeedbackData(episodes, np.zeros(episodes.nx), "")
    share = _measure_share(episodes, instruments is not None)
    if share < SETTINGS.share:
        if instruments is None or not episodes.nu:
            return kept
        said = f"{_UNUSED}: the logs hold no feedback, for the states explain {to_percent(share)} of the inputs"
        return replace(kept, sentence=said)
    sound, replaced = _mend(episodes)
    found: list[tuple[float, FeedbackData]] = []
    reason = ""
    for way in _list_ways(episodes, signals):
        try:
            with hide_fit_warnings():
                made, noise = way.apply(sound, signals)
                ratio = _compare_unseen(sound, signals, way)
        except (KoopmpcError, np.linalg.LinAlgError) as problem:
            reason = str(problem)
            continue
        if ratio <= SETTINGS.gain:
            said = f"the error of a linear model falls to {to_percent(ratio)} of that of least squares"
            said = f"{way.says}, since the logs hold feedback and noise: on unseen rows {said}{replaced}"
            found.append((ratio, FeedbackData(made, noise, said)))
        else:
            reason = f"on unseen rows the error is {to_percent(ratio)} of that of least squares"
    if found:
        return min(found, key=lambda one: one[0])[1]
    if instruments is None:
        return replace(kept, sentence=reason if RESTS in reason else "")
    return replace(kept, sentence=f"{_UNUSED}: {reason}")


def _measure_share(episodes: Episodes, instruments: bool) -> float:
    """Return the share of an input that the states explain; 0 where none is looked for."""
    if not episodes.nu:
        return 0.0
    if not instruments:
        looked = SETTINGS.fewest <= sum(map(len, episodes)) <= SETTINGS.most
        if not looked or measure_feedback(episodes).max() < SETTINGS.share:
            return 0.0
    return float(feedback_share(episodes, _PLAIN)[: episodes.nu].max())


def _list_ways(episodes: Episodes, signals: Sequence[_Rows]) -> list[_Way]:
    total, ways = sum(map(len, episodes)), list[_Way]()
    if total * episodes.nx**2 <= SETTINGS.work:
        said = "models are of the states as a filter sees them that was fitted together with a linear model"
        ways.append(_Way(SETTINGS.settles, said, _filter_logs))
    if signals[0] is not None:
        most = total // (SETTINGS.rows_per_lag * signals[0].shape[1] * 4)
        lags = min(SETTINGS.lags, max(most, 2), min(len(e) for e in episodes) // 2)
        said = f"models are of states and inputs as {lags} rows of the set point explain them"
        ways.append(_Way(lags, said, partial(_project_biased, lags=lags)))
    return ways


def _mend(episodes: Episodes) -> tuple[Episodes, str]:
    """Return the episodes without wild readings, which a filter would spread, and the end of a sentence."""
    try:
        mender = Mender.of(episodes)
    except DataError:
        return episodes, ""
    count = len(mender.glitches(episodes))
    return (mender(episodes), f"; {count} wild readings were replaced") if count else (episodes, "")


def _filter_logs(logs: Episodes, _: Sequence[_Rows]) -> tuple[Episodes, _Size]:
    """Return the states as the filter sees them, and the spread of what it takes out."""
    start = edmd(logs, _PLAIN)
    model, gain = fit_with_gain(start, logs, SETTINGS.iterations)
    if model is start:
        raise DataError("least squares is not found biased: no filter of the readings forecasts better")
    filtered = filter_states(model, gain, logs)
    rest = np.concatenate([e.X - f.X for e, f in zip(logs, filtered, strict=True)])
    return filtered, np.asarray(rest.std(axis=0), dtype=np.float64)


def _project_biased(logs: Episodes, signals: Sequence[_Rows], *, lags: int) -> tuple[Episodes, _Size]:
    """Return what `project_on_instruments` does, where a test finds least squares biased."""
    known = [r for r in signals if r is not None]
    tested = instrumental_edmd(logs, _PLAIN, known, lags=min(12, lags), level=0.01)
    assert tested.report is not None
    if "not found biased" in tested.report.route:
        raise DataError("no test finds that the feedback and the noise falsify it")
    return project_on_instruments(logs, known, lags)


def project_on_instruments(episodes: Episodes, signals: Sequence[ArrayLike], lags: int) -> tuple[Episodes, _Size]:
    """Return the episodes with states and inputs as the set points explain them, and the (nx,) size of the rest.

    The first stage of the two-stage method: x_k and u_k are regressed on r_k … r_{k−lags+1} and a constant over all
    episodes, of which the first lags − 1 rows are dropped. A share lags / M of the noise variance remains, and feedback
    no longer carries it from y to u. Models of any kind can be fitted to the result; if the loop is linear and settles
    within the lags, they are consistent.

    References
    ----------
    Van den Hof & Schrama, "An indirect method for transfer function estimation from closed loop data", Automatica 29,
    1993.
    """
    rows = check_instruments(episodes, signals)
    kept = [(e, r) for e, r in zip(episodes, rows, strict=True) if len(e) > lags]
    if not kept:
        raise DataError(f"no episode is longer than the {lags} rows of the set point that a projection sees")
    Q: list[np.ndarray] = []
    for e, r in kept:
        past = [r[lags - 1 - lag : len(e) + 1 - lag] for lag in range(lags)]  # rows of x_{lags−1} … x_T
        Q.append(np.hstack([np.ones((len(e) + 2 - lags, 1)), *past]))
    X = [e.X[lags - 1 :] for e, _ in kept]
    U = [e.U[lags - 1 :] for e, _ in kept]
    weights = np.linalg.lstsq(np.concatenate(Q), np.concatenate(X), rcond=1e-8)[0]
    moves = np.linalg.lstsq(np.concatenate([q[:-1] for q in Q]), np.concatenate(U), rcond=1e-8)[0]
    rest = np.asarray(np.concatenate([x - q @ weights for x, q in zip(X, Q, strict=True)]), dtype=np.float64)
    made = [Episode(X=q @ weights, U=q[:-1] @ moves, W=e.W[lags - 1 :]) for (e, _), q in zip(kept, Q, strict=True)]
    return episodes.with_episodes(made), np.asarray(rest.std(axis=0), dtype=np.float64)


def _compare_unseen(episodes: Episodes, signals: Sequence[_Rows], way: _Way) -> float:
    """Return the error of forecasts by a linear model of the changed rows over that of least squares, on unseen rows.

    A DataError says that the logs are too short, or that a model with thin plates loses by the change.
    """
    parts = _cut_parts(episodes, signals, way.settles)
    logs: list[list[float]] = []
    for fold in range(min(SETTINGS.judged, len(parts))):
        seen = [one for i, one in enumerate(parts) if i % SETTINGS.parts != fold]
        if not seen:
            break
        rest = episodes.with_episodes([e for e, _ in seen])
        judged = episodes.with_episodes([e for e, _ in parts[fold :: SETTINGS.parts]])
        ahead = min(SETTINGS.ahead, min(map(len, judged)))
        changed, _ = way.apply(rest, [r for _, r in seen])
        both = [
            [score(edmd(data, lifting, ridge=SETTINGS.ridge), judged, ahead).rmse for data in (changed, rest)]
            for lifting in (_PLAIN, _bend(rest))
        ]
        logs.append([float(np.mean(np.log(np.maximum(a, 1e-300) / np.maximum(b, 1e-300)))) for a, b in both])
    if len(logs) < min(SETTINGS.judged, max(len(parts), 1)):
        raise DataError("the logs are too short to be judged on unseen rows")
    mean = np.exp(np.mean(logs, axis=0))
    if not np.isfinite(mean).all() or mean[1] > 1:
        raise DataError("with the set points a nonlinear model forecasts unseen rows worse")
    return float(mean[0])


def _cut_parts(episodes: Episodes, signals: Sequence[_Rows], settles: int) -> list[tuple[Episode, _Rows]]:
    """Return the logs in parts in which a way settles and forecasts follow."""
    block = max(min(len(e) for e in episodes) // SETTINGS.parts, settles + SETTINGS.ahead)
    cuts = [
        (e, r, k, min(k + block, len(e)))
        for e, r in zip(episodes, signals, strict=True)
        for k in range(0, len(e), block)
    ]
    return [(e.cut(k, end), None if r is None else r[k : end + 1]) for e, r, k, end in cuts if end - k > settles + 1]


def _bend(episodes: Episodes) -> Lifting:
    """Return thin plates about rows of the episodes, beside the states."""
    X = np.concatenate([e.X for e in episodes])
    whole = Standardized.of(episodes, State())
    centers = np.unique((X[:: max(len(X) // SETTINGS.plates, 1)] - whole.mean) / whole.scale, axis=0)
    return _PLAIN + Standardized(ThinPlate(centers), whole.mean, whole.scale)
