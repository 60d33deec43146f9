"""What a row of a planned experiment teaches beside one of random steps, by the cost of the closed loop."""

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache, partial

import numpy as np

import koopmpc as km
from koopmpc.experiment.planning import rank_fits
from tests.closed_loop.more_tasks import ALL
from tests.closed_loop.optimum import held, optimum
from tests.closed_loop.tasks import Task

TASKS = tuple(name for name in ALL if name != "wrong, told" and not name.startswith("one record"))
GRID = (24, 36, 54, 80, 120, 180, 270, 400, 600, 900)  # rows of random steps
NOISE = 1e-3  # of the sensors, as a share of the range of the starts: what the tasks have that have any
CHOOSING, JUDGED = range(10, 16), range(8)  # seeds that choose the rows, and seeds that are compared
FAR, NEAR = 1.5, 1.1  # where random steps have not converged: their cost is so many times that of all the data
LOST = 10.0  # a run counts as at most so many times the optimum
RIDGE = 1e-8  # of plain models; those with products have theirs by cross-validation
PAST = 2  # past steps of the model where states are hidden


@dataclass(frozen=True)
class HalfRow:
    """One task: geometric means over starts and seeds of costs over the optimum.

    Attributes
    ----------
    whole
        With all of the task's data.
    rows
        Rows of random steps that were chosen.
    grid
        With so many rows of random steps, by the seeds that choose.
    random, half, planned
        With these rows of random steps, with half of them, and with half of the rows, of which half are planned.
    ratios
        Planned over random, for each seed.
    plans, refused
        How many plans were made, and how many pieces of random steps stand for a plan that was refused.
    """

    whole: float
    rows: int
    grid: dict[str, float]
    random: float
    half: float
    planned: float
    ratios: list[float] = field(default_factory=list)
    plans: int = 0
    refused: int = 0
    seconds: float = 0.0


@cache
def gather(name: str, seed: int) -> km.Episodes:
    """Return all data of a task and seed, with noise of the sensors."""
    task = ALL[name]
    clean, rng = task.data(seed), np.random.default_rng([36, seed])
    return clean.with_episodes(
        [km.Episode(X=e.X + _spread(task) * rng.standard_normal(e.X.shape), U=e.U) for e in clean]
    )


def _spread(task: Task) -> np.ndarray:
    x0 = task.training.x0
    seen = [task.plant.states.index(name) for name in task.plant.outputs]
    return NOISE * (np.asarray(x0.high) - np.asarray(x0.low))[seen]


def take_rows(data: km.Episodes, rows: int, skip: int = 0) -> list[km.Episode]:
    """Return the pieces that hold so many rows, after others that are skipped."""
    pieces: list[km.Episode] = []
    for e in data:
        first, skip = min(skip, len(e)), max(skip - len(e), 0)
        last = min(first + rows, len(e))
        if last - first > PAST + 1:
            pieces.append(e.cut(first, last))
        rows -= last - first
        if rows <= 0:
            break
    return pieces


def choose_fit(task: Task, data: km.Episodes) -> partial[km.LinearPredictor]:
    """Return the fit of a linear model, plain or with products of states, whose forecasts of a third of the data are best."""
    embedding = None if task.measured else km.Delay(PAST)
    for fit in rank_fits(data, embedding, np.random.default_rng(0)):
        if isinstance(fit, partial) and fit.func is km.edmd:
            return fit
    return partial(km.edmd, lifting=km.State() + km.Constant(), embedding=embedding, ridge=RIDGE)


def make_cost(task: Task) -> km.Cost:
    """Return the cost of a task; inputs that it gives are left to the equilibrium."""
    return km.Cost(Q=task.Q, R=task.R, of=task.of, u_target="zero" if task.u_target == "zero" else "equilibrium")


def find_cost(name: str, data: km.Episodes) -> float:
    """Return the geometric mean over the starts of the cost over the optimum, at most ten each."""
    task = ALL[name]
    cost = make_cost(task)
    logs: list[float] = []
    try:
        model = choose_fit(task, data)(data)
    except km.KoopmpcError:
        return LOST
    for start, x0 in enumerate(task.starts):
        best = optimum(name, start).cost
        try:
            controller = km.KoopmanMPC(model, cost, task.limits, task.horizon)
            run = km.simulate(
                task.plant,
                controller,
                x0=x0,
                reference=task.rows,
                steps=task.steps,
                cost=cost,
                limits=task.limits,
                u_reference=held(name),
            )
            ratio = km.metrics(run).cost / best
        except km.KoopmpcError:
            ratio = LOST
        logs.append(math.log(min(ratio, LOST) if math.isfinite(ratio) else LOST))
    return math.exp(sum(logs) / len(logs))


def _mean(values: Iterable[float]) -> float:
    return float(np.exp(np.mean(np.log(list(values)))))


def choose_rows(grid: dict[int, float], whole: float) -> int:
    """Return the most rows with which random steps cost 1.1 to 1.5 times what all data cost.

    Where no number of rows does, it is the one whose cost is the nearest to the middle of both.
    """
    inside = [rows for rows, cost in grid.items() if NEAR <= cost / whole <= FAR]
    if inside:
        return max(inside)
    middle = math.sqrt(NEAR * FAR)
    return min(grid, key=lambda rows: abs(math.log(grid[rows] / whole / middle)))


def widen_limits(task: Task, data: km.Episodes) -> km.Limits:
    """Return the limits of plans: random steps go beyond the limits of the states, so plans may go as far as they do."""
    low, high = task.limits.states(data.nx) if task.measured else (np.full(data.nx, np.inf), np.full(data.nx, -np.inf))
    X = np.concatenate([e.X for e in data])
    low, high = np.minimum(low, X.min(axis=0)), np.maximum(high, X.max(axis=0))
    return km.Limits(u_min=task.limits.u_min, u_max=task.limits.u_max, x_min=low, x_max=high)


def add_plans(name: str, seed: int, rows: int) -> tuple[km.Episodes, int, int]:
    """Return half of the rows: a quarter of random steps, then plans one after another, each from all rows before.

    A plan begins where the next episode of random steps would have begun, or where a log did. Where a plan is refused,
    shorter ones are asked for, as its sentence says; random steps stand for what is refused at a tenth of the rows.
    """
    task, whole = ALL[name], gather(name, seed)
    rng = np.random.default_rng([37, seed])
    first = rows // 4
    logs, left = list(take_rows(whole, first)), rows // 2 - first
    cost = make_cost(task)
    seen = [task.plant.states.index(one) for one in task.plant.outputs]
    x0 = task.training.x0
    steps, least, made, refused = min(task.training.steps, left), max(rows // 10, 8), 0, 0
    while left > PAST + 1:
        steps = min(steps, left)
        begin = rng.uniform(x0.low, x0.high)
        held_data = whole.with_episodes(logs)
        plan = None
        for starts in (begin[seen], None):
            try:
                plan = km.next_experiment(
                    held_data,
                    cost,
                    widen_limits(task, whole),
                    reference=task.reference,
                    steps=steps,
                    rng=seed,
                    starts=starts,
                )
                break
            except km.KoopmpcError:
                continue
        if plan is None and steps // 2 >= least:
            steps //= 2
            continue
        if plan is None:
            refused += 1
            used = rows // 2 - left
            logs += take_rows(whole, left, skip=used)
            break
        begin[seen] = plan.starts[0]
        new = km.collect(task.equations, begin, plan, episodes=1, steps=plan.steps)[0]
        logs.append(km.Episode(X=new.X + _spread(task) * rng.standard_normal(new.X.shape), U=new.U))
        left, made = left - plan.steps, made + 1
    return whole.with_episodes(logs), made, refused


def judge_halves(name: str) -> HalfRow:
    """Return the row of a task."""
    began = time.process_time()
    whole = _mean(find_cost(name, gather(name, seed)) for seed in list(CHOOSING)[:2])
    grid: dict[int, float] = {}
    for rows in GRID:
        parts = [gather(name, seed).with_episodes(take_rows(gather(name, seed), rows)) for seed in CHOOSING]
        grid[rows] = _mean(find_cost(name, part) for part in parts)
    rows = choose_rows(grid, whole)
    random, half, planned, plans, refused = list[float](), list[float](), list[float](), 0, 0
    for seed in JUDGED:
        data = gather(name, seed)
        random.append(find_cost(name, data.with_episodes(take_rows(data, rows))))
        half.append(find_cost(name, data.with_episodes(take_rows(data, rows // 2))))
        logs, made, missed = add_plans(name, seed, rows)
        planned.append(find_cost(name, logs))
        plans, refused = plans + made, refused + missed
    return HalfRow(
        whole=round(whole, 4),
        rows=rows,
        grid={str(rows): round(cost, 4) for rows, cost in grid.items()},
        random=round(_mean(random), 4),
        half=round(_mean(half), 4),
        planned=round(_mean(planned), 4),
        ratios=[round(a / b, 4) for a, b in zip(planned, random, strict=True)],
        plans=plans,
        refused=refused,
        seconds=round(time.process_time() - began, 1),
    )
