"""Pages show the figures that are stored: times of steps, long horizons, and coverage on plants."""

import json
import sys

from tests.docs.page import DOCS
from tests.guarantees.coverage.plants import list_tasks
from tests.guarantees.coverage.table import find_shares
from tests.guarantees.coverage.table import stored as read_coverage
from tests.speed.figures import growth, turns


def read_lines(page: str) -> list[str]:
    return (DOCS / page).read_text(encoding="utf-8").splitlines()


def test_the_page_of_speed_shows_the_stored_figures(monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])  # figures are imported from their folder
    figures, lines = turns.load_figures(), read_lines("speed.md")
    measured = {name: found for path in turns.find_files() for name, found in turns.read_measured(path).items()}
    assert len(measured) > 10
    missing = [name for name, found in measured.items() if turns.format_row(figures[name], found) not in lines]
    assert not missing, "python -m tests.speed.figures.turns writes them"


def test_the_page_of_speed_shows_the_stored_long_horizons():
    lines = read_lines("speed.md")
    found = json.loads(growth.MEASURED.read_text())
    for rows in found.values():
        cells = [f"{1e3 * row['next']:.3g} ms" for row in rows.values()] + [f"{rows['500']['MB']:.0f} MB"]
        assert any(line.endswith("| " + " | ".join(cells) + " |") for line in lines), cells
    daqp, staged, compiled = (
        found[name]["500"]["next"] / found[name]["50"]["next"] for name in ("daqp", "riccati", "riccati in C")
    )
    assert (
        f"{round(daqp, -1):.0f} times as long, one of `BilinearMPC` {staged:.0f} times, in C {compiled:.0f}."
        in "\n".join(lines)
    )


def test_the_page_of_speed_shows_the_stored_large_problems():
    assert growth.write_large_rows(json.loads(growth.LARGE.read_text())) in "\n".join(read_lines("speed.md"))


def test_the_page_of_guarantees_shows_the_stored_coverage():
    rows, page = read_coverage(), "\n".join(read_lines("why/guarantees.md"))
    shares, ran = find_shares(rows), [row.kept / row.runs for row in rows.values()]
    few = ", ".join(f"{100 * share:.0f} %" for share in sorted(ran, reverse=True) if share < 0.8)
    kept, plain, promised = (
        f"{100 * shares[name]:.1f} %" for name in ("kept", "kept without a margin", "kept where promised")
    )
    for words in (
        f"{shares['plants']} of {len(list_tasks())} plants",
        f"of {shares['runs']}; without the margin | {kept}; {plain} |",
        f"| {shares['promised']}; {promised} |",
        f"| {shares['below 80 %']} ({few}); {shares['of these without a warning']} |",
        f"on {shares['plants whose optimum touches']} plants whose optimum touches a limit | "
        f"{shares['touching, over_plain, median']:.2f}, {shares['touching, over_plain, most']:.2f} |",
        f"| {shares['free, over_plain, median']:.2f}, {shares['free, over_plain, most']:.2f} |",
    ):
        assert words in page
