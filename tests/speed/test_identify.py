"""Moments against the bare accumulation of their Gram matrix; their memory; few episodes and many; two workers."""

import gc
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import koopmpc as km

pytestmark = pytest.mark.speed

NX = 100  # on State() these are 100 observables
ROWS = 1023  # snapshot pairs of a block, with the last state 1024 rows: a plain Gram of the same cache


def data(snapshots: int, steps: int = 5000) -> km.Episodes:
    """Episodes of `steps` steps each, together `snapshots` pairs: copies of at most 20, which fill no cache."""
    rng = np.random.default_rng(0)
    count = snapshots // steps
    some = [
        km.Episode(X=rng.standard_normal((steps + 1, NX)), U=rng.standard_normal((steps, 1)))
        for _ in range(min(count, 20))
    ]
    return km.Episodes([some[i % len(some)] for i in range(count)], 0.1)


def bare(chunks: list[np.ndarray], snapshots: int) -> float:
    """Return the seconds of Σ DᵀD over rows [ψ u ψ⁺] that are lifted already and laid out side by side."""
    start = time.process_time()
    total = np.zeros((2 * NX + 1, 2 * NX + 1))
    for k in range(snapshots // ROWS):
        D = chunks[k % len(chunks)]
        total += D.T @ D
    return time.process_time() - start


def told(benchmark) -> None:
    print(dict(benchmark.extra_info))  # noqa: T201


@pytest.mark.parametrize(("route", "limit"), [("gram", 1.5), ("qr", 10)])
def test_moments_of_a_million_snapshots(benchmark, route: str, limit: float) -> None:
    snapshots = 1_000_000
    episodes = data(snapshots)
    rng = np.random.default_rng(1)
    chunks = [rng.standard_normal((ROWS, 2 * NX + 1)) for _ in range(64)]
    pairs: list[tuple[float, float]] = []

    def both() -> None:
        start = time.process_time()
        if route == "gram":
            km.edmd(episodes, km.State())  # which chooses Gram here
        else:
            km.moments.second_moments(episodes, km.State(), route="qr")
        pairs.append((time.process_time() - start, bare(chunks, snapshots)))

    benchmark.pedantic(both, rounds=5, warmup_rounds=1)
    ours, gram = np.median(pairs, axis=0)
    benchmark.extra_info |= {
        f"{'edmd' if route == 'gram' else 'qr'} [s]": round(float(ours), 3),
        "bare Gram [s]": round(float(gram), 3),
        f"ratio to bare Gram (≤ {limit:g})": round(float(np.median([a / b for a, b in pairs])), 2),
    }
    told(benchmark)


@pytest.mark.parametrize("route", ["gram", "qr"])
def test_memory_does_not_grow_with_the_snapshots(benchmark, route: str) -> None:
    hold_memory(benchmark, route, {count: partial(data, count) for count in (20_000, 1_000_000)})


def hold_memory(benchmark, route: str, sources: dict[int, Callable[[], Any]]) -> None:
    """Measure the memory that the moments of sources of so many rows take, and hold that it does not grow."""
    peaks: dict[str, float] = {}

    def measure() -> None:
        for count, make in sources.items():
            source = make()
            gc.collect()
            tracemalloc.start()
            km.moments.second_moments(source, km.State(), route=route)
            peaks[f"extra at {count} [MB]"] = round(tracemalloc.get_traced_memory()[1] / 1e6, 2)
            tracemalloc.stop()

    benchmark.pedantic(measure, rounds=1)
    benchmark.extra_info |= peaks
    told(benchmark)
    small, large = peaks.values()
    assert large < 1.1 * small
    assert large < 64


@pytest.mark.parametrize("route", ["gram", "qr"])
def test_a_stream_of_ten_million_rows_needs_no_memory_of_its_own(benchmark, route: str) -> None:
    rng = np.random.default_rng(0)
    one = km.Episodes([km.Episode(X=rng.standard_normal((20_001, 3))) for _ in range(5)], 0.1)
    streams = {sets * 100_000: lambda sets=sets: km.data.Stream(one for _ in range(sets)) for sets in (10, 100)}
    hold_memory(benchmark, route, streams)


def test_five_thousand_episodes_cost_what_a_hundred_do(benchmark) -> None:
    rng = np.random.default_rng(0)
    sets = {
        count: km.Episodes(
            [
                km.Episode(
                    X=rng.standard_normal((100_000 // count + 1, NX)),
                    U=rng.standard_normal((100_000 // count, 1)),
                )
                for _ in range(count)
            ],
            0.1,
        )
        for count in (100, 1000, 5000)
    }
    seconds: dict[int, list[float]] = {count: [] for count in sets}

    def every() -> None:
        for count, episodes in sets.items():
            start = time.process_time()
            km.edmd(episodes, km.State())
            seconds[count].append(time.process_time() - start)

    benchmark.pedantic(every, rounds=7, warmup_rounds=1)
    best = {count: min(own) for count, own in seconds.items()}
    benchmark.extra_info |= {f"{count} episodes [s]": round(own, 3) for count, own in best.items()}
    benchmark.extra_info["5000 episodes / 100"] = round(best[5000] / best[100], 2)
    told(benchmark)


@contextmanager
def cluster(workers: int) -> Iterator[str]:
    """Yield the address of a cluster like that of scheduler="local", so that its start is not timed."""
    dask, distributed = pytest.importorskip("dask"), pytest.importorskip("distributed")
    alone = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    with (
        dask.config.set({"distributed.nanny.pre-spawn-environ": alone}),
        distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, host="127.0.0.1", processes=True, dashboard_address="127.0.0.1:0"
        ) as made,
    ):
        yield made.scheduler_address


def test_two_dask_workers_against_one(benchmark, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for i in range(12):
        episode = km.Episode(X=rng.standard_normal((240_001, 8)), U=rng.standard_normal((240_000, 1)))
        km.Episodes([episode], 0.1).save(tmp_path / f"{i:02}.npz")
    lifting = km.State() + km.Gaussian(rng.standard_normal((92, 8)), 2.0)
    source, pairs = km.data.Files(tmp_path), []

    with cluster(1) as one, cluster(2) as two:
        where = ({"scheduler": one}, {"scheduler": two})

        def both() -> None:
            seconds: list[float] = []
            for how in where:
                start = time.perf_counter()
                km.moments.second_moments(source, lifting, route="gram", **how)
                seconds.append(time.perf_counter() - start)
            pairs.append(seconds)

        benchmark.pedantic(both, rounds=4, warmup_rounds=1)
    best_one, best_two = np.min(pairs[1:], axis=0)
    benchmark.extra_info |= {
        "one worker [s]": round(float(best_one), 2),
        "two workers [s]": round(float(best_two), 2),
        "one / two (≥ 1.7)": round(float(np.median([a / b for a, b in pairs[1:]])), 2),
    }
    told(benchmark)


def plain_gram(episodes: km.Episodes, lifting: km.Lifting) -> np.ndarray:
    """Return K of EDMD as a numpy script has it: each row lifted once, Σ DᵀD, and one solve on unit-norm columns."""
    bound = lifting.bind(episodes.states)
    n = bound.nz + episodes.nu
    G = np.zeros((n + bound.nz, n + bound.nz))
    for episode in episodes:
        for k in range(0, len(episode), ROWS):
            Z = bound(episode.X[k : k + ROWS + 1])
            D = np.hstack([Z[:-1], episode.U[k : k + ROWS], Z[1:]])
            G += D.T @ D
    size = np.sqrt(G.diagonal()[:n])
    return np.linalg.lstsq(G[:n, :n] / np.outer(size, size), G[:n, n:] / size[:, None], rcond=None)[0] / size[:, None]


@pytest.mark.parametrize(("observables", "limit"), [(34, 1.15), (104, 1.05)])
@pytest.mark.parametrize("count", [20, 500])
def test_edmd_over_a_plain_gram_that_lifts_each_row_once(benchmark, observables: int, limit: float, count: int) -> None:
    rng = np.random.default_rng(0)
    steps = 100_000 // count
    episodes = km.Episodes(
        [km.Episode(X=rng.uniform(-1, 1, (steps + 1, 4)), U=rng.uniform(-1, 1, (steps, 1))) for _ in range(count)], 0.1
    )
    lifting = km.State() + km.Gaussian(rng.uniform(-1, 1, (observables - 4, 4)), 0.3)
    assert km.moments.second_moments(episodes, lifting).route == "gram"
    pairs: list[tuple[float, float]] = []

    def both() -> None:
        start = time.process_time()
        km.edmd(episodes, lifting)
        middle = time.process_time()
        plain_gram(episodes, lifting)
        pairs.append((middle - start, time.process_time() - middle))

    benchmark.pedantic(both, rounds=9, warmup_rounds=1)
    ours, plain = np.median(pairs, axis=0)
    benchmark.extra_info |= {
        "edmd [s]": round(float(ours), 3),
        "plain Gram [s]": round(float(plain), 3),
        f"edmd / plain Gram (≤ {limit:g})": round(float(np.median([a / b for a, b in pairs])), 2),
    }
    told(benchmark)


def scan_by_pyarrow(files: list[Path]) -> None:
    """Read all batches."""
    dataset: Any = import_module("pyarrow.dataset")
    for _ in dataset.dataset([str(file) for file in files]).to_batches():
        pass


def scan_by_duckdb(files: list[Path]) -> None:
    """Sum all columns."""
    duckdb: Any = import_module("duckdb")
    duckdb.sql("SET threads = 1")
    duckdb.sql(f"SELECT sum(COLUMNS(*)) FROM read_parquet({[str(file) for file in files]})").fetchall()


def scan_by_polars(files: list[Path]) -> None:
    """Sum all columns."""
    polars: Any = import_module("polars")
    polars.scan_parquet(files).sum().collect()


SCANS = {"pyarrow": scan_by_pyarrow, "duckdb": scan_by_duckdb, "polars": scan_by_polars}


def test_rows_a_second_from_parquet_files(benchmark, tmp_path: Path) -> None:
    """34 observables of three states, from files, beside Gram matrices of rows in memory and scans of the same files."""
    rng, parts = np.random.default_rng(0), 4
    for i in range(parts):
        episodes = [km.Episode(X=rng.uniform(-1, 1, (10_001, 3)), U=rng.uniform(-1, 1, (10_000, 1))) for _ in range(25)]
        km.Episodes(episodes, 0.1).save(tmp_path / f"{i}.parquet")
    lifting = km.State() + km.Constant() + km.Gaussian(rng.uniform(-1, 1, (30, 3)), 1.0)
    files, bound = km.data.Files(sorted(tmp_path.glob("*.parquet"))), lifting.bind(("x0", "x1", "x2"))
    pairs: list[tuple[float, float]] = []

    def both() -> None:
        start = time.process_time()
        count = km.moments.second_moments(files, lifting, route="gram", workers=1).samples
        ours, start = count / (time.process_time() - start), time.process_time()
        for one in episodes:
            Z = bound(one.X)
            D = np.hstack([Z[:-1], one.U, Z[1:]])
            D.T @ D
        pairs.append((ours, sum(map(len, episodes)) / (time.process_time() - start)))

    benchmark.pedantic(both, rounds=3, warmup_rounds=1)
    ours, plain = np.median(pairs, axis=0)
    every = sorted(tmp_path.glob("*.parquet"))
    for name, scan in SCANS.items():
        if find_spec(name) is None:
            continue
        spent: list[float] = []
        for _ in range(4):
            start = time.process_time()
            scan(every)
            spent.append(time.process_time() - start)
        benchmark.extra_info[f"{name} [rows/s]"] = round(parts * sum(map(len, episodes)) / float(np.median(spent[1:])))
    benchmark.extra_info |= {
        "from files [rows/s]": round(float(ours)),
        "numpy, in memory [rows/s]": round(float(plain)),
    }
    told(benchmark)
