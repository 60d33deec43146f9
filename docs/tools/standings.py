"""Measure the shipped problems: `python docs/tools/standings.py [NAME…]` runs all controllers and writes measured.json.

`python docs/tools/gallery.py --pages` puts the tables of this file into the docs.
"""

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from koopmpc.apps.bench.controllers import is_learned
from koopmpc.apps.bench.measured import PATH, Standing, find_baseline, find_best_learned
from koopmpc.apps.bench.problem import Problem
from koopmpc.apps.bench.problem_files import load_problem, shipped
from koopmpc.apps.bench.store import ORACLE, RunRow
from koopmpc.apps.bench.sweep import sweep
from koopmpc.base import disk

OVER = 0.005  # a run breaks a limit if it violates one by this share of its range more than the baseline
COST_SHARE = 1.05  # a frugal controller costs at most this share of nonlinear MPC
LINEAR_TIME = 1 / 20  # a step of a frugal linear controller takes at most this share of nonlinear MPC's time
BILINEAR_TIME = 1 / 5  # a step of a frugal bilinear controller takes at most this share of nonlinear MPC's time


def compute_standings(rows: Iterable[RunRow], problems: Sequence[Problem]) -> dict[str, dict[str, Standing]]:
    """Return the standing of each controller on each problem; a run that raised has lost."""
    found = {(row.problem, row.case, row.controller): row for row in rows if row.fault is None}
    return {problem.name: _judge_problem(problem, found) for problem in problems}


def _judge_problem(problem: Problem, found: Mapping[tuple[str, str, str], RunRow]) -> dict[str, Standing]:
    names = list(dict.fromkeys(name for key, _, name in found if key == problem.name))
    baseline = find_baseline(names)
    if baseline not in names:
        return {}  # a problem for other controllers
    cases = [name for name, case in problem.cases.items() if not (case.plant or case.faults or case.noise is not None)]
    result: dict[str, Standing] = {}
    for name in names:
        ratios, times, over = [0.0], [0.0], False
        for case in cases:
            own, other = found[problem.name, case, name].metrics, found[problem.name, case, baseline].metrics
            if own is None or other is None or not np.isfinite(own.cost):
                ratios.append(float("inf"))
                continue
            ratios.append(own.cost / other.cost)
            times.append(own.solve_time_p50 / other.solve_time_p50)
            over = over or own.violation_share - other.violation_share > OVER
        result[name] = Standing(max(ratios), over, float(np.median(times[1:] or times)))
    return result


def write_standings(found: Mapping[str, Mapping[str, Standing]], path: Path = PATH) -> None:
    """Write the standings, beside those of other problems that the file holds already."""
    known: dict[str, Any] = json.loads(path.read_text("utf-8")) if path.exists() else {}
    for problem, each in found.items():
        known[problem] = {name: [float(f"{s.ratio:.4g}"), s.over, float(f"{s.time:.2g}")] for name, s in each.items()}
    lines = [f"  {json.dumps(name)}: {json.dumps(known[name])}" for name in sorted(known)]
    with disk.writing(path) as stream:
        stream.write(("{\n" + ",\n".join(lines) + "\n}\n").encode())


def format_standings(found: Mapping[str, Mapping[str, Standing]]) -> str:
    """Return the table problems × controllers for the docs."""
    names = list(dict.fromkeys(name for each in found.values() for name in each if name != ORACLE))
    lines = ["| problem | " + " | ".join(names) + " |", "|---|" + "--:|" * len(names)]
    for problem in sorted(found):
        each = found[problem]
        best = find_best_learned(each)
        cells = [f"**{each[n]}**" if n == best else str(each[n]) if n in each else "–" for n in names]
        lines.append(f"| `{problem}` | {' | '.join(cells)} |")
    return "\n".join(lines)


def find_frugal(found: Mapping[str, Standing]) -> str | None:
    """Return the learned controller of the shortest step within 5 % of nonlinear MPC's cost; None where there is none.

    It takes at most 1/20 of its time, or 1/5 if bilinear. One that broke a limit does not count. Where linear MPC is
    the baseline, time does not.
    """
    timed = find_baseline(found) == ORACLE
    kept = {
        name: one
        for name, one in found.items()
        if is_learned(name)
        and not one.over
        and one.ratio <= COST_SHARE
        and (not timed or one.time <= (BILINEAR_TIME if "bilinear" in name else LINEAR_TIME))
    }
    return min(kept, key=lambda name: kept[name].time) if kept else None


def format_goals(found: Mapping[str, Mapping[str, Standing]]) -> str:
    """Return the table of the cheapest learned controller that does on each problem, for the docs."""
    lines = ["| problem | learned controller | cost | time of a step |", "|---|---|--:|--:|"]
    for problem in sorted(found):
        name = find_frugal(found[problem])
        if name is None:
            lines.append(f"| `{problem}` | none | | |")
        else:
            own, unit = found[problem][name], "" if find_baseline(found[problem]) == ORACLE else ", of linear MPC's"
            time = f"1/{1 / own.time:.0f}" if own.time < 0.7 else f"{own.time:.1f}"
            lines.append(f"| `{problem}` | {name} | {own.ratio:.3f}{unit} | {time} |")
    return "\n".join(lines)


def measure(names: Sequence[str]) -> None:
    """Run the shipped problems of these names, by default all, in a temporary folder; write measured.json."""
    problems = [load_problem(path) for path in shipped() if not names or path.stem in names]
    for problem in problems:
        with TemporaryDirectory() as folder:
            rows = sweep([replace(problem, scene=lambda x, u: [])], folder=folder)  # drawing is what takes long
        found = compute_standings(rows, [problem])
        for row in rows:
            if row.failure:
                sys.stdout.write(f"{row.problem}:{row.case} {row.controller}: {row.failure}\n")
        if found[problem.name]:
            write_standings(found)
            sys.stdout.write(f"{format_standings(found)}\n")


if __name__ == "__main__":
    measure(sys.argv[1:])
