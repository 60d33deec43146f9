"""Cross-validation: a candidate is fitted without each fold and rolled out over that fold, for all ridges.

This is how `select` chooses a ridge; the ``ridge="gcv"`` of a single fit is in identify/solve.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import accumulate
from time import perf_counter

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base import checks
from koopmpc.base.errors import DataError, KoopmpcError, hide_fit_warnings
from koopmpc.base.values import Value
from koopmpc.data.episodes import Episodes
from koopmpc.models.moments.moments import Moments
from koopmpc.models.moments.read import second_moments
from koopmpc.models.moments.solve import BilinearColumns, solve_path
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.models.records.hidden_fit import fit_hidden
from koopmpc.models.records.hidden_structure import HiddenStructure
from koopmpc.models.records.structure import Structure, solve_structure, weigh_rows
from koopmpc.models.shared.regression import Regression, build_regression
from koopmpc.synthesis.search.candidates import Candidate
from koopmpc.synthesis.search.folds import drop_fold, select_fold
from koopmpc.validate.scoring import AnyPredictor, compare_forecasts

RIDGES = tuple(10.0**power for power in range(-9, -2))
LEAST = 1e-9  # smallest ridge; with less, nearly dependent observables get weights beyond double precision
_TINY = 1e-15  # stands for an error of zero in logarithms
_ALIKE = 1.02  # the largest ridge whose errors are within this factor of the smallest ones is chosen
_STARTS = 256  # number of forecasts in a fold
EXACT = 1e-6  # smaller relative errors are due to rounding and the smallest ridge
HALF = 0.5  # a model with delays or fast growth must reduce the error to this share
_DIVERGED = 100.0  # forecasts diverge if their error exceeds this many spreads of the states


@dataclass(frozen=True, eq=False)
class Trial:
    """One task: a bound candidate, the episodes with their folds, the horizon and the ridges."""

    candidate: Candidate  # bound to the episodes' names
    # episodes, fold: episodes, and the fold of each episode
    episodes: Episodes
    fold: tuple[int, ...]
    horizon: int  # steps ahead
    # the earliest step of an episode at which forecasts start: the length of the longest embedding of all candidates,
    # so that all are judged on the same forecasts
    first: int
    ridges: tuple[float, ...]  # weights to try, the least first
    relift: bool = False  # lift the forecasts of bilinear models at every step, as BilinearMPC does
    # the same episodes as they were measured, from which hidden states learn; by default the episodes themselves
    raw: Episodes | None = None

    @property
    def lifts_at_each_step(self) -> bool:
        """Whether forecasts are lifted at every step."""
        return self.candidate.bilinear and (self.relift or self.candidate.structure is not None)

    def __str__(self) -> str:
        return f"{self.candidate.kind} {self.candidate.name}"


@dataclass(frozen=True, eq=False)
class Tried(Value):
    """The result of a trial, for each ridge."""

    candidate: Candidate  # the candidate that was tried
    ridges: tuple[float, ...]  # tikhonov weights as in `edmd`
    # (ridges, folds, horizon) root mean square over the states of the error h steps ahead, relative to each state's
    # spread. Once the forecasts of a fold diverge, its later errors are infinite.
    errors: Float[np.ndarray, "ridges folds horizon"]
    inputs: int  # number of columns of B and E
    A: Float[np.ndarray, "ridges nz nz"]  # (ridges, nz, nz) matrices A, fitted to all folds
    misfit: float  # mean over the states of (one-step residual / spread)², of all folds with the least ridge
    seconds: float  # time that the trial took

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
    """Return the ridges in ascending order; those below 1e-9 are raised to it."""
    given = checks.array(ridges, "ridges", (None,))  # pyright: ignore[reportArgumentType]  # checks.array accepts any object
    if not given.size or (given < 0).any():
        raise DataError(f"ridges is {given.tolist()}; pass weights of 0 or above, at least one")
    return tuple(sorted({max(ridge, LEAST) for ridge in given.tolist()}))
