"""choose_row: the scores of recipes, and the choice among them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from koopmpc.base.values import Value
from koopmpc.synthesis.loops.judging import LITTLE, Outcome
from koopmpc.synthesis.search.recipe import Recipe


@dataclass(frozen=True)
class ChoiceSettings:
    """What a violation or a lost run costs, and which rows of a leaderboard are alike."""

    breaks: float = 0.01  # a larger violation, as a share of the range, is less safe
    worth: float = 0.02  # a controller with an estimator may cost this share more
    worth_unstable: float = 0.05  # on an unstable plant one without an estimator may cost this share more
    lost: float = 20.0  # ratio to the best of a lost run, and the largest ratio of any run
    free: float = 0.005  # a violation up to this share of the limits' range costs nothing
    price: float = 10.0  # each further 1 % of violation adds this many percent to the cost
    alike: float = 0.005  # scores that differ by this share are alike
    unsure: float = (
        0.03  # the largest standard error by which two scores are alike, and share by which two worst runs are
    )


CHOICE = ChoiceSettings()


@dataclass(frozen=True, eq=False)
class DesignRow(Value):
    """A line of the leaderboard: one recipe.

    Attributes
    ----------
    recipe
        Model and controller.
    score
        Mean over its runs of cost × (1 + 10 max(0, violation − 0.5 %)), over the best on the same surrogate and start.
    worst
        The largest of these ratios; 20 is a lost run.
    violation
        Largest violation of a limit in any run that was not lost, as a share of its range.
    lost
        Number of lost runs: they left the data by more than half of its range, or became NaN or infinite.
    runs
        Number of runs.
    off
        True if runs with inputs 20 % off are among them. Only scores of rows with equal `off` can be compared.
    error
        Standard error of the score's difference to the best of the rows with equal `off`, as a share of the score.
    """

    recipe: Recipe
    score: float
    worst: float
    violation: float
    lost: int
    runs: int
    off: bool
    error: float = 0.0

    @property
    def title(self) -> str:
        """The recipe in words."""
        return str(self.recipe)


def choose_row(rows: Sequence[DesignRow], kind: str | None = None, *, unstable: bool = False) -> int | None:
    """Return the place of the safest, then simplest row that is as good as the best, of those judged in all conditions.

    A row is as good as the best if its score is within 0.5 % of it, or within the standard error of their difference
    where that is larger, at most 3 %. Its worst run may be at most 3 % worse: where a plant differs from its logs, one
    run shows it before the mean does. Safer is a row with fewer lost runs, then one without a violation above 1 %.
    Simpler is a row without weights, then one with a smaller model; a bilinear model counts twice its observables.
    A controller with an estimator may cost 2 % more than without one, since it corrects errors that surrogates and
    models share. So may an estimator that finds its gain, over one with a small fixed gain, which corrects them late.
    On a plant that is `unstable` where it is used, one without an estimator may cost 5 % more, for an estimator takes
    the model's error in a transient for a load.
    """
    places = [i for i, row in enumerate(rows) if row.off and kind in (None, row.recipe.candidate.kind)]
    if not places:
        return None
    best = min((rows[i] for i in places), key=lambda row: (row.score, row.worst))
    near = [i for i in places if is_alike(rows[i].score, best.score, rows[i].error)]
    near = [i for i in near if rows[i].worst <= best.worst * (1 + CHOICE.unsure)]

    def rank(i: int) -> tuple[object, ...]:
        row, one = rows[i], rows[i].recipe
        safe = row.lost, row.violation > CHOICE.breaks
        return *safe, one.weighted, one.candidate.size, one.candidate.delays, one.estimator is None, row.score, i

    place = min(near, key=rank)
    plain = replace(rows[place].recipe, estimator=None)
    same = [i for i in places if replace(rows[i].recipe, estimator=None) == plain]
    return _choose_among_estimators(rows, same, place, unstable)


def _choose_among_estimators(rows: Sequence[DesignRow], same: Sequence[int], place: int, unstable: bool) -> int:
    """Return the row whose estimator is worth its cost; the rows differ in it alone. See `choose_row`."""

    def admit(i: int, worth: float) -> bool:
        return rows[i].score <= (1 + worth) * rows[place].score

    if unstable:
        plain = [i for i in same if rows[i].recipe.estimator is None and rows[i].lost <= rows[place].lost]
        return next((i for i in plain if admit(i, CHOICE.worth_unstable)), place)
    if rows[place].recipe.estimator is None:
        some = [i for i in same if rows[i].recipe.estimator is not None and admit(i, CHOICE.worth)]
        place = min(some, key=lambda i: (rows[i].score, i), default=place)
    estimator, row = rows[place].recipe.estimator, rows[place]
    if estimator is None or estimator.gain is None:
        return place
    own = [i for i in same if rows[i].recipe.estimator == replace(estimator, gain=None) and rows[i].lost <= row.lost]
    own = [i for i in own if rows[i].worst <= (1 + CHOICE.unsure) * row.worst]
    return next((i for i in own if admit(i, CHOICE.worth)), place)


def choose_estimator(scores: Sequence[float], *, unstable: bool) -> int:
    """Return the place of the estimator that other models of the kind get; the first score is that without one.

    One that costs at most 2 % more than none is taken, for it leaves no offset; none of those on an unstable plant.
    """
    place, some = int(np.argmin(scores)), 1 + int(np.argmin(scores[1:]))
    return some if not unstable and scores[some] <= (1 + CHOICE.worth) * scores[place] else place


def rate_runs(outcomes: Sequence[Outcome]) -> Float[np.ndarray, "jobs runs"]:
    """Return cost × (1 + 10 max(0, violation − 0.5 %)) of each run over the best of its condition, at most 20.

    The smallest violation of a condition is subtracted first, because from some starts no controller keeps the limits.
    If every run of a condition is lost, all its ratios are 20.
    """
    cost, violation = (np.array([getattr(each, name) for each in outcomes]) for name in ("cost", "violation"))
    least = np.where(np.isfinite(violation), violation, np.inf).min(axis=0)
    with np.errstate(invalid="ignore"):
        priced = cost * (1 + CHOICE.price * np.maximum(violation - least - CHOICE.free, 0.0))
        priced = np.where(np.isfinite(priced), priced, np.inf)
        best = priced.min(axis=0)
        known = best[np.isfinite(best)]
        little = LITTLE * float(np.median(known)) if known.size else 0.0
        ratio = (priced + little) / np.maximum(best + little, 1e-300)
    return np.where(np.isfinite(ratio), np.minimum(ratio, CHOICE.lost), CHOICE.lost)


def average_ratios(
    ratio: Float[np.ndarray, "jobs runs"], weights: Float[np.ndarray, " runs"]
) -> Float[np.ndarray, " jobs"]:
    """Return the weighted geometric mean of each job's ratios.

    With six runs with inputs as in the data and six with inputs 20 % off, one lost run raises the mean by 40 % or 18 %.
    """
    return np.exp(np.average(np.log(ratio), axis=1, weights=weights))


def measure_errors(
    ratio: Float[np.ndarray, "jobs runs"],
    score: Float[np.ndarray, " jobs"],
    weights: Float[np.ndarray, " runs"],
) -> Float[np.ndarray, " jobs"]:
    """Return the standard error of each job's log score less that of the best job, over the runs that both share."""
    if not len(score):
        return score
    apart = np.log(ratio) - np.log(ratio[int(np.argmin(score))])
    share = weights / weights.sum()
    spread = ((apart - (apart @ share)[:, None]) ** 2) @ share
    return np.sqrt(spread * (share**2).sum())


def is_alike(score: float, best: float, error: float) -> bool:
    """Return whether a score is as good as the best one, by the standard error of their difference."""
    return bool(score <= best * (1 + max(CHOICE.alike, min(error, CHOICE.unsure))))
