"""Files of every kind that the library writes, ways to damage them, and a disk that is full."""

import resource
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

import koopmpc as km
from koopmpc.bench.store import Journal, RunRow, record_of, write_results
from koopmpc.page import Curves, Page
from koopmpc.recording.curves import record_curves
from koopmpc.synthesis.designed import SavedDesign, read_controller
from tests.recording.runs import make_run
from tests.synthesis.test_design import usual


def episodes(seed: int = 0, steps: int = 30) -> km.Episodes:
    """Return a few random walks; a state has the name of time, so that a table of them might pass for a plain one."""
    rng = np.random.default_rng(seed)
    made = [
        km.Episode(X=0.1 * rng.standard_normal((steps + i, 3)).cumsum(0), U=rng.standard_normal((steps + i - 1, 2)))
        for i in range(4)
    ]
    return km.Episodes(made, 0.1, ["t [s]", "x [m]", "v [m/s]"], ["u [N]", "f"])


def model(seed: int = 0) -> km.LinearPredictor:
    """Return a model of these walks whose file is some kilobytes long."""
    data, rng = episodes(seed), np.random.default_rng(seed)
    return km.edmd(data, km.State() + km.Constant() + km.Gaussian(rng.standard_normal((12, 3)), 1.0))


def controller() -> km.KoopmanMPC:
    """Return a controller on this model, with limits and an estimator."""
    cost, limits = km.Cost(Q=[1.0, 1.0, 0.1], R=0.1, R_delta=0.2), km.Limits(u_min=-1, u_max=1, x_max=[2.0, 2.0, 3.0])
    return km.KoopmanMPC(model(), cost, limits, 6, estimator=km.LiftedDisturbance(), latency=1, moves=3)


def saved(path: Path) -> Any:
    """Return what is in the file of a controller or a design, of which a controller was made."""
    km.load_controller(path)
    return read_controller(path)


@cache
def rows() -> list[RunRow]:
    """Return the rows of a sweep."""
    figures = km.metrics(make_run(T=30))
    return [RunRow("plant", f"case {i}", "lqr", figures, x0=(0.1 * i, -1.0)) for i in range(20)]


def texts(rows: Iterable[RunRow]) -> list[str]:
    """Return all that the rows hold."""
    return [repr(record_of(row)) for row in rows]


def journal(path: Path) -> None:
    """Write the lines of these runs, as they end."""
    with Journal(path) as lines:
        for row in rows():
            lines.turn(row, None)


def results(path: Path) -> None:
    write_results([RunRow("plant", f"case {i}", "lqr", failure="none") for i in range(40)], path)


def report(path: Path) -> None:
    page = Page(path.parent)
    page.text("# Report", "words " * 2000)
    page.write(path.name)


def figure(path: Path) -> None:
    made, axes = plt.subplots()
    axes.plot([0, 1], [0, 1])
    try:
        km.plot.save(made, path)
    finally:
        plt.close(made)


def recorded(path: Path) -> None:
    """Write a log while its loop runs."""
    from tests.recording.runs import about, steps_of

    run = make_run(T=60)
    with km.Recorder(path, **about(run)) as recorder:
        for step in steps_of(run):
            recorder(step)


def curves(path: Path) -> None:
    X = np.random.default_rng(0).standard_normal((500, 2))
    record_curves([Curves("tab", 0.1, ("a", "b"), {"one": X})], path, application="test", page="words")


WRITERS: dict[str, Callable[[Path], Any]] = {
    "model.npz": lambda path: model().save(path),
    "controller.npz": lambda path: controller().save(path),
    "design.npz": lambda path: usual().save(path),
    "episodes.npz": lambda path: episodes().save(path),
    "episodes.csv": lambda path: episodes().save(path),
    "episodes.parquet": lambda path: episodes().save(path),
    "run.rrd": lambda path: km.record(make_run(T=60), path),
    "model.rrd": lambda path: km.recording.record_model(model(), episodes(1), path, horizon=5),
    "curves.rrd": curves,
    "results.parquet": results,
    "report.md": report,
    "figure.png": figure,
    "figure.pdf": figure,
    "figure.svg": figure,
}
"""What writes each kind of file."""

READERS: dict[str, tuple[Callable[[], Any], Callable[[Path], Any]]] = {
    "model.npz": (model, km.load_model),
    "controller.npz": (lambda: controller().as_data(), saved),
    "design.npz": (lambda: SavedDesign(usual().controller.as_data(), usual().evidence), saved),
    "episodes.npz": (episodes, km.load_episodes),
    "episodes.parquet": (episodes, km.load_episodes),
    "run.rrd": (lambda: make_run(T=60), km.load_run),
    "rows.jsonl": (lambda: texts(rows()), lambda path: texts(Journal(path).rows.values())),
}
"""Each kind of file that is read: what was written, and what reads it."""


@contextmanager
def room_for(size: int) -> Generator[None]:
    """Let no file grow beyond `size` bytes: the system refuses the next byte, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
