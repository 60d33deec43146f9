"""Cases that `make full` alone runs, beside the few that every run of the tests has."""

from collections.abc import Iterable

import pytest


def slow(values: Iterable[object]) -> list[object]:
    """Return the values as parameters of a test that are marked slow."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


def few(values: Iterable[object], *stay: object) -> list[object]:
    """Return the values as parameters of a test that are marked slow, but those that stay in every run."""
    values = list(values)
    assert all(value in values for value in stay)
    return [value if value in stay else pytest.param(value, marks=pytest.mark.slow) for value in values]
