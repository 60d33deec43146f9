"""A Dask cluster of two processes on this machine, for tests that reach it by its address."""

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def two_workers() -> Iterator[str]:
    """Yield the address of its scheduler."""
    from distributed import LocalCluster

    ports = {"dashboard_address": "127.0.0.1:0", "worker_dashboard_address": "127.0.0.1:0"}
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", **ports) as cluster:
        yield cluster.scheduler_address


@contextmanager
def scheduler_process(folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """Yield the process of a scheduler that has one worker in a process of its own, and its address."""
    file = folder / "scheduler.json"
    options = ["--host", "127.0.0.1", "--dashboard-address", "127.0.0.1:0"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", "0", "--scheduler-file", str(file)]
    process = subprocess.Popen([*command, *options], **quiet)
    worker = None
    try:
        end = time.monotonic() + 60
        while not file.exists() or not file.read_text():
            assert time.monotonic() < end
            time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        command = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny"]
        worker = subprocess.Popen([*command, *options], **quiet)
        yield process, address
    finally:
        for started in (process, worker):
            if started is not None:
                started.kill()
                started.wait()
