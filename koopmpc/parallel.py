"""map_tasks: one function over many tasks, here, on local processes, or on a Dask cluster."""

import os
import pickle
import signal
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sized
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import islice
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Generic, TypeVar, cast
from uuid import uuid4

from koopmpc import checks
from koopmpc.errors import DataError, KoopmpcError

Task = TypeVar("Task")
Result = TypeVar("Result")
Progress = Callable[[int, int | None], None]
StageProgress = Callable[[str, int, int | None], None]  # the same of work in several stages, each with its name

_TRIES = 3  # how often a task may take its worker with it
_AHEAD = 2  # tasks a worker that may be under way or done before their turn
_SHOWN = 200  # characters of a task that a message shows
_GRACE = 5.0  # [s] for a process to end
_PATIENCE = 30.0  # [s] without any Dask worker
_ANSWER = 10.0  # [s] for a Dask scheduler to answer
_ANY_PORT = "127.0.0.1:0"
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
_GUARD = 'put what the script runs under `if __name__ == "__main__":`, for each worker imports the script first'


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
    What `function` raises is raised here, once all results before it are out. A task whose worker dies is done again,
    three times at most.

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
        results = _on_dask(function, iter(tasks), _address(scheduler, workers), workers)
    elif workers == 1:
        results = map(function, tasks)
    else:
        results = _on_processes(function, iter(tasks), workers or 1)
    return results if progress is None else _told(results, progress, total)


def _told(results: Iterator[Result], progress: Progress, total: int | None) -> Iterator[Result]:
    progress(0, total)
    for done, result in enumerate(results, start=1):
        progress(done, total)
        yield result


@dataclass(eq=False)
class _Job(Generic[Task]):
    """A task, its place in the order, and how many workers it has cost."""

    index: int
    task: Task
    deaths: int = 0

    def __str__(self) -> str:
        text = str(self.task)
        return f"task {self.index}, {text if len(text) <= _SHOWN else text[: _SHOWN - 1] + '…'}"


@dataclass(eq=False)
class _Worker:
    """A process, our end of its pipe, and what it is doing; `ready` once it has said so."""

    process: BaseProcess
    pipe: Connection
    job: _Job[Any] | None = None
    ready: bool = False


def _on_processes(function: Callable[[Task], Result], tasks: Iterator[Task], workers: int) -> Generator[Result]:
    """Yield the results of `workers` processes in order."""
    fresh = (_Job(i, task) for i, task in enumerate(tasks))
    waiting = deque(islice(fresh, workers))
    crew = [_started(function) for _ in waiting]
    done: dict[int, tuple[bool, Any]] = {}
    taken, due = len(waiting), 0
    try:
        while waiting or any(worker.job for worker in crew):
            for worker in crew:
                if worker.job is None and waiting:
                    _send(worker, waiting.popleft())
            heard = wait([worker.pipe for worker in crew if worker.job])
            for i, worker in enumerate(crew):
                if worker.pipe in heard and not _answered(worker, done, waiting):
                    crew[i] = _started(function)
            while due in done:
                fine, value = done.pop(due)
                due += 1
                if not fine:
                    raise value
                yield value
            more = list(islice(fresh, max(due + _AHEAD * workers - taken, 0)))
            taken += len(more)
            waiting.extend(more)
    finally:
        for worker in crew:
            _dismiss(worker)


def _send(worker: _Worker, job: _Job[Any]) -> None:
    """Give the job to the worker; what breaks the pipe is found when its answer is read."""
    try:
        worker.ready = worker.ready or worker.pipe.recv()
    except (EOFError, OSError) as error:
        raise KoopmpcError(f"the worker processes cannot start; {_GUARD}") from error
    worker.job = job
    try:
        worker.pipe.send(job.task)
    except OSError:
        pass
    except (AttributeError, TypeError, pickle.PicklingError) as error:
        raise DataError(
            f"{job} cannot be sent to a worker: {error}; run with workers=1, or define its parts in a module"
        ) from error


def _answered(worker: _Worker, done: dict[int, tuple[bool, Any]], waiting: deque[_Job[Any]]) -> bool:
    """Take the worker's answer; False where it has died, its job then waits again."""
    job, worker.job = worker.job, None
    assert job is not None, "only workers with a job are heard"
    try:
        done[job.index] = worker.pipe.recv()
    except (EOFError, OSError) as error:
        _dismiss(worker)
        job.deaths += 1
        if job.deaths == _TRIES:
            raise KoopmpcError(_died(str(job), f"{_TRIES} times, exit code {worker.process.exitcode}")) from error
        waiting.appendleft(job)
        return False
    return True


def _died(job: str, how: str) -> str:
    return (
        f"{job}: each worker that did it died ({how}); run it with workers=1 to see why, "
        "or give the workers more memory"
    )


def _started(function: Callable[[Any], Any]) -> _Worker:
    """Return a worker whose interpreter begins afresh, with one BLAS thread."""
    context = get_context("spawn")
    ours, its = cast("tuple[Connection, Connection]", context.Pipe())
    process = context.Process(target=_serve, args=(its, function), daemon=True)
    with _one_thread():
        process.start()
    its.close()
    return _Worker(process, ours)


@contextmanager
def _one_thread() -> Generator[None]:
    """Let processes that start meanwhile inherit one BLAS thread each; numpy reads it when it is imported."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _dismiss(worker: _Worker) -> None:
    """End the process: one that waits sees its pipe close, one that works is stopped."""
    worker.pipe.close()
    if worker.job is not None or not worker.ready:
        worker.process.terminate()
    worker.process.join(_GRACE)
    if worker.process.is_alive():
        worker.process.kill()
        worker.process.join()


def _serve(pipe: Connection, function: Callable[[Any], Any]) -> None:
    """Answer tasks until the pipe closes; this runs in the worker."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to answer
    pipe.send(True)
    while True:
        try:
            task = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            answer = (True, function(task))
        except Exception as error:  # whatever it is, it is raised again in the parent
            answer = (False, _portable(error))
        try:
            pipe.send(answer)
        except (AttributeError, TypeError, pickle.PicklingError) as error:
            pipe.send((False, DataError(f"the result of {task} cannot be sent back: {error}")))


def _portable(error: Exception) -> Exception:
    """Return the error with the worker's traceback as a note, as one that pickles."""
    told = "".join(traceback.format_exception(error))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # an exception with a constructor of its own
        error = KoopmpcError(f"{type(error).__name__}: {error}")
    error.add_note(f"in a worker:\n{told}")
    return error


@dataclass(frozen=True, eq=False)
class _Call(Generic[Task, Result]):
    """function(task) as one object, which Dask does not look into."""

    function: Callable[[Task], Result]
    task: Task

    def __call__(self) -> Result:
        return self.function(self.task)


def _address(scheduler: str, workers: int | None) -> str:
    if scheduler == "local" or "://" in scheduler:
        if scheduler != "local" and workers is not None:
            raise DataError(f"the cluster at {scheduler} has its own workers; leave out workers={workers}")
        return scheduler
    raise DataError(f'scheduler is {scheduler!r}; pass "local", or the address "tcp://host:port" of a Dask scheduler')


def _on_dask(
    function: Callable[[Task], Result], tasks: Iterator[Task], scheduler: str, workers: int | None
) -> Generator[Result]:
    """Yield the results of a Dask cluster in order; Dask does the tasks of a lost worker again."""
    with _client(scheduler, workers) as client:
        run, futures = f"koopmpc-{uuid4()}", deque[tuple[_Job[Task], Any]]()
        jobs = (_Job(i, task) for i, task in enumerate(tasks))
        try:
            while True:
                room = _AHEAD * max(sum(client.nthreads().values()), 1) - len(futures)
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


def _awaited(job: _Job[Any], future: Any, client: Any) -> Any:
    """Return the result of the future, or raise what it raised; a cluster without any worker is not waited for."""
    from distributed.scheduler import KilledWorker

    while True:
        try:
            return future.result(timeout=_PATIENCE)
        except TimeoutError:
            if future.done():
                raise  # the function's own
            if not client.nthreads():
                raise KoopmpcError(
                    f"{job}: the cluster has had no worker for {_PATIENCE:g} s; start some with `dask worker ADDRESS`"
                ) from None
        except KilledWorker as error:
            raise KoopmpcError(_died(str(job), "Dask gave it up")) from error


@contextmanager
def _client(scheduler: str, workers: int | None) -> Generator[Any]:
    """Return a client of the cluster; a local one, which only this machine sees, is taken down after."""
    try:
        from dask import config
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise KoopmpcError("a scheduler needs Dask; install it with: pip install 'koopmpc[dask]'") from error
    with ExitStack() as open_now:
        address: Any = scheduler
        if scheduler == "local":
            # Dask has its workers give freed memory back at once, which makes fresh arrays cost more than their sums
            with config.set({"distributed.nanny.pre-spawn-environ": dict.fromkeys(_THREADS, "1")}):
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
            client = open_now.enter_context(Client(address, set_as_default=False, timeout=_ANSWER))
        except (OSError, TimeoutError) as error:
            raise KoopmpcError(
                f'no Dask scheduler answers at {scheduler}; start one with `dask scheduler`, or pass "local"'
            ) from error
        yield client
