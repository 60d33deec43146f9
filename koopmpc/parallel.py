"""map_tasks: one function over many tasks, here, on local processes, or on a Dask cluster."""

import os
import pickle
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence, Sized
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait
from time import monotonic, sleep
from typing import Any, cast

from koopmpc import checks
from koopmpc.cluster import AHEAD, ONE_THREAD, QueuedTask, Result, Task, address_of, died, on_dask
from koopmpc.errors import DataError, KoopmpcError

Progress = Callable[[int, int | None], None]
StageProgress = Callable[
    [str, int, int | None], None
]  # the same for work in several stages, the name of the stage first

_TRIES = 3  # how often a task that runs alone may kill its worker before it is named
_GRACE = 5.0  # time that a process gets to end [s]
_GUARD = 'put what the script runs under `if __name__ == "__main__":`, for each worker imports the script first'
_UNSENDABLE = (AttributeError, TypeError, pickle.PicklingError)


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
    workers = 1 if workers is None and scheduler is None else workers
    workers = None if workers is None else checks.count(workers, "workers")
    total = len(tasks) if isinstance(tasks, Sized) else None
    if scheduler is not None:
        results = on_dask(function, iter(tasks), address_of(scheduler, workers), workers)
    elif workers == 1:
        results = map(function, tasks)
    else:
        results = _on_own_processes(function, iter(tasks), workers or 1)
    return results if progress is None else _told(results, progress, total)


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
        workers = 1 if workers is None and scheduler is None else workers
        self._workers = None if workers is None else checks.count(workers, "workers")
        self._scheduler, self._held = scheduler, _HeldPool(self._workers or 1)

    def __enter__(self) -> "Workers":
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()

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
            results = _on_processes(function, iter(sent), self._held, len(sent))
            results = results if progress is None else _told(results, progress, len(sent))
        return [result for _, result in sorted(zip(order, results, strict=True), key=lambda pair: pair[0])]


def _told(results: Iterator[Result], progress: Progress, total: int | None) -> Iterator[Result]:
    progress(0, total)
    for done, result in enumerate(results, start=1):
        progress(done, total)
        yield result


class _Pool:
    """Processes that begin afresh, with one BLAS thread each, and do `function` of what they are sent.

    A worker gets `function` once, when it starts; another one comes with each of its tasks. Tasks and results are
    pickled here rather than by the executor, so that an error names what does not pickle and an exception that does not
    unpickle breaks nothing.
    """

    def __init__(self, function: Callable[[Any], Any], workers: int) -> None:
        self.workers = workers
        self._function, self._other, self._number, self._code = function, function, 0, b""
        _quiet_tracker()
        self._executor = ProcessPoolExecutor(workers, get_context("spawn"), _begin, (function,))

    def turn_to(self, function: Callable[[Any], Any]) -> None:
        """Send this function with all tasks from now on.

        Raises
        ------
        DataError
            It does not pickle.
        """
        if function is self._other:
            return
        self._other, self._number = function, self._number + 1
        self._code = b"" if function is self._function else _pickled(function, "the function")

    def submit(self, job: QueuedTask[Any]) -> "Future[bytes]":
        """Send the job to the next worker that is free.

        Raises
        ------
        DataError
            It does not pickle.
        BrokenProcessPool
            A worker has died; the pool is of no use any more.
        """
        sent = _pickled(job.task, str(job))
        try:
            with _environment(ONE_THREAD), _undisturbed():  # `submit` starts the processes
                return self._executor.submit(_work, sent, self._number, self._code)
        except OSError as error:  # another worker died meanwhile, and the executor has closed what this one inherits
            if self._executor._broken:
                raise BrokenProcessPool("a worker died while another one was started") from error
            raise

    def close(self) -> None:
        """End the processes, those that work too; Python 3.14 calls this `kill_workers`."""
        processes = list((self._executor._processes or {}).values())
        self._executor.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()
        for process in processes:
            process.join(_GRACE)
            if process.is_alive():
                process.kill()


class _HeldPool:
    """A pool that is made when it is first asked for, and made anew where it broke."""

    def __init__(self, workers: int) -> None:
        self.workers, self._pool = workers, cast("_Pool | None", None)

    def of(self, function: Callable[[Any], Any]) -> _Pool:
        """Return the pool, at work on this function."""
        if self._pool is None:
            self._pool = _Pool(function, self.workers)
        self._pool.turn_to(function)
        return self._pool

    def close(self) -> None:
        """End the processes; the next `of` begins others."""
        if self._pool is not None:
            self._pool.close()
        self._pool = None


def _on_own_processes(function: Callable[[Task], Any], tasks: Iterator[Task], workers: int) -> Generator[Any]:
    held = _HeldPool(workers)
    try:
        yield from _on_processes(function, tasks, held, AHEAD * workers)
    finally:
        held.close()


def _on_processes(
    function: Callable[[Task], Any], tasks: Iterator[Task], held: _HeldPool, ahead: int
) -> Generator[Any]:
    """Yield the results of a pool's processes in order; at most `ahead` tasks are under way, or wait for their turn.

    A worker that dies breaks the pool, and its task is not known. The first task that is due is therefore
    done alone, where a death is its own, and the others go to a new pool.
    """
    jobs = (QueuedTask(i, task) for i, task in enumerate(tasks))
    queue: deque[tuple[QueuedTask[Task], Future[bytes] | None]] = deque()
    try:
        while True:
            queue.extend((job, None) for job in islice(jobs, ahead - len(queue)))
            if not queue:
                return
            try:
                for i, (job, future) in enumerate(queue):
                    queue[i] = job, future or held.of(function).submit(job)
                answer = cast("Future[bytes]", queue[0][1]).result()
            except BrokenProcessPool:
                held.close()
                queue = deque((job, future if _is_done(future) else None) for job, future in queue)
                done = queue[0][1]
                answer = _alone(function, queue[0][0]) if done is None else done.result()
            queue.popleft()
            fine, value = pickle.loads(answer)
            if not fine:
                raise value
            yield value
    finally:
        if queue:  # no one waits for the tasks under way
            held.close()


def _is_done(future: "Future[bytes] | None") -> bool:
    return future is not None and future.done() and not future.cancelled() and future.exception() is None


def _alone(function: Callable[[Any], Any], job: QueuedTask[Any]) -> bytes:
    """Return the answer of a worker that has nothing else to do.

    Raises
    ------
    KoopmpcError
        Each worker died, or none can start.
    """
    end = 0
    for _ in range(_TRIES):
        pool = _Pool(function, 1)
        try:
            with _environment(ONE_THREAD), _undisturbed():
                begun = pool._executor.submit(os.getpid)
            processes = list((pool._executor._processes or {}).values())
            try:
                begun.result()
            except BrokenProcessPool as error:
                end = _exit_code(processes)
                if end < 0:
                    continue
                raise KoopmpcError(f"the worker processes cannot start; {_GUARD}") from error
            end = 0
            return pool.submit(job).result()
        except BrokenProcessPool:
            continue
        finally:
            pool.close()
    if end:
        raise KoopmpcError(
            f"each worker process was killed while it started (signal {-end}); run with fewer workers, or give them "
            "more memory"
        )
    raise KoopmpcError(died(str(job), f"{_TRIES} times"))


def _exit_code(processes: list[Any]) -> int:
    """Return how these processes ended: negative where a signal ended one, its number.

    The executor's own thread waits for them too: where it was told first, their exit codes come a moment later.
    """
    deadline = monotonic() + _GRACE
    for process in processes:
        process.join(_GRACE)
        while process.exitcode is None and monotonic() < deadline:
            sleep(0.001)
    return min((process.exitcode or 0 for process in processes), default=0)


def _quiet_tracker() -> None:
    """Start the process with which Python removes semaphores that are left behind, without its warnings.

    Of a process that Ctrl-C ended it would write two lines for each semaphore below what the program said last.
    """
    if os.name == "posix":
        from multiprocessing import resource_tracker  # Windows has none

        with _environment({"PYTHONWARNINGS": "ignore::UserWarning"}):
            resource_tracker.ensure_running()


@contextmanager
def _environment(added: dict[str, str]) -> Generator[None]:
    """Let processes that start meanwhile inherit these variables."""
    before = {name: os.environ.get(name) for name in added}
    os.environ.update(added)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _undisturbed() -> Generator[None]:
    """Let processes that start meanwhile inherit a blocked Ctrl-C, which is the parent's to answer, at the end of this.

    A worker that met it while it imports would print a traceback of its own.
    """
    block = getattr(signal, "pthread_sigmask", None)  # Windows has none
    if block is None:
        yield
        return
    before = block(signal.SIG_BLOCK, ())
    try:
        block(signal.SIG_BLOCK, {signal.SIGINT})  # it may raise a KeyboardInterrupt that came before
        yield
    finally:
        block(signal.SIG_SETMASK, before)


def _pickled(value: object, name: str) -> bytes:
    """Return the bytes of what is sent to a worker.

    Raises
    ------
    DataError
        It does not pickle.
    """
    try:
        return pickle.dumps(value)
    except _UNSENDABLE as error:
        raise DataError(
            f"{name} cannot be sent to a worker: {error}; run with workers=1, or define its parts in a module"
        ) from error


_functions: dict[int, Callable[[Any], Any]] = {}  # of this worker: 0 is what it began with, others have come later


def _begin(function: Callable[[Any], Any]) -> None:
    """Take the function; this runs in the worker when it starts."""
    _functions[0] = function
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to answer
    threading.Thread(target=_end_with_parent, daemon=True).start()


def is_orphan() -> bool:
    """Return whether this is a worker whose parent has ended; it ends soon itself."""
    parent = parent_process()
    return parent is not None and not parent.is_alive()


def _end_with_parent() -> None:
    """End this worker when its parent has ended, killed perhaps: it would wait for tasks for ever."""
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _work(sent: bytes, number: int, code: bytes) -> bytes:
    """Return (True, the function of the task) or (False, what it raised); this runs in the worker.

    `number` names the function, and `code` is its pickle where it is another than that of the start.
    """
    number = number if code else 0
    if number not in _functions:
        for old in [key for key in _functions if key]:
            del _functions[old]
        _functions[number] = pickle.loads(code)
    task = pickle.loads(sent)
    try:
        answer = (True, _functions[number](task))
    except Exception as error:  # whatever it is, it is raised again in the parent
        answer = (False, _portable(error))
    try:
        return pickle.dumps(answer)
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
