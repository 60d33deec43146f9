"""Pages show the figures that are stored: times of steps, long horizons, and coverage on plants."""

import json
import sys

import numpy as np

from koopmpc.experiment.ensemble import UNUSUAL
from tests.docs.page import DOCS
from tests.experiment.study.table import count_drift, count_halves, count_safety, load_rows
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


def test_the_page_of_research_shows_the_stored_study_of_planned_experiments():
    safety, halves, drift = (load_rows(study) for study in ("safety", "halves", "drift"))
    bands, named = count_safety(safety.values()), count_drift(drift.values())["named rightly"]
    held = {level: [one for row in safety.values() if row.level == level for one in row.held] for level in (0.7, 0.9)}
    reached = {level: [one for row in safety.values() if row.level == level for one in row.reached] for level in held}
    shares = {
        level: ", ".join(f"{np.mean(np.array(some) <= factor / UNUSUAL):.2f}" for factor in (1, 1.2, 1.5, 2))
        for level, some in reached.items()
    }
    planned, half = (
        np.exp(np.mean([np.log(getattr(row, name) / row.random) for row in halves.values()]))
        for name in ("planned", "half")
    )
    worse = count_halves(halves)
    page = "\n".join(read_lines("research.md"))
    for words in (
        f"at a level of 0.7 {sum(held[0.7])} of {len(held[0.7])} episodes held",
        f"at 0.9 {sum(held[0.9])} of {len(held[0.9])}; {bands['broken at all']} of {bands['episodes']} broke a limit",
        f"{bands['broken where the band holds']} where the band held",
        f"{shares[0.7]} held at 0.7, and {shares[0.9]} at 0.9",
        f"{worse['tasks']} tasks: planned rows cost {planned:.2f} times those of random steps (geometric mean)",
        f"at most 1.02 on {worse['at most 1.02 times']}, above 1.10 on {len(worse['worse'])}",
        f"half of the random steps alone {half:.2f}.",
        f"{sum(row.right for row in drift.values())} of {len(drift)} changes of 20 % named rightly",
        f"(inputs {named['input']}, sensors {named['sensor']}, coefficients {named['coefficient']})",
    ):
        assert words in page
