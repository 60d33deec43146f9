"""Recipes judged by closed loop: a recipe is fitted to some folds, and controls surrogates fitted to others."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base.errors import KoopmpcError
from koopmpc.control.kinds.bilinear_mpc import BilinearMPC
from koopmpc.control.move import Controller
from koopmpc.data.episodes import Episodes
from koopmpc.loop.metrics import total_cost, violation_shares
from koopmpc.loop.run import Run
from koopmpc.loop.simulate import LoopOptions, StepObserver, simulate
from koopmpc.models.predictors import BilinearPredictor
from koopmpc.plants.plant import SimulatedPlant, Transition
from koopmpc.synthesis.loops.abreast import Acting
from koopmpc.synthesis.loops.conditions import Condition, LoopTest
from koopmpc.synthesis.loops.neighbours import NeighbourMap
from koopmpc.synthesis.loops.surrogates import Surrogate
from koopmpc.synthesis.search.folds import drop_fold, select_fold
from koopmpc.synthesis.search.recipe import Designed, Nearness, Recipe
from koopmpc.synthesis.task import DesignTask
from koopmpc.validate.scoring import AnyPredictor, score

LITTLE = 0.01  # this share of the usual cost is added to all costs, because some runs start at their goal
_WEIGHTED = 4  # a recipe with weights takes about this many times as long, since its models are fitted again
_NINETY = 1.645  # 90 % of normal errors lie within this many standard deviations
_BAND = 5  # limits are tightened by errors up to this many steps ahead
CONFIRMED = 1.25  # fitted to all data, a controller may cost this factor of its cost with two folds
BROKEN = 1e-3  # a step violates a limit if it exceeds the limit by more than this share of its range


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of a job."""

    cost: Float[np.ndarray, " runs"]  # cost of each run; infinite where it was lost
    violation: Float[np.ndarray, " runs"]  # largest violation of a limit in each run, as a share of its range
    # share of each run's steps that violate a limit by more than 0.1 % of its range
    broken: Float[np.ndarray, " runs"]
    visited: Float[np.ndarray, "n nx"]  # (n, nx) states of the runs in which the inputs act as in the data
    # (h, nx) half-width of the band that holds 90 % of the errors 1 … h steps ahead, on folds that the models do not
    # know
    band: Float[np.ndarray, "h nx"]
    models: tuple[AnyPredictor, ...] = ()  # for each fold, the model that does not know it
    failure: str = ""  # why there is no controller; empty where there is one


@dataclass(frozen=True, eq=False)
class Job:
    """A recipe, the conditions in which it is judged, and the outcome `known` of an earlier job with its model.

    If `known_runs` is True, the earlier job had the same controller, and its runs are the first of these conditions.
    """

    recipe: Recipe
    conditions: Sequence[int]
    known: Outcome | None = None
    known_runs: bool = False

    def size(self) -> float:
        """Return a number that grows with the time that the job takes."""
        return self.recipe.candidate.size * (_WEIGHTED if self.recipe.weighted else 1)

    def __str__(self) -> str:
        return str(self.recipe)


class LostError(Exception):
    """A run has left the box of states that the surrogates know."""


class Fenced(SimulatedPlant):
    """A plant that ends the run where its state leaves the box from low to high; its inputs act as `acting` says."""

    def __init__(
        self,
        step_map: Transition,
        low: Float[np.ndarray, " nx"],
        high: Float[np.ndarray, " nx"],
        acting: Acting | None = None,
    ) -> None:
        super().__init__(step_map)
        self._low, self._high, self._acting = low, high, acting
        self._before: Float[np.ndarray, "1 nu"] | None = None

    def step(self, u: ArrayLike, disturbance: ArrayLike | None = None) -> Float[np.ndarray, " ny"]:
        """Return y of the next step, or end the run."""
        if self._acting is not None:
            now = np.array(u, dtype=np.float64)[None]
            before = now if self._before is None else self._before
            u, self._before = self._acting.change(now, before, np.zeros(1, dtype=np.int64))[0], now
        y = super().step(u, disturbance)
        state = self.state
        x = y if state is None else state[: len(self._low)]  # with feedthrough y differs from the state
        if not ((x >= self._low) & (x <= self._high)).all():
            raise LostError
        return y


class _Models(NamedTuple):
    """For each fold the model that does not know it, and the largest error band of them all."""

    each: tuple[AnyPredictor, ...]
    band: Float[np.ndarray, "h nx"]


def judge_job(test: LoopTest, job: Job) -> Outcome:
    """Return the result of a job, run by run.

    The model of a weighted recipe is fitted with weights around the states that its own runs visit, on the same
    surrogates with unchanged inputs. This is done twice.
    """
    recipe, known = job.recipe, job.known
    try:
        models = _fit_folds(test, recipe) if known is None else _Models(known.models, known.band)
        if recipe.weighted:
            visited = None if known is None else known.visited
            for _ in range(2):
                if visited is None:
                    visited = _judge_models(test, recipe, models, test.nominal).visited
                if len(visited):
                    models = _fit_folds(test, recipe, Nearness.of(visited, test.episodes))
                visited = None
        if known is None or not job.known_runs:
            return _judge_models(test, recipe, models, job.conditions)
        return _join_outcomes(known, _judge_models(test, recipe, models, job.conditions[len(known.cost) :]))
    except (KoopmpcError, ArithmeticError, np.linalg.LinAlgError) as error:
        nothing, none = np.full(len(job.conditions), np.inf), np.zeros((0, test.episodes.nx))
        return Outcome(nothing, nothing, np.ones(len(nothing)), none, none, (), f"{type(error).__name__}: {error}")


def _fit_folds(test: LoopTest, recipe: Recipe, near: Nearness | None = None) -> _Models:
    folds, rows = range(max(test.fold) + 1), test.episodes
    if test.raw is not None and recipe.candidate.has_hidden_state:
        rows = test.raw
    models = [recipe.fit(drop_fold(rows, test.fold, k), near) for k in folds]
    bands = [measure_band(model, select_fold(test.episodes, test.fold, k)) for k, model in enumerate(models)]
    return _Models(tuple(models), np.hypot(np.max(bands, axis=0), _NINETY * test.noise))


def _join_outcomes(first: Outcome, rest: Outcome) -> Outcome:
    """Return the runs of both results, which are of the same models."""
    cost, violation, broken, visited = (
        np.concatenate([getattr(each, name) for each in (first, rest)])
        for name in ("cost", "violation", "broken", "visited")
    )
    return Outcome(cost, violation, broken, visited, first.band, first.models)


def _judge_models(test: LoopTest, recipe: Recipe, models: _Models, conditions: Sequence[int]) -> Outcome:
    """Return the result of controllers of these models; all have the limits that the final controller gets."""
    n, task, limits = len(conditions), test.task, test.limits(models.band)
    cost, violation, broken = np.full(n, np.inf), np.full(n, np.inf), np.ones(n)
    visited: dict[int, Float[np.ndarray, "T1 nx"]] = {}
    controller: Designed | None = None
    for k, model in enumerate(models.each):
        mine = [j for j, place in enumerate(conditions) if test.conditions[place].fold == k]
        if not mine:
            continue
        if isinstance(controller, BilinearMPC) and not recipe.candidate.has_hidden_state:
            controller.update(model)  # its functions are those of the lifting, whatever the model
        else:
            controller = recipe.controller(model, task.cost, limits, task.horizon, brief=True)
        for j in mine:
            one = test.conditions[conditions[j]]
            run, cost[j] = _run_condition(test, one, controller, conditions[j])
            if run is None:
                continue
            over = violation_shares(run, task.limit_sizes)[1:]
            violation[j], broken[j] = over.max(), np.mean(over > BROKEN)
            if one.gain == 1.0:
                visited[j] = run.X
    states = np.concatenate([np.zeros((0, test.episodes.nx)), *(visited[j] for j in sorted(visited))])
    return Outcome(cost, violation, broken, states, models.band, models.each)


def measure_band(model: AnyPredictor, episodes: Episodes) -> Float[np.ndarray, "h nx"]:
    """Return half-widths of a band that holds 90 % of the errors 1 … 5 steps ahead; bilinear models are re-lifted."""
    past = 0 if model.embedding is None else model.embedding.steps
    horizon = min(_BAND, *(len(episode) - past for episode in episodes))
    errors = score(model, episodes, horizon, relift=isinstance(model, BilinearPredictor))
    return np.maximum(np.abs(errors.low), np.abs(errors.high))


def is_confirmed(test: LoopTest, controller: Designed, outcome: Outcome) -> bool:
    """Return True if the controller fitted to all data does as well on the surrogates as those of the folds did.

    It may not lose more runs, and its geometric mean cost may be up to a quarter higher. A few more data can change the
    long forecasts of a lifted model much, since its observables are not invariant.
    """
    cost = np.array([_run_condition(test, one, controller, j)[1] for j, one in enumerate(test.conditions)])
    both = np.isfinite(cost) & np.isfinite(outcome.cost)
    if np.sum(~np.isfinite(cost)) > np.sum(~np.isfinite(outcome.cost)):
        return False
    little = LITTLE * float(np.median(outcome.cost[both])) if both.any() else 0.0
    change = np.log((cost[both] + little) / np.maximum(outcome.cost[both] + little, 1e-300))
    return not both.any() or bool(change.mean() <= np.log(CONFIRMED))


def _run_condition(test: LoopTest, one: Condition, controller: Designed, seed: int) -> tuple[Run | None, float]:
    """Return the closed loop of a condition and its cost; None and inf if it is lost."""
    task = test.task
    run = run_on_surrogate(
        task,
        test.surrogates[one.surrogate],
        Fenced(test.plant(one), test.low, test.high),
        controller,
        one.x0,
        reference=read_reference(task, one.first, task.steps + 1 + controller.horizon),
        u_reference=one.u_reference,
        options=LoopOptions(noise=test.surrogates[one.surrogate].noise, rng=seed),
    )
    cost = np.inf if run is None else total_cost(run)
    return (run, cost) if np.isfinite(cost) else (None, np.inf)


def read_reference(task: DesignTask, first: int, count: int) -> Float[np.ndarray, "count nr"]:
    """Return so many rows of the reference from row `first` on, the last one repeated behind its end."""
    return task.reference[np.minimum(first + np.arange(count), len(task.reference) - 1)]


def run_on_surrogate(
    task: DesignTask,
    surrogate: Surrogate | NeighbourMap,
    plant: Fenced,
    controller: Controller,
    x0: Float[np.ndarray, " n"],
    *,
    reference: Float[np.ndarray, "rows nr"],
    u_reference: Float[np.ndarray, "T nu"],
    options: LoopOptions,
    observers: Sequence[StepObserver] = (),
) -> Run | None:
    """Return a closed loop on the plant of a surrogate, with the states without their past; None if it is lost.

    It is judged by the cost and the limits of the task. With feedthrough its state k + 1 is h(x_k, u_k), the row k of a
    log.
    """
    states, start = surrogate.states, surrogate.start(x0)
    try:
        run = simulate(
            plant,
            controller,
            x0=np.concatenate([start, surrogate.middle]) if surrogate.feedthrough else start,
            reference=reference,
            steps=len(u_reference),
            options=options,
            measured=surrogate.w if len(surrogate.w) else None,
            limits=task.limits,
            observers=observers,
        )
    except LostError:
        return None
    return replace(
        run, X=run.X[:, : len(states)], states=states, cost=task.cost, angles=task.angles, u_reference=u_reference
    )
