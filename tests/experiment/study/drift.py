"""`find_drift` on nonlinear plants: how often unchanged ones are named, and changes of a fifth by their name."""

from dataclasses import dataclass, replace

import numpy as np

import koopmpc as km
from tests.experiment.study.plants import DT, build_plant

OLD, NEW, QUIET = (6, 150), (1, 500), (1, 300)  # episodes and steps
HOLD = 5  # steps of an input's level
NOISE = 0.005  # of the sensors, as a share of the states' spread
SLOWEST = -0.5  # largest real part of the eigenvalues in rest
WILDEST = 10.0  # plants whose states go beyond are drawn again
FAR = 6.0  # an input in whose reach there are no old data


@dataclass(frozen=True)
class Verdicts:
    """What `find_drift` said of one plant.

    Attributes
    ----------
    unchanged, quiet, far
        Verdicts on the same plant with another set point and load, with hardly any excitation, and far from the data.
    compared
        How many of the rows far from the data were compared.
    kind, changed, right
        What was changed by a fifth, the verdict, and whether what changed is among the names.
    """

    unchanged: str
    quiet: str
    far: str
    compared: int
    kind: str
    changed: str
    right: bool


@dataclass(frozen=True, eq=False)
class BentPlant:
    """A `DrawnPlant` that is stable, with sensors."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    load: np.ndarray | float = 0.0
    gain: np.ndarray | float = 1.0
    sensor: np.ndarray | float = 1.0

    def log(
        self,
        size: tuple[int, int],
        rng: np.random.Generator,
        noise: np.ndarray | float,
        *,
        amplitude: float = 1.0,
        middle: float = 0.0,
    ) -> km.Episodes:
        """Return logs from rest under random steps, without rows that are beyond all bounds."""
        episodes, steps = size
        nx, nu = self.B.shape
        plant = build_plant(self.A, self.B, self.C, self.D, self.load)
        levels = rng.uniform(-1, 1, (episodes, -(-steps // HOLD), nu))
        U = middle + amplitude * np.repeat(levels, HOLD, axis=1)[:, :steps]
        X = plant.rollouts(np.zeros((episodes, nx)), self.gain * U)
        Y = X * self.sensor + noise * rng.standard_normal(X.shape)
        return km.Episodes([km.Episode(X=y, U=u) for y, u in zip(Y, U, strict=True)], DT, plant.states, plant.inputs)


def draw_bent(rng: np.random.Generator) -> tuple[BentPlant, np.ndarray]:
    """Return a plant whose states stay bounded under random steps, and their spread."""
    while True:
        nx = int(rng.integers(1, 4))
        nu = int(rng.integers(1, 3)) if nx > 1 else 1
        A, B = rng.normal(size=(nx, nx)), rng.normal(size=(nx, nu))
        A += (SLOWEST - np.linalg.eigvals(A).real.max()) * np.eye(nx)
        bent = BentPlant(A, B, 0.3 * rng.normal(size=(nx, nx)), 0.2 * rng.normal(size=(nx, nx)))
        try:
            X = np.concatenate([e.X for e in bent.log((2, 400), rng, 0.0)])
        except km.errors.DataError:
            continue
        if np.abs(X).max() < WILDEST:
            return bent, X.std(axis=0)


def _change(bent: BentPlant, number: int, rng: np.random.Generator) -> tuple[BentPlant, str, str]:
    """Return the plant with one thing changed by a fifth, its kind, and its name."""
    share, kind = float(rng.choice([0.8, 1.2])), ("input", "sensor", "coefficient")[number % 3]
    nx, nu = bent.B.shape
    states, inputs = ("a", "b", "c")[:nx], ("u", "v")[:nu]
    if kind == "input":
        j, gain = int(rng.integers(nu)), np.ones(nu)
        gain[j] = share
        return replace(bent, gain=gain), kind, f"the gain of {inputs[j]}"
    if kind == "sensor":
        j, sensor = int(rng.integers(nx)), np.ones(nx)
        sensor[j] = share
        return replace(bent, sensor=sensor), kind, f"the sensor of {states[j]}"
    i, j = np.unravel_index(int(np.argmax(np.abs(bent.A))), bent.A.shape)
    A = bent.A.copy()
    A[i, j] *= share
    return replace(bent, A=A), kind, f"the coefficient of {states[j]} in the change of {states[i]}"


def judge_drift(number: int) -> Verdicts:
    """Return the verdicts on the plant of this number."""
    rng = np.random.default_rng([3500, number])
    bent, size = draw_bent(rng)
    noise = NOISE * size
    old = bent.log(OLD, rng, noise)
    load = rng.uniform(-0.05, 0.05, len(size)) * size * (number % 2)
    moved = replace(bent, load=load).log(
        NEW, rng, noise, amplitude=0.8, middle=rng.uniform(-0.3, 0.3) * (number % 3 > 0)
    )
    quiet = bent.log(QUIET, rng, noise, amplitude=0.005)
    try:
        away = km.validate.find_drift(old, bent.log(QUIET, rng, noise, amplitude=0.3, middle=FAR))
        far, compared = away.verdict, away.inside
    except km.KoopmpcError:  # the plant does not bear it
        far, compared = "diverged", 0
    other, kind, name = _change(bent, number, rng)
    found = km.validate.find_drift(old, replace(other, load=load).log(NEW, rng, noise))
    return Verdicts(
        km.validate.find_drift(old, moved).verdict,
        km.validate.find_drift(old, quiet).verdict,
        far,
        compared,
        kind,
        found.verdict,
        name in {one.name for one in found.changes},
    )
