"""Recording: at least a million scalars a second, at most 12 bytes each; a call to a Recorder costs microseconds."""

from pathlib import Path
from typing import Any

import pytest

import koopmpc as km
from tests.views.runs import about, make_run, steps_of

pytestmark = pytest.mark.speed


def test_record(benchmark: Any, tmp_path: Path) -> None:
    run = make_run(nx=20, T=10_000, N=None, noisy=False)
    path = tmp_path / "run.rrd"
    benchmark.pedantic(km.record, args=(run, path), rounds=7, warmup_rounds=1)
    scalars = run.X.size + run.reference.size + run.U.size + run.solve_time.size + run.iterations.size
    rate, size = scalars / benchmark.stats["median"] / 1e6, path.stat().st_size / scalars
    benchmark.extra_info |= {"million scalars/s": rate, "bytes a scalar": size}
    print(f"\nrecord: {rate:.2f} million scalars/s (target 1), {size:.2f} bytes a scalar (target 12)")  # noqa: T201


def test_load_run(benchmark: Any, tmp_path: Path) -> None:
    run = make_run(nx=20, T=10_000, N=None, noisy=False)
    km.record(run, tmp_path / "run.rrd")
    assert benchmark.pedantic(km.load_run, args=(tmp_path / "run.rrd",), rounds=5, warmup_rounds=1) == run


def test_recorder_call(benchmark: Any, tmp_path: Path) -> None:
    run = make_run(nx=4, T=2000, N=40)
    steps = iter(steps_of(run))
    with km.Recorder(tmp_path / "run.rrd", **about(run)) as recorder:
        benchmark.pedantic(recorder, setup=lambda: ((next(steps),), {}), rounds=2000)
    print(f"\nRecorder: {1e6 * benchmark.stats['median']:.1f} µs a call")  # noqa: T201
