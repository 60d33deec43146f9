"""The table of the judge: as text, as JSON whose lines are its rows, and compared with the stored one."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from tests.closed_loop.controllers import YARDSTICKS
from tests.closed_loop.judge import LOST, Row, Table, rounded

HERE = Path(__file__).parent
STORED = HERE / "table.json"  # each row as it was last measured
DESIGNS = HERE / "designed.json"  # designs of the later tasks, seed 0
FIRST = HERE / "first_edition.json"  # of the first edition's defaults
WORSE = 1.05  # a default that costs more than this beyond the stored table fails
ALLOWED = 0.01  # and so does one that violates limits by this share of the range more
TIMES = ("median", "p99")


def text(table: Table, old: Table | None = None) -> str:
    """Return a line a row; with `old` its cost ratio stands beside the new one."""
    head = f"{'task':<12}{'controller':<16}{'cost':>9}{'' if old is None else f'{chr(32) * 3}before':>9}"
    lines = [head + f"{'violation':>11}{'steady':>9}{'median ms':>11}{'p99 ms':>9}  statuses"]
    for task, rows in table.items():
        for name, row in rows.items():
            before = None if old is None else old.get(task, {}).get(name)
            then = "" if old is None else f"{_ratio(before):>9}"
            lead = f"{task:<12}{name:<16}{_ratio(row):>9}{then}"
            if row.ratio is None:
                lines.append(f"{lead}  needs the whole state")
                continue
            counts = ", ".join(f"{count} {status}" for status, count in sorted(row.statuses.items()))
            times = f"{1e3 * row.median:>11.3g}{1e3 * row.p99:>9.3g}"
            more = "; ".join(part for part in (counts, row.failure) if part)
            lines.append(f"{lead}{row.violation:>11.2%}{row.steady:>9.1e}{times}  {more}")
    return "\n".join(lines)


def _ratio(row: Row | None) -> str:
    if row is None or row.ratio is None:
        return "-"
    return "failed" if row.failure else "lost" if row.ratio >= LOST else f"{row.ratio:.4g}"


def show_cost(row: Row | None) -> str:
    """Return the cost of a row as the pages have it, in brackets the violation from 0.05 % on."""
    if row is None:
        return "–"
    return _ratio(row) + (f"&nbsp;({100 * row.violation:.1f}&nbsp;%)" if row.violation >= 5e-4 else "")


def saved(table: Table, path: Path) -> None:
    """Write the table: a line a row, and the times, which no two runs share, apart at the end."""
    figures: dict[str, dict[str, object]] = {}
    times: dict[str, dict[str, object]] = {}
    for task, rows in table.items():
        for name, row in rows.items():
            values = asdict(rounded(row))
            times.setdefault(task, {})[name] = [values.pop(key) for key in TIMES]
            figures.setdefault(task, {})[name] = values
    path.write_text('{"figures": ' + _lines(figures) + ',\n"times": ' + _lines(times) + "}\n")


def _lines(nested: dict[str, dict[str, object]]) -> str:
    parts = []
    for task, rows in nested.items():
        body = ",\n".join(f"  {json.dumps(name)}: {json.dumps(row, sort_keys=True)}" for name, row in rows.items())
        parts.append(f" {json.dumps(task)}: {{\n{body}\n }}")
    return "{\n" + ",\n".join(parts) + "\n}"


def stored(path: Path = STORED) -> Table:
    """Read a table; an empty one where there is none."""
    if not path.exists():
        return {}
    content = json.loads(path.read_text())
    return {
        task: {
            name: Row(**values, **dict(zip(TIMES, content["times"][task][name], strict=True)))
            for name, values in rows.items()
        }
        for task, rows in content["figures"].items()
    }


def losses(new: Table, old: Table, exempt: Sequence[str] = YARDSTICKS) -> list[str]:
    """Return a sentence for each default that lost more than 5 % on a task, or violates its limits by 1 % more."""
    found: list[str] = []
    for task, rows in new.items():
        for name, row in rows.items():
            before = old.get(task, {}).get(name)
            if name in exempt or before is None or before.ratio is None or row.ratio is None:
                continue
            if row.failure and not before.failure:
                found.append(f"{task}, {name}: failed ({row.failure}), cost {before.ratio:.4g} before")
            elif row.ratio > WORSE * before.ratio:
                found.append(f"{task}, {name}: costs {row.ratio:.4g} times the optimum, {before.ratio:.4g} before")
            if row.violation > before.violation + ALLOWED and row.ratio < LOST:
                found.append(f"{task}, {name}: violates limits by {row.violation:.1%}, {before.violation:.1%} before")
    return found
