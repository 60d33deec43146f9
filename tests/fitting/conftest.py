"""A controller that was designed from logs of the mass, made once for all files of tests."""

import pytest

from koopmpc.fitting.goal import design_data
from tests.fitting.mass import GOAL, logs
from tests.small_designs import small_designs


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("designed")
    logs().save(folder / "logs.npz")
    (folder / "goal.toml").write_text(GOAL)
    with small_designs():
        return design_data(folder / "logs.npz", folder / "goal.toml", folder / "out", bilinear=False)
