"""A pytest plugin that writes the seconds of processor time of each test that passes to seconds.json."""

import json
import os
from collections import Counter
from pathlib import Path

import pytest

_seconds: Counter[str] = Counter()


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
    else:
        Path("seconds.json").write_text(json.dumps(_seconds))


def pytest_testnodedown(node):
    _seconds.update(getattr(node, "workeroutput", {}).get("seconds", {}))
