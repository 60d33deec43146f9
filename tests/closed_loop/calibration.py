"""python -m tests.closed_loop.calibration: what designs promise, and what happens on the plant from starts drawn alike.

A design expects a cost inside an interval in 90 % of the loops, a violation below a bound in 95 %, and at most so many
lost loops. Here each design runs on its plant from starts that are drawn as those of its fresh loops are, with the noise
of the logs. The logs of `wrong` and `leaks` are those of another plant, and nothing in them can say so.
"""

import argparse
import json
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import koopmpc as km
from koopmpc.loop.metrics import violation_shares
from koopmpc.synthesis.designed import read_controller, rebuild_controller
from koopmpc.synthesis.loops.abreast import speed_up
from koopmpc.synthesis.loops.fresh import run_fresh_loops
from koopmpc.synthesis.loops.pool import LoopPool, draw_starts
from koopmpc.synthesis.rates import ExpectedLoop
from tests.closed_loop.controllers import Parts
from tests.closed_loop.more_tasks import ALL
from tests.closed_loop.optimum import held
from tests.closed_loop.tasks import Task
from tests.searches import design

STORED = Path(__file__).parent / "calibration.json"
STARTS = 12  # runs on the plant for each design
LOOPS = 300  # fresh loops of each design
OTHER_PLANT = ("wrong", "leaks")  # what is driven is not what was logged
BROKEN = 0.01  # a violation above this share of the range breaks a promise of 0 %


def read_or_design(task: str, seed: int, folder: Path | None) -> tuple[Any, Any]:
    """Return controller and evidence of a design, from the folder where it is kept."""
    path = None if folder is None else folder / f"{task}-{seed}.design"
    if path is None or not path.exists():
        parts = Parts(ALL[task], seed)
        rows = parts.task.rows
        reference = rows if (rows != rows[0]).any() else rows[0]
        made = design(
            parts.data,
            parts.cost(),
            parts.task.limits,
            horizon=parts.task.horizon,
            reference=reference,
            loops=0,
            workers=1,
        )
        if path is None:
            return made.controller, made.evidence
        made.save(path)
    saved = read_controller(path)
    return rebuild_controller(saved, path), saved.evidence


def draw_states(task: Task, evidence: Any, rng: np.random.Generator) -> np.ndarray:
    """Return first states of runs on the plant: what is measured by the design's distribution, the rest as logged."""
    x0, states = task.training.x0, list(task.plant.states)
    starts = rng.uniform(x0.low, x0.high, (STARTS, len(states)))
    starts[:, [states.index(name) for name in evidence.surrogates[0].states]] = draw_starts(evidence.task, STARTS, rng)
    return starts


def measure_design(task: Task, seed: int, controller: Any, evidence: Any) -> dict[str, Any]:
    """Return what a design promises, and cost and violation of each run on the plant; null where it was lost."""
    asked, rng = evidence.task, np.random.default_rng(1000 + seed)
    fast = speed_up(controller)
    pool = LoopPool(asked, evidence.surrogates, evidence.neighbours, evidence.low, evidence.high)
    none = np.zeros(0)
    fresh = run_fresh_loops(pool, fast, LOOPS, rng)
    expected = ExpectedLoop(none, none, none, none, 0.0, np.zeros((0, len(asked.low))), (), asked.steps, fresh)
    x0 = task.training.x0
    seen = [task.plant.states.index(name) for name in task.plant.outputs]
    noise = task.noise * (np.asarray(x0.high) - np.asarray(x0.low))[seen]
    costs: list[float] = []
    violations: list[float] = []
    for start in draw_states(task, evidence, rng):
        run = km.simulate(
            task.plant,
            fast,
            x0=start,
            reference=task.rows[: asked.steps + 1],
            steps=asked.steps,
            cost=km.Cost(Q=task.Q, R=task.R, of=task.of),
            limits=task.limits,
            options=km.loop.LoopOptions(
                u_reference=held(task.name, None)[: asked.steps], noise=noise, rng=int(rng.integers(2**31))
            ),
        )
        seen_states = run.X[:, seen]
        lost = not ((seen_states >= evidence.low) & (seen_states <= evidence.high)).all()
        sizes = asked.limit_sizes if len(asked.low) == task.plant.nx else None
        costs.append(np.inf if lost else km.metrics(run).cost)
        violations.append(np.inf if lost else float(violation_shares(run, sizes)[1:].max(initial=0.0)))
    low, high = expected.cost_interval
    lost = int(np.sum(~np.isfinite(fresh.cost)))
    return {
        "low": shorten(low),
        "high": shorten(high),
        "median": shorten(float(np.median(fresh.cost))),
        "most": shorten(expected.violation_bound),
        "lost in loops": lost,
        "lost bound": shorten(expected.lost_bound),
        "machine code": fast is not controller,
        "cost": [shorten(value) for value in costs],
        "violation": [shorten(value) for value in violations],
    }


def shorten(value: float) -> float:
    """Return five digits."""
    return float(f"{value:.5g}")


def summarise(table: dict[str, dict[str, Any]], tasks: list[str]) -> dict[str, float]:
    """Return the shares of promises that are kept, each design weighed equally."""
    rows = [one for key, one in table.items() if key.rsplit(" ", 1)[0] in tasks]
    inside = [np.mean([one["low"] <= c <= one["high"] for c in one["cost"]]) for one in rows]
    over = [np.mean([v > one["most"] for v in one["violation"]]) for one in rows]
    lost = [np.mean(~np.isfinite(one["cost"])) for one in rows]
    none = [one for one in rows if one["most"] < 5e-4]
    return {
        "designs": len(rows),
        "cost inside its interval": float(np.mean(inside)),
        "cost above it": float(np.mean([np.mean(np.array(one["cost"]) > one["high"]) for one in rows])),
        "violation above its bound": float(np.mean(over)),
        "mean bound of the violation": float(np.mean([one["most"] for one in rows if np.isfinite(one["most"])])),
        "lost above its bound": float(np.mean([a > one["lost bound"] for a, one in zip(lost, rows, strict=True)])),
        "mean bound of lost": float(np.mean([one["lost bound"] for one in rows])),
        "designs that say 0 %": len(none),
        "of these violate by over 1 %": sum(max(one["violation"]) > BROKEN for one in none),
    }


def describe(table: dict[str, dict[str, Any]]) -> list[str]:
    """Return the lines of the table of docs/closed_loop.md."""
    found = summarise(table, list(ALL))
    none = f"{found['of these violate by over 1 %']} of {found['designs that say 0 %']}"
    return [
        "| promise | asked | measured |",
        "| --- | --- | --- |",
        f"| cost inside its 90&nbsp;% interval | 85–95&nbsp;% | {100 * found['cost inside its interval']:.1f}&nbsp;% |",
        f"| violation above its bound | ≤ 8&nbsp;% | {100 * found['violation above its bound']:.1f}&nbsp;% |",
        f"| mean bound of the violation | – | {100 * found['mean bound of the violation']:.1f}&nbsp;% of the range |",
        f"| designs that lose more than their bound | ≤ 8&nbsp;% | {100 * found['lost above its bound']:.1f}&nbsp;% |",
        f"| mean bound of lost loops | – | {100 * found['mean bound of lost']:.1f}&nbsp;% |",
        f"| designs that say 0&nbsp;% and violate by more than 1&nbsp;% | 1 in 50 | {none} |",
    ]


def stored() -> dict[str, dict[str, Any]]:
    """Return the stored table: a row for each task and seed."""
    return json.loads(STORED.read_text()) if STORED.exists() else {}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.closed_loop.calibration", description=__doc__)
    parser.add_argument("--tasks", nargs="+", choices=ALL, default=list(ALL))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--designs", type=Path, help="folder in which designs are kept")
    parser.add_argument("--write", action="store_true", help="store the rows measured")
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    table: dict[str, dict[str, Any]] = {}
    for seed in asked.seeds:
        for task in asked.tasks:
            row = measure_design(ALL[task], seed, *read_or_design(task, seed, asked.designs))
            table[f"{task} {seed}"] = row
            sys.stdout.write(f"{task} {seed}: {json.dumps(row)}\n")
            sys.stdout.flush()
            if asked.write:
                both = stored() | table
                lines = ",\n".join(f"{json.dumps(key)}: {json.dumps(one)}" for key, one in sorted(both.items()))
                STORED.write_text("{" + lines + "}\n")
    sys.stdout.write("\n".join(describe(table)) + "\n")
    known = [one for one in ALL if one not in OTHER_PLANT]
    sys.stdout.write(f"without {', '.join(OTHER_PLANT)}: {json.dumps(summarise(table, known), indent=1)}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
