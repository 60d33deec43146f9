"""One plant: a design with coverage=0.95, and runs of its controller and of the same without a margin on the true plant."""

import time
import warnings
from dataclasses import dataclass, field

import numpy as np

import koopmpc as km
from koopmpc.loop.metrics import violation_shares
from koopmpc.synthesis.search.recipe import get_model
from tests.guarantees.coverage.optimum import find_optimum, is_touched
from tests.guarantees.coverage.plants import CoverageTask

COVERAGE = 0.95
KEPT = 0.01  # a run keeps its limits if it violates none by more than this share of its range
BEST = 3  # runs that are compared with the optimum
LOST = 1e3  # a run that costs so many times the optimum is lost
LOOPS = 39  # on stand-ins, for the choice and for its verification
PLAIN = km.State() + km.Constant()
CANDIDATES = (PLAIN, PLAIN + km.Monomials(2), PLAIN + km.Monomials(3))


@dataclass(frozen=True)
class Row:
    """What became of one plant.

    Attributes
    ----------
    holds, warnings
        Whether the design promises the share, and what it says besides.
    margin
        Factor on the tube, 0 without a margin.
    runs, kept, kept_plain
        Runs on the true plant, how many kept their limits, and how many did without a margin.
    touches
        Whether the optimum touches a state limit in some run.
    over_plain, over_optimum, plain_over_optimum
        Geometric means of cost ratios, of runs that were not lost.
    """

    holds: bool
    margin: float
    runs: int
    kept: int
    kept_plain: int
    touches: bool
    over_plain: float
    over_optimum: float
    plain_over_optimum: float
    seconds: float
    warnings: list[str] = field(default_factory=list)


def _run(task: CoverageTask, controller, x0, sizes, seed):
    """Return cost, whether the limits were kept, and the run."""
    try:
        run = km.simulate(
            task.plant,
            controller,
            x0=x0,
            reference=task.rows,
            steps=task.steps,
            cost=task.cost,
            limits=task.limits,
            options=km.loop.LoopOptions(u_reference=task.held, noise=task.noise, rng=seed),
        )
    except km.errors.KoopmpcError:
        return np.inf, False, None
    cost = km.metrics(run).cost
    over = violation_shares(run, sizes)[1:].max(initial=0.0)
    return cost, bool(np.isfinite(cost) and over <= KEPT), run


def judge(task: CoverageTask) -> Row:
    """Return the row of a plant."""
    began = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        design = km.design(
            task.gather(),
            task.cost,
            task.limits,
            horizon=task.horizon,
            reference=task.reference,
            starts=task.starts if task.delays == (0,) else None,
            options=km.DesignOptions(
                candidates=CANDIDATES, delays=task.delays, loops=LOOPS, margin=COVERAGE, workers=1
            ),
        )
    asked, recipe = design.evidence.task, design.leaderboard[design.chosen].recipe
    plain = recipe.controller(get_model(design.controller), asked.cost, task.limits, asked.horizon)
    rng = np.random.default_rng(0)
    low, high = task.limits.states(len(task.plant.outputs))
    kept = kept_plain = 0
    touches, ratios = False, []
    for k in range(task.runs):
        x0 = task.starts[k % len(task.starts)]
        moved = x0 + task.spread * rng.uniform(-1, 1, x0.shape)
        if len(low) == len(x0):
            moved = np.clip(moved, np.minimum(low, x0), np.maximum(high, x0))
        design.controller.reset()
        plain.reset()
        cost, well, run = _run(task, design.controller, moved, asked.limit_sizes, k)
        plain_cost, plain_well, _ = _run(task, plain, moved, asked.limit_sizes, k)
        kept, kept_plain = kept + well, kept_plain + plain_well
        if k < BEST:
            best = find_optimum(task, moved, *(() if run is None else (run.X[1:], run.U)))
            if best is None:
                continue
            touches = touches or is_touched(task, best)
            if max(cost, plain_cost) < LOST * best.cost:
                ratios.append((cost / plain_cost, cost / best.cost, plain_cost / best.cost))
    means = np.exp(np.mean(np.log(ratios), axis=0)) if ratios else np.full(3, np.inf)
    assert design.promise is not None
    return Row(
        holds=design.promise.holds,
        margin=round(design.promise.scale, 3),
        runs=task.runs,
        kept=kept,
        kept_plain=kept_plain,
        touches=touches,
        over_plain=round(float(means[0]), 4),
        over_optimum=round(float(means[1]), 4),
        plain_over_optimum=round(float(means[2]), 4),
        seconds=round(time.process_time() - began, 1),
        warnings=[sentence[:160] for sentence in design.advice],
    )
