"""What `koopmpc list` and `explain` say of problems: their cases, and standings of the controllers (measured.json)."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from koopmpc.apps.bench.controllers import is_learned
from koopmpc.apps.bench.problem import Problem
from koopmpc.apps.bench.problem_files import list_problems, load_problem
from koopmpc.apps.bench.store import ORACLE
from koopmpc.base.errors import KoopmpcError

PATH = Path(__file__).with_name("measured.json")
BASELINE = "linear-mpc"  # compare with it if a problem has no nonlinear MPC


@dataclass(frozen=True)
class Standing:
    """How a controller did on the cases of a problem in which the equations that it is given are the plant's."""

    ratio: float  # its cost over the baseline's, in the case where that is largest
    over: bool  # it broke a limit on states that the baseline kept, in one of these cases
    time: float  # median time of its steps over that of the baseline's steps

    def __str__(self) -> str:
        """Return e.g. ``"1.02"``, with a dagger where it broke a limit; ``"lost"`` from a hundred on."""
        return ("lost" if not self.ratio < 100 else f"{self.ratio:.3g}") + "†" * self.over


def find_baseline(controllers: Iterable[str]) -> str:
    """Return the controller that the others are compared with."""
    return ORACLE if ORACLE in controllers else BASELINE


def find_best_learned(found: Mapping[str, Standing]) -> str | None:
    """Return the learned controller of least cost that broke no limit; None where each broke one."""
    kept = [name for name in found if is_learned(name) and not found[name].over]
    return min(kept, key=lambda name: round(found[name].ratio, 3)) if kept else None


@cache
def read_standings() -> dict[str, dict[str, Standing]]:
    """Return what measured.json holds: standings by problem and controller."""
    known: dict[str, Any] = json.loads(PATH.read_text("utf-8"))
    return {problem: {name: Standing(*values) for name, values in each.items()} for problem, each in known.items()}


def describe_best(problem: str) -> str:
    """Return e.g. ``"bilinear-mpc: 1.000 × the cost of nonlinear-mpc, in 1/190 of its time"``; empty if unknown."""
    found = read_standings().get(problem)
    best = find_best_learned(found) if found else None
    if found is None or best is None:
        return ""
    own = found[best]
    time = f"1/{1 / own.time:.0f} of its time" if own.time < 0.7 else f"{own.time:.1f} × its time"
    return f"{best}: {own.ratio:.3f} × the cost of {find_baseline(found)}, in {time}"


def describe_cases(asked: str) -> list[str]:
    """Return a sentence on each case that is called ``"case"`` or ``"problem:case"``."""
    name, _, case = asked.rpartition(":")
    found: list[str] = []
    for entry in list_problems():
        if name not in ("", entry.name) or case not in entry.path.read_text(encoding="utf-8", errors="replace"):
            continue
        try:
            problem = load_problem(entry.path)
        except KoopmpcError:  # a file of the user's that does not load; `koopmpc list` names it
            continue
        found += [_describe_case(problem, each) for each in problem.cases if each == case]
    return found


def _describe_case(problem: Problem, name: str) -> str:
    """Return where a case begins, where it leads, and what controllers are not told."""
    case, row = problem.cases[name], np.atleast_2d(problem.cases[name].reference)
    start, end = (", ".join(f"{value:.4g}" for value in np.ravel(each)) for each in (case.x0, row[0]))
    moves = " and moves on" if len(row) > 1 else ""
    parts = [
        f"{problem.name}:{name} is a case of {problem.name}: from the state ({start}) to the reference ({end}){moves}, "
        f"{case.steps * problem.dt:.4g} s"
    ]
    if case.limits is not None:
        parts.append("with limits of its own")
    if case.noise is not None:
        parts.append("with noise in the measurement")
    if case.faults:
        parts.append("with " + ", ".join(type(fault).__name__ for fault in case.faults))
    text = "; ".join(parts) + "."
    if case.plant is not None:
        text += f" The plant is another one than the controllers know{_name_changes(problem.dynamics, case.plant)}. "
        text += "So nonlinear-mpc is not optimal here, and a ratio may be below 1."
    return text


def _name_changes(known: object, real: object) -> str:
    """Return ``" (m is 1.2, not 1)"`` for the fields in which two plants differ; empty for plants of two kinds."""
    if type(known) is not type(real) or not is_dataclass(known):
        return ""
    pairs = [(field.name, getattr(known, field.name), getattr(real, field.name)) for field in fields(known)]
    changes = [f"{name} is {there}, not {here}" for name, here, there in pairs if np.any(here != there)]
    return f" ({', '.join(changes)})" if changes else ""
