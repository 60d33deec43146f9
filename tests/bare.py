"""Messages that the type hook of the tests would forestall, from a process without it."""

import os
import subprocess
import sys

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


def shown(code):
    """Return what `show(call)` prints for each call of `code`, line by line."""
    environment = {**os.environ, "KOOPMPC_TESTS": "bare"}
    done = subprocess.run(
        [sys.executable, "-c", PRELUDE + code], capture_output=True, text=True, check=True, env=environment
    )
    return done.stdout.splitlines()
