"""FreeRun: models of long records, judged by free runs over stretches that no fit saw."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base.errors import hide_fit_warnings
from koopmpc.base.parallel import Progress
from koopmpc.base.values import Value
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.models.moments.read import ReadOptions
from koopmpc.models.records.free_run import HELD, PIECE, ROWS
from koopmpc.models.records.hidden_structure import HiddenStructure
from koopmpc.models.records.narx import FOLDS, is_worse
from koopmpc.models.records.structure import EXACT, Structure, fit_structure
from koopmpc.synthesis.search.candidates import Candidate, fit_candidate
from koopmpc.synthesis.search.leaderboard import LeaderboardRow, choose_model
from koopmpc.validate.scoring import AnyPredictor, forecast_errors

_GAIN = 0.98  # keep a refinement if it lowers the error on unseen rows to less than this share
PAYS = 0.9  # take a hidden state if it lowers the error on unseen rows to less than this share
_LOST = 1e3  # a free run counts as this many spreads at most
_HALVES = 2  # errors of a quarter
_ROWS_AT_ONCE = 500  # longer forecasts run in the compiled map, which takes as long to build as these rows take without
_BEHIND = 1.1  # a model that errs by this many times a rival's error on the first quarters is not fitted to others
_LONGEST = 4000  # rows of a free run that judges finalists, at most; the search for terms cuts shorter pieces


@dataclass(frozen=True, eq=False)
class FreeRun(Value):
    """How a model does on stretches of records that its fit did not see, in free run and in short forecasts."""

    # (blocks,) geometric means of both errors, relative to the spread of each state
    errors: Float[np.ndarray, " blocks"]
    # the model that is fitted to all rows stays within three times the range of the data, over each record twice
    calm: bool

    @property
    def error(self) -> float:
        """Geometric mean of the errors of the blocks."""
        return _mean(self.errors)


def judge_free_run(
    fit: Callable[[Episodes], AnyPredictor],
    learned: Episodes,
    measured: Episodes,
    first: int,
    horizon: int,
    *,
    relift: bool,
    rival: FreeRun | None = None,
    beaten: FreeRun | None = None,
    calm: bool | None = None,
) -> FreeRun:
    """Return how a fit does on each quarter of the records when it learns from the others.

    It learns from `learned` rows, smoothed for example, and is judged on `measured` ones: in free run from row `first`
    on, and in forecasts of `horizon` steps. Where it errs by a tenth more than a `rival` on each of the first two
    quarters, it is not fitted to the others: one quarter may hold what the others lack. Nor is it where it would have
    to halve the errors of `beaten` there, a model that it must beat by a tenth. Whether it is `calm` may be known.
    """
    seen, truth = cut_pieces(learned), cut_pieces(measured)
    errors: list[float] = []
    for spans, rest in leave_quarters(seen, truth, first):
        errors += measure_stretches(fit(rest), truth, spans, first, horizon, relift=relift)
        if len(errors) <= _HALVES:
            continue
        behind = rival is not None and _is_behind(errors, rival.errors[: len(errors)])
        if behind or (beaten is not None and _must_halve(errors, beaten.errors)):
            left = _HALVES * FOLDS - len(errors) if rival is None else len(rival.errors) - len(errors)
            return FreeRun(np.array(errors + [_LOST] * left), False)
    return FreeRun(np.array(errors), is_calm(fit(seen), truth, first, relift) if calm is None else calm)


def leave_quarters(learned: Episodes, truth: Episodes, first: int) -> Iterator[tuple[list[tuple[int, int]], Episodes]]:
    """Yield the rows of each quarter of the records, and the other rows, in parts that have a past."""
    for fold in range(FOLDS):
        spans = [(len(e) * fold // FOLDS, len(e) * (fold + 1) // FOLDS) for e in truth]
        sides = [(e, ends) for e, (a, b) in zip(learned, spans, strict=True) for ends in ((0, a), (b, len(e)))]
        yield spans, truth.with_episodes([e.cut(a, b) for e, (a, b) in sides if b - a > first])


def measure_spread(episodes: Episodes) -> Float[np.ndarray, " nx"]:
    """Return the standard deviation of each state, 1 where it is constant."""
    spread = np.concatenate([episode.X for episode in episodes]).std(axis=0)
    return np.where(spread > 0, spread, 1.0)


def _is_behind(errors: Sequence[float], than: Float[np.ndarray, " blocks"]) -> bool:
    """Return whether errors are far larger on each of their quarters that have rows behind `first`."""
    own, others = (np.log(np.maximum(e, EXACT)).reshape(-1, _HALVES).mean(axis=1) for e in (errors, than))
    return bool((own > others + np.log(_BEHIND)).all())


def _must_halve(errors: Sequence[float], than: Float[np.ndarray, " blocks"]) -> bool:
    """Return whether the other blocks must have less than half the errors `than`, for the mean to be low enough."""
    done = len(errors)
    gap = np.sum(np.log(np.maximum(errors, EXACT)) - np.log(np.maximum(than[:done], EXACT)))
    return bool(len(than) * np.log(PAYS) - gap < -(len(than) - done) * np.log(2))


def run_structure(structure: Structure, measured: Episodes, first: int, horizon: int) -> FreeRun:
    """Return how a sparse polynomial does on each quarter of the records; the arguments are as in `judge_free_run`."""
    if max(map(len, measured)) <= PIECE:  # the search for its terms ran it freely on the same pieces
        return FreeRun(structure.errors, structure.calm)
    fit = partial(fit_structure, structure)
    return judge_free_run(fit, measured, measured, first, horizon, relift=structure.is_nonlinear)


def _mean(errors: ArrayLike) -> float:
    """Return the geometric mean of errors."""
    return float(np.exp(np.log(np.maximum(errors, EXACT)).mean()))


def measure_stretches(
    model: AnyPredictor,
    truth: Episodes,
    spans: Sequence[tuple[int, int]],
    first: int,
    horizon: int,
    *,
    relift: bool,
) -> list[float]:
    """Return the errors on both halves of these spans: of free runs from row `first` and of short forecasts."""
    scale, free, short = measure_spread(truth), list[np.ndarray](), list[np.ndarray]()
    for e, (start, high) in zip(truth, spans, strict=True):
        low = max(start, first)
        if high - low < 2:
            continue
        run = forecast_rows(model, truth.with_episodes([e.cut(0, high)]), [first], high - first, relift)[:, 0]
        free.append(run[low - first :])
        starts = [*range(low, high - horizon + 1, horizon)]
        if starts:
            short.append(forecast_rows(model, truth.with_episodes([e]), starts, horizon, relift).transpose(1, 0, 2))
    parts = [np.array_split(np.concatenate(gaps), _HALVES) for gaps in (free, short) if gaps]
    errors: list[float] = []
    for halves in zip(*parts, strict=True):
        sizes = [_root_mean_square(half / scale) for half in halves if len(half)]
        errors.append(float(np.exp(np.mean(np.log(sizes)))))
    return errors


def is_surely_better(errors: Float[np.ndarray, " blocks"], than: Float[np.ndarray, " blocks"]) -> bool:
    """Return whether errors are smaller by 2 %, by more than one standard error, and on most of the blocks."""
    gap = np.log(np.maximum(errors, EXACT)) - np.log(np.maximum(than, EXACT))
    least = max(gap.std(ddof=1) / np.sqrt(len(gap)), -np.log(_GAIN))
    return bool(-gap.mean() > least and np.median(gap) < 0)


def _root_mean_square(gaps: Float[np.ndarray, "*rows nx"]) -> float:
    """Return the root of the mean square, not below rounding error; a lost forecast counts as 1000 spreads."""
    return max(float(np.sqrt(np.mean(np.minimum(np.abs(gaps), _LOST) ** 2))), EXACT)


def cut_pieces(episodes: Episodes) -> Episodes:
    """Return the records in pieces of at most 4000 rows, of very long data evenly spread ones."""
    pieces: list[Episode] = []
    for e in episodes:
        count = -(-len(e) // _LONGEST)
        pieces += [e.cut(len(e) * i // count, len(e) * (i + 1) // count) for i in range(count)]
    return episodes.with_episodes(pieces[:: -(-sum(map(len, pieces)) // ROWS)])


def forecast_rows(
    model: AnyPredictor, episode: Episodes, starts: Sequence[int], horizon: int, relift: bool
) -> Float[np.ndarray, "horizon starts nx"]:
    """Return the errors of forecasts that begin at these rows of one episode, without measured disturbances."""
    past = 0 if model.embedding is None else model.embedding.steps
    if relift and horizon >= _ROWS_AT_ONCE * len(starts) and not model.nw:
        points, step = model.embed(episode)[0], model.step_map()
        runs = [step.rollout(points.X[k - past], points.U[k - past : k - past + horizon])[1:] for k in starts]
        truth = [points.X[k - past + 1 : k - past + 1 + horizon] for k in starts]
        with np.errstate(invalid="ignore"):
            gaps = (np.array(truth) - np.array(runs))[..., : model.nx].swapaxes(0, 1)
        return np.where(np.isnan(gaps), np.inf, gaps)
    rows = [np.array(starts) - past]
    return np.concatenate(
        [gap for gap, _ in forecast_errors(model, model.embed(episode), rows, horizon, relift=relift)], axis=1
    )


def is_calm(model: AnyPredictor, pieces: Episodes, first: int, relift: bool) -> bool:
    """Return whether free runs over each record twice stay within three times the range of the data."""
    centre = np.concatenate([e.X for e in pieces]).mean(axis=0)
    reach = HELD * np.max([np.abs(e.X - centre).max(axis=0) for e in pieces], axis=0)
    for e in pieces:
        if len(e) <= first:
            continue
        twice = Episode(X=np.vstack([e.X, e.X[1:]]), U=np.vstack([e.U, e.U]))
        gap = forecast_rows(model, pieces.with_episodes([twice]), [first], len(twice) - first, relift)[:, 0]
        if not bool((np.abs(twice.X[first + 1 :] - gap - centre) < reach).all()):
            return False
    return True


def judge_finalists(
    rows: tuple[LeaderboardRow, ...],
    learned: Episodes,
    measured: Episodes,
    first: int,
    horizon: int,
    sparse: Mapping[str, FreeRun],
    progress: Progress | None = None,
    ran: Sequence[tuple[LeaderboardRow, FreeRun]] = (),
) -> tuple[tuple[LeaderboardRow, ...], int, dict[str, int]]:
    """Return the rows with the errors of those that ran freely, and the places of the best one and of each kind's best.

    The best row of each kind runs, with delays and without, sparse or not. Linear models with other observables than
    the states run lifted once and lifted at each step; where that is better, the row becomes one of a bilinear model
    with N = 0, for those are used so. Where smoothed rows are learned from, measured ones are tried too, and taken
    unless the smoothed ones gain. The `sparse` polynomial of each kind has run already, and so have the rows `ran`.
    """
    groups: dict[tuple[str, bool, bool], list[int]] = {}
    for i, row in enumerate(rows):
        groups.setdefault((row.kind, row.structure is None, row.delays > 0), []).append(i)
    places = [choose_model(rows, among=group) for group in groups.values()]
    every, runs = list(rows), dict[int, FreeRun]()
    for done, place in enumerate(places):
        if progress is not None:
            progress(done, len(places))
        known = sparse[rows[place].kind] if isinstance(rows[place].structure, Structure) else None
        every[place], runs[place] = (
            (rows[place], known) if known else _run_row(rows[place], learned, measured, first, horizon)
        )
    runs |= {len(every) + i: run for i, (_, run) in enumerate(ran)}
    every += [row for row, _ in ran]
    some = any(run.calm for run in runs.values())
    for place, run in runs.items():
        every[place] = replace(every[place], free=run.error if run.calm or not some else np.inf)
    kinds = {every[i].kind for i in runs}
    return tuple(every), _choose_run(every, runs), {kind: _choose_run(every, runs, kind) for kind in kinds}


def _run_row(
    row: LeaderboardRow, learned: Episodes, measured: Episodes, first: int, horizon: int
) -> tuple[LeaderboardRow, FreeRun]:
    """Return how a row's model runs, and the row: of measured rows, or lifted at each step, where that is better."""
    fit = partial(fit_quietly, row.candidate, row.ridge)
    run = judge_free_run(fit, learned, measured, first, horizon, relift=row.bilinear)
    if learned is not measured:
        raw = judge_free_run(fit, measured, measured, first, horizon, relift=row.bilinear)
        if (raw.calm, -raw.error) >= (run.calm, -run.error):  # the smoother gains nothing
            row, run, learned = replace(row, rough=True), raw, measured
    if row.kind == "linear" and row.nz > len(row.lifting.bound_states) + 1:
        again = judge_free_run(fit, learned, measured, first, horizon, relift=True)
        if again.calm >= run.calm and is_worse(run.errors, again.errors):
            return replace(row, bilinear=True, relifted=True), again
    return row, run


def _choose_run(rows: Sequence[LeaderboardRow], runs: Mapping[int, FreeRun], kind: str | None = None) -> int:
    """Return the place of the best row; one with a hidden state has to pay."""
    same = [i for i in runs if kind in (None, rows[i].kind)]
    plain = [i for i in same if not isinstance(rows[i].structure, HiddenStructure)]
    least = min((rows[i].free for i in plain), default=np.inf)
    those = [i for i in same if i in plain or rows[i].free < PAYS * least]
    sizes = [rows[i].size if i in plain else np.inf for i in those]  # of models alike one without a hidden state
    return those[choose_by_free_run([runs[i] for i in those], sizes)]


def fit_quietly(candidate: Candidate, ridge: float, data: Episodes) -> AnyPredictor:
    """Return the model of these data; doubts about the fit stand in its report."""
    with hide_fit_warnings():
        return fit_candidate(candidate, data, ridge, ReadOptions())


def choose_by_free_run(runs: Sequence[FreeRun], sizes: Sequence[float]) -> int:
    """Return the smallest model within one standard error of the best; a calm one where there is any."""
    places = [i for i, run in enumerate(runs) if run.calm] or list(range(len(runs)))
    best = min(places, key=lambda i: runs[i].error)
    near = [i for i in places if not is_worse(runs[i].errors, runs[best].errors)]
    return min(near, key=lambda i: (sizes[i], runs[i].error))
