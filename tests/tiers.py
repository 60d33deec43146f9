"""Cases that `make full` alone runs, beside the few that every run of the tests has."""

from collections.abc import Iterable

import pytest


def slow(values: Iterable[object]) -> list[object]:
    """Return the values as parameters of a test that are marked slow."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]
