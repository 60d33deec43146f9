"""What the type hook of the tests would forestall: with the hook it comes from a process without it."""

import os
import subprocess
import sys
import tempfile
import warnings
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path
from xml.etree import ElementTree

PRELUDE = """
import koopmpc as km, numpy as np
def show(call):
    try:
        call()
    except km.KoopmpcError as error:
        print(type(error).__name__, error)
    else:
        print("nothing was raised")
"""


def shown(code, fresh=False):
    """Return what `show(call)` prints for each call of `code`, line by line; in a fresh process if asked for."""
    if fresh or os.environ.get("KOOPMPC_TESTS") == "typed":
        environment = {**os.environ, "KOOPMPC_TESTS": "bare"}
        command = [sys.executable, "-c", PRELUDE + code]
        return subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout.splitlines()
    with redirect_stdout(StringIO()) as out, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        exec(PRELUDE + code, {"__name__": "__main__"})
    return out.getvalue().splitlines()


@cache
def run_unhooked(file, which):
    """Run the tests of `file` that are marked unhooked, and are of `which` marks, in one process without the hook.

    Return for each how it ended, "passed" or what pytest's report calls it, and what is said of that.
    """
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTEST_", "KOOPMPC_TESTS"))
    }
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.xml")
        marks = f"unhooked and ({which})" if which else "unhooked"
        options = [
            "-n",
            "0",
            "-p",
            "no:cacheprovider",
            "-o",
            "junit_family=xunit1",
            f"--junitxml={report}",
            "-m",
            marks,
        ]
        root = Path(__file__).parents[1]
        command = [sys.executable, "-m", "pytest", *options, str(file)]
        done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=root, check=False)
        assert report.exists(), done.stdout + done.stderr
        cases = ElementTree.parse(report).iter("testcase")
        return {case.get("name"): _end_of(case) for case in cases}


def _end_of(case):
    """Return how a case of pytest's report ended, and what is said of it."""
    for part in case:
        if part.tag in ("failure", "error", "skipped"):
            return part.tag, f"{part.get('message')}\n{part.text or ''}"
    return "passed", ""
