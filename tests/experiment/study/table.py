"""The stored rows of the studies, and what they amount to."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from tests.experiment.study.alarms import STEPS, Alarms
from tests.experiment.study.bent import Taken
from tests.experiment.study.drift import Verdicts
from tests.experiment.study.feedback import Biases
from tests.experiment.study.halves import HalfRow
from tests.experiment.study.safety import BROKEN, Experiments

KINDS = {
    "safety": Experiments,
    "halves": HalfRow,
    "drift": Verdicts,
    "alarms": Alarms,
    "feedback": Biases,
    "bent": Taken,
}
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


def count_alarms(rows: Iterable[Alarms]) -> dict[str, Any]:
    """Return how many runs had false alarms, and how many changes had one and were named rightly."""
    some = list(rows)
    return {
        "runs": f"{len(some)} of {STEPS} steps",
        "runs with a false alarm": sum(row.false > 0 for row in some),
        "unchanged": dict(Counter(row.unchanged for row in some)),
        "changes with an alarm": sum(row.true > 0 for row in some),
        "named rightly": sum(row.right for row in some),
    }


def count_feedback(rows: Iterable[Biases]) -> dict[str, Any]:
    """Return the range over the plants of biases over that of least squares, of their fall, and of variances."""
    some = list(rows)
    found: dict[str, Any] = {"plants": len(some)}
    for i, way in ((1, "instruments"), (2, "direct")):
        for steps in some[0].bias:
            ratios = [row.bias[steps][i] / row.bias[steps][0] for row in some]
            bounds = [row.bias[steps][i] / row.bound[steps][i] for row in some]
            found[f"{way}, {steps} rows"] = (
                f"bias over that of least squares {min(ratios):.4f} to {max(ratios):.4f}, over three standard errors "
                f"at most {max(bounds):.2f}, {sum(row.left[steps][i - 1] for row in some)} records left"
            )
        first, *_, last = some[0].bound
        falls = [row.bound[last][i] / row.bound[first][i] * (int(last) / int(first)) ** 0.5 for row in some]
        found[f"{way}, fall"] = f"of the standard error, over M^-1/2: {min(falls):.2f} to {max(falls):.2f}"
        spent = [row.variance[i - 1] for row in some]
        found[f"{way}, variance"] = f"{min(spent):.4f} to {max(spent):.4f} with process noise alone"
        found[f"{way}, refused"] = f"{sum(row.refused[i - 1] for row in some)} of {20 * len(some)} set points at rest"
    return found


def count_bent(rows: Iterable[Taken]) -> dict[str, Any]:
    """Return how often noise was taken out of logs of nonlinear plants, by noise, and what that gained."""
    some, found = list(rows), dict[str, Any]()
    for noise in sorted({row.noise for row in some}):
        part = [row for row in some if row.noise == noise]
        for i, way in enumerate(("without", "with")):
            ratios = [row.ratio[i] for row in part if row.taken[i]]
            mean = float(np.exp(np.mean(np.log(ratios)))) if ratios else 1.0
            found[f"noise {noise:g}, {way} instruments"] = (
                f"taken on {len(ratios)} of {len(part)}; error {mean:.3f}, at most {max(ratios, default=1.0):.3f}"
            )
    return found


COUNTS: dict[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
    "safety": lambda rows: count_safety(rows.values()),
    "halves": count_halves,
    "drift": lambda rows: count_drift(rows.values()),
    "alarms": lambda rows: count_alarms(rows.values()),
    "feedback": lambda rows: count_feedback(rows.values()),
    "bent": lambda rows: count_bent(rows.values()),
}
