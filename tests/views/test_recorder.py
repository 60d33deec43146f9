"""Recorder: step by step it writes what `record` writes at once, and nothing that happens to it reaches the loop."""

import os
import subprocess
import sys
import threading
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import koopmpc as km
from tests.views.logged import Logged
from tests.views.runs import about, make_run, steps_of
from tests.views.viewing import free_port, start_viewer


def test_a_recorder_and_record_write_the_same_run(tmp_path: Path) -> None:
    for i, run in enumerate((make_run(nu=2, odd=1.0), make_run(N=None, ny=1, cost=False), make_run(T=1))):
        path = tmp_path / f"{i}.rrd"
        with km.Recorder(
            path,
            **about(run, scene=lambda x, u: [km.scene.Disk("d", (float(x[0]), 0.0), 1.0)]),
        ) as recorder:
            for step in steps_of(run):
                recorder(step)
                time.sleep(0.02)  # so that there are several batches
        km.record(run, tmp_path / "once.rrd")
        assert km.load_run(path) == run
        assert km.load_run(tmp_path / "once.rrd") == run


def test_steps_without_a_plan_leave_a_gap_in_the_plans(tmp_path: Path) -> None:
    run = make_run(T=6, N=2)
    run.plans.X[[0, 3]], run.plans.U[[0, 3]] = np.nan, np.nan
    with km.Recorder(tmp_path / "run.rrd", **about(run)) as recorder:
        for step in steps_of(run):
            recorder(replace(step, look_ahead=None) if step.k in (0, 3) else step)
    assert km.load_run(tmp_path / "run.rrd") == run


def test_predictions_that_begin_after_the_first_batch_are_drawn_as_all_others(tmp_path: Path) -> None:
    run, path = make_run(T=6, N=2), tmp_path / "run.rrd"
    with km.Recorder(path, **about(run)) as recorder:
        for step in steps_of(run):
            recorder(replace(step, look_ahead=None) if step.k < 3 else step)
            end = time.monotonic() + 60
            while step.k == 2 and b"control/u" not in path.read_bytes() and time.monotonic() < end:
                time.sleep(0.01)  # until the first batch is written
    log = Logged(path)
    for j in (1, 2):
        assert log.static(f"plots/0/ahead/{j}", "names")
        assert log.matrix(f"plots/0/ahead/{j}")[0].tolist() == list(range(3 + j, 7))


def test_a_loop_of_your_own_needs_only_y_u_and_the_reference(tmp_path: Path) -> None:
    run = make_run()
    y, u = np.zeros(2), np.zeros(1)
    with km.Recorder(tmp_path / "run.rrd", dt=0.1, states=run.states, inputs=run.inputs) as recorder:
        for k in range(run.steps):
            y[:], u[:] = run.Y[k], run.U[k]  # the same arrays again: the Recorder keeps copies
            recorder(km.loop.Step(k, y, u, run.reference[k], y_next=run.Y[-1] if k == run.steps - 1 else None))
    read = km.load_run(tmp_path / "run.rrd")
    assert np.array_equal(read.Y, run.Y)
    assert np.array_equal(read.U, run.U)
    assert np.isnan(read.X).all()
    assert read.outputs == run.states


def test_without_the_last_measurement_the_run_ends_a_step_before(tmp_path: Path) -> None:
    run = make_run()
    with km.Recorder(tmp_path / "run.rrd", **about(run)) as recorder:
        for step in steps_of(run):
            recorder(replace(step, x_next=None, y_next=None))
    assert km.load_run(tmp_path / "run.rrd").steps == run.steps - 1


def feed(recorder: km.Recorder, run: km.Run) -> None:
    for step in steps_of(run):
        recorder(step)


def test_no_viewer_costs_one_warning_and_no_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("koopmpc.views.recording.viewer.has_display", lambda: False)
    monkeypatch.setattr(
        "rerun.GrpcSink", lambda _: pytest.fail("Rerun waits five seconds for a viewer that is not there")
    )
    run, port = make_run(), free_port()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with km.Recorder(tmp_path / "run.rrd", live=True, **about(run, port=port)) as recorder:
            feed(recorder, run)
        with km.Recorder(live=True, **about(run, port=port)) as recorder:
            feed(recorder, run)
    assert [w.category for w in caught] == [UserWarning, UserWarning]
    listens = f"no Rerun viewer listens at 127.0.0.1:{port}, and there is no display to open one on"
    assert str(caught[0].message) == f"{listens}; the log is written all the same"
    assert str(caught[1].message) == f"{listens}; nothing is recorded"
    assert km.load_run(tmp_path / "run.rrd") == run


def test_a_viewer_that_fails_to_start_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("koopmpc.views.recording.viewer.has_display", lambda: True)
    monkeypatch.setattr("koopmpc.views.recording.viewer.open_viewer", lambda logs, port: False)
    run = make_run()
    told = r"and the one that was opened did not start; run `.*rerun.*` to see what it says; the log is written"
    with pytest.warns(UserWarning, match=told):  # noqa: SIM117
        with km.Recorder(tmp_path / "run.rrd", live=True, **about(run, port=free_port())) as recorder:
            feed(recorder, run)
    assert km.load_run(tmp_path / "run.rrd") == run


def missing(log: Path, run: km.Run) -> str:
    """Return what a log lacks of a run, in words; nothing where it lacks nothing."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # that the log is a part
            read = km.load_run(log)
    except (km.errors.LogError, UserWarning) as told:
        return str(told)
    return "" if read == run else f"the log holds {read.steps} steps of {run.steps}, or others than were sent"


def test_a_viewer_that_is_up_gets_the_whole_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("koopmpc.views.recording.recorder._PATIENCE_VIEWER", 30.0)  # on a busy machine it may be late
    run, seen, port = make_run(), tmp_path / "seen.rrd", free_port()
    viewer = start_viewer("--save", str(seen), port=port)
    assert viewer is not None, "the viewer does not listen"
    try:
        with km.Recorder(live=True, **about(run, port=port)) as recorder:
            feed(recorder, run)
        end = time.monotonic() + 30
        while (lacks := missing(seen, run)) and viewer.poll() is None and time.monotonic() < end:
            time.sleep(0.1)  # it writes what it is sent as it comes
    finally:
        viewer.kill()  # not by a Ctrl-C, which a program that was started in the background ignores
        viewer.wait()
    assert not lacks


_FAILING = """
import signal, sys, time, warnings
sys.path.insert(0, {root!r})
from tests.views.runs import about, make_run, steps_of
from tests.views.viewing import start_viewer
import koopmpc as km
km.Recorder
sys.modules["koopmpc.views.recording.recorder"]._PATIENCE_VIEWER = 1.0
run = make_run(T=40)
viewer = start_viewer("--serve-grpc", port={port})
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    with km.Recorder({path!r}, live=True, **about(run, port={port})) as recorder:
        for step in steps_of(run):
            recorder(step)
            time.sleep(0.02)
            if step.k == 15:
                {end}
viewer.kill()
viewer.wait()
for warning in caught:
    print(warning.category.__name__, warning.message)
"""


@pytest.mark.parametrize(
    ("end", "told"),
    [
        ("viewer.kill(); viewer.wait()", "was closed"),
        pytest.param(
            "viewer.send_signal(signal.SIGSTOP)",
            "takes in nothing more (it took in no more for 1 s)",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["killed", "slow"],
)
def test_a_viewer_that_fails_costs_one_warning_and_no_step(tmp_path: Path, end: str, told: str) -> None:
    """In a process of its own: Rerun prints what it thinks of it when the process ends."""
    path, root, port = tmp_path / "run.rrd", str(Path(__file__).parents[2]), free_port()
    code = _FAILING.format(root=root, path=str(path), port=port, end=end)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    (said,) = done.stdout.splitlines()
    assert said == f"UserWarning the viewer {told} before the end; the log {path} is complete"
    assert done.stderr == ""  # no line of Rerun's own
    assert km.load_run(path) == make_run(T=40)


def test_a_scene_that_raises_is_told_and_does_not_reach_the_loop(tmp_path: Path) -> None:
    def scene(x: np.ndarray, u: np.ndarray) -> list[km.scene.Disk]:
        raise ZeroDivisionError("no such place")

    run = make_run()
    with pytest.warns(UserWarning, match=r"run\.rrd is not complete: no such place"):  # noqa: SIM117
        with km.Recorder(tmp_path / "run.rrd", **about(run, scene=scene)) as recorder:
            feed(recorder, run)


def test_an_exception_in_the_loop_still_closes_the_log(tmp_path: Path) -> None:
    run = make_run()

    def loop() -> None:
        with km.Recorder(tmp_path / "run.rrd", **about(run)) as recorder:
            for step in steps_of(run)[:9]:
                recorder(step)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        loop()
    read = km.load_run(tmp_path / "run.rrd")
    assert read.steps == 9
    assert np.array_equal(read.X, run.X[:10])


_KILLED = """
import sys, time, warnings
sys.path.insert(0, {root!r})
from tests.views.runs import about, make_run, steps_of
import koopmpc as km
run = make_run(T=200)
def count_flushed():
    try:
        return km.load_run({path!r}).steps
    except km.errors.LogError:  # its head is not there yet
        return 0
warnings.simplefilter("ignore")  # the log is not closed
with km.Recorder({path!r}, **about(run)) as recorder:
    for step in steps_of(run)[:100]:
        recorder(step)
    while count_flushed() < 98:  # the thread starts Rerun first, for a second or more on a busy machine
        time.sleep(0.1)
    for step in steps_of(run)[100:]:
        recorder(step)
    print("written", flush=True)
    time.sleep(60)
"""


def test_a_file_that_takes_in_no_more_is_told_after_the_patience_for_files(tmp_path: Path, monkeypatch) -> None:
    goes_on, run = threading.Event(), make_run(T=3, N=None)

    def scene(x: np.ndarray, u: np.ndarray) -> list[km.scene.Disk]:
        goes_on.wait()
        return [km.scene.Disk("d", (0.0, 0.0), 1.0)]

    monkeypatch.setattr("koopmpc.views.recording.recorder._PATIENCE_FILE", 0.05)
    monkeypatch.setattr("koopmpc.views.recording.recorder._PATIENCE_VIEWER", 0.01)
    told = pytest.warns(UserWarning, match=r"run\.rrd is not complete: it took in no more for 0\.05 s")
    with told, km.Recorder(tmp_path / "run.rrd", **about(run, scene=scene)) as recorder:
        feed(recorder, run)
    goes_on.set()
    for thread in threading.enumerate():
        if thread.name == "koopmpc-recording":
            thread.join()
    assert km.load_run(tmp_path / "run.rrd").steps == 3


@pytest.mark.slow
def test_a_killed_writer_keeps_what_was_flushed(tmp_path: Path) -> None:
    path, root = tmp_path / "run.rrd", str(Path(__file__).parents[2])
    code = _KILLED.format(root=root, path=str(path))
    writer = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, env=os.environ | {"PYTHONPATH": root}
    )
    assert writer.stdout is not None
    writer.stdout.readline()
    writer.kill()
    writer.wait()
    writer.stdout.close()
    with pytest.warns(UserWarning, match=r"run\.rrd ends after step \d+: the file was cut short or its writer"):
        read = km.load_run(path)
    run = make_run(T=200)
    assert read.steps >= 98  # the hundredth was held back for what follows it
    assert np.array_equal(read.X, run.X[: read.steps + 1])
    assert np.array_equal(read.plans.X, run.plans.X[: read.steps])
    assert read.status == run.status[: read.steps]


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="counts threads as Linux lists them")
def test_logs_that_are_written_give_their_threads_back(tmp_path: Path) -> None:
    threads = []
    for _ in range(4):
        km.record(make_run(), tmp_path / "run.rrd")
        threads.append(len(list(Path("/proc/self/task").iterdir())))
    assert threads[1] == threads[3]  # of the last log they may be there until the next


def test_a_recording_that_the_user_made_global_stays_so(tmp_path: Path) -> None:
    import rerun as rr

    before, own = rr.get_global_data_recording(), rr.RecordingStream("own")
    rr.set_global_data_recording(own)
    try:
        km.record(make_run(), tmp_path / "run.rrd")
        kept = rr.get_global_data_recording()
        assert kept is not None
        assert kept.get_recording_id() == own.get_recording_id()
    finally:
        rr.set_global_data_recording(before)
