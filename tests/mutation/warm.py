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


def outcome(tests: list[str], seconds: int) -> int:
    """Return the exit code of these tests in a child, negative where a signal ended it: SIGXCPU, when its time was up."""
    child = os.fork()
    if not child:
        for stream in range(3):
            os.dup2(os.open(os.devnull, os.O_RDWR), stream)
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        signal.alarm(4 * seconds)  # where it waits instead
        os._exit(pytest.main([*OPTIONS, *tests]))
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


for name in LIBRARIES:
    import_module(name)
for line in sys.stdin:
    sys.stdout.write(f"{outcome(*json.loads(line))}\n")
    sys.stdout.flush()
