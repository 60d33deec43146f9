"""Tasks on a Dask cluster, and what local workers and a cluster share: jobs, and the pool that does them."""

import logging
import os
import signal
import socket
import time
from asyncio import CancelledError
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar
from urllib.parse import urlsplit
from uuid import uuid4

from koopmpc.errors import DataError, KoopmpcError, install

Task = TypeVar("Task")
Result = TypeVar("Result")

AHEAD = 2  # for each worker this many tasks may be under way, or be done before their turn
ONE_THREAD: dict[str, str] = dict.fromkeys(  # environment of a worker: numpy reads it when it is imported
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
_SHOWN = 200  # a message shows at most this many characters of a task
_PATIENCE = 30.0  # raise an error if the cluster has had no worker for this time [s]
_LOOK = 1.0  # while a result is awaited, look for workers this often [s]
_ANSWER = 3.0  # raise an error if nothing listens at the scheduler's address for this time [s]
_GREETING = 30.0  # raise an error if what listens there has not greeted as a scheduler within this time [s]
_LOG = logging.getLogger(__name__)
_ANY_PORT = "127.0.0.1:0"


@dataclass(frozen=True, eq=False)
class QueuedTask(Generic[Task]):
    """A task and its place in the order."""

    index: int
    task: Task

    def __str__(self) -> str:
        text = str(self.task)
        return f"task {self.index}, {text if len(text) <= _SHOWN else text[: _SHOWN - 1] + '…'}"


class TaskPool(Protocol):
    """Workers that do one function on many tasks."""

    def count_workers(self) -> int:
        """Return how many workers there are, 1 or more."""
        ...

    def submit(self, job: QueuedTask[Any]) -> None:
        """Send the job to the next worker that is free."""
        ...

    def wait(self, job: QueuedTask[Any]) -> Any:
        """Return the result of the job, or raise what the task raised, or an error that names a job that kills."""
        ...

    def abandon(self) -> None:
        """Stop the jobs that nobody waits for any more."""
        ...


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


class DaskPool(Generic[Task, Result]):
    """The workers of a Dask cluster, which does the jobs of a lost worker again by itself."""

    def __init__(self, function: Callable[[Task], Result], client: Any, address: str) -> None:
        self._function, self._client, self._address = function, client, address
        self._run = f"koopmpc-{uuid4()}"
        self._futures: dict[QueuedTask[Task], Any] = {}

    def count_workers(self) -> int:
        """Return the number of the cluster's threads, or 1 while it has none, or nobody answers: wait says so."""
        with suppress(OSError):
            return max(sum(self._client.nthreads().values()), 1)
        return 1

    def submit(self, job: QueuedTask[Task]) -> None:
        """Send the job to the scheduler."""
        call = _Call(self._function, job.task)
        self._futures[job] = self._client.submit(call, key=f"{self._run}-{job.index}")

    def wait(self, job: QueuedTask[Task]) -> Result:
        """Return the result of the job, or raise what the task raised.

        Raises
        ------
        KoopmpcError
            Several workers died of the job, the cluster has no worker, or its scheduler has ended.
        """
        from distributed.client import FutureCancelledError
        from distributed.comm.core import CommClosedError
        from distributed.scheduler import KilledWorker

        future, seen = self._futures.pop(job), time.monotonic()
        while True:
            try:
                return future.result(timeout=_LOOK)
            except KilledWorker as error:
                raise KoopmpcError(died(str(job), "Dask gave it up")) from error
            except (FutureCancelledError, CommClosedError) as error:
                raise self._tell_end(job) from error
            except TimeoutError:
                if future.done():
                    return future.result()  # it came just now, or the function itself raised a TimeoutError
                try:
                    threads = self._client.nthreads()
                except OSError as error:  # nobody answers: it has just ended, and the future does not know yet
                    raise self._tell_end(job) from error
                if threads:
                    seen = time.monotonic()
                elif time.monotonic() > seen + _PATIENCE:
                    raise KoopmpcError(
                        f"{job}: the cluster has had no worker for {_PATIENCE:g} s; start some with "
                        "`dask worker ADDRESS`"
                    ) from None

    def _tell_end(self, job: QueuedTask[Task]) -> KoopmpcError:
        """Return the error for a scheduler that has ended before the job was done."""
        return KoopmpcError(f"{job}: the Dask scheduler at {self._address} has ended; start another one, and run again")

    def abandon(self) -> None:
        """Cancel the jobs that are under way."""
        for future in self._futures.values():
            future.cancel()


def _knock(scheduler: str) -> None:
    """Raise an error where nothing listens at the address, or what listens does not greet as a scheduler in time.

    Raises
    ------
    KoopmpcError
        Nothing listens, or something else than a scheduler.
    TimeoutError
        No greeting came.
    """
    place, last = urlsplit(scheduler), time.monotonic() + _ANSWER
    host, port = place.hostname or "", place.port or 8786
    while True:
        try:
            left = max(last - time.monotonic(), 0.2)
            count = len(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM))  # each is tried in turn
            line = socket.create_connection((host, port), timeout=left / count)
            break
        except OSError as error:
            if time.monotonic() + 0.2 > last:
                raise _absent(f"no Dask scheduler answers at {scheduler} within {_ANSWER:g} s") from error
        time.sleep(0.2)
    if place.scheme != "tcp":
        return line.close()
    with line, suppress(ConnectionError):  # a scheduler speaks first, and a Client would wait for it without end
        line.settimeout(_GREETING)
        size = line.recv(8)  # of its greeting: eight bytes, the lowest first
        if size and not any(size[4:]):
            return None
    raise _absent(f"what listens at {scheduler} does not greet as a Dask scheduler")


def _absent(said: str) -> KoopmpcError:
    return KoopmpcError(f'{said}; start one with `dask scheduler`, or pass "local"')


def _close(cluster: Any) -> None:
    """Take down a local cluster, by force where Dask fails to: it does if a worker that died is started just then."""
    from distributed.core import Status

    try:
        cluster.close()
    except (Exception, CancelledError):
        _LOG.debug("Dask did not close its cluster", exc_info=True)
        for nanny in list(cluster.workers.values()):
            nanny.status = Status.closed  # it neither starts a new worker nor asks for the scheduler that has ended
            with suppress(AttributeError, TypeError, OSError):  # it has no process, or no longer
                os.kill(nanny.pid, getattr(signal, "SIGKILL", signal.SIGTERM))
        with suppress(Exception, CancelledError):
            cluster.sync(cluster.scheduler.close)
        cluster.status = Status.closed  # else it warns, and tries again at the end of the program
        cluster.close()  # of a cluster that is closed this ends the thread of its loop


@contextmanager
def open_dask(
    function: Callable[[Task], Result], scheduler: str, workers: int | None
) -> Generator[DaskPool[Task, Result]]:
    """Return the pool of a Dask cluster; a local one, which only this machine sees, is taken down after.

    Raises
    ------
    KoopmpcError
        Dask is not installed, or no scheduler answers.
    """
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
                address = LocalCluster(
                    n_workers=workers or os.cpu_count(),
                    threads_per_worker=1,
                    processes=True,
                    host="127.0.0.1",
                    dashboard_address=_ANY_PORT,
                    worker_dashboard_address=_ANY_PORT,
                )
            open_now.callback(_close, address)
        try:
            if scheduler.startswith(("tcp://", "tls://")):
                _knock(scheduler)  # a Client without an answer needs 11 s to say so
            client = open_now.enter_context(Client(address, set_as_default=False, timeout=_GREETING))
        except (OSError, ValueError, MemoryError) as error:  # MemoryError: another service's words were read as a size
            raise _absent(f"no Dask scheduler answers at {scheduler} within {_GREETING:g} s") from error
        yield DaskPool(function, client, scheduler)
