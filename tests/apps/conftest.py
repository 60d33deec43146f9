"""A controller that was designed from logs of the mass, made once for all files of tests."""

from contextlib import nullcontext

import pytest

from koopmpc.apps.fitting.designing import design_data
from koopmpc.apps.fitting.options import FitOptions
from tests.apps.mass import GOAL, logs
from tests.small_designs import small_designs, undrawn_pages


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("designed")
    logs().save(folder / "logs.npz")
    (folder / "goal.toml").write_text(GOAL)
    with small_designs(), undrawn_pages():
        return design_data(folder / "logs.npz", folder / "goal.toml", folder / "out", FitOptions(linear=True))


@pytest.fixture(autouse=True)
def undrawn(request):
    """Let test_report.py alone look at the pictures of pages."""
    with nullcontext() if request.path.name == "test_report.py" else undrawn_pages():
        yield
