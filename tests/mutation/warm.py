"""A process that has imported the library and collected its tests, and runs some of them in a child for each change."""

import contextlib
import json
import math
import os
import resource
import signal
import sys
import time

import pytest
import sitecustomize as switch  # tests/mutation/switch.py, in a copy of the library

OPTIONS = ("-x", "-q", "--benchmark-disable", "-p", "no:cacheprovider", "-p", "no:cov", "-p", "no:xdist")
MEMORY = 8 << 30  # [bytes]
IMPORT = 120  # seconds of processor time until all is imported
LEAST, TIMES = (
    30,
    5,
)  # a test that takes so many seconds and times its own does not end; a fixture may be the most of it


class Server:
    """A plugin that runs the tests it is asked for, in the order in which they are asked for, until one fails."""

    def __init__(self, asked: int, answers: int) -> None:
        self._asked, self._answers, self.failed = os.fdopen(asked), os.fdopen(answers, "w"), ""

    def answer(self, *what: object) -> None:
        self._answers.write(json.dumps(what) + "\n")
        self._answers.flush()

    @pytest.hookimpl
    def pytest_runtest_logreport(self, report):
        if report.failed:
            self.failed = report.nodeid

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session):
        """Answer each request, which is a change and its tests with their seconds.

        An answer is 0 or the code of the child, negative where a signal ended it, and the test that was under way then.
        """
        if session.testsfailed:
            return None
        items = {item.nodeid: item for item in session.items}
        hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
        resource.setrlimit(resource.RLIMIT_CPU, (hard, hard))
        self.answer("ready")
        for line in self._asked:
            change, tests = json.loads(line)
            ours, theirs = os.pipe()
            child = os.fork()
            if not child:
                os.setsid()
                chosen = [(items[test], seconds) for test, seconds in tests if test in items]
                os._exit(self._run(change, chosen, theirs))
            os.close(theirs)
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)  # what it started
            with os.fdopen(ours) as pipe:
                begun = pipe.read().splitlines()
            self.answer(code, begun[-1] if code and begun else "")
        return True

    def _run(self, change, chosen, begun):
        switch.on = os.environ["KOOPMPC_CHANGE"] = change
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
        items = [item for item, _ in chosen]
        for (item, seconds), following in zip(chosen, [*items[1:], None], strict=True):
            os.write(begun, f"{item.nodeid}\n".encode())
            most = LEAST + TIMES * seconds
            resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(time.process_time() + most), hard))
            signal.alarm(math.ceil(10 * most))  # where it waits instead
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            if self.failed:
                return 1
        return 0


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_CPU, (IMPORT, resource.RLIM_INFINITY))
    asked, answers, *tests = sys.argv[1:]
    pytest.main([*OPTIONS, *tests], plugins=[Server(int(asked), int(answers))])
