"""Planned experiments on true plants: whether the bands held, and by how much limits were broken."""

import time
from dataclasses import dataclass, field

import numpy as np

import koopmpc as km
from tests.experiment.study.plants import StudyTask

STEPS, EPISODES, PLANS = 80, 2, 3  # of a plan; so many plans one after another, each from all logs before it
BROKEN = 0.01  # of the range of a limit


@dataclass(frozen=True)
class Experiments:
    """What became of the plans of one plant and one seed.

    Attributes
    ----------
    held
        Whether the readings stayed in the band, for each episode.
    broken
        The most by which the plant left its limits, as a share of their range; negative inside.
    reached
        The largest deviation of readings from the plan, in half-widths of its band.
    kinds, gains
        What each episode was, and the expected gain of each plan.
    lengths
        Steps of each plan, fewer than asked where none of so many was safe.
    ended
        Why there were no more plans.
    """

    level: float
    noise: float
    held: list[bool] = field(default_factory=list)
    broken: list[float] = field(default_factory=list)
    reached: list[float] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    gains: list[float] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    ended: str = ""
    seconds: float = 0.0


def run_experiments(
    task: StudyTask, seed: int, level: float, *, plans: int = PLANS, episodes: int = EPISODES, steps: int = STEPS
) -> Experiments:
    """Plan, record and plan again on the true plant, until nothing is worth its length."""
    found = Experiments(level, float(task.noise[0]))
    logs, ended = task.gather(seed), "all plans made"
    low, high = task.limits.states(task.plant.nx)
    began = time.process_time()
    for number in range(plans):
        try:
            plan = km.next_experiment(
                logs,
                task.cost,
                task.limits,
                reference=task.reference,
                controller=task.controller,
                steps=steps,
                episodes=episodes,
                level=level,
                rng=seed,
            )
        except km.KoopmpcError as reason:
            ended = str(reason).partition(";")[0]
            break
        if not plan.is_worth_it:
            ended = "not worth its length"
            break
        rng = np.random.default_rng([seed, number])
        runs = [
            km.simulate(
                task.plant,
                plan.choose_episode(i),
                x0=plan.starts[i] + task.noise * rng.standard_normal(task.plant.nx),  # a start is a reading, too
                reference=task.reference,
                steps=plan.steps,
                noise=task.noise,
                rng=rng,
            )
            for i in range(episodes)
        ]
        new = logs.with_episodes([km.Episode(X=run.Y, U=run.U) for run in runs])
        found.held.extend(plan.review(new).held)
        half = (plan.high - plan.low) / 2
        found.reached.extend(float(np.max(np.abs(e.X - X) / w)) for e, X, w in zip(new, plan.X, half, strict=True))
        over = [np.maximum(run.X - high, low - run.X)[1:] / (high - low) for run in runs]
        found.broken.extend(float(one[np.isfinite(one)].max(initial=-1.0)) for one in over)
        found.kinds.extend(plan.kinds)
        found.gains.append(plan.gain)
        found.lengths.append(plan.steps)
        logs = logs.with_episodes([*logs, *new])
    return Experiments(**{**vars(found), "ended": ended, "seconds": time.process_time() - began})
