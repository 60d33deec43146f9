"""judge_rate, judge_plant_runs: how often a controller fails, on surrogates of its plant and on the plant itself."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc.base.errors import DataError
from koopmpc.base.text import to_percent
from koopmpc.data.episodes import Episodes
from koopmpc.loop.metrics import stack_limited
from koopmpc.synthesis.designed import Evidence
from koopmpc.synthesis.loops.abreast import speed_up
from koopmpc.synthesis.loops.pool import LoopPool, LoopResult
from koopmpc.synthesis.rates import KEPT, LoopRate
from koopmpc.synthesis.search.recipe import get_model
from koopmpc.validate.binomial import count_runs_needed


def plan_verdict(rate: float) -> str:
    """Return how many loops a bound of `rate` needs, in words."""
    none, one = count_runs_needed(rate), count_runs_needed(rate, failures=1)
    return (
        f"a bound of {to_percent(rate)} on the share of failing loops needs {none} loops without a failure, or {one} "
        f"with one; {none} are run"
    )


def judge_rate(
    evidence: Evidence,
    controller: Any,
    rate: float,
    rng: np.random.Generator,
    report: Callable[[int, int], None] | None = None,
    *,
    abreast: int = 50,
) -> LoopRate:
    """Return the verdict of as many fresh loops as a bound of `rate` needs when none fails.

    The number is fixed before the loops: a number that grows until the bound is met loses the confidence.
    """
    count = count_runs_needed(rate)
    pool = LoopPool(evidence.task, evidence.surrogates, evidence.neighbours, evidence.low, evidence.high)
    drawn, fast = pool.draw(count, rng), speed_up(controller)
    results: list[LoopResult] = []
    for first in range(0, count, abreast):
        results += pool.run(fast, drawn[first : first + abreast])
        if report is not None:
            report(len(results), count)
    lost = sum(result.run is None for result in results)
    broken = sum(result.run is not None and not result.keeps for result in results)
    rows = sum(loop.place < 0 for loop in drawn)
    return LoopRate(count, broken, lost, on_rows=rows)


def judge_plant_runs(evidence: Evidence, controller: Any, logs: Episodes, *, same: float = 0.02) -> LoopRate:
    """Return the verdict of logged runs of this controller on its plant, in rows timed as those of the design's logs.

    With feedthrough each row holds the reading h(x, u) of the input before, which the controller had. An input is the
    controller's if it differs by at most the share `same` of the input's range.
    Logs with other states or inputs, or with less than nine tenths of this controller's inputs, are refused.
    """
    asked, nx, nu = evidence.task, len(evidence.task.low), controller.nu
    if logs.nx != nx or logs.nu != nu:
        raise DataError(f"the logs have {logs.nx} states and {logs.nu} inputs, the design {nx} and {nu}")
    direct = evidence.surrogates[0].feedthrough
    low, high = asked.limits.inputs(nu)
    spread = np.ptp(np.concatenate([episode.U for episode in logs]), axis=0)
    size = np.where(np.isfinite(high - low), high - low, np.maximum(spread, 1e-12))
    alike, steps = 0, 0
    for episode in logs if direct else get_model(controller).align(logs):
        controller.reset(episode.X[0])
        last: Float[np.ndarray, " nu"] | None = None
        for k, u in enumerate(episode.U):
            rows = asked.reference[min(k, len(asked.reference) - 1) :][: controller.horizon + 1]
            move = controller(episode.X[k], rows, applied=last)
            alike, steps, last = alike + bool((np.abs(move.u - u) <= same * size).all()), steps + 1, u
    own = alike / max(steps, 1)
    if own < 0.9:
        timing = ", each row with the reading h(x, u) of the input before, which the controller had" * direct
        raise DataError(
            f"in the logged states this controller asks for {to_percent(own)} of the logged inputs: the "
            "logs hold other runs, not those of this controller towards its reference; pass these" + timing
        )
    failures = 0
    for episode in logs:
        values, box = stack_limited(asked.limits, episode.X[1:], logs.states)
        over = np.maximum(box.low - values, values - box.high) / asked.limit_sizes
        failures += bool(over.max(initial=0.0) > KEPT)
    return LoopRate(len(logs), failures, own=own)
