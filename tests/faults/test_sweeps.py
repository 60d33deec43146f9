"""Sweeps under kill -9, lost workers, a full disk and a second sweep: what is finished stays, and nothing runs twice."""

import os
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import koopmpc as km
from tests.apps.test_store import TWO, figures
from tests.apps.tiny import write
from tests.cluster import two_workers

GRID = {"starts": 4, "seeds": 2, "noise": [0.0, 0.05]}


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    return km.load_problem(write(tmp_path_factory.mktemp("problem")))


@pytest.fixture(scope="module")
def peace(problem, tmp_path_factory):
    """The same sweep, undisturbed."""
    return km.sweep([problem], TWO, folder=tmp_path_factory.mktemp("whole"), options=km.bench.SweepOptions(**GRID))


def script_of(problem, folder, grid, more=""):
    """Write a program that makes the sweep with two workers, and return its path."""
    script = Path(f"{folder}.py")
    script.write_text(
        "import koopmpc as km\n"
        "if __name__ == '__main__':\n"
        f"    {more}\n"
        f"    km.sweep([km.load_problem({problem.file!r})], {TWO!r}, folder={str(folder)!r}, options=km.bench.SweepOptions(workers=2, **{grid!r}))\n"
    )
    return script


def killed_and_resumed(problem, folder, moments, grid, most=10**9):
    """Start the sweep in a process of its own, kill it at each moment [s] or once it has `most` lines, and end it in peace."""
    script = script_of(problem, folder, grid)
    for moment in moments:
        before = {row.key for row in km.bench.load_rows(folder)} if (folder / "sweep.sqlite").exists() else set()
        process = subprocess.Popen([sys.executable, script], start_new_session=True)
        ends = time.monotonic() + moment
        while time.monotonic() < ends and once_each(folder) < most:
            time.sleep(0.02)
        process.kill()
        process.wait()
        if (folder / "sweep.sqlite").exists():
            assert before <= {row.key for row in km.bench.load_rows(folder)}
    return resumed(problem, folder, grid)


def resumed(problem, folder, grid):
    """End a sweep in this process, as soon as the workers of the last one have ended with their parent."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        try:
            return km.sweep([problem], TWO, folder=folder, options=km.bench.SweepOptions(**grid))
        except km.errors.ProblemError as error:
            if "another process" not in str(error):
                raise
            time.sleep(0.2)
    raise AssertionError("a worker of a killed sweep still holds the folder")


def once_each(folder):
    """Return how many rows of runs the store has."""
    try:
        with closing(sqlite3.connect(f"file:{folder / 'sweep.sqlite'}?mode=ro", uri=True)) as file:
            return file.execute("SELECT count(*) FROM texts WHERE name != 'asked'").fetchone()[0]
    except sqlite3.Error:  # it is not there yet
        return 0


def test_a_sweep_that_was_killed_goes_on_where_it_was(problem, peace, tmp_path):
    rows = killed_and_resumed(problem, tmp_path / "killed", [60.0], GRID, most=5)
    assert figures(rows) == figures(peace)
    assert once_each(tmp_path / "killed") == len(rows)


@pytest.mark.slow
def test_twenty_kills_at_random_moments_lose_nothing_and_repeat_nothing(problem, tmp_path):
    grid = {**GRID, "starts": 300}
    undisturbed = km.sweep([problem], TWO, folder=tmp_path / "peace", options=km.bench.SweepOptions(**grid))
    moments = np.random.default_rng(0).uniform(1.0, 8.0, 20).tolist()
    rows = killed_and_resumed(problem, tmp_path / "killed", moments, grid)
    assert figures(rows) == figures(undisturbed)
    assert once_each(tmp_path / "killed") == len(rows)


def test_a_worker_that_is_killed_costs_its_current_run_alone(tmp_path):
    source = {
        "return -0.5 * x[0]": "import os; os.kill(os.getpid(), 9) if os.environ.get('X') else 0\n        return -0.5 * x[0]"
    }
    deadly = km.load_problem(write(tmp_path, **source))
    os.environ["X"] = "1"
    try:
        rows = km.sweep([deadly], ["lqr"], folder=tmp_path / "deadly", options=km.bench.SweepOptions(workers=2))
    finally:
        del os.environ["X"]
    assert len(rows) == 2
    assert all("each worker that ran it died" in row.failure for row in rows)


@pytest.mark.slow
def test_twenty_workers_killed_at_random_lose_nothing_of_what_was_finished(problem, tmp_path):
    grid, kills = {**GRID, "starts": 300}, 20
    expected = figures(km.sweep([problem], TWO, folder=tmp_path / "peace", options=km.bench.SweepOptions(**grid)))
    rng, folder = np.random.default_rng(1), tmp_path / "killed"
    process = subprocess.Popen([sys.executable, script_of(problem, folder, grid)])
    done = 0
    while process.poll() is None and done < kills:
        time.sleep(rng.uniform(0.05, 0.6))
        found = subprocess.run(["pgrep", "-P", str(process.pid), "-f", "popen_loky"], capture_output=True, text=True)
        workers = list(map(int, found.stdout.split()))
        if workers and once_each(folder):
            os.kill(int(rng.choice(workers)), signal.SIGKILL)
            done += 1
    process.wait(300)
    rows = resumed(problem, folder, grid)  # a sweep all of whose workers are killed while they start has ended
    assert figures(rows) == expected
    assert once_each(folder) == len(rows)
    assert done > 0


@pytest.mark.slow
def test_two_processes_that_sweep_into_one_folder_do_not_mix(problem, peace, tmp_path):
    script = script_of(problem, tmp_path / "both", GRID)
    pair = [subprocess.Popen([sys.executable, script], stderr=subprocess.PIPE, text=True) for _ in range(2)]
    said = [process.communicate(timeout=200)[1] for process in pair]
    assert sorted(process.returncode for process in pair) == [0, 1]
    (refused,) = (text for process, text in zip(pair, said, strict=True) if process.returncode)
    assert "another process runs a sweep in" in refused
    rows = km.bench.load_rows(tmp_path / "both")
    assert figures(rows) == figures(peace)
    assert once_each(tmp_path / "both") == len(rows)


LIMIT = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({0}, {0}))"


@pytest.mark.parametrize(
    "sizes", [[2_000], pytest.param([300, 1_000, 3_000, 10_000, 30_000, 100_000, 200_000], marks=pytest.mark.slow)]
)
def test_a_disk_that_fills_ends_a_sweep_with_one_error_and_it_goes_on_when_there_is_room(
    problem, peace, tmp_path, sizes
):
    folder, ends = tmp_path / "full", []
    for size in sizes:
        script = script_of(problem, folder, GRID, LIMIT.format(size))
        ended = subprocess.run([sys.executable, script], stderr=subprocess.PIPE, text=True, timeout=200)
        ends.append(ended.returncode)
        if ended.returncode:
            assert "koopmpc.base.errors.FullDiskError: " in ended.stderr, (size, ended)
    assert ends[0] == 1
    rows = km.sweep([problem], TWO, folder=folder, options=km.bench.SweepOptions(**GRID))
    assert figures(rows) == figures(peace)
    assert once_each(folder) == len(rows)


@pytest.mark.slow
def test_a_file_system_without_room_does_too(problem, peace, tmp_path):
    folder = tmp_path / "small"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", folder], capture_output=True)
    if mounted.returncode:
        pytest.skip("no file system can be mounted here")
    try:
        with pytest.raises(km.errors.FullDiskError, match="No space left on device"):
            km.sweep([problem], TWO, folder=folder, options=km.bench.SweepOptions(**GRID))
        subprocess.run(["mount", "-o", "remount,size=100M", folder], check=True)
        assert figures(km.sweep([problem], TWO, folder=folder, options=km.bench.SweepOptions(**GRID))) == figures(peace)
    finally:
        subprocess.run(["umount", folder], check=True)


@pytest.mark.slow
def test_a_lost_worker_of_a_cluster_costs_nothing_that_was_finished(problem, peace, tmp_path):
    from distributed import Client

    killed = []

    def kill(name, done, total):
        if done >= 10 and not killed:
            killed.append(next(iter(pids.values())))
            os.kill(killed[0], signal.SIGKILL)

    with two_workers() as address:
        with Client(address) as client:
            pids = client.run(os.getpid)
        rows = km.sweep(
            [problem], TWO, folder=tmp_path, progress=kill, options=km.bench.SweepOptions(scheduler=address, **GRID)
        )
    assert killed
    assert figures(rows) == figures(peace)
    assert once_each(tmp_path) == len(rows)


def test_ctrl_c_leaves_a_store_that_reads(problem, tmp_path):
    script = tmp_path / "swept.py"
    grid = {**GRID, "starts": 2000}
    script.write_text(
        "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background ignore it\n"
        f"import koopmpc as km\nkm.sweep([km.load_problem({problem.file!r})], {TWO!r}, folder={str(tmp_path / 'f')!r}, options=km.bench.SweepOptions(**{grid!r}))\n"
    )
    process = subprocess.Popen([sys.executable, script], stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 180
    while time.monotonic() < deadline and once_each(tmp_path / "f") < 5:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    process.wait(180)
    rows = km.bench.load_rows(tmp_path / "f")
    assert 0 < len(rows) < 24000
    assert pq.read_table(tmp_path / "f" / "results.parquet").num_rows == len(rows)


def test_two_sweeps_at_once_in_one_folder_are_refused(problem, tmp_path):
    def second(*told):
        with pytest.raises(km.errors.ProblemError, match="another process runs a sweep in"):
            km.sweep([problem], ["lqr"], folder=tmp_path)

    assert len(km.sweep([problem], ["lqr"], folder=tmp_path, progress=second)) == 2
