"""Drift of nonlinear plants: stored verdicts hold, a page shows them, and a plant judged again gives its row."""

import numpy as np
import pytest

from tests.docs.page import DOCS
from tests.drift.nonlinear import judge_drift, load_rows

ROWS = load_rows()


def test_changes_are_named_and_their_absence_is_not():
    rows = list(ROWS.values())
    assert len(rows) >= 400
    assert not any("changed" in {row.unchanged, row.quiet, row.far} for row in rows)
    assert np.mean([row.right for row in rows]) >= 0.9


def test_the_pages_show_the_stored_rows():
    named = {
        kind: f"{kind}s {sum(row.right for row in some)} of {len(some)}"
        for kind in ("input", "sensor", "coefficient")
        if (some := [row for row in ROWS.values() if row.kind == kind])
    }
    right = sum(row.right for row in ROWS.values())
    page = (DOCS / "research.md").read_text(encoding="utf-8")
    assert f"{right} of {len(ROWS)} changes of 20 % named rightly" in page
    assert f"({', '.join(named.values())})" in page
    assert f"named {right} of {len(ROWS)} changes" in (DOCS / "how" / "what_changed.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("number", [28, 416])
def test_a_change_that_explains_too_little_is_not_named(number):
    """Of 550 unchanged plants these two were named while changes of 8 % were, and none had to explain a third."""
    assert judge_drift(number).unchanged != "changed"


@pytest.mark.slow
def test_a_plant_that_is_judged_again_gives_its_row():
    number = next(iter(ROWS))
    assert judge_drift(int(number)) == ROWS[number]
