"""choose_margin: a margin with which a stated share of loops on surrogates keeps its limits, chosen and verified."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc.base.errors import DataError, KoopmpcError
from koopmpc.control.ask.limits import Limits
from koopmpc.control.riccati import find_gain, one_step, stationary
from koopmpc.synthesis.doubts import limit_margins
from koopmpc.synthesis.loops.abreast import speed_up
from koopmpc.synthesis.loops.conditions import LoopTest
from koopmpc.synthesis.loops.pool import DrawnLoop, LoopPool, LoopResult
from koopmpc.synthesis.rates import CoveragePromise
from koopmpc.synthesis.search.recipe import Designed, Recipe, get_model
from koopmpc.synthesis.task import DesignTask
from koopmpc.validate.scoring import AnyPredictor


@dataclass(frozen=True)
class MarginSettings:
    """Which margins are tried, and how long their tube is."""

    scales: tuple[float, ...] = (
        0.25,
        0.5,
        1.0,
        2.0,
        4.0,
    )  # times the tube that are tried as a margin, the least one first
    round: int = 20  # loops that are run before their failures are counted
    finer: int = 2  # halvings between the last scale that fails and the first that holds
    iterations: int = 10_000  # of the Riccati equation
    slack: float = (
        1e-6  # weight of the states in the feedback of the tube, as a share of 1 / range², beside those of the cost
    )
    rested: float = 1e-4  # the tube ends once a step widens it by less than this share
    longest: int = 400  # steps of a tube, at most


SETTINGS = MarginSettings()


def most_failures(loops: int, coverage: float) -> int:
    """Return how many of these loops may fail so that one more loop keeps its limits with a probability of `coverage`.

    (k + 1) / (n + 1) ≤ 1 − coverage (Angelopoulos, Bates, Fisch, Lei & Schuster, "Conformal risk control", ICLR 2024).
    Negative for fewer than ⌈1/α⌉ − 1 loops. This holds for one family of margins of which a wider one never fails where
    a narrower one does not. `promise_coverage` tries two families and takes the cheaper: its second loops count alone.
    """
    return int(np.floor((1 - coverage) * (loops + 1) + 1e-9)) - 1


def check_share(share: float, loops: int) -> None:
    """Raise a DataError where a promise of this share needs more loops."""
    if most_failures(loops, share) < 0:
        needed = int(np.ceil(1 / (1 - share) - 1e-9)) - 1
        raise DataError(f"margin={share:g} needs {needed} loops or more to choose a margin; pass loops={needed}")


def keep_limits(
    test: LoopTest,
    pool: LoopPool,
    recipe: Recipe,
    controller: Designed,
    band: Float[np.ndarray, "h nx"],
    coverage: float,
    loops: int,
    rng: np.random.Generator,
) -> tuple[CoveragePromise, Limits]:
    """Return the promise of a design's controller, and its limits.

    The tube is that of the model's one-step errors, the first row of `band`, around the reference; for a model of past
    rows, and where no feedback holds the model, it is the band itself.
    """
    task, model = test.task, get_model(controller)
    width = np.where(np.isfinite(band), band, task.high - task.low)
    rest = test.surrogates[0].holding(task.cost, task.limits)(task.reference[0])
    nx = len(task.low)
    tube = find_tube(model, task, width[0], np.asarray(rest.x)[:nx], np.asarray(rest.u))
    ends = controller.limits.terminal
    promise, limits = promise_coverage(
        pool,
        lambda limits: recipe.controller(model, task.cost, replace(limits, terminal=ends), task.horizon),
        width if tube is None else tube,
        limit_margins(task, test.episodes),
        coverage,
        loops,
        rng,
    )
    return promise, replace(limits, terminal=ends)


def promise_coverage(
    pool: LoopPool,
    build: Callable[[Limits], Any],
    tube: Float[np.ndarray, "h nx"],
    room: Float[np.ndarray, " nx"],
    coverage: float,
    loops: int,
    rng: np.random.Generator,
) -> tuple[CoveragePromise, Limits]:
    """Return the promise, and the limits with the margin that it rests on.

    The least factor on the tube, at most `room`, is taken with which few enough of the first loops fail; of a growing
    and a rigid margin the one whose loops cost less. Then it is fixed, and as many further loops are run. `build` makes
    a controller of limits.
    """
    first, second = pool.draw(loops, rng), pool.draw(loops, rng)
    limits = replace(pool.task.limits, margin=None, capped=())
    low, high = limits.states(tube.shape[1])
    limited = np.isfinite(low) | np.isfinite(high)
    rigid = tube.max(axis=0, keepdims=True)
    allowed = most_failures(loops, coverage)

    def attempt(shape: str, rows: Float[np.ndarray, "h nx"], scale: float) -> _Attempt | None:
        margin = np.minimum(scale * np.where(limited, rows, 0.0), room)
        try:
            inside = replace(limits, margin=margin) if margin.any() else limits
            controller = build(inside)
        except KoopmpcError:  # limits that cross
            return None
        results = _run_until(pool, controller, first, allowed)
        return _Attempt(shape, scale, margin, inside, controller, results, _count_failures(results) <= allowed)

    chosen = attempt("none", rigid, 0.0)
    assert chosen is not None, "limits without a margin do not cross"
    if not chosen.holds and limited.any():
        tried = [_find_least(partial(attempt, shape, rows)) for shape, rows in (("growing", tube), ("rigid", rigid))]
        found = [one for one in tried if one is not None and one.holds]
        if found:
            chosen = min(found, key=lambda one: (one.cost, one.shape))
        else:  # none holds: the one with the fewest failures of all loops
            widest = [chosen, *(one for one in tried if one is not None)]
            chosen = min(widest, key=lambda one: _count_failures(pool.run(speed_up(one.controller), first)))
    fast = speed_up(chosen.controller)
    whole = pool.run(fast, first) if len(chosen.results) < loops else chosen.results
    promise = CoveragePromise(
        coverage=coverage,
        shape=chosen.shape,
        scale=chosen.scale,
        margin=chosen.margin,
        chosen_from=loops,
        chosen_failures=_count_failures(whole),
        verified_on=loops,
        failures=_count_failures(pool.run(fast, second)),
        found=chosen.holds,
        steps=pool.task.steps,
    )
    return promise, chosen.limits


@dataclass(frozen=True, eq=False)
class _Attempt:
    """A margin, its controller, the loops that were run before too many of them failed, and whether few enough did."""

    shape: str
    scale: float
    margin: Float[np.ndarray, "h nx"]
    limits: Limits
    controller: Any
    results: Sequence[LoopResult]
    holds: bool

    @property
    def cost(self) -> float:
        """Mean cost of the loops that were not lost."""
        known = [result.cost for result in self.results if np.isfinite(result.cost)]
        return float(np.mean(known)) if known else np.inf


def _count_failures(results: Sequence[LoopResult]) -> int:
    return sum(not result.keeps for result in results)


def _run_until(pool: LoopPool, controller: Any, loops: Sequence[DrawnLoop], allowed: int) -> list[LoopResult]:
    """Return the results of loops, up to the round with one failure too many."""
    results: list[LoopResult] = []
    while len(results) < len(loops) and _count_failures(results) <= allowed:
        results += pool.run(controller, loops[len(results) : len(results) + SETTINGS.round])
    return results


def _find_least(attempt: Callable[[float], _Attempt | None]) -> _Attempt | None:
    """Return the attempt with the least scale that holds; where none does the widest one, None if there is none."""
    below, last = 0.0, None
    for scale in SETTINGS.scales:
        tried = attempt(scale)
        if tried is None or (last is not None and np.array_equal(tried.margin, last.margin)):
            return last  # the limits cross, or the room is used up
        last = tried
        if tried.holds:
            break
        below = scale
    for _ in range(SETTINGS.finer if last is not None and last.holds else 0):
        assert last is not None
        middle = (below + last.scale) / 2
        tried = attempt(middle)
        if tried is not None and tried.holds:
            last = tried
        else:
            below = middle
    return last


def propagate_errors(
    A: Float[np.ndarray, "n n"], error: Float[np.ndarray, " n"], steps: int
) -> Float[np.ndarray, "steps n"]:
    """Return half-widths of e_k, k = 1 … steps, for e_{k+1} = A e_k + w, e_0 = 0 and every |w| ≤ error.

    |e_k| is at most Σ_{j<k} |Aʲ| error, and errors of these sizes with fitting signs reach it.
    """
    row, width, widths = np.eye(len(A)), np.zeros(len(A)), np.zeros((steps, len(A)))
    for k in range(steps):
        width = width + np.abs(row) @ error
        row = row @ A
        widths[k] = width
    return widths


def find_tube(
    model: AnyPredictor,
    task: DesignTask,
    error: Float[np.ndarray, " nx"],
    x: Float[np.ndarray, " nx"],
    u: Float[np.ndarray, " nu"],
) -> Float[np.ndarray, "steps nx"] | None:
    """Return half-widths of each state 1 … steps after a plan, one-step errors being at most `error` in size.

    The loop around (x, u) follows the model's linearisation under the feedback of the stationary Riccati equation of
    the cost. The tube ends where it no longer widens. Returns None for a model of past rows, and where there is no such
    feedback.
    """
    if model.embedding is not None:
        return None
    try:
        at = model.step_map().linearize(x, u)
        A, B = at.A, at.B
        n, size = len(A), np.maximum(task.high - task.low, 1e-12)
        R = task.cost.matrices(task.reference.shape[1], B.shape[1])[1]
        tracked = task.weigh_states(x, model.states, B.shape[1])
        weight = tracked + SETTINGS.slack * float(np.trace(tracked @ np.diag(size**2))) / n * np.diag(1 / size**2)
        stage = one_step(A, B, weight, R + 1e-9 * np.eye(len(R)) * max(float(np.trace(R)), 1e-9), None)
        K, _ = find_gain(stage, stationary(stage, SETTINGS.iterations).P)
    except (KoopmpcError, np.linalg.LinAlgError):
        return None
    loop = A - B @ K
    if not np.isfinite(loop).all() or np.abs(np.linalg.eigvals(loop)).max() >= 1:
        return None
    widths = propagate_errors(loop, error, SETTINGS.longest)
    still = np.flatnonzero((np.diff(widths, axis=0) <= SETTINGS.rested * widths[:-1] + 1e-300).all(axis=1))
    return widths[: int(still[0]) + 2] if still.size else widths
