"""One candidate, cross-validated: fitted without each fold and rolled out over it, for every ridge at once.

This is how `select` chooses a ridge; the ``ridge="gcv"`` of a single fit is in identify/solve.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from time import perf_counter

import numpy as np
from jaxtyping import Float, Int

from koopmpc import checks
from koopmpc.data.episodes import Episodes
from koopmpc.errors import DataError
from koopmpc.identify.moments.moments import Moments
from koopmpc.identify.moments.read import second_moments
from koopmpc.identify.regression import Regression, regression_of
from koopmpc.identify.solve import about_means, path
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.synthesis.candidates import Candidate
from koopmpc.synthesis.folds import only
from koopmpc.validate.scoring import AnyPredictor, forecast_errors
from koopmpc.values import Value

LEAST = 1e-9  # ridge: without one, observables that are almost dependent get weights that no controller has digits for
_TINY = 1e-15  # of an error that is zero
_ALIKE = 1.02  # a larger ridge with errors so little above is worth having
_STARTS = 256  # forecasts a fold
EXACT = 1e-6  # relative errors below are what rounding and the least ridge leave
HALF = 0.5  # the share of the error below which a model with delays, or with fast growth, is worth its risk
_LOST = 100.0  # a prediction that is so many spreads off is no prediction


@dataclass(frozen=True, eq=False)
class Trial:
    """One task: a bound candidate, the episodes with their folds, the horizon and the ridges.

    Attributes
    ----------
    candidate
        Bound to the episodes' names.
    episodes, fold
        Episodes, and which fold each is in.
    horizon
        Steps ahead.
    first
        The earliest step of an episode at which forecasts start: the length of the longest embedding of all
        candidates, so that all are judged on the same forecasts.
    ridges
        Weights to try, the least first.
    relift
        Lift the forecasts of bilinear models anew at every step, as BilinearMPC does.
    """

    candidate: Candidate
    episodes: Episodes
    fold: tuple[int, ...]
    horizon: int
    first: int
    ridges: tuple[float, ...]
    relift: bool = False

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
        spread; infinite from where the forecasts of a fold run away.
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

        On an unstable plant errors grow from step to step, and a root-mean-square would be that of the last steps: a
        tame model could win that spoils the next step, and with it every gain. Here each step counts alike.
        """
        return np.exp(np.log(np.maximum(self.errors, _TINY)).mean(axis=2))

    def best(self, floor: float) -> int:
        """Return the index of the largest ridge whose mean score over the folds is within 2 % of the least one.

        Where the data hold noise, ridges below it make no difference, and a larger one makes the model calmer. `floor`
        is the least ridge of a model with delays, whose observables are almost functions of each other; where every
        ridge is below it, the largest one stands for it.
        """
        first = int(np.searchsorted(self.ridges[:-1], floor)) if self.candidate.delays else 0
        mean = np.exp(np.log(self.scores).mean(axis=1))
        alike = max(_ALIKE * mean[first:].min(), EXACT)
        return max(i for i in range(first, len(mean)) if mean[i] <= alike)


def tried(trial: Trial) -> Tried:
    """Cross-validate one candidate.

    The moments of each fold are read once. Moments add, so those of all data but a fold are the sum of the other
    folds'. A further ridge costs neither a pass over the data nor a decomposition.
    """
    begun = perf_counter()
    count = max(trial.fold) + 1
    folds = [only(trial.episodes, trial.fold, i) for i in range(count)]
    parts = [_moments(trial.candidate, fold) for fold in folds]
    total, spread = reduce(Moments.__add__, parts), _spread(trial.episodes)
    errors = np.empty((len(trial.ridges), count, trial.horizon))
    for i, fold in enumerate(folds):
        rest = reduce(Moments.__add__, (part for j, part in enumerate(parts) if j != i))
        models = fitted(trial.candidate, rest, trial.episodes, trial.ridges)
        errors[:, i] = _errors(trial, models, fold, spread)
    return Tried(
        candidate=trial.candidate,
        ridges=trial.ridges,
        errors=errors,
        inputs=trial.episodes.nu + trial.episodes.nw,
        A=np.array([model.A for model in fitted(trial.candidate, total, trial.episodes, trial.ridges)]),
        misfit=_misfit(trial.candidate, total),
        seconds=perf_counter() - begun,
    )


def fitted(candidate: Candidate, total: Moments, like: Episodes, ridges: tuple[float, ...]) -> list[AnyPredictor]:
    """Return the predictor of each ridge on these moments, without the checks that a report would need."""
    task, nz, nu, which = regression_of(total, "select"), total.nz, like.nu, total.products
    C = task.C
    assert C is not None, "an extended regression has its C"
    models: list[AnyPredictor] = []
    for K in _solutions(candidate, task, ridges, which):
        A, B = K[:nz].T, K[nz : nz + nu].T
        common = (C, candidate.lifting, like.dt, like.states, like.inputs)
        if candidate.bilinear:
            N = np.zeros((nu, nz, nz))
            N[:, :, which] = K[nz + nu :].reshape(nu, -1, nz).transpose(0, 2, 1)
            models.append(BilinearPredictor(A, B, N, *common, embedding=candidate.embedding))
        else:
            E = K[nz + nu :].T
            models.append(
                LinearPredictor(A, B, *common, E=E, disturbances=like.disturbances, embedding=candidate.embedding)
            )
    return models


def _misfit(candidate: Candidate, total: Moments) -> float:
    task = regression_of(total, "select")
    rows, where = task.rows, task.x_next
    (K,) = _solutions(candidate, task, (LEAST,), total.products)
    energy = (np.sum(rows.centred().T[:, where] ** 2, axis=0) + rows.rest[where]) / rows.samples
    return float(np.mean(rows.residual(where, task.decoded(K)) ** 2 / np.where(energy > 0, energy, 1.0)))


def _solutions(
    candidate: Candidate, task: Regression, ridges: Sequence[float], which: Int[np.ndarray, " np"]
) -> list[Float[np.ndarray, "n nz"]]:
    """Return K of each ridge. The ridge of a bilinear model pulls it towards z⁺ = z, as in the final fit."""
    P, nz = task.rows.P, task.lifting.nz
    if not candidate.bilinear:
        light = task.affine if candidate.towards == "affine" else ()
        return [solution.K for solution in path(task.rows.leading(nz), ridges, light=light)]
    start = np.eye(P.shape[1], nz)
    rows = replace(task.rows, T=task.rows.T[:, :nz] - P @ start, rest=task.rows.rest[:nz])
    shifted, back = about_means(rows, len(task.inputs), which)
    return [back @ solution.K + start for solution in path(shifted, ridges)]


def _moments(candidate: Candidate, episodes: Episodes) -> Moments:
    """Return moments as triangular factors whatever the condition, so that all folds are solved in the same way."""
    return second_moments(
        episodes if candidate.bilinear else episodes.driven(),
        candidate.lifting,
        embedding=candidate.embedding,
        route="qr",
        bilinear=candidate.bilinear,
    )


def _spread(episodes: Episodes) -> Float[np.ndarray, " nx"]:
    """Return the standard deviation of each state over all episodes; one that does not move keeps its unit."""
    X = np.concatenate([episode.X for episode in episodes])
    scale = X.std(axis=0)
    return np.where(scale > 1e-12 * np.abs(X.mean(axis=0)), scale, 1.0)


def _errors(
    trial: Trial, models: list[AnyPredictor], fold: Episodes, spread: Float[np.ndarray, " nx"]
) -> Float[np.ndarray, "models horizon"]:
    points = models[0].embed(fold)
    late = trial.first - trial.candidate.delays
    every = [np.arange(late, len(episode) - trial.horizon + 1) for episode in points]
    stride = max(sum(map(len, every)) // _STARTS, 1)
    starts: list[Int[np.ndarray, " n"]] = [k[: 1 + (len(k) - 1) // stride * stride : stride] for k in every]
    result = np.empty((len(models), trial.horizon))
    for row, model in zip(result, models, strict=True):
        total, count = np.zeros(trial.horizon), 0
        for gap, _ in forecast_errors(
            model, points, starts, trial.horizon, relift=trial.relift and trial.candidate.bilinear
        ):
            with np.errstate(over="ignore"):
                total += ((gap / spread) ** 2).mean(axis=2).sum(axis=1)
            count += gap.shape[1]
        row[:] = np.sqrt(total / count)
        lost = np.flatnonzero(~(row < _LOST))
        if lost.size:
            row[lost[0] :] = np.inf
    return result


def ridges_of(ridges: object) -> tuple[float, ...]:
    """Return the ridges, the least first, those below 1e-9 raised to it.

    Raises
    ------
    DataError
        There is none, or one is negative.
    """
    given = checks.array(ridges, "ridges", (None,))  # pyright: ignore[reportArgumentType]  # array refuses what is none
    if not given.size or (given < 0).any():
        raise DataError(f"ridges is {given.tolist()}; pass weights of 0 or above, at least one")
    return tuple(sorted({max(ridge, LEAST) for ridge in given.tolist()}))
