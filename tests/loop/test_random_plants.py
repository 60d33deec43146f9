"""Random loops with all that real plants ask for: no exception, no unsafe input, no level that is not in the list."""

import sys

import pytest

from tests.compiler import avoid_compiling
from tests.loop.random_plants import run_loops, table


def good(outcomes) -> None:
    assert [(each.seed, each.error) for each in outcomes if each.error] == []
    assert [each.seed for each in outcomes if each.outside > 1e-9 or each.infinite] == []
    assert [each.seed for each in outcomes if each.off_levels or each.early] == []


@pytest.fixture(autouse=True)
def interpret(monkeypatch):
    avoid_compiling(monkeypatch)


def test_a_sample_of_random_loops_with_all_features() -> None:
    outcomes = run_loops(range(14))
    good(outcomes)
    found = {name for each in outcomes for name in each.features}
    assert {"levels", "rows in time", "W", "periodic", "price", "priority", "own blocks", "station"} <= found


@pytest.mark.slow
def test_a_thousand_random_loops_with_all_features() -> None:
    outcomes = run_loops(range(1000), 2)
    sys.stdout.write("\n" + "\n".join(table(outcomes)) + "\n")
    good(outcomes)
