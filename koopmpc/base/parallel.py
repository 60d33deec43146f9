"""map_tasks: one function over many tasks, here, on local processes, or on a Dask cluster.

Local processes are those of loky, and a Dask client has an executor of the same protocol: a window
of futures over either yields the results in order.
"""

import os
import pickle
import socket
import sys
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence, Sized
from concurrent.futures import BrokenExecutor, Future, wait
from contextlib import ExitStack, contextmanager, suppress
from functools import lru_cache, partial
from itertools import islice
from typing import Any, TypeVar, cast
from urllib.parse import urlsplit

from koopmpc.base import checks
from koopmpc.base.errors import DataError, KoopmpcError, WorkerError, install
from koopmpc.base.interrupts import call_uninterrupted

Task = TypeVar("Task")
Result = TypeVar("Result")
Progress = Callable[[int, int | None], None]
"""Called with (tasks done, tasks in all)."""
StageProgress = Callable[[str, int, int | None], None]
"""Called with (name of the stage, tasks done, tasks in all), for work in several stages."""

_AHEAD = 2  # for each worker this many tasks may be under way, or wait for their turn
_TRIES = 3  # name a task that killed its worker this many times while it ran alone
_PATIENCE = 30.0  # raise an error if the cluster has no worker, or its scheduler no answer, for this time [s]
_ANSWER = 10.0  # raise an error if nothing listens at the scheduler's address, or it says nothing, for this time [s]
_LOOK = 1.0  # look whether the scheduler has ended each time that no answer came for this time [s]
_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_KEEP_MODELS = {"LOKY_MAX_MEMORY_LEAK_SIZE": "1e18"}  # loky restarts a worker whose memory grows by more [B]
_KILLS = ": each worker that ran it died; run it with workers=1 to see why, or give the workers more memory"
_UNSENDABLE = (AttributeError, TypeError, pickle.PicklingError)
_Pool = tuple[Any, Callable[[], int], Callable[[], bool]]


def map_tasks(
    function: Callable[[Task], Result],
    tasks: Iterable[Task],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Iterator[Result]:
    """Yield function(task) for each task, in the order of the tasks.

    Tasks are taken and results kept only a few ahead of what was yielded: memory does not grow with their number.
    What `function` raises is raised here, once all results before it are out. Tasks that were under way when a worker
    died run again, each alone; one that kills its worker three times is named.

    Parameters
    ----------
    function
        Of one argument. A worker gets it by name from its module, or its code where a script defines it.
    tasks
        Any iterable; for workers of what pickles.
    workers
        Local processes, started afresh, each with one BLAS thread; None and 1 run the tasks here.
    scheduler
        ``"tcp://host:port"`` of a Dask cluster, or ``"local"`` for one of `workers` processes on this machine, by
        default as many as it has cores. Needs the extra ``dask``.
    progress
        Called with (tasks done, tasks in all), the second None where `tasks` has no length.

    Raises
    ------
    DataError
        workers is no whole number above 0, or scheduler no address; a task does not pickle.
    KoopmpcError
        A worker died on the same task each time, cannot start, or no Dask scheduler or worker answers.
    """
    pool = Workers(workers, scheduler)  # checks its arguments now, not when the first result is asked for

    def run_and_close() -> Generator[Result]:
        with pool:
            yield from pool.run(function, tasks, progress)

    return run_and_close()


class Workers:
    """Processes that do one `map_tasks` after the other, so that they start and import once; use it with ``with``.

    Parameters
    ----------
    workers, scheduler
        As in `map_tasks`.
    """

    def __init__(self, workers: int | None = None, scheduler: str | None = None) -> None:
        workers = 1 if workers is None and scheduler is None else workers
        self._workers = None if workers is None else checks.count(workers, "workers")
        self._scheduler = None if scheduler is None else check_scheduler(scheduler, workers)
        self._opened = ExitStack()
        self._pool: _Pool | None = None

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the processes, under an exception those that work too; the next task starts others."""
        self._pool = None
        self._opened.__exit__(*sys.exc_info())

    def map(
        self,
        function: Callable[[Task], Result],
        tasks: Sequence[Task],
        progress: Progress | None = None,
        *,
        size: Callable[[Task], float] | None = None,
    ) -> list[Result]:
        """Return function(task) of each task, in the order of the tasks; progress as in `map_tasks`.

        All tasks are sent at once. Those of the largest `size`, which grows with the time that a task takes, begin
        first: at the end no worker waits long for the others.
        """
        order = list(range(len(tasks)))
        if size is not None:
            order.sort(key=lambda i: -size(tasks[i]))
        results = self.run(function, [tasks[i] for i in order], progress, ahead=len(tasks))
        return [result for _, result in sorted(zip(order, results, strict=True), key=lambda pair: pair[0])]

    def run(
        self,
        function: Callable[[Task], Result],
        tasks: Iterable[Task],
        progress: Progress | None = None,
        ahead: int | None = None,
    ) -> Generator[Result]:
        """Yield function(task) in the order of the tasks; at most `ahead` are under way or wait for their turn."""
        here, total = self._workers == 1 and self._scheduler is None, len(tasks) if isinstance(tasks, Sized) else None
        if progress is not None:
            progress(0, total)
        for done, result in enumerate(map(function, tasks) if here else self._send(function, tasks, ahead), start=1):
            if progress is not None:
                progress(done, total)
            yield result

    def _send(self, function: Callable[[Task], Any], tasks: Iterable[Task], ahead: int | None) -> Generator[Any]:
        """Yield the results of the workers."""
        code, numbered = _pickle(function, "the function"), enumerate(tasks)
        waiting = deque[tuple[str, bytes, Future[bytes]]]()
        try:
            while True:
                room = (_AHEAD * self._open()[1]() if ahead is None else ahead) - len(waiting)
                for i, task in islice(numbered, max(room, 0)):
                    name = f"task {i}, {task!s:.200}"
                    sent = _pickle(task, name)
                    waiting.append((name, sent, self._submit(code, sent)))
                if not waiting:
                    return
                name, sent, future = waiting[0]
                succeeded, value = pickle.loads(self._wait(future, name, code, sent))
                waiting.popleft()
                if not succeeded:
                    raise value
                yield value
        finally:
            if waiting:  # nobody waits for the tasks under way any more
                self.close()

    def _open(self) -> _Pool:
        """Return the executor, what counts its workers, and what says whether it has ended."""
        if self._pool is None:
            processes = _start_processes(self._workers or 1)
            opening = processes if self._scheduler is None else _join_cluster(self._scheduler, self._workers)
            self._pool = self._opened.enter_context(opening)
        return self._pool

    def _submit(self, code: bytes, sent: bytes) -> Future[bytes]:
        try:
            return self._open()[0].submit(_work, code, sent)
        except BrokenExecutor as error:  # a worker died meanwhile: `_wait` runs the task alone
            lost = Future[bytes]()
            lost.set_exception(error)
            return lost

    def _wait(self, future: Future[bytes], name: str, code: bytes, sent: bytes) -> bytes:
        """Return the answer; what the function raised is in it, so an exception is one of the workers."""
        try:
            while not wait([future], timeout=_LOOK).done:
                if self._pool is not None and self._pool[2]():  # Dask forgets what was sent while its scheduler ended
                    raise ConnectionError("the scheduler has ended")
            return future.result()
        except BrokenExecutor:
            self.close()
            return _run_alone(name, code, sent)
        except Exception as error:
            if type(error).__name__ == "KilledWorker":
                raise WorkerError(f"{name}{_KILLS}") from error
            raise KoopmpcError(
                f"{name}: the Dask scheduler at {self._scheduler} has ended; start another one, and run again"
            ) from error


def check_scheduler(scheduler: str, workers: int | None) -> str:
    """Return the scheduler's address, or ``"local"``.

    Raises
    ------
    DataError
        It is neither; workers are asked of a cluster that has its own.
    """
    if scheduler != "local" and "://" not in scheduler:
        raise DataError(
            f'scheduler is {scheduler!r}; pass "local", or the address "tcp://host:port" of a Dask scheduler'
        )
    if scheduler != "local" and workers is not None:
        raise DataError(f"the cluster at {scheduler} has its own workers; leave out workers={workers}")
    return scheduler


@contextmanager
def _start_processes(workers: int) -> Generator[_Pool]:
    """Start processes that inherit a blocked Ctrl-C, which is the parent's to answer, and one BLAS thread."""
    from loky import ProcessPoolExecutor

    executor: Any = ProcessPoolExecutor(workers, initializer=_watch_parent, env={**_ONE_THREAD, **_KEEP_MODELS})
    try:
        call_uninterrupted(lambda: executor.submit(os.getpid))
        yield executor, lambda: workers, lambda: False
    except BaseException:  # nobody waits for the tasks under way
        executor.shutdown(wait=True, kill_workers=True)
        raise
    executor.shutdown(wait=True)  # a worker that is not killed removes its temporary files


def _run_alone(name: str, code: bytes, sent: bytes) -> bytes:
    """Return the answer of a worker that has nothing else to do: if it dies, this task killed it.

    Raises
    ------
    KoopmpcError
        Each worker died while it ran this task, or while it started.
    """
    for _ in range(_TRIES):
        with _start_processes(1) as (executor, *_):
            try:
                executor.submit(os.getpid).result()
            except BrokenExecutor as error:
                raise KoopmpcError(
                    "each worker process was killed while it started; run with fewer workers, or give them more memory"
                ) from error
            with suppress(BrokenExecutor):
                return executor.submit(_work, code, sent).result()
    raise WorkerError(f"{name}{_KILLS}")


@contextmanager
def _join_cluster(scheduler: str, workers: int | None) -> Generator[_Pool]:
    """Connect to a Dask cluster; a local one, which only this machine sees, is taken down after.

    Raises
    ------
    KoopmpcError
        Dask is not installed, no scheduler answers, or it has no worker.
    """
    try:
        from dask import config
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise KoopmpcError(f"a scheduler needs Dask; install it with: {install('dask')}") from error
    place: dict[str, Any] = {
        "host": "127.0.0.1",
        "dashboard_address": "127.0.0.1:0",
        "worker_dashboard_address": "127.0.0.1:0",
    }
    with ExitStack() as opened:
        try:
            if scheduler == "local":
                # Dask has its workers give freed memory back at once: fresh arrays then cost more than their sums
                with config.set({"distributed.nanny.pre-spawn-environ": _ONE_THREAD}):
                    cluster = LocalCluster(n_workers=workers or os.cpu_count(), threads_per_worker=1, **place)
                address: Any = opened.enter_context(cast("Any", cluster))
            else:
                _greet(address := scheduler)
            client: Any = opened.enter_context(Client(address, set_as_default=False, timeout=_PATIENCE))
        except (OSError, ValueError) as error:
            raise KoopmpcError(
                f'no Dask scheduler answers at {scheduler}; start one with `dask scheduler`, or pass "local"'
            ) from error
        try:
            client.wait_for_workers(1, timeout=_PATIENCE)
        except TimeoutError as error:
            raise KoopmpcError(
                f"the cluster at {scheduler} has no worker after {_PATIENCE:g} s; start some with `dask worker ADDRESS`"
            ) from error
        executor = client.get_executor(pure=False)

        def has_ended() -> bool:
            return bool(client.status == "closed")

        def end() -> None:
            if has_ended():  # by itself: Dask would let its thread go on, unless the client is closed once more
                client.status = "running"
            else:
                executor.shutdown(wait=False)

        def count_threads() -> int:
            with suppress(OSError):  # the scheduler has ended: the first result that is awaited says so
                return max(sum(client.nthreads().values()), 1)
            return 1

        opened.callback(end)
        yield executor, count_threads, has_ended


def _greet(address: str) -> None:
    """Raise OSError where nothing listens, or what listens does not speak first: a Client would wait without end."""
    place = urlsplit(address)
    if place.scheme == "tcp":
        with socket.create_connection((place.hostname or "", place.port or 8786), timeout=_ANSWER) as line:
            size = line.recv(8)  # of the greeting, in bytes, the lowest first
        if not size or any(size[4:]):
            raise OSError("it does not greet as a Dask scheduler")


def _pickle(value: object, name: str) -> bytes:
    """Return the bytes of what is sent to a worker; a DataError where it does not pickle."""
    from loky.backend import reduction

    try:
        return bytes(cast("Any", reduction).dumps(value))
    except _UNSENDABLE as error:
        raise DataError(
            f"{name} cannot be sent between processes: {error}; run with workers=1, or define its parts in a module"
        ) from error


def _watch_parent(*, period: float = 0.5) -> None:
    """End this worker when its parent has ended, killed perhaps; look for that each `period` [s]."""
    parent = os.getppid()

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(period)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@lru_cache(maxsize=1)
def _unpickle_function(code: bytes) -> Callable[[Any], Any]:
    return pickle.loads(code)


def _work(code: bytes, sent: bytes) -> bytes:
    """Return (True, the function of the task) or (False, what it raised); this runs in the worker."""
    task = None
    try:
        task = pickle.loads(sent)
        answer = (True, _unpickle_function(code)(task))
    except Exception as error:  # whatever it is, it is raised again in the parent
        answer = (False, _make_portable(error))
    try:
        return _pickle(answer, f"the result of {task}")
    except DataError as error:
        return pickle.dumps((False, error))


def _make_portable(error: Exception) -> Exception:
    """Return the error with the worker's traceback as a note, as one that pickles."""
    trace = "".join(traceback.format_exception(error))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # an exception with a constructor of its own
        error = KoopmpcError(f"{type(error).__name__}: {error}")
    error.add_note(f"in a worker:\n{trace}")
    return error


def report_stage(progress: StageProgress | None, name: str) -> Progress | None:
    """Return what is called with the progress of one stage."""
    return None if progress is None else partial(progress, name)
