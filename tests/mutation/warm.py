"""A process that has imported the libraries of others and runs tests in children: each change costs a second less."""

import json
import os
import resource
import signal
import sys
from importlib import import_module

import pytest

LIBRARIES = (
    "casadi",
    "daqp",
    "numpy",
    "osqp",
    "pyarrow.parquet",
    "scipy.linalg",
    "scipy.optimize",
)  # no plugins of pytest
OPTIONS = ("-x", "-q", "--benchmark-disable", "-p", "no:cacheprovider", "-p", "no:cov", "-p", "no:xdist")
MEMORY = 8 << 30  # [bytes]


class Watch:
    """A plugin that ends the run after so many seconds of processor time, and keeps which test failed."""

    def __init__(self, enough: float) -> None:
        self._enough, self.failed = enough, ""

    @pytest.hookimpl
    def pytest_runtest_logreport(self, report):
        if report.failed:
            self.failed = report.nodeid

    @pytest.hookimpl
    def pytest_collectreport(self, report):
        if report.failed:  # a change that breaks an import is noticed too
            self.failed = report.nodeid

    @pytest.hookimpl
    def pytest_runtest_teardown(self, item):
        if sum(os.times()[:4]) > self._enough:
            item.session.shouldstop = "enough"


def outcome(tests: list[str], seconds: int, enough: float) -> tuple[int, str]:
    """Return the exit code of these tests in a child, and the test that failed.

    The code is 0 too where the tests took `enough` seconds, and negative where a signal ended the child: SIGXCPU, when
    its time was up.
    """
    ours, theirs = os.pipe()
    child = os.fork()
    if not child:
        for stream in range(3):
            os.dup2(os.open(os.devnull, os.O_RDWR), stream)
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        signal.alarm(4 * seconds)  # where it waits instead
        watch = Watch(enough)
        code = pytest.main([*OPTIONS, *tests], plugins=[watch])
        os.write(theirs, watch.failed.encode())
        os._exit(0 if code == pytest.ExitCode.INTERRUPTED and not watch.failed else code)
    os.close(theirs)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    with os.fdopen(ours) as pipe:
        return code, pipe.read()


for name in LIBRARIES:
    import_module(name)
for line in sys.stdin:
    sys.stdout.write(json.dumps(outcome(*json.loads(line))) + "\n")
    sys.stdout.flush()
