"""Cross-validation: data in folds, and a candidate fitted without each fold and rolled out over it, for all ridges.

This is how `select` chooses a ridge; the ``ridge="gcv"`` of a single fit is in identify/solve.py.
"""

from collections.abc import Sequence, Sized
from dataclasses import dataclass, replace
from functools import reduce
from itertools import accumulate, islice, pairwise
from time import perf_counter
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from koopmpc import checks
from koopmpc.data.episodes import Episode, Episodes, join_sets
from koopmpc.data.smoother import Glitch, Mender, Smoother
from koopmpc.data.source import Changed, EpisodesMap, Held, Source
from koopmpc.errors import DataError, KoopmpcError, hide_fit_warnings
from koopmpc.identify.moments.moments import Moments
from koopmpc.identify.moments.read import second_moments, space_evenly
from koopmpc.identify.records.hidden_fit import fit_hidden
from koopmpc.identify.records.hidden_structure import HiddenStructure
from koopmpc.identify.records.structure import Structure, solve_structure, weigh_rows
from koopmpc.identify.regression import Regression, build_regression
from koopmpc.identify.solve import BilinearColumns, solve_path
from koopmpc.lifting.base import strip_unit
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.synthesis.candidates import Candidate
from koopmpc.text import with_unit
from koopmpc.validate.scoring import AnyPredictor, compare_forecasts
from koopmpc.values import Value

LEAST = 1e-9  # smallest ridge; with less, nearly dependent observables get weights beyond double precision
_TINY = 1e-15  # stands for an error of zero in logarithms
_ALIKE = 1.02  # the largest ridge whose errors are within this factor of the smallest ones is chosen
_STARTS = 256  # number of forecasts in a fold
EXACT = 1e-6  # smaller relative errors are due to rounding and the smallest ridge
HALF = 0.5  # a model with delays or fast growth must reduce the error to this share
_DIVERGED = 100.0  # forecasts diverge if their error exceeds this many spreads of the states
_PARTS = 16  # a sample is taken from at most this many parts of a source
_TOLD = 3  # a note names at most this many glitches
_AHEAD = 20  # steps of the default horizon


class Folds(NamedTuple):
    """Episodes, the fold of each episode, and sentences on changes of the data."""

    episodes: Episodes
    fold: tuple[int, ...]
    notes: tuple[str, ...]

    @property
    def number(self) -> int:
        """Number of folds."""
        return max(self.fold) + 1


def take_sample(source: Source, pairs: int) -> tuple[Episodes, tuple[str, ...]]:
    """Return episodes of about `pairs` snapshot pairs at most, spread over the source, and a sentence if not all.

    Raises
    ------
    DataError
        The source can be read once only.
    """
    if not source.replayable:
        raise DataError(
            "a stream is read once, and a selection reads its data several times; pass Episodes, "
            "km.data.Files(folder), or km.data.Stream of a list"
        )
    parts = source.parts()
    if isinstance(parts, Sized):
        every = list(parts)
        chosen = [every[i] for i in space_evenly(len(every), _PARTS)] if len(every) > _PARTS else every
        whole = len(chosen) == len(every)
    else:
        chosen, whole = list(islice(parts, _PARTS)), False
    quota = max(pairs // len(chosen), 1)
    taken: list[Episodes] = []
    for part in chosen:
        loaded = part.load()
        taken.append(_thin_episodes(loaded, quota))
        whole = whole and taken[-1] is loaded
    result = join_sets(taken)
    if whole:
        return result, ()
    steps = sum(len(episode) for episode in result)
    count = f"{len(result)} episode{'s' * (len(result) != 1)}"
    return result, (f"chosen on {steps} steps in {count}, evenly spread over the data, and fitted to all",)


def replace_glitches(source: Source, held: Episodes) -> tuple[Source, Episodes, tuple[str, ...]]:
    """Return the source and the episodes `held` of it with glitches replaced, and a sentence if there are any."""
    try:
        mender = Mender.of(held)
    except DataError:  # too few data to tell a glitch from the plant, or too many states
        return source, held, ()
    found = mender.glitches(held)
    if not found:
        return source, held, ()
    named = [_name_glitch(one, held) for one in found[:_TOLD]]
    rest = f", and {len(found) - _TOLD} more" if len(found) > _TOLD else ""
    note = f"measurements that fit neither those before nor those after were replaced: {'; '.join(named)}{rest}"
    return *_apply_change(source, held, mender), (note,)


def _name_glitch(glitch: Glitch, data: Episodes) -> str:
    """Return what was measured, where, and what stands there now; where the data are of a table, by file and line."""
    state, origin = data.states[glitch.state], data[glitch.episode].origin
    was, place = glitch.was, f"in row {glitch.row} of episode {glitch.episode}"
    if origin is not None:
        number, was = origin.locate(glitch.row, state, glitch.now)
        place = f"in {origin.place(number)}"
    return f"{with_unit(state, f'= {was:.5g}')} {place}, now {glitch.now:.4g}"


def smooth_data(source: Source, held: Episodes) -> tuple[Source, Episodes, tuple[str, ...], Float[np.ndarray, " nx"]]:
    """Return source and episodes, smoothed where noise is found, a sentence that says so, and the size of the noise.

    The size is the (nx,) standard deviation of what was taken out, zero where that is nothing. The smoother is found
    on `held`; where that is not all of the source, its parts are smoothed as they are read.
    """
    nothing = source, held, (), np.zeros(held.nx)
    try:
        smoother = Smoother.of(held)
    except DataError:
        return nothing
    if not smoother.is_noisy.any():
        return nothing
    told = ", ".join(
        with_unit(name, f"± {size:.2g}")
        for name, size, found in zip(held.states, smoother.noise, smoother.is_noisy, strict=True)
        if found
    )
    quiet = [strip_unit(name) for name, found in zip(held.states, smoother.is_noisy, strict=True) if not found]
    others = f"; that of {', '.join(quiet)} is too small to tell" if quiet else ""
    note = (
        f"the measurements hold noise (standard deviations): {told}{others}; candidates are fitted to smoothed states"
    )
    return *_apply_change(source, held, smoother), (note,), smoother.noise


def _apply_change(source: Source, held: Episodes, change: EpisodesMap) -> tuple[Source, Episodes]:
    changed = change(held)
    if isinstance(source, Held) and source.episodes is held:
        return Held(changed), changed
    return Changed(source, change, held.states, held.inputs, held.disturbances), changed


def usual_horizon(episodes: Episodes, past: int = 0) -> tuple[int, tuple[str, ...]]:
    """Return 20 steps, or as many as whole episodes allow, and a sentence if these are fewer.

    At least half of all steps are in episodes that are long enough for this and the `past` that embeddings need, so
    that the shortest ones do not determine the horizon. A single episode is later cut into four blocks.
    """
    lengths = np.sort([len(episode) for episode in episodes])[::-1]
    held = np.cumsum(lengths) >= lengths.sum() / 2
    half = int(lengths[np.argmax(held)])  # episodes as long as this hold half of the steps
    room = half if np.sum(lengths >= half) > 1 else half // 4
    ahead = min(_AHEAD, max(room - past, 1))
    if ahead == _AHEAD:
        return ahead, ()
    return ahead, (
        f"judged {ahead} step{'s' * (ahead > 1)} ahead, not {_AHEAD}: episodes of {half} steps hold half of the data, "
        "which leaves no more; a controller that looks further ahead than this needs longer episodes",
    )


def make_folds(episodes: Episodes, needed: int, folds: int, rng: np.random.Generator) -> Folds:
    """Return the episodes in folds of about equal size; few long ones are first cut into blocks.

    Episodes are dealt out at random. Neighbouring blocks are alike, so blocks keep their order and a fold is one
    stretch of time.

    Parameters
    ----------
    episodes
        Of any length.
    needed
        Steps that an episode must have to be scored.
    folds
        Number of folds; fewer if there are fewer episodes.
    rng
        Deals out the episodes.

    Raises
    ------
    DataError
        Less than two episodes, or blocks, are long enough.
    """
    notes: list[str] = []
    long = [episode for episode in episodes if len(episode) >= needed]
    short = len(episodes) - len(long)
    if short:
        notes.append(
            f"{short} of {len(episodes)} episodes are shorter than the {needed} steps that a forecast needs, and took "
            "no part in the choice"
        )
    cut = 0 < len(long) < 2 * folds
    if cut:
        number, total = len(long), sum(map(len, long))
        block = max(2 * needed, total // (4 * folds))
        long = [piece for episode in long for piece in cut_blocks(episode, block)]
        cut = len(long) > number
        if cut:
            notes.append(
                f"{number} episode{'s are' if number > 1 else ' is'} too few for {folds} folds: cut into {len(long)} "
                "blocks, and a fold is one stretch of them; neighbouring blocks are alike, so errors may be too small"
            )
    if len(long) < 2:
        given = "one episode" if len(episodes) == 1 else f"{len(episodes)} episodes, the longest"
        raise DataError(
            f"the data have {given} of {max(map(len, episodes))} steps, and a choice needs two of {needed} steps or "
            f"more, or one of {4 * needed}: pass a shorter horizon, or longer episodes"
        )
    count = min(folds, len(long))
    lengths = np.array([len(episode) for episode in long])
    fold = np.zeros(len(long), dtype=np.intp)
    if cut:
        fold[:] = np.minimum((np.cumsum(lengths) - lengths / 2) * count / lengths.sum(), count - 1)
        fold[:] = np.unique(fold, return_inverse=True)[1]
    else:
        size = np.zeros(count)
        for i in rng.permutation(len(long)):
            fold[i] = np.argmin(size)
            size[fold[i]] += lengths[i]
    if fold.max() == 0:
        raise DataError(f"all {len(long)} episodes fell into one fold; pass more of them, or a shorter horizon")
    return Folds(episodes.with_episodes(long), tuple(fold.tolist()), tuple(notes))


def select_fold(episodes: Episodes, fold: Sequence[int], wanted: int) -> Episodes:
    """Return the episodes of one fold."""
    return episodes.with_episodes([episode for episode, own in zip(episodes, fold, strict=True) if own == wanted])


def drop_fold(episodes: Episodes, fold: Sequence[int], out: int) -> Episodes:
    """Return the episodes of all folds but one."""
    return episodes.with_episodes([episode for episode, own in zip(episodes, fold, strict=True) if own != out])


def cut_blocks(episode: Episode, steps: int) -> list[Episode]:
    """Return an episode in equal blocks of at least `steps` steps; no two blocks share a snapshot pair."""
    count = max(len(episode) // steps, 1)
    at = np.linspace(0, len(episode), count + 1).astype(int)
    return [episode.cut(a, b) for a, b in pairwise(at.tolist())]


def _thin_episodes(episodes: Episodes, quota: int) -> Episodes:
    """Return evenly spread episodes of about `quota` steps in total; a longer episode is cut to its beginning."""
    total = sum(len(episode) for episode in episodes)
    if total <= quota:
        return episodes
    wanted = max(len(episodes) * quota // total, 1)
    kept = [episodes[i] for i in space_evenly(len(episodes), wanted)]
    cut = [e if len(e) <= quota else e.cut(0, quota) for e in kept]
    return episodes.with_episodes(cut)


@dataclass(frozen=True, eq=False)
class Trial:
    """One task: a bound candidate, the episodes with their folds, the horizon and the ridges.

    Attributes
    ----------
    candidate
        Bound to the episodes' names.
    episodes, fold
        Episodes, and the fold of each episode.
    horizon
        Steps ahead.
    first
        The earliest step of an episode at which forecasts start: the length of the longest embedding of all
        candidates, so that all are judged on the same forecasts.
    ridges
        Weights to try, the least first.
    relift
        Lift the forecasts of bilinear models at every step, as BilinearMPC does.
    raw
        The same episodes as they were measured, from which hidden states learn; by default the episodes themselves.
    """

    candidate: Candidate
    episodes: Episodes
    fold: tuple[int, ...]
    horizon: int
    first: int
    ridges: tuple[float, ...]
    relift: bool = False
    raw: Episodes | None = None

    @property
    def lifts_at_each_step(self) -> bool:
        """Whether forecasts are lifted at every step."""
        return self.candidate.bilinear and (self.relift or self.candidate.structure is not None)

    def __str__(self) -> str:
        return f"{self.candidate.kind} {self.candidate.name}"


@dataclass(frozen=True, eq=False)
class Tried(Value):
    """The result of a trial, for each ridge.

    Attributes
    ----------
    candidate
        The candidate that was tried.
    ridges
        Tikhonov weights as in `edmd`.
    errors
        (ridges, folds, horizon) root-mean-square error over the states h steps ahead, each relative to the state's
        spread; infinite from the step on at which the forecasts of a fold diverge.
    inputs
        Number of columns of B and E.
    A
        (ridges, nz, nz) matrices A, fitted to all folds.
    misfit
        Mean over the states of (one-step residual / spread)², of all folds with the least ridge.
    seconds
        Time that the trial took.
    """

    candidate: Candidate
    ridges: tuple[float, ...]
    errors: Float[np.ndarray, "ridges folds horizon"]
    inputs: int
    A: Float[np.ndarray, "ridges nz nz"]
    misfit: float
    seconds: float

    @property
    def scores(self) -> Float[np.ndarray, "ridges folds"]:
        """Geometric mean of the errors over the horizon, of each fold.

        On an unstable plant errors grow from step to step, and the last steps would dominate a root-mean-square. A tame
        model with a bad next step, and hence with bad gains, could then win. In the geometric mean each step counts
        alike.
        """
        return np.exp(np.log(np.maximum(self.errors, _TINY)).mean(axis=2))

    def best(self, floor: float) -> int:
        """Return the index of the largest ridge whose mean score over the folds is within 2 % of the smallest one.

        With noisy data, ridges below the noise make no difference, and a larger ridge makes the model calmer. `floor`
        is the smallest ridge of a model with delays, whose observables are almost dependent. If every ridge is below
        `floor`, the largest one is taken.
        """
        first = int(np.searchsorted(self.ridges[:-1], floor)) if self.candidate.delays else 0
        mean = np.exp(np.log(self.scores).mean(axis=1))
        alike = max(_ALIKE * mean[first:].min(), EXACT)
        return max(i for i in range(first, len(mean)) if mean[i] <= alike)


def cross_validate(trial: Trial) -> Tried:
    """Cross-validate one candidate.

    The moments of each fold are read once. The moments of all data except a fold are the sum over the other folds. A
    further ridge costs neither a pass over the data nor a decomposition.
    """
    if isinstance(trial.candidate.structure, HiddenStructure):
        return _cross_validate_hidden(trial, trial.candidate.structure)
    start = perf_counter()
    count = max(trial.fold) + 1
    folds = [select_fold(trial.episodes, trial.fold, i) for i in range(count)]
    parts = [_moments(trial.candidate, fold) for fold in folds]
    (*rests, total), sizes = leave_one_out(parts), _sizes(trial.episodes)
    errors = np.empty((len(trial.ridges), count, trial.horizon))
    for i, fold in enumerate(folds):
        models = fit_ridges(trial.candidate, rests[i], trial.episodes, trial.ridges)
        errors[:, i] = _errors(trial, models, fold, sizes)
    return Tried(
        candidate=trial.candidate,
        ridges=trial.ridges,
        errors=errors,
        inputs=trial.episodes.nu + trial.episodes.nw,
        A=np.array([model.A for model in fit_ridges(trial.candidate, total, trial.episodes, trial.ridges)]),
        misfit=_misfit(trial.candidate, total, trial.episodes.nw),
        seconds=perf_counter() - start,
    )


def _cross_validate_hidden(trial: Trial, structure: HiddenStructure) -> Tried:
    """Cross-validate a model with a hidden state, whose fit sees measured rows and no moments, and needs no ridge."""
    start, count, sizes = perf_counter(), max(trial.fold) + 1, _sizes(trial.episodes)
    errors = np.full((1, count, trial.horizon), np.inf)
    A, learned = np.eye(trial.candidate.lifting.nz)[None], trial.episodes if trial.raw is None else trial.raw
    with hide_fit_warnings():
        try:
            A = fit_hidden(structure, learned, quick=True).A[None]
        except KoopmpcError:  # blocks are too short for its segments: no fold is judged, and it is not chosen
            count = 0
        for i in range(count):
            try:
                model = fit_hidden(structure, drop_fold(learned, trial.fold, i), quick=True)
            except KoopmpcError:  # what is left is too short
                continue
            errors[:, i] = _errors(trial, [model], select_fold(trial.episodes, trial.fold, i), sizes)
    inputs = trial.episodes.nu + trial.episodes.nw
    return Tried(trial.candidate, (0.0,), errors, inputs, A, np.inf, perf_counter() - start)


def leave_one_out(parts: Sequence[Moments]) -> list[Moments]:
    """Return for each part the sum of all others, and last the sum of all.

    All are added from the first part on, so sums up to a part are shared and the rounding is that of plain sums.
    """
    before = list(accumulate(parts))
    rests = [reduce(Moments.__add__, parts[1:])]
    rests += [reduce(Moments.__add__, parts[i + 2 :], whole) for i, whole in enumerate(before[:-1])]
    return [*rests, before[-1]]


def fit_ridges(candidate: Candidate, total: Moments, like: Episodes, ridges: tuple[float, ...]) -> list[AnyPredictor]:
    """Return the predictor of each ridge on these moments, without the checks that a report would need."""
    if isinstance(candidate.structure, Structure):  # fitted without a ridge
        return [solve_structure(candidate.structure, total)] * len(ridges)
    nz, nu, nw, which = total.nz, like.nu, like.nw, total.products
    task = _build_task(candidate, total, nw)
    C = task.C
    assert C is not None, "an extended regression has its C"
    names, past = like.disturbances, candidate.embedding
    common = (C, candidate.lifting, like.dt, like.states, like.inputs)
    models: list[AnyPredictor] = []
    for K in _solutions(candidate, task, ridges, which, nw):
        if candidate.bilinear:
            A, B, N, E, S, M = BilinearColumns(nz, nu, nw, crossed=nw > 0).split(K, which)
            models.append(BilinearPredictor(A, B, N, *common, E=E, S=S, M=M, disturbances=names, embedding=past))
        else:
            A, B, E = K[:nz].T, K[nz : nz + nu].T, K[nz + nu : nz + nu + nw].T
            models.append(LinearPredictor(A, B, *common, E=E, disturbances=names, embedding=past))
    return models


def _misfit(candidate: Candidate, total: Moments, nw: int) -> float:
    if isinstance(candidate.structure, Structure):
        return np.inf  # it is fitted without a ridge, and takes no part in the choice of the least one
    task = _build_task(candidate, total, nw)
    rows, where = task.rows, task.x_next
    (K,) = _solutions(candidate, task, (LEAST,), total.products, nw)
    energy = (np.sum(rows.subtract_means().T[:, where] ** 2, axis=0) + rows.rest[where]) / rows.samples
    return float(np.mean(rows.residual(where, task.decode(K)) ** 2 / np.where(energy > 0, energy, 1.0)))


def _build_task(candidate: Candidate, total: Moments, nw: int) -> Regression:
    """Return the regression of these moments; of a bilinear candidate with its columns in their order."""
    task = build_regression(total, "select")
    if not candidate.bilinear:
        return task
    return replace(task, rows=_list_columns(task, nw).arrange(task.rows, total.products, total.products))


def _list_columns(task: Regression, nw: int) -> BilinearColumns:
    """Return the columns of a bilinear candidate, whose signals are u, w and w⊗u."""
    return BilinearColumns(task.lifting.nz, (len(task.inputs) - nw) // (1 + nw), nw, crossed=nw > 0)


def _solutions(
    candidate: Candidate, task: Regression, ridges: Sequence[float], which: Int[np.ndarray, " np"], nw: int
) -> list[Float[np.ndarray, "n nz"]]:
    """Return K of each ridge. The ridge of a bilinear model pulls it towards z⁺ = z, as in the final fit."""
    nz = task.lifting.nz
    if not candidate.bilinear:
        light = task.affine_columns if candidate.towards == "affine" else ()
        return [solution.K for solution in solve_path(task.rows.keep_targets(nz), ridges, light=light)]
    P, rows = task.rows.P, task.rows
    start = np.eye(P.shape[1], nz)
    change = replace(rows, T=rows.T[:, :nz] - P @ start, rest=rows.rest[:nz])
    shifted, back = _list_columns(task, nw).centre(change, which)
    return [back @ solution.K + start for solution in solve_path(shifted, ridges)]


def _moments(candidate: Candidate, episodes: Episodes) -> Moments:
    """Return moments as triangular factors, whatever their condition, so that all folds are solved in the same way."""
    sparse, weights = isinstance(candidate.structure, Structure), None
    products = candidate.bilinear
    if isinstance(candidate.structure, Structure):
        products, weights = candidate.structure.has_products, weigh_rows(candidate.structure)
    return second_moments(
        episodes.driven(products=candidate.bilinear and not sparse),
        candidate.lifting,
        embedding=candidate.embedding,
        route="qr",
        bilinear=products,
        weights=weights,
    )


def _sizes(episodes: Episodes) -> Float[np.ndarray, " nx"]:
    """Return the standard deviation of each state over all episodes; 1 for a constant state."""
    X = np.concatenate([episode.X for episode in episodes])
    scale = X.std(axis=0)
    return np.where(scale > 1e-12 * np.abs(X.mean(axis=0)), scale, 1.0)


def _errors(
    trial: Trial, models: list[AnyPredictor], fold: Episodes, sizes: Float[np.ndarray, " nx"]
) -> Float[np.ndarray, "models horizon"]:
    points = models[0].embed(fold)
    late = trial.first - trial.candidate.delays
    every = [np.arange(late, len(episode) - trial.horizon + 1) for episode in points]
    stride = max(sum(map(len, every)) // _STARTS, 1)
    starts: list[Int[np.ndarray, " n"]] = [k[: 1 + (len(k) - 1) // stride * stride : stride] for k in every]
    total, count = np.zeros((len(models), trial.horizon)), 0
    for gaps, _ in compare_forecasts(models, points, starts, trial.horizon, relift=trial.lifts_at_each_step):
        with np.errstate(over="ignore"):
            total += ((gaps / sizes) ** 2).mean(axis=3).sum(axis=2)
        count += gaps.shape[2]
    result = np.sqrt(total / count)
    for row in result:
        lost = np.flatnonzero(~(row < _DIVERGED))
        if lost.size:
            row[lost[0] :] = np.inf
    return result


def check_ridges(ridges: object) -> tuple[float, ...]:
    """Return the ridges in ascending order; those below 1e-9 are raised to it.

    Raises
    ------
    DataError
        There is no ridge, or one is negative.
    """
    given = checks.array(ridges, "ridges", (None,))  # pyright: ignore[reportArgumentType]  # checks.array accepts any object
    if not given.size or (given < 0).any():
        raise DataError(f"ridges is {given.tolist()}; pass weights of 0 or above, at least one")
    return tuple(sorted({max(ridge, LEAST) for ridge in given.tolist()}))
