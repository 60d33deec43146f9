"""A pytest plugin that notes which tests meet which changes, how much processor time each takes, and which fail.

Those that read a file of C to build it meet its changes.
"""

import json
import os
from pathlib import Path

import pytest
import sitecustomize as switch  # tests/mutation/switch.py, in a copy of the library

_seconds: dict[str, float] = {}
_failed: list[str] = []


@pytest.fixture(autouse=True, scope="session")
def _reads_are_noted():
    """Note the test that is under way where a file of C is read; one of a fixture is that of its first test."""
    import koopmpc.codegen.sources as sources

    read = sources.read_shipped

    def read_noted(folder: str, name: str) -> str:
        switch.note(f"koopmpc/codegen/{folder}/{name}")
        return read(folder, name)

    with pytest.MonkeyPatch.context() as patch:
        for module in ("sources", "export", "unit"):
            patch.setattr(f"koopmpc.codegen.{module}.read_shipped", read_noted)
        yield


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    switch.met.clear()
    before, failed = sum(os.times()[:4]), item.session.testsfailed  # of this process and of its children
    result = yield
    _seconds[item.nodeid] = sum(os.times()[:4]) - before
    if item.session.testsfailed > failed:
        _failed.append(item.nodeid)
    return result


def pytest_sessionfinish():
    Path(f"{switch.notes}/{os.getpid()}.json").write_text(json.dumps([_seconds, _failed]))
