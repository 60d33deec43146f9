"""Rerun only logs an error where it could raise one, unless it is strict."""

from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True, scope="session")
def strict() -> Iterator[None]:
    import rerun as rr

    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)
