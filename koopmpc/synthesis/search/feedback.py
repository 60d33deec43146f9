"""Logs of closed loops before a choice of models: noise is projected out by the set points where unseen rows gain."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, cast, runtime_checkable

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

FEEDBACK = 0.05  # logs hold feedback where the states explain this share of an input, and of what its past leaves
_LAGS = 40  # rows of the set point that the projection sees: a loop should settle within them
_EACH = 4  # rows of data for each lag, at least
_FOLDS = 4  # parts of the rows,
_JUDGED = 2  # of which so many are left out in turn
_AHEAD = 20  # steps of the forecasts that judge
_SHORTEST = 60  # rows of an episode in which a filter settles
_ITERATIONS = 12  # Levenberg-Marquardt steps of a filter's fit
_LEAST = 200  # rows of logs without instruments, from which on their noise is looked for,
_MOST = 20_000  # and up to which,
_WORK = 200_000  # with rows times states squared at most, above which a filter takes too long
_PLATES = 20  # thin plates of the model that tells noise from curvature
_RIDGE = 1e-8  # of the models that judge
_UNUSED = "the set points are not used, and models are fitted by plain least squares"
_GAIN = 0.98  # the error on unseen rows must fall to this share


def project_on_instruments(
    episodes: Episodes, instruments: Sequence[ArrayLike], lags: int
) -> tuple[Episodes, Float[np.ndarray, " nx"]]:
    """Return the episodes with states and inputs as the set points explain them, and the (nx,) size of the rest.

    The first stage of the two-stage method: x_k and u_k are regressed on r_k … r_{k−lags+1} and a constant over all
    episodes. A share lags / M of the noise variance remains, and feedback no longer carries it from y to u. Models of
    any kind can be fitted to the result; if the loop is linear and settles within the lags, they are consistent.

    References
    ----------
    Van den Hof & Schrama, "An indirect method for transfer function estimation from closed loop data", Automatica 29,
    1993.
    """
    signals = _check(episodes, instruments)
    kept = [(e, r) for e, r in zip(episodes, signals, strict=True) if len(e) > lags]
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


def _check(episodes: Episodes, instruments: Sequence[ArrayLike]) -> list[Float[np.ndarray, "rows nr"]]:
    checks.kind(instruments, "instruments", Sequence, "pass a list with the set point of each episode")
    return check_instruments(episodes, instruments)


@dataclass(frozen=True, eq=False)
class FeedbackData:
    """The data that models are to be fitted to, the (nx,) noise that was taken out of them, and a sentence."""

    episodes: Episodes
    noise: Float[np.ndarray, " nx"]
    sentence: str


def remove_feedback(episodes: Episodes, instruments: Sequence[ArrayLike] | None) -> FeedbackData:
    """Return logs of closed loops without the noise that feedback carries from sensors to inputs, if unseen rows gain.

    Two ways are tried where the logs hold feedback: the states as the filter of `prediction_error` sees them, and,
    with instruments, `project_on_instruments`, if the test of Hausman finds least squares biased. The linear model of
    the data must have an error in forecasts of unseen, measured rows that is 2 % below that of least squares, and
    a model with thin plates must not lose: else what looks like noise is a curvature of the plant.

    """
    signals = None if instruments is None else _check(episodes, instruments)
    kept = FeedbackData(episodes, np.zeros(episodes.nx), "")
    total, plain = sum(map(len, episodes)), State() + Constant()
    if not episodes.nu or (signals is None and not _LEAST <= total <= _MOST):
        return kept
    if signals is None and measure_feedback(episodes).max() < FEEDBACK:
        return kept
    share = float(feedback_share(episodes, plain)[: episodes.nu].max())
    if share < FEEDBACK:
        if signals is None:
            return kept
        said = f"the logs hold no feedback, for the states explain {to_percent(share)} of the inputs"
        return replace(kept, sentence=f"{_UNUSED}: {said}")
    ways: list[_Way] = [_Filter()] if total * episodes.nx**2 <= _WORK else []
    if signals is not None:
        width = signals[0].shape[1]
        lags = min(_LAGS, max(total // (_EACH * width * 4), 2), min(len(e) for e in episodes) // 2)
        ways.append(_Projection(lags))
    sound, replaced = _mend(episodes)
    pieces = list(zip(sound, [None] * len(episodes) if signals is None else signals, strict=True))
    found: list[tuple[float, FeedbackData]] = []
    reason = ""
    for way in ways:
        try:
            with hide_fit_warnings():
                made, noise = way.apply(sound, pieces)
                ratio = _compare_unseen(sound, pieces, way)
        except (KoopmpcError, np.linalg.LinAlgError) as problem:
            reason = str(problem)
            continue
        if ratio <= _GAIN:
            said = f"the error of a linear model falls to {to_percent(ratio)} of that of least squares"
            said = f"{way.describe()}, since the logs hold feedback and noise: on unseen rows {said}{replaced}"
            found.append((ratio, FeedbackData(made, noise, said)))
        else:
            reason = f"on unseen rows the error is {to_percent(ratio)} of that of least squares"
    if found:
        return min(found, key=lambda one: one[0])[1]
    if signals is None:
        return replace(kept, sentence=reason if RESTS in reason else "")
    return replace(kept, sentence=f"{_UNUSED}: {reason}")


def _mend(episodes: Episodes) -> tuple[Episodes, str]:
    """Return the episodes without wild readings, which a filter would spread, and the end of a sentence."""
    try:
        mender = Mender.of(episodes)
    except DataError:
        return episodes, ""
    count = len(mender.glitches(episodes))
    return (mender(episodes), f"; {count} wild readings were replaced") if count else (episodes, "")


_Pieces = Sequence[tuple[Episode, Float[np.ndarray, "rows nr"] | None]]


@runtime_checkable
class _Way(Protocol):
    """A way to take the noise out of logs."""

    settles: int  # rows of an episode that it needs

    def apply(self, episodes: Episodes, pieces: _Pieces) -> tuple[Episodes, Float[np.ndarray, " nx"]]: ...

    def describe(self) -> str: ...


class _Filter:
    settles = _SHORTEST

    def apply(self, episodes: Episodes, pieces: _Pieces) -> tuple[Episodes, Float[np.ndarray, " nx"]]:
        """Return the states as the filter sees them, and the spread of what it takes out."""
        logs = episodes.with_episodes([e for e, _ in pieces])
        start = edmd(logs, State() + Constant())
        model, gain = fit_with_gain(start, logs, _ITERATIONS)
        if model is start:
            raise DataError("least squares is not found biased: no filter of the readings forecasts better")
        filtered = filter_states(model, gain, logs)
        rest = np.concatenate([e.X - f.X for e, f in zip(logs, filtered, strict=True)])
        return filtered, np.asarray(rest.std(axis=0), dtype=np.float64)

    def describe(self) -> str:
        return "models are of the states as a filter sees them that was fitted together with a linear model"


class _Projection:
    def __init__(self, lags: int) -> None:
        self.settles = lags

    def apply(self, episodes: Episodes, pieces: _Pieces) -> tuple[Episodes, Float[np.ndarray, " nx"]]:
        """Return states and inputs as the set points explain them, and the spread of the rest."""
        logs, signals = episodes.with_episodes([e for e, _ in pieces]), [r for _, r in pieces if r is not None]
        tested = instrumental_edmd(logs, State() + Constant(), signals, lags=min(12, self.settles), level=0.01)
        assert tested.report is not None
        if "not found biased" in tested.report.route:
            raise DataError("no test finds that the feedback and the noise falsify it")
        return project_on_instruments(logs, signals, self.settles)

    def describe(self) -> str:
        return f"models are of states and inputs as {self.settles} rows of the set point explain them"


def require_episodes(data: object) -> Episodes:
    """Return the data if they are episodes in memory, as instruments need them."""
    checks.kind(data, "the data", Episodes, "instruments go with episodes; load the source, or leave them out")
    return cast("Episodes", data)


def _compare_unseen(episodes: Episodes, pieces: _Pieces, way: _Way) -> float:
    """Return the error of forecasts by a linear model of the changed rows over that of least squares, on unseen rows."""
    block = max(min(len(e) for e in episodes) // _FOLDS, way.settles + _AHEAD)
    parts = [
        (e.cut(k, min(k + block, len(e))), None if r is None else r[k : min(k + block, len(e)) + 1])
        for e, r in pieces
        for k in range(0, len(e), block)
    ]
    parts = [(e, r) for e, r in parts if len(e) > way.settles + 1]
    logs: list[list[float]] = []
    for fold in range(min(_JUDGED, len(parts))):
        seen = [one for i, one in enumerate(parts) if i % _FOLDS != fold]
        out = [e for i, (e, _) in enumerate(parts) if i % _FOLDS == fold]
        if not seen:
            raise DataError("the logs are too short to be judged on unseen rows")
        rest, judged = episodes.with_episodes([e for e, _ in seen]), episodes.with_episodes(out)
        ahead = min(_AHEAD, min(map(len, out)))
        changed, _ = way.apply(episodes, seen)
        both = [
            [score(edmd(data, lifting, ridge=_RIDGE), judged, ahead).rmse for data in (changed, rest)]
            for lifting in (State() + Constant(), _bend(rest))
        ]
        logs.append([float(np.mean(np.log(np.maximum(a, 1e-300) / np.maximum(b, 1e-300)))) for a, b in both])
    if not logs:
        raise DataError("the logs are too short to be judged on unseen rows")
    mean = np.exp(np.mean(logs, axis=0))
    if not np.isfinite(mean).all() or mean[1] > 1:
        raise DataError("with the set points a nonlinear model forecasts unseen rows worse")
    return float(mean[0])


def _bend(episodes: Episodes) -> Lifting:
    """Return thin plates about rows of the episodes, beside the states."""
    X = np.concatenate([e.X for e in episodes])
    whole = Standardized.of(episodes, State())
    centers = np.unique((X[:: max(len(X) // _PLATES, 1)] - whole.mean) / whole.scale, axis=0)
    return State() + Constant() + Standardized(ThinPlate(centers), whole.mean, whole.scale)
