"""What the bench measured on the shipped problems: kept as measured.json, shown by `koopmpc list` and in the docs."""

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc import disk
from koopmpc.bench.controllers import LEARNED
from koopmpc.bench.problem import Problem, load_problem, shipped
from koopmpc.bench.store import ORACLE, RunRow
from koopmpc.bench.sweep import sweep
from koopmpc.scene import Shape

PATH = Path(__file__).with_name("measured.json")
BASELINE = "linear-mpc"  # what a problem without nonlinear MPC is compared with
OVER = 0.01  # violation beyond the baseline's, as a share of the largest limit, from which a run has broken a limit


@dataclass(frozen=True)
class Standing:
    """How a controller did on the cases of a problem in which the equations that it is given are the plant's.

    Attributes
    ----------
    ratio
        Its cost over the baseline's, in the case where that is largest.
    over
        Whether it broke a limit on states that the baseline kept, in any of these cases.
    time
        Median time of its steps over that of the baseline's steps.
    """

    ratio: float
    over: bool
    time: float

    def __str__(self) -> str:
        """Return e.g. ``"1.02"``, with a dagger where it broke a limit; ``"lost"`` from a hundred on."""
        return ("lost" if not self.ratio < 100 else f"{self.ratio:.3g}") + "†" * self.over


def standings(rows: Iterable[RunRow], problems: Sequence[Problem]) -> dict[str, dict[str, Standing]]:
    """Return the standing of each controller on each problem; a run that raised has lost."""
    found = {(row.problem, row.case, row.controller): row for row in rows if row.fault is None}
    return {problem.name: _standings(problem, found) for problem in problems}


def _standings(problem: Problem, found: Mapping[tuple[str, str, str], RunRow]) -> dict[str, Standing]:
    names = list(dict.fromkeys(name for key, _, name in found if key == problem.name))
    baseline = baseline_of(names)
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
            over = over or own.violation - other.violation > OVER * _size(problem, case)
        result[name] = Standing(max(ratios), over, float(np.median(times[1:] or times)))
    return result


def _size(problem: Problem, case: str) -> float:
    """Return the largest finite limit on a state or an observable, 1 where there is none."""
    limits = problem.limits_of(case)
    ends = (limits.x_min, limits.x_max, limits.y_min, limits.y_max)
    values = np.concatenate([np.ravel(np.asarray(end, dtype=float)) for end in ends if end is not None] or [np.ones(1)])
    finite = np.abs(values[np.isfinite(values)])
    return float(finite.max(initial=0.0)) or 1.0


def baseline_of(controllers: Iterable[str]) -> str:
    """Return the controller that the others are compared with."""
    return ORACLE if ORACLE in controllers else BASELINE


def best_learned(found: Mapping[str, Standing]) -> str | None:
    """Return the learned controller of least cost that broke no limit; None where each broke one."""
    kept = [name for name in found if name in LEARNED and not found[name].over]
    return min(kept, key=lambda name: round(found[name].ratio, 3)) if kept else None


def write_measured(found: Mapping[str, Mapping[str, Standing]], path: Path = PATH) -> None:
    """Write the standings, beside those of other problems that the file holds already."""
    known: dict[str, Any] = json.loads(path.read_text("utf-8")) if path.exists() else {}
    for problem, each in found.items():
        known[problem] = {name: [float(f"{s.ratio:.4g}"), s.over, float(f"{s.time:.2g}")] for name, s in each.items()}
    lines = [f"  {json.dumps(name)}: {json.dumps(known[name])}" for name in sorted(known)]
    with disk.writing(path) as stream:
        stream.write(("{\n" + ",\n".join(lines) + "\n}\n").encode())


@cache
def measured() -> dict[str, dict[str, Standing]]:
    """Return what measured.json holds: standings by problem and controller."""
    known: dict[str, Any] = json.loads(PATH.read_text("utf-8"))
    return {problem: {name: Standing(*values) for name, values in each.items()} for problem, each in known.items()}


def in_words(problem: str) -> str:
    """Return e.g. ``"bilinear-mpc: 1.000 × the cost of nonlinear-mpc, in 1/190 of its time"``; empty if unknown."""
    found = measured().get(problem)
    best = best_learned(found) if found else None
    if found is None or best is None:
        return ""
    own = found[best]
    time = f"1/{1 / own.time:.0f} of its time" if own.time < 0.7 else f"{own.time:.1f} × its time"
    return f"{best}: {own.ratio:.3f} × the cost of {baseline_of(found)}, in {time}"


def markdown(found: Mapping[str, Mapping[str, Standing]]) -> str:
    """Return the table problems × controllers for the docs."""
    names = list(dict.fromkeys(name for each in found.values() for name in each if name != ORACLE))
    lines = ["| problem | " + " | ".join(names) + " |", "|---|" + "--:|" * len(names)]
    for problem in sorted(found):
        each = found[problem]
        best = best_learned(each)
        cells = [f"**{each[n]}**" if n == best else str(each[n]) if n in each else "–" for n in names]
        lines.append(f"| `{problem}` | {' | '.join(cells)} |")
    return "\n".join(lines)


_SHARE, _LINEAR, _BILINEAR = 1.05, 1 / 20, 1 / 5  # cost and time that a learned controller may take, of the baseline's


def frugal(found: Mapping[str, Standing]) -> str | None:
    """Return the learned controller of the shortest step within 5 % of nonlinear MPC's cost; None where there is none.

    It takes at most 1/20 of its time, or 1/5 if bilinear. One that broke a limit does not count. Where linear MPC is
    the baseline, time does not.
    """
    timed = baseline_of(found) == ORACLE
    kept = {
        name: one
        for name, one in found.items()
        if name in LEARNED
        and not one.over
        and one.ratio <= _SHARE
        and (not timed or one.time <= (_BILINEAR if "bilinear" in name else _LINEAR))
    }
    return min(kept, key=lambda name: kept[name].time) if kept else None


def goals(found: Mapping[str, Mapping[str, Standing]]) -> str:
    """Return the table of the cheapest learned controller that does on each problem, for the docs."""
    lines = ["| problem | learned controller | cost | time of a step |", "|---|---|--:|--:|"]
    for problem in sorted(found):
        name = frugal(found[problem])
        if name is None:
            lines.append(f"| `{problem}` | none | | |")
        else:
            own, unit = found[problem][name], "" if baseline_of(found[problem]) == ORACLE else ", of linear MPC's"
            time = f"1/{1 / own.time:.0f}" if own.time < 0.7 else f"{own.time:.1f}"
            lines.append(f"| `{problem}` | {name} | {own.ratio:.3f}{unit} | {time} |")
    return "\n".join(lines)


def _nothing(x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"]) -> list[Shape]:
    return []


def measure(names: Sequence[str]) -> None:
    """Run the shipped problems of these names, by default all, in a temporary folder; write measured.json."""
    problems = [load_problem(path) for path in shipped() if not names or path.stem in names]
    for problem in problems:
        with TemporaryDirectory() as folder:
            rows = sweep([replace(problem, scene=_nothing)], folder=folder)  # drawing is what takes long
        found = standings(rows, [problem])
        for row in rows:
            if row.failure:
                sys.stdout.write(f"{row.problem}:{row.case} {row.controller}: {row.failure}\n")
        if found[problem.name]:
            write_measured(found)
            sys.stdout.write(f"{markdown(found)}\n")


if __name__ == "__main__":
    measure(sys.argv[1:])
