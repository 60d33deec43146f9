"""Logs of closed loops before a choice of models: noise is projected out by the set points where unseen rows gain."""

from collections.abc import Sequence
from typing import cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import DataError, KoopmpcError, hide_fit_warnings
from koopmpc.identify.fits.edmd import edmd
from koopmpc.identify.instruments import check_instruments, instrumental_edmd
from koopmpc.lifting.state import Constant, State
from koopmpc.text import to_percent
from koopmpc.validate.scoring import score
from koopmpc.validate.sufficiency import feedback_share

FEEDBACK = 0.05  # logs hold feedback where the states explain at least this share of an input
_LAGS = 40  # rows of the set point that the projection sees: a loop should settle within them
_EACH = 4  # rows of data for each lag, at least
_FOLDS = 4  # parts of the rows that are left out in turn
_AHEAD = 20  # steps of the forecasts that judge
_GAIN = 0.98  # the error on unseen rows must fall to this share


def project_on_instruments(
    episodes: Episodes, instruments: Sequence[ArrayLike], lags: int
) -> tuple[Episodes, Float[np.ndarray, " nx"]]:
    """Return the episodes with states and inputs as the set points explain them, and the (nx,) size of the rest.

    The first stage of the two-stage method: x_k and u_k are regressed on r_k … r_{k−lags+1} and a constant over all
    episodes. A share lags / M of the noise variance remains, and feedback no longer carries it from y to u. Models of
    any kind can be fitted to the result; if the loop is linear and settles within the lags, they are consistent.

    Parameters
    ----------
    episodes
        Logs of closed loops.
    instruments
        For each episode (T, nr) or (T + 1, nr) rows of its set point or test signal.
    lags
        Rows of it; the first lags − 1 rows of each episode are dropped.

    Raises
    ------
    DataError
        No episode is longer than the lags.
    ShapeError
        There is not one array an episode, of one row a step.

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


def use_instruments(
    episodes: Episodes, instruments: Sequence[ArrayLike]
) -> tuple[Episodes, Float[np.ndarray, " nx"], str]:
    """Return the data that models are to be fitted to, the noise that was taken out of them, and a sentence.

    The projection is used if all of this holds: the logs hold feedback; the instruments identify the plant, and the
    test of Hausman finds least squares biased; the plain linear model of projected rows has the smaller error in
    forecasts of unseen, measured rows, by 2 %.

    Parameters
    ----------
    episodes
        Logs of closed loops, as measured.
    instruments
        As for `project_on_instruments`.

    Raises
    ------
    ShapeError
        The instruments do not fit the episodes.
    """
    signals, none = _check(episodes, instruments), np.zeros(episodes.nx)
    plain = State() + Constant()
    share = float(feedback_share(episodes, plain)[: episodes.nu].max())
    if share < FEEDBACK:
        said = f"the states explain {to_percent(share)} of the inputs"
        return episodes, none, f"instruments are not used: the logs hold no feedback, for {said}"
    total = sum(map(len, episodes))
    width = signals[0].shape[1]
    lags = min(_LAGS, max(total // (_EACH * width * 4), 2), min(len(e) for e in episodes) // 2)
    try:
        with hide_fit_warnings():
            tested = instrumental_edmd(episodes, plain, signals, lags=min(12, lags), level=0.01)
    except DataError as reason:
        return episodes, none, f"instruments are not used: {reason}"
    assert tested.report is not None
    if "not found biased" in tested.report.route:
        return episodes, none, "instruments are not used: least squares is not found biased under this feedback"
    ratio = _compare_unseen(episodes, signals, lags)
    if ratio > _GAIN:
        return (
            episodes,
            none,
            f"instruments are not used: on unseen rows the error is {to_percent(ratio)} of that of least squares",
        )
    projected, noise = project_on_instruments(episodes, signals, lags)
    return (
        projected,
        noise,
        f"models are of states and inputs as {lags} rows of the set point explain them, since the logs hold feedback "
        f"and noise: on unseen rows the error of a linear model falls to {to_percent(ratio)} of that of least squares",
    )


def require_episodes(data: object) -> Episodes:
    """Return the data if they are episodes in memory, as instruments need them."""
    checks.kind(data, "the data", Episodes, "instruments go with episodes; load the source, or leave them out")
    return cast("Episodes", data)


def _compare_unseen(episodes: Episodes, signals: Sequence[Float[np.ndarray, "rows nr"]], lags: int) -> float:
    """Return the error of forecasts by a model of projected rows over that of least squares, on rows neither saw."""
    pieces: list[tuple[Episode, np.ndarray]] = []
    block = max(min(len(e) for e in episodes) // _FOLDS, lags + _AHEAD)
    for e, r in zip(episodes, signals, strict=True):
        cuts = range(0, len(e), block)
        pieces += [(e.cut(k, min(k + block, len(e))), r[k : min(k + block, len(e)) + 1]) for k in cuts]
    pieces = [(e, r) for e, r in pieces if len(e) > lags + 1]
    if len(pieces) < 2:
        return 1.0
    logs: list[float] = []
    plain = State() + Constant()
    for fold in range(min(_FOLDS, len(pieces))):
        seen = [one for i, one in enumerate(pieces) if i % _FOLDS != fold]
        out = [e for i, (e, _) in enumerate(pieces) if i % _FOLDS == fold]
        if not seen or not out:
            continue
        rest, judged = episodes.with_episodes([e for e, _ in seen]), episodes.with_episodes(out)
        ahead = min(_AHEAD, min(map(len, out)))
        try:
            with hide_fit_warnings():
                projected, _ = project_on_instruments(rest, [r for _, r in seen], lags)
                both = [score(edmd(data, plain), judged, ahead).rmse for data in (projected, rest)]
        except KoopmpcError:
            return 1.0
        logs.append(float(np.mean(np.log(np.maximum(both[0], 1e-300) / np.maximum(both[1], 1e-300)))))
    return float(np.exp(np.mean(logs))) if logs and np.isfinite(logs).all() else 1.0
