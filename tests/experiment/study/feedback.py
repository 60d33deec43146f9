"""Identification under feedback: bias and variance of least squares, instruments and the direct method on linear loops."""

from dataclasses import dataclass

import numpy as np

import koopmpc as km
from tests.identify.test_instruments import run_loop

LENGTHS = (500, 2000, 8000)  # rows of a record
RECORDS = 100
SENSOR = 0.1  # noise of each sensor, as a share of its state's spread in the loop
PROCESS = 0.05  # process noise, as a share of the same
SLOWEST = 0.97  # spectral radius of a loop; slower ones are drawn again
LEVEL = 0.01  # of the test that keeps least squares
WAYS = ("least squares", "instruments", "direct")

Records = list[tuple[km.Episodes, list[np.ndarray]]]


@dataclass(frozen=True)
class Biases:
    """What the fits of one linear plant under a PI controller are off by.

    Attributes
    ----------
    bias
        ‖mean of [A B] over 100 records − truth‖ by number of rows, of each of the three ways, with noisy sensors.
    bound
        Three standard errors of these means.
    variance
        Variance over that of least squares with process noise alone, of instruments with the test and of the direct
        method.
    refused
        Of 20 records with a constant set point, those that instruments, and the direct method, do not identify.
    left
        Of the 100 records with a moving one, those that a way calls not identifiable, by number of rows.
    """

    bias: dict[str, list[float]]
    bound: dict[str, list[float]]
    variance: list[float]
    refused: list[int]
    left: dict[str, list[int]]


@dataclass(frozen=True, eq=False)
class Loop:
    """A linear plant, gains of a PI controller of its first state, and the spread of the states in the loop."""

    A: np.ndarray
    B: np.ndarray
    gain: tuple[float, float]
    spread: np.ndarray

    def record(self, rng: np.random.Generator, steps: int, count: int, **noise: float | bool) -> Records:
        """Return records and their set points; noises are shares of the spread."""
        more = {name: one if isinstance(one, bool) else one * self.spread for name, one in noise.items()}
        return [run_loop(rng, steps, gain=self.gain, plant=(self.A, self.B), **more) for _ in range(count)]


def draw_loop(number: int) -> Loop:
    """Return a random plant of two states, under a PI controller that holds it."""
    rng = np.random.default_rng([352, number])
    while True:
        A, B = rng.normal(size=(2, 2)), 0.3 * rng.normal(size=(2, 1))
        A *= rng.uniform(0.75, 0.95) / np.abs(np.linalg.eigvals(A)).max()
        B *= np.sign(np.linalg.solve(np.eye(2) - A, B)[0, 0])
        rest = float(np.linalg.solve(np.eye(2) - A, B)[0, 0])
        if rest < 0.3:
            continue
        gain = 0.5 / rest, 0.05 / rest
        closed = np.block([[A - B @ [[gain[0], 0.0]], B * gain[1]], [np.array([[-1.0, 0.0]]), np.eye(1)]])
        if np.abs(np.linalg.eigvals(closed)).max() < SLOWEST:
            data, _ = run_loop(rng, 400, gain=gain, plant=(A, B))
            return Loop(A, B, gain, data[0].X.std(axis=0))


def fit(way: str, data: km.Episodes, r: list[np.ndarray], level: float | None = None) -> np.ndarray:
    """Return [A B] by one of the three ways; NaN where the record identifies nothing."""
    model = km.edmd(data, km.State())
    try:
        if way == "instruments":
            model = km.identify.instrumental_edmd(data, km.State(), r, level=level)
        elif way == "direct":
            model = km.identify.prediction_error(model, data)
    except km.errors.DataError as problem:
        if "not identifiable" not in str(problem):
            raise
        return np.full((data.nx, data.nx + data.nu), np.nan)
    return np.hstack([model.A, model.B])


def judge_feedback(number: int) -> Biases:
    """Return the row of the plant of this number."""
    loop, rng = draw_loop(number), np.random.default_rng([353, number])
    truth = np.hstack([loop.A, loop.B])
    bias, bound, left = dict[str, list[float]](), dict[str, list[float]](), dict[str, list[int]]()
    for steps in LENGTHS:
        records = loop.record(rng, steps, RECORDS, sensor=SENSOR)
        fits = [np.array([fit(way, *one) for one in records]) for way in WAYS]
        found = [one[np.isfinite(one).all(axis=(1, 2))] for one in fits]
        bias[str(steps)] = [round(float(np.linalg.norm(one.mean(axis=0) - truth)), 6) for one in found]
        bound[str(steps)] = [round(float(3 * np.linalg.norm(one.std(axis=0)) / len(one) ** 0.5), 6) for one in found]
        left[str(steps)] = [RECORDS - len(one) for one in found[1:]]
    records = loop.record(rng, 800, RECORDS, process=PROCESS)
    spent = [np.array([fit(way, *one, level=LEVEL) for one in records]).var(axis=0).sum() for way in WAYS]
    still = loop.record(rng, 400, 20, sensor=SENSOR, moves=False)
    refused = [sum(bool(np.isnan(fit(way, *one)).any()) for one in still) for way in WAYS[1:]]
    return Biases(bias, bound, [round(float(one / spent[0]), 4) for one in spent[1:]], refused, left)
