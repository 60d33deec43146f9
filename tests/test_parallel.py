"""Tasks come back in order wherever they are done, a lost worker costs nothing, and errors name their task."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest

import koopmpc as km
from koopmpc.base.parallel import Workers, map_tasks
from tests import tasks
from tests.cluster import scheduler_process, two_workers
from tests.tiers import few

ROOT = Path(__file__).parents[1]
HERE = {"workers": 1}
PROCESSES = {"workers": 2}
EVERYWHERE = pytest.mark.parametrize("where", ["here", "processes", "dask"], indirect=True)
MORTAL = pytest.mark.parametrize("where", ["processes", "a mortal cluster"], indirect=True)


@pytest.fixture(autouse=True)
def _no_loop_of_dask_survives() -> Iterator[None]:
    """A loop that goes on draws from `random` while it looks for its scheduler, which breaks other tests by chance."""
    yield
    assert "IO loop" not in {thread.name for thread in threading.enumerate()}


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    with two_workers() as address:
        yield address


@pytest.fixture
def where(request: pytest.FixtureRequest) -> Iterator[dict]:
    """Return the arguments with which map_tasks runs there; a test that kills workers has a cluster of its own."""
    if request.param == "a mortal cluster":
        with two_workers() as address:
            yield {"scheduler": address}
    elif request.param == "dask":
        yield {"scheduler": request.getfixturevalue("scheduler")}
    else:
        yield HERE if request.param == "here" else PROCESSES


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


@MORTAL
def test_a_lost_worker_costs_its_task_nothing(where: dict, tmp_path: Path) -> None:
    assert list(map_tasks(tasks.die_once, [(str(tmp_path), i) for i in range(5)], **where)) == list(range(5))
    assert (tmp_path / "died").exists()


@pytest.mark.parametrize("where", few(["processes", "a mortal cluster"], "processes"), indirect=True)
def test_a_task_that_kills_each_worker_is_named(where: dict) -> None:
    with pytest.raises(km.KoopmpcError, match=r"task 0, the first: each worker that ran it died; .*workers=1 to see"):
        list(map_tasks(tasks.die, ["the first"], **where))


def test_among_others_the_task_that_kills_is_named_after_the_results_before_it() -> None:
    results = map_tasks(tasks.die_at_two, range(6), **PROCESSES)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(km.KoopmpcError, match=r"task 2, 2: each worker that ran it died"):
        next(results)


def test_workers_that_are_busy_end_when_nobody_waits_for_them(tmp_path: Path) -> None:
    results = map_tasks(tasks.sleep, [(str(tmp_path), seconds) for seconds in (0, 600, 600, 600)], **PROCESSES)
    assert next(results) == 0
    started = time.perf_counter()
    results.close()
    assert time.perf_counter() - started < 300
    pids = [int(file.name) for file in tmp_path.iterdir()]
    assert pids
    assert not [pid for pid in pids if _is_alive(pid)]


def run_script(script: Path, text: str, **options: Any) -> subprocess.Popen[str]:
    """Start a program that imports this library and these tests from where they stand."""
    script.write_text(dedent(text))
    paths = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    pipe, environment = subprocess.PIPE, {**os.environ, "PYTHONPATH": paths}
    return subprocess.Popen([sys.executable, script], stdout=pipe, stderr=pipe, text=True, env=environment, **options)


def pids_in(folder: Path, least: int, program: subprocess.Popen[str]) -> list[int]:
    """Return the process numbers that `tasks.sleep` wrote for a program that still runs, once there are so many."""
    wait_until(lambda: len(list(folder.iterdir())) >= least or program.poll() is not None)
    assert program.poll() is None, program.communicate()
    return [int(file.name) for file in folder.iterdir()]


def wait_until(condition: Callable[[], bool], seconds: float = 300.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_workers_end_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    (folder := tmp_path / "pids").mkdir()
    parent = run_script(
        tmp_path / "script.py",
        f"""
        from koopmpc.base.parallel import map_tasks
        from tests import tasks
        list(map_tasks(tasks.sleep, [({str(folder)!r}, 300)] * 4, workers=2))
        """,
    )
    pids = pids_in(folder, 2, parent)
    parent.kill()
    parent.communicate(timeout=300)
    wait_until(lambda: not any(map(_is_alive, pids)))


def test_ctrl_c_ends_the_program_with_130_and_one_line_and_leaves_no_worker(tmp_path: Path) -> None:
    (folder := tmp_path / "pids").mkdir()
    program = run_script(
        tmp_path / "script.py",
        f"""
        from koopmpc.apps.cli.ending import ENDING
        with ENDING:
            from koopmpc.base.parallel import map_tasks
            from tests import tasks
            list(map_tasks(tasks.sleep, [({str(folder)!r}, 300)] * 4, workers=2))
        """,
        start_new_session=True,
    )
    pids = pids_in(folder, 2, program)
    os.killpg(program.pid, signal.SIGINT)
    assert program.communicate(timeout=300) == ("", "interrupted; nothing was written\n")
    assert program.returncode == 130
    wait_until(lambda: not any(map(_is_alive, pids)))


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
    with pytest.raises(km.errors.DataError, match=r"task 0, <unlocked .*cannot be sent between processes.*in a module"):
        list(map_tasks(tasks.square, [threading.Lock()], **PROCESSES))
    with pytest.raises(km.errors.DataError, match="the result of 3 cannot be sent"):
        list(map_tasks(tasks.unsendable, [3], **PROCESSES))


def test_workers_have_one_blas_thread_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    assert set(map_tasks(tasks.threads, range(2), **PROCESSES)) == {"1"}
    assert set(map_tasks(tasks.threads, range(2))) == {"2"}


def test_a_local_cluster_is_made_and_taken_down() -> None:
    assert list(map_tasks(tasks.threads, range(3), workers=2, scheduler="local")) == ["1", "1", "1"]


def test_a_service_that_does_not_greet_as_a_scheduler_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("koopmpc.base.parallel._ANSWER", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(km.KoopmpcError, match=rf"no Dask scheduler answers at {address}; start one"):
            list(map_tasks(tasks.square, [1], scheduler=address))


@pytest.mark.parametrize("words", [b"", b"SSH-2.0-OpenSSH_9.0\r\n"])
def test_a_service_that_speaks_otherwise_or_closes_the_line_is_told_before_a_client_waits_for_it(words: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        address = f"tcp://127.0.0.1:{other.getsockname()[1]}"

        def answer() -> None:
            with other.accept()[0] as line:
                line.sendall(words)

        talk = threading.Thread(target=answer)
        talk.start()
        with pytest.raises(km.KoopmpcError, match=f"no Dask scheduler answers at {address}; start one"):
            list(map_tasks(tasks.square, [1], scheduler=address))
        talk.join()


def test_no_task_is_no_result() -> None:
    assert list(map_tasks(tasks.square, [], **PROCESSES)) == []


def test_a_script_needs_no_guard_and_sends_functions_of_its_own(tmp_path: Path) -> None:
    script = """
        from koopmpc.base.parallel import map_tasks
        shift = 3
        def add(x):
            return x + shift
        print(list(map_tasks(add, [1, 2], workers=2)), list(map_tasks(lambda x: 2 * x, [1, 2], workers=2)))
        """
    program = run_script(tmp_path / "script.py", script)
    assert program.communicate(timeout=300) == ("[4, 5] [2, 4]\n", "")


@pytest.mark.skipif(sys.platform == "win32", reason="a script is no program there")
def test_a_worker_that_is_killed_while_it_starts_is_not_blamed_on_its_task(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert list(map_tasks(abs, [-1, 2], **PROCESSES)) == [1, 2]  # loky starts its processes of one program
    (program := tmp_path / "dies").write_text("#!/bin/sh\nkill -9 $$\n")
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    with pytest.raises(km.KoopmpcError, match=r"was killed while it started; run with fewer workers"):
        list(map_tasks(abs, range(4), **PROCESSES))


@pytest.mark.parametrize(
    ("where", "count", "size"),
    [
        ("processes", 500, 100_000),
        pytest.param("processes", 100_000, 1_000, marks=pytest.mark.slow),
        pytest.param("dask", 10_000, 10_000, marks=pytest.mark.slow),
    ],
    indirect=["where"],
)
def test_lazy_tasks_need_memory_for_a_few_of_them(where: dict, count: int, size: int) -> None:
    list(map_tasks(len, [b""], **where))  # what is imported counts as well
    tracemalloc.start()
    try:
        total = sum(map_tasks(len, (bytes(size) for _ in range(count)), **where))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert total == count * size
    assert peak < total * (0.1 if where is PROCESSES else 0.5)  # a Dask client keeps its last 1000 messages


def test_what_is_no_number_of_workers_or_no_scheduler_is_refused() -> None:
    with pytest.raises(km.errors.DataError, match="workers is 0; it must be at least 1"):
        map_tasks(tasks.square, [1], workers=0)
    with pytest.raises(km.errors.DataError, match=r"""scheduler is 'here'; pass "local", or the address "tcp://"""):
        map_tasks(tasks.square, [1], scheduler="here")
    with pytest.raises(km.errors.DataError, match="has its own workers; leave out workers=2"):
        map_tasks(tasks.square, [1], scheduler="tcp://127.0.0.1:8786", workers=2)


def test_a_scheduler_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("koopmpc.base.parallel._ANSWER", 0.5)
    with pytest.raises(km.KoopmpcError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9; start one"):
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
        monkeypatch.setattr("koopmpc.base.parallel._PATIENCE", 1.0)
        with pytest.raises(km.KoopmpcError, match=r"the cluster at .* has no worker after 1 s; start some"):
            list(map_tasks(tasks.square, [5], scheduler=address))


def test_without_dask_the_message_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(km.KoopmpcError, match=r"install it with: pip install '.+\[dask\]'"):
        list(map_tasks(tasks.square, [1], scheduler="local"))


def test_a_scheduler_that_dies_is_told(tmp_path: Path) -> None:
    with scheduler_process(tmp_path) as (process, address):
        results = map_tasks(tasks.kill_at_three, [(process.pid, i) for i in range(10)], scheduler=address)
        with pytest.raises(km.KoopmpcError, match=rf"task \d+, .*: the Dask scheduler at {address} has ended"):
            list(results)


def test_a_task_that_dask_forgot_with_its_scheduler_is_told(tmp_path: Path) -> None:
    """What is sent while the scheduler ends may never be answered, nor cancelled."""
    with scheduler_process(tmp_path) as (_process, address), Workers(scheduler=address) as workers:
        executor, *_ = workers._open()
        executor.submit = lambda *_: Future[bytes]()
        executor._client.status = "closed"  # as when the client has ended by itself
        with pytest.raises(km.KoopmpcError, match=rf"task 0, .*: the Dask scheduler at {address} has ended"):
            list(workers.run(tasks.square, [1, 2], ahead=2))
