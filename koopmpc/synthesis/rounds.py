"""Rounds of closed loops: models by one controller each, then the best with every estimator and end of the plan."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc.base.parallel import Workers, report_stage
from koopmpc.estimate.disturbance import LiftedDisturbance
from koopmpc.synthesis.choice import DesignRow, average_ratios, choose_estimator, is_alike, measure_errors, rate_runs
from koopmpc.synthesis.loops.conditions import LoopTest, prepare_test
from koopmpc.synthesis.loops.judging import Job, Outcome, judge_job
from koopmpc.synthesis.loops.surrogates import choose_surrogates, is_unstable, rank_results
from koopmpc.synthesis.options import DesignOptions
from koopmpc.synthesis.search.cross_validation import Tried
from koopmpc.synthesis.search.recipe import Recipe
from koopmpc.synthesis.trials import PlannedTrials

_FIRST_ROUND = 5  # models of each kind that the first round judges by closed loop
_LINEAR = 2  # linear models of the first round that are tried with estimators and both terminal costs
_BILINEAR = 3  # bilinear models of the first round that are tried with an estimator or with weights
_GAINS = (None, 0.05)  # gains of the estimators: the default, and one for noisy measurements
GAINED = 0.01  # another end of the horizon is tried on further models if it costs this share less


def _list_first_round(results: Sequence[Tried], floor: float) -> list[Recipe]:
    """Return the recipes of the first round: the five best models of each kind, and plain linear ones with Q_N = Q.

    Models with a hidden state are few, and all of them are judged. Plain linear models are also tried with the smallest
    ridge, as in a textbook fit.
    """
    ranked = [recipe for _, recipe in rank_results(results, floor)]
    found: list[Recipe] = []
    for bilinear in (False, True):
        same = [one for one in ranked if one.candidate.bilinear == bilinear]
        found += same[:_FIRST_ROUND] + [one for one in same[_FIRST_ROUND:] if one.candidate.has_hidden_state]
    for one in results:
        if one.candidate.name == "x, 1" and not one.candidate.bilinear:
            found += [Recipe(one.candidate, one.ridges[i], tail=0) for i in sorted({0, one.best(floor)})]
    return found


@dataclass(frozen=True, eq=False)
class JudgedRows:
    """The leaderboard of a design with the outcome of each row, and the loops that judged them."""

    plan: PlannedTrials  # the task, its data and the folds
    test: LoopTest  # the surrogates and conditions
    # rows, outcomes: the recipes of the final rounds, the best first, then the others
    rows: tuple[DesignRow, ...]
    outcomes: Sequence[Outcome]
    unstable: bool  # whether the plant is unstable where it is used


def build_test(
    plan: PlannedTrials, results: Sequence[Tried], floor: float, options: DesignOptions, pool: Workers
) -> LoopTest:
    """Return the surrogates, which are the best models, with the conditions of all loops, and doubts about the task."""
    posed, pair = plan.posed, choose_surrogates(results, floor, hidden=plan.memory is not None)
    pair = [replace(one, feedthrough=bool(options.feedthrough)) for one in pair]
    tighten = options.margin == "errors"
    test = prepare_test(plan.folds, posed.task, pair, tighten, posed.data.noise, pool, plan.raw)
    return replace(test, doubts=(*posed.doubts, *test.doubts))


def judge_rounds(
    plan: PlannedTrials,
    results: Sequence[Tried],
    floor: float,
    test: LoopTest,
    options: DesignOptions,
    pool: Workers,
) -> JudgedRows:
    """Return the leaderboard and the outcome of each row.

    The first round judges all models with inputs as in the data. The second judges, in all conditions, the best
    bilinear model with every estimator, and the best linear model with every estimator and terminal cost. The third
    judges the second linear model likewise, and the smallest one that is as good as the best, the next bilinear models
    with the best estimator, and the best bilinear one with weights.
    """
    run, every = partial(judge_job, test), range(len(test.conditions))
    unstable = is_unstable(test.surrogates, test.task)
    screened = [replace(one, feedthrough=bool(options.feedthrough)) for one in _list_first_round(results, floor)]
    told = report_stage(options.progress, "closed loops")
    first = pool.map(run, [Job(one, test.nominal) for one in screened], told, size=Job.size)
    linear, bilinear = _find_best(test, screened, first)
    ways = _Ways.of(test, options)
    second, third = ways.list_second(linear, bilinear)
    told = report_stage(options.progress, "closed loops of the best")
    outcomes = pool.map(run, _list_jobs(second, screened, first, every), told, size=Job.size)
    third += ways.list_third(bilinear, outcomes, test.weights, unstable)
    told = report_stage(options.progress, "closed loops of the last")
    outcomes += pool.map(run, _list_jobs(third, screened, first, every), told, size=Job.size)
    rows, found = _build_leaderboard(test, (screened, first), ([*second, *third], outcomes))
    return JudgedRows(plan, test, rows, found, unstable)


def _find_best(
    test: LoopTest, screened: Sequence[Recipe], first: Sequence[Outcome]
) -> tuple[list[Recipe], list[Recipe]]:
    """Return the linear and the bilinear recipes of the first round that go on, the best first."""
    each, nominal = rate_runs(first), test.weights[test.nominal]
    score = average_ratios(each, nominal)
    error = measure_errors(each, score, nominal)
    places = sorted(range(len(screened)), key=lambda i: (score[i], i))
    ranked = [screened[i] for i in places]
    linear = [one for one in ranked if not one.candidate.bilinear][:_LINEAR]
    near = [screened[i] for i in places if is_alike(score[i], score[places[0]], error[i])]
    small = min((one for one in near if not one.candidate.bilinear), key=lambda one: one.candidate.size, default=None)
    if small is not None and small not in linear:  # else no later round can choose the simplest of equals
        linear.append(small)
    return linear, [one for one in ranked if one.candidate.bilinear][:_BILINEAR]


@dataclass(frozen=True)
class _Ways:
    """The estimators and the ends of plans that models are tried with; the first of each is the default."""

    estimators: Sequence[LiftedDisturbance | None]
    ends: Sequence[dict[str, Any]]
    horizon: int
    moves: bool

    @classmethod
    def of(cls, test: LoopTest, options: DesignOptions) -> "_Ways":
        """Return those of a task; with feedthrough each recipe has a filter, and no other estimator."""
        estimators = (None, *(LiftedDisturbance(gain=gain) for gain in _GAINS))
        horizon, moves = test.task.horizon, test.task.moves
        ends: list[dict[str, Any]] = [{}, {"tail": 0}, {"tail": horizon}]
        if moves and test.task.cost.moves_on:
            ends.append({"rests": True})
        return cls((None,) if options.feedthrough else estimators, ends, horizon, moves)

    def list_second(self, linear: Sequence[Recipe], bilinear: Sequence[Recipe]) -> tuple[list[Recipe], list[Recipe]]:
        """Return the recipes of the second round, and those of the other linear models for the third."""
        second = [replace(one, estimator=each) for one in bilinear[:1] for each in self.estimators]
        second += [replace(one, **end) for one in bilinear[:1] for end in self.ends[1:]]
        third: list[Recipe] = []
        for place, one in enumerate(linear):
            tails = (None, 0) if one.tail is None else (0,)
            some = [replace(one, estimator=each, tail=tail) for tail in tails for each in self.estimators]
            if self.moves and one.tail is None:
                some.append(replace(one, tail=self.horizon))
            (second if place == 0 else third).extend(some)
        return second, third

    def list_third(
        self,
        bilinear: Sequence[Recipe],
        outcomes: Sequence[Outcome],
        weights: Float[np.ndarray, " runs"],
        unstable: bool,
    ) -> list[Recipe]:
        """Return the bilinear recipes of the third round, with the best estimator and end of the second."""
        if not bilinear:
            return []
        count = len(self.estimators)
        scores = average_ratios(rate_runs(outcomes[:count]), weights)
        best = self.estimators[choose_estimator(scores.tolist(), unstable=unstable)] if count > 1 else None
        tried = [outcomes[0], *outcomes[count : count + len(self.ends) - 1]]
        scores = average_ratios(rate_runs(tried), weights)
        end = self.ends[int(np.argmin(scores))] if scores.min() < (1 - GAINED) * scores[0] else {}
        third = list[Recipe]()
        if not bilinear[0].candidate.has_hidden_state:  # fits of hidden states know no weights
            third.append(replace(bilinear[0], estimator=best, weighted=True, **end))
        third += [replace(one, estimator=best, **end) for one in bilinear[1:]]
        if end and best is not None:
            third.append(replace(bilinear[0], estimator=best, **end))
        return third


Round = tuple[Sequence[Recipe], Sequence[Outcome]]  # the recipes of a round, and the outcome of each


def _list_jobs(
    chosen: Sequence[Recipe], screened: Sequence[Recipe], outcomes: Sequence[Outcome], every: Sequence[int]
) -> list[Job]:
    """Return the jobs of a later round; they reuse models and runs of the first round."""
    jobs: list[Job] = []
    for one in chosen:
        same = [i for i, other in enumerate(screened) if other == one]
        alike = [i for i, other in enumerate(screened) if other.candidate == one.candidate and other.ridge == one.ridge]
        known = next((outcomes[i] for i in (*same, *alike) if outcomes[i].models), None)
        jobs.append(Job(one, every, known, known_runs=bool(same) and known is outcomes[same[0]]))
    return jobs


def _build_leaderboard(test: LoopTest, screened: Round, last: Round) -> tuple[tuple[DesignRow, ...], list[Outcome]]:
    """Return the rows and their outcomes: first the recipes of the final round, the best first, then the others."""
    both: list[tuple[DesignRow, Outcome]] = []
    nominal = test.weights[test.nominal]
    for off, (recipes, outcomes), weights in ((True, last, test.weights), (False, screened, nominal)):
        part: list[tuple[DesignRow, Outcome]] = []
        each = rate_runs(outcomes)
        scores = average_ratios(each, weights)
        errors = measure_errors(each, scores, weights)
        for recipe, outcome, ratio, score, error in zip(recipes, outcomes, each, scores, errors, strict=True):
            known = outcome.violation[np.isfinite(outcome.violation)]
            row = DesignRow(
                recipe=recipe,
                score=float(score),
                worst=float(ratio.max()),
                violation=float(known.max(initial=0.0)),
                lost=int(np.sum(~np.isfinite(outcome.cost))),
                runs=len(ratio),
                off=off,
                error=float(error),
            )
            if off or recipe not in last[0]:  # else it stands above, judged in all conditions
                part.append((row, outcome))
        both += sorted(part, key=lambda pair: pair[0].score)
    return tuple(row for row, _ in both), [outcome for _, outcome in both]
