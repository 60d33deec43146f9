"""map_tasks: one function over many tasks, here, on local processes, or on a Dask cluster."""

import os
import pickle
import re
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence, Sized
from concurrent.futures import BrokenExecutor, Future
from contextlib import AbstractContextManager, nullcontext
from itertools import count, islice
from multiprocessing import Pipe, parent_process
from multiprocessing.connection import Connection, wait
from typing import Any, cast

import cloudpickle

from koopmpc import checks
from koopmpc.cluster import (
    AHEAD,
    ONE_THREAD,
    QueuedTask,
    Result,
    Task,
    TaskPool,
    address_of,
    died,
    open_dask,
)
from koopmpc.errors import DataError, KoopmpcError
from koopmpc.interrupts import call_uninterrupted

Progress = Callable[[int, int | None], None]
"""Called with (tasks done, tasks in all)."""
StageProgress = Callable[[str, int, int | None], None]
"""Called with (name of the stage, tasks done, tasks in all), for work in several stages."""

_TRIES = 3  # name a task that killed its worker this many times while it ran alone
_UNSENDABLE = (AttributeError, TypeError, pickle.PicklingError)
_WORKER_ENVIRONMENT = {**ONE_THREAD, "LOKY_MAX_MEMORY_LEAK_SIZE": "1e18"}  # a worker may keep models between its tasks


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
    What `function` raises is raised here, once all results before it are out. A task that is under way when a worker
    dies is done again; one that takes its worker with it three times when it is done alone is named.

    Parameters
    ----------
    function
        Of one argument. For workers: defined at the top of a module, for it crosses processes by name.
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
    workers = _check_workers(workers, scheduler)
    total = len(tasks) if isinstance(tasks, Sized) else None
    if scheduler is not None:
        results = _yield_results(open_dask(function, address_of(scheduler, workers), workers), tasks)
    elif workers == 1:
        results = map(function, tasks)
    else:
        results = _yield_results(LocalPool(workers or 1, function), tasks)
    return results if progress is None else _report(results, progress, total)


class Workers:
    """Processes that do one `map_tasks` after the other, so that they start and import once; use it with ``with``.

    A worker is sent the function of a call with each of its tasks, and keeps the last one. On a Dask cluster every
    call is one of `map_tasks`.

    Parameters
    ----------
    workers, scheduler
        As in `map_tasks`.
    """

    def __init__(self, workers: int | None = None, scheduler: str | None = None) -> None:
        self._workers, self._scheduler = _check_workers(workers, scheduler), scheduler
        self._pool = LocalPool(self._workers or 1)

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.close()

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
        sent = [tasks[i] for i in order]
        if self._scheduler is not None or self._workers == 1:
            results = map_tasks(function, sent, workers=self._workers, scheduler=self._scheduler, progress=progress)
        else:
            self._pool.set_function(function)
            results = _yield_results(nullcontext(self._pool), sent, ahead=len(sent))
            results = results if progress is None else _report(results, progress, len(sent))
        return [result for _, result in sorted(zip(order, results, strict=True), key=lambda pair: pair[0])]


def _check_workers(workers: int | None, scheduler: str | None) -> int | None:
    """Return the number of local processes; None leaves it to the cluster."""
    workers = 1 if workers is None and scheduler is None else workers
    return None if workers is None else checks.count(workers, "workers")


def _report(results: Iterator[Result], progress: Progress, total: int | None) -> Iterator[Result]:
    """Yield the results, and call progress after each."""
    progress(0, total)
    for done, result in enumerate(results, start=1):
        progress(done, total)
        yield result


def _yield_results(
    opening: AbstractContextManager[TaskPool], tasks: Iterable[Any], ahead: int | None = None
) -> Generator[Any]:
    """Yield the results of a pool in the order of the tasks.

    At most `ahead` tasks, by default two for each worker, are under way or wait for their turn.
    """
    with opening as pool:
        jobs = (QueuedTask(i, task) for i, task in enumerate(tasks))
        queue = deque[QueuedTask[Any]]()
        try:
            while True:
                room = (AHEAD * pool.count_workers() if ahead is None else ahead) - len(queue)
                for job in islice(jobs, max(room, 0)):
                    queue.append(job)
                    pool.submit(job)
                if not queue:
                    return
                result = pool.wait(queue[0])
                queue.popleft()
                yield result
        finally:
            if queue:
                pool.abandon()


class LocalPool:
    """Processes of loky's executor, each with one BLAS thread.

    Tasks and results are pickled here rather than by the executor, so that an error names what does not pickle, and an
    exception that does not unpickle breaks nothing. cloudpickle sends what a script defines by its code: a worker does
    not import the script.
    """

    def __init__(self, workers: int, function: Callable[[Any], Any] | None = None) -> None:
        self._workers, self._function, self._code = workers, function, (0, b"")
        self._futures: dict[QueuedTask[Any], Future[Any]] = {}
        self._executor: Any = None

    def __enter__(self) -> "LocalPool":
        if self._function is not None:
            self.set_function(self._function)
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def set_function(self, function: Callable[[Any], Any]) -> None:
        """Send this function with all tasks from now on.

        Raises
        ------
        DataError
            It does not pickle.
        """
        if not self._code[0] or function is not self._function:
            self._function, self._code = function, (next(_numbers), _pickle(function, "the function"))

    def count_workers(self) -> int:
        """Return the number of processes."""
        return self._workers

    def submit(self, job: QueuedTask[Any]) -> None:
        """Send the job to the next worker that is free.

        Raises
        ------
        DataError
            It does not pickle.
        """
        self._futures[job] = self._send(_pickle(job.task, str(job)))

    def wait(self, job: QueuedTask[Any]) -> Any:
        """Return the result of the job, or raise what the task raised.

        When a worker dies, it is not known whose job killed it. This job, the first that is due, is done again alone,
        where a death is its own; the others that were lost are sent to new workers.

        Raises
        ------
        KoopmpcError
            Each worker died while it did this job alone, or while it started.
        """
        try:
            answer = self._futures.pop(job).result()
        except BrokenExecutor:
            self.close()
            answer = self._repeat(job)
            lost = [other for other, future in self._futures.items() if future.exception() is not None]
            for other in lost:
                self.submit(other)
        fine, value = pickle.loads(answer)
        if not fine:
            raise value
        return value

    def abandon(self) -> None:
        """End the processes, those that work too; the next job starts others."""
        self._futures.clear()
        self.close()

    def close(self) -> None:
        """End the processes."""
        executor, self._executor = self._executor, None
        if executor is not None:
            executor.shutdown(wait=True, kill_workers=True)
            self._lifeline.close()

    def _send(self, task: bytes) -> "Future[Any]":
        try:
            executor = self._executor or self._start()
            return executor.submit(_work, task, *self._code)
        except BrokenExecutor as error:  # another worker died meanwhile: `wait` sends the task again
            lost = Future[Any]()
            lost.set_exception(error)
            return lost

    def _start(self) -> Any:
        """Return an executor whose processes have started, which inherit a blocked Ctrl-C and one BLAS thread."""
        from loky import ProcessPoolExecutor

        _quiet_tracker()
        received, self._lifeline = Pipe(duplex=False)
        with received:
            self._executor = ProcessPoolExecutor(
                self._workers, initializer=_begin, initargs=(received,), env=_WORKER_ENVIRONMENT
            )
            call_uninterrupted(self._send_first)
        return self._executor

    def _send_first(self) -> None:
        self._started: Future[int] = self._executor.submit(os.getpid)  # starts the processes

    def _repeat(self, job: QueuedTask[Any]) -> bytes:
        """Return the answer of a worker that has nothing else to do."""
        task, not_started = _pickle(job.task, str(job)), None
        for _ in range(_TRIES):
            with LocalPool(1) as alone:
                alone._code = self._code
                try:
                    return alone._send(task).result()
                except BrokenExecutor:
                    not_started = alone._started.exception()
        if not_started is None:
            raise KoopmpcError(died(str(job), f"{_TRIES} times"))
        codes = re.search(r"\{.+\}", str(not_started))  # loky names them in its message alone
        raise KoopmpcError(
            f"each worker process was killed while it started (exit codes {codes[0] if codes else 'unknown'}); "
            "run with fewer workers, or give them more memory"
        ) from not_started


_dump: Callable[[object], bytes] = cast("Any", cloudpickle).dumps
_numbers = count(1)  # of the functions that this process sends


def _quiet_tracker() -> None:
    """Start the process with which loky removes semaphores that are left behind, without its warnings.

    After Ctrl-C it would write lines below the one with which the program ends.
    """
    from loky.backend import resource_tracker

    before = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = "ignore::UserWarning"
    try:
        resource_tracker.ensure_running()
    finally:
        del os.environ["PYTHONWARNINGS"]
        if before is not None:
            os.environ["PYTHONWARNINGS"] = before


def _pickle(value: object, name: str) -> bytes:
    """Return the bytes of what is sent to a worker.

    Raises
    ------
    DataError
        It does not pickle.
    """
    try:
        return _dump(value)
    except _UNSENDABLE as error:
        raise DataError(
            f"{name} cannot be sent to a worker: {error}; run with workers=1, or define its parts in a module"
        ) from error


_received: dict[int, Callable[[Any], Any]] = {}  # of this worker: the function that it was sent last
_parents: list[Connection] = []  # of this worker: a pipe that only its parent holds open


def _begin(parent: Connection) -> None:
    """Leave Ctrl-C to the parent, and end with it; this runs in the worker when it starts."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _parents.append(parent)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def is_orphan() -> bool:
    """Return whether this is a worker whose parent has ended; it ends soon itself."""
    if _parents:
        return _parents[0].poll()  # nothing is ever sent: the pipe has come to its end
    parent = parent_process()  # of a Dask worker
    return parent is not None and not parent.is_alive()


def _end_with_parent() -> None:
    """End this worker when its parent has ended, killed perhaps: it would wait for tasks for ever."""
    wait(_parents)
    os._exit(1)


def _work(sent: bytes, number: int, code: bytes) -> bytes:
    """Return (True, the function of the task) or (False, what it raised); this runs in the worker.

    `number` names the function, and `code` is its pickle.
    """
    task = None
    try:
        if number not in _received:
            _received.clear()
            _received[number] = pickle.loads(code)
        task = pickle.loads(sent)
        answer = (True, _received[number](task))
    except Exception as error:  # whatever it is, it is raised again in the parent
        answer = (False, _portable(error))
    try:
        return _dump(answer)
    except _UNSENDABLE as error:
        return pickle.dumps((False, DataError(f"the result of {task} cannot be sent back: {error}")))


def _portable(error: Exception) -> Exception:
    """Return the error with the worker's traceback as a note, as one that pickles."""
    told = "".join(traceback.format_exception(error))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # an exception with a constructor of its own
        error = KoopmpcError(f"{type(error).__name__}: {error}")
    error.add_note(f"in a worker:\n{told}")
    return error
