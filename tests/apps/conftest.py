"""A controller that was designed from logs of the mass, made once for all files of tests."""

from contextlib import nullcontext

import pytest

from tests.apps.mass import design
from tests.small_designs import small_designs, undrawn_pages


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    with small_designs(), undrawn_pages():
        return design(tmp_path_factory.mktemp("designed"))


@pytest.fixture(autouse=True)
def undrawn(request):
    """Let test_report.py alone look at the pictures of pages."""
    with nullcontext() if request.path.name == "test_report.py" else undrawn_pages():
        yield
