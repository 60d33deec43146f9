"""The stored rows, and what they amount to."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from tests.guarantees.coverage.judge import Row

STORED = Path(__file__).with_name("table.json")
WORDS = ("limit", "lost", "outside", "promise")  # a warning is a sentence with one of these


def stored() -> dict[str, Row]:
    """Return the rows that were kept."""
    return {name: Row(**row) for name, row in json.loads(STORED.read_text()).items()} if STORED.exists() else {}


def save_rows(rows: dict[str, Row]) -> None:
    """Keep rows, one a line."""
    lines = [f"{json.dumps(name)}: {json.dumps(asdict(row), ensure_ascii=False)}" for name, row in rows.items()]
    STORED.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def is_warned(row: Row) -> bool:
    """Return whether the design withdraws its promise, or doubts that limits are kept."""
    return not row.holds or any(word in sentence for sentence in row.warnings for word in WORDS)


def find_shares(rows: dict[str, Row]) -> dict[str, float]:
    """Return the figures that the promise is judged by."""
    touched, free = ([row for row in rows.values() if row.touches is side] for side in (True, False))
    held = [row for row in rows.values() if row.holds]

    def worst(some: list[Row], name: str) -> tuple[float, float]:
        values = [getattr(row, name) for row in some] or [np.nan]
        return float(np.median(values)), float(np.max(values))

    figures = {
        "plants": len(rows),
        "promised": len(held),
        "runs": sum(row.runs for row in rows.values()),
        "kept": sum(row.kept for row in rows.values()) / max(sum(row.runs for row in rows.values()), 1),
        "kept where promised": sum(row.kept for row in held) / max(sum(row.runs for row in held), 1),
        "kept without a margin": sum(row.kept_plain for row in rows.values())
        / max(sum(r.runs for r in rows.values()), 1),
        "below 80 %": sum(row.kept < 0.8 * row.runs for row in rows.values()),
        "of these without a warning": sum(row.kept < 0.8 * row.runs and not is_warned(row) for row in rows.values()),
        "plants whose optimum touches": len(touched),
    }
    for name, some in (("touching", touched), ("free", free)):
        for ratio in ("over_plain", "over_optimum"):
            figures[f"{name}, {ratio}, median"], figures[f"{name}, {ratio}, most"] = worst(some, ratio)
    return figures


def summarise(rows: dict[str, Row]) -> str:
    """Return the figures as lines, and the plants that fall short."""
    lines = [f"{name}: {value:.4g}" for name, value in find_shares(rows).items()]
    lines += [
        f"  {name}: {row.kept} of {row.runs}, holds {row.holds}"
        for name, row in rows.items()
        if row.kept < 0.9 * row.runs
    ]
    return "\n".join(lines)
