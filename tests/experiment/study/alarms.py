"""`Adaptive` on linear plants: how often it raises an alarm where nothing changed, and what it names where a gain did."""

from dataclasses import dataclass

import numpy as np

import koopmpc as km
from tests.validate.test_drift import SIGMA, draw_plant, log, sample

STEPS = 500  # of a run
CHANGED = 100  # step at which the gain of an input changes by a fifth
HELD = 5  # steps of a set point
DITHER = 0.5  # random steps on top of the controller's input: excitation as in the design's data


@dataclass(frozen=True)
class Alarms:
    """Runs of one plant with an `Adaptive`.

    Attributes
    ----------
    false, renewed
        Alarms, and models that came into use, while nothing changed.
    unchanged
        What `Adaptive.find_drift` says then.
    true
        Alarms where the gain of an input changed by a fifth.
    changed, right
        What `Adaptive.find_drift` says then, and whether that gain is among the names.
    """

    false: int
    renewed: int
    unchanged: str
    true: int
    changed: str
    right: bool


def run(
    plant: tuple[np.ndarray, np.ndarray, np.ndarray], rng: np.random.Generator, gain: np.ndarray
) -> tuple[km.Episodes, km.supervise.Adaptive]:
    """Return the data of a design, and a controller that learns after a run in which the gains of inputs change once."""
    A, B, size = plant
    nx, nu, sigma = len(A), B.shape[1], SIGMA * size
    old = log(A, B, 6, 150, rng, sigma)
    lifting = km.State() + km.Constant()
    model = km.edmd(old, lifting)
    mpc = km.KoopmanMPC(model, km.Cost(Q=1 / size**2, R=0.1 * np.ones(nu)), km.Limits(u_min=-1, u_max=1), 10)
    learning = km.supervise.Adaptive(mpc, km.OnlineEDMD.start(old, lifting, forgetting=0.98))
    F, G = sample(A, B, 0.1)
    x, goal, extra = np.zeros(nx), np.zeros(nx), np.zeros(nu)
    for k in range(STEPS):
        if k % HELD == 0:
            goal, extra = size * rng.uniform(-1, 1, nx), DITHER * rng.uniform(-1, 1, nu)
        before = learning(x + sigma * rng.standard_normal(nx), goal, u if k else None).u
        u = np.clip(before + extra, -1, 1)
        x = F @ x + G @ (u * (gain if k >= CHANGED else 1.0))
    return old, learning


def judge_alarms(number: int) -> Alarms:
    """Return the row of the plant of this number."""
    rng = np.random.default_rng([356, number])
    plant = draw_plant(rng)
    nu = plant[1].shape[1]
    old, still = run(plant, rng, np.ones(nu))
    gain, j = np.ones(nu), int(rng.integers(nu))
    gain[j] = float(rng.choice([0.8, 1.2]))
    data, learning = run(plant, rng, gain)
    found = learning.find_drift(data)
    return Alarms(
        still.alarms,
        still.renewed,
        still.find_drift(old).verdict,
        learning.alarms,
        found.verdict,
        f"the gain of u{j}" in {one.name for one in found.changes},
    )
