"""What a Dask cluster would do with parts of files: `python -m tests.speed.figures.cluster [WORKERS …]`.

It measures the bytes of a task and of its result, and the CPU time that scheduler and client spend on one, with two
workers here; then it simulates more workers, for which one scheduler does that work one task after the other.
"""

import heapq
import pickle
import sys
import tempfile
import time

import numpy as np

import koopmpc as km
from koopmpc.base.parallel import Workers
from koopmpc.models.moments.read import _ReadTask, read_part, source_of

PART, PARTS, TASKS = 0.91, 1000, 200  # CPU time of 1e6 pairs with 34 observables [s], parts, tasks that are timed


def answer(task: int) -> tuple[np.ndarray, int, float]:
    """Return as many bytes as the sums of a part."""
    return np.zeros((69, 69)), task, 1.0


def count_bytes() -> tuple[int, int]:
    """Return the bytes of a task and of its result: 3 states, 1 input, 34 observables."""
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        episode = km.Episode(X=rng.normal(size=(1001, 3)), U=rng.normal(size=(1000, 1)))
        km.Episodes([episode], 0.1, tuple("abc"), ("u",)).save(f"{folder}/part.parquet")
        lifting = (km.State() + km.Gaussian(rng.normal(size=(30, 3)), 1.0) + km.Constant()).bind(tuple("abc"))
        (part,) = source_of(km.data.Files(folder)).parts()
        task = _ReadTask(part, lifting, ("u",), False, None)
        return len(pickle.dumps(task)), len(pickle.dumps(read_part(task)))


def time_task() -> float:
    """Return the CPU time [s] that scheduler and client, both in this process, spend on a task."""
    with Workers(2, "local") as pool:
        pool.map(answer, range(10))
        start = time.process_time()
        pool.map(answer, range(TASKS))
        return (time.process_time() - start) / TASKS


def simulate_time(workers: int, spent: float) -> float:
    """Return when the last of `PARTS` parts is done [s]; the scheduler gives out one each `spent` seconds."""
    free, now = [0.0] * workers, 0.0
    for _ in range(PARTS):
        now = max(now + spent, heapq.heappop(free))
        heapq.heappush(free, now + PART)
    return max(free)


def main() -> None:
    """Print the table."""
    sent, back = count_bytes()
    spent = time_task()
    sys.stdout.write(f"a task {sent} bytes, its result {back}, {1e3 * spent:.2f} ms of scheduler and client\n")
    for workers in map(int, sys.argv[1:] or (1, 10, 50, 100, 200)):
        lasts = simulate_time(workers, spent)
        sys.stdout.write(f"{workers} workers: {lasts:.1f} s, {PARTS * PART / lasts:.1f} times one\n")


if __name__ == "__main__":
    main()
