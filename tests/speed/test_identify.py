"""EDMD against the bare accumulation of its Gram matrix, and its memory."""

import time
import tracemalloc

import numpy as np
import pytest

from koopmpc.data.episodes import Episode, Episodes
from koopmpc.identify.chunks import ROWS
from koopmpc.identify.edmd import edmd
from koopmpc.identify.moments import moments
from koopmpc.lifting.state import State

pytestmark = pytest.mark.speed

NX = 100  # on State() these are 100 observables


def data(snapshots: int, steps: int = 5000) -> Episodes:
    """Episodes of `steps` steps each, together `snapshots` pairs: copies of at most 20, which fill no cache."""
    rng = np.random.default_rng(0)
    count = snapshots // steps
    some = [
        Episode(X=rng.standard_normal((steps + 1, NX)), U=rng.standard_normal((steps, 1)))
        for _ in range(min(count, 20))
    ]
    return Episodes([some[i % len(some)] for i in range(count)], 0.1)


def bare(chunks: list[np.ndarray], snapshots: int) -> float:
    """Return the seconds of Σ DᵀD over rows [ψ u ψ⁺] that are lifted already and laid out side by side."""
    start = time.perf_counter()
    total = np.zeros((2 * NX + 1, 2 * NX + 1))
    for k in range(snapshots // ROWS):
        D = chunks[k % len(chunks)]
        total += D.T @ D
    return time.perf_counter() - start


def test_edmd_of_a_million_snapshots(benchmark) -> None:
    snapshots = 1_000_000
    episodes = data(snapshots)
    rng = np.random.default_rng(1)
    chunks = [rng.standard_normal((ROWS, 2 * NX + 1)) for _ in range(64)]
    pairs: list[tuple[float, float]] = []

    def both() -> None:
        start = time.perf_counter()
        edmd(episodes, State())
        pairs.append((time.perf_counter() - start, bare(chunks, snapshots)))

    benchmark.pedantic(both, rounds=5, warmup_rounds=1)
    ours, gram = np.median(pairs, axis=0)
    benchmark.extra_info |= {
        "edmd [s]": round(float(ours), 3),
        "bare Gram [s]": round(float(gram), 3),
        "ratio to bare Gram (≤ 2)": round(float(np.median([a / b for a, b in pairs])), 2),
    }
    print(dict(benchmark.extra_info))  # noqa: T201


@pytest.mark.parametrize("route", ["gram", "qr"])
def test_memory_does_not_grow_with_the_snapshots(benchmark, route: str) -> None:
    peaks: dict[str, float] = {}

    def measure() -> None:
        for snapshots in (20_000, 200_000):
            episodes = data(snapshots)
            tracemalloc.start()
            moments(episodes, State(), route=route)
            peaks[f"peak at {snapshots} [MB]"] = round(tracemalloc.get_traced_memory()[1] / 1e6, 2)
            tracemalloc.stop()

    benchmark.pedantic(measure, rounds=1)
    benchmark.extra_info |= peaks
    print(dict(benchmark.extra_info))  # noqa: T201
    small, large = peaks.values()
    assert large < 1.1 * small
