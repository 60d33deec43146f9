"""Tasks on a Dask cluster, and the job that local workers and a cluster share."""

import os
import socket
import time
from collections import deque
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import islice
from typing import Any, Generic, TypeVar
from urllib.parse import urlsplit
from uuid import uuid4

from koopmpc.errors import DataError, KoopmpcError, install

Task = TypeVar("Task")
Result = TypeVar("Result")

AHEAD = 2  # tasks for each worker that may be under way, or done before their turn
ONE_THREAD: dict[str, str] = dict.fromkeys(  # the environment of a worker; numpy reads it when it is imported
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
_SHOWN = 200  # characters of a task that a message shows
_PATIENCE = 30.0  # longest wait for a cluster without any worker [s]
_ANSWER = 3.0  # longest wait for a scheduler to answer [s]
_ANY_PORT = "127.0.0.1:0"


@dataclass(frozen=True, eq=False)
class QueuedTask(Generic[Task]):
    """A task and its place in the order."""

    index: int
    task: Task

    def __str__(self) -> str:
        text = str(self.task)
        return f"task {self.index}, {text if len(text) <= _SHOWN else text[: _SHOWN - 1] + '…'}"


def died(job: str, how: str) -> str:
    """Return the message for a job that killed each of its workers."""
    return (
        f"{job}: each worker that did it died ({how}); run it with workers=1 to see why, "
        "or give the workers more memory"
    )


@dataclass(frozen=True, eq=False)
class _Call(Generic[Task, Result]):
    """function(task) as one object, which Dask does not look into."""

    function: Callable[[Task], Result]
    task: Task

    def __call__(self) -> Result:
        return self.function(self.task)


def address_of(scheduler: str, workers: int | None) -> str:
    """Return the scheduler's address, or ``"local"``.

    Raises
    ------
    DataError
        It is neither; workers are asked of a cluster that has its own.
    """
    if scheduler == "local" or "://" in scheduler:
        if scheduler != "local" and workers is not None:
            raise DataError(f"the cluster at {scheduler} has its own workers; leave out workers={workers}")
        return scheduler
    raise DataError(f'scheduler is {scheduler!r}; pass "local", or the address "tcp://host:port" of a Dask scheduler')


def on_dask(
    function: Callable[[Task], Result], tasks: Iterator[Task], scheduler: str, workers: int | None
) -> Generator[Result]:
    """Yield the results of a Dask cluster in order; Dask does the tasks of a lost worker again."""
    with _client(scheduler, workers) as client:
        run, futures = f"koopmpc-{uuid4()}", deque[tuple[QueuedTask[Task], Any]]()
        jobs = (QueuedTask(i, task) for i, task in enumerate(tasks))
        try:
            while True:
                room = AHEAD * max(sum(client.nthreads().values()), 1) - len(futures)
                for job in islice(jobs, max(room, 0)):
                    futures.append((job, client.submit(_Call(function, job.task), key=f"{run}-{job.index}")))
                if not futures:
                    return
                job, future = futures[0]
                result = _awaited(job, future, client)
                futures.popleft()
                del future  # the cluster may forget it
                yield result
        finally:
            for _, future in futures:
                future.cancel()


def _awaited(job: QueuedTask[Any], future: Any, client: Any) -> Any:
    """Return the result of the future, or raise what it raised; a cluster without any worker is not waited for."""
    from distributed.scheduler import KilledWorker

    while True:
        try:
            return future.result(timeout=_PATIENCE)
        except TimeoutError:
            if future.done():
                raise  # the function itself raised it
            if not client.nthreads():
                raise KoopmpcError(
                    f"{job}: the cluster has had no worker for {_PATIENCE:g} s; start some with `dask worker ADDRESS`"
                ) from None
        except KilledWorker as error:
            raise KoopmpcError(died(str(job), "Dask gave it up")) from error


def _knock(scheduler: str) -> None:
    """Raise OSError where nothing listens at the address, now or within the time that a scheduler has to answer."""
    place, last = urlsplit(scheduler), time.monotonic() + _ANSWER
    while True:
        try:
            with socket.create_connection((place.hostname or "", place.port or 8786), timeout=_ANSWER):
                return
        except OSError:
            if time.monotonic() + 0.2 > last:
                raise
        time.sleep(0.2)


@contextmanager
def _client(scheduler: str, workers: int | None) -> Generator[Any]:
    """Return a client of the cluster; a local one, which only this machine sees, is taken down after."""
    try:
        from dask import config
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise KoopmpcError(f"a scheduler needs Dask; install it with: {install('dask')}") from error
    with ExitStack() as open_now:
        address: Any = scheduler
        if scheduler == "local":
            # Dask has its workers give freed memory back at once, which makes fresh arrays cost more than their sums
            with config.set({"distributed.nanny.pre-spawn-environ": ONE_THREAD}):
                cluster: Any = LocalCluster(
                    n_workers=workers or os.cpu_count(),
                    threads_per_worker=1,
                    processes=True,
                    host="127.0.0.1",
                    dashboard_address=_ANY_PORT,
                    worker_dashboard_address=_ANY_PORT,
                )
            address = open_now.enter_context(cluster)
        try:
            if scheduler.startswith(("tcp://", "tls://")):
                _knock(scheduler)  # a Client without an answer needs 11 s to say so
            client = open_now.enter_context(Client(address, set_as_default=False, timeout=_ANSWER))
        except (OSError, ValueError, MemoryError) as error:  # MemoryError: another service's words were read as a size
            raise KoopmpcError(
                f"no Dask scheduler answers at {scheduler} within {_ANSWER:g} s; start one with `dask scheduler`, "
                'or pass "local"'
            ) from error
        yield client
