"""The page of the judge says what the stored calibration holds, and the promises are kept as asked."""

import numpy as np

from tests.closed_loop.calibration import describe, stored, summarise
from tests.closed_loop.more_tasks import ALL, JUDGED, MORE
from tests.closed_loop.table import DESIGNS, show_cost
from tests.closed_loop.table import stored as stored_rows
from tests.docs.page import DOCS


def test_the_page_of_the_judge_shows_the_stored_calibration():
    page = (DOCS / "closed_loop.md").read_text(encoding="utf-8").splitlines()
    table = stored()
    missing = [line for line in describe(table) if line not in page]
    assert not missing, "python -m tests.closed_loop.calibration prints them"
    assert any(f"{len(table)} designs" in line for line in page)


def test_the_page_of_the_judge_shows_the_stored_designs_of_the_later_tasks():
    page = (DOCS / "closed_loop.md").read_text(encoding="utf-8").splitlines()
    rows = stored_rows(DESIGNS)
    assert set(rows) <= set(JUDGED)
    for task in {*MORE, *rows}:
        shown = [line for line in page if line.startswith(f"| `{task}` ") and line.count(" | ") == 4]
        costs = [show_cost(rows.get(task, {}).get(name)) for name in ("designed", "guarded")]
        assert [line.split(" | ")[-2:] for line in shown] == [[costs[0], costs[1] + " |"]], task


def test_stored_promises_are_kept_as_often_as_asked():
    kept = summarise(stored(), list(ALL))
    assert {key.rsplit(" ", 1)[0] for key in stored()} == set(ALL)
    assert 0.85 <= kept["cost inside its interval"] <= 0.95
    assert max(kept["violation above its bound"], kept["lost above its bound"]) <= 0.08
    assert 50 * kept["of these violate by over 1 %"] <= kept["designs that say 0 %"]


def test_a_summary_counts_runs_inside_and_beyond_what_is_promised():
    row = {"low": 1.0, "high": 2.0, "most": 0.0, "lost bound": 0.2}
    table = {
        "beyond 0": row | {"cost": [0.5, 1.5, 1.6, 2.5], "violation": [0.0, 0.0, 0.0, 0.02]},
        "sine 0": row | {"cost": [1.5, np.inf], "violation": [0.0, np.inf]},
    }
    found = summarise(table, ["beyond", "sine"])
    assert found["cost inside its interval"] == 0.5
    assert found["cost above it"] == 0.375
    assert found["violation above its bound"] == 0.375
    assert found["lost above its bound"] == 0.5
    assert (found["designs that say 0 %"], found["of these violate by over 1 %"]) == (2, 2)
    assert summarise(table, ["beyond"])["designs"] == 1
