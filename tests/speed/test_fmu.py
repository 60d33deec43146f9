"""A step of a co-simulation unit, beside the same calls in a loop of FMPy's own."""

from time import perf_counter

import numpy as np
import pytest

import koopmpc as km
from tests.plants import units

fmpy = pytest.importorskip("fmpy", reason="the extra fmu is not installed")


@pytest.mark.speed
def test_a_step_takes_at_most_twice_as_long_as_in_fmpys_own_loop(tmp_path):
    pendulum = units.build_pendulum(tmp_path / "pendulum.fmu")
    unit = km.plants.fmu(pendulum, interface="co-simulation", dt=0.001)
    raw = fmpy.instantiate_fmu(fmpy.extract(str(pendulum)), fmpy.read_model_description(str(pendulum)), "CoSimulation")
    raw.setupExperiment(startTime=0.0)
    raw.enterInitializationMode()
    raw.exitInitializationMode()
    unit.reset(None)
    u, steps, times = np.array([1.0]), 2000, []
    for _ in range(5):
        begin = perf_counter()
        for k in range(steps):
            raw.setReal([3], [1.0])
            raw.doStep(k * 0.001, 0.001)
            raw.getReal([0])
        between = perf_counter()
        for _ in range(steps):
            unit.step(u)
        times.append((between - begin, perf_counter() - between))
    own, ours = np.min(times, axis=0)
    assert ours < 2 * own, f"FMPy {1e6 * own / steps:.1f} µs, koopmpc {1e6 * ours / steps:.1f} µs a step"
