"""Tasks come back in order wherever they are done, a lost worker costs nothing, and errors name their task."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from textwrap import dedent
from typing import Any, cast

import pytest

import koopmpc as km
from koopmpc.parallel import Workers, is_orphan, map_tasks
from tests import tasks
from tests.cluster import two_workers

HERE = {"workers": 1}
PROCESSES = {"workers": 2}
EVERYWHERE = pytest.mark.parametrize("where", ["here", "processes", "dask"], indirect=True)
AWAY = pytest.mark.parametrize("where", ["processes", "dask"], indirect=True)


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    with two_workers() as address:
        yield address


@pytest.fixture
def where(request: pytest.FixtureRequest) -> dict:
    """Return how map_tasks is told where to run."""
    if request.param == "dask":
        return {"scheduler": request.getfixturevalue("scheduler")}
    return HERE if request.param == "here" else PROCESSES


@EVERYWHERE
def test_results_come_in_the_order_of_the_tasks(where: dict) -> None:
    told: list[tuple[int, int | None]] = []
    results = map_tasks(tasks.square, range(7), **where, progress=lambda *now: told.append(now))
    assert list(results) == [i * i for i in range(7)]
    assert told == [(i, 7) for i in range(8)]


@EVERYWHERE
def test_the_largest_tasks_begin_first_and_results_keep_the_order_of_the_tasks(where: dict) -> None:
    sizes, asked, told = [3, 1, 4, 1, 5, 9, 2, 6], [], []

    def size(task: int) -> float:
        asked.append(task)
        return float(task)

    with Workers(**where) as pool:
        assert pool.map(tasks.square, sizes, size=size) == [n * n for n in sizes]
        assert pool.map(tasks.square, [], size=size) == []
        assert pool.map(tasks.square, range(20), lambda *now: told.append(now)) == [i * i for i in range(20)]
    assert asked == sizes
    assert told == [(i, 20) for i in range(21)]


def test_here_tasks_begin_by_their_size() -> None:
    begun: list[int] = []
    with Workers() as pool:
        pool.map(begun.append, [3, 1, 4, 1, 5], size=float)
    assert begun == [5, 4, 3, 1, 1]


@EVERYWHERE
def test_tasks_are_taken_a_few_ahead_and_no_more(where: dict) -> None:
    taken: list[int] = []

    def endless() -> Iterator[int]:
        while True:
            taken.append(len(taken))
            yield taken[-1]

    results = map_tasks(tasks.square, endless(), **where)
    assert [next(results) for _ in range(5)] == [0, 1, 4, 9, 16]
    assert len(taken) <= 5 + 2 * 2
    results.close() if where is not HERE else None


@AWAY
def test_a_lost_worker_costs_its_task_nothing(where: dict, tmp_path: Path) -> None:
    assert list(map_tasks(tasks.die_once, [(str(tmp_path), i) for i in range(5)], **where)) == list(range(5))
    assert (tmp_path / "died").exists()


@AWAY
def test_a_task_that_kills_each_worker_is_named(where: dict) -> None:
    with pytest.raises(km.KoopmpcError, match=r"task 0, the first: each worker that did it died .*workers=1 to see"):
        list(map_tasks(tasks.die, ["the first"], **where))


def test_among_others_the_task_that_kills_is_named_after_the_results_before_it() -> None:
    results = map_tasks(tasks.die_at_two, range(6), **PROCESSES)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(km.KoopmpcError, match=r"task 2, 2: each worker that did it died"):
        next(results)


def test_workers_that_are_busy_end_when_nobody_waits_for_them(tmp_path: Path) -> None:
    results = map_tasks(tasks.sleep, [(str(tmp_path), seconds) for seconds in (0, 60, 60, 60)], **PROCESSES)
    assert next(results) == 0
    started = time.perf_counter()
    results.close()
    assert time.perf_counter() - started < 20
    pids = [int(file.name) for file in tmp_path.iterdir()]
    assert pids
    assert not [pid for pid in pids if _is_alive(pid)]


def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        dedent(f"""
        import os, signal
        from koopmpc.parallel import Workers, is_orphan, map_tasks
        from tests import tasks
        if __name__ == "__main__":
            results = map_tasks(tasks.sleep, [({str(tmp_path / "pids")!r}, 0)] * 4, workers=2)
            next(results)
            os.kill(os.getpid(), signal.SIGKILL)
        """)
    )
    (tmp_path / "pids").mkdir()
    subprocess.run([sys.executable, script], capture_output=True, timeout=60, check=False)
    pids = [int(file.name) for file in (tmp_path / "pids").iterdir()]
    assert pids
    ends = time.perf_counter() + 20
    while time.perf_counter() < ends and any(map(_is_alive, pids)):
        time.sleep(0.1)
    assert not [pid for pid in pids if _is_alive(pid)]


def _is_alive(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False


@EVERYWHERE
def test_what_a_task_raises_is_raised_after_the_results_before_it(where: dict) -> None:
    results = map_tasks(tasks.fail, range(5), **where)
    assert next(results) == 0
    with pytest.raises(km.errors.DataError, match="the second task is wrong"):
        next(results)


def test_a_worker_tells_where_it_failed_even_if_the_exception_does_not_pickle() -> None:
    with pytest.raises(km.KoopmpcError, match="OddError: 1 and 2") as caught:
        list(map_tasks(tasks.odd, [0], **PROCESSES))
    assert "in odd" in caught.value.__notes__[0]


def test_what_does_not_pickle_is_told() -> None:
    with pytest.raises(km.errors.DataError, match=r"task 0, <function .*cannot be sent to a worker.*in a module"):
        list(map_tasks(tasks.square, [lambda: 0], **PROCESSES))
    with pytest.raises(km.errors.DataError, match="the result of 3 cannot be sent back"):
        list(map_tasks(tasks.unsendable, [3], **PROCESSES))


def test_workers_have_one_blas_thread_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    assert set(map_tasks(tasks.threads, range(2), **PROCESSES)) == {"1"}
    assert set(map_tasks(tasks.threads, range(2))) == {"2"}


def test_a_local_cluster_is_made_and_taken_down() -> None:
    assert list(map_tasks(tasks.threads, range(3), workers=2, scheduler="local")) == ["1", "1", "1"]


def test_no_task_is_no_result() -> None:
    assert list(map_tasks(tasks.square, [], **PROCESSES)) == []


def test_a_script_without_a_guard_is_told_what_to_write(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        dedent("""
        from koopmpc.parallel import Workers, is_orphan, map_tasks
        print(list(map_tasks(abs, [1, 2], workers=2)))
        """)
    )
    ended = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode != 0
    assert 'put what the script runs under `if __name__ == "__main__":`' in ended.stderr


def test_a_worker_that_is_killed_while_it_starts_is_not_blamed_on_the_script() -> None:
    with pytest.raises(km.KoopmpcError, match=r"was killed while it started \(signal 9\); run with fewer workers"):
        list(map_tasks(tasks.DeadOnArrival(), range(4), **PROCESSES))


def test_its_signal_is_found_also_where_the_executor_was_told_of_its_end_first(monkeypatch: pytest.MonkeyPatch) -> None:
    waited = os.waitpid

    def slowly(pid: int, options: int) -> tuple[int, int]:
        ended = waited(pid, options)
        time.sleep(0.05)  # between the end of a process and the note of its exit code
        return ended

    monkeypatch.setattr(os, "waitpid", slowly)
    with pytest.raises(km.KoopmpcError, match=r"killed while it started \(signal 9\)"):
        list(map_tasks(tasks.DeadOnArrival(), range(4), **PROCESSES))


def test_a_worker_that_dies_while_another_one_is_started_is_found_as_any_other(monkeypatch: pytest.MonkeyPatch) -> None:
    started = ProcessPoolExecutor._spawn_process  # pyright: ignore[reportAttributeAccessIssue]

    def late(executor: ProcessPoolExecutor) -> None:
        held, deadline = cast("Any", executor), time.monotonic() + 10
        while held._processes and not held._broken and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(0.2)  # until its thread has closed the queue
        started(executor)

    monkeypatch.setattr(ProcessPoolExecutor, "_spawn_process", late)
    with pytest.raises(km.KoopmpcError, match=r"killed while it started \(signal 9\)"):
        list(map_tasks(tasks.DeadOnArrival(), range(4), **PROCESSES))


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no process that removes semaphores")
def test_a_program_that_ends_at_once_leaves_no_lines_of_its_workers_semaphores(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        dedent("""
        import os

        from koopmpc.parallel import Workers, is_orphan, map_tasks

        if __name__ == "__main__":
            results = map_tasks(abs, range(100), workers=2)
            print(next(results), flush=True)
            os._exit(3)
        """)
    )
    ended = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (3, "0\n", "")


def test_what_is_no_number_of_workers_or_no_scheduler_is_refused() -> None:
    with pytest.raises(km.errors.DataError, match="workers is 0; it must be at least 1"):
        map_tasks(tasks.square, [1], workers=0)
    with pytest.raises(km.errors.DataError, match=r"""scheduler is 'here'; pass "local", or the address "tcp://"""):
        map_tasks(tasks.square, [1], scheduler="here")
    with pytest.raises(km.errors.DataError, match="has its own workers; leave out workers=2"):
        map_tasks(tasks.square, [1], scheduler="tcp://127.0.0.1:8786", workers=2)


def test_a_scheduler_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("koopmpc.cluster._ANSWER", 0.5)
    with pytest.raises(
        km.KoopmpcError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9 within 0\.5 s; start one"
    ):
        list(map_tasks(tasks.square, [1], scheduler="tcp://127.0.0.1:9"))


def test_a_cluster_is_reached_by_its_address_and_one_without_workers_is_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from distributed import LocalCluster

    local = {
        "processes": False,
        "threads_per_worker": 1,
        "host": "127.0.0.1",
        "dashboard_address": "127.0.0.1:0",
    }
    with LocalCluster(n_workers=1, protocol="tcp", **local) as cluster:
        address = cluster.scheduler_address
        assert list(map_tasks(tasks.square, range(3), scheduler=address)) == [0, 1, 4]
        cluster.scale(0)
        monkeypatch.setattr("koopmpc.cluster._PATIENCE", 1.0)
        with pytest.raises(km.KoopmpcError, match="task 0, 5: the cluster has had no worker for 1 s"):
            list(map_tasks(tasks.square, [5], scheduler=address))


def test_without_dask_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(km.KoopmpcError, match=r"install it with: pip install '.+\[dask\]'"):
        list(map_tasks(tasks.square, [1], scheduler="local"))


def test_a_worker_knows_that_its_parent_was_killed(tmp_path: Path) -> None:
    assert not is_orphan()
    script, told = tmp_path / "parent.py", tmp_path / "told"
    script.write_text(
        dedent(f"""
        import os, signal, time
        from multiprocessing import get_context
        from pathlib import Path
        from koopmpc.parallel import is_orphan

        def worker():
            assert not is_orphan()
            os.kill(os.getppid(), signal.SIGKILL if hasattr(signal, "SIGKILL") else signal.SIGTERM)
            while not is_orphan():
                time.sleep(0.01)
            Path({str(told)!r}).write_text("an orphan")

        if __name__ == "__main__":
            process = get_context("spawn").Process(target=worker)
            process.start()
            process.join()
        """)
    )
    subprocess.run([sys.executable, script], timeout=60, check=False)
    deadline = time.monotonic() + 20
    while not told.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert told.read_text() == "an orphan"
