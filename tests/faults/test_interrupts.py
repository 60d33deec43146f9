"""Ctrl-C: one line and exit code 130 from every command, KeyboardInterrupt in Python, and no file lost."""

import gc
import os
import random
import re
import signal
import subprocess
import sys
import threading
import time
import traceback
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import koopmpc as km
from tests.apps.tiny import write
from tests.faults.test_controllers import BUILD, controllers, models  # noqa: F401  # fixtures

SECONDS = 180.0  # of patience of a test on a busy machine; on a quiet one each command ends within one
BOUND = km.Limits(u_min=-1, u_max=1, x_min=[-0.2, -1.0], x_max=[0.2, 1.0])
PENDULUM = km.load_problem("pendulum")
PLANT = km.discretize(PENDULUM.dynamics, 0.05)


def data(episodes=30, steps=40):
    return km.collect(PLANT, km.Uniform([-3, -4], [3, 4]), km.Noise(-8, 8), episodes=episodes, steps=steps)


LIFTING = km.State() + km.Fourier(2, states=[0]) + km.Constant()


def stepping(controller):
    def again():
        controller.reset()
        controller([0.5, 0.0], [np.random.default_rng().uniform(-0.1, 0.1), 0.0])

    return again


def _koopman(solver):
    return stepping(km.KoopmanMPC(km.edmd(data(), LIFTING), PENDULUM.cost, BOUND, 40, solver=solver))


def _bilinear():
    model = km.bilinear_edmd(data(), LIFTING)
    return lambda: km.BilinearMPC(model, PENDULUM.cost, BOUND, 8)([0.5, 0.0], [np.random.default_rng().random(), 0.0])


def _cvodes():
    plant = km.discretize(PENDULUM.dynamics, 0.05, km.plants.CVODES())
    return lambda: plant.rollout([0.1, 0.0], np.zeros((200, 1)))


def _record(tmp_path):
    run = km.simulate(
        PLANT, km.LinearMPC(PLANT, [0, 0], [0], PENDULUM.cost, None, 5), x0=[0.1, 0], reference=[0, 0], steps=50
    )
    return lambda: km.record(run, tmp_path / "run.rrd")


BUSY = {
    "osqp": lambda _: _koopman("osqp"),
    "daqp": lambda _: _koopman("daqp"),
    "ipopt": lambda _: stepping(km.NonlinearMPC(PLANT, PENDULUM.cost, BOUND, 20)),
    "sqpmethod": lambda _: stepping(km.NonlinearMPC(PLANT, PENDULUM.cost, BOUND, 20, solver="sqpmethod")),
    "equilibria": lambda _: _bilinear(),
    "cvodes": lambda _: _cvodes(),
    "record": _record,
}


def _interrupted(busy, after):
    """Be busy until a Ctrl-C comes, which is sent after some seconds."""
    timer, end = threading.Timer(after, _interrupt), time.monotonic() + SECONDS
    timer.start()
    while time.monotonic() < end:
        busy()


def _interrupt():
    """Send a Ctrl-C to the thread that works, as in a program that has no other."""
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    os.kill(os.getpid(), signal.SIGINT)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # of files that an import had open
@pytest.mark.parametrize("name", BUSY)
@pytest.mark.parametrize("count", [2, pytest.param(50, marks=pytest.mark.slow)])
def test_an_interrupt_is_never_swallowed_in_python(tmp_path: Path, name: str, count: int) -> None:
    busy, rng = BUSY[name](tmp_path), random.Random(name)
    for _ in range(count):
        with pytest.raises(KeyboardInterrupt):
            _interrupted(busy, rng.uniform(0.01, 0.2))
    assert not list(tmp_path.glob(".*.part"))


@pytest.fixture(autouse=True)
def _ctrl_c_is_heard():
    """Listen to Ctrl-C, which a shell lets its jobs in the background ignore, and with them all that they start."""
    gc.collect()
    gc.disable()  # Python drops one that comes in a `__del__` of garbage, or in a callback of its collector
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
    gc.enable()


SENDER = """
import os, random, signal, sys, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
while os.getppid() == int(sys.argv[1]):
    os.kill(int(sys.argv[1]), signal.SIGINT)
    time.sleep(random.uniform(0.0002, 0.004))
"""


@pytest.mark.parametrize("name", BUILD)
@pytest.mark.parametrize("least", [20, pytest.param(2000, marks=pytest.mark.slow)])
def test_a_rain_of_interrupts_is_raised_one_by_one_and_the_controller_goes_on(controllers, name, least):  # noqa: F811
    if sys.gettrace() is not None:
        pytest.skip("an interrupt in coverage's own lock leaves it locked for ever")
    (controller, _), rng = controllers[name], random.Random(name)
    raised = caught = 0
    listens = False
    place, swallowed = [], []  # where the last one was raised, and where those were that did not arrive

    def answer(number, frame):
        """Raise one interrupt in each work; signals that merge, or come in between, are not counted."""
        nonlocal listens, raised, place
        if listens:
            listens, raised = False, raised + 1
            place = [f"{each.f_code.co_filename}:{line}" for each, line in traceback.walk_stack(frame)]
            raise KeyboardInterrupt

    def work():
        nonlocal listens
        listens = True
        controller.reset()
        for _ in range(3):
            controller([rng.uniform(-2, 2), 0.0], [rng.uniform(-1, 1), 0.0])
        listens = False

    signal.signal(signal.SIGINT, answer)
    sender = subprocess.Popen([sys.executable, "-S", "-c", SENDER, str(os.getpid())])
    end = time.monotonic() + SECONDS
    try:
        while raised < least and time.monotonic() < end:
            try:
                work()
            except KeyboardInterrupt:
                caught += 1
            if raised > caught + len(swallowed):
                swallowed.append(place)
    finally:
        sender.kill()
        sender.wait()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    assert not swallowed
    assert caught == raised >= least  # and the signal is neither blocked nor of another handler
    controller.reset()
    assert np.isfinite(controller([0.1, 0.0], [0.0, 0.0]).u).all()


def test_a_handler_that_raises_nothing_lets_the_solver_go_on(controllers):  # noqa: F811
    controller, told = controllers["nonlinear-mpc"][0], []
    signal.signal(signal.SIGINT, lambda number, frame: told.append(number))
    sender = subprocess.Popen([sys.executable, "-S", "-c", SENDER, str(os.getpid())])
    try:
        while len(told) < 20:
            controller.reset()
            assert controller([0.5, 0.0], [0.1, 0.0]).status is km.Status.OPTIMAL
    finally:
        sender.kill()
        sender.wait()


def moments(what: str, count: int) -> list[float]:
    """Return seconds after the start of a command: a third of them while it still imports."""
    rng = random.Random(what)
    return [rng.uniform(0.2, 2.0) if i % 3 == 0 else rng.uniform(1.0, 12.0) for i in range(count)]


@pytest.mark.parametrize(
    ("arguments", "sent"),
    [
        (["bench", "tiny.py", "pendulum"], signal.SIGINT),
        pytest.param(["fit", "data.csv"], signal.SIGINT, marks=pytest.mark.slow),
        (["fit", "data.csv", "--workers", "2"], signal.SIGINT),
        (["fit", "data.csv"], signal.SIGTERM),
        pytest.param(["reproduce", "snyder"], signal.SIGINT, marks=pytest.mark.slow),
    ],
    ids=["bench", "fit", "fit with workers", "fit, SIGTERM", "reproduce"],
)
@pytest.mark.parametrize("count", [1, pytest.param(50, marks=pytest.mark.slow)])
def test_a_command_ends_at_once_with_one_line_and_whole_files(
    tmp_path: Path, arguments: list[str], sent: signal.Signals, count: int
) -> None:
    write(tmp_path)
    data(episodes=60).save(tmp_path / "data.csv")
    interrupted = 0
    for moment in moments(" ".join(arguments), count):
        running = subprocess.Popen(
            [sys.executable, "-m", "koopmpc", *arguments],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        try:
            running.communicate(timeout=moment)
            continue  # it was done before
        except subprocess.TimeoutExpired:
            pass
        if sent is signal.SIGINT:  # of a terminal, to all processes of the command
            os.killpg(running.pid, sent)
        else:
            running.send_signal(sent)
        said = running.communicate(timeout=SECONDS)[1]
        interrupted += 1
        if moment < 0.5 and running.returncode in (-sent, 130) and "interrupted; " not in said:
            continue  # Python itself was still starting
        assert running.returncode == 130, said
        assert "Traceback" not in said
        *_, last = said.replace("\r", "\n").splitlines()
        assert "interrupted; nothing was written" in last or "interrupted; kept in logs" in last
        assert "CasADi" not in said
        kept = [path.suffix for path in (tmp_path / last.partition("kept in ")[2].partition(": ")[0]).rglob("*")]
        told = re.search(r": (\d+) finished run", last)
        assert int(told[1] if told else 0) == (kept.count(".rrd") if "kept in " in last else 0)
        for path in (tmp_path / "logs").rglob("*") if (tmp_path / "logs").exists() else ():
            assert path.suffix != ".part"
            if path.suffix == ".parquet":
                pq.read_table(path)
            if path.name == "model.npz":
                km.load_model(path)
            if path.suffix == ".rrd" and "bench" in arguments:
                km.load_run(path)
    assert interrupted > 0


def test_an_interrupt_in_the_last_iteration_of_a_solve_is_raised() -> None:
    """OSQP takes the signal for itself, and its status says nothing of one that comes after its last look."""
    from ctypes import CDLL

    from osqp import ext_builtin

    from koopmpc.control.solvers.osqp import _solve_uninterrupted

    library = CDLL(ext_builtin.__file__)

    def solve() -> None:
        library.osqp_start_interrupt_listener()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])  # as in another thread, which receives it
        os.kill(os.getpid(), signal.SIGINT)
        library.osqp_end_interrupt_listener()

    with pytest.raises(KeyboardInterrupt):
        _solve_uninterrupted(solve)
    _solve_uninterrupted(lambda: (library.osqp_start_interrupt_listener(), library.osqp_end_interrupt_listener()))
