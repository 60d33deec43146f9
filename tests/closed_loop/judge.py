"""Closed loops of every controller on every task, and what they cost beyond the optimum."""

import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from multiprocessing import get_context

import numpy as np

import koopmpc as km
from tests.closed_loop.controllers import CONTROLLERS, DESIGNED, GIVEN, NotApplicableError, Parts
from tests.closed_loop.more_tasks import JUDGED
from tests.closed_loop.optimum import boxes, held, optimum, weights
from tests.closed_loop.tasks import Task, UTarget

LOST = 1e3  # a run that costs more than this many times the optimum is lost, and is ended
TAIL = 0.1  # share of a run, its end, over which the steady error is taken
SEEDS = (0, 1, 2)


@dataclass(frozen=True)
class Row:
    """One task under one controller, the worst of its starts and training seeds.

    Attributes
    ----------
    ratio
        Closed-loop cost over the optimum, at most 1000; None where the controller is not applicable.
    violation
        Largest violation of a state limit, as a share of that state's range.
    steady
        Largest tracking error over the last tenth of a run beyond that of the optimum, as a share of the range.
    statuses
        How many steps of all runs ended with each status.
    failure
        The first exception, where there was one; its run counts as lost.
    median, p99
        Time of a step [s].
    promise
        Of a designed controller: what the design promised, beside what happened in as many steps; see `promised`.
    """

    ratio: float | None
    violation: float = 0.0
    steady: float = 0.0
    statuses: dict[str, int] = field(default_factory=dict)
    failure: str = ""
    median: float = 0.0
    p99: float = 0.0
    promise: dict[str, float] = field(default_factory=dict)


Table = dict[str, dict[str, Row]]  # task → controller → row


class _LostError(Exception):
    """The run costs a thousand times the optimum."""


class _Watch:
    """An observer that counts what a run costs, so that a lost one ends, and keeps what it has seen."""

    def __init__(self, task: Task, best: float) -> None:
        self._Q, self._R, self._tracked = weights(task)
        self._most = LOST * best
        self.cost = 0.0
        self.costs: list[float] = []
        self.X: list[np.ndarray] = []
        self.statuses: Counter[str] = Counter()
        self.times: list[float] = []

    def __call__(self, step: km.loop.Step) -> None:
        error, moved = step.x_next[self._tracked] - step.reference_next, step.u - step.u_reference
        self.cost += float(error @ self._Q @ error + moved @ self._R @ moved)
        self.costs.append(self.cost)
        self.X.append(step.x_next)
        self.statuses[step.move.status.name] += 1
        self.times.append(step.move.solve_time)
        if not self.cost <= self._most:
            raise _LostError


def ranges(task: Task) -> np.ndarray:
    """Return the range of each state: between its limits, else that of the initial states of the training data."""
    low, high, _, _ = boxes(task)
    x0 = task.training.x0
    wide = np.asarray(x0.high) - np.asarray(x0.low)
    return np.where(np.isfinite(low) & np.isfinite(high), high - low, wide)


def judged(parts: Parts, name: str, start: int, u_target: UTarget | None = None) -> Row:
    """Return the row of one run; an exception of the controller is recorded, never raised."""
    task = parts.task
    best = optimum(task.name, start, u_target)
    watch, failure = _Watch(task, best.cost), ""
    _, _, tracked = weights(task)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            controller = (CONTROLLERS | DESIGNED)[name](parts)
            run = km.simulate(
                task.plant,
                controller,
                x0=task.starts[start],
                reference=task.rows,
                steps=task.steps,
                cost=km.Cost(Q=task.Q, R=task.R, of=task.of),
                limits=task.limits,
                options=km.loop.LoopOptions(u_reference=held(task.name, u_target)),
                measured=task.weather,
                observers=(watch,),
            )
        ratio = km.metrics(run).cost / best.cost
    except NotApplicableError:
        return Row(None)
    except _LostError:
        ratio = LOST
    except Exception as error:  # the judge records what a controller does, whatever that is
        ratio, failure = LOST, f"{type(error).__name__}: {str(error)[:80]}"
    X = np.array(watch.X) if watch.X else np.array([task.starts[start]])
    low, high, _, _ = boxes(task)
    wide = ranges(task)
    with np.errstate(invalid="ignore", over="ignore"):
        beyond = np.nanmax(np.maximum(low - X, X - high) / wide, initial=0.0)
        last = math.ceil(TAIL * task.steps)
        error, least = (
            np.abs(states[-last:][:, tracked] - task.rows[-last:]).max(axis=0) for states in _ends(X, best.X, last)
        )
        steady = float(np.max((error - least) / wide[tracked]))
    return Row(
        ratio=min(ratio, LOST) if math.isfinite(ratio) else LOST,
        violation=min(float(beyond), LOST),
        steady=min(max(steady, 0.0), LOST) if math.isfinite(steady) else LOST,
        statuses=dict(watch.statuses),
        failure=failure,
        median=float(np.median(watch.times)) if watch.times else 0.0,
        p99=float(np.quantile(watch.times, 0.99)) if watch.times else 0.0,
        promise=promised(parts.design.expected, watch.costs, float(beyond)) if name == "designed" else {},
    )


def promised(expected: km.synthesis.ExpectedLoop, costs: Sequence[float], violation: float) -> dict[str, float]:
    """Return what a design promised, and what happened in the first steps of a run, as many as it promised.

    `low`, `high` and `cost` are costs, promised and spent; `most` and `violation` bound and measure the violation;
    `lost` bounds the probability that a loop is lost.
    """
    spent = costs[min(expected.steps, len(costs)) - 1] if costs else math.inf
    low, high = expected.cost_interval
    return {
        "low": low,
        "high": high,
        "cost": spent,
        "most": expected.violation_bound,
        "violation": violation,
        "lost": expected.lost_bound,
    }


def _ends(X: np.ndarray, best: np.ndarray, last: int) -> tuple[np.ndarray, np.ndarray]:
    """Return both trajectories, the first one's last state repeated where the run was ended."""
    return np.vstack([X, np.repeat(X[-1:], max(last - len(X), 0), axis=0)]), best


def worst(rows: Iterable[Row]) -> Row:
    """Return the worst of each figure, and all statuses."""
    rows = list(rows)
    if any(row.ratio is None for row in rows):
        return Row(None)
    return Row(
        ratio=max(row.ratio for row in rows),
        violation=max(row.violation for row in rows),
        steady=max(row.steady for row in rows),
        statuses=dict(sum((Counter(row.statuses) for row in rows), Counter())),
        failure=next((row.failure for row in rows if row.failure), ""),
        median=max(row.median for row in rows),
        p99=max(row.p99 for row in rows),
        promise=max(rows, key=lambda row: row.ratio).promise,
    )


def one(task: str, seed: int, names: Sequence[str], u_target: UTarget | None = None) -> dict[str, Row]:
    """Return the rows of one task and training seed, each the worst of the task's starts."""
    parts = Parts(JUDGED[task], seed, u_target)
    starts = range(len(parts.task.starts))
    return {name: worst(judged(parts, name, start, u_target) for start in starts) for name in names}


def measure(
    tasks: Sequence[str],
    names: Sequence[str],
    seeds: Sequence[int] = SEEDS,
    u_target: UTarget | None = None,
    workers: int = 2,
    progress: Callable[[int, int, Table], None] | None = None,
) -> Table:
    """Return the table of these tasks and controllers; the worst of all seeds, one seed for those given equations.

    After each task and seed `progress` is told how many are done, of how many, and the table so far.
    """
    jobs = [(task, seed, [n for n in names if seed == seeds[0] or n not in GIVEN]) for seed in seeds for task in tasks]
    done: dict[str, list[dict[str, Row]]] = {}

    def table() -> Table:
        kept = {task: [n for n in names if any(n in rows for rows in done[task])] for task in tasks if task in done}
        return {task: {n: worst(rows[n] for rows in done[task] if n in rows) for n in kept[task]} for task in kept}

    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        futures = {pool.submit(one, task, seed, asked, u_target): task for task, seed, asked in jobs}
        for number, future in enumerate(as_completed(futures), 1):
            done.setdefault(futures[future], []).append(future.result())
            if progress is not None:
                progress(number, len(jobs), table())
    return table()


def rounded(row: Row) -> Row:
    """Return the figures as they are stored: five digits of the ratio, two of times."""
    if row.ratio is None:
        return row
    return replace(
        row,
        ratio=float(f"{row.ratio:.5g}"),
        violation=round(row.violation, 5),
        steady=round(row.steady, 6),
        median=float(f"{row.median:.2g}"),
        p99=float(f"{row.p99:.2g}"),
    )
