"""Messages that the type hook of the tests would forestall: with the hook they come from a process without it."""

import os
import subprocess
import sys
import warnings
from contextlib import redirect_stdout
from io import StringIO

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
