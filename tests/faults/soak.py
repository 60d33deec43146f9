"""Soak: closed loops with faults, damaged files and interrupts for some minutes; run by `make soak`.

Each round has a seed, which is printed where something goes wrong. Memory must stay flat: after the first rounds it may
grow by 20 MB at most.
"""

import argparse
import gc
import os
import random
import signal
import sys
import tempfile
import threading
import time
import warnings
from contextlib import suppress
from pathlib import Path

import numpy as np

import koopmpc as km
from tests.faults.damage import READERS, WRITERS
from tests.faults.test_controllers import BUILD, COST, PLANT

_GROWTH, _SETTLED = 20.0, 30  # [MB], and rounds until memory is at rest


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


def loops(seed: int) -> None:
    rng = random.Random(seed)
    faults = [km.faults.NaNSensor(probability=0.1), km.faults.DroppedSamples(0.2), km.faults.SolverFailure(0.2)]
    for name, controller, limits in controllers(seed):
        chosen = rng.sample(faults, rng.randrange(len(faults) + 1))
        x0 = [rng.uniform(-2, 2), rng.uniform(-2, 2)]
        run = km.simulate(PLANT, controller, x0=x0, reference=[0, 0], steps=20, cost=COST, faults=chosen, rng=seed)
        low, high = limits.inputs(1)
        assert np.isfinite(run.U).all(), name
        assert ((low <= run.U) & (high >= run.U)).all(), name


def files(seed: int, folder: Path) -> None:
    rng, name = random.Random(seed), random.Random(seed).choice(list(READERS))
    written, read = READERS[name][0](), READERS[name][1]
    WRITERS[name](folder / name)
    data = bytearray((folder / name).read_bytes())
    bit = rng.randrange(8 * len(data))
    data[bit // 8] ^= 1 << bit % 8
    (folder / name).write_bytes(data)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with suppress(km.errors.LogError):
            assert read(folder / name) == written or caught, f"{name}, bit {bit}"


def interrupt(seed: int) -> None:
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
        assert np.isfinite(controller([0.1, 0.0], [0.0, 0.0]).u).all()


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    asked = parser.parse_args()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which a job in the background ignores
    end, rounds, settled, lost = time.monotonic() + 60 * asked.minutes, 0, 0.0, 0
    with tempfile.TemporaryDirectory() as folder:
        for name in READERS:  # the libraries that each kind of file needs are loaded before memory is measured
            WRITERS[name](Path(folder) / name)
            READERS[name][1](Path(folder) / name)
        while time.monotonic() < end:
            seed = asked.seed + rounds
            try:
                loops(seed)
                files(seed, Path(folder))
                interrupt(seed)
            except Exception as error:
                lost += 1
                sys.stdout.write(f"seed {seed}: {type(error).__name__}: {error}\n")
            rounds += 1
            settled = resident() if rounds == _SETTLED else settled
    growth = resident() - settled if settled else 0.0
    sys.stdout.write(f"seeds {asked.seed} to {asked.seed + rounds - 1}: {lost} lost, memory grew by {growth:.1f} MB\n")
    return int(lost > 0 or growth > _GROWTH)


if __name__ == "__main__":
    sys.exit(main())
