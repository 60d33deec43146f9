"""Soak: loops with faults and wild readings, files, interrupts, designs and killed benches; run by `make soak MINUTES=60`.

Each round has a seed, which is printed where something goes wrong. Memory must stay flat: of the line through the means
of resident memory over each minute, after the first ten minutes or the first third, the upper end of the 95 % interval of
the slope is at most 5 MB an hour. No process may outlive a bench that is killed.
"""

import argparse
import gc
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np
from scipy import stats

import koopmpc as km
from tests.faults.damage import READERS, WRITERS, store
from tests.faults.test_controllers import BUILD, COST, PLANT

MAKERS = WRITERS | {"sweep.sqlite": store}
_SLOPE, _SETTLED = 5.0, 10.0  # [MB/h], and minutes until memory is at rest


def resident() -> float:
    """Return the memory of this process [MB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def controllers(seed: int):
    """Yield each controller with its limits, on models of fresh data."""
    data = km.collect(PLANT, km.Uniform([-2, -2], [2, 2]), km.Noise(-3, 3), episodes=60, steps=15, rng=seed)
    lifting = km.State() + km.Fourier(1, states="theta") + km.Constant()
    linear, bilinear = km.edmd(data, lifting), km.bilinear_edmd(data, lifting)
    for name, build in BUILD.items():
        yield name, *build(linear, bilinear)


def loops(seed: int, _: Path) -> None:
    rng = random.Random(seed)
    faults = [km.faults.NaNSensor(probability=0.1), km.faults.DroppedSamples(0.2), km.faults.SolverFailure(0.2)]
    for name, controller, limits in controllers(seed):
        chosen = rng.sample(faults, rng.randrange(len(faults) + 1))
        x0 = [rng.uniform(-2, 2), rng.uniform(-2, 2)]
        run = km.simulate(
            PLANT,
            controller,
            x0=x0,
            reference=[0, 0],
            steps=20,
            cost=COST,
            options=km.loop.LoopOptions(faults=chosen, rng=seed),
        )
        low, high = limits.inputs(1)
        assert np.isfinite(run.U).all(), name
        assert ((low <= run.U) & (high >= run.U)).all(), name


def files(seed: int, folder: Path) -> None:
    rng, name = random.Random(seed), random.Random(seed).choice(list(READERS))
    written, read = READERS[name][0](), READERS[name][1]
    (folder / name).unlink(missing_ok=True)  # a sweep goes on in its store
    MAKERS[name](folder / name)
    data = bytearray((folder / name).read_bytes())
    bit = rng.randrange(8 * len(data))
    data[bit // 8] ^= 1 << bit % 8
    (folder / name).write_bytes(data)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with suppress(km.errors.LogError):
            assert read(folder / name) == written or caught, f"{name}, bit {bit}"


def interrupt(seed: int, _: Path) -> None:
    rng = random.Random(seed)
    _, controller, _ = rng.choice(list(controllers(seed)))
    gc.collect()  # Python drops one that comes while it deletes the recordings of the round
    timer = threading.Timer(rng.uniform(0.0, 0.1), lambda: os.kill(os.getpid(), signal.SIGINT))
    end = time.monotonic() + 10
    try:
        timer.start()
        while time.monotonic() < end:
            controller([rng.uniform(-2, 2), 0.0], [0.0, 0.0])
        raise AssertionError("an interrupt was swallowed")
    except KeyboardInterrupt:
        controller.reset()
        assert np.isfinite(controller([0.1, 0.0], [0.0, 0.0]).u).all(), "no number after an interrupt"


def wild(seed: int, _: Path) -> None:
    """Run loops whose measurement is far off now and then."""
    rng = random.Random(seed)
    for name, controller, limits in controllers(seed):
        low, high = limits.inputs(1)
        x = np.array([rng.uniform(-2, 2), 0.0])
        for _ in range(20):
            y = x.copy()
            if rng.random() < 0.2:
                y[rng.randrange(2)] = rng.choice([50.0, 1e6, 1e29, -1e6])
            u = controller(y, [0.0, 0.0]).u
            assert np.isfinite(u).all(), name
            assert ((low <= u) & (u <= high)).all(), name
            x = np.clip(PLANT(x, u), -50, 50)


def paced(seed: int, folder: Path) -> None:
    """Run a loop in real time that is recorded, and read its log."""
    rng = random.Random(seed)
    _, controller, _ = rng.choice(list(controllers(seed)))
    with km.Recorder(folder / "paced.rrd", dt=PLANT.dt, states=PLANT.states, inputs=PLANT.inputs) as recorder:
        x0 = [rng.uniform(-1, 1), 0.0]
        plant = km.plants.SimulatedPlant(PLANT)
        done = km.realtime(controller, plant, dt=PLANT.dt, reference=[0, 0], steps=5, x0=x0, recorder=recorder)
    logged = km.load_run(folder / "paced.rrd").steps
    # On a busy machine steps are skipped. The log holds those before the last step, too, and at times some after it.
    assert done.steps <= logged <= done.steps + done.skipped, f"{done}: {logged} rows"


def designed(seed: int, _: Path) -> None:
    """Design a controller from a few episodes."""
    data = km.collect(PLANT, km.Uniform([-1, -1], [1, 1]), km.Noise(-3, 3), episodes=8, steps=20, rng=seed)
    made = km.design(
        data,
        COST,
        km.Limits(u_min=-3, u_max=3),
        reference=[0, 0],
        horizon=5,
        options=km.DesignOptions(rng=seed, loops=6),
    )
    assert np.isfinite(made.controller([0.1, 0.0], [0.0, 0.0]).u).all(), "a design gives no number"


def killed(seed: int, folder: Path) -> None:
    """Kill a bench at a random moment; its folder can be gone on with, and nothing of it lives."""
    rng = random.Random(seed)
    command = [sys.executable, "-m", "koopmpc", "bench", "pendulum", "--name", f"killed {seed}", "--workers", "2"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen(command, cwd=folder, start_new_session=True, **quiet)
    with suppress(subprocess.TimeoutExpired):
        process.wait(rng.uniform(0.5, 8.0))
    process.send_signal(rng.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT]))
    process.wait(20)
    end = time.monotonic() + 15
    while (left := session(process.pid)) and time.monotonic() < end:
        time.sleep(0.2)
    assert not left, f"processes {left} outlived a bench that was killed"


def session(leader: int) -> list[int]:
    """Return the processes of a session that live."""
    found = []
    for folder in Path("/proc").iterdir():
        with suppress(OSError, ValueError, IndexError):
            state, _, _, of = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
            if int(of) == leader and state != "Z":
                found.append(int(folder.name))
    return found


def slope(minutes: list[float], memory: list[float]) -> tuple[float, float]:
    """Return the slope of memory [MB/h] and the upper end of its 95 % interval, from the means over each minute.

    Both are NaN where there are fewer than three minutes: the soak is then too short to tell.
    """
    whole = np.floor(minutes).astype(int)
    means = np.array([(m, np.mean([v for at, v in zip(whole, memory, strict=True) if at == m])) for m in set(whole)])
    if len(means) < 3:
        return np.nan, np.nan
    fit = stats.linregress(means[:, 0] / 60, means[:, 1])
    return float(fit.slope), float(fit.slope + stats.t.ppf(0.975, len(means) - 2) * fit.stderr)


PARTS = {loops: 1, wild: 1, files: 1, interrupt: 1, paced: 1, designed: 20, killed: 20}  # each, every so many rounds


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    asked = parser.parse_args()
    warnings.simplefilter("ignore")  # of lines that are damaged on purpose, and left out
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which a job in the background ignores
    begun, rounds, lost = time.monotonic(), 0, 0
    rest = min(_SETTLED, asked.minutes / 3)
    minutes: list[float] = []
    memory: list[float] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for each in READERS:  # the libraries that each kind of file needs are loaded before memory is measured
            MAKERS[each](folder / each)
            READERS[each][1](folder / each)
        while (now := (time.monotonic() - begun) / 60) < asked.minutes:
            seed = asked.seed + rounds
            for part, every in PARTS.items():
                if rounds % every == every - 1:
                    try:
                        part(seed, folder)
                    except Exception as error:
                        lost += 1
                        sys.stdout.write(f"seed {seed}: {type(error).__name__}: {error}\n")
            rounds += 1
            if now > rest:
                minutes.append(now)
                memory.append(resident())
    rise, most = slope(minutes, memory)
    sys.stdout.write(
        f"seeds {asked.seed} to {asked.seed + rounds - 1}: {lost} lost; memory {memory[-1] if memory else 0:.0f} MB, "
        f"rises by {rise:.1f} MB an hour, at most {most:.1f} at 95 %\n"
    )
    return int(lost > 0 or not most <= _SLOPE)


if __name__ == "__main__":
    sys.exit(main())
