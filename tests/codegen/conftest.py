import pytest

from tests.codegen import plants


@pytest.fixture(autouse=True)
def _sizes_are_not_measured(monkeypatch):
    """Leave out the compiler's run for the README's table of sizes; folders of module fixtures are made before this."""
    monkeypatch.setattr("koopmpc.codegen.export._measure_objects", lambda *_: None)


@pytest.fixture(scope="session")
def pendulum():
    return plants.make_pendulum()
