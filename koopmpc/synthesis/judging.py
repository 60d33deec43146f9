"""Recipes judged by closed loop: a recipe is fitted to some folds, and controls surrogates fitted to others."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.control.limits import Limits
from koopmpc.control.nonlinear.bilinear_mpc import BilinearMPC
from koopmpc.data.episodes import Episodes
from koopmpc.errors import KoopmpcError
from koopmpc.lifting.base import short
from koopmpc.loop.metrics import metrics
from koopmpc.loop.run import Run
from koopmpc.loop.simulate import simulate
from koopmpc.plants.plant import SimulatedPlant
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.predictors import BilinearPredictor
from koopmpc.synthesis.asked import Asked
from koopmpc.synthesis.candidates import Designed, Nearness, Recipe
from koopmpc.synthesis.cross_validation import only, without
from koopmpc.synthesis.surrogates import Surrogate
from koopmpc.validate.scoring import AnyPredictor, score

LOST = 20.0  # what a lost run counts, and the most that one counts: times the best on the same surrogate and start
FREE = 0.005  # violation that costs nothing, as a share of the limits' range
PRICE = 10.0  # a violation of 1 % beyond costs a tenth of the cost
LITTLE = 0.01  # of the usual cost: so much more is no loss, as where a run starts at its goal
_WEIGHTED = 4  # times as long takes a recipe with weights, for its models are fitted and judged again
_NINETY = 1.645  # standard deviations within which 90 % of normal errors are
_BAND = 5  # steps ahead of the errors that tighten limits
CONFIRMED = 1.25  # times the cost of the fold's controllers that the one of all data may cost on the same surrogates
LESS = 0.5  # weight of a run in which the inputs act more or less than in the data, beside 1 of the others
BROKEN = 1e-3  # share of the range beyond which a step counts as one that violates


@dataclass(frozen=True, eq=False)
class Condition:
    """One run of a controller whose model was fitted without a fold.

    Attributes
    ----------
    fold
        The fold that the model does not know.
    surrogate
        Number of the surrogate that is controlled; it knows that fold.
    gain
        How strongly the inputs act; 1 is as in the data.
    x0
        (nx,) start.
    first
        Row of the reference at which the run begins.
    u_reference
        (T, nu) inputs that cost nothing: those that hold the reference on this surrogate, unless the cost names others.
    """

    fold: int
    surrogate: int
    gain: float
    x0: Float[np.ndarray, " nx"]
    first: int
    u_reference: Float[np.ndarray, "T nu"]


@dataclass(frozen=True, eq=False)
class LoopTest:
    """The task, the data in folds, the surrogates and the conditions, which all runs share.

    A run that leaves the box from `low` to `high` is lost. Controllers have margins to the limits, of at most `room`
    (nx,); None for no margins. `noise` is the (nx,) standard deviation of measurements that the data no longer hold.
    """

    asked: Asked
    episodes: Episodes
    fold: tuple[int, ...]
    surrogates: tuple[Surrogate, ...]
    conditions: tuple[Condition, ...]
    low: Float[np.ndarray, " nx"]
    high: Float[np.ndarray, " nx"]
    room: Float[np.ndarray, " nx"] | None
    noise: Float[np.ndarray, " nx"]

    def limits(self, band: Float[np.ndarray, "h nx"]) -> Limits:
        """Return the limits that a controller gets if its model has these errors."""
        if self.room is None:
            return self.asked.limits
        width = np.where(np.isfinite(band), band, self.asked.high - self.asked.low)
        limits = self.asked.limits.tightened(np.minimum(width, self.room), states=self.episodes.states)
        said = tuple(
            f"{short(self.episodes.states[i])}: the margin is {self.room[i]:.4g}, half way from the reference to the "
            f"limit, though the errors ask for up to {width[:, i].max():.4g}"
            for i in np.flatnonzero((np.asarray(limits.margin) == self.room).any(axis=0))
        )
        return replace(limits, capped=(*limits.capped, *said))

    @property
    def nominal(self) -> list[int]:
        """The conditions in which the inputs act as in the data."""
        return [i for i, condition in enumerate(self.conditions) if condition.gain == 1.0]

    @property
    def weights(self) -> Float[np.ndarray, " conditions"]:
        """The weight of each condition in a score: a plant is likelier the one of its logs."""
        return np.array([1.0 if one.gain == 1.0 else LESS for one in self.conditions])

    def plant(self, condition: Condition) -> StepMap:
        """Return the plant of a condition; each plant is built once in a process."""
        key = condition.surrogate, condition.gain
        if key not in self._plants:
            self._plants[key] = self.surrogates[condition.surrogate].plant(condition.gain)
        return self._plants[key]

    @cached_property
    def _plants(self) -> dict[tuple[int, float], StepMap]:
        return {}


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of a job.

    Attributes
    ----------
    cost
        Cost of each run; infinite where it was lost.
    violation
        Largest violation of a limit in each run, as a share of its range.
    broken
        Share of each run's steps that violate a limit by more than 0.1 % of its range.
    visited
        (n, nx) states of the runs in which the inputs act as in the data.
    band
        (h, nx) half-width of the band that holds 90 % of the errors 1 … h steps ahead, on folds that the models do not
        know.
    models
        For each fold, the model that does not know it.
    failure
        Why there is no controller; empty where there is one.
    """

    cost: Float[np.ndarray, " runs"]
    violation: Float[np.ndarray, " runs"]
    broken: Float[np.ndarray, " runs"]
    visited: Float[np.ndarray, "n nx"]
    band: Float[np.ndarray, "h nx"]
    models: tuple[AnyPredictor, ...] = ()
    failure: str = ""


@dataclass(frozen=True, eq=False)
class Job:
    """A recipe, the conditions that it is judged in, and what is known of its model from an earlier job.

    Where `known_runs` is True that job was of the same controller, and its runs are the first of these conditions.
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
    """A plant that ends the run where its state leaves the box from low to high."""

    def __init__(self, step_map: StepMap, low: Float[np.ndarray, " nx"], high: Float[np.ndarray, " nx"]) -> None:
        super().__init__(step_map)
        self._low, self._high = low, high

    def step(self, u: ArrayLike, disturbance: ArrayLike | None = None) -> Float[np.ndarray, " ny"]:
        """Return y of the next step, or end the run."""
        y = super().step(u, disturbance)
        if not ((y >= self._low) & (y <= self._high)).all():
            raise LostError
        return y


class _Models(NamedTuple):
    """For each fold the model that does not know it, and the largest error band of them all."""

    each: tuple[AnyPredictor, ...]
    band: Float[np.ndarray, "h nx"]


def judged(test: LoopTest, job: Job) -> Outcome:
    """Return the result of a job, run by run.

    The model of a weighted recipe is fitted with weights around the states that its own runs visit, on the same
    surrogates with unchanged inputs. This is done twice.
    """
    recipe, known = job.recipe, job.known
    try:
        models = _fitted(test, recipe) if known is None else _Models(known.models, known.band)
        if recipe.weighted:
            visited = None if known is None else known.visited
            for _ in range(2):
                if visited is None:
                    visited = _outcome(test, recipe, models, test.nominal).visited
                if len(visited):
                    models = _fitted(test, recipe, Nearness.of(visited, test.episodes))
                visited = None
        if known is None or not job.known_runs:
            return _outcome(test, recipe, models, job.conditions)
        return _joined(known, _outcome(test, recipe, models, job.conditions[len(known.cost) :]))
    except (KoopmpcError, ArithmeticError, np.linalg.LinAlgError) as error:
        nothing, none = np.full(len(job.conditions), np.inf), np.zeros((0, test.episodes.nx))
        return Outcome(nothing, nothing, np.ones(len(nothing)), none, none, (), f"{type(error).__name__}: {error}")


def _fitted(test: LoopTest, recipe: Recipe, near: Nearness | None = None) -> _Models:
    folds = range(max(test.fold) + 1)
    models = [recipe.fit(without(test.episodes, test.fold, k), near) for k in folds]
    bands = [error_band(model, only(test.episodes, test.fold, k)) for k, model in enumerate(models)]
    return _Models(tuple(models), np.hypot(np.max(bands, axis=0), _NINETY * test.noise))


def _joined(first: Outcome, rest: Outcome) -> Outcome:
    """Return the runs of both results, which are of the same models."""
    cost, violation, broken, visited = (
        np.concatenate([getattr(each, name) for each in (first, rest)])
        for name in ("cost", "violation", "broken", "visited")
    )
    return Outcome(cost, violation, broken, visited, first.band, first.models)


def _outcome(test: LoopTest, recipe: Recipe, models: _Models, conditions: Sequence[int]) -> Outcome:
    """Return the result of controllers of these models; all have the limits that the final controller gets."""
    n, asked, limits = len(conditions), test.asked, test.limits(models.band)
    cost, violation, broken = np.full(n, np.inf), np.full(n, np.inf), np.ones(n)
    visited: dict[int, Float[np.ndarray, "T1 nx"]] = {}
    controller: Designed | None = None
    for k, model in enumerate(models.each):
        mine = [j for j, place in enumerate(conditions) if test.conditions[place].fold == k]
        if not mine:
            continue
        if isinstance(controller, BilinearMPC):
            controller.update(model)  # its functions are those of the lifting, whatever the model
        else:
            controller = recipe.controller(model, asked.cost, limits, asked.horizon, brief=True)
        for j in mine:
            one = test.conditions[conditions[j]]
            run, cost[j] = _run(test, one, controller, conditions[j])
            if run is None:
                continue
            over = asked.beyond(run.X[1:], run.states)
            violation[j], broken[j] = over.max(), np.mean(over > BROKEN)
            if one.gain == 1.0:
                visited[j] = run.X
    states = np.concatenate([np.zeros((0, test.episodes.nx)), *(visited[j] for j in sorted(visited))])
    return Outcome(cost, violation, broken, states, models.band, models.each)


def error_band(model: AnyPredictor, episodes: Episodes) -> Float[np.ndarray, "h nx"]:
    """Return half-widths of a band that holds 90 % of the errors 1 … 5 steps ahead; bilinear models are re-lifted."""
    past = 0 if model.embedding is None else model.embedding.steps
    horizon = min(_BAND, *(len(episode) - past for episode in episodes))
    errors = score(model, episodes, horizon, relift=isinstance(model, BilinearPredictor))
    return np.maximum(np.abs(errors.low), np.abs(errors.high))


def confirmed(test: LoopTest, controller: Designed, outcome: Outcome) -> bool:
    """Return whether the controller fitted to all data does as well on the surrogates as those of the folds did.

    It may lose no more runs than they, and cost a quarter more, as a geometric mean. A few more data can change a
    lifted model much: its observables are not invariant, so its forecasts of many steps rest on small numbers.
    """
    cost = np.array([_run(test, one, controller, j)[1] for j, one in enumerate(test.conditions)])
    both = np.isfinite(cost) & np.isfinite(outcome.cost)
    if np.sum(~np.isfinite(cost)) > np.sum(~np.isfinite(outcome.cost)):
        return False
    little = LITTLE * float(np.median(outcome.cost[both])) if both.any() else 0.0
    change = np.log((cost[both] + little) / np.maximum(outcome.cost[both] + little, 1e-300))
    return not both.any() or bool(change.mean() <= np.log(CONFIRMED))


def _run(test: LoopTest, one: Condition, controller: Designed, seed: int) -> tuple[Run | None, float]:
    """Return the closed loop, with the states without their past, and its cost; None and inf where it is lost."""
    asked, surrogate = test.asked, test.surrogates[one.surrogate]
    try:
        run = simulate(
            Fenced(test.plant(one), test.low, test.high),
            controller,
            x0=surrogate.start(one.x0),
            reference=asked.reference[one.first : one.first + asked.steps + 1],
            steps=asked.steps,
            noise=surrogate.noise,
            measured=surrogate.w if len(surrogate.w) else None,
            rng=seed,
        )
    except LostError:
        return None, np.inf
    run = replace(
        run,
        X=run.X[:, : test.episodes.nx],
        states=test.episodes.states,
        cost=asked.cost,
        limits=asked.limits,
        angles=asked.angles,
        u_reference=one.u_reference,
    )
    cost = metrics(run).cost
    return (run, cost) if np.isfinite(cost) else (None, np.inf)


def ratios(outcomes: Sequence[Outcome]) -> Float[np.ndarray, "jobs runs"]:
    """Return cost × (1 + 10 max(0, violation − 0.5 %)) of each run over the best of its condition, at most 20.

    Of a violation only what exceeds the least one of that condition counts, for from some starts no controller keeps
    the limits. Where every run of a condition is lost, all ratios are 20.
    """
    cost, violation = (np.array([getattr(each, name) for each in outcomes]) for name in ("cost", "violation"))
    least = np.where(np.isfinite(violation), violation, np.inf).min(axis=0)
    with np.errstate(invalid="ignore"):
        priced = cost * (1 + PRICE * np.maximum(violation - least - FREE, 0.0))
        priced = np.where(np.isfinite(priced), priced, np.inf)
        best = priced.min(axis=0)
        known = best[np.isfinite(best)]
        little = LITTLE * float(np.median(known)) if known.size else 0.0
        ratio = (priced + little) / np.maximum(best + little, 1e-300)
    return np.where(np.isfinite(ratio), np.minimum(ratio, LOST), LOST)


def scores(ratio: Float[np.ndarray, "jobs runs"], weights: Float[np.ndarray, " runs"]) -> Float[np.ndarray, " jobs"]:
    """Return the weighted geometric mean of each job's ratios.

    Of six runs with inputs as in the data and six others a lost one counts as 40 % more cost in all, or 18 %.
    """
    return np.exp(np.average(np.log(ratio), axis=1, weights=weights))
