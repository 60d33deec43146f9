"""The tables of `koopmpc run` in README.md and docs/bench.md, measured now: `python docs/tools/tables.py [TASK…]`.

A table stands between ```text and ```, and its first line is its task. Costs are the same on every machine to some
digits; times are of this machine and its load.
"""

import os
import re
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

ROOT = Path(__file__).parents[2]
PAGES = (ROOT / "README.md", ROOT / "docs" / "bench.md")
TABLE = re.compile(r"```text\n(\w+:\w+)\n\n  controller .*?```", re.DOTALL)


def measure(task: str) -> str:
    """Return the table that `koopmpc run` prints for a task."""
    environment = os.environ | {"COLUMNS": "110", "PYTHONPATH": str(ROOT)}
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "koopmpc", "run", task]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    lines = [line.rstrip() for line in done.stdout.splitlines()]
    rows = lines[lines.index(task) + 2 :]
    return "\n".join([task, "", *rows[: rows.index("")]])


def main(tasks: list[str]) -> None:
    """Measure the tables of these tasks, by default of all that the pages show, and write them into the pages."""
    texts = {page: page.read_text(encoding="utf-8") for page in PAGES}
    shown = dict.fromkeys(task for text in texts.values() for task in TABLE.findall(text))
    tables = {task: measure(task) for task in tasks or shown}
    for page, text in texts.items():
        new = TABLE.sub(lambda found: f"```text\n{tables[found[1]]}\n```" if found[1] in tables else found[0], text)
        page.write_text(new, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
