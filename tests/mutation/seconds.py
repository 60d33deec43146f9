"""A pytest plugin that writes the seconds of processor time of each test that passes to seconds.json.

Which tests read which file of C is written to built.json.
"""

import json
import os
from collections import Counter
from pathlib import Path

import pytest

_seconds: Counter[str] = Counter()
_built: dict[str, list[str]] = {}


@pytest.fixture(autouse=True, scope="session")
def _reads_are_noted():
    """Note the test that is under way where a file of C is read; one of a fixture is that of its first test."""
    import koopmpc.codegen.sources as sources

    read = sources.read_shipped

    def read_noted(folder: str, name: str) -> str:
        test = os.environ.get("PYTEST_CURRENT_TEST", "").rpartition(" ")[0]
        if test and test not in _built.setdefault(f"{folder}/{name}", []):
            _built[f"{folder}/{name}"].append(test)
        return read(folder, name)

    with pytest.MonkeyPatch.context() as patch:
        for module in ("sources", "export", "unit"):
            patch.setattr(f"koopmpc.codegen.{module}.read_shipped", read_noted)
        yield


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    before, failed = sum(os.times()[:4]), item.session.testsfailed  # of this process and of its children
    result = yield
    if item.session.testsfailed == failed:
        _seconds[item.nodeid] += sum(os.times()[:4]) - before
    return result


def pytest_sessionfinish(session):
    if hasattr(session.config, "workeroutput"):  # of pytest-xdist: this is one of its processes
        session.config.workeroutput["seconds"] = dict(_seconds)  # which execnet can send
        session.config.workeroutput["built"] = _built
    else:
        Path("seconds.json").write_text(json.dumps(_seconds))
        Path("built.json").write_text(json.dumps(_built))


def pytest_testnodedown(node):
    output = getattr(node, "workeroutput", {})
    _seconds.update(output.get("seconds", {}))
    for name, tests in output.get("built", {}).items():
        _built.setdefault(name, []).extend(tests)
