"""Free-run errors of our models on records: what `koopmpc fit` and `km.select` make without options, and the yardsticks."""

import subprocess
import sys
import tempfile
import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import koopmpc as km
from tests.real.records import RECORDS, Record
from tests.real.twins import TWINS
from tests.real.yardsticks import YARDSTICKS

SEEDS = (0, 1, 2)
HORIZON = 20  # steps ahead of the short forecast, those of a controller
OURS = ("fit", "select", "select linear", "select bilinear")
KNOWING = "true structure"  # the twin's own equations, fitted by simulation error


@dataclass(frozen=True)
class Entry:
    """One model on one record, the worst of the seeds.

    Attributes
    ----------
    free
        Root-mean-square error of the free run over the test part.
    ahead
        The same over forecasts of 20 steps, which begin at every tenth row; NaN for a yardstick.
    seconds
        Time to find the model.
    diverged
        The free run left ten ranges of the learning part.
    failure
        The first exception, where there was one.
    """

    free: float
    ahead: float = float("nan")
    seconds: float = 0.0
    diverged: bool = False
    failure: str = ""


Table = dict[str, dict[str, Entry]]  # record → model → entry


def names() -> list[str]:
    """Return the names of all records and twins."""
    return [*RECORDS, *TWINS]


def records_of(name: str) -> list[Record]:
    """Return the record of a name; of a twin one for each seed."""
    return [RECORDS[name]()] if name in RECORDS else [TWINS[name].record(seed) for seed in SEEDS]


def free_run(model: km.LinearPredictor | km.BilinearPredictor, test: Record, relift: bool) -> np.ndarray:
    """Return the outputs of a model over the test part, which begins at the rows that are known.

    Row k of the inputs acts on row k + 1, or on row k where the model's inputs are one row up. Of a model whose past is
    longer than the known rows least squares over these finds the start.
    """
    past, told = (0 if model.embedding is None else model.embedding.steps), test.U_test[model.input_lead :]
    Y, U = test.Y_test[: test.known], told[: test.known - 1]
    if past > len(U):
        start = km.identify.estimate_start(model, Y, U)
    else:
        start = model.start(Y[-1], km.Episode(X=Y, U=U)) if past else Y[-1]
    ahead = told[test.known - 1 : len(test.Y_test) - 1]
    with np.errstate(all="ignore"):
        X = model.step_map().rollout(start, ahead)[:, : model.nx] if relift else model.rollout(start, ahead)
    return np.vstack([Y, X[1:]])


def has_diverged(test: Record, Y: np.ndarray) -> bool:
    """Return whether a free run leaves the measured outputs by ten ranges of the learning part, or all numbers."""
    error = test.error(Y)
    gap = np.abs(Y - test.Y_test).max() if len(test.outputs) == 1 else error
    return not np.isfinite(error) or bool(gap > test.diverged)


def _entry(model: km.LinearPredictor | km.BilinearPredictor, test: Record, seconds: float) -> Entry:
    """Judge a model as its controller uses it: KoopmanMPC lifts once, BilinearMPC at each step."""
    relift = isinstance(model, km.BilinearPredictor)
    Y = free_run(model, test, relift)
    free = test.error(Y)
    episode = km.Episodes(
        [km.Episode(X=test.Y_test, U=test.U_test[:-1])], test.dt, model.states, model.inputs
    )  # fmt: skip
    episode = model.align(episode)
    ahead = km.score(model, episode, HORIZON, stride=10, relift=relift).rmse
    scale = test.Y_test.std(axis=0) if len(test.outputs) > 1 else 1.0
    return Entry(free, float(np.sqrt(np.mean((ahead / scale) ** 2))), seconds, has_diverged(test, Y))


def _select(record: Record) -> dict[str, Entry]:
    data = km.Episodes(
        [km.Episode(X=record.Y_learn, U=record.U_learn[:-1])], record.dt, record.outputs, record.inputs
    )  # fmt: skip
    begun = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", km.FitWarning)
        found = km.select(data)
    seconds = time.perf_counter() - begun
    models = {"select": found.predictor, "select linear": found.linear, "select bilinear": found.bilinear}
    return {which: _entry(model, record, seconds) for which, model in models.items() if model is not None}


def _fit(record: Record) -> Entry:
    """Run `koopmpc fit` as a new user does, with the names of the columns."""
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "record.csv"
        columns = ("t [s]", *record.inputs, *record.outputs)
        time_column = np.arange(len(record.U_learn))[:, None] * record.dt
        rows = np.hstack([time_column, record.U_learn, record.Y_learn])
        lines = [",".join(columns), *(",".join(f"{value:.10g}" for value in row) for row in rows)]
        table.write_text("\n".join(lines) + "\n")
        begun = time.perf_counter()
        told = ["--states", ",".join(record.outputs), "--inputs", ",".join(record.inputs), "--logs", folder]
        ended = subprocess.run(
            [sys.executable, "-m", "koopmpc", "fit", str(table), *told], capture_output=True, text=True
        )
        seconds = time.perf_counter() - begun
        written = sorted(Path(folder).rglob("model.npz"))
        if not written:
            return Entry(float("inf"), seconds=seconds, diverged=True, failure=ended.stderr.strip()[-200:])
        return _entry(km.load_model(written[0]), record, seconds)


def _yardstick(which: str, record: Record) -> Entry | None:
    begun = time.perf_counter()
    Y = YARDSTICKS[which](record)
    if Y is None:
        return None
    return Entry(record.error(Y), seconds=time.perf_counter() - begun, diverged=has_diverged(record, Y))


def worst(entries: list[Entry]) -> Entry:
    """Return the worst free run, the worst short forecast and the longest time of several seeds."""
    return Entry(
        max(entry.free for entry in entries),
        max(entry.ahead for entry in entries),
        max(entry.seconds for entry in entries),
        any(entry.diverged for entry in entries),
        next((entry.failure for entry in entries if entry.failure), ""),
    )


def measure(name: str, which: tuple[str, ...]) -> dict[str, Entry]:
    """Return the entries of the models `which` on one record or twin: `OURS`, `YARDSTICKS` and the true structure."""
    found: dict[str, list[Entry]] = {}
    for seed, record in enumerate(records_of(name)):
        if "fit" in which:
            found.setdefault("fit", []).append(_fit(record))
        if "select" in which:
            for model, entry in _select(record).items():
                found.setdefault(model, []).append(entry)
        for yardstick in YARDSTICKS:
            if yardstick in which and (entry := _yardstick(yardstick, record)) is not None:
                found.setdefault(yardstick, []).append(entry)
        if KNOWING in which and name in TWINS:
            begun = time.perf_counter()
            Y = TWINS[name].knowing(record, np.random.default_rng(seed))
            found.setdefault(KNOWING, []).append(Entry(record.error(Y), seconds=time.perf_counter() - begun))
    return {model: worst(entries) for model, entries in found.items()}
