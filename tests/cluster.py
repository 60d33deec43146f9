"""A Dask cluster of two processes on this machine, for tests that reach it by its address."""

from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def two_workers() -> Iterator[str]:
    """Yield the address of its scheduler."""
    from distributed import LocalCluster

    ports = {"dashboard_address": "127.0.0.1:0", "worker_dashboard_address": "127.0.0.1:0"}
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", **ports) as cluster:
        yield cluster.scheduler_address
