"""OnlineEDMD: one update, a block of them, and the predictor that a controller takes."""

import time

import numpy as np
import pytest

import koopmpc as km

pytestmark = pytest.mark.speed

SIZES = {14: (km.State() + km.Monomials(2) + km.Constant(), 3, 4), 104: (km.State() + km.Constant(), 100, 3)}  # nz + nu


def learner(width: int, **options: float) -> tuple[km.OnlineEDMD, np.ndarray, np.ndarray]:
    """Return one that has learned from some data, and these data."""
    lifting, nx, nu = SIZES[width]
    states, inputs = [f"x{i}" for i in range(nx)], [f"u{i}" for i in range(nu)]
    online = km.OnlineEDMD(lifting, dt=0.1, states=states, inputs=inputs, **options)
    rng = np.random.default_rng(0)
    X, U = rng.standard_normal((4001, nx)), rng.standard_normal((4000, nu))
    online.learn(X[:-1], U, X[1:])
    return online, X, U


@pytest.mark.parametrize("width", SIZES)
@pytest.mark.parametrize("options", [{"forgetting": 0.999}, {"window": 2000}], ids=["forgetting", "window"])
def test_updates(benchmark, width: int, options: dict[str, float]) -> None:
    online, X, U = learner(width, **options)
    singles: list[float] = []
    blocks: list[float] = []
    fits: list[float] = []

    def run() -> None:
        start = time.perf_counter()
        for k in range(2000):
            online.learn(X[k], U[k], X[k + 1])
        middle = time.perf_counter()
        online.learn(X[:-1], U, X[1:])
        later = time.perf_counter()
        for _ in range(5):
            online.predictor()
        singles.append((middle - start) / 2000)
        blocks.append((later - middle) / 4000)
        fits.append((time.perf_counter() - later) / 5)

    benchmark.pedantic(run, rounds=7, warmup_rounds=1)
    benchmark.extra_info |= {
        "one update [us]": round(1e6 * float(np.median(singles)), 1),
        "a pair of a block of 4000 [us]": round(1e6 * float(np.median(blocks)), 1),
        "predictor [ms]": round(1e3 * float(np.median(fits)), 2),
    }
    print(width, options, dict(benchmark.extra_info))  # noqa: T201


@pytest.mark.parametrize("width", SIZES)
def test_the_longest_single_update(benchmark, width: int) -> None:
    peaks: dict[str, float] = {}

    def measure() -> None:
        for name, options in (("forgetting", {"forgetting": 0.999}), ("window", {"window": 2000})):
            online, X, U = learner(width, **options)
            times = np.empty(6000)
            for k in range(6000):
                start = time.perf_counter()
                online.learn(X[k % 4000], U[k % 4000], X[k % 4000 + 1])
                times[k] = time.perf_counter() - start
            peaks[f"{name}: p99 [us]"] = round(1e6 * float(np.quantile(times, 0.99)), 1)
            peaks[f"{name}: p99.9 [us]"] = round(1e6 * float(np.quantile(times, 0.999)), 1)

    benchmark.pedantic(measure, rounds=1)
    benchmark.extra_info |= peaks
    print(width, dict(benchmark.extra_info))  # noqa: T201
