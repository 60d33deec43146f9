"""A new model between two steps: `update` of the linear and of the bilinear controller, against making them anew."""

import sys
from time import perf_counter

import numpy as np
import pytest

import koopmpc as km

pytestmark = pytest.mark.speed
NX, N, PAIRS = 11, 40, 30


def model(seed: int) -> km.LinearPredictor:
    """Return a random stable plant of eleven states beside a Constant: nz = 12, one input."""
    rng = np.random.default_rng(seed)
    A = np.eye(NX) + 0.1 * rng.standard_normal((NX, NX))
    whole, B = np.eye(NX + 1), np.zeros((NX + 1, 1))
    whole[:NX, :NX] = A / max(1, np.abs(np.linalg.eigvals(A)).max() / 0.98)
    B[:NX] = 0.1 * rng.standard_normal((NX, 1))
    states = tuple(f"x{i}" for i in range(NX))
    return km.LinearPredictor(whole, B, np.eye(NX, NX + 1), km.State() + km.Constant(), 0.02, states, ("u",))


@pytest.mark.parametrize("kind", [km.KoopmanMPC, km.BilinearMPC])
def test_update(benchmark, kind):
    models, cost, limits = (model(0), model(1)), km.Cost(Q=1, R=0.1), km.Limits(-1, 1)
    mpc, x, r = kind(models[0], cost, limits, N), np.full(NX, 0.1), np.zeros(NX)
    times: tuple[list[float], list[float], list[float]] = ([], [], [])
    for k in range(PAIRS):
        started = perf_counter()
        mpc.update(models[(k + 1) % 2])
        updated = perf_counter()
        mpc(x, r)
        stepped = perf_counter()
        if k % 10 == 0:
            begun = perf_counter()
            kind(models[k % 2], cost, limits, N)
            times[2].append(perf_counter() - begun)
        times[0].append(updated - started)
        times[1].append(stepped - updated)
    update, step, new = (1e3 * float(np.median(each)) for each in times)
    figures = {"update ms": update, "step after it ms": step, "anew ms": new, "update to anew": update / new}
    benchmark.extra_info.update(figures)
    sys.stdout.write(
        f"\n{benchmark.name}: " + ", ".join(f"{name} {value:.4g}" for name, value in figures.items()) + "\n"
    )
    benchmark(mpc.update, models[1])
