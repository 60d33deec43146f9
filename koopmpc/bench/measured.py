"""Standings of the controllers on the shipped problems: measured.json, from which `koopmpc list` says the best."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from koopmpc.bench.controllers import is_learned
from koopmpc.bench.store import ORACLE

PATH = Path(__file__).with_name("measured.json")
BASELINE = "linear-mpc"  # compare with it if a problem has no nonlinear MPC


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
