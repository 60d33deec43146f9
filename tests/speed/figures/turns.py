"""Measure figures in turns: `python -m tests.speed.figures.turns NAME … [--before TREE]` writes docs/speed.md.

A figure is measured in a process of its own. With `--before`, the tree of another commit, a second process measures the
same figure there, and both are asked in turns. `python -m tests.speed.figures.turns` without a name writes docs/speed.md
of what was measured before, and `--every` prints all rows as they are here and now, and writes nothing.
"""

import argparse
import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
PAGE = HERE.parents[2] / "docs" / "speed.md"
TABLE = "<!-- table -->\n\n", "\n\n<!-- end -->"
EACH = 6  # turns of a process: where its memory lies alone can move a time by 3 %
PAIRS = 24  # turns of a figure: the median's 95 % interval needs some 20
HEAD = ("figure", "before", "now", "now / before, 95 %", "compared with", "goal", "commit")


def find_files() -> list[Path]:
    """Return the files of figures."""
    return sorted(HERE.glob("of_*.py"))


def load_file(path: Path) -> dict[str, Any]:
    """Return the figures of a file by name."""
    if str(HERE) not in sys.path:
        sys.path.insert(0, str(HERE))
    return importlib.import_module(path.stem).FIGURES


def load_figures() -> dict[str, Any]:
    """Return the figures of all files by name."""
    return {name: figure for path in find_files() for name, figure in load_file(path).items()}


def read_measured(path: Path) -> dict[str, Any]:
    """Return what was measured of a file's figures, which is in a JSON file beside it."""
    beside = path.with_suffix(".json")
    return json.loads(beside.read_text(encoding="utf-8")) if beside.exists() else {}


def answer(name: str) -> None:
    """Measure a figure once for each line of standard input."""
    measure = load_figures()[name].prepare()
    measure()  # warm
    for _ in sys.stdin:
        got = measure()
        sys.stdout.write(json.dumps(got if isinstance(got, tuple) else [got]) + "\n")
        sys.stdout.flush()


class Side:
    """The process that measures a figure in one tree."""

    def __init__(self, name: str, tree: Path) -> None:
        pinned = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")
        command = [sys.executable, str(HERE / "turns.py"), "--answer", name]
        environment = {**os.environ, **pinned, "PYTHONPATH": str(tree), "KOOPMPC_TESTS": "bare"}
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=tree
        )

    def ask(self) -> list[float]:
        """Return one measurement: seconds, and those of the yardstick where there is one."""
        process = self.process
        assert process.stdin is not None, "it was opened"
        assert process.stdout is not None, "it was opened"
        process.stdin.write("\n")
        process.stdin.flush()
        return json.loads(process.stdout.readline())

    def close(self) -> None:
        """End the process."""
        self.process.communicate()


def interval(values: list[float]) -> tuple[float, float, float]:
    """Return the median and its 95 % interval, by order statistics."""
    ordered = sorted(values)
    n = len(ordered)
    reach = round(0.98 * n**0.5)
    middle = (ordered[(n - 1) // 2] + ordered[n // 2]) / 2
    return middle, ordered[max(0, n // 2 - reach)], ordered[min(n - 1, (n - 1) // 2 + reach)]


def read_commit(tree: Path) -> str:
    """Return the commit of a tree, with a + where files were changed since."""
    commit, changed = (
        subprocess.run(["git", *command], cwd=tree, capture_output=True, text=True, check=True).stdout.strip()
        for command in (
            ("rev-parse", "--short=7", "HEAD"),
            ("status", "--porcelain", "--untracked-files=no", "koopmpc"),
        )
    )
    return commit + "+" * bool(changed)


def measure(name: str, before: Path | None, pairs: int) -> dict[str, Any]:
    """Return what was measured of a figure."""
    trees = {"now": HERE.parents[2]} | ({} if before is None else {"before": before})
    rows: dict[str, list[list[float]]] = {side: [] for side in trees}
    for first in range(0, pairs, EACH):
        sides = {side: Side(name, tree) for side, tree in trees.items()}
        for turn in range(first, min(first + EACH, pairs)):
            for side in list(sides)[:: 1 if turn % 2 else -1]:
                rows[side].append(sides[side].ask())
        for process in sides.values():
            process.close()
    found: dict[str, Any] = {"commit": read_commit(trees["now"]), "pairs": pairs}
    for side, values in rows.items():
        found[side] = interval([row[0] for row in values])[0]
        if len(values[0]) > 1:
            found[f"{side} to yardstick"] = interval([row[0] / row[1] for row in values])
    if before is not None:
        found["ratio"] = interval([a[0] / b[0] for a, b in zip(rows["now"], rows["before"], strict=True)])
    return found


def format_time(seconds: float | None) -> str:
    """Return a time with its unit, of three digits."""
    if seconds is None:
        return ""
    unit, scale = next((u, s) for u, s in (("s", 1.0), ("ms", 1e3), ("µs", 1e6)) if seconds * s >= 1 or u == "µs")
    return f"{seconds * scale:.3g} {unit}"


def format_row(figure: Any, found: dict[str, Any]) -> str:
    """Return the row of a figure."""
    ratio, relative, former = found.get("ratio"), found.get("now to yardstick"), found.get("before to yardstick")
    cells = (
        figure.what,
        format_time(found.get("before")),
        format_time(found["now"]),
        f"{ratio[0]:.2f} ({ratio[1]:.2f} to {ratio[2]:.2f})" if ratio else "",
        f"{relative[0]:.2f} × {figure.yardstick}{f', was {former[0]:.2f}' if former else ''}"
        if relative and figure.yardstick
        else "",
        figure.goal,
        f"`{found['commit']}`",
    )
    return "| " + " | ".join(cells) + " |"


def write_page(measured: dict[str, Any]) -> None:
    """Put the table of what was measured into the page."""
    figures = load_figures()
    rows = [format_row(figures[name], found) for name, found in measured.items() if name in figures]
    table = "\n".join(["| " + " | ".join(HEAD) + " |", "|" + " --- |" * len(HEAD), *rows])
    text = PAGE.read_text(encoding="utf-8")
    first, last = text.index(TABLE[0]) + len(TABLE[0]), text.index(TABLE[1])
    PAGE.write_text(text[:first] + table + text[last:], encoding="utf-8")


def main() -> None:
    """Measure the figures that are named, and write the page."""
    parser = argparse.ArgumentParser(description="Measure figures in turns, and write the page.")
    parser.add_argument("names", nargs="*")
    parser.add_argument("--before", type=Path)
    parser.add_argument("--pairs", type=int, default=PAIRS)
    parser.add_argument("--answer")
    parser.add_argument("--every", action="store_true")
    given = parser.parse_args()
    if given.answer:
        answer(given.answer)
        return
    if given.every:
        for name, figure in load_figures().items():
            sys.stdout.write(format_row(figure, measure(name, given.before, min(given.pairs, EACH))) + "\n")
            sys.stdout.flush()
        return
    figures, measured = load_figures(), {path: read_measured(path) for path in find_files()}
    for name in given.names:
        path = next(file for file in measured if name in load_file(file))
        measured[path][name] = measure(name, given.before, given.pairs)
        sys.stdout.write(format_row(figures[name], measured[path][name]) + "\n")
        path.with_suffix(".json").write_text(json.dumps(measured[path], indent=1) + "\n", encoding="utf-8")
    write_page({name: found for rows in measured.values() for name, found in rows.items()})


if __name__ == "__main__":
    main()
