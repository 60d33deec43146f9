"""The stored rows keep what is promised, and a plant that is measured again gives its row."""

from dataclasses import replace

import pytest

from tests.guarantees.coverage.judge import judge
from tests.guarantees.coverage.plants import list_tasks
from tests.guarantees.coverage.table import find_shares, is_warned, stored


def test_the_stored_plants_keep_their_limits_as_often_as_promised():
    rows = stored()
    assert set(rows) <= set(list_tasks())
    shares = find_shares(rows)
    assert shares["plants"] == len(rows) > 0
    assert shares["kept"] >= 0.93
    assert shares["of these without a warning"] == 0


def test_a_plant_that_breaks_limits_without_a_warning_is_counted():
    name, row = next(iter(stored().items()))
    bad = replace(row, holds=True, kept=0, warnings=[])
    assert find_shares({name: bad})["of these without a warning"] == 1
    assert is_warned(replace(bad, holds=False))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["random 1", "integrating"])
def test_a_plant_that_is_measured_again_gives_its_row(name):
    row, again = stored()[name], judge(list_tasks()[name]())
    assert (again.kept, again.kept_plain, again.margin) == (row.kept, row.kept_plain, row.margin)
    assert again.over_optimum == pytest.approx(row.over_optimum, rel=1e-3)
