"""Dask clusters on this machine, in processes of their own, for tests that reach them by their address."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

ROOT = Path(__file__).parents[1]
PATIENCE = 120.0  # a scheduler and its workers start within this time, on a busy machine too [s]
IDLE = ("--idle-timeout", "600")  # a scheduler whose test was killed ends after this time without a task [s]
LOCAL = ("--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0")


@contextmanager
def two_workers() -> Iterator[str]:
    """Yield the address of a scheduler with two workers, which nannies start again when they die.

    At the end all are killed. `LocalCluster.close` would raise where a nanny starts a worker again at that moment.
    """
    with (
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder,
        scheduler_process(Path(folder), workers=2, nanny=True) as (_, address),
    ):
        yield address


@contextmanager
def scheduler_process(
    folder: Path, workers: int = 1, nanny: bool = False
) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """Yield the process of a scheduler and its address, once so many workers in their own processes are there."""
    from distributed import Client

    file = folder / "scheduler.json"
    with ExitStack() as started:
        process = _start(started, "scheduler", "--port", "0", "--scheduler-file", str(file), *IDLE)
        address = _read_address(file, process)
        for _ in range(workers):
            keeper = "--nanny" if nanny else "--no-nanny"
            options = ("--nthreads", "1", "--local-directory", str(folder), "--death-timeout", "60", keeper)
            _start(started, "worker", address, *options)
        with Client(address, set_as_default=False, timeout=PATIENCE) as client:
            client.wait_for_workers(workers, timeout=PATIENCE)
        yield process, address


def _start(started: ExitStack, what: str, *options: str) -> subprocess.Popen[bytes]:
    """Start a program of Dask in a session of its own, which ends with all its processes."""
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen(
        [sys.executable, "-m", f"distributed.cli.dask_{what}", *options, *LOCAL],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": paths},
        start_new_session=True,
    )
    started.callback(_kill, process)
    return process


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill the program and the processes it started; its number stays its own until it is waited for."""
    if sys.platform == "win32":
        process.kill()
    else:
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _read_address(file: Path, process: subprocess.Popen[bytes]) -> str:
    """Return the address that the scheduler writes into the file once it listens."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and process.poll() is None:
        try:
            return str(json.loads(file.read_text())["address"])
        except (OSError, ValueError):  # not there yet, or not yet whole
            time.sleep(0.05)
    raise AssertionError(f"no scheduler within {PATIENCE:g} s; exit code {process.poll()}")
