"""The stored rows of the three studies, and what they amount to."""

import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from tests.experiment.study.drift import Verdicts
from tests.experiment.study.halves import HalfRow
from tests.experiment.study.safety import BROKEN, Experiments

KINDS = {"safety": Experiments, "halves": HalfRow, "drift": Verdicts}
SAME, WORSE = 1.02, 1.10  # ratios of costs up to which they count as the same, and above which as worse


def load_rows(study: str) -> dict[str, Any]:
    """Return the rows of a study that were kept."""
    file = _find_file(study)
    stored = json.loads(file.read_text()) if file.exists() else {}
    return {name: KINDS[study](**row) for name, row in stored.items()}


def save_rows(study: str, rows: Mapping[str, Any]) -> None:
    """Keep rows, one a line."""
    lines = [f"{json.dumps(name)}: {json.dumps(asdict(row), ensure_ascii=False)}" for name, row in rows.items()]
    _find_file(study).write_text("{\n" + ",\n".join(lines) + "\n}\n")


def _find_file(study: str) -> Path:
    return Path(__file__).with_name(f"{study}.json")


def count_safety(rows: Iterable[Experiments]) -> dict[str, Any]:
    """Return how many episodes held their band, by level, and by how much limits were broken."""
    found: dict[str, Any] = {"plants": 0, "episodes": 0, "refused at first": 0}
    by_level: dict[float, list[bool]] = {}
    broken, held = list[float](), list[bool]()
    for row in rows:
        found["plants"] += 1
        found["refused at first"] += not row.held and row.ended.startswith("no safe plan")
        by_level.setdefault(row.level, []).extend(row.held)
        held += row.held
        broken += row.broken
    found["episodes"] = len(held)
    for level, one in sorted(by_level.items()):
        found[f"held of {len(one)} at a level of {level:g}"] = sum(one)
    over = np.array(broken) > BROKEN
    found["broken where the band holds"] = int((over & np.array(held, dtype=bool)).sum())
    found["broken at all"] = int(over.sum())
    return found


def count_halves(rows: Mapping[str, HalfRow]) -> dict[str, Any]:
    """Return on how many tasks half of the rows, planned, cost the same, and more."""
    ratios = {name: row.planned / row.random for name, row in rows.items()}
    return {
        "tasks": len(rows),
        f"at most {SAME:g} times": sum(one <= SAME for one in ratios.values()),
        "worse": {name: round(one, 3) for name, one in ratios.items() if one > WORSE},
    }


def count_drift(rows: Iterable[Verdicts]) -> dict[str, Any]:
    """Return how many verdicts of each kind there were, and how many changes were named rightly."""
    some = list(rows)
    kinds = sorted({row.kind for row in some})
    return {
        "plants": len(some),
        "unchanged": dict(Counter(row.unchanged for row in some)),
        "quiet": dict(Counter(row.quiet for row in some)),
        "far": dict(Counter(row.far for row in some)),
        "named rightly": {
            kind: f"{sum(row.right for row in some if row.kind == kind)} of {sum(row.kind == kind for row in some)}"
            for kind in kinds
        },
    }
