"""prepare_data: the data of a search: a sample without glitches, inputs in time, noise and feedback taken out."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import cast

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, KoopmpcError, hide_fit_warnings
from koopmpc.base.text import to_percent
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.smoother import Mender
from koopmpc.data.source import Source, source_of
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.composed import Standardized
from koopmpc.lifting.radial import ThinPlate
from koopmpc.lifting.state import Constant, State
from koopmpc.models.base import change_model
from koopmpc.models.fits.edmd import edmd
from koopmpc.models.innovations import RESTS, filter_states, fit_with_gain
from koopmpc.models.instruments import check_instruments, instrumental_edmd
from koopmpc.synthesis.options import SearchOptions
from koopmpc.synthesis.search.candidates import check_delays
from koopmpc.synthesis.search.data import advance_inputs, is_record, replace_glitches, smooth_data, take_sample
from koopmpc.synthesis.search.folds import cut_blocks
from koopmpc.synthesis.search.records import is_late
from koopmpc.validate.closed_loop import feedback_share, measure_feedback
from koopmpc.validate.memory import Memory, find_hidden_state
from koopmpc.validate.scoring import AnyPredictor, score

_NEAR = 10  # steps of the forecasts that say whether more of the past is worth a trial
_GAINS = 0.9  # it is, where two past steps lower the error of one to this share
_LONGER = (4,)  # then these are tried too
_EPISODES = 8  # of which a quarter is forecast
LATE_COLUMN = (
    "the inputs were moved up by one row: the log's row k holds the outputs after its inputs have acted; "
    "model.align(logs) does the same to other logs"
)


@dataclass(frozen=True, eq=False)
class PreparedData:
    """The data of a search, and what was done to them."""

    # source, held: what the chosen model is fitted to, and the episodes that the choice uses; smoothed where noise
    # was found
    source: Source
    held: Episodes
    # measured_source, measured: the same before they were smoothed
    measured_source: Source
    measured: Episodes
    noise: Float[np.ndarray, " nx"]  # (nx,) standard deviation of the noise that was taken out
    noisy: bool  # noise is still to be looked for
    record: bool  # the data are a few long records and no candidates were given
    lead: int  # rows by which the inputs were moved up
    moved: str  # sentence on these, for the report of a model
    # sampled, notes: the sentence on the sample, and all sentences on what was done
    sampled: tuple[str, ...]
    notes: tuple[str, ...]

    def mark(self, model: AnyPredictor) -> AnyPredictor:
        """Return a model whose report says how the inputs were moved."""
        report = model.report
        if not self.lead or report is None:
            return model
        return change_model(model, report=replace(report, input_lead=self.lead, changes=(*report.changes, self.moved)))


def prepare_data(data: Episodes | Source, options: SearchOptions, *, feedback: bool, feedthrough: str) -> PreparedData:
    """Return a sample of the data without glitches, with inputs in time, and without noise that feedback carries."""
    used, noise, smooth = "", None, bool(options.smooth)
    if options.instruments is not None or (smooth and feedback and isinstance(data, Episodes)):
        checks.kind(data, "the data", Episodes, "instruments go with episodes; load the source, or leave them out")
        loop = remove_feedback(cast("Episodes", data), options.instruments)
        data, noise, used = loop.episodes, loop.noise, loop.sentence
        smooth = smooth and not noise.any()
    source = source_of(data)
    if options.feedthrough and not source.nu:
        raise DataError("feedthrough says how inputs act, and the data have none; give each Episode its U")
    held, sampled = take_sample(source, options.sample)
    notes = (*sampled, used) if used else sampled
    record = options.candidates is None and is_record(held)
    if smooth:
        source, held, replaced = replace_glitches(source, held)
        notes = (*notes, *replaced)
    lead = int(options.feedthrough or (record and is_late(held)))
    moved = feedthrough if options.feedthrough else LATE_COLUMN
    if lead:
        source, held = advance_inputs(source, held)
        notes = (*notes, moved)
    noise = np.zeros(held.nx) if noise is None else noise
    return PreparedData(source, held, source, held, noise, smooth, record, lead, moved, sampled, notes)


def take_out_noise(data: PreparedData) -> PreparedData:
    """Return the data smoothed, where noise is to be looked for and found."""
    if not data.noisy:
        return data
    source, held, freed, noise = smooth_data(data.source, data.held)
    return replace(data, source=source, held=held, noise=noise, notes=(*data.notes, *freed))


def extend_past(past: Sequence[int], learned: Episodes, measured: Episodes) -> list[int]:
    """Return the past steps to try where a hidden state shows: more if two of them forecast better than one.

    Linear models of the `learned` rows forecast `measured` rows of every fourth episode, which they did not see: of
    smoothed rows a model would know from the past what only the future told. Fewer than eight episodes are cut into
    blocks; where these are too short, more past steps are tried.
    """
    if len(measured) < _EPISODES:
        share = -(-_EPISODES // len(measured))
        learned, measured = (
            each.with_episodes([block for e in each for block in cut_blocks(e, max(len(e) // share, 1))])
            for each in (learned, measured)
        )
    unseen = [i for i, e in enumerate(measured) if i % 4 == 0 and len(e) > 3 * max(past)]
    if len(unseen) < 2:
        return [*past, *_LONGER]
    seen = learned.with_episodes([e for i, e in enumerate(learned) if i % 4])
    ahead = min(_NEAR, min(len(measured[i]) for i in unseen) - 2)
    errors: list[float] = []
    with hide_fit_warnings():
        for steps in (1, 2):
            model = edmd(seen, State() + Constant(), embedding=Delay(steps))
            same = measured.with_episodes([measured[i].cut(2 - steps, len(measured[i])) for i in unseen])
            errors.append(float(np.mean(score(model, same, ahead).rmse)))
    return [*past, *_LONGER] if errors[1] < _GAINS * errors[0] else list(past)


def list_delays(data: PreparedData, delays: Sequence[int] | None) -> tuple[list[int], Memory | None]:
    """Return the past steps to try, and what shows a hidden state; None where nothing does."""
    past = check_delays((0, 1, 2) if delays is None else delays)
    memory = find_hidden_state(data.measured) if max(past) else None
    if memory is None or not memory.shows_hidden_state:
        return past, None
    return past if delays is not None else extend_past(past, data.held, data.measured), memory


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
