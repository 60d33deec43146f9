"""realtime: a paced loop on a plant in another process, that stalls or dies; late steps, signals, and its log."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
import warnings
from collections import deque
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import koopmpc as km
from tests.loop.socket_plant import SocketPlant, inputs_in, started
from tests.tiers import few

ROOT = Path(__file__).parents[2]
DT = 0.02


class Toward:
    """u = r + (r − p) − v, which holds p at r; before call n it calls at[n]."""

    nu, horizon = 1, 3

    def __init__(self, dt=DT, at=None):
        self.dt, self.at, self.calls, self.ahead = dt, at or {}, 0, []

    def reset(self, x0=None, u_prev=None):
        self.calls = 0

    def __call__(self, y, reference, applied=None, w=None):
        self.at.get(self.calls, int)()
        self.ahead.append(reference[:, 0].tolist())
        self.calls += 1
        u = np.array([2.0 * reference[0, 0] - y.sum()])
        return km.Move(u, km.Status.OPTIMAL, km.control.Fallback.NONE, 1e-5, 1)


class Here:
    """A plant of this process that notes what it gets: y counts the inputs."""

    states = outputs = ("n",)
    inputs = ("u [N]",)
    state = None

    def __init__(self, dt=DT):
        self.dt, self.got = dt, []

    def reset(self, x0, rng):
        return [0.0]

    def step(self, u):
        self.got.append(float(u[0]))
        return [float(len(self.got))]


class Counting(Toward):
    """u = 1, 2, 3, …"""

    def __call__(self, y, reference, applied=None, w=None):
        move = super().__call__(np.zeros(2), reference)
        move.u[:] = self.calls
        return move


def names(plant):
    return {"dt": plant.dt, "states": plant.states, "inputs": plant.inputs}


def test_a_plant_in_another_process_is_brought_to_its_reference_and_gets_the_safe_input_last(tmp_path):
    log = tmp_path / "run.rrd"
    with started(tmp_path) as (_, port, heard), closing(SocketPlant(port, DT)) as plant:
        with km.Recorder(log, **names(plant)) as recorder:
            paced = km.realtime(
                Toward(),
                plant,
                dt=DT,
                x0=[0, 0],
                reference=[1, 0],
                steps=120,
                recorder=recorder,
                watchdog=20,
                safe=0.25,
            )
        given = inputs_in(heard)
    run = km.load_run(log)
    measured = np.isfinite(run.Y[:-1, 0])
    assert paced.ended == "done"
    assert paced.steps + paced.skipped == 120
    assert abs(run.Y[:-1][measured][-1, 0] - 1.0) < 0.2
    assert given[-1] == ("stop", 0.25)
    logged = run.U[measured, 0].tolist()
    assert paced.steps - 1 <= len(logged) <= paced.steps  # of the last tick nothing is measured: it has no row
    assert [value for kind, value in given if kind == "u"][: len(logged)] == logged


def test_a_plant_that_stalls_gets_the_safe_input_and_the_loop_ends(tmp_path):
    with started(tmp_path) as (process, port, heard), closing(SocketPlant(port, DT)) as plant:
        stall = Toward(at={25: lambda: process.send_signal(signal.SIGSTOP)})
        paced = km.realtime(stall, plant, dt=DT, x0=[0, 0], reference=[1, 0], watchdog=0.4, safe=-0.5)
        process.send_signal(signal.SIGCONT)
        deadline = time.monotonic() + 180
        while time.monotonic() < deadline and inputs_in(heard)[-1] != ("stop", -0.5):
            time.sleep(0.05)
        assert inputs_in(heard)[-1] == ("stop", -0.5)
    assert paced.ended == "watchdog: the plant did not return within 0.4 s"


def test_a_plant_that_dies_ends_the_loop_and_its_log_is_complete(tmp_path):
    log = tmp_path / "run.rrd"
    with started(tmp_path) as (process, port, _), closing(SocketPlant(port, DT)) as plant:
        end = Toward(at={30: process.kill})
        with km.Recorder(log, **names(plant)) as recorder:
            paced = km.realtime(end, plant, dt=DT, x0=[0, 0], reference=[1, 0], recorder=recorder, watchdog=20)
    assert paced.ended.startswith(("plant: ConnectionError", "plant: BrokenPipeError", "plant: ConnectionResetError"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = km.load_run(log)
    assert abs(run.steps - paced.steps - paced.skipped) <= 1


LOOP = """
import sys
import koopmpc as km
from tests.loop.socket_plant import SocketPlant
from tests.loop.test_realtime import DT, Toward, names
plant = SocketPlant(int(sys.argv[1]), DT)
with km.Recorder(sys.argv[2], **names(plant)) as recorder:
    print("up", flush=True)
    print(km.realtime(Toward(), plant, dt=DT, x0=[0, 0], reference=[1, 0], recorder=recorder, watchdog=20, safe=0.125))
"""


def flushed_steps(log):
    """Return how many steps of a log that is being written can be read now."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return km.load_run(log).steps
        except km.errors.LogError:  # its head is not there yet
            return 0


@pytest.mark.parametrize("number", few([signal.SIGTERM, signal.SIGINT, signal.SIGKILL], signal.SIGKILL))
def test_the_log_is_whole_up_to_its_last_flush_whatever_ends_the_process(tmp_path, number):
    log = tmp_path / "run.rrd"
    restored = "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
    with started(tmp_path) as (_, port, heard):
        process = subprocess.Popen(
            [sys.executable, "-c", restored + LOOP, str(port), str(log)],
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            text=True,
        )
        assert process.stdout.readline() == "up\n"
        deadline = time.monotonic() + 180
        while time.monotonic() < deadline and (not heard.exists() or len(inputs_in(heard)) < 60):
            time.sleep(0.05)
        while number == signal.SIGKILL and time.monotonic() < deadline and flushed_steps(log) <= 20:
            time.sleep(0.2)  # the recorder starts Rerun first, for a second or more on a busy machine
        process.send_signal(number)
        said = process.stdout.read()
        code = process.wait(180)
        process.stdout.close()
        given = [value for kind, value in inputs_in(heard) if kind == "u"]
        stopped = inputs_in(heard)[-1]
    if number == signal.SIGKILL:
        assert code == -signal.SIGKILL
        with pytest.warns(UserWarning, match="ends after step"):
            run = km.load_run(log)
        assert run.steps > 20  # the others came after the last flush
    else:
        assert code == 0
        assert f"ended: {number.name}" in said
        assert stopped == ("stop", 0.125)
        run = km.load_run(log)
        assert run.steps >= len(given) - 1
    logged = run.U[np.isfinite(run.Y[:-1, 0]), 0].tolist()
    assert logged == given[: len(logged)]


@pytest.mark.parametrize("policy", ["skip", "hold"])
def test_a_late_step_is_counted_and_its_input_is_applied_late_or_not_at_all(tmp_path, policy):
    dt, plant = 0.2, Here(0.2)
    with km.Recorder(tmp_path / "run.rrd", **names(plant)) as recorder:
        paced = km.realtime(
            Counting(dt, {3: lambda: time.sleep(2.5 * dt)}),
            plant,
            dt=dt,
            reference=[0.0],
            steps=9,
            late=policy,
            recorder=recorder,
        )
    run = km.load_run(tmp_path / "run.rrd")
    given, skipped = run.U[:, 0].tolist(), np.flatnonzero(np.isnan(run.Y[:-1, 0])).tolist()
    taken = [k for k in range(run.steps) if k not in skipped]
    at = taken[3]  # the step that takes two and a half; a busy machine may have made others late, too
    assert {at + 1, at + 2} <= set(skipped)
    assert given[at] == (4.0 if policy == "skip" else given[at - 1])
    assert all(given[k] == given[k - 1] for k in skipped)
    assert plant.got == [*(given[k] for k in taken), 0.0]
    assert paced.steps + paced.skipped == 9
    assert paced.late >= 1
    assert paced.held == (paced.late if policy == "hold" else 0)
    assert [k for k in range(run.steps) if run.status[k] is km.Status.TIME_LIMIT] == skipped
    assert all(run.fallback[k] is km.control.Fallback.HOLD for k in skipped)


def test_a_controller_that_never_returns_is_interrupted_and_the_plant_is_safe():
    plant = Here()
    paced = km.realtime(Toward(at={2: lambda: time.sleep(1e6)}), plant, dt=DT, reference=[0.0], watchdog=1.0, safe=9.0)
    assert paced.ended == "watchdog: the controller did not return within 1 s"
    assert paced.steps == 2
    assert plant.got[2:] == [9.0]


@pytest.mark.parametrize("part", ["the plant", "the recorder"])
def test_a_reading_or_a_recorder_that_never_returns_is_named_and_the_plant_is_safe(part):
    def stuck(step=None):
        time.sleep(1e6)

    class Reading(Here):
        def read(self):
            return stuck() if len(self.got) == 2 and part == "the plant" else [0.0]

        def step(self, u):
            super().step(u)

        def stop(self, u):
            super().step(u)

    plant = Reading()
    recorder = None if part == "the plant" else lambda step: stuck() if step.k == 1 else None
    paced = km.realtime(Toward(), plant, dt=DT, reference=[0.0], watchdog=1.0, safe=9.0, recorder=recorder)
    assert paced.ended == f"watchdog: {part} did not return within 1 s"
    assert plant.got[-1] == 9.0
    assert len(plant.got) == 3


def test_an_input_that_comes_after_the_watchdog_has_acted_never_reaches_the_plant():
    """Outside the main thread no call can be interrupted: the controller returns in its own time."""
    plant, ended = Here(), []
    late = Toward(at={2: lambda: time.sleep(0.5)})
    loop = {"dt": DT, "reference": [0.0], "watchdog": 0.2, "safe": 9.0}
    thread = threading.Thread(target=lambda: ended.append(km.realtime(late, plant, **loop).ended))
    thread.start()
    thread.join(60)
    assert ended == ["watchdog: the controller did not return within 0.2 s"]
    assert plant.got[-1] == 9.0
    assert plant.got.count(9.0) == 1


def test_a_plant_that_fails_once_is_made_safe_by_its_next_step():
    class Loose(Here):
        def step(self, u):
            super().step(u)
            if len(self.got) == 3:
                raise OSError("no answer")
            return [0.0]

    plant = Loose()
    paced = km.realtime(Toward(), plant, dt=DT, reference=[0.0], watchdog=20, safe=9.0)
    assert paced.ended == "plant: OSError: no answer"
    assert plant.got[3:] == [9.0]


def test_what_a_recorder_raises_is_no_failure_of_the_plant():
    def full(step):
        raise OSError("no room")

    plant = Here()
    with pytest.raises(OSError, match="no room"):
        km.realtime(Toward(), plant, dt=DT, reference=[0.0], watchdog=20, safe=9.0, recorder=full)
    assert plant.got[1:] == [9.0]


def test_what_a_controller_raises_is_raised_when_the_plant_is_safe():
    class Broken(Toward):
        def __call__(self, y, reference, applied=None, w=None):
            raise ZeroDivisionError

    plant = Here()
    with pytest.raises(ZeroDivisionError):
        km.realtime(Broken(), plant, dt=DT, reference=[0.0], safe=9.0)
    assert plant.got == [9.0]


def test_a_plant_that_cannot_be_made_safe_is_named():
    class Gone(Here):
        def step(self, u):
            raise OSError("the cable is out")

    paced = km.realtime(Toward(), Gone(), dt=DT, reference=[0.0])
    assert paced.ended.startswith("plant: OSError: the cable is out")
    assert "the safe input did not reach it: OSError: the cable is out" in paced.ended


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"dt": 0.1}, r"the controller has dt = 0\.02 s, the loop 0\.1 s; use one dt for both"),
        ({"late": "drop"}, r"late is 'drop'; pass \"skip\" or \"hold\""),
        ({"safe": [0, 0]}, r"safe has shape \(2,\)"),
        ({"steps": 0}, r"steps is 0"),
        ({"watchdog": -1.0}, r"watchdog"),
    ],
)
@pytest.mark.unhooked
def test_arguments_that_do_not_fit_say_so_before_the_plant_moves(wrong, message):
    plant = Here()
    with pytest.raises((km.errors.DataError, km.errors.ShapeError), match=message):
        km.realtime(Toward(), plant, **{"dt": DT, "reference": [0.0], **wrong})
    assert plant.got == []


def test_signals_and_switches_are_as_they_were():
    before = signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT), sys.getswitchinterval()
    km.realtime(Toward(), Here(), dt=DT, reference=[0.0], steps=1)
    assert before == (signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT), sys.getswitchinterval())


@pytest.mark.parametrize("steps", few([20, 300], 20))
def test_the_example_of_the_page_runs(tmp_path, monkeypatch, capsys, steps):
    (source,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "realtime.md").read_text(), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    exec(source.replace("steps=300", f"steps={steps}"), names := {})
    assert "stopped by u = [0.]\n" in capsys.readouterr().out
    paced = names["paced"]
    assert paced.ended == "done"
    assert paced.steps + paced.skipped == steps
    assert steps - paced.skipped <= km.load_run("rig.rrd").steps <= steps  # ticks that are skipped last have no row


def test_the_report_tells_the_median_and_the_99_percent_quantile_of_the_delays():
    paced = km.loop.Paced(steps=101, late=2, jitter=deque(np.linspace(0.0, 0.1, 101)))
    assert str(paced).splitlines() == [
        "101 steps, 2 late, 0 skipped, 0 held; ended: done",
        "steps began 50.000 ms after their time at the median, 99.000 ms at the 99 % quantile",
    ]
    assert "nan ms" in str(km.loop.Paced())
