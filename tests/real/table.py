"""The table of the judge of records: as text, as JSON, and compared with the stored one."""

import json
import math
from dataclasses import asdict
from pathlib import Path

from tests.real.judge import KNOWING, OURS, Entry, Table
from tests.real.records import RECORDS
from tests.real.twins import TWINS
from tests.real.yardsticks import YARDSTICKS

STORED = Path(__file__).parent / "table.json"
WORSE = 1.05  # a free-run error of ours above this multiple of the stored one fails
COLUMNS = (*OURS, *YARDSTICKS, KNOWING)


def text(table: Table) -> str:
    """Return the free-run errors of the table, a line a record, and below them the short forecasts and the times."""
    lines = [f"{'free run over the test part':<34}" + "".join(f"{name:>17}" for name in COLUMNS)]
    for name, row in table.items():
        unit = RECORDS[name]().unit if name in RECORDS else TWINS[name].unit
        lines.append(f"{name + ' [' + unit + ']':<34}" + "".join(f"{_figure(row.get(c)):>17}" for c in COLUMNS))
    lines.append("\n20 steps ahead; time to find the model [s]")
    for name, row in table.items():
        ours = [row[c] for c in OURS if c in row]
        cells = [f"{entry.ahead:.4g}" for entry in ours] + [f"{entry.seconds:.0f} s" for entry in ours[:2]]
        lines.append(f"{name:<34}" + "".join(f"{cell:>17}" for cell in cells))
    return "\n".join(lines)


def _figure(entry: Entry | None) -> str:
    if entry is None:
        return "-"
    if entry.failure:
        return "failed"
    return "diverged" if entry.diverged or not math.isfinite(entry.free) else f"{entry.free:.4g}"


def save(table: Table, path: Path = STORED) -> None:
    """Write the table as JSON, a line an entry; numbers have four digits, and infinite errors are null."""
    body: list[str] = []
    for name, row in table.items():
        entries = ",\n".join(f"  {json.dumps(model)}: {json.dumps(_rounded(row[model]))}" for model in sorted(row))
        body.append(f" {json.dumps(name)}: {{\n{entries}\n }}")
    path.write_text("{\n" + ",\n".join(body) + "\n}\n")


def _rounded(entry: Entry) -> dict[str, object]:
    values = asdict(entry)
    for key in ("free", "ahead", "seconds"):
        value = values[key]
        values[key] = float(f"{value:.4g}") if math.isfinite(value) else None
    return values


def load(path: Path = STORED) -> Table:
    """Read a table; an empty one where there is none."""
    if not path.exists():
        return {}
    infinite = {"free": math.inf, "ahead": math.nan, "seconds": 0.0}
    return {
        name: {
            model: Entry(**{k: infinite[k] if v is None and k in infinite else v for k, v in entry.items()})
            for model, entry in row.items()
        }
        for name, row in json.loads(path.read_text()).items()
    }


def losses(new: Table, old: Table) -> list[str]:
    """Return a sentence for each of our models whose free run is more than 5 % worse than in the stored table."""
    found: list[str] = []
    for name, row in new.items():
        for model in OURS:
            before, now = old.get(name, {}).get(model), row.get(model)
            if before is None or now is None:
                continue
            if now.diverged and not before.diverged:
                found.append(f"{name}, {model}: the free run diverges, its error was {before.free:.4g}")
            elif now.free > WORSE * before.free:
                found.append(f"{name}, {model}: error {now.free:.4g}, {before.free:.4g} before")
    return found
