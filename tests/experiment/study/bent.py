"""Nonlinear plants under PI: how often the noise that feedback carries is taken out of their logs, and what that gains."""

from dataclasses import dataclass
from unittest.mock import patch

import numpy as np

import koopmpc as km
from koopmpc.synthesis import select as selecting
from koopmpc.synthesis.feedback import FeedbackData
from tests.experiment.study.drift import BentPlant, draw_bent
from tests.experiment.study.plants import DT, build_plant

EPISODES, STEPS = 4, 400
NOISES = (0.02, 0.1, 0.3)  # of the sensors, as a share of the states' spread, in turn
GAIN = (0.8, 0.08)  # of the PI loop, over the gain of the plant at rest
HELD = 15  # steps of a set point
AHEAD = 20  # steps of the forecasts that are compared


@dataclass(frozen=True)
class Taken:
    """Whether `select` took noise out of the logs of one plant, with set points as instruments and without.

    Attributes
    ----------
    noise
        Of the sensors, as a share of the states' spread.
    taken
        Without and with instruments.
    ratio
        Error of the chosen model over that of the model chosen of the logs as they are, in forecasts of a loop without
        noise that neither has seen; without and with instruments, 1 where nothing was taken.
    """

    noise: float
    taken: list[bool]
    ratio: list[float]


def record(
    bent: BentPlant, rng: np.random.Generator, noise: np.ndarray | float, gain: float
) -> tuple[km.Episodes, list[np.ndarray]]:
    """Return logs of a PI loop on the first state and input, and their set points."""
    nx, nu = bent.B.shape
    plant = build_plant(bent.A, bent.B, bent.C, bent.D)
    logs, signals = list[km.Episode](), list[np.ndarray]()
    for _ in range(EPISODES):
        r = np.repeat(rng.uniform(-1, 1, -(-STEPS // HELD)), HELD)[:STEPS, None] * gain
        x, total, X, U = np.zeros(nx), 0.0, list[np.ndarray](), list[np.ndarray]()
        other = 0.3 * np.repeat(rng.uniform(-1, 1, (-(-STEPS // HELD), nu)), HELD, axis=0)
        for k in range(STEPS):
            X.append(x + noise * rng.standard_normal(nx))
            error = (r[k, 0] - X[-1][0]) / gain
            total = float(np.clip(total + error, -1 / GAIN[1], 1 / GAIN[1]))
            u = other[k].copy()
            u[0] = np.clip(GAIN[0] * error + GAIN[1] * total, -2, 2)
            U.append(u)
            x = np.asarray(plant(x, u))
        X.append(x + noise * rng.standard_normal(nx))
        logs.append(km.Episode(X=np.array(X), U=np.array(U)))
        signals.append(r)
    return km.Episodes(logs, DT, plant.states, plant.inputs), signals


def draw_loop(number: int) -> tuple[BentPlant, float, np.ndarray]:
    """Return a plant whose first input moves its first state, the gain, and the spread of the states in the loop."""
    rng = np.random.default_rng([354, number])
    while True:
        bent, _ = draw_bent(rng)
        gain = -float(np.linalg.solve(bent.A, bent.B)[0, 0])
        if abs(gain) < 0.3:
            continue
        try:
            clean, _ = record(bent, rng, 0.0, gain)
        except km.errors.DataError:
            continue
        X = np.concatenate([e.X for e in clean])
        if np.abs(X).max() < 5 and X[:, 0].std() > 0.1 * abs(gain):
            return bent, gain, X.std(axis=0)


def choose(data: km.Episodes, r: list[np.ndarray] | None, *, keep: bool = False) -> tuple[km.LinearPredictor, bool]:
    """Return the model of `select`, and whether it took noise out; with `keep` of the logs as they are."""

    def refuse(logs: km.Episodes, _: object) -> FeedbackData:
        return FeedbackData(logs, np.zeros(logs.nx), "")

    plain = km.State() + km.Constant()
    some = [plain, plain + km.Monomials(2), plain + km.Monomials(3)]
    options = {"candidates": some, "delays": (0,), "bilinear": False, "instruments": r}
    if keep:
        with patch.object(selecting, "remove_feedback", refuse):
            return km.select(data, **options).predictor, False
    chosen = km.select(data, **options)
    return chosen.predictor, any(note.startswith("models are of") for note in chosen.notes)


def judge_bent(number: int) -> Taken:
    """Return the row of the plant of this number."""
    bent, gain, spread = draw_loop(number)
    rng, share = np.random.default_rng([355, number]), NOISES[number % len(NOISES)]
    data, r = record(bent, rng, share * spread, gain)
    clean, _ = record(bent, rng, 0.0, gain)
    plain = choose(data, None, keep=True)[0]
    taken, ratio = list[bool](), list[float]()
    for signals in (None, r):
        model, was = choose(data, signals)
        rmse = [km.score(one, clean, AHEAD).rmse / spread for one in (model, plain)]
        taken.append(was)
        ratio.append(round(float(np.linalg.norm(rmse[0]) / np.linalg.norm(rmse[1])), 4) if was else 1.0)
    return Taken(share, taken, ratio)
